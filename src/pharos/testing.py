"""Fixtures of pytest, a mailbox, and a way to wait for events, for tests of your own nodes.

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
from pharos.waiting import wait

TIMEOUT = 30.0  # seconds; a test that passes never waits so long
_expects_failures = False  # True: the running test has called expect_failures()


def until(predicate: Callable[[], Any], timeout: float | None = None, what: str = '') -> Any:
    """Wait until ``predicate()`` is true, and return its value.

    :param timeout: seconds, None: :data:`TIMEOUT`
    :param what: a description of the event, for the error
    :raises TimeoutError: if the value is not true in time
    """
    if timeout is None:
        timeout = TIMEOUT
    value = wait(predicate, timeout)
    if not value:
        raise TimeoutError(f'{what or predicate} did not come to be within {timeout:g} s')
    return value


class Mailbox:
    """Keeps the messages of a topic, and lets a test wait for them. A mailbox is a delegate, too.

    Each method can be called from any thread.

    :param node: the node that receives them; None: the test gives the mailbox as a delegate
    :param typed_as: the type of the topic; None: the type that the master knows
    :ivar channel: the InputChannel of the node, None without a node
    """

    def __init__(self, node: Node | None = None, topic: str = '', typed_as: Any = None):
        self._messages: list[Any] = []
        self._new_messages: queue.SimpleQueue = queue.SimpleQueue()
        self.channel = None
        if node:
            self.channel = node.interested_in(topic, typed_as, delegate=self)

    def __call__(self, message: Any, channel: Any = None) -> None:
        self._messages.append(message)
        self._new_messages.put(message)

    def next(self, timeout: float | None = None) -> Any:
        """Take the next message, and wait until one is there.

        :param timeout: seconds, None: :data:`TIMEOUT`
        :raises TimeoutError: if no message comes in time
        """
        if timeout is None:
            timeout = TIMEOUT
        try:
            return self._new_messages.get(timeout=max(0, timeout))
        except queue.Empty:
            others = f'{len(self._messages)} others: {str(self._messages[-1:])[:300]}'
            raise TimeoutError(f'no message came in time, after {others}') from None

    def wait_for(self, predicate: Callable[[Any], Any], timeout: float | None = None) -> Any:
        """Take messages until ``predicate(message)`` is true, and return that message.

        :param timeout: seconds for all of them, None: :data:`TIMEOUT`
        :raises TimeoutError: if the message does not come in time
        """
        if timeout is None:
            timeout = TIMEOUT
        deadline = time.monotonic() + timeout
        while True:
            message = self.next(deadline - time.monotonic())
            if predicate(message):
                return message

    def all(self) -> list[Any]:
        """Return all messages so far, also those that were taken."""
        return list(self._messages)


@pytest.fixture
def master(monkeypatch: pytest.MonkeyPatch) -> Iterator[Master]:
    """An embedded master for one test. The test must leave no node, registration or thread."""
    threads = set(threading.enumerate())
    with Master.embedded() as embedded:
        monkeypatch.setenv('ROS_MASTER_URI', embedded.url)
        registrations = _registrations(embedded)
        yield embedded
        nodes = embedded.own_nodes()
        for node in nodes:
            node.stop()
        assert not nodes, f'left running: {nodes}; stop() them, or start them in a with'
        _check_gone(lambda: _registrations(embedded) - registrations)
        _check_gone(lambda: set(threading.enumerate()) - threads)


def _registrations(master):
    """Return the names of topics and services, each with the name of a node that has it."""
    pairs = set()
    for registry in master.system_state():
        for name, nodes in registry.items():
            pairs.update((name, node) for node in nodes)
    return pairs


def _check_gone(find_remains):
    try:
        until(lambda: not find_remains())
    except TimeoutError:
        pytest.fail(f'left behind: {find_remains()}', False)


def expect_failures() -> None:
    """Let blocks fail in this test. A test can also name this as a fixture."""
    global _expects_failures
    _expects_failures = True


@pytest.fixture
def create_node(master: Master) -> Iterator[Callable[..., Any]]:
    """Create and start nodes by ``create_node(node_class, name=None, **kwargs)``.

    The end of the test stops them. If a block of theirs fails, after the last start of the node, the test
    fails, unless it calls :func:`expect_failures`.
    """
    nodes: list[Node] = []

    def create(node_class: type[Node], name: str | None = None, **kwargs: Any) -> Any:
        """Create a node; its name is by default that of the class, made unique."""
        if name is None:
            name = re.sub('(?<=[a-z0-9])(?=[A-Z])', '_', node_class.__name__).lower()
            same_class = sum(type(node) is node_class for node in nodes)
            if same_class:
                name += f'_{same_class}'
        kwargs.setdefault('domain', '127.0.0.1')
        node = master.create(node_class, name, **kwargs)
        nodes.append(node)
        return node

    global _expects_failures
    _expects_failures = False
    yield create
    for node in nodes:
        node._stop_safely()
    failures = [failure for node in nodes for failure in node._current_run.failures]
    if failures and not _expects_failures:
        lines = ['blocks of its nodes failed (or say expect_failures()):']
        lines += [f'{failure}\n{failure.traceback}' for failure in failures]
        pytest.fail('\n'.join(lines), False)


@pytest.fixture
def simulation(master: Master) -> Iterator[Any]:
    """Virtual time for the nodes of the test: a :class:`pharos.simulation.Simulation`.

    The test fails if a thread waits for something else than time and threads, unless the
    test says ``simulation.allow_waits()``. A failed test shows the seed, the time, and the command
    that goes there, if the test has composed a launch file.
    """
    from pharos.simulation import Simulation

    with Simulation(master) as simulation:
        yield simulation
        deadlocks = simulation.deadlocks()
    print(
        f'simulation: seed {simulation.seed_number}, {simulation.now:.9f} s', simulation.command()
    )
    if simulation.lost and not simulation.allows_waits:
        pytest.fail(f'threads waited for something else: {simulation.lost}', False)
    if deadlocks:
        pytest.fail(f'threads wait for a lock for ever: {deadlocks}', False)


@pytest.fixture(name='expect_failures')
def _expect_failures(create_node):
    return expect_failures
