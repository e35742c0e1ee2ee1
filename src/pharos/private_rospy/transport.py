"""Connect topics: INTRAPROCESS links, publishing, and receiving from sockets.

A link is two ends, one in the list of connections of rospy's publisher and one in that of its
subscription. rospy itself lists links, closes them, and refuses a second one to the same peer.
"""
import collections
import contextlib
import functools
import io
import socket
import struct
import threading
import time

import rospy
from rospy.impl.transport import Transport
from rospy.msg import serialize_message
from rospy.names import TOPIC_ANYTYPE

from pharos.intraprocess.copier import copied, copier_for, thawer
from pharos.intraprocess.workers import Inbox, OwnTurns, hand_over

LARGEST_MESSAGE = 1_000_000_000  # bytes, as roscpp has it
INFINITE = float('inf')
SOCKET_BYTES = 6 << 20  # that the sockets between a publisher and a subscriber hold about
AT_ONCE = 256 << 10  # bytes of a message that a publisher writes itself; more would hold it up
_length = struct.Struct('<I')
#: the runs of this process by the URI of their node
runs = {}
guard = threading.Lock()  # of runs and their relays


def peer_of(connection):
    """Return the name of the node at the other end; None if it has not said it yet."""
    if connection.direction == 'o':
        return connection.endpoint_id
    return connection.header and connection.header['callerid']


class Link(Transport):
    """One end of a link; the publisher's has the ``inboxes`` of the subscription."""

    latch = None
    header = property(lambda self: self.publisher.header)
    callerid_pub = property(peer_of)  # actionlib asks for it
    # not counted for each message: to touch ten links takes as long as to run ten delegates
    stat_num_msg = property(lambda self: self.publisher.seq, lambda self, zero: None)

    def get_transport_info(self):
        return f'{self.transport_type} connection to [{self.endpoint_id}]'

    def close(self):
        """Close both ends: nothing else closes a link, a publisherUpdate closes no connection."""
        if not self.done:
            self.done = self.other.done = True
            for end in self, self.other:
                if end.cleanup_cb:
                    end.cleanup_cb(end)


def follow(run, topic, uri, subscription):
    """Link the subscription to the relay of the node that has the connection, and return True.

    If no node of this process has it, this one is to connect: make its relay, and return False.
    """
    key = topic, uri, subscription.data_class
    with guard:
        for other in runs.values():
            if key in other.relays:
                make_link(other.relays[key], uri, subscription, run, 'TCPROS')
                return True
        relay = run.modules.load('rospy.topics')._PublisherImpl(topic, subscription.data_class)
        relay.has_header = False  # keeps the publisher's header.seq
        run.relays[key] = relay
    return False


def end_share(run, topic, uri, subscription):
    """Close the relay of a connection that has ended, or never began: its followers connect anew."""
    with guard:
        relay = run.relays.pop((topic, uri, subscription.data_class), None)
        if not relay:
            return
        links = relay.connections
        relay.close()
    for link in links:
        link.run.start_thread(functools.partial(link.run.connect, topic, uri))


def link(sender, receiver, topic):
    """Link the publisher and the subscription of a topic of two runs of this process."""
    publisher, subscription = sender.topics.pubs.get(topic), receiver.topics.subs.get(topic)
    if not publisher or not subscription:
        return
    sent, wanted = publisher.data_class, subscription.data_class
    if wanted._md5sum not in (sent._md5sum, TOPIC_ANYTYPE):
        return receiver.node._refused(
            topic, f'{sender.name} publishes {sent._type}, not {wanted._type}'
        )
    with publisher.lock:
        if publisher.header is None:
            protocol = sender.modules.load('rospy.impl.tcpros_pubsub').TCPROSPub
            options = topic, sent, publisher.is_latch, publisher.headers
            publisher.header = protocol(*options).get_header_fields()
        make_link(publisher, sender.uri, subscription, receiver, 'INTRAPROCESS')


def make_link(publisher, uri, subscription, receiver, transport_type):
    """Link a publisher, which has a URI, and a subscription of the run ``receiver``."""
    with publisher.lock:
        out, end = Link('o', publisher.name), Link('i', publisher.name)
        out.endpoint_id, end.endpoint_id = receiver.name, uri
        out.other, end.other, out.inboxes = end, out, subscription.inboxes
        for each in out, end:
            each.publisher, each.run = publisher, receiver
            each.transport_type = transport_type
            each.thaw = thawer(publisher.data_class, subscription.data_class)
        with subscription.c_lock:
            if subscription.closed or publisher.closed or subscription.has_connection(uri):
                return
            subscription.add_connection(end)
        publisher.rospy_add_connection(out)
        for frozen in publisher.latches.values():
            for inbox in out.inboxes:
                inbox.put((frozen, out.thaw, out.header))
    for inbox in out.inboxes:
        inbox.turns.wake()


def local_service(name, uri):
    """Return the rospy.Service of a node of this process, or None."""
    for run in list(runs.values()):
        service = run.services.get_service(name)
        if service and service.uri == uri:
            return service


def shut(sock):
    """Have whoever reads from a socket find it closed."""
    with contextlib.suppress(OSError):
        sock.shutdown(socket.SHUT_RDWR)


class PublisherOverlay:
    """Methods for a node's own rospy.topics._PublisherImpl; ``rospy_NAME`` is rospy's method.

    rospy serializes for all, latches the user's object, one for all Publishers of a topic, and keeps
    what did not serialize in its buffer, which corrupts the next message.
    """

    def __init__(self, name, data_class):
        self.rospy___init__(name, data_class)
        self.lock, self.latches, self.last_wake = self.publock, {}, 0.0
        self.freeze, self.thaw = copier_for(data_class)
        self.has_header = getattr(data_class, '_has_header', False)
        self.seen = self.header = None

    def acquire(self):
        """Wait while a signal is handled. publish() locks, but not while it runs inline delegates."""
        if self.resolved_name != '/rosout':  # the log's lock is held
            self.run.checkpoint()

    def release(self):
        """Do nothing."""

    def enable_latch(self):  # rospy calls it after registering, when links may exist
        self.is_latch = True
        if self.header:
            self.header['latching'] = '1'

    def add_connection(self, connection):
        with self.lock:
            self.rospy_add_connection(connection)
            for frozen in list(self.latches.values()):
                self.write(self.thaw(frozen), self.connections[-1:])
        return True

    def remove_connection(self, connection):
        if not self.closed:  # else rospy trips over what the close has taken away
            self.rospy_remove_connection(connection)

    def publish(self, message, connection_override=None, latch_key=None):
        """Publish to the links, then to the sockets.

        :param latch_key: whose latch it is, if the topic latches; False: nobody's; None: of plain rospy
        """
        with self.lock:
            if self.closed:
                if latch_key is None and self.run.stopping.is_set():  # rospy's ends quietly, too
                    return False
                raise rospy.ROSException('publish() to a closed topic')
            self.seq += 1
            if connection_override is None:
                if self.connections is not self.seen:
                    self.seen = self.connections
                    self.receivers = receivers_of(self.connections)
                inboxes, inline, others, remote = self.receivers
            else:
                inboxes, inline, others, remote = receivers_of([connection_override])
            if self.has_header:  # as serialize_message does
                message.header.seq = self.seq
            is_latched = self.is_latch and latch_key is not False and connection_override is None
            if inboxes or is_latched or not remote:  # if nobody hears it, this checks it
                frozen = self.freeze(message)
                if is_latched:
                    self.latches[latch_key] = frozen
                for thaw, group in inboxes.items():
                    item = frozen, thaw, self.header
                    for inbox in group:
                        inbox.put((message, None, None) if inbox.shared else item)
            if remote:
                self.write(message, remote)
        for turns in inline:
            turns.run()
        if others:
            # for plain rospy, never wait for a receiver: actionlib keeps a goal after publish() only
            self.last_wake = hand_over(others, INFINITE if latch_key is None else self.last_wake)
        return True

    def write(self, message, connections):
        buffer = io.BytesIO()
        try:
            serialize_message(buffer, self.seq, message)
        except Exception:  # copying makes bytes of numpy's arrays, or says what is wrong
            return self.write(self.thaw(self.freeze(message)), connections)
        data = buffer.getvalue()
        self.message_data_sent += len(data)
        for connection in connections:
            try:
                connection.write_data(data)
            except Exception:  # its peer has gone
                connection.close()

    def flush(self, deadline):
        """Wait until all is with the sockets."""
        while any(getattr(each, 'busy', False) for each in self.connections):
            if time.monotonic() > deadline:
                break
            time.sleep(0.001)

    def close(self):
        close(self)
        self.headers, self.subscriber_listeners = {}, []


class PlainInbox(Inbox):
    """The messages that wait for the callbacks of plain rospy of a subscription."""

    def __init__(self, subscription):
        super().__init__(OwnTurns(), subscription.call_plain, subscription.queue_size)
        self.subscription = subscription
        self.queue_bytes = subscription.run.node.queue_bytes

    def most(self, size):
        """Let as many wait as with processes: in the queues of publishers, and in sockets."""
        connections = self.subscription.connections
        links = links_of(connections)
        sizes = [link.publisher.queue_size for link in links]
        is_bounded = all(sizes) and len(links) == len(connections)
        if self.queue_size != INFINITE or not sizes or not is_bounded:
            return super().most(size)  # nothing is lost between processes
        return sum(sizes) + max(1, min(SOCKET_BYTES, self.queue_bytes) // size)


class SubscriptionOverlay:
    """Methods for a node's own rospy.topics._SubscriberImpl.

    Callbacks that are an Inbox get messages directly. All others of a topic share one, and run one
    after another. Those of two topics run side by side: one may wait for the other.
    """

    def __init__(self, name, data_class):
        self.rospy___init__(name, data_class)
        self.tcp_nodelay, self.inboxes, self.plain = True, [], None

    def find_inboxes(self):
        """Find the inboxes of all callbacks anew, have the publishers do so, and return the links."""
        callbacks = self.callbacks or ()
        found = [callback for callback, _ in callbacks if isinstance(callback, Inbox)]
        if len(found) < len(callbacks):
            self.plain = self.plain or PlainInbox(self)
            found.append(self.plain)
        self.inboxes[:] = found  # the links have this very list
        links = links_of(self.connections)
        for link in links:
            link.publisher.seen = None
        return links

    def call_plain(self, message):
        for callback, args in self.callbacks or ():
            if not isinstance(callback, Inbox):
                with contextlib.suppress(SystemExit):  # it would end a worker
                    self._invoke_callback(message, callback, args)

    def add_callback(self, callback, args):
        self.rospy_add_callback(callback, args)
        for link in self.find_inboxes():
            for frozen in list(link.publisher.latches.values()):
                message = link.thaw(frozen)
                message._connection_header = link.header
                self._invoke_callback(message, callback, args)
        self.run.connect_all(self.resolved_name)

    def remove_callback(self, callback, args):
        self.rospy_remove_callback(callback, args)
        self.find_inboxes()

    def close(self):
        close(self)
        if self.plain:
            self.plain.turns.close(0)


def links_of(connections):
    """Return the links of some connections."""
    return [each for each in connections if isinstance(each, Link)]


def receivers_of(connections):
    """Find who gets what is published to some connections.

    :returns: lists of inboxes by the function that thaws for them, the Turns of those that are
        inline, the Turns of the others, and the connections that are no links
    """
    inboxes, links = {}, links_of(connections)
    for link in links:
        inboxes[link.thaw] = inboxes.get(link.thaw, []) + link.inboxes
    found = sum(inboxes.values(), [])
    inline = [each.turns for each in found if each.inline]
    others = [each.turns for each in found if not each.inline]
    return inboxes, inline, others, [each for each in connections if each not in links]


def close(impl):
    """Close a publisher or subscription: links without rospy's lock, then all else, then its epoll."""
    for link in links_of(impl.connections):
        link.close()
    impl.rospy_close()
    impl.connection_poll.poller.close()


def keep_alive(sock):
    """Have a connection break within 30 s if the other host has silently gone."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option in (socket.TCP_KEEPIDLE, 10), (socket.TCP_KEEPINTVL, 5), (socket.TCP_KEEPCNT, 4):
        sock.setsockopt(socket.IPPROTO_TCP, *option)


def receive(connection, address, port, uri, subscription, run):
    """Connect to a publisher and receive its messages until the connection ends."""
    connection.connect(address, port, uri, timeout=10.0)
    sock = connection.socket
    keep_alive(sock)
    run.sockets.add(sock)
    sock.settimeout(None)
    cls, header = subscription.data_class, connection.header
    relay = run.relays.get((subscription.resolved_name, uri, cls))
    if relay:
        relay.header, relay.is_latch = header, connection.is_latched
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
            message = cls().deserialize(data)
            logger = subscription.statistics_logger
            if logger:
                logger.callback(message, connection.callerid_pub, connection.stat_bytes)
            if relay:
                relay.publish(message)
            inboxes = [*subscription.inboxes]
            copies = [copied(message) for _ in inboxes[1:]]  # which share its bytes
            for each, inbox in zip([message, *copies], inboxes):
                each._connection_header = header
                inbox.receive(each, size)
            if connection.is_latched:
                connection.latch = message


class Sender:
    """A bounded queue before a connection. A thread writes what the socket does not take at once, and ends.

    Stands in for rospy's QueuedConnection, whose thread writes everything, and takes all out of its
    queue at once, so that it neither bounds nor flushes it.
    """

    busy = False
    _rest = b''  # of a message whose beginning the socket has

    def __init__(self, connection, queue_size, run):
        self._connection, self._limit = connection, queue_size or INFINITE
        self._queue = collections.deque()
        self._lock, self._run = threading.Lock(), run

    def __getattr__(self, name):
        return getattr(self._connection, name)

    def write_data(self, data):
        """Send a message with its length; never waits for the subscriber."""
        connection = self._connection
        with self._lock:
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
                limit = min(self._limit, max(1, self._run.node.queue_bytes // len(data)))
                while len(self._queue) > limit:
                    self._queue.popleft()
            if not self.busy:
                self.busy = True
                self._run.start_thread(self._send_all)
        time.sleep(0)  # or a busy publisher keeps the interpreter for 5 ms

    def _send_all(self):
        connection = self._connection
        while True:
            with self._lock:
                self.busy = bool(self._rest or self._queue) and not connection.done
                if not self.busy:
                    return
                data, self._rest = self._rest or self._queue.popleft(), b''
            try:
                connection.write_data(data)
            except Exception:  # its peer has gone
                connection.close()
