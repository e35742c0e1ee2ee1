"""Channels, the ends of a topic at which a node receives and sends; topics, which hand them out."""
from __future__ import annotations

import socket
import time
import urllib.parse
from typing import TYPE_CHECKING, Any

import genpy

from pharos import messages
from pharos.blocks import Block, rebound, taking
from pharos.errors import (
    MessageTypeError,
    NodeStoppedError,
    UnknownNodeError,
)
from pharos.intraprocess.copier import copier_for
from pharos.intraprocess.workers import Inbox
from pharos.program import wait
from pharos.private_rospy.transport import by_kind

if TYPE_CHECKING:
    from pharos.master import Master
    from pharos.node import Node

QUEUE_SIZE = 1000


class Channel:
    """What both kinds of channel have.

    :ivar topic: the full name of the topic
    :ivar type: the name of its message type
    :ivar node: the node whose channel it is
    """

    node: Node
    end: Any = None  # rospy's Publisher or Subscriber

    def _begin(self, node: Node, topic: str, message_class: type) -> None:
        self.node, self.topic = node, topic
        self.message_class, self.type = message_class, message_class._type
        self.closed = True
        node.remember(self)

    @property
    def is_open(self) -> bool:
        """True if it receives or sends: the node runs, and it was not closed."""
        return not self.closed

    def _connections(self) -> list[Any]:
        impl = self.end and self.end.impl
        if not impl or impl.closed:
            return []
        impl.check()  # rospy looks now and then who has left (ros_comm #927)
        return impl.connections

    def close(self) -> None:
        """Receive or send no more, and unregister."""
        self.node.forget(self)
        if not self.closed:
            self.closed = True
            self.end.unregister()

    def node_stopped(self) -> None:
        """Take note that rospy has closed it."""
        self.closed = True

    def __repr__(self) -> str:
        state = 'closed ' if self.closed else ''
        return f'<{state}{type(self).__name__} {self.topic} ({self.type}) of {self.node.name}>'


class InputChannel(Channel, Inbox):
    """The end of a topic at which a node receives; see :meth:`Node.interested_in`.

    :ivar received: how many messages the delegate was run on
    :ivar dropped: how many were dropped since the queue was full
    """

    def __init__(self, node, topic, message_class, delegate, queue_size, inline, shared, from_):
        Inbox.__init__(self, node.run.turns, self._deliver, queue_size, inline, shared)
        self.queue_bytes, self.received, self.from_ = node.queue_bytes, 0, from_
        self.delegate = delegate
        self._begin(node, topic, message_class)
        self.open()

    @property
    def delegate(self) -> Block | None:
        """The block run for each message, as ``block(message, channel)`` or ``block(message)``.

        None: the node's. One that is set takes effect with the next message.
        """
        return self._delegate

    @delegate.setter
    def delegate(self, block: Block | None) -> None:
        self._runs = taking(block, 'delegate', 2, 1)
        self._delegate = block

    def open(self) -> None:
        """Subscribe. Called again after the node was stopped and started."""
        node, topic = self.node, self.topic
        self.turns, self.closed = node.run.turns, False
        self.end = node.ros.Subscriber(topic, self.message_class, self)

    def __call__(self, message):
        """Take a message; rospy calls this if nobody has made it an Inbox."""
        self.receive(message, 0)

    def _deliver(self, message: genpy.Message) -> None:
        if self.closed or self.from_ and message._connection_header['callerid'] != self.from_:
            return
        self.received += 1
        block = self._runs or self.node._delegate_runs
        if block is None:
            return
        try:
            block(message, self)
        except BaseException as error:
            self.node.report(error, self.block, 'delegate', message, self, self.retry)

    @property
    def block(self) -> Block | None:
        """The delegate that is run: the channel's, or the node's."""
        return self._delegate or self.node.delegate

    def retry(self, message: genpy.Message) -> None:
        """Run the delegate on a message once more, in the node's turn."""
        self.node.check_running()
        self.turns.call(lambda: self._deliver(message))

    def rebind(self) -> None:
        self.delegate = rebound(self._delegate, self.node)

    @property
    def connections(self) -> list[tuple[str, str]]:
        """The peers: ``(name of the node, 'INTRAPROCESS' or 'TCPROS')``."""
        links, others = by_kind(self._connections())
        return [(link.caller, 'INTRAPROCESS') for link in links] + [
            (each.callerid_pub, each.transport_type) for each in others if each.header
        ]


class OutputChannel(Channel):
    """The end of a topic at which a node sends; see :meth:`Node.output_channel`.

    :ivar sent: how many messages were sent
    """

    def __init__(self, node, topic, message_class, latch, queue_size):
        self.latch, self.queue_size, self.sent = latch, queue_size, 0
        self._latched: Any = None
        self._impl: Any = None  # rospy's, of all its Publishers of the topic
        self._begin(node, topic, message_class)
        self.open()

    def open(self) -> None:
        """Advertise, and wait for the subscribers that the master knows."""
        node, topic = self.node, self.topic
        known = set(node.master.system_state()[1].get(topic, ()))
        self.end = node.ros.Publisher(
            topic, self.message_class, latch=self.latch, queue_size=self.queue_size
        )
        self._impl, self.closed = self.end.impl, False
        self._key = self if self.latch else False
        if self._latched is not None:
            self._impl.publish(self._latched, None, self._key)
        if known:
            self._wait_for(known)

    def _wait_for(self, names: set[str]) -> None:
        """Wait until these subscribers are connected: rospy loses what is sent before (#176).

        Who refuses a connection is dead. Who does not connect in time is named in the log.
        """
        deadline = time.monotonic() + self.node.connect_timeout

        def is_connected():
            return names <= {each.endpoint_id for each in self._impl.connections}

        while (left := deadline - time.monotonic()) > 0:
            if wait(is_connected, min(left, 0.5), self.node) or not self.node.is_running:
                return
            connected = {each.endpoint_id for each in self._impl.connections}
            names = {name for name in names - connected if self.node.master.may_live(name)}
        if names and self.node.connect_timeout:
            self.node.log(
                f'{self.topic}: {", ".join(sorted(names))} did not connect within'
                f' {self.node.connect_timeout:g} s, and may miss the first messages: can they reach'
                ' this host, and are they of the same type? A longer connect_timeout waits longer',
                'warning',
            )

    def publish(self, message: genpy.Message) -> None:
        """Send a message.

        :raises MessageTypeError: if it is of another type, or cannot be serialized
        :raises NodeStoppedError: if the channel is closed
        """
        if message.__class__ is not self.message_class:
            self._check_type(message)
        if self.closed:
            raise NodeStoppedError(f'{self!r} cannot send: open another one, or start the node')
        try:
            self._impl.publish(message, None, self._key)
        except Exception as error:
            self._publish_again(message, error)
        self.sent += 1

    def publish_to(self, message: genpy.Message, peer: str) -> None:
        """Send a message to one subscriber alone, by its full name."""
        self._check_type(message)
        connection = self._link_to(peer)
        if connection is None and peer in Topic(self.node.master, self.topic).subscribers:
            connection = wait(lambda: self._link_to(peer), self.node.connect_timeout, self.node)
        if connection is None:
            raise UnknownNodeError(
                f'{peer} is not interested in {self.topic}: rostopic info {self.topic} tells who is'
            )
        try:
            self._impl.publish(message, connection)
        except Exception as error:
            raise messages.explain(message, error) from error
        self.sent += 1

    def _link_to(self, peer: str) -> Any:
        return next((each for each in self._connections() if each.endpoint_id == peer), None)

    def _check_type(self, message: Any) -> None:
        if getattr(message, '_md5sum', None) != self.message_class._md5sum and not (
            isinstance(message, genpy.Message) and message._md5sum == '*'
        ):
            found = getattr(message, '_type', repr(message)[:80])
            raise MessageTypeError(f'{self.topic} carries {self.type}, not {found}')

    def _publish_again(self, message: genpy.Message, error: Exception) -> None:
        """Publish what failed once more, if it held numpy arrays, or raise what is wrong."""
        if self.closed or self._impl.closed:
            raise NodeStoppedError(f'{self!r} was closed while it sent') from error
        if not messages.convert_numpy(message):
            raise messages.explain(message, error) from error
        try:
            self._impl.publish(message, None, self._key)
        except Exception as again:
            raise messages.explain(message, again) from again

    def send(self, block: Any = None, *, to: Any = None, **fields: Any) -> genpy.Message:
        """Fill a new message by ``block(message)`` and keywords, or take a ready one; send it.

        :param to: the node that alone gets it: a name, Node or ExternalNode
        :returns: the message
        """
        message = messages.build(self.message_class, block, fields)
        if to is not None:
            self.publish_to(message, self.node.peer_name(to))
            return message
        if not self._impl.connections and not self.closed:
            self._check(message)
        self.publish(message)
        return message

    def _check(self, message: genpy.Message) -> None:
        """Raise what is wrong with a message that nobody receives."""
        try:
            copier_for(message.__class__)[0](message)
        except Exception as error:
            if not messages.convert_numpy(message):
                raise messages.explain(message, error) from error

    def close(self) -> None:
        """Send no more, once what was published is with the sockets; unregister."""
        if not self.closed:
            self._impl.latches.pop(self, None)
            deadline = time.monotonic() + self.node.stop_timeout
            for sender in by_kind(self._impl.connections)[1] if self._impl.ref_count == 1 else ():
                sender.flush(deadline)
        super().close()

    def node_stopped(self) -> None:
        super().node_stopped()
        frozen = self._impl and self._impl.latches.get(self)
        self._latched = None if frozen is None else self._impl.thaw(frozen)

    def rebind(self) -> None:
        """Do nothing: it has no blocks."""

    @property
    def connections(self) -> list[tuple[str, str]]:
        """The peers: ``(name of the node, 'INTRAPROCESS' or 'TCPROS')``."""
        return [(each.endpoint_id, each.transport_type) for each in self._connections()]

    def wait_for_subscribers(self, count: int = 1, timeout: float | None = None) -> bool:
        """Wait until so many subscribers are connected; True if they are.

        :param timeout: seconds, None: without limit
        """
        return bool(wait(lambda: len(self.connections) >= count, timeout, self.node))


def refuses(uri: str) -> bool:
    """True if nobody listens at a URI."""
    parts = urllib.parse.urlsplit(uri)
    try:
        socket.create_connection((parts.hostname, parts.port), 0.5).close()
    except ConnectionRefusedError:
        return True
    except OSError:
        pass
    return False


class Topic:
    """A topic of a master: the named bus, which hands nodes their channels.

    :ivar name: its full name
    """

    def __init__(self, master: Master, name: str):
        self.master, self.name = master, name

    @property
    def type(self) -> str | None:
        """The name of its message type, None if the master knows none."""
        return self.master.topic_type(self.name)

    @property
    def publishers(self) -> list[str]:
        """The names of the nodes that publish on it."""
        return self.master.system_state()[0].get(self.name, [])

    @property
    def subscribers(self) -> list[str]:
        """The names of the nodes that receive from it."""
        return self.master.system_state()[1].get(self.name, [])

    @property
    def channels(self) -> list[Channel]:
        """The channels of nodes of this process."""
        nodes = self.master.own_nodes()
        return [each for node in nodes for each in node.channels if each.topic == self.name]

    def input_channel(self, node: Node, typed_as: Any = None, **options: Any) -> InputChannel:
        """Hand a node its end to receive at; see :meth:`Node.interested_in`."""
        return node.interested_in(self.name, typed_as, **options)

    def output_channel(self, node: Node, typed_as: Any = None, **options: Any) -> OutputChannel:
        """Hand a node its end to send at; see :meth:`Node.output_channel`."""
        return node.output_channel(self.name, typed_as, **options)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Topic) and (self.master, self.name) == (other.master, other.name)

    def __hash__(self) -> int:
        return hash((self.master, self.name))

    def __repr__(self) -> str:
        return f'<Topic {self.name} of {self.master.url}>'
