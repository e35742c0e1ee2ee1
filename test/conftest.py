"""Fixtures: a real ROS master in this process, on a free port and loopback, so that runs go side by
side."""
import atexit
import os
import pathlib
import queue
import shutil
import sys
import tempfile
import threading

# before pharos is imported: logs and addresses of the tests are their own
os.environ['ROS_HOSTNAME'] = '127.0.0.1'
os.environ['ROS_LOG_DIR'] = tempfile.mkdtemp(prefix='pharos-test-log-')
atexit.register(shutil.rmtree, os.environ['ROS_LOG_DIR'], ignore_errors=True)
for name in ('ROS_IP', 'ROS_NAMESPACE', 'ROS_MASTER_URI'):
    os.environ.pop(name, None)
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent / 'src'))

import numpy  # noqa: E402
import pytest  # noqa: E402
import rosmaster.master  # noqa: E402

import pharos  # noqa: E402
from pharos import node_registry, watcher  # noqa: E402
from pharos.private_rospy.local_link import PROTOCOL  # noqa: E402

collect_ignore = ['programs']  # run by tests, and no tests of this package
TIMEOUT = 20.0  # seconds; a bound on waits for events, never reached in a test that passes
#: of a test that serializes a numpy_msg
serializes_numpy = pytest.mark.skipif(
    not hasattr(numpy.ndarray, 'tostring'),
    reason="genpy's code writes numpy_msg with ndarray.tostring, which this numpy has no more; bare rospy fails, too",
)


class Mailbox:
    """A delegate that keeps what it gets, and lets the test wait for it."""

    def __init__(self):
        self._messages = queue.SimpleQueue()

    def __call__(self, message, channel):
        self._messages.put((message, channel))

    def get(self):
        """The next message; fails after TIMEOUT."""
        return self.get_with_channel()[0]

    def get_with_channel(self):
        return self._messages.get(timeout=TIMEOUT)

    def take(self, count):
        return [self.get() for _ in range(count)]

    def empty(self):
        return self._messages.empty()


def speak_tcpros_only(node):
    """Have the node connect by sockets alone, as those of other processes do; returns it."""
    handlers = node.latest_run.rospy.lifetime.xmlrpc.handler.protocol_handlers
    handlers[:] = [handler for handler in handlers if not handler.supports(PROTOCOL)]
    return node


class InProcessMaster:
    """rosmaster's own master, in this process."""

    def __init__(self, port=0):
        self._master = rosmaster.master.Master(port=port)
        self._master.start()
        ready = threading.Event()
        while not self._master.uri:
            ready.wait(0.001)  # rosmaster has no event for it
        self.url = 'http://127.0.0.1:%d/' % self._master.master_node.port

    def stop(self):
        node = self._master.master_node
        node.is_shutdown = True
        node.server.shutdown()  # rosgraph itself only closes its socket, and its thread spins (ros_comm #2238)
        self._master.stop()


@pytest.fixture(scope='session')
def ros_master():
    """One ROS master for the whole run; a test leaves nothing on it."""
    master = InProcessMaster()
    yield master
    master.stop()


@pytest.fixture
def master(ros_master, monkeypatch):
    """A pharos.Master; every node that the test leaves running is stopped, and nothing may stay
    registered."""
    monkeypatch.setenv('ROS_MASTER_URI', ros_master.url)
    yield pharos.Master(ros_master.url)
    node_registry.stop_all()


@pytest.fixture
def mailbox():
    return Mailbox()


@pytest.fixture
def mortal_master(monkeypatch):
    """A master that a test may end and start again at the same URL."""
    monkeypatch.setattr(watcher, 'PERIOD', 0.1)

    class MortalMaster:
        def __init__(self):
            self._embedded = pharos.Master.embedded()
            self.url = self._embedded.url
            monkeypatch.setenv('ROS_MASTER_URI', self.url)

        def end(self):
            """kill -9"""
            self._embedded._child.kill()
            self._embedded._child.wait()

        def come_back(self):
            self._embedded = pharos.Master.embedded(port=int(self.url.rsplit(':', 1)[1].strip('/')))

    master = MortalMaster()
    yield master
    node_registry.stop_all()
    master.end()


@pytest.fixture
def transcript():
    """What the Transcript shows, as a list."""
    lines = []
    before = pharos.Transcript.on_show(lines.append)
    yield lines
    pharos.Transcript.on_show(before)
