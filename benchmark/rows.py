"""The rows of a table: each is a player, a process of its own, or two with a socket between them."""
import contextlib
import ctypes
import json
import os
import pathlib
import signal
import socket
import subprocess
import sys
import time
from typing import List, NamedTuple

import rosgraph

HERE = pathlib.Path(__file__).resolve().parent
SOURCE = HERE.parent / 'src'
# row -> the words for player.py; 'two': a process sends, another receives
ROWS = {
    'direct call': ['direct'],
    'SimpleQueue, 2 threads': ['queue'],
    'pharos inline': ['pharos', 'inline'],
    'pharos inline, shared': ['pharos', 'inline', 'shared'],
    'pharos default': ['pharos'],
    'pharos default, send_to': ['pharos', 'send_to'],
    'rospy, 1 process': ['rospy'],
    'pharos, 2 processes': ['pharos', 'two'],
    'rospy, 2 processes': ['rospy', 'two'],
    'rospy, 2 proc., tuned': ['rospy', 'tuned', 'two'],
}
# seconds without a message after which the rest is lost: flat out, and at a rate
SILENCE, SILENCE_AT_A_RATE = 0.4, 2.0


class Ended(Exception):
    """A process that was to measure has ended."""


class Slice(NamedTuple):
    """The measurement of a short while; times in seconds."""

    took: List[float]  # latencies, a sample of them
    sent: int  # messages to be received, over all receivers
    received: int
    duration: float  # from the first message sent to the last received
    cpu: float  # of the processes


class Row:
    """One way of messages; a signal stops its processes while others are measured."""

    def __init__(self, name, commands, environment, errors):
        self.name, self._errors, self._open = name, errors, set()
        pipes = {'stdin': subprocess.PIPE, 'stdout': subprocess.PIPE, 'stderr': errors}
        options = {'text': True, 'env': environment, 'preexec_fn': end_with_parent}
        # the sender last
        self._players = [subprocess.Popen(command, **pipes, **options) for command in commands]
        self._signal(signal.SIGSTOP)

    def measure(self, message, receivers, queue_size, rate, seconds, busy=False):
        """Send for so long and return the :class:`Slice`; the first time, connect."""
        what = message, receivers, queue_size
        self._signal(signal.SIGCONT)
        for player in self._players if what not in self._open else ():
            self._ask(player, 'open', *what)
        self._open.add(what)
        self._slice(what, 100, 0.05, busy)  # warms the caches
        measured = self._slice(what, rate, seconds, busy)
        self._signal(signal.SIGSTOP)
        return measured

    def _slice(self, what, rate, seconds, busy):
        for player in self._players:
            self._ask(player, 'begin', *what)
        sent = self._ask(self._players[-1], 'send', rate, seconds, int(busy))
        expected = sent['sent'] * what[1]
        silence = SILENCE_AT_A_RATE if rate else SILENCE
        found = [self._ask(self._players[0], 'result', expected, silence)]
        found += [self._ask(player, 'result', 0, silence) for player in self._players[1:]]
        duration = max(found[0]['last'] - sent['begun'], sent['took'])
        cpu = sum(each['cpu'] for each in found)
        return Slice(found[0]['took'], expected, found[0]['received'], duration, cpu)

    def _ask(self, player, *words):
        with contextlib.suppress(BrokenPipeError):
            print(*words, file=player.stdin, flush=True)
        answer = player.stdout.readline()
        if not answer:
            self._errors.seek(0)
            said = self._errors.read().splitlines()[-1:]
            raise Ended(f'{self.name} ended with {player.wait()} at {words}: {said}')
        return json.loads(answer)

    def _signal(self, number):
        for player in self._players:
            player.send_signal(number)

    def end(self):
        """End its processes."""
        self._signal(signal.SIGKILL)
        for player in self._players:
            player.wait()


def end_with_parent():
    """Have a child process end with the thread that starts it: a stopped one would stay for ever."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def make(names, environment, folder, beside=None):
    """Return the rows of these names, those of another pharos in ``beside`` marked with '.

    :param folder: for the files of the rows
    """
    found = []
    for name in names:
        way, *words = ROWS[name]
        for source in (SOURCE, beside) if beside and way == 'pharos' else (SOURCE,):
            label = f'row{len(found)}'
            command = ['/usr/bin/python3', str(HERE / 'player.py'), way, label, *words]
            commands = [command]
            if 'two' in words:
                stamps = folder / f'{label}.stamps'
                stamps.touch()
                os.truncate(stamps, 8 << 21)
                roles = 'role=receive', 'role=send'
                commands = [[*command, role, f'stamps={stamps}'] for role in roles]
            errors = open(folder / f'{label}.errors', 'w+')
            mark = "'" if source is beside else ''
            environ = {**environment, 'PYTHONPATH': str(source)}
            found.append(Row(name + mark, commands, environ, errors))
    return found


@contextlib.contextmanager
def ros_master(folder):
    """Start a ROS master as a child process; gives the environment for its nodes."""
    with socket.socket() as free:
        free.bind(('127.0.0.1', 0))
        port = str(free.getsockname()[1])
    dropped = 'ROS_NAMESPACE', 'ROS_IP', 'CMAKE_PREFIX_PATH', 'PYTHONDONTWRITEBYTECODE'
    environment = {key: value for key, value in os.environ.items() if key not in dropped}
    environment.update(ROS_MASTER_URI=f'http://127.0.0.1:{port}/', ROS_HOSTNAME='127.0.0.1')
    environment.update(ROS_LOG_DIR=str(folder), ROS_HOME=str(folder), PYTHONPATH=str(SOURCE))
    pipes = dict.fromkeys(('stdin', 'stdout', 'stderr'), subprocess.DEVNULL)
    command = ['/usr/bin/rosmaster', '--core', '-p', port]
    process = subprocess.Popen(command, env=environment, preexec_fn=end_with_parent, **pipes)
    try:
        while not rosgraph.is_master_online(environment['ROS_MASTER_URI']):
            if process.poll() is not None:
                raise Ended('no ROS master')
            time.sleep(0.05)
        yield environment
    finally:
        process.terminate()
        process.wait()


def run_program(main):
    """Run it; SIGTERM ends it as Ctrl-C does, so that all that it has begun ends, too."""
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        main()
    except Ended as error:
        sys.exit(f'{os.path.basename(sys.argv[0])}: {error}')
