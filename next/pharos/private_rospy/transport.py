"""What a topic's connections do here: INTRAPROCESS links, publishing, and receiving from sockets.

A link is two ends, one in the list of connections of rospy's publisher and one in that of its
subscription, so that rosnode info, closing and duplicates are rospy's own matter.
"""
from __future__ import annotations

import collections
import socket
import struct
import threading
import time
from typing import Any

import rospy
from rospy.names import TOPIC_ANYTYPE

from pharos.intraprocess.copier import copier_for, serialize, thawer
from pharos.intraprocess.workers import Inbox, Turns, hand_over

LARGEST_MESSAGE = 1_000_000_000  # bytes, as roscpp has it
AT_ONCE = 1 << 16  # bytes; copying more into the socket would hold up the publisher
CONNECT_LIMIT = 10.0  # seconds for one attempt to connect
RETRY_DELAY = 1.0  # seconds until the next one
_length = struct.Struct('<I')


def link_classes(transport: Any) -> tuple[type, type]:
    """Make the classes of a link's ends and of followers, transports of one node's rospy."""

    class Link(transport.Transport):
        """One end of a link; ``subscription`` is at the other one, if this is the publisher's."""

        transport_type = 'INTRAPROCESS'
        is_latched, header, subscription = False, None, None

        def get_transport_info(self):
            return f'INTRAPROCESS connection to [{self.endpoint_id}]'

        def close(self):
            """Close both ends; rospy never drops a link because of a publisherUpdate."""
            if not self.done:
                self.done = self.other.done = True
                for end in self, self.other:
                    if end.cleanup_cb:
                        end.cleanup_cb(end)

        @property
        def latch(self):
            """The latched messages, for a callback that comes later: a list."""
            return [self.thawed(frozen) for frozen in list(self.publisher.latches.values())]

        def thawed(self, frozen):
            message = self.thaw(frozen)
            message._connection_header = self.made_header()
            return message

        def made_header(self):
            """The connection header, as TCPROS has it; a publisher may latch after it was linked."""
            if self.header is None:
                cls, publisher = self.publisher.data_class, self.publisher
                self.header = {
                    'callerid': self.caller,
                    'topic': publisher.resolved_name,
                    'type': cls._type,
                    'md5sum': cls._md5sum,
                    'message_definition': cls._full_text,
                    'latching': str(int(publisher.is_latch)),
                    **publisher.headers,
                }
            return self.header

    class Follower(transport.Transport):
        """The share of a subscription in the connection of another node."""

        transport_type, latch = 'TCPROS', None
        header = property(lambda self: self.share.header)
        callerid_pub = property(lambda self: self.header['callerid'])

        def get_transport_info(self):
            return f'TCPROS connection of {self.share.leader.name}'

        def close(self):
            if not self.done:
                self.done = True
                self.share.followers = [each for each in self.share.followers if each is not self]
                self.cleanup_cb(self)

    return Link, Follower


class Share:
    """A connection to an external publisher that several nodes of this process share.

    The first that connects has it, and hands its messages to the ``followers``; when it ends, these
    connect anew.
    """

    def __init__(self, leader: Any):
        self.leader, self.followers, self.header = leader, [], {}


_shares: dict[tuple, Share] = {}
_share_guard = threading.Lock()


def follow(run: Any, topic: str, uri: str, subscription: Any) -> bool:
    """True if another node of this process has the connection, which the subscription now shares.

    If nobody has, this one is the first.
    """
    key = topic, uri, subscription.data_class
    with _share_guard:
        share = _shares.get(key)
        if share is None or share.leader in (None, run):
            _shares[key] = Share(run)
            return False
        follower = run.Follower('i', topic)
        follower.endpoint_id, follower.share, follower.run = uri, share, run
        follower.subscription = subscription
        subscription.add_connection(follower)
        share.followers = [*share.followers, follower]
    return True


def end_share(topic: str, uri: str, cls: type, run: Any) -> None:
    """Have those that share a connection that has ended connect anew."""
    with _share_guard:
        share = _shares.get((topic, uri, cls))
        if share is None or share.leader is not run:
            return
        del _shares[topic, uri, cls]
    for follower in share.followers:
        follower.close()
        if not follower.run.stopping.is_set():
            follower.run.start_thread(lambda run=follower.run: run.connect(topic, uri), 'connect')


def connect(sender: Any, receiver: Any, topic: str) -> str | None:
    """Link the publisher and the subscription of a topic of two runs of this process.

    :returns: why not, if their types differ
    """
    publisher, subscription = sender.topics.pubs.get(topic), receiver.topics.subs.get(topic)
    if not publisher or not subscription:
        return None
    sent, wanted = publisher.data_class, subscription.data_class
    if wanted._md5sum not in (sent._md5sum, TOPIC_ANYTYPE):
        return f'{sender.name} publishes {sent._type}, not {wanted._type}'
    with publisher.lock:
        out, end = sender.Link('o', topic), receiver.Link('i', topic)
        out.endpoint_id, end.endpoint_id = receiver.name, sender.uri
        out.other, end.other, out.subscription = end, out, subscription
        for each in out, end:
            each.publisher, each.thaw = publisher, thawer(sent, wanted)
            each.caller = each.callerid_pub = sender.name
        with subscription.c_lock:
            if subscription.closed or publisher.closed or subscription.has_connection(sender.uri):
                return None
            subscription.add_connection(end)
            inboxes = subscription.inboxes()
        publisher.rospy_add_connection(out)
        for inbox in inboxes if publisher.latches else ():
            for frozen in publisher.latches.values():
                inbox.put(frozen, out.thaw, out.made_header())
    for inbox in inboxes:
        inbox.turns.wake()
    return None


class PublisherOverlay:
    """What is set on a node's own rospy.topics._PublisherImpl; ``rospy_NAME`` is rospy's method.

    rospy serializes for all, latches the user's object, one for all Publishers of a topic, and keeps
    what did not serialize in its buffer, which corrupts the next message.
    """

    def __init__(self, name, data_class):
        self.rospy___init__(name, data_class)
        self.lock, self.latches, self.last_wake = self.publock, {}, 0.0
        self.freeze, self.thaw = copier_for(data_class)
        self.has_header = getattr(data_class, '_has_header', False)
        self.seen, self.links, self.remote = None, (), ()

    def acquire(self):
        """Do nothing: publish() locks, but not while it runs inline delegates."""

    release = acquire

    def add_connection(self, connection):
        with self.lock:
            self.rospy_add_connection(connection)
            for frozen in list(self.latches.values()):
                self.write(self.thaw(frozen), self.connections[-1:])
        return True

    def publish(self, message, connection_override=None, latch_key=None):
        """Publish to the links, then to the sockets.

        :param latch_key: whose latch it is, if the topic latches; False: nobody's
        """
        inboxes: list[Inbox] = []
        with self.lock:
            if self.closed:
                raise rospy.ROSException('publish() to a closed topic')
            if connection_override is None:
                self.seq += 1
                if self.has_header:
                    message.header.seq = self.seq
                    if message.header.frame_id is None:
                        message.header.frame_id = '0'
                if self.connections is not self.seen:
                    self.seen = self.connections
                    self.links, self.remote = by_kind(self.seen)
                links, remote = self.links, self.remote
            else:
                links, remote = by_kind([connection_override])
            is_latched = self.is_latch and latch_key is not False and connection_override is None
            if links or is_latched:
                frozen = self.freeze(message)
                if is_latched:
                    self.latches[latch_key] = frozen
                for link in links:
                    link.stat_num_msg += 1
                    thaw, header = link.thaw, link.header or link.made_header()
                    received = link.subscription.inboxes()
                    for inbox in received:
                        if inbox.shared:
                            inbox.put(message)
                        else:
                            inbox.put(frozen, thaw, header)
                    inboxes = [*inboxes, *received] if inboxes else received
            if remote:
                self.write(message, remote)
        if inboxes:
            self.last_wake = hand_over(inboxes, self.last_wake)
        return True

    def write(self, message, connections):
        data = serialize(message)
        data = _length.pack(len(data)) + data
        self.message_data_sent += len(data)
        for connection in connections:
            try:
                connection.write_data(data)
            except Exception:  # its peer has gone
                connection.close()

    def close(self):
        close_links(self)
        self.rospy_close()
        self.headers = {}


class SubscriptionOverlay:
    """What is set on a node's own rospy.topics._SubscriberImpl.

    Callbacks that are an Inbox get messages directly. All others of a topic share one, which takes
    turns by itself, for they may wait for each other.
    """

    def __init__(self, name, data_class):
        self.rospy___init__(name, data_class)
        self.tcp_nodelay, self.seen, self.known, self.plain = True, None, [], None

    def inboxes(self) -> list[Inbox]:
        """Return the inboxes of all callbacks; rospy makes another list if these change."""
        callbacks = self.callbacks
        if callbacks is not self.seen:
            known = [callback for callback, _ in callbacks or () if isinstance(callback, Inbox)]
            if callbacks and len(known) < len(callbacks):
                if self.plain is None:
                    self.plain = Inbox(Turns(self.name), self.call_plain, self.queue_size)
                known.append(self.plain)
            self.seen, self.known = callbacks, known
        return self.known

    def call_plain(self, message):
        for callback, args in self.callbacks or ():
            if not isinstance(callback, Inbox):
                self._invoke_callback(message, callback, args)

    def add_callback(self, callback, args):
        """Add it, and hand it what is latched: rospy's can miss that, or do it twice."""
        if self.closed:
            raise rospy.ROSException(f'subscriber [{self.resolved_name}] has been closed')
        with self.c_lock:
            self.callbacks = [*self.callbacks, (callback, args)]
            latched = [connection.latch for connection in self.connections]
        for messages in latched:
            for message in messages if isinstance(messages, list) else [messages]:
                if message is not None and isinstance(callback, Inbox):
                    callback.put(message)
                    callback.turns.wake()
                elif message is not None:
                    self._invoke_callback(message, callback, args)

    def close(self):
        close_links(self)
        self.rospy_close()
        if self.plain:
            self.plain.turns.close(0)


def by_kind(connections: list[Any]) -> tuple[list[Any], list[Any]]:
    """Return the links and the others of some connections."""
    links = [each for each in connections if each.transport_type == 'INTRAPROCESS']
    return links, [each for each in connections if each not in links]


def close_links(impl: Any) -> None:
    """Close the links of a publisher or subscription, before rospy closes it with its lock held."""
    for link in by_kind(impl.connections or [])[0]:
        link.close()


def keep_alive(sock: socket.socket) -> None:
    """Have a connection break within 30 s if the other host has silently gone."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 10)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 5)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 4)


def receive(
    connection: Any, address: str, port: int, uri: str, subscription: Any, run: Any
) -> None:
    """Connect to a publisher and receive its messages until the connection ends."""
    connection.connect(address, port, uri, timeout=CONNECT_LIMIT)
    sock = connection.socket
    if sock is None:
        return
    run.sockets.add(sock)
    sock.settimeout(None)
    cls, header = subscription.data_class, connection.header
    share = _shares.get((subscription.resolved_name, uri, cls))
    if share:
        share.header = header
    with sock.makefile('rb', 1 << 16) as stream:
        while not connection.done:
            head = stream.read(4)
            if len(head) < 4:
                return
            (size,) = _length.unpack(head)
            if size > LARGEST_MESSAGE:
                raise ValueError(f'it announces a message of {size} bytes')
            data = stream.read(size)
            if len(data) < size:
                return
            connection.stat_bytes += size + 4
            connection.stat_num_msg += 1
            message = None
            inboxes = subscription.inboxes()
            for follower in share.followers if share else ():
                inboxes = [*inboxes, *follower.subscription.inboxes()]
            for inbox in inboxes:
                message = cls().deserialize(data)
                message._connection_header = header
                inbox.receive(message, size)
            if connection.is_latched:
                connection.latch = message or cls().deserialize(data)
            if subscription.statistics_logger and message is not None:
                statistics = subscription.statistics_logger
                statistics.callback(message, connection.callerid_pub, connection.stat_bytes)


class Sender:
    """A bounded queue before a connection. A thread writes what the socket does not take at once.

    Stands in for rospy's QueuedConnection, whose thread writes everything, and takes all out of its
    queue at once, so that it neither bounds nor flushes it.
    """

    def __init__(self, connection: Any, queue_size: int | None, run: Any):
        self._connection, self._limit = connection, queue_size or float('inf')
        self._queue: collections.deque[bytes] = collections.deque()
        self._rest = b''  # of a message whose beginning the socket has
        self._changed = threading.Condition()
        self.busy = False
        run.start_thread(self._send_all, f'sender of {connection.name}')

    def __getattr__(self, name):
        return getattr(self._connection, name)

    def set_cleanup_callback(self, callback):
        def closed(connection):
            callback(connection)
            with self._changed:
                self._changed.notify_all()

        self._connection.set_cleanup_callback(closed)

    def write_data(self, data: bytes) -> None:
        """Send a message with its length; never waits for the subscriber."""
        connection = self._connection
        with self._changed:
            if not self.busy and len(data) <= AT_ONCE:
                try:
                    sent = connection.socket.send(data, socket.MSG_DONTWAIT)
                except BlockingIOError:
                    sent = 0
                connection.stat_bytes += sent
                if sent == len(data):
                    connection.stat_num_msg += 1
                    return
                self._rest = data[sent:]
            else:
                self._queue.append(data)
                limit = min(self._limit, max(1, Inbox.queue_bytes // len(data)))
                while len(self._queue) > limit:
                    self._queue.popleft()
            self.busy = True
            self._changed.notify_all()
        time.sleep(0)  # or a busy publisher keeps the interpreter for 5 ms

    def _send_all(self) -> None:
        connection = self._connection
        while True:
            with self._changed:
                while not (self._rest or self._queue or connection.done):
                    self.busy = False
                    self._changed.notify_all()
                    self._changed.wait()
                if connection.done:
                    self.busy = False
                    return
                data, self._rest = self._rest, b''
                data = data or self._queue.popleft()
            try:
                connection.write_data(data)
            except Exception:  # its peer has gone
                connection.close()

    def flush(self, deadline: float) -> None:
        """Wait until all is with the socket."""
        with self._changed:
            while self.busy and not self._connection.done and time.monotonic() < deadline:
                self._changed.wait(max(0.0, deadline - time.monotonic()))
