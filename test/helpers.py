"""Masters, nodes, peers and programs that the tests of several files need."""
import contextlib
import datetime
import os
import pathlib
import pickle
import random
import signal
import socket
import subprocess
import sys
import textwrap
import threading

import pytest
import rosmaster.master

import pharos
from pharos import BlockNode, Master, Node
from pharos.testing import Mailbox, until

ROOT = pathlib.Path(__file__).resolve().parent.parent
PYTHON = '/usr/bin/python3'
#: begins a command whose signals do what they do by default, also under nohup
DEFAULT_SIGNALS = ['env', '--default-signal=INT,TERM,HUP']
TIMEOUT = 30  # seconds; a test that passes never waits so long
#: without rosrun, which takes a while to find it
COMPOSE = [PYTHON, str(ROOT / 'scripts' / 'compose')]
#: begins each script of a Bench
HEAD = '''#!/usr/bin/python3
import asyncio, atexit, inspect, os, pharos, rospy, signal, sys, threading, time
from std_msgs.msg import String
SAID = os.path.dirname(__file__) + '/said'
def say(text):
    with open(SAID, 'a') as file:
        print(text, file=file)
'''
INIT = "rospy.init_node('program')\n"
SPIN = INIT + "say('ready')\nrospy.spin()\n"
#: chooses the packages of a walk over all of them: another fifth each day
SEED = os.environ.get('PHAROS_SEED') or datetime.date.today().isoformat()
threading.Thread.isAlive = threading.Thread.is_alive  # the rospy of Debian 11 calls it at its end
_created = []


class InProcessMaster:
    """rosmaster's own master, in this process."""

    def __init__(self, port=0):
        self._master = rosmaster.master.Master(port=port)
        self._master.start()
        until(lambda: self._master.uri)
        self.url = f'http://127.0.0.1:{self._master.master_node.port}/'

    def forget(self):
        """Forget parameters, types of topics and addresses of nodes, so that the next test can use their names.

        A rospy node that has logged leaves a parameter subscribed, and the master then knows its address for ever.
        """
        handler = self._master.handler
        with handler.param_server.lock:
            handler.param_server.parameters.clear()
        with handler.ps_lock:
            handler.topics_types.clear()
            handler.reg_manager.param_subscribers.map.clear()
            handler.reg_manager.nodes.clear()

    def stop(self):
        """End its server; rosgraph only closes the socket, and its thread spins (ros_comm #2238)."""
        node = self._master.master_node
        node.is_shutdown = True
        node.server.shutdown()
        self._master.stop()


def free_port():
    """Return a port that no server of another test gets, and that can so be taken again."""
    while True:
        # below those that the system hands out; a simulation gives `random` the same seed in two processes
        port = random.SystemRandom().randrange(20000, 32000)
        with contextlib.suppress(OSError), socket.create_server(('127.0.0.1', port)):
            return port


def one_in_five(names):
    """Return every fifth of the names, as the seed chooses them."""
    return random.Random(SEED).sample(sorted(names), len(names) // 5 + 1)


class MortalMaster:
    """A rosmaster in a process of its own, which can be killed and started again at its URL."""

    def __init__(self):
        self.url = f'http://127.0.0.1:{free_port()}/'
        self.master = Master(self.url)
        self.come_back()

    @property
    def pid(self):
        return self._program.pid

    def come_back(self):
        """Start an empty one."""
        port = self.url.rsplit(':', 1)[1].strip('/')
        self._program = Program(['rosmaster', '--core', '-p', port], self.url)
        until(self.master.is_reachable)

    def end(self):
        """Kill it, as by kill -9."""
        self._program.__exit__()


def create(master, name='/node', node_class=BlockNode, **settings):
    """Create a node, which the fixture of the master stops."""
    node = master.create(node_class, named=name, **settings)
    _created.append(node)
    return node


def stop_nodes(master=None):
    """Stop all nodes of this process that `create` made or that the master knows."""
    known = [node for node in master.nodes() if isinstance(node, Node)] if master else []
    for node in [*_created, *known]:
        node.stop()
    _created.clear()


def registrations(master, name):
    """The topics that a node publishes, those that it hears, and its services, as three lists."""
    return [
        sorted(key for key, nodes in kind.items() if name in nodes)
        for kind in master.system_state()
    ]


class Gate(Mailbox):
    """A delegate that blocks at each message until the gate is opened."""

    def __init__(self):
        super().__init__()
        self.begun = threading.Event()
        self.open = threading.Event()

    @property
    def heard(self):
        """The data of all messages so far."""
        return [message.data for message in self.all()]

    def __call__(self, message, channel=None):
        super().__call__(message)
        self.begun.set()
        self.open.wait(TIMEOUT)


class Hasty(BlockNode):
    stop_timeout = 0.05


def fill(master):
    """Return a node, its gate and channel, and a sender; one message is in the gate, and two wait."""
    gate, ear, mouth = Gate(), create(master, '/ear', Hasty), create(master, '/mouth')
    channel = ear.interested_in('/words', 'std_msgs/String', gate)
    for word in 'first', 'old', 'older':
        mouth.send_to('/words', typed_as='std_msgs/String', data=word)
    assert gate.begun.wait(TIMEOUT)
    return ear, gate, channel, mouth


def has_come_to(thread, function):
    """True if a thread stands in a function, or has ended."""
    frame = sys._current_frames().get(thread.ident)
    while frame and frame.f_code is not function.__code__:
        frame = frame.f_back
    return frame or not thread.is_alive()


class Peer:
    """A rospy node in a process of its own, which runs Python as the test asks.

    ``peer.run(code)`` executes statements, ``peer.value(expression)`` returns a value; both know
    rospy, pharos' message_class, and what earlier code defined.

    :param command: what runs the process, such as ['setpriv', ...]
    """

    library = 'rospy'

    def __init__(self, url, name='peer', command=(), **environ):
        environ = {**os.environ, 'ROS_MASTER_URI': url, **environ}
        command = [*DEFAULT_SIGNALS, *command, PYTHON, __file__, name, self.library]
        self.name = '/' + name.lstrip('/')
        self.process = subprocess.Popen(
            command, env=environ, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self._lock = threading.Lock()
        assert self._answer() == 'ready'

    @property
    def pid(self):
        return self.process.pid

    def run(self, code):
        """Execute statements; raises here what they raise there."""
        self._ask('exec', code)

    def value(self, expression):
        """Return the value of an expression; it must pickle."""
        return self._ask('eval', expression)

    def hear(self, topic, type_):
        """Subscribe; the messages come into the list of the topic in ``heard``."""
        self.run(
            f'heard.setdefault({topic!r}, []); subscribers.append(rospy.Subscriber({topic!r},'
            f' message_class({type_!r}), heard[{topic!r}].append))'
        )

    def heard(self, topic, count=1):
        """Wait for so many messages of a topic; returns all that came."""
        until(lambda: self.value(f'len(heard[{topic!r}])') >= count, TIMEOUT)
        return self.value(f'heard[{topic!r}]')

    def _ask(self, kind, text):
        with self._lock:
            pickle.dump((kind, text), self.process.stdin)
            self.process.stdin.flush()
            return self._answer()

    def _answer(self):
        answer = pickle.load(self.process.stdout)
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def end(self):
        """Kill it, as by kill -9."""
        self.process.kill()
        self.process.wait()
        self.process.stdin.close()
        self.process.stdout.close()

    def close(self):
        """Let it end and unregister."""
        self.process.stdin.close()
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.wait(TIMEOUT)
        self.end()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()


class PharosPeer(Peer):
    """A node of pharos in a process of its own: ``node`` in the code, whose ``rospy`` is its own."""

    library = 'pharos'


def _node_or_none(url, name):
    with contextlib.suppress(pharos.PharosError):
        return Master(url).node(name)


class Program:
    """A program in a child process, whose lines of output a test can wait for.

    :param source: Python code as text, or a command as a list
    """

    def __init__(self, source, url, *arguments, **environ):
        command = [PYTHON, '-u', '-c', source] if isinstance(source, str) else list(source)
        self._process = subprocess.Popen(
            [*DEFAULT_SIGNALS, *command, *arguments],
            env={
                **os.environ,
                'ROS_MASTER_URI': url,
                'PYTHONFAULTHANDLER': '1',
                'PYTHONUNBUFFERED': '1',
                **environ,
            },
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._url, self._lines = url, []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.pid, self.poll = self._process.pid, self._process.poll

    def _read(self):
        for line in self._process.stdout:
            self._lines.append(line)

    @property
    def output(self):
        """The text that it has written so far, to standard output and error."""
        return ''.join(self._lines)

    def expect(self, text):
        """Wait until it has written the text."""
        self.until(lambda: text in self.output, repr(text))

    def until(self, predicate, what=''):
        """Wait until a predicate is true; fail with its last lines, and as soon as it has ended."""
        try:
            until(lambda: predicate() or self.has_ended, TIMEOUT, what)
        except TimeoutError as error:
            pytest.fail(f'{error}; {self.last_lines}')
        if self.has_ended:
            self._reader.join(TIMEOUT)
        value = predicate()
        if not value:
            code = self.poll()
            pytest.fail(
                f'{what or predicate}: it has ended, with exit code {code}; {self.last_lines}'
            )
        return value

    def node(self, name):
        """Wait for a node that it runs, and return the node."""
        return self.until(lambda: _node_or_none(self._url, name), name)

    @property
    def has_ended(self):
        return self.poll() is not None

    @property
    def last_lines(self):
        return 'its last lines:\n' + ''.join(self._lines[-20:])

    def signal(self, number):
        """Send it a signal."""
        self._process.send_signal(number)

    def wait(self):
        """Wait for its end; returns its exit code, negative if a signal ended it.

        Fail if it does not end, with what its threads do.
        """
        try:
            code = self._process.wait(TIMEOUT)
        except subprocess.TimeoutExpired:
            self.signal(signal.SIGABRT)  # Python writes where each thread is, and ends
            self._process.wait(TIMEOUT)
            self._reader.join(TIMEOUT)
            pytest.fail(f'it does not end: {self.output}')
        self._reader.join(TIMEOUT)
        return code

    def __enter__(self):
        return self

    def __exit__(self, *error):
        if self.poll() is None:
            self._process.kill()
        self.wait()
        self._process.stdout.close()


def _serve_as_peer():
    """Answer the requests of a Peer until standard input ends."""
    answers = os.fdopen(os.dup(1), 'wb')
    os.dup2(2, 1)  # what is printed must not come between
    scope = {'message_class': pharos.message_class, 'heard': {}, 'subscribers': []}
    _, name, library = sys.argv
    if library == 'pharos':
        node = Master().create(BlockNode, name)
        scope.update(node=node, rospy=node.ros, pharos=pharos)
    else:
        import rospy

        rospy.init_node(name)
        scope['rospy'] = rospy
    answer = 'ready'
    while True:
        pickle.dump(answer, answers)
        answers.flush()
        try:
            kind, text = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        try:
            answer = eval(text, scope) if kind == 'eval' else exec(text, scope)
            pickle.dumps(answer)
        except BaseException as error:
            answer = RuntimeError(f'{type(error).__name__}: {error}')


class Bench:
    """A package of scripts, which tell the test by ``say(text)`` what they do."""

    def __init__(self, folder, master):
        self.folder, self.master = folder, master
        self._newest = None  # the Program or ScriptNode that was started last
        self.write('<package><name>bench</name></package>', 'package.xml', '')

    def write(self, text, name='program', head=HEAD):
        """Write a script, or a file without a head; returns its path."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(head + textwrap.dedent(text))
        path.chmod(0o755)
        return str(path)

    def load(self, text, *args, **options):
        """Load a script; the fixture of the master stops it."""
        self._newest = self.master.load(self.write(text), None, *args, **options)
        return self._newest

    @contextlib.contextmanager
    def program(self, *words):
        """Run compose; Ctrl-C ends it."""
        with Program([*COMPOSE, *words], self.master.url) as running:
            self._newest = running
            try:
                yield running
            finally:
                end(running)

    def launch_file(self, xml='', **texts):
        """Write a launch file, with a node for each of these scripts; returns its path."""
        for name, text in texts.items():
            self.write(text.replace("'program'", repr(name)), name)
            xml += f'<node pkg="bench" type="{name}" name="{name}"/>'
        return self.write(f'<launch>{xml}</launch>', 'a.launch', '')

    def until(self, predicate):
        """Wait until a predicate is true; fail as soon as the newest program or script has ended."""
        if isinstance(self._newest, Program):
            return self._newest.until(predicate)
        script = self._newest
        until(lambda: predicate() or script and not script.is_running)
        value = predicate()
        assert value, f'{script} has ended, with exit code {script.exit_code}: {self.said()}'
        return value

    def said(self):
        """Return the lines that the scripts have said."""
        file = self.folder / 'said'
        return file.read_text().splitlines() if file.exists() else []


def end(running):
    """Press Ctrl-C if it runs, and return the exit code."""
    if running.poll() is None:
        running.signal(signal.SIGINT)
    return running.wait()


# -- fixtures of a module: one master, and one peer for all its tests, which have names of their own


@pytest.fixture(scope='module')
def network(request):
    """Yield a master, and a peer that has run the module's PEER."""
    ros_master = InProcessMaster()
    with Peer(ros_master.url) as peer:
        peer.run(request.module.PEER)
        yield Master(ros_master.url), peer
        peer.run("rospy.signal_shutdown('the end')")  # ends the threads of an action server
    ros_master.stop()


@pytest.fixture
def network_master(network, monkeypatch):
    """Yield the master of the network, which a test leaves as it was."""
    master, _ = network
    monkeypatch.setenv('ROS_MASTER_URI', master.url)
    yield master
    stop_nodes(master)
    until(lambda: [node.name for node in master.nodes()] == ['/peer'], 10, 'the end of all nodes')


@pytest.fixture
def network_peer(network):
    return network[1]


if __name__ == '__main__':
    _serve_as_peer()
