"""Fixtures: a real ROS master on a free port of the loopback, so that several runs go side by side."""
import atexit
import logging
import os
import pathlib
import shutil
import sys
import tempfile
import threading

import rosgraph
import rosnode
import rospkg

# before pharos is imported: the tests have their own logs and addresses, and Debian's own programs, as
# in tools/workspace.sh: programs that begin with /usr/bin/env find another python3, which has no rospy
os.environ['PATH'] = '/usr/sbin:/usr/bin:/sbin:/bin'
os.environ['ROS_HOSTNAME'] = '127.0.0.1'
os.environ['ROS_LOG_DIR'] = tempfile.mkdtemp(prefix='pharos-test-log-')
atexit.register(shutil.rmtree, os.environ['ROS_LOG_DIR'], ignore_errors=True)
for name in ('ROS_IP', 'ROS_NAMESPACE', 'ROS_MASTER_URI'):
    os.environ.pop(name, None)
ROOT = pathlib.Path(__file__).resolve().parent.parent
SRC = str(ROOT / 'src')
sys.path.insert(0, SRC)
os.environ['PYTHONPATH'] = f'{SRC}:{os.environ.get("PYTHONPATH", "")}'.rstrip(':')
# in a clone with nothing built, rosrun finds this package, too
if 'pharos' not in rospkg.RosPack().list():
    os.environ['ROS_PACKAGE_PATH'] = f'{ROOT}:{os.environ.get("ROS_PACKAGE_PATH", "/usr/share")}'

import pytest  # noqa: E402

import helpers  # noqa: E402
import pharos  # noqa: E402
from pharos.testing import until  # noqa: E402

# rosmaster logs a traceback for each node that does not answer: a report would be full of them
logging.getLogger('rosmaster').setLevel(logging.CRITICAL)
collect_ignore = ['programs', 'robot']
# rosmaster runs in this process: its threads end when the other side closes the connection
SERVER_THREADS = 'process_request_thread', 'Dummy-'
#: fixtures of a module that start several programs
SLOW_FIXTURES = {'both', 'changed', 'drive', 'made', 'scene', 'session', 'tested'}


def pytest_configure(config):
    """Have a test fail if a thread raises; the pytest of Debian 11 does not see that."""
    config.addinivalue_line('markers', 'xdist_group(name): one process of pytest-xdist runs them')
    if hasattr(pytest, 'PytestUnhandledThreadExceptionWarning'):
        warning = 'error::pytest.PytestUnhandledThreadExceptionWarning'
        config.addinivalue_line('filterwarnings', warning)


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist looks for the groups
def pytest_collection_modifyitems(items):
    """Have one process of pytest-xdist run all tests of a fixture that takes seconds."""
    for item in items:
        for name in SLOW_FIXTURES.intersection(item.fixturenames):
            item.add_marker(pytest.mark.xdist_group(name))


def pytest_report_header():
    """Say which seed chooses the packages of the walks."""
    return f'PHAROS_SEED={helpers.SEED}: one installed package in five is walked through'


@pytest.fixture(scope='session')
def ros_master():
    """One ROS master for the whole run; a test leaves nothing on it."""
    master = helpers.InProcessMaster()
    yield master
    master.stop()


@pytest.fixture
def master(ros_master, monkeypatch):
    """A pharos.Master. Its nodes are stopped after the test, and leave no registration and no thread."""
    monkeypatch.setenv('ROS_MASTER_URI', ros_master.url)
    master = pharos.Master(ros_master.url)
    threads = set(threading.enumerate())
    yield master
    helpers.stop_nodes(master)
    try:
        until(lambda: not any(master.system_state()), 10)
        until(lambda: not left_threads(threads), 10)
    except TimeoutError:
        state = master.system_state()
        names = {name for kind in state for names in kind.values() for name in names}
        # so that the next test does not fail, too
        rosnode.cleanup_master_blacklist(rosgraph.Master('/test', master.url), names)
        pytest.fail(f'left behind: {left_threads(threads)}, {state}')
    finally:
        ros_master.forget()


def left_threads(before):
    """The threads that a test left behind."""
    left = []
    for thread in set(threading.enumerate()) - before:
        target = getattr(thread, '_target', None)  # a thread that ends deletes it
        if not any(name in f'{thread.name} {target}' for name in SERVER_THREADS):
            left.append(thread)
    return left


@pytest.fixture
def mortal(monkeypatch):
    """A master that a test can kill and start again."""
    master = helpers.MortalMaster()
    monkeypatch.setenv('ROS_MASTER_URI', master.url)
    yield master
    helpers.stop_nodes()
    master.end()


@pytest.fixture
def peer(master):
    """A rospy node in another process, which does what the test asks; see helpers.Peer."""
    with helpers.Peer(master.url) as peer:
        yield peer


@pytest.fixture
def transcript():
    """The lines that the Transcript shows."""
    lines = []
    before = pharos.Transcript.on_show(lines.append)
    yield lines
    pharos.Transcript.on_show(before)


@pytest.fixture
def bench(master, tmp_path, monkeypatch):
    """A Bench; ROS finds it and the package robot."""
    robot = ROOT / 'test' / 'robot'
    shutil.copytree(robot, tmp_path / 'robot', ignore=shutil.ignore_patterns('CATKIN_IGNORE'))
    paths = [str(tmp_path), os.environ.get('ROS_PACKAGE_PATH', ''), '/usr/share']
    monkeypatch.setenv('ROS_PACKAGE_PATH', os.pathsep.join(paths))
    monkeypatch.setenv('ROS_HOME', str(tmp_path / 'home'))
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    return helpers.Bench(tmp_path / 'bench', master)
