"""Send to sockets and receive from them, and share a connection among the nodes of a process."""
import collections
import contextlib
import functools
import math
import os
import socket
import struct
import threading
import time

from pharos.intraprocess.links import link, runs, runs_lock

MAX_MESSAGE = 1_000_000_000  # bytes, as in roscpp
MAX_DIRECT = 2 << 20  # bytes; the write of a larger message would hold up the publisher
MAX_PARTS = 1024  # that a system call takes
LARGE_PART = 1 << 16  # bytes
THREAD_REST = 0.3  # seconds without a message until a sender's thread ends
CONNECT_LIMIT = 10.0  # seconds
CLOSED = OSError, AttributeError  # a connection that rospy has closed has no socket
_READ_BUFFER = 1 << 17  # bytes
_CREDENTIALS = struct.Struct('3i')  # numbers of the process, the user, and the group
_LENGTH = struct.Struct('<I')


def shutdown_socket(sock):
    """Shut a socket down, which wakes a thread that reads from the socket; close() wakes none."""
    with contextlib.suppress(OSError):
        sock.shutdown(socket.SHUT_RDWR)


def keep_alive(sock):
    """Have a connection break within 30 s if the other host has silently gone."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 10)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 5)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 4)


def check_user(sock):
    """Raise PermissionError if the process at the other end of a local socket has another user."""
    credentials = sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    _, user, _ = _CREDENTIALS.unpack(credentials)
    if user != os.getuid():
        raise PermissionError(f'a process of user {user}')


# -- receiving


def receive_until_end(run, subscription, connection, uri, receive_messages):
    """Receive messages until the connection ends, then connect again, or report a refusal."""
    topic = subscription.resolved_name
    reason = ''
    try:
        receive_messages()
    except Exception as error:
        reason = str(error)
    connection.close()
    close_relay(run, topic, uri, subscription)
    if 'md5sum' in reason or 'do not match' in reason:  # rospy compares the names of types, too
        run.report_refusal(topic, reason)
    elif not subscription.closed:
        run.connect_again(topic, uri, reason)


def receive(connection, address, port, uri, subscription, run):
    """Connect to a publisher and receive its messages until the connection ends.

    Each message goes to the relay of the connection, if there is one, and to all inboxes of the
    subscription. This runs in rospy's thread of the connection.

    :param connection: rospy's TCPROSTransport
    :param uri: the URI of the publisher's node
    :raises Exception: if the connection cannot be made or breaks, or a message cannot be read
    """
    connection.connect(address, port, uri, timeout=CONNECT_LIMIT)
    sock = connection.socket
    keep_alive(sock)
    run.sockets.add(sock)
    sock.settimeout(None)
    message_class = subscription.data_class
    subscription.begin_delivery(connection)
    with sock.makefile('rb', _READ_BUFFER) as stream:
        while not connection.done:
            data = _read_message(stream)
            if data is None:
                return
            message = message_class().deserialize(data)
            subscription.deliver(message, connection, len(data) + _LENGTH.size)


def _read_message(stream):
    """Return the bytes of the next message, None at the end of the stream."""
    head = stream.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    (size,) = _LENGTH.unpack(head)
    if size > MAX_MESSAGE:
        raise ValueError(f'it announces a message of {size} bytes')
    data = stream.read(size)
    if len(data) < size:
        return None
    return data


# -- sharing


def join_relay(run, topic, uri, subscription):
    """Link a subscription to the relay of a node of this process with a connection to a publisher.

    If no node of this process has such a connection, make a relay for this node. The caller then
    connects.

    :param uri: the URI of the publisher's node
    :returns: True if the subscription is linked, False if the caller must connect
    """
    key = topic, uri, subscription.data_class
    with runs_lock:
        for other in runs.values():
            if key in other.relays:
                relay = other.relays[key]
                link(relay, uri, subscription, run, relay.transport_type)
                return True
        relay = run.modules.load('rospy.topics')._PublisherImpl(topic, subscription.data_class)
        relay.transport_type = 'TCPROS'  # until begin_delivery() knows the connection's
        relay.has_header = False  # messages keep the publisher's header.seq
        run.relays[key] = relay
    return False


def close_relay(run, topic, uri, subscription):
    """Close the relay of a connection that has ended or failed; the linked nodes connect anew."""
    with runs_lock:
        relay = run.relays.pop((topic, uri, subscription.data_class), None)
        if not relay:
            return
        links = [*relay.connections]
        relay.close()
    for end in links:
        end.run.start_thread(functools.partial(end.run.connect, topic, uri))


# -- sending


class MessageParts(list):
    """The bytes of a message in parts. Large parts are not joined: that would copy them."""

    write = list.append  # genpy's serialize() calls this

    def with_length(self):
        """Return a list of parts with the length of the message in front, and the bytes of all."""
        size = sum(map(len, self))
        parts = []
        small_parts = [_LENGTH.pack(size)]
        for part in self:
            if len(part) < LARGE_PART:
                small_parts.append(part)
            else:
                parts += [b''.join(small_parts), part]
                small_parts = []
        parts.append(b''.join(small_parts))
        return parts, size + _LENGTH.size


class Sender:
    """A connection to a subscriber, with a bounded queue for messages that must wait.

    Stands in for rospy's QueuedConnection. rospy's thread writes everything, and takes all messages
    out of the queue at once: the queue is neither bounded nor flushed. Here the publisher writes,
    and a thread writes the rest. The thread rests between messages: to start one takes long.

    :param publication: the PublisherOverlay; its queue_size is the number of messages that wait at
        most. 0: as many as the node's queue_bytes hold. None: the publisher waits for the socket,
        as in rospy. rospy sets the size after the first connections may have been made.
    :ivar is_busy: True while a thread writes the queue
    """

    is_busy = False
    _has_thread = False
    _rest = ()  # the parts of a message that the socket has not taken yet

    def __init__(self, connection, publication):
        self._connection = connection
        self._publication = publication
        self._queue = collections.deque()  # of lists of parts
        self._condition = threading.Condition()  # notified to wake the thread

    def __getattr__(self, name):
        return getattr(self._connection, name)

    def write_data(self, parts, size):
        """Send a message, or queue the rest if the socket is full.

        :param parts: the bytes of the message, with their length in front
        :param size: the number of bytes
        """
        with self._condition:
            if self._publication.queue_size is None:
                self._rest = [*self._rest, *parts]  # a signal may have ended an earlier call
                while self._rest:
                    self._send_rest()
                return
            if self.is_busy or size > MAX_DIRECT:
                self._enqueue(parts, size)
            else:
                self._rest = [*self._rest, *parts]
                with contextlib.suppress(BlockingIOError):
                    self._send_rest(socket.MSG_DONTWAIT)
                if not self._rest:
                    return
            if not self.is_busy:
                self.is_busy = True
                self._wake_thread()
        time.sleep(0)  # let the thread run: a busy publisher keeps the interpreter for 5 ms

    def _enqueue(self, parts, size):
        self._queue.append(parts)
        queue_size = self._publication.queue_size or math.inf
        capacity = min(queue_size, max(1, self._publication.run.node.queue_bytes // size))
        while len(self._queue) > capacity:
            self._queue.popleft()

    def _wake_thread(self):
        if self._has_thread:
            self._condition.notify()
        else:
            self._has_thread = True
            self._publication.run.start_thread(self._send_queue)

    def _send_rest(self, flags=0):
        """Send the bytes that the socket takes, and keep the others."""
        parts = [*self._rest]
        sent_bytes = self._connection.socket.sendmsg(parts[:MAX_PARTS], [], flags)
        self._connection.stat_bytes += sent_bytes
        while parts and sent_bytes >= len(parts[0]):
            sent_bytes -= len(parts.pop(0))
        if parts:
            parts[0] = memoryview(parts[0])[sent_bytes:]
        else:
            self._connection.stat_num_msg += 1
        self._rest = parts

    def _send_queue(self):
        connection = self._connection
        while True:
            with self._condition:
                if not self._rest and not self._queue:
                    self.is_busy = False
                    self._condition.wait(THREAD_REST)
                if connection.done or not self.is_busy:
                    self.is_busy = False
                    self._has_thread = False
                    return
                if not self._rest:
                    self._rest = self._queue.popleft()
            try:
                self._send_rest()
            except CLOSED:
                connection.close()

    def close(self):
        """Close the connection, and end the thread."""
        self._connection.close()
        with self._condition:
            self._condition.notify()
