"""What ``pharos.live`` looks at topics with: probes, which count and weigh messages, listeners, and
the waits of those who look. It is of the facade, for it is made of a channel's inbox and dispatcher;
loaded only when somebody looks."""
import array
import collections
import threading
import time
from typing import TYPE_CHECKING, Any, Callable, Deque, Dict, Optional

import genpy

from pharos import node_registry, signals
from pharos.channel import InputChannel
from pharos.errors import NodeStoppedError
from pharos.intraprocess.inbox import Inbox
from pharos.private_rospy import changes
from pharos.private_rospy.lifetime import Interruption, wait_for

if TYPE_CHECKING:
    from pharos.node import Node
    from pharos.run import Run

KEPT = 1000  # messages that wait for a thread that is slower than they come
QUEUE_SIZE = 100  # messages of nodes of this process that wait to be weighed


class Look:
    """One look, of one thread: its waits end when the node stops on whose behalf the thread runs,
    also where that begins between two of them."""

    def __init__(self) -> None:
        self._stop = Interruption()

    def pause(self, seconds: float) -> None:
        """Wait; in the main thread, Ctrl-C raises KeyboardInterrupt, and another signal SystemExit,
        as in time.sleep().

        :raises NodeStoppedError: if the thread's node stops, or all nodes do
        """
        deadline, all_stop = time.monotonic() + seconds, threading.Event()
        node_registry.before_stop_all(all_stop.set)
        try:
            with signals.interruptible_wait(is_cut_off=True):
                own = threading.Condition()  # any other might stay locked where this is cut off
                wait_for(own, lambda: self._stop.came or all_stop.is_set(), seconds)
        finally:
            node_registry.not_before_stop_all(all_stop.set)
        self._check_time_is_up(deadline)

    def wait(self, node: 'Node', predicate: Callable[[], Any], timeout: float) -> bool:
        """Wait until ``predicate()`` holds, which is looked at when a :class:`Listener` hears a
        message; returns whether it does.

        :param node: the one that looks
        :param timeout: seconds
        :raises NodeStoppedError: if that node stops meanwhile, as Ctrl-C has it where this is no
            prompt, or the thread's
        """
        deadline = time.monotonic() + timeout
        with signals.interruptible_wait():
            node.latest_run.rospy.wait_until(lambda: self._stop.came or predicate(), timeout)
        if predicate():
            return True
        self._check_time_is_up(deadline)
        return False

    def wait_out(self, node: 'Node', seconds: float) -> None:
        """Wait for so many seconds, as :meth:`wait` does for something."""
        self.wait(node, lambda: False, seconds)

    def _check_time_is_up(self, deadline: float) -> None:
        if self._stop.came or time.monotonic() < deadline:
            raise NodeStoppedError('nodes stop: nothing is watched any more')


def wait_for_publishers(node: 'Node', topic: str, timeout: float) -> None:
    """Wait until each publisher that the master has named to the node is connected, or out of
    reach, for up to ``timeout`` seconds."""
    rospy = node.latest_run.rospy
    rospy.wait_until(lambda: rospy.connections.has_heard_from_publishers(topic), timeout)


class Listener:
    """A delegate that keeps the newest messages that it hears for a thread that waits for them."""

    def __init__(self) -> None:
        self.messages: Deque[genpy.Message] = collections.deque(maxlen=KEPT)

    def __call__(self, message: genpy.Message, channel: InputChannel) -> None:
        self.messages.append(message)
        changes.notify()


class Probe(InputChannel):
    """The end at which a node takes note of when each message comes, and, if asked, of its bytes.

    No message is made of what nodes of this process publish, but where it is to be weighed, and
    that is done in a thread of the probe's node: the publisher does not wait for it.

    :param node: one that is made for this, for its dispatcher is told that nobody waits for it
    :param weighs: whether the bytes count
    """

    def __init__(self, node: 'Node', topic: str, weighs: bool = False) -> None:
        self.weighs = weighs
        self.restart()
        super().__init__(node, topic, node.ros.AnyMsg, queue_size=QUEUE_SIZE)

    def open(self, run: 'Run') -> None:
        dispatcher = run.dispatcher
        dispatcher.is_yielded_to = False
        if self.weighs:
            dispatcher.need_thread()
        inbox = _SocketTally(self, dispatcher)
        self._subscribe(run, inbox)

    def restart(self) -> None:
        """Forget what came so far, such as latched messages."""
        #: when each message came, by time.perf_counter()
        self.times = array.array('d')
        #: bytes on the wire, without the length that precedes them; where messages come faster than
        #: they can be weighed, those of some
        self.sizes = array.array('q')

    def open_inbox(self, thaw: Callable[[Any], Any], header: Dict[str, str]) -> Inbox:
        return _LinkTally(self, self._run.dispatcher, thaw, header)

    def deliver(self, message: genpy.Message, header: Optional[Dict[str, str]]) -> None:
        """Weigh a message of a node of this process."""
        self.sizes.append(len(message._buff))


class _LinkTally(Inbox):
    """What comes from one node of this process."""

    __slots__ = ()

    def put(self, value: Any, size: int = 0) -> None:
        probe: Any = self.receiver
        probe.times.append(time.perf_counter())
        if probe.weighs:
            super().put(value, size)


class _SocketTally(Inbox):
    """What comes through sockets, as the bytes that it was there."""

    __slots__ = ()

    def put(self, value: Any, size: int = 0) -> None:
        probe: Any = self.receiver
        probe.times.append(time.perf_counter())
        if probe.weighs:
            probe.sizes.append(len(value._buff))
