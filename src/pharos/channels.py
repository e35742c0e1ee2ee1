"""Channels: the ends of a topic at which a node receives and sends."""
from __future__ import annotations

import functools
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from genpy import Message
from rospy import ROSException
from rospy.msg import args_kwds_to_message

from pharos import definitions, messages
from pharos.blocks import Block, DelegateHolder
from pharos.errors import (
    MessageTypeError,
    NodeStoppedError,
    UnknownNodeError,
    UnknownTopicError,
)
from pharos.intraprocess.copier import SERIALIZE_ERRORS
from pharos.intraprocess.inboxes import Inbox
from pharos.intraprocess.links import Connection, peer_of
from pharos.private_rospy.topics import connections_of
from pharos.waiting import wait

if TYPE_CHECKING:
    from pharos.node import Node
    from pharos.private_rospy.run import Run

QUEUE_SIZE = 1000


class Endpoint:
    """A channel, service or parameter of a node.

    The node's stop closes what rospy has opened, and marks the endpoint as closed. The node's next
    start opens the endpoint again, unless the node's class has a start() of its own.

    :ivar node: the node
    :ivar closed: True if the endpoint was closed, or the node is stopped. open() and close() set it;
        Run.mark_stopped() does so for all endpoints, and InputChannel._open() early, for the first message
    """

    node: Node
    closed = True
    delegate: Any = None  # the endpoint's block or blocks
    ros_object: Any = None  # rospy's Publisher, Subscriber or Service

    @property
    def _run(self) -> Run:
        return self.node._current_run

    def _open(self) -> bool | None:
        """Register with the master; return True if a delegate has closed the endpoint meanwhile.

        A question to the master comes first: if it does not answer, nothing is registered.
        """
        raise NotImplementedError

    def open(self) -> None:
        """Register with the master, by _open() of the subclass.

        The constructor calls this, and each further start of the node.

        :raises MasterUnreachableError: if the master does not answer
        """
        self.node._check_active()
        is_closed_again = self._open()
        if not is_closed_again:
            self._run.endpoints.append(self)  # in place: another thread may open or close one, too
            self.closed = False

    def close(self) -> None:
        """Unregister, and receive, send or offer no more.

        The node's next start leaves the endpoint closed. A second call does nothing.
        """
        with suppress(ValueError):  # a closed one
            self._run.endpoints.remove(self)
        if not self.closed:
            self.closed = True
            self._close()

    def _close(self) -> None:
        if self.ros_object:
            self.ros_object.unregister()


class Channel(Endpoint):
    """The base of input and output channels.

    :ivar topic: the full name of the topic
    :ivar type: the name of the topic's message type
    """

    queue_size: int | None

    def _open_on(self, node: Node, topic: str, message_class: type[Message]) -> None:
        """Set the attributes, and open the channel.

        :raises ValueError: if the queue_size cannot be one
        """
        size = self.queue_size
        if size is not None and not (isinstance(size, int) and size >= 0):
            raise ValueError(f'{topic}: a queue_size is 0 or more messages, not {size!r}')
        self.node = node
        self.topic = topic
        self.message_class = message_class
        self.type = message_class._type
        self.open()

    @property
    def connections(self) -> list[tuple[str, str]]:
        """The connected peers: ``(name of the node, 'INTRAPROCESS', 'SHARED_MEMORY' or 'TCPROS')``."""
        return [
            (peer_of(connection), connection.transport_type)  # type: ignore[misc]
            for connection in connections_of(self.ros_object)
            if peer_of(connection)
        ]

    def __repr__(self) -> str:
        state = 'closed ' if self.closed else ''
        return f'<{state}{type(self).__name__} {self.topic} ({self.type}) of {self._run.name}>'


# DelegateHolder comes first: its ``delegate`` replaces that of Endpoint
class InputChannel(DelegateHolder, Channel, Inbox):
    """The end of a topic at which a node receives; see :meth:`Node.interested_in`.

    The channel is an Inbox: messages wait in the channel itself for its delegate.

    :ivar received: the number of messages that were taken for the delegate
    :ivar dropped: the number of messages that were dropped because the queue was full
    """

    received = 0

    def __init__(
        self,
        node: Node,
        topic: str,
        message_class: type[Message],
        delegate: Block | None,
        queue_size: int | None,
        inline: bool,
        shared: bool,
        from_: str | None,
    ) -> None:
        Inbox.__init__(self, None, self._run_delegate, queue_size, inline, shared)
        self.queue_bytes = node.queue_bytes
        self.from_ = from_
        self.delegate = delegate
        self._open_on(node, topic, message_class)

    def _open(self) -> bool:
        self._run.master.call('getPid')
        self.messages.clear()  # the stop has dropped the jobs of these messages
        self.attach(self._run.callback_queue)
        self.closed = False  # the first message may come before the Subscriber is made
        # the callback is an Inbox, which SubscriptionOverlay fills
        self.ros_object = self.node.ros.Subscriber(self.topic, self.message_class, self)
        if self.closed:  # by the delegate, at that message
            self._close()
        return self.closed

    def __call__(self, message: Message) -> None:
        """Take a latched message of a connection that is older than the channel; rospy calls this."""
        self.receive(message)

    def _run_delegate(self, message: Message) -> None:
        try:
            if self.closed:
                return
            if self.from_ and message._connection_header['callerid'] != self.from_:
                return
            self.received += 1
            block = self._delegate_block or self.node._delegate_block
            if block:
                block(message, self)
            elif self.received == 1:
                self._run.ros.logwarn(f'{self.topic}: messages come, but there is no delegate')
        except BaseException as error:
            delegate = self.delegate or self.node.delegate
            self._run.report_failure(error, delegate, 'delegate', message, self, self._retry)

    def _retry(self, message: Message) -> None:
        """Run the delegate on a message once more, while no other delegate of the node runs."""
        self.node._check_active()
        self.callback_queue.run_exclusively(lambda: self._run_delegate(message))


class OutputChannel(Channel):
    """The end of a topic at which a node sends; see :meth:`Node.output_channel`.

    :ivar sent: the number of messages that were sent
    """

    sent = 0

    def __init__(
        self,
        node: Node,
        topic: str,
        message_class: type[Message],
        latch: bool = False,
        queue_size: int | None = QUEUE_SIZE,
    ) -> None:
        self.latch = latch
        self.queue_size = queue_size
        self._open_on(node, topic, message_class)

    def open(self) -> None:
        """Advertise, and wait for the subscribers that the master knows."""
        # asked before: later subscribers learn of this publisher from the master
        subscribers = set(self._run.master.system_state()[1].get(self.topic, []))
        latched = None
        # the node starts again: _publisher is still that of the run before, which has its latched message
        if self.ros_object:
            latched = self._publisher.latches.get(self)
        super().open()
        if latched is not None:
            self._publisher.publish(self._publisher.thaw(latched), channel=self)
        self._wait_until_connected(subscribers)

    def _open(self) -> None:
        self.ros_object = self.node.ros.Publisher(
            self.topic, self.message_class, latch=self.latch, queue_size=self.queue_size
        )
        self._publisher = self.ros_object.impl

    def _wait_until_connected(self, subscribers: set[str]) -> None:
        """Wait until these nodes are connected: rospy loses messages sent before (#176).

        Dead nodes, which refuse connections, are left out. A node that does not connect within the
        node's connect_timeout is logged.
        """
        node = self.node

        def connected() -> set[str | None]:
            return {peer_of(connection) for connection in self._publisher.connections}

        may_live = self._run.master.may_live
        alive = {name for name in subscribers - connected() if may_live(name)}
        is_ready = wait(lambda: alive <= connected(), node.connect_timeout, node)
        if not is_ready and node.connect_timeout and node.is_running:
            missing = sorted(alive - connected())
            node.log(
                f'{self.topic}: {", ".join(missing)} did not connect within'
                f' {node.connect_timeout:g} s, and may miss the first messages: can they reach'
                ' this host, and are they of the same type? A longer connect_timeout waits longer',
                'warning',
            )

    def publish(self, *values: Any, **fields: Any) -> None:
        """Send a message, or one with these values of all its fields, or with these fields.

        Inline delegates of nodes of this process run before this returns, unless their node runs a
        delegate already, or its start(). This waits for sockets only without a queue_size. It waits for the threads
        of receivers: 1 ms at most (YIELD_LIMIT) for each, and for no other after one that took so long.
        If the queue of a receiver is full, its thread may run before each message.

        :raises MessageTypeError: if the message is of another type, or cannot be serialized
        :raises NodeStoppedError: if the channel is closed
        """
        message = values[0] if len(values) == 1 and not fields else None
        if not isinstance(message, Message):
            try:
                message = args_kwds_to_message(self.message_class, values, fields)
            except (TypeError, ROSException) as error:
                raise MessageTypeError(f'{self.topic} carries {self.type}: {error}') from error
        self._publish(message)

    def _publish(self, message: Message, connection: Connection | None = None) -> None:
        """Send a message, to all or to one connection."""
        if type(message) is not self.message_class:
            self._check_type(message)
        if self.closed:
            raise NodeStoppedError(f'{self!r} cannot send: open another one, or start the node')
        try:
            # PublisherOverlay.publish(), which takes a connection and a channel, too
            self._publisher.publish(message, connection, self)
        except (ROSException, *SERIALIZE_ERRORS) as error:
            if self._publisher.closed:  # the node's stop closes it before the channel
                raise NodeStoppedError(f'{self!r} was closed while it sent') from error
            raise messages.explain(message, error) from error

    def _check_type(self, message: object) -> None:
        sent_class = type(message)
        # AnyMsg has the md5sum '*'
        if getattr(sent_class, '_md5sum', None) not in (self.message_class._md5sum, '*'):
            sent_type = getattr(sent_class, '_type', repr(message)[:80])
            raise MessageTypeError(f'{self.topic} carries {self.type}, not {sent_type}')

    def send(self, block: Any = None, *, to: Any = None, **fields: Any) -> Message:
        """Fill a new message, or take a ready one, and send the message.

        :param block: ``block(message)`` fills a new message; or a dict, or a ready message
        :param to: the node that alone gets the message: a name, Node or ExternalNode
        :param fields: fill the message by name
        :returns: the message
        :raises MessageTypeError: if the message does not fit the topic, or has no such field
        :raises UnknownNodeError: if the node ``to`` is not connected
        :raises NodeStoppedError: if the channel is closed
        """
        message = messages.build(self.message_class, block, fields)
        connection = self._connection_to(to) if to else None
        self._publish(message, connection)
        return message

    def _connection_to(self, node: Any) -> Connection:
        name = self.node._peer_name(node)
        for connection in connections_of(self.ros_object):
            if peer_of(connection) == name:
                return connection
        raise UnknownNodeError(
            f'{name} is not connected to {self.topic}: rostopic info {self.topic} tells who is'
        )

    def close(self) -> None:
        """Unregister, and send no more.

        Before that, wait until the sockets have taken all messages, up to the node's stop_timeout.
        If the node has another Publisher of the topic, do not wait.
        """
        if not self.closed:
            self._publisher.latches.pop(self, None)
            if self._publisher.ref_count == 1:  # the last one closes the topic
                self._publisher.flush(time.monotonic() + self.node.stop_timeout)
        super().close()

    def wait_for_subscribers(self, count: int = 1, timeout: float | None = None) -> bool:
        """Wait until so many subscribers are connected.

        The node's stop ends the wait.

        :param timeout: seconds, None: without limit
        :returns: True if they are connected
        """
        subject = f'{count} subscribers of {self.topic}'
        return wait(lambda: len(self.connections) >= count, timeout, self.node, subject)


# -- the class of a topic


def find_to_send(node: Node, topic: str, typed_as: str | type | None) -> tuple[OutputChannel, bool]:
    """Return an OutputChannel of a node for a topic, and True if the channel is a new one."""
    message_class = class_of(node, topic, typed_as)
    for channel in node.channels:
        if channel.topic == topic and isinstance(channel, OutputChannel):
            return channel, False
    return OutputChannel(node, topic, message_class), True


def class_of(node: Node, topic: str, typed_as: str | type | None) -> type[Message]:
    """Return the message class of a topic for a node.

    :param typed_as: type name or message class; None: the type known to the node or the master
    :raises UnknownTopicError, UnknownTypeError: if the type is not known
    :raises MessageTypeError: if the node has the topic open with another type
    """
    known = [channel.message_class for channel in node.channels if channel.topic == topic]
    if known and typed_as is None:
        return known[0]
    type_name = typed_as or node._settings.master.topic_type(topic)
    if type_name is None or type_name == '*':
        raise UnknownTopicError(
            f'the master knows no type of {topic}: give typed_as=, such as "std_msgs/String"'
        )
    message_class = definitions.message_class(
        type_name, functools.partial(_ask_definition, node, topic)
    )
    if known and known[0]._md5sum != message_class._md5sum:
        raise MessageTypeError(
            f'{node._settings.name} has {topic} open as {known[0]._type}, not as'
            f' {message_class._type}'
        )
    return message_class


def _ask_definition(node: Node, topic: str, type_name: str) -> str | None:
    """Return the type's definition from the header of a publisher's connection, or None."""
    if not node._settings.master.topic(topic).publishers:
        return None

    def definitions_of(subscriber: Any) -> list[str]:
        headers = [connection.header or {} for connection in subscriber.impl.connections]
        return [
            header['message_definition'] for header in headers if header.get('type') == type_name
        ]

    found = wait_subscribed(
        node, definitions_of, node.connect_timeout, topic, node._current_run.ros.AnyMsg
    )
    return found[0] if found else None


def wait_subscribed(
    node: Node, predicate: Block, timeout: float | None, topic: str, *arguments: Any
) -> Any:
    """Return the first true ``predicate(subscriber)`` of a new rospy.Subscriber."""
    # a channel would not do: the delegate that calls this holds up the node's callback queue
    subscriber = node._current_run.ros.Subscriber(topic, *arguments)
    try:
        return wait(lambda: predicate(subscriber), timeout, node, f'a message on {topic}')
    finally:
        subscriber.unregister()
