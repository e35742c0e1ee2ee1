"""Fixtures of pytest, a mailbox, and waiting for events, for tests of your own nodes.

In a ``conftest.py``: ``pytest_plugins = ['pharos.testing']``; and a test is::

    def test_a_driver_greets(master, create_node):
        greetings = Mailbox(create_node(BlockNode), '/greetings', 'std_msgs/String')
        create_node(Driver).send_to('/greetings', data='hello')
        assert greetings.next().data == 'hello'
"""
from __future__ import annotations

import queue
import re
import threading
import time
from typing import Any, Callable, Iterator

import pytest

from pharos import Master, Node

TIMEOUT = 30.0  # seconds; a test that passes never waits so long
_factories: list[NodeFactory] = []


def until(predicate: Callable[[], Any], timeout: float | None = None, what: str = '') -> Any:
    """Wait until ``predicate()`` is true, and return its value.

    :param timeout: seconds, None: :data:`TIMEOUT`
    :param what: what is waited for, for the error
    :raises TimeoutError: if it is not in time
    """
    timeout = TIMEOUT if timeout is None else timeout
    deadline = time.monotonic() + timeout
    while not (value := predicate()):
        if time.monotonic() >= deadline:
            raise TimeoutError(f'{what or predicate} did not come to be within {timeout:g} s')
        time.sleep(0.01)
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
        timeout = TIMEOUT if timeout is None else timeout
        try:
            return self._waiting.get(timeout=max(0.0, timeout))
        except queue.Empty:
            count = len(self._came)
            raise TimeoutError(
                f'no message came within {timeout:g} s, after {count} others'
            ) from None

    def take(self, count: int) -> list[Any]:
        """Take the next messages."""
        return [self.next() for _ in range(count)]

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
        known = registrations(embedded)
        yield embedded
        nodes = embedded.own_nodes()
        for node in nodes:
            node.stop()
        assert not nodes, f'left running: {nodes}; stop() them, or make them by create_node()'
        _check_gone(lambda: registrations(embedded) - known)
        _check_gone(lambda: set(threading.enumerate()) - threads)


def registrations(master: Master) -> set[tuple[str, str]]:
    """Return the names of topics and services with the nodes that have registered them."""
    kinds = master.system_state()
    return {(name, node) for kind in kinds for name, nodes in kind.items() for node in nodes}


def _check_gone(left: Callable[[], set]) -> None:
    try:
        until(lambda: not left())
    except TimeoutError:
        pytest.fail(f'left behind: {left()}', False)


class NodeFactory:
    """Makes the nodes of a test; the fixture ``create_node`` is one."""

    def __init__(self, master: Master):
        self.master, self.nodes, self.expects_failures = master, [], False

    def __call__(self, node_class: type, name: str | None = None, **kwargs: Any) -> Any:
        """Create and start a node; its name is by default that of the class, made unique."""
        if name is None:
            name = '/' + re.sub(r'(?<=[a-z0-9])(?=[A-Z])', '_', node_class.__name__).lower()
            same = sum(node.name.startswith(name) for node in self.nodes)
            name += f'_{same + 1}' if same else ''
        kwargs.setdefault('domain', '127.0.0.1')
        node = self.master.create(node_class, named=name, **kwargs)
        self.nodes.append(node)
        return node


def expect_failures() -> None:
    """Say in a test that blocks of its nodes may fail; a fixture of this name does so, too."""
    _factories[-1].expects_failures = True


@pytest.fixture
def create_node(master: Master) -> Iterator[NodeFactory]:
    """Make and start nodes, ``create_node(node_class, name=None, **kwargs)``; the test's end stops
    them. A failure in a block of them fails the test, unless it says :func:`expect_failures`."""
    factory = NodeFactory(master)
    _factories.append(factory)
    yield factory
    _factories.remove(factory)
    for node in factory.nodes:
        node.end_now()
    failures = [failure for node in factory.nodes for failure in node.failures]
    if failures and not factory.expects_failures:
        told = '\n'.join(f'{failure}\n{failure.traceback}' for failure in failures)
        pytest.fail(f'blocks of its nodes failed (or say expect_failures()):\n{told}', False)


@pytest.fixture(name='expect_failures')
def _expect_failures(create_node: NodeFactory) -> Callable[[], None]:
    return expect_failures
