"""For those who test their own nodes: fixtures of pytest, a mailbox, and waiting for events.

In a ``conftest.py``, either of::

    pytest_plugins = ['pharos.testing']
    from pharos.testing import create_node, master

and a test is::

    def test_a_driver_greets(master, create_node):
        listener = create_node(BlockNode)
        greetings = Mailbox(listener, '/greetings', 'std_msgs/String')
        create_node(Driver).send_to('/greetings', data='hello')
        assert greetings.next().data == 'hello'

Nothing here is imported with pharos itself. There is no entry point, which would load it into
every run of pytest.
"""
import contextlib
import queue
import re
import threading
import time
from typing import Any, Callable, Dict, Iterable, Iterator, List, Optional, Set, Tuple, TypeVar

import pytest

from pharos import Failure, InputChannel, Master, Node, node_registry
from pharos.attributes import check_not_taken
from pharos.blocks import check_block
from pharos.seconds import check_seconds

#: seconds; a bound on waits for events, which a test that passes never reaches
TIMEOUT = 30.0
POLL = 0.01  # seconds between two looks at what tells nobody of its change
NodeType = TypeVar('NodeType', bound=Node)
Value = TypeVar('Value')


def until(predicate: Callable[[], Value], timeout: Optional[float] = None, what: str = '') -> Value:
    """Wait for what nobody tells, such as what another process does, or what only a master knows.

    :param timeout: seconds, None: :data:`TIMEOUT`
    :param what: what is waited for, for the error
    :returns: the first value of ``predicate()`` that is true
    :raises TimeoutError: if none is in time
    """
    check_block(predicate, 'predicate', ())
    timeout = _limit(timeout)
    pause, deadline = threading.Event(), time.monotonic() + timeout
    while True:
        value = predicate()
        if value:
            return value
        if time.monotonic() >= deadline:
            raise TimeoutError(f'{what or predicate} did not come to be within {timeout:g} s')
        pause.wait(POLL)


class Mailbox:
    """Keeps the messages of a topic, and lets a test wait for them.

    :param node: the node that receives them; None: the mailbox is given as a delegate to whatever
        channels or nodes, ``interested_in(..., delegate=mailbox)``
    :param topic: as in :meth:`~pharos.Node.interested_in`, like ``typed_as``
    """

    def __init__(self, node: Optional[Node] = None, topic: str = '', typed_as: Any = None) -> None:
        self._came: List[Any] = []
        self._waiting: 'queue.SimpleQueue[Tuple[Any, InputChannel]]' = queue.SimpleQueue()
        if not (node is None or node_registry.is_node(node)):
            raise TypeError(
                f'a Mailbox is given the node that hears, before the topic, not {node!r}'
            )
        self.channel = node.interested_in(topic, typed_as, delegate=self) if node else None

    def __call__(self, message: Any, channel: InputChannel) -> None:
        self._came.append(message)
        self._waiting.put((message, channel))

    def next(self, timeout: Optional[float] = None) -> Any:
        """Take the next message, and wait for it if need be.

        :param timeout: seconds, None: :data:`TIMEOUT`
        :raises TimeoutError: if none comes in time
        """
        return self.next_with_channel(timeout)[0]

    def next_with_channel(self, timeout: Optional[float] = None) -> Tuple[Any, InputChannel]:
        """The same, as ``(message, the channel that it came through)``."""
        timeout = _limit(timeout)
        try:
            return self._waiting.get(timeout=max(0.0, timeout))
        except queue.Empty:
            through = ', '.join(map(repr, self._channels())) or 'no channel: nothing is heard'
            raise TimeoutError(
                f'no message came within {timeout:g} s, after {len(self._came)} others, through'
                f' {through}'
            ) from None

    def _channels(self) -> List[InputChannel]:
        """Those whose messages come here."""
        blocks: Dict[InputChannel, Any] = {
            channel: node.delegate if channel.delegate is None else channel.delegate
            for node in node_registry.nodes()
            for channel in node.channels
            if isinstance(channel, InputChannel)
        }
        return [channel for channel, block in blocks.items() if block is self]

    def take(self, count: int) -> List[Any]:
        """The next ``count`` messages."""
        return [self.next() for _ in range(count)]

    def wait_for(self, predicate: Callable[[Any], Any], timeout: Optional[float] = None) -> Any:
        """Take messages until one for which ``predicate(message)`` holds; returns that one.

        :param timeout: seconds for all of them, None: :data:`TIMEOUT`
        :raises TimeoutError: if there is none in time
        """
        check_block(predicate, 'predicate', ('message',))
        deadline = time.monotonic() + _limit(timeout)
        while True:
            message = self.next(max(0.0, deadline - time.monotonic()))
            if predicate(message):
                return message

    def all(self) -> List[Any]:
        """All messages that came so far, those that were taken among them."""
        return list(self._came)

    def empty(self) -> bool:
        """Whether there is no message that was not taken."""
        return self._waiting.empty()


def _limit(timeout: Optional[float]) -> float:
    return TIMEOUT if timeout is None else check_seconds('timeout', timeout)


def registrations(master: Master) -> Dict[str, Set[str]]:
    """What the master knows: the name of each node, and what it publishes, hears and offers."""
    found: Dict[str, Set[str]] = {}
    for kind, names in zip(('publishes', 'hears', 'offers'), master.system_state()):
        for name, nodes in names.items():
            for node in nodes:
                found.setdefault(node, set()).add(f'{kind} {name}')
    return found


@contextlib.contextmanager
def nothing_left(
    master: Master, timeout: Optional[float] = None, may_stay: str = '(?!)'
) -> Iterator[None]:
    """A block that leaves behind neither a node of this process, nor a registration at the master,
    nor a thread that it did not find.

    Fails the test otherwise, and says what is left; nodes that are left are stopped.

    :param timeout: seconds in which what is about to end may do so, None: :data:`TIMEOUT`
    :param may_stay: regular expression for the names of threads that may stay; by default none may
    """
    threads, known = set(threading.enumerate()), registrations(master)
    yield
    nodes = master.local_nodes()
    _stop(nodes)
    if nodes:
        names = ', '.join(node.name for node in nodes)
        pytest.fail(f'left running: {names}; stop() them, or make them by create_node()', False)

    def left() -> List[str]:
        return [
            *(
                f'{name} {what}'
                for name, own in registrations(master).items()
                for what in sorted(own - known.get(name, set()))
            ),
            *(
                f'thread {thread.name}'
                for thread in set(threading.enumerate()) - threads
                if not re.search(may_stay, thread.name)
            ),
        ]

    with contextlib.suppress(TimeoutError):
        until(lambda: not left(), timeout)
        return
    pytest.fail(f"left behind: {'; '.join(left())}", False)


def _stop(nodes: Iterable[Node]) -> None:
    with contextlib.ExitStack() as stops:  # each of them, whatever the stop of another raises
        for node in nodes:
            stops.callback(node.stop)


@pytest.fixture
def master(monkeypatch: pytest.MonkeyPatch) -> Iterator[Master]:
    """An embedded :class:`~pharos.Master` of the test, which is ROS_MASTER_URI's, too.

    The test fails where it leaves a node, thread or registration behind: see :func:`nothing_left`.
    """
    with Master.embedded() as embedded:
        monkeypatch.setenv('ROS_MASTER_URI', embedded.url)
        with nothing_left(embedded):
            yield embedded


class NodeFactory:
    """Makes the nodes of a test; the fixture ``create_node`` is one."""

    def __init__(self, master: Master) -> None:
        self.master = master
        self.nodes: List[Node] = []
        self._expects_failures = False

    def __call__(
        self,
        node_class: Callable[..., NodeType],
        name: Optional[str] = None,
        domain: str = '127.0.0.1',
        **kwargs: Any,
    ) -> NodeType:
        """A started node, on the loopback interface.

        :param node_class: as in :meth:`~pharos.Master.create`, like ``domain`` and ``kwargs``
        :param name: None: made of that of the class, and unique among the nodes of the test
        """
        if 'named' in kwargs:
            raise TypeError(
                f"create_node() takes a name as name={kwargs['named']!r}, not as named="
            )
        if name is None:
            name = self._free_name(getattr(node_class, '__name__', 'node'))
        else:
            check_not_taken(node_class, ['name'], 'create_node()')
        node = self.master.create(node_class, named=name, domain=domain, **kwargs)
        self.nodes.append(node)
        return node

    def _free_name(self, class_name: str) -> str:
        base = '/' + re.sub(r'(?<=[a-z0-9])(?=[A-Z])', '_', class_name).lower()
        taken = {node.name for node in self.nodes}
        numbers = range(2, len(taken) + 3)
        names = [base, *(f'{base}_{number}' for number in numbers)]
        return next(name for name in names if name not in taken)

    def expect_failures(self) -> None:
        """Blocks of the nodes of this test may fail: the test looks at ``node.failures`` itself."""
        self._expects_failures = True

    def close(self) -> None:
        """Stop the nodes, and fail the test if a block of them failed unexpectedly."""
        _stop(self.nodes)
        failures: List[Failure] = [failure for node in self.nodes for failure in node.failures]
        if failures and not self._expects_failures:
            told = '\n'.join(f'{failure}\n{failure.traceback}' for failure in failures)
            pytest.fail(f'blocks of its nodes failed (or say expect_failures()):\n{told}', False)


_factories: List[NodeFactory] = []  # of the test that runs, the newest last


def expect_failures() -> None:
    """Say in a test that blocks of the nodes of its ``create_node`` may fail; a fixture, too, of
    this name, which is this function."""
    if not _factories:
        raise RuntimeError('expect_failures() is for a test that has the fixture create_node')
    _factories[-1].expect_failures()


def pytest_configure(config: 'pytest.Config') -> None:
    """Have pytest say nothing of a name of Python 2's by which rospy itself calls ``threading``."""
    config.addinivalue_line('filterwarnings', 'ignore:notifyAll:DeprecationWarning')


@pytest.fixture
def create_node(master: Master) -> Iterator[NodeFactory]:
    """``create_node(node_class, name=None, **kwargs)`` makes and starts a node, which is stopped
    at the end of the test.

    A failure in a block of it fails the test, unless that says :func:`expect_failures`.
    """
    factory = NodeFactory(master)
    _factories.append(factory)
    try:
        yield factory
    finally:
        _factories.remove(factory)
        factory.close()


@pytest.fixture(name='expect_failures')
def _expect_failures(create_node: NodeFactory) -> Callable[[], None]:
    return create_node.expect_failures


@pytest.fixture
def mailbox() -> Mailbox:
    """A :class:`Mailbox` to be given as a delegate."""
    return Mailbox()
