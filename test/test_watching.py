"""Looking at a topic: hz, bw, last and watch."""
import collections
import contextlib
import re
import signal
import sys
import threading

import pexpect
import pytest
from geometry_msgs.msg import Point, Point32, Polygon
from sensor_msgs.msg import Image, JointState, LaserScan, PointCloud
from std_msgs.msg import String

from helpers import create, ended, in_thread, speak_tcpros_only
from pharos import NodeStoppedError, UnknownTopicError
from pharos.live import watching
from pharos.live.figures import size_text
from pharos.live.message_text import text_of_message
from pharos.live.notebook import html_of
from pharos.testing import TIMEOUT, until
from programs import PROGRAMS, Program, environment

RATE = 40  # messages a second
TEXT = 'x' * 100


@contextlib.contextmanager
def publishing(master, topic, rate=RATE, **options):
    """A node of this process that publishes all the time."""
    with create(master, '/sender', **options) as node:
        channel = node.output_channel(topic, 'std_msgs/String')

        def soul(me):
            for _ in me.every(1 / rate):
                channel.send(data=TEXT)

        node.fork(soul)
        yield channel


def publishing_apart(master, topic, rate=RATE):
    """The same as a process of its own."""
    program = Program(
        master.url, sys.executable, str(PROGRAMS / 'publishes.py'), topic, str(rate), '100'
    )
    program.wait_for('publishing')
    until(lambda: master.topic(topic).publishers)
    return program


@pytest.mark.parametrize('publishing', [publishing, publishing_apart])
def test_hz_tells_how_often_messages_come(master, publishing):
    with publishing(master, '/watched'):
        rate = master.topic('/watched').hz(1)
    assert RATE / 10 < float(rate) < RATE * 2
    assert rate.window >= 2
    assert 0 <= rate.min <= 1 / rate.rate <= rate.max < TIMEOUT
    assert 0 <= rate.std_dev < TIMEOUT
    assert re.fullmatch(
        r'\S+ Hz \(\S+ to \S+ s apart, std dev \S+ s\), \d+ messages in 1 s', repr(rate)
    )


def test_hz_agrees_with_rostopic(master):
    with publishing(master, '/watched'):
        with Program(master.url, 'rostopic', 'hz', '/watched') as rostopic:
            theirs = float(rostopic.wait_for('average rate').split()[-1])
        ours = master.topic('/watched').hz(1).rate
    assert theirs / 2 < ours < theirs * 2


@pytest.mark.parametrize('publishing', [publishing, publishing_apart])
def test_bw_tells_how_many_bytes_come(master, publishing):
    with publishing(master, '/watched'):
        bandwidth = master.topic('/watched').bw(1)
    size = 4 + len(TEXT)  # the text is preceded by its length
    assert bandwidth.mean == bandwidth.min == bandwidth.max == size
    assert float(bandwidth) == bandwidth.rate == size * bandwidth.window
    assert repr(bandwidth) == (
        f'{size_text(bandwidth.rate)}/s (104 B each), {bandwidth.window} messages in 1 s'
    )


def test_a_publisher_in_this_process_connects_without_a_socket_and_is_left_as_it_was(master):
    with publishing(master, '/watched') as channel:
        look = in_thread(master.topic('/watched').hz, 1)
        until(lambda: [transport for _, transport in channel.connections] == ['INTRAPROCESS'])
        assert ended(look)
        assert channel.connections == []
        assert [node.name for node in master.local_nodes()] == ['/sender']


def test_hz_makes_no_messages_of_those_in_this_process(master, monkeypatch):
    made = []
    monkeypatch.setattr(String, 'serialize', lambda *arguments: made.append(arguments))
    with publishing(master, '/watched'):
        assert master.topic('/watched').hz(0.5).window
    assert made == []


def test_a_look_needs_no_node_of_this_process_and_no_type(master):
    with Program(master.url, 'rostopic', 'pub', '-r', '20', '/watched', 'std_msgs/Empty', '{}'):
        until(lambda: master.topic('/watched').publishers)
        assert master.topic('/watched').hz(1).window
        assert master.topic('/watched').bw(1).max == 0


@pytest.mark.parametrize('look', ['hz', 'bw'])
def test_a_topic_on_which_nothing_comes_has_a_rate_of_0(master, look):
    with create(master) as node:
        node.output_channel('/watched', 'std_msgs/String')
        found = getattr(master.topic('/watched'), look)(0.1)
    assert float(found) == found.window == 0
    assert repr(found).endswith('no messages in 0.1 s')


def test_one_message_makes_no_rate(master):
    with create(master) as node:
        channel = node.output_channel('/watched', 'std_msgs/String')
        found = []
        look = in_thread(lambda: found.append(master.topic('/watched').hz(1)))
        channel.wait_for_subscribers(1, TIMEOUT)
        # until the window has begun, what comes is taken for a latched message
        until(lambda: not look.is_alive() or channel.send(data='x') and False or found)
    assert found[0].window >= 2
    one = watching.dataclasses.replace(found[0], rate=0.0, window=1)
    assert repr(one) == '0 Hz, 1 message in 1 s'


LOOKS = {
    'hz': lambda topic: topic.hz(0.1),
    'bw': lambda topic: topic.bw(0.1),
    'last': lambda topic: topic.last,
    'watch': lambda topic: topic.watch(1),
}


@pytest.mark.parametrize('look', LOOKS.values(), ids=LOOKS)
def test_a_topic_that_nobody_publishes_is_told_at_once(master, look):
    with create(master) as node:
        with pytest.raises(UnknownTopicError, match='^nobody publishes on /watched at http'):
            look(master.topic('/watched'))
        node.interested_in('/watched', 'std_msgs/String')
        with pytest.raises(UnknownTopicError, match='/watched, heard by /node: start a node'):
            look(master.topic('/watched'))
        node.output_channel('/watcher', 'std_msgs/String')
        with pytest.raises(UnknownTopicError, match="did you mean '/watcher'"):
            look(master.topic('/watched'))


@pytest.mark.parametrize('seconds', [0, -1, 'long', float('nan'), None])
def test_seconds_that_are_none_are_refused(master, seconds):
    with pytest.raises(ValueError, match='seconds is a number of seconds above 0'):
        master.topic('/watched').hz(seconds)


def test_simulated_time_is_told(master):
    master.parameters['/use_sim_time'] = True
    try:
        with publishing(master, '/watched'):
            rate = master.topic('/watched').hz(0.1)
    finally:
        del master.parameters['/use_sim_time']
    assert rate.is_time_simulated
    assert repr(rate).endswith('in 0.1 s of wall time, though time is simulated')


def test_last_is_what_was_latched(master):
    with create(master) as node:
        channel = node.output_channel('/watched', 'std_msgs/String', latch=True)
        channel.send(data='kept')
        assert master.topic('/watched').last.data == 'kept'
        assert channel.connections == []
        speak_tcpros_only(node)
        assert master.topic('/watched').last.data == 'kept'


@pytest.mark.parametrize('publishing', [publishing, publishing_apart])
def test_last_is_else_the_next_message(master, publishing):
    with publishing(master, '/watched'):
        assert master.topic('/watched').last.data == TEXT


def test_last_waits_for_so_long_only(master):
    with create(master) as node:
        node.output_channel('/watched', 'std_msgs/String')
        with pytest.raises(
            TimeoutError, match='on /watched within 0.1 s: it is published by /node'
        ):
            watching.last(master.topic('/watched'), 0.1)


def test_watch_shows_the_next_messages(master, transcript):
    with publishing(master, '/watched'):
        master.topic('/watched').watch(2)
    assert transcript == [f'data: "{TEXT}"\n---'] * 2


def test_watch_runs_a_block_in_the_thread_that_asks(master):
    came = []
    with publishing_apart(master, '/watched'):
        master.topic('/watched').watch(3, came.append)
    assert [message.data for message in came] == [TEXT] * 3


def test_a_node_of_the_block_that_has_stopped_is_told(master):
    node = create(master)
    node.stop()
    with publishing(master, '/watched'):
        with pytest.raises(NodeStoppedError, match='/node'):
            master.topic('/watched').watch(2, lambda message: node.send_to('/more', data='x'))


@pytest.mark.parametrize('count', [0, -1, 1.5, 'many'])
def test_a_count_that_is_none_is_refused(master, count):
    with pytest.raises(ValueError, match='count is a number of messages, 1 or more'):
        master.topic('/watched').watch(count)


def test_what_the_block_raises_ends_the_watching(master):
    def block(message):
        raise RuntimeError('enough')

    with publishing(master, '/watched') as channel:
        with pytest.raises(RuntimeError, match='enough'):
            master.topic('/watched').watch(None, block)
        assert channel.connections == []


def test_a_soul_that_watches_ends_with_its_node(master):
    raised = []

    def soul(me):
        try:
            me.master.topic('/watched').watch()
        except NodeStoppedError as error:
            raised.append(str(error))

    with create(master) as node:
        channel = node.output_channel('/watched', 'std_msgs/String')
        thread = node.fork(soul)
        channel.wait_for_subscribers(1, TIMEOUT)
        node.stop()
        assert ended(thread)
    assert len(raised) == 1
    until(lambda: not master.local_nodes())


def test_ctrl_c_ends_a_watch_of_a_script(master):
    script = 'import pharos; pharos.Master().topic("/watched").watch(); print("went on")'
    with publishing_apart(master, '/watched'):
        with Program(master.url, sys.executable, '-c', script) as program:
            program.wait_for('---')
            assert program.end(signal.SIGINT) == 0
            assert program.read_to_the_end().endswith('---\nwent on\n')
            assert 'pharos_looks' not in str(master.system_state())


def test_ctrl_c_at_a_prompt_ends_the_watch_and_stops_no_node(master):
    prompt = pexpect.spawn(
        sys.executable, ['-i', '-q'], env=environment(master.url), timeout=TIMEOUT
    )
    prompt.expect('>>> ')
    prompt.sendline(
        'import pharos; node = pharos.Master().create(pharos.BlockNode, named="/prompt")'
    )
    prompt.expect('>>> ')
    with publishing_apart(master, '/watched'):
        prompt.sendline('node.master.topic("/watched").watch()')
        prompt.expect('---')
        prompt.sendintr()
        prompt.expect('>>> ')
        assert 'Error' not in str(prompt.before)
        prompt.sendline('node.is_running, len(node.master.local_nodes())')
        prompt.expect(r'\(True, 1\)')
        prompt.sendline('print(node.master.topic("/watched").hz(100))')
        until(lambda: 'pharos_looks' in str(master.topic('/watched').subscribers))
        prompt.sendintr()
        prompt.expect('KeyboardInterrupt')
        until(lambda: not master.topic('/watched').subscribers)
    prompt.sendeof()
    prompt.expect(pexpect.EOF)
    prompt.close()


def test_long_arrays_are_cut():
    scan = text_of_message(LaserScan(ranges=[1.5] * 720))
    assert 'ranges: [1.5, 1.5, 1.5, ... 720 in all]' in scan
    assert 'intensities: []' in scan
    assert 'data: [7, 7, 7, ... 100 in all]' in text_of_message(Image(data=b'\x07' * 100))
    assert text_of_message(Image(data=b'\x07' * 2)).endswith('data: [7, 7]')
    cloud = text_of_message(PointCloud(points=[Point32(1, 2, 3)] * 100))
    assert cloud.count('x: 1') == 3
    assert '  - ... 100 in all' in cloud
    assert text_of_message(Point(1, 2, 3)) == 'x: 1\ny: 2\nz: 3'
    assert text_of_message(Polygon()) == 'points: []'


@pytest.mark.parametrize('data', [b'\x07', bytearray(b'\x07'), [7], collections.deque([7])])
def test_arrays_are_cut_whatever_a_block_has_put_there(data):
    assert 'data: [7, 7, 7, ... 100 in all]' in text_of_message(Image(data=data * 100))
    assert text_of_message(Image(data=data * 2)).endswith('data: [7, 7]')


def test_long_strings_are_cut():
    text = text_of_message(String(data='x' * 10**6))
    assert '1000000 characters in all' in text and len(text) < 3000
    assert len(text_of_message(Image(data='x' * 10**6))) < 20000


def test_a_field_that_a_block_has_deleted_is_none():
    message = String()
    del message.data
    assert text_of_message(message) == 'data: None'
    assert 'None' in html_of(message)


def test_messages_do_nothing_to_the_terminal():
    names = ['\x1b[2J'] * 20
    assert '[?[2J, ?[2J, ' in text_of_message(JointState(name=names))
    assert '\x1b' not in text_of_message(JointState(name=names[:2]))


def test_a_soul_that_watches_ends_though_its_node_stopped_between_two_messages(master):
    came, go_on = threading.Event(), threading.Event()

    def block(message):
        came.set()
        go_on.wait(TIMEOUT)

    def soul(me):
        me.master.topic('/watched').watch(None, block)

    with publishing_apart(master, '/watched'):
        node = create(master, soul=soul)
        thread = node.fork()
        assert came.wait(TIMEOUT)
        stop = in_thread(node.stop)
        until(lambda: not node.is_running)
        go_on.set()
        assert ended(stop) and ended(thread)
    assert not master.local_nodes()
