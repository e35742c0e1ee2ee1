"""Fixtures of pytest, a mailbox, and waiting for events, for tests of your own nodes.

In a ``conftest.py``: ``pytest_plugins = ['pharos.testing']``; and a test is::

    def test_a_driver_greets(master, create_node):
        greetings = Mailbox(create_node(BlockNode), '/greetings', 'std_msgs/String')
        create_node(Driver).send_to('/greetings', data='hello')
        assert greetings.next().data == 'hello'
"""
import queue
import re
import threading
import time
from typing import Any, Callable, Iterator

import pytest

from pharos import Master, Node
from pharos.waiting import wait

TIMEOUT = 30.0  # seconds; a test that passes never waits so long
_expects_failures = False  # said by the running test


def until(predicate: Callable[[], Any], timeout: float | None = None, what: str = '') -> Any:
    """Wait until ``predicate()`` is true, and return its value.

    :param timeout: seconds, None: :data:`TIMEOUT`
    :param what: what is waited for, for the error
    :raises TimeoutError: if it is not in time
    """
    timeout = TIMEOUT if timeout is None else timeout
    value = wait(predicate, timeout)
    if not value:
        raise TimeoutError(f'{what or predicate} did not come to be within {timeout:g} s')
    return value


class Mailbox:
    """Keeps the messages of a topic, and lets a test wait for them. It is a delegate, too.

    :param node: the node that receives them; None: the mailbox is given as a delegate
    """

    def __init__(self, node: Node | None = None, topic: str = '', typed_as: Any = None):
        self._came: list[Any] = []
        self._waiting: queue.SimpleQueue = queue.SimpleQueue()
        self.channel = node.interested_in(topic, typed_as, delegate=self) if node else None

    def __call__(self, message: Any, channel: Any = None) -> None:
        self._came.append(message)
        self._waiting.put(message)

    def next(self, timeout: float | None = None) -> Any:
        """Take the next message, and wait for it if need be; raises TimeoutError."""
        try:
            return self._waiting.get(timeout=TIMEOUT if timeout is None else max(0, timeout))
        except queue.Empty:
            others = f'{len(self._came)} others: {str(self._came[-1:])[:300]}'
            raise TimeoutError(f'no message came in time, after {others}') from None

    def wait_for(self, predicate: Callable[[Any], Any], timeout: float | None = None) -> Any:
        """Take messages until ``predicate(message)`` is true, and return that one."""
        deadline = time.monotonic() + (TIMEOUT if timeout is None else timeout)
        while not predicate(message := self.next(deadline - time.monotonic())):
            pass
        return message

    def all(self) -> list[Any]:
        """Return all messages that came so far."""
        return list(self._came)

    def empty(self) -> bool:
        """True if there is no message that was not taken."""
        return self._waiting.empty()


@pytest.fixture
def master(monkeypatch) -> Iterator[Master]:
    """An embedded master of the test, which leaves no node, registration or thread behind."""
    threads = set(threading.enumerate())
    with Master.embedded() as embedded:
        monkeypatch.setenv('ROS_MASTER_URI', embedded.url)
        known = _registrations(embedded)
        yield embedded
        nodes = embedded.own_nodes()
        for node in nodes:
            node.stop()
        assert not nodes, f'left running: {nodes}; stop() them, or make them by create_node()'
        _check_gone(lambda: _registrations(embedded) - known)
        _check_gone(lambda: set(threading.enumerate()) - threads)


def _registrations(master):
    kinds = master.system_state()
    return {(name, node) for kind in kinds for name, nodes in kind.items() for node in nodes}


def _check_gone(left):
    try:
        until(lambda: not left())
    except TimeoutError:
        pytest.fail(f'left behind: {left()}', False)


def expect_failures() -> None:
    """Say in a test that blocks of its nodes may fail; a fixture of this name does so, too."""
    global _expects_failures
    _expects_failures = True


@pytest.fixture
def create_node(master: Master) -> Iterator[Callable[..., Any]]:
    """Make and start nodes, ``create_node(node_class, name=None, **kwargs)``; the test's end stops
    them. A failure in a block of them fails the test, unless it says :func:`expect_failures`."""
    nodes: list[Node] = []

    def create(node_class: type[Node], name: str | None = None, **kwargs: Any) -> Any:
        """Create a node; its name is by default that of the class, made unique."""
        if name is None:
            name = re.sub('(?<=[a-z0-9])(?=[A-Z])', '_', node_class.__name__).lower()
            same = sum(type(node) is node_class for node in nodes)
            name += f'_{same}' if same else ''
        kwargs = {'domain': '127.0.0.1', **kwargs}
        nodes.append(master.create(node_class, name, **kwargs))
        return nodes[-1]

    global _expects_failures
    _expects_failures = False
    yield create
    for node in nodes:
        node._stop_safely()
    told = [
        f'{failure}\n{failure.traceback}'
        for node in nodes
        for failure in node._current_run.failures
    ]
    if told and not _expects_failures:
        told.insert(0, 'blocks of its nodes failed (or say expect_failures()):')
        pytest.fail('\n'.join(told), False)


@pytest.fixture(name='expect_failures')
def _expect_failures(create_node):
    return expect_failures
