"""The rows of the table: each is a player, a process of its own, or two where messages go from one
to another."""
import contextlib
import ctypes
import json
import os
import pathlib
import random
import signal
import socket
import subprocess
import sys
import time
import xmlrpc.client
from typing import List, NamedTuple

from player import STAMPS

HERE = pathlib.Path(__file__).resolve().parent
SOURCE = HERE.parent / 'src'
BUILD = HERE.parent / 'build' / 'benchmark'
# Debian package -> what of it is in /usr/include
CPP_PACKAGES = {
    'libroscpp-dev': 'ros/ros.h',
    'libnodeletlib-dev': 'nodelet/loader.h',
    'pluginlib-dev': 'pluginlib',
    'libgeometry-msgs-dev': 'geometry_msgs/Twist.h',
    'libsensor-msgs-dev': 'sensor_msgs/Image.h',
    'libstd-msgs-dev': 'std_msgs/String.h',
}
CPP_TOOLS = {'catkin': '/usr/share/catkin/cmake', 'cmake': '/usr/bin/cmake', 'g++': '/usr/bin/g++'}

# What stands in the table -> the words for player.py; a row of two processes has '--two'
PYTHON_ROWS = {
    'direct call': ['direct'],
    'SimpleQueue, 2 threads': ['queue'],
    'pharos inline': ['pharos', '--inline'],
    'pharos inline, send_to': ['pharos', '--inline', '--send-to'],
    'pharos inline, shared': ['pharos', '--inline', '--shared'],
    'pharos default': ['pharos'],
    'rospy, 1 process': ['rospy'],
    'rospy, 1 process, tuned': ['rospy', '--tuned'],
    'pharos, 2 processes': ['pharos', '--two'],
    'pharos, 2 pr., sharing': ['pharos', '--share-connections', '--two'],
    'rospy, 2 processes': ['rospy', '--two'],
    'rospy, 2 proc., tuned': ['rospy', '--tuned', '--two'],
}
CPP_ROWS = {'C++ nodelets': 'nodelets', 'roscpp, 1 process': 'roscpp'}
# seconds without a message after which the rest is lost; at a rate, where nothing is to be lost, as
# long as the largest message may be under way: what came later would count in the next slice
SILENCE, SILENCE_AT_A_RATE = 0.4, 2.0


class Ended(Exception):
    """A process that was to measure has ended."""


class Slice(NamedTuple):
    """What was measured in a short while; times in seconds."""

    took: List[float]  # latencies, a sample of them
    sent: int  # messages to be received, over all receivers
    received: int
    duration: float  # from the first message sent to the last received
    cpu: float  # of the processes


class Row:
    """One way of messages; it runs only within :meth:`measure`, and is stopped by a signal
    meanwhile."""

    def __init__(self, name, commands, environment, errors):
        self.name = name
        # the sender last
        self._players = [_Player(command, environment, errors) for command in commands]
        self._open = set()
        self._pause()

    def measure(self, message, receivers, queue_size, rate, seconds, busy=False):
        """Send for so long and return the :class:`Slice`; the first time, connect."""
        what = (message, receivers, queue_size)
        for player in self._players:
            player.signal(signal.SIGCONT)
        if what not in self._open:
            self._open.add(what)
            for player in self._players:
                player.ask('open', *what)
        # what the players put off while they were stopped, and cold caches
        self._slice(what, 100, 0.05, busy)
        measured = self._slice(what, rate, seconds, busy)
        self._pause()
        return measured

    def _slice(self, what, rate, seconds, busy):
        for player in self._players:
            player.ask('begin', *what)
        sent = self._players[-1].ask('send', rate, seconds, int(busy))
        expected = sent['sent'] * what[1]
        silence = SILENCE_AT_A_RATE if rate else SILENCE
        receiver = self._players[0].ask('result', expected, silence)
        others = [player.ask('result', 0, silence) for player in self._players[1:]]
        cpu = sum(each['cpu'] for each in (receiver, *others))
        duration = max(receiver['last'] - sent['begun'], sent['took'])
        return Slice(receiver['took'], expected, receiver['received'], duration, cpu)

    def ask_receiver(self, *words):
        """What the receiving player answers."""
        self._players[0].signal(signal.SIGCONT)
        answer = self._players[0].ask(*words)
        self._pause()
        return answer

    def _pause(self):
        for player in self._players:
            player.signal(signal.SIGSTOP)

    def end(self):
        for player in self._players:
            player.end()


class _Player:
    def __init__(self, command, environment, errors):
        self._errors = errors
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env=environment,
            preexec_fn=end_with_parent,
        )

    def ask(self, *words):
        try:
            print(*words, file=self._process.stdin, flush=True)
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ''
        if not answer:
            status = self._process.wait()
            how = signal.Signals(-status).name if status < 0 else f'status {status}'
            what = f"a process ended by {how} at {' '.join(map(str, words))}"
            raise Ended(f'{what}: {what_was_raised(self._errors)}')
        return json.loads(answer)

    def signal(self, number):
        self._process.send_signal(number)

    def end(self):
        self._process.kill()
        self._process.wait()


def what_was_raised(errors):
    """The last error in a file, without the frames of its traceback."""
    errors.seek(0)
    last = errors.read().rpartition('Traceback (most recent call last):')[2].splitlines()
    return ' '.join(line for line in last if line and not line.startswith(' '))[:1000]


def end_with_parent():
    """Has a child process end with the thread that starts it."""
    # PR_SET_PDEATHSIG: a stopped player would stay for ever
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def shuffled(all_rows):
    """The rows in another order each time, so that none always finds the processor's caches as the
    same other one has left them."""
    return random.sample(all_rows, len(all_rows))


def make(names, environment, folder, beside=()):
    """The rows of these names.

    :param folder: where they may keep files
    :param beside: other ``src`` folders of pharos: their rows are there too, marked with ', '' and
        so on
    """
    rows = []
    for name in names:
        label = f'row{len(rows)}'
        if name in CPP_ROWS:
            command = [str(BUILD / 'player'), CPP_ROWS[name], label]
            rows.append(Row(name, [command], environment, open_errors(folder, label)))
            continue
        words = PYTHON_ROWS[name]
        for number, source in enumerate((SOURCE, *beside) if 'pharos' in name else (SOURCE,)):
            label = f'row{len(rows)}'
            rows.append(
                Row(
                    name + "'" * number,
                    commands(words, label, folder),
                    {**environment, 'PYTHONPATH': str(source)},
                    open_errors(folder, label),
                )
            )
    return rows


def open_errors(folder, label):
    """Where the processes of a row write what is wrong."""
    return open(folder / f'{label}.errors', 'w+')


def commands(words, label, folder, program=('/usr/bin/python3', str(HERE / 'player.py'))):
    """The command of each player of a row, as Row takes them.

    :param words: of PYTHON_ROWS
    :param label: of the row, for topics and files
    """
    command = [
        *program,
        words[0],
        label,
        *(word for word in words[1:] if word != '--two'),
    ]
    if '--two' not in words:
        return [command]
    stamps = folder / (label + '.stamps')
    with open(stamps, 'wb') as file:
        file.truncate(8 * STAMPS)
    return [[*command, '--role', role, '--stamps', str(stamps)] for role in ('receive', 'send')]


def build_cpp():
    """Build the C++ player, where its packages are installed; returns the names of those that are
    missing."""
    missing = [
        package
        for package, file in CPP_PACKAGES.items()
        if not os.path.exists('/usr/include/' + file)
    ]
    missing += [package for package, file in CPP_TOOLS.items() if not os.path.exists(file)]
    if missing:
        return sorted(missing)
    BUILD.mkdir(parents=True, exist_ok=True)
    python = [f'-D{name}_EXECUTABLE=/usr/bin/python3' for name in ('PYTHON', 'Python3')]
    for command in (
        ['cmake', str(HERE / 'nodelet'), '-DCATKIN_ENABLE_TESTING=OFF', *python],
        ['cmake', '--build', '.'],
    ):
        done = subprocess.run(
            command, cwd=BUILD, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        if done.returncode:
            sys.exit(f"{' '.join(command)} failed in {BUILD}:\n{done.stdout}")
    return []


@contextlib.contextmanager
def ros_master(folder, program=('/usr/bin/rosmaster', '--core', '-p')):
    """A ROS master as a child process; gives the environment for nodes of it.

    :param program: what is started, with its port as one more argument
    """
    port = free_port()
    environment = {
        **os.environ,
        'ROS_MASTER_URI': f'http://127.0.0.1:{port}/',
        'ROS_HOSTNAME': '127.0.0.1',
        'ROS_LOG_DIR': str(folder),
        'ROS_HOME': str(folder),
    }
    environment.pop('ROS_NAMESPACE', None)
    process = subprocess.Popen(
        [*program, str(port)],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=end_with_parent,
    )
    try:
        deadline = time.monotonic() + 20
        while True:
            try:
                xmlrpc.client.ServerProxy(environment['ROS_MASTER_URI']).getPid('/benchmark')
                break
            except OSError:
                if time.monotonic() > deadline or process.poll() is not None:
                    raise Ended(f"no ROS master by {' '.join(map(str, program))}") from None
                time.sleep(0.05)
        yield environment
    finally:
        process.terminate()
        process.wait()


def free_port():
    """A port that nobody has now."""
    with socket.socket() as free:
        free.bind(('127.0.0.1', 0))
        return free.getsockname()[1]


def tell(text=''):
    """Show what is measured now, at a terminal, in a line that the next one overwrites."""
    if sys.stderr.isatty():
        print(f'\r{text:<78.78}', end='' if text else '\r', file=sys.stderr, flush=True)


def run_program(main):
    """Run it to its end; by Ctrl-C or another signal it ends as by an exception, so that all that it
    has begun ends, too."""

    def end(number, frame):
        sys.exit(128 + number)

    for number in signal.SIGTERM, signal.SIGHUP:
        if signal.getsignal(number) is signal.SIG_DFL:  # nohup has it ignored
            signal.signal(number, end)
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
    except Ended as error:
        tell()
        sys.exit(f'{os.path.basename(sys.argv[0])}: {error}')
