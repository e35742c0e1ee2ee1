"""Channels: one node's end of a topic, and the end at which it hears."""
import collections
import threading
from typing import TYPE_CHECKING, Any, Callable, Dict, List, Optional, Tuple, Type

import genpy

from pharos import on_demand, signals
from pharos.blocks import Block, attempt, check_delegate, check_flag
from pharos.errors import NodeStoppedError, PharosError
from pharos.intraprocess.inbox import Inbox, SocketInbox

if TYPE_CHECKING:
    from pharos.live.plot import Plot
    from pharos.node import Node
    from pharos.run import Run


class Channel:
    """What the two ends have in common.

    Its node opens it, again after a restart, and forgets it when it is closed.
    """

    refused: Any = 0  # how many of the other end the channel cannot hear

    def __init__(
        self, node: 'Node', topic: str, message_class: Type[genpy.Message], queue_size: int
    ) -> None:
        if type(queue_size) is not int or queue_size < 1:
            raise ValueError(
                f'queue_size must be a number of messages, 1 or more, not {queue_size!r}'
            )
        self.node, self.topic = node, topic
        self.message_class = message_class
        self.queue_size, self.queue_bytes = queue_size, node.queue_bytes
        self.closed = False  # whether close() was called
        self._endpoint: Any = None  # rospy's Publisher or Subscriber while the channel is open
        # held to take the endpoint away, for two threads may close the channel at once
        self._lock = threading.Lock()

    def open(self, run: 'Run') -> None:
        """Register with rospy, also after a restart of the node.

        :param run: the node's that is to have it
        """
        raise NotImplementedError

    def _unregister(self, endpoint: Any) -> None:
        raise NotImplementedError

    def _begin(self, *arguments: Any) -> None:
        """Open it for the first time; where that fails, nothing is left behind."""
        try:
            self.open(self._run, *arguments)
        except BaseException:
            self.close()
            raise

    @property
    def _run(self) -> 'Run':
        run = self.node.latest_run
        assert run  # who has channels has been started
        return run

    @property
    def _rospy(self) -> Any:
        return self._run.rospy

    @property
    def type(self) -> str:
        """The type name, such as 'turtlesim/Velocity'."""
        return str(self.message_class._type)

    @property
    def connections(self) -> List[Tuple[str, str]]:
        """``[(peer node name, transport)]``, transport being 'INTRAPROCESS' or 'TCPROS'."""
        return list(self._rospy.connections.of(self._endpoint)) if self.is_open else []

    @property
    def is_open(self) -> bool:
        """Whether it is neither closed nor its node stopped."""
        return self._endpoint is not None

    def close(self) -> None:
        """End it: the node no longer publishes, or is interested. Harmless when done twice.

        When it returns, no delegate runs for the channel any more; but for the one that calls it,
        if one does, and one that does not end within the node's ``stop_timeout``.
        """
        with signals.held():
            self.closed = True  # where it is only just being opened, it is closed right after that
            self._run.forget(self)
            self._release()

    def _release(self) -> None:
        """Give rospy's Publisher or Subscriber back, if there is one."""
        with self._lock:
            endpoint, self._endpoint = self._endpoint, None
        if endpoint is not None:
            self._unregister(endpoint)

    def _opened(self, run: 'Run', endpoint: Any, give_back: Callable[[], Any]) -> None:
        """The channel is open, unless a delegate or another thread has closed it meanwhile.

        :raises NodeStoppedError: if the run has ended, after ``give_back()``
        """
        run.remember(self, self.topic, lambda: self._take(endpoint), give_back)
        if self.closed:
            self.close()

    def _take(self, endpoint: Any) -> None:
        self._endpoint = endpoint

    def node_stopped(self) -> None:
        """The node stops, and its rospy closes all endpoints."""
        self._endpoint = None

    def __repr__(self) -> str:
        counts = collections.Counter(transport for _, transport in self.connections)
        counts['refused'] += self.refused
        state = ', '.join(
            f'{count} {transport}' for transport, count in sorted(counts.items()) if count
        )
        return (
            f"<{type(self).__name__} {self.topic} {self.type} of {self.node.name}:"
            f" {state or 'not connected' if self.is_open else 'closed'}>"
        )


class InputChannel(Channel):
    """The end at which a node receives: made by :meth:`Node.interested_in`.

    :ivar node: the node that has it
    :ivar topic: the name of the topic
    :ivar message_class: the class of its messages
    :ivar received: how many messages the node has taken from it
    :ivar dropped: how many were dropped, the oldest first, for the node was slower than they came
    :ivar from_: the name of the only node that it hears; None: all
    :ivar inline: whether the delegate runs in the publisher's thread
    :ivar shared: whether it gets the very message that was published
    :ivar queue_size: messages that may wait for the node
    :ivar queue_bytes: bytes of large messages that may
    :ivar closed: whether it was closed for good
    """

    def __init__(
        self,
        node: 'Node',
        topic: str,
        message_class: Type[genpy.Message],
        delegate: Optional[Block] = None,
        queue_size: int = 1,
        inline: bool = False,
        shared: bool = False,
        from_: Any = None,
    ) -> None:
        super().__init__(node, topic, message_class, queue_size)
        self.delegate = delegate
        self.inline = check_flag('inline', inline)
        self.shared = check_flag('shared', shared)
        self.from_ = None if from_ is None else str(self._run.resolve_peer(from_))
        self.received = 0
        self.dropped = 0
        self._dropping = threading.Lock()  # held to change that
        self._has_told = False  # that there is no delegate
        self._begin()

    def open(self, run: 'Run') -> None:
        dispatcher = run.dispatcher
        if not self.inline:
            dispatcher.need_thread()
        inbox = Inbox(self, dispatcher) if self.inline else SocketInbox(self, dispatcher)
        self._subscribe(run, inbox)
        dispatcher.run()  # the inline inboxes that latched messages have filled

    def _subscribe(self, run: 'Run', inbox: Inbox) -> None:
        """Be open, with an inbox for what comes through sockets.

        :raises NodeStoppedError: if the run ends meanwhile
        """
        endpoint = run.rospy.connections.subscribe(self, inbox, self.node.connect_timeout)
        self._opened(run, endpoint, lambda: run.rospy.connections.unsubscribe(self, endpoint))

    def _unregister(self, endpoint: Any) -> None:
        self._rospy.connections.unsubscribe(self, endpoint)
        self._run.dispatcher.wait_for_delegate(self.node.stop_timeout)

    def subscribe_as(self, message_class: Type[genpy.Message]) -> None:
        """Take another class than it was opened with, of which nothing has come."""
        self._release()
        self._run.forget(self)
        self.message_class = message_class
        self._begin()

    @property
    def refused(self) -> int:
        """How many publishers the channel cannot hear, for they publish another type; see the
        node's errors."""
        return len(self._rospy.refusals.of(self.topic)) if self.is_open else 0

    @property
    def delegate(self) -> Optional[Block]:
        """The channel's own block, called as ``delegate(message, channel)``; None: the node's is
        run."""
        return self._delegate

    @delegate.setter
    def delegate(self, block: Optional[Block]) -> None:
        self._delegate: Optional[Block] = check_delegate(block)

    def run_again(self, message: genpy.Message) -> None:
        """Run the delegate, as it is now, on a message, when no other of the node runs: that of the
        channel in the place of this one, if another is open there.

        :raises PharosError: if there is none any more; or if the node runs a delegate that waits
            for one that this thread runs
        :raises NodeStoppedError: if the node is not running, or stops before
        """
        self.node.current_run  # raises where it is stopped
        channel = self._in_its_place()

        def run() -> None:
            block = channel._present_delegate
            if block is None:
                raise PharosError(
                    f'{self.topic} has no delegate any more: give {self.node.name} or its '
                    'channel one first'
                )
            try:
                block(message, channel)
            except BaseException as error:
                self._run.report(error, block, 'delegate', channel, message)

        if not self.node.current_run.dispatcher.run_in_turn(run):
            raise NodeStoppedError(f'{self.node.name} has stopped meanwhile: start() it first')

    def _in_its_place(self) -> 'InputChannel':
        """The channel; or where it is closed, as after a restart with a start() of the class's own,
        one that the node has opened for the same since, with a delegate of that name if it can
        be."""
        matter = self.topic, self.message_class, self.from_
        same = [
            other
            for other in self._run.channels
            if isinstance(other, InputChannel)
            and (other.topic, other.message_class, other.from_) == matter
        ]
        if self in same:
            return self
        name = getattr(self._delegate, '__name__', None)
        same.sort(key=lambda other: getattr(other._delegate, '__name__', None) != name)
        return same[0] if same else self

    @property
    def _present_delegate(self) -> Any:
        return self.node.delegate if self._delegate is None else self._delegate

    def plot(self, *fields: str, seconds: Optional[float] = None) -> 'Plot':
        """Plot numeric fields of the topic's messages over time: ``channel.plot('linear.x',
        seconds=10).save('speed.png')``.

        They are collected from now on by a node of its own, until the channel's node stops, and
        through its restarts; the channel's delegate, queue and counts are not touched.

        :param fields: 'linear.x', 'ranges[0]', 'header.stamp'
        :param seconds: returns the finished :class:`~pharos.live.plot.Plot` after that long; None:
            returns at once one that collects until its ``close()``, or until it is kept no more
        :raises MessageTypeError: if there is no such field, or it is no number
        :raises TimeoutError: if no message came in these seconds
        :raises NodeStoppedError: if the channel's node is stopped
        :raises PharosError: if matplotlib is not installed
        """
        made: 'Plot' = on_demand.module('live.plot').plot(self, fields, seconds)
        return made

    # -- as a pharos.intraprocess.inbox.Receiver

    def open_inbox(self, thaw: Callable[[Any], Any], header: Dict[str, str]) -> Inbox:
        """An inbox for what a node of this process sends."""
        return Inbox(self, self._run.dispatcher, thaw, header)

    def deliver(self, message: genpy.Message, header: Optional[Dict[str, str]]) -> None:
        """Run the delegate."""
        if self.closed:
            return
        self.received += 1
        block = self._delegate
        if block is None:
            block = self.node.delegate
            if block is None:
                self._tell_of_no_delegate()
                return
        if header is not None:
            message._connection_header = header
        try:
            block(message, self)
        except BaseException as error:
            self._run.report(error, block, 'delegate', self, message)

    def _tell_of_no_delegate(self) -> None:
        """Say so once, and not before a message is lost by it: the delegate may be set later."""
        if not self._has_told:
            self._has_told = True
            text = (
                f'{self.node.name} has no delegate for what comes on {self.topic}, which goes'
                ' nowhere: give interested_in() one, or set that of the node or channel'
            )
            attempt(lambda: self.node.log(text, level='warning'))

    def report(self, error: BaseException) -> None:
        """A message could not be made for the delegate."""
        self._run.report(error, self._present_delegate, 'delegate', self)

    def count_dropped(self) -> None:
        """A message was dropped."""
        with self._dropping:
            self.dropped += 1
