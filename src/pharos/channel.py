"""Channels: one node's end of a topic."""
import collections
import threading
import time
from typing import TYPE_CHECKING, Any, Callable, Dict, List, NoReturn, Optional, Set, Tuple, Type

import genpy

from pharos import first_message, messages
from pharos.blocks import check_block, check_delegate, check_runs
from pharos.errors import MessageTypeError, NodeStoppedError, PharosError
from pharos.intraprocess.copier import copier_for
from pharos.intraprocess.fanout import ClosedFanout
from pharos.intraprocess.inbox import Inbox, SocketInbox
from pharos.private_rospy.deadlines import time_limit
from pharos.seconds import check_limit
from pharos.signals import is_from_signal

if TYPE_CHECKING:
    from pharos.node import Node
    from pharos.run import Run

Block = Callable[..., Any]


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

    def open(self) -> None:
        """Register with rospy, also after a restart of the node."""
        raise NotImplementedError

    def _unregister(self, endpoint: Any) -> None:
        raise NotImplementedError

    def _begin(self, *arguments: Any) -> None:
        """Open it for the first time; where that fails, nothing is left behind."""
        try:
            self.open(*arguments)
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
        if one does, and one that does not end within the node's :attr:`stop_timeout`.
        """
        self.closed = True  # where it is only just being opened, it is closed right after that
        self._run.forget(self)
        self._release()

    def _release(self) -> None:
        """Give rospy's Publisher or Subscriber back, if there is one."""
        with self._lock:
            endpoint, self._endpoint = self._endpoint, None
        if endpoint is not None:
            self._unregister(endpoint)

    def _opened(self, endpoint: Any) -> None:
        """The channel is open, unless a delegate or another thread has closed it meanwhile."""
        self._endpoint = endpoint
        self._run.remember(self)
        if self.closed:
            self.close()

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

    :attr:`received` counts the messages that the node has taken from the channel, :attr:`dropped`
    those dropped, the oldest first, because the node was slower than they came.
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
        self.inline = inline
        self.shared = shared
        self.from_ = None if from_ is None else str(self._run.resolve_peer(from_))
        self.received = 0
        self.dropped = 0
        self._dropping = threading.Lock()  # held to change that
        self._begin()

    def open(self) -> None:
        dispatcher = self._run.dispatcher
        if not self.inline:
            dispatcher.need_thread()
        inbox = Inbox(self, dispatcher) if self.inline else SocketInbox(self, dispatcher)
        self._opened(self._rospy.connections.subscribe(self, inbox, self.node.connect_timeout))
        dispatcher.run()  # the inline inboxes that latched messages have filled

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
        """Run the delegate, as it is now, on a message, when no other of the node runs.

        :raises PharosError: if there is none any more
        """

        def run() -> None:
            block = self._present_delegate
            if block is None:
                raise PharosError(
                    f'{self.topic} has no delegate any more: give {self.node.name} or its '
                    'channel one first'
                )
            try:
                block(message, self)
            except BaseException as error:
                self._run.report(error, block, 'delegate', self, message)

        self.node.current_run.dispatcher.run_in_turn(run)

    @property
    def _present_delegate(self) -> Any:
        return self.node.delegate if self._delegate is None else self._delegate

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
                return
        if header is not None:
            message._connection_header = header
        try:
            block(message, self)
        except BaseException as error:
            self._run.report(error, block, 'delegate', self, message)

    def report(self, error: BaseException) -> None:
        """A message could not be made for the delegate."""
        self._run.report(error, self._present_delegate, 'delegate', self)

    def count_dropped(self) -> None:
        """A message was dropped."""
        with self._dropping:
            self.dropped += 1


class OutputChannel(Channel):
    """The end at which a node sends, as :meth:`Node.output_channel` or ``send_to`` makes it.

    :attr:`sent` counts the messages published; :attr:`latched` keeps the last, None: nothing does.
    """

    def __init__(
        self,
        node: 'Node',
        topic: str,
        message_class: Type[genpy.Message],
        latch: bool = False,
        queue_size: int = 1,
        connect_timeout: Optional[float] = None,
    ) -> None:
        super().__init__(node, topic, message_class, queue_size)
        self.latch = latch
        self.latched = self._run.latch_for(topic, message_class) if latch else None
        self.sent = 0
        self._uninterested: Set[str] = set()  # names of nodes of which the log says so
        self._freeze = copier_for(message_class).freeze
        self._fanout: Any = ClosedFanout
        self._opener: Optional[threading.Thread] = None
        self._connected = threading.Event()
        self._begin(connect_timeout)

    def open(self, connect_timeout: Optional[float] = None) -> None:
        timeout = self.node.connect_timeout if connect_timeout is None else connect_timeout
        deadline = time.monotonic() + timeout
        self._opener = threading.current_thread()
        try:
            endpoint, self._fanout = self._rospy.connections.advertise(
                self.topic,
                self.message_class,
                self.latched,
                timeout,
                self.queue_size,
                self.queue_bytes,
            )
            self._opened(endpoint)
            first_message.wait_for_known_subscribers(self, timeout, deadline)
        finally:
            self._connected.set()

    def wait_until_connected(self, timeout: float) -> None:
        """Wait for up to ``timeout`` seconds while another thread opens the channel and connects it
        to the subscribers that the master knows."""
        if self._opener is not threading.current_thread():
            self._connected.wait(timeout)

    def publish(self, message: genpy.Message, to: Any = None) -> None:
        """Send ``message`` to all who are interested, or to the node ``to`` alone.

        :param to: a name, Node or ExternalNode; see :meth:`Node.send_to`
        :raises MessageTypeError: if it is of another type, or a field holds what does not fit
        :raises UnknownNodeError: if there is no node ``to``
        :raises NodeStoppedError: if the channel is closed
        """
        if message.__class__ is not self.message_class:
            self._check_type(message)
        if to is not None:
            to = str(self._run.resolve_peer(to))
            self._check_is_there(to)
        try:
            is_sent = self._fanout.publish(message, self.latched, to)
        except Exception as error:
            self._explain(error, message)
        if is_sent or to is None:
            self.sent += 1

    def _check_is_there(self, name: str) -> None:
        """Raise UnknownNodeError if a message for that node alone has nowhere to go, since there is
        no such node."""
        endpoint = self._endpoint
        if endpoint is None or self._rospy.connections.reaches(endpoint, name):
            return
        with time_limit(self.node.connect_timeout):
            self.node.master.uri_of(name)
        if name not in self._uninterested and not self.latch:
            self._uninterested.add(name)
            self.node.log(
                f'{name} is not interested in {self.topic}, or not connected yet: what'
                f' {self.node.name} sends to it alone goes nowhere',
                level='warning',
            )

    def _check_type(self, message: Any) -> None:
        allowed = self.message_class._md5sum, '*'
        if not isinstance(message, genpy.Message) or message._md5sum not in allowed:
            raise MessageTypeError(
                f'{self.topic} carries {self.type}'
                f' ({messages.describe_fields(self.message_class)}), not'
                f' {getattr(message, "_type", None) or repr(message)}'
            )

    def _explain(self, error: Exception, message: genpy.Message) -> NoReturn:
        """Raise our error for one that publishing raised, but that of a handler of signals."""
        if is_from_signal(error):
            raise error
        if not self.is_open or self._rospy.connections.is_closed(self._endpoint):
            raise NodeStoppedError(
                f'the channel of {self.node.name} on {self.topic} is closed: open another with'
                ' output_channel()'
            ) from error
        messages.check_fits(message)
        raise MessageTypeError(f'{self.type} cannot be sent on {self.topic}: {error}') from error

    def _unregister(self, endpoint: Any) -> None:
        self._fanout = ClosedFanout
        self._rospy.connections.unadvertise(endpoint, self.latched)

    def send(
        self, block: Optional[Callable[[Any], Any]] = None, *, to: Any = None, **fields: Any
    ) -> Any:
        """Fill a fresh message with ``block(message)`` and by keywords, publish it, and return
        it."""
        if block is not None:
            check_runs(block, 'a block')
        try:
            message = messages.build(self.message_class, block, fields)
        except TypeError:
            check_block(block, 'block', ('message',))  # says how it is called
            raise
        if not self._fanout.connections:  # with nobody interested, nobody else looks at it
            try:
                self._freeze(message)
            except Exception:
                messages.check_fits(message)
                raise
        self.publish(message, to)
        return message

    def wait_for_subscribers(self, count: int = 1, timeout: Optional[float] = None) -> bool:
        """Wait until ``count`` subscribers are connected, for up to ``timeout`` seconds (None:
        without limit).

        Returns whether they are; ends early, with False, when the node stops; a soul of the node is
        ended by that.
        """
        timeout = check_limit('timeout', timeout)
        if self.is_open:
            self._rospy.wait_until(
                lambda: len(self.connections) >= count or not self.is_open, timeout
            )
        self._run.end_soul()
        return self.is_open and len(self.connections) >= count

    def node_stopped(self) -> None:
        super().node_stopped()
        self._fanout = ClosedFanout
        self._connected.set()
        self._opener, self._connected = None, threading.Event()
