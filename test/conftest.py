"""Fixtures: a real ROS master in this process, on a free port and loopback, so that runs go side by
side."""
import atexit
import contextlib
import os
import pathlib
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

import pytest  # noqa: E402

import pharos  # noqa: E402
from helpers import InProcessMaster  # noqa: E402
from pharos import node_registry, watcher  # noqa: E402
from pharos.testing import mailbox, nothing_left  # noqa: E402, F401

HOPELESS = 360.0  # seconds; more than the timeout in setup.cfg
collect_ignore = ['programs']  # run by tests, and no tests of this package


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol():
    """End the worker where even pytest-timeout cannot end a test: Python runs no handler of a signal
    while it waits for some locks. That test counts as failed, and the others go on in a new worker.
    """
    watchdog = threading.Timer(HOPELESS, os._exit, [3])
    watchdog.daemon = True
    watchdog.start()
    yield
    watchdog.cancel()


@pytest.fixture(scope='session')
def ros_master():
    """One ROS master for the whole run; a test leaves nothing on it."""
    master = InProcessMaster()
    yield master
    master.stop()


@pytest.fixture
def master(request, ros_master, monkeypatch):
    """A pharos.Master; every node that the test leaves running is stopped, and nothing may stay, but
    where it is marked as ``leaves``."""
    monkeypatch.setenv('ROS_MASTER_URI', ros_master.url)
    master = pharos.Master(ros_master.url)
    if request.node.get_closest_marker('leaves'):
        check = contextlib.nullcontext()
    else:
        # What answers a connection to rosmaster, which is in this process, ends when the other side
        # has closed that.
        check = nothing_left(master, may_stay='process_request_thread|^Dummy-')
    with check:
        yield master
        node_registry.stop_all()
    if isinstance(ros_master, InProcessMaster):  # not a process of its own
        ros_master.forget()


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
