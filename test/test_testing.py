"""pharos.testing, as those use it who test nodes of their own."""
import os
import re
import subprocess
import sys
import threading

import pytest

from helpers import create
from pharos.testing import Mailbox, NodeFactory, TIMEOUT, until
import pharos
from programs import ROOT

ROBOT = ROOT / 'test' / 'programs' / 'robot'
TOLD = {
    'test_leaves_a_node': r'left running: /forgotten; stop\(\) them',
    'test_leaves_a_thread': 'left behind: thread forgotten',
    'test_leaves_a_registration': 'left behind: /forgotten publishes /topic',
    'test_does_not_look_at_a_failure': 'ValueError: nothing was said',
}


def run_tests(folder):
    """Run pytest there, as a process of its own; returns its status and what it printed."""
    environ = {**os.environ, 'PYTHONPATH': str(ROOT / 'src')}
    environ.pop('PYTEST_ADDOPTS', None)
    command = [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', '--rootdir', folder]
    ended = subprocess.run(
        [*command, '-W', 'error::pytest.PytestWarning', folder],
        env=environ,
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=2 * TIMEOUT,
        check=False,
    )
    return ended.returncode, ended.stdout


def test_a_package_tests_its_nodes_with_it():
    """Those of its tests that are in order pass; the others fail for what they leave or overlook."""
    status, printed = run_tests(ROBOT)
    assert status == pytest.ExitCode.TESTS_FAILED, printed
    for name, told in TOLD.items():
        section = re.search(
            rf'_ ERROR at teardown of {name} _(.*?)(\n_____|\Z)', printed, re.DOTALL
        )
        assert section and re.search(told, section[1]), (name, printed)
    assert re.search(r'9 passed, 4 errors', printed), printed


def test_it_is_a_plugin(tmp_path):
    (tmp_path / 'conftest.py').write_text("pytest_plugins = ['pharos.testing']\n")
    test = 'def test_it(master, mailbox, create_node, expect_failures):\n    expect_failures()\n'
    (tmp_path / 'test_it.py').write_text(test)
    status, printed = run_tests(tmp_path)
    assert status == pytest.ExitCode.OK, printed


def test_a_mailbox_in_which_nothing_comes_names_its_channels(master):
    node = create(master, '/hears_nothing')
    by_channel = Mailbox(node, '/misspelt', 'std_msgs/String')
    with pytest.raises(TimeoutError, match=r'/misspelt std_msgs/String .*: not connected'):
        by_channel.next(0)
    with pytest.raises(TimeoutError, match='no channel: nothing is heard'):
        Mailbox().next(0)


@pytest.mark.parametrize(
    'use, said',
    [
        (lambda create_node: create_node('/arm'), "made of a subclass of Node.* not '/arm'"),
        (lambda create_node: create_node(None), 'made of a subclass of Node.* not None'),
        (lambda create_node: create_node(pharos.BlockNode, named='/a'), "name='/a', not as named="),
        (lambda create_node: Mailbox('/topic'), "node that hears, before the topic, not '/topic'"),
        (lambda create_node: Mailbox(pharos.BlockNode, '/topic'), 'given the node that hears'),
    ],
)
def test_what_is_given_in_another_order_is_told(master, use, said):
    with pytest.raises(TypeError, match=said):
        use(NodeFactory(master))


@pytest.mark.parametrize('timeout', ['5', float('nan'), [5]], ids=repr)
def test_a_limit_that_is_no_number_of_seconds_is_refused(timeout):
    for wait in (
        lambda: until(lambda: True, timeout),
        lambda: Mailbox().next(timeout),
        lambda: Mailbox().wait_for(lambda message: True, timeout),
    ):
        with pytest.raises(ValueError, match='timeout is a number of seconds, not'):
            wait()


def test_a_limit_may_be_longer_than_the_system_can_wait_or_over_by_now():
    mailbox = Mailbox()
    threading.Timer(0.01, lambda: mailbox('message', None)).start()
    assert mailbox.next(float('inf')) == 'message'
    for limit in 0, -1:
        with pytest.raises(TimeoutError):
            mailbox.next(limit)


def test_a_predicate_that_would_always_hold_is_refused():
    async def later():
        pass

    for wrong in later, 5, lambda message: True:
        with pytest.raises(TypeError, match='a predicate is called'):
            until(wrong, 1)
    with pytest.raises(TypeError, match=r'called as predicate\(message\)'):
        Mailbox().wait_for(lambda: True)


def test_a_name_that_the_nodes_init_waits_for_is_refused(master):
    """The node was called so, and its __init__ never got it, in silence."""
    create_node = NodeFactory(master)

    class Named(pharos.Node):
        def __init__(self, name='arm'):
            self.called = name

    with pytest.raises(TypeError, match=r'create_node\(\) takes name= for itself.* my_name'):
        create_node(Named, name='left')
    assert create_node(Named).called == 'arm'
    create_node.close()
