"""Channels, the ends of a topic at which a node receives and sends; topics, which hand them out."""
from __future__ import annotations

import dataclasses
import time
from typing import TYPE_CHECKING, Any

from genpy import Message

from pharos import messages
from pharos.blocks import Block, Receiver
from pharos.errors import MessageTypeError, NodeStoppedError, UnknownNodeError
from pharos.intraprocess.workers import Inbox
from pharos.private_rospy.transport import peer_of
from pharos.program import wait

if TYPE_CHECKING:
    from pharos.master import Master
    from pharos.node import Node

QUEUE_SIZE = 1000


class Opened:
    """A thing that a node has opened: its stop closes it, its next start opens it again.

    :ivar node: the node
    :ivar closed: True if it was closed, or the node is stopped
    """

    node: Node
    closed = True
    delegate: Any = None  # its block or blocks
    end: Any = None  # rospy's Publisher, Subscriber or Service

    def open(self):
        """Have the subclass register it, by _open(); the node's next start calls this again."""
        self.node._master.call('getPid')  # raises if it does not answer
        self._open()
        self.node._opened = [*self.node._opened, self]
        self.closed = False

    def close(self) -> None:
        """Receive, send or offer no more, and unregister."""
        self.node._opened = [each for each in self.node._opened if each is not self]
        if not self.closed:
            self.closed = True
            self._close()

    def _close(self):
        self.end.unregister()


class Channel(Opened):
    """Either kind of channel.

    :ivar topic: the full name of the topic
    :ivar type: the name of its message type
    """

    def _begin(self, node, topic, message_class):
        self.node, self.topic = node, topic
        self.message_class, self.type = message_class, message_class._type
        self.open()

    def _connections(self):
        impl = self.end.impl
        if not impl or impl.closed:
            return []
        impl.check()  # rospy looks now and then who has left (ros_comm #927)
        with impl.c_lock:  # the watcher may be removing one
            return impl.connections

    @property
    def connections(self) -> list[tuple[str, str]]:
        """The peers: ``(name of the node, 'INTRAPROCESS' or 'TCPROS')``."""
        return [(peer_of(end), end.transport_type) for end in filter(peer_of, self._connections())]

    def __repr__(self):
        state = 'closed ' if self.closed else ''
        return f'<{state}{type(self).__name__} {self.topic} ({self.type}) of {self.node._name}>'


class InputChannel(Receiver, Channel, Inbox):
    """The end of a topic at which a node receives; see :meth:`Node.interested_in`.

    :ivar received: how many messages the delegate was run on
    :ivar dropped: how many were dropped since the queue was full
    """

    received = 0

    def __init__(self, node, topic, message_class, delegate, queue_size, inline, shared, from_):
        Inbox.__init__(self, None, self._deliver, queue_size, inline, shared)
        self.queue_bytes, self.from_ = node.queue_bytes, from_
        self.delegate = delegate
        self._begin(node, topic, message_class)

    def _open(self):
        self.queue.clear()  # what came while the node stopped was never scheduled
        self.turns, self.closed = self.node._run.turns, False
        self.end = self.node.ros.Subscriber(self.topic, self.message_class, self)

    def __call__(self, message):
        """Take a latched message; rospy calls this for a connection that was there before."""
        self.receive(message, 0)

    def _deliver(self, message):
        try:
            if self.closed or self.from_ and message._connection_header['callerid'] != self.from_:
                return
            self.received += 1
            delegate = self._delegate_runs or self.node._delegate_runs
            delegate and delegate(message, self)
        except BaseException as error:
            delegate = self.delegate or self.node.delegate
            self.node._report(error, delegate, 'delegate', message, self, self._retry)

    def _retry(self, message):
        """Run the delegate on a message once more, in the node's turn."""
        self.node._check_running()
        self.turns.call(lambda: self._deliver(message))


class OutputChannel(Channel):
    """The end of a topic at which a node sends; see :meth:`Node.output_channel`.

    :ivar sent: how many messages were sent
    """

    sent = 0

    def __init__(self, node, topic, message_class, latch=False, queue_size=QUEUE_SIZE):
        self.latch, self.queue_size = latch, queue_size
        self._key = latch and self  # its place in publisher.latches; False: keep nothing
        self._begin(node, topic, message_class)

    def open(self):
        """Advertise, and wait for the subscribers that the master knows."""
        known = set(Topic(self.node._master, self.topic).subscribers)
        latched = self.end and self._impl.latches.get(self)  # before the node stopped
        super().open()
        if latched is not None:
            self._impl.publish(self._impl.thaw(latched), None, self)
        self._wait_for(known)

    def _open(self):
        options = {'latch': self.latch, 'queue_size': self.queue_size}
        self.end = self.node.ros.Publisher(self.topic, self.message_class, **options)
        self._impl = self.end.impl

    def _wait_for(self, names):
        """Wait until these subscribers are connected: rospy loses what is sent before (#176).

        Who refuses a connection is dead. Who does not connect in time is named in the log.
        """
        node = self.node

        def missing():
            return names.difference(map(peer_of, self._impl.connections))

        names = set(filter(node._master.may_live, missing()))
        is_ready = wait(lambda: not missing(), node.connect_timeout, node)
        if not is_ready and node.connect_timeout and node.is_running:
            node.log(
                f'{self.topic}: {", ".join(sorted(missing()))} did not connect within'
                f' {node.connect_timeout:g} s, and may miss the first messages: can they reach'
                ' this host, and are they of the same type? A longer connect_timeout waits longer',
                'warning',
            )

    def publish(self, message: Message, connection=None) -> None:
        """Send a message.

        :param connection: to that one alone
        :raises MessageTypeError: if it is of another type, or cannot be serialized
        :raises NodeStoppedError: if the channel is closed
        """
        cls, kind = self.message_class, type(message)
        if kind is not cls and getattr(kind, '_md5sum', None) not in (cls._md5sum, '*'):
            found = getattr(kind, '_type', repr(message)[:80])
            raise MessageTypeError(f'{self.topic} carries {self.type}, not {found}')
        if self.closed:
            raise NodeStoppedError(f'{self!r} cannot send: open another one, or start the node')
        try:
            self._impl.publish(message, connection, self._key)
        except Exception as error:
            if self.closed:
                raise NodeStoppedError(f'{self!r} was closed while it sent') from error
            raise messages.explain(message, error) from error
        self.sent += 1

    def send(self, block=None, *, to=None, **fields) -> Message:
        """Fill a new message by ``block(message)`` and keywords, or take a ready one; send it.

        :param to: the node that alone gets it: a name, Node or ExternalNode
        :returns: the message
        """
        message = messages.build(self.message_class, block, fields)
        self.publish(message, to and self._connection_to(self.node._peer_name(to)))
        return message

    def _connection_to(self, peer):
        for each in self._connections():
            if peer_of(each) == peer:
                return each
        raise UnknownNodeError(
            f'{peer} is not connected to {self.topic}: rostopic info {self.topic} tells who is'
        )

    def close(self) -> None:
        """Send no more, once what was published is with the sockets; unregister."""
        if not self.closed:
            self._impl.latches.pop(self, None)
            if self._impl.ref_count == 1:
                self._impl.flush(time.monotonic() + self.node.stop_timeout)
        super().close()

    def wait_for_subscribers(self, count: int = 1, timeout: float | None = None) -> bool:
        """Wait until so many subscribers are connected; True if they are.

        :param timeout: seconds, None: without limit
        """
        return wait(lambda: len(self.connections) >= count, timeout, self.node)


@dataclasses.dataclass(frozen=True)
class Topic:
    """A topic of a master: the named bus, which hands nodes their channels.

    :ivar name: its full name
    """

    master: Master
    name: str

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
        ends = [each for node in self.master.own_nodes() for each in node.channels]
        return [each for each in ends if each.topic == self.name]

    def hz(self, seconds: float = 1.0):
        """Measure for some seconds how often messages come, and how large they are."""
        from pharos.live import watching

        return watching.measure(self, seconds)

    bw = hz

    @property
    def last(self) -> Message:
        """The latched or else the next message; TimeoutError if none comes within 3 s."""
        from pharos.live import watching

        return watching.last(self)

    def watch(self, count: int | None = None, block: Block | None = None) -> None:
        """Show the next messages, or run ``block(message)`` on them; None: until Ctrl-C."""
        from pharos.live import watching

        watching.watch(self, count, block)

    def plot(self, *fields: str, seconds: float = 5.0):
        """Return a matplotlib Figure of fields such as 'linear.x' over some seconds."""
        from pharos.live import watching

        return watching.plot(self, fields, seconds)

    def input_channel(self, node: Node, typed_as=None, **options) -> InputChannel:
        """Hand a node its end to receive at; see :meth:`Node.interested_in`."""
        return node.interested_in(self.name, typed_as, **options)

    def output_channel(self, node: Node, typed_as=None, **options) -> OutputChannel:
        """Hand a node its end to send at; see :meth:`Node.output_channel`."""
        return node.output_channel(self.name, typed_as, **options)
