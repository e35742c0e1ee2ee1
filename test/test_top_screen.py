"""rosrun pharos top in a real terminal, as a user sees it."""
import contextlib
import functools
import os
import pty
import re
import signal
import sys
import threading
import time

import pexpect
import pytest

from helpers import create
from pharos import BlockNode, Master
from pharos.live.message_text import printable
from pharos.live.terminal import Terminal as Keyboard
from pharos.testing import TIMEOUT, until
from programs import PROGRAMS, environment, script

SEQUENCES = re.compile(r'\x1b\[[0-9;?]*[A-Za-z]|\x1b[()][A-Z0-9]|\r')
HOME = '\x1b[H'
LEAVE = '\x1b[?1049l'  # the screen is again what it was before


class Terminal:
    """A program in a terminal of its own, and what it shows."""

    def __init__(self, master_url, *command, size=(24, 80)):
        self.process = pexpect.spawn(
            command[0],
            list(command[1:]),
            env=environment(master_url, TERM='xterm-256color'),
            dimensions=size,
            encoding='utf-8',
            timeout=TIMEOUT,
        )
        self.written = ''

    def frame(self):
        """The lines that were drawn last, perhaps not all of them yet."""
        with contextlib.suppress(pexpect.TIMEOUT, pexpect.EOF):
            self.written += self.process.read_nonblocking(1 << 16, 0.02)
        return SEQUENCES.sub('', self.written.rpartition(HOME)[2]).split('\n')

    def wait_for(self, pattern):
        """A whole frame in which there is that, as text."""
        found = []

        def look():
            found[:] = self.frame()
            return found[-1].startswith('q quit') and re.search(pattern, '\n'.join(found))

        try:
            until(look)
        except TimeoutError:
            raise AssertionError('\n'.join([f'no {pattern!r} in:', *found])) from None
        return found

    def press(self, keys, pattern):
        """Press keys, and wait for what they bring about."""
        self.process.send(keys)
        return self.wait_for(pattern)

    def end(self):
        """The status with which it ends by itself."""
        with contextlib.suppress(pexpect.EOF):
            while True:
                self.written += self.process.read_nonblocking(1 << 16, TIMEOUT)
        self.process.wait()
        return self.process.exitstatus


@contextlib.contextmanager
def top(master_url, *arguments, size=(24, 80), starts=True):
    terminal = Terminal(
        master_url, script('top'), '--interval', '0.2', *map(str, arguments), size=size
    )
    try:
        if starts:
            terminal.wait_for('NODE')
        yield terminal
    finally:
        terminal.process.close(force=True)


@pytest.fixture
def sender(master):
    """A node that publishes all the time, and one that hears it."""
    with create(master, '/sender') as node, create(master, '/hearer') as hearer:
        channel = node.output_channel('/traffic', 'std_msgs/String')
        hearer.interested_in('/traffic')
        hearer.interested_in('/another', 'std_msgs/Bool')

        def soul(me):
            for _ in me.every(0.02):
                channel.send(data='x')

        node.fork(soul)
        yield node


def column(frame, index=0):
    """The words of a column, without its title."""
    return [line.split()[index] for line in frame[3:-1] if line.strip()]


def test_keys_switch_between_nodes_processes_and_topics_in_80_columns(master, sender):
    with top(master.url) as shown:
        frames = [
            shown.wait_for(r'NODE .*IN/S +OUT/S +IN B/S +OUT B/S +LOCAL +TCP +DROP +FAIL'),
            shown.press('p', r'\n *PID +CPU +MEM +IN/S +OUT/S .* NODES'),
            shown.press('t', r'TOPIC +TYPE +HZ +B/S +PUB +SUB +LOCAL +TCP +DROP'),
            shown.press('\t', r'NODE .*IN/S'),
            shown.press('n', r'\n/sender +- +[1-9][\d.]+ '),  # when there are rates
        ]
        for frame in frames:
            assert len(frame) == 24
            assert max(map(len, frame)) <= 80
            assert re.match(rf'pharos top  .* every 0.2 s  {master.url}', frame[0])
            assert frame[-1].startswith('q quit')
        assert re.search(r'std_msgs/String +[\d.-]+ +', '\n'.join(frames[2]))


def test_a_column_sorts_and_the_order_is_reversed(master, sender):
    with top(master.url) as shown:
        names = column(shown.press('t', 'TOPIC'))
        assert names == sorted(names)
        assert column(shown.press('r', rf'(?s){names[-1]} .*{names[0]} '))[0] == names[-1]
        shown.press('r', rf'(?s){names[0]} .*{names[-1]} ')
        # to TYPE, then to HZ, by which the busiest comes first
        frame = shown.press('ss', r'TOPIC[^\n]*\n/traffic ')
        assert column(frame)[0] == '/traffic'
        shown.press('SS', rf'TOPIC[^\n]*\n{names[0]} ')


def test_a_filter_leaves_what_has_the_text_in_its_name(master, sender):
    with top(master.url) as shown:
        shown.press('t', 'TOPIC')
        assert column(shown.press('/traf', r'filter: traf_')) == ['/traffic']
        shown.press('x', r'filter: trafx_')
        shown.press('\x7f', r'filter: traf_')
        shown.press('\x1b[D\x1b[3~\x1b[1;5Ay', r'filter: trafy_')  # keys that are none of ours
        shown.press('\x7f', r'filter: traf_')
        # q is a letter while it is typed, and a key afterwards
        assert column(shown.press('q', r'filter: trafq_')) == []
        shown.press('\x7f\r', r'filter: traf(?!_)')
        shown.press('\x1b', r'/another')
        shown.press('/zz\x1b', r'/another')
        assert 'filter:' not in ''.join(shown.frame())


def test_it_pauses(master, sender):
    with top(master.url) as shown:
        shown.press(' ', 'PAUSED')
        frame = shown.press('p', 'PID')
        with create(master, '/newcomer'):
            shown.press('n', 'NODE')
            shown.press('t', 'TOPIC')
            assert shown.press('n', 'NODE')[1].split()[0] == frame[1].split()[0]
            shown.press(' ', '/newcomer')


def test_more_rows_than_lines_are_scrolled_through(master, sender):
    with create(master, '/many') as node:
        for number in range(30):
            node.interested_in(f'/many/{number:02}', 'std_msgs/Bool')
        with top(master.url, size=(12, 80)) as shown:
            count = len(master.topics())
            shown.press('t', rf'1 to 8 of {count}')
            shown.press('\x1b[B', rf'2 to 9 of {count}')
            shown.press('\x1b[6~', rf'10 to 17 of {count}')
            shown.press('\x1b[A', rf'9 to 16 of {count}')
            shown.press('\x1b[F', rf'{count - 7} to {count} of {count}')
            shown.press('\x1b[H', rf'1 to 8 of {count}')
            shown.press('\x1b[5~\x1b[15~', rf'1 to 8 of {count}')  # F5 is no key of ours


def test_it_follows_the_size_of_the_terminal(master, sender):
    with top(master.url) as shown:
        shown.wait_for('/sender')
        shown.process.setwinsize(10, 60)
        until(lambda: len(shown.frame()) == 10)
        frame = shown.wait_for('/sender')
        assert max(map(len, frame)) <= 60
        shown.process.setwinsize(30, 140)
        frame = shown.wait_for(r'CLASS +HOST +PID')
        assert len(frame) == 30
        shown.process.setwinsize(2, 9)
        until(lambda: len(shown.frame()) <= 4)
        shown.process.setwinsize(24, 80)
        shown.wait_for('NODE')


@pytest.mark.parametrize(
    'end, status',
    [
        (lambda process: process.send('q'), 0),
        (lambda process: process.sendintr(), 0),
        (lambda process: process.kill(signal.SIGINT), 0),
        (lambda process: process.kill(signal.SIGTERM), 128 + signal.SIGTERM),
        (lambda process: process.kill(signal.SIGHUP), 128 + signal.SIGHUP),
    ],
    ids=['q', 'Ctrl-C', 'SIGINT', 'SIGTERM', 'SIGHUP'],
)
def test_it_leaves_the_screen_as_it_was(master, sender, end, status):
    with top(master.url) as shown:
        shown.wait_for('NODE')
        end(shown.process)
        assert shown.end() == status
        assert shown.written.endswith(LEAVE)
        assert '\x1b[?25h' in shown.written  # the cursor is shown
        assert 'Traceback' not in shown.written


FAILING = f"{sys.executable} {PROGRAMS / 'failing_top.py'} {script('top')}"


@pytest.mark.parametrize(
    'command, key, says',
    [(script('top'), 'q', 'status 0'), (FAILING, '', 'a fault of its own')],
    ids=['q', 'an error'],
)
def test_the_terminal_is_as_it_was_after_it(master, sender, command, key, says):
    shell = Terminal(master.url, '/bin/sh').process
    shell.sendline('PS1=; stty -a; echo be""fore')
    shell.expect('(speed.*)before\r\n')
    before = shell.match.group(1).splitlines()[-3:]
    shell.sendline(f'{command}; echo status $?')
    shell.expect('q quit')
    shell.send(key)
    shell.expect(re.escape(LEAVE))
    shell.expect(says)
    shell.sendline('stty -a; echo af""ter')
    shell.expect('(speed.*)after\r\n')
    assert shell.match.group(1).splitlines()[-3:] == before
    shell.close(force=True)


def test_ctrl_z_gives_the_terminal_back_for_a_while(master, sender):
    shell = pexpect.spawn(
        'bash',
        ['--norc', '-i'],
        env=environment(master.url, TERM='xterm-256color', PS1='ready> '),
        dimensions=(24, 80),
        encoding='utf-8',
        timeout=TIMEOUT,
    )
    shell.sendline(f"{script('top')} --interval 0.2")
    shell.expect('q quit')
    shell.send('\x1a')
    shell.expect(re.escape(LEAVE))
    shell.expect('Stopped')
    shell.sendline('echo $((6 * 7))')
    shell.expect('42\r\n')
    shell.sendline('fg')
    shell.expect(re.escape('\x1b[?1049h'))
    shell.expect('q quit')
    shell.send('q')
    shell.expect(re.escape(LEAVE))
    shell.sendline('echo status $?')
    shell.expect('status 0\r\n')
    shell.close(force=True)


def test_a_master_that_goes_away_is_told_and_comes_back(mortal_master):
    with create(Master(mortal_master.url), '/lasting', BlockNode):
        with top(mortal_master.url) as shown:
            shown.wait_for('/lasting')
            mortal_master.end()
            frame = shown.wait_for(r'MASTER AWAY since \d\d:\d\d:\d\d')
            assert '/lasting' in column(frame)  # what was seen last is shown still
            mortal_master.come_back()
            until(lambda: 'AWAY' not in shown.wait_for('NODE')[0])
            shown.wait_for('/lasting')
            shown.process.send('q')
            assert shown.end() == 0


def test_without_a_master_it_ends_at_once(master):
    with top('http://127.0.0.1:1', starts=False) as shown:
        assert shown.end() == 1
        assert 'top: no ROS master answers at http://127.0.0.1:1/' in shown.written
        assert '\x1b[?1049h' not in shown.written


def test_topics_that_nobody_hears_are_measured_where_asked(master):
    with create(master, '/unheard') as node:
        channel = node.output_channel('/unheard', 'std_msgs/String')
        node.fork(lambda me: [channel.send(data='x') for _ in me.every(0.02)])
        with top(master.url, '--measure', 'unheard') as shown:
            shown.press('t', r'/unheard +std_msgs/String +[1-9]\d*\.\d ')
            assert 'rates measured' in shown.frame()[0]
            shown.process.send('q')
            assert shown.end() == 0
        until(lambda: channel.connections == [])


def test_a_node_that_hangs_is_told_and_does_not_hold_up_keys(master, sender):
    hung = threading.Event()
    handler = sender.latest_run.rospy.handler
    handler.getPid = lambda caller_id: hung.wait(TIMEOUT) or (1, '', 0)
    try:
        with top(master.url) as shown:
            shown.wait_for(r'/sender \(silent\)')
            begin = time.monotonic()
            shown.press('t', 'TOPIC')
            assert time.monotonic() - begin < TIMEOUT / 2
    finally:
        hung.set()


def test_names_that_would_do_something_to_a_terminal_do_not():
    assert printable('/a\x1b[2Jb\r\nc') == '/a?[2Jb??c'


@pytest.fixture
def typing(monkeypatch):
    """What writes to a terminal as a keyboard does, and what reads the keys."""
    keyboard, end = pty.openpty()
    with os.fdopen(end) as stdin:
        monkeypatch.setattr(sys, 'stdin', stdin)
        reader = Keyboard()
        with reader:
            yield functools.partial(os.write, keyboard), reader.keys
        reader.close()
    os.close(keyboard)


@pytest.mark.parametrize(
    'typed, expected',
    [
        (b'\x1b', ['escape']),
        (b'\x1b[A\x1bOB', ['up', 'down']),
        (b'\x1b[1~\x1b[7~\x1bOH', ['home'] * 3),
        (b'\x1b[4~\x1b[8~\x1bOF', ['end'] * 3),
        (b'\x1b[Dq', ['q']),
        (b'\x1b[3~\x1b[15~\x1bOP\x1b[[A', []),  # Delete, F5, F1, and F1 of the console
        (b'\x1b[1;5A', []),  # Ctrl and up
    ],
)
def test_keys_that_are_unknown_are_none(typing, typed, expected):
    write, keys = typing
    write(typed)
    assert keys() == expected


def test_a_key_may_come_in_pieces(typing):
    write, keys = typing
    write(b'\xc3')
    assert keys() == []
    write(b'\xa9')
    assert keys() == ['\xe9']
