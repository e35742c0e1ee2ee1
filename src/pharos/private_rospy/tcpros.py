"""Send messages to sockets, and receive messages from sockets."""
import contextlib
import os
import select
import socket
import struct
import threading

from pharos.intraprocess.inboxes import BoundedQueue
from pharos.private_rospy import sharing
from pharos.private_rospy.connections import connect_later
from pharos.transcript import tell_once
from pharos.waiting import let_senders_run

MAX_MESSAGE = 1_000_000_000  # bytes, as in roscpp
MAX_DIRECT = 2 << 20  # bytes; the write of a larger message would hold up the publisher
MAX_PARTS = 1024  # that a system call takes
LARGE_PART = 1 << 16  # bytes
POLL_LIMIT = 1000  # milliseconds between two looks if the connection is closed
CONNECT_LIMIT = 10.0  # seconds
ACCEPT_PAUSE = 0.5  # seconds after an error
CLOSED = OSError, AttributeError, TypeError  # a connection that rospy has closed has no socket
_READ_BUFFER = 1 << 17  # bytes
_CREDENTIALS = struct.Struct('3i')  # numbers of the process, the user, and the group
_LENGTH = struct.Struct('<I')


def shutdown_socket(sock: socket.socket) -> None:
    """Shut a socket down, which wakes a thread that reads from the socket; close() wakes none."""
    with contextlib.suppress(OSError):
        sock.shutdown(socket.SHUT_RDWR)


def keep_alive(sock: socket.socket) -> None:
    """Have a connection break within 30 s if the other host has silently gone."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 10)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 5)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 4)


def check_user(sock: socket.socket) -> None:
    """Raise PermissionError if the process at the other end of a local socket has another user."""
    credentials = sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    _, user, _ = _CREDENTIALS.unpack(credentials)
    if user != os.getuid():
        raise PermissionError(f'a process of user {user}')


def accept_clients(listener: socket.socket, stopping: threading.Event, take) -> None:
    """Accept clients, and call ``take(sock, address)`` for each; tell errors, and try again.

    :param stopping: an Event that ends this; who sets it wakes accept() by shutdown_socket()
    """
    while not stopping.is_set():
        try:
            take(*listener.accept())
        except Exception as error:  # such as that no descriptor is left
            if not stopping.is_set():
                tell_once(error)
            stopping.wait(ACCEPT_PAUSE)


# -- receiving


def receive_until_end(connection, address, port, uri, subscription):
    """Receive from a publisher until the connection ends; then connect again, or report a refusal.

    This runs in rospy's thread of the connection.

    :param connection: rospy's TCPROSTransport
    :param uri: the URI of the publisher's node
    """
    reason = ''
    try:
        connection.connect(address, port, uri, timeout=CONNECT_LIMIT)
        _receive(connection, subscription)
    except Exception as error:
        reason = str(error)
    for each in sharing.end(connection) or [subscription]:
        end_connection(each, connection, uri, reason)


def end_connection(subscription, connection, uri, reason):
    """Remove a connection that has ended; connect again later, or report a refusal.

    :param reason: the text of the error that has ended the connection, or ''
    """
    topic = subscription.resolved_name
    subscription.remove_connection(connection)
    if 'md5sum' in reason or 'do not match' in reason:  # rospy compares the names of types, too
        subscription.run.report_refusal(topic, reason)
    elif not subscription.closed:
        connect_later(subscription, uri, reason)


def _receive(connection, subscription):
    """Receive the messages of a connection until its end.

    :raises Exception: if the connection breaks, or a message cannot be read
    """
    sock = connection.socket
    keep_alive(sock)
    if connection.share:  # it goes on after the stop of this run, if others hear it
        subscription.run.threads.discard(threading.current_thread())
    else:
        subscription.run.sockets.add(sock)
    sock.settimeout(None)
    message_class = subscription.data_class
    with sock.makefile('rb', _READ_BUFFER) as stream:
        while not connection.done:
            data = read_message(stream)
            if data is None:
                return
            message = message_class().deserialize(data)
            subscription.deliver(message, connection, len(data) + _LENGTH.size)


def read_message(stream):
    """Return the bytes of the next message, None at the end of the stream.

    :raises ConnectionError: if the length cannot be one
    """
    head = stream.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    (size,) = _LENGTH.unpack(head)
    if size > MAX_MESSAGE:
        raise ConnectionError(f'it announces a message of {size} bytes')
    data = stream.read(size)
    if len(data) < size:
        return None
    return data


# -- sending


class MessageParts(list):
    """The bytes of a message in parts. Large parts are not joined: that would copy them."""

    write = list.append  # genpy's serialize() calls this

    def with_length(self) -> tuple:
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


def send_while_waiting(sock: socket.socket, send) -> None:
    """Call ``send()`` until it returns None; before each further call, wait for the event that it returns."""
    poller = select.poll()
    event = send()
    while event:
        poller.register(sock, event)
        poller.poll(POLL_LIMIT)
        event = send()


class Sender(BoundedQueue):
    """A connection to a subscriber, with a bounded queue for messages that must wait.

    Stands in for rospy's QueuedConnection. rospy's thread writes everything, and takes all messages
    out of the queue at once: the queue is neither bounded nor flushed. Here the publisher writes, and
    while messages wait, a thread writes when the socket takes more. With a queue_size, each write takes the lock and
    never waits, so it does no harm if two threads write. All that is not here is the connection's,
    such as ``done`` and the counts.

    :param publication: the PublisherOverlay; BoundedQueue says what its queue_size means. rospy sets
        that after the first connections may have been made.
    """

    _has_thread = False  # True while a thread writes the queue

    def __init__(self, connection, publication):
        self._connection = connection
        self._publication = publication
        super().__init__()  # its messages are lists of parts
        self.queue_bytes = publication.run.node.queue_bytes
        # the parts of a message, and the numbers of bytes sent of them, which _send() adds to in C
        self._unsent = [], []
        # for `with`: in C, since the handler of a signal may raise between any two lines of Python
        self._lock = threading.RLock()

    def __getattr__(self, name):
        return getattr(self._connection, name)

    @property
    def is_busy(self) -> bool:
        """True while something waits for the socket."""
        return bool(self.messages or self._unsent_parts())

    def write_data(self, parts: list, size: int) -> None:
        """Send a message, or queue the rest if the socket is full.

        :param parts: the bytes of the message, with their length in front
        :param size: the number of bytes
        """
        with self._lock:
            self._write(parts, size)
        if self._has_thread:  # a publisher that computes would keep the interpreter
            let_senders_run()

    def _write(self, parts: list, size: int) -> None:
        self.queue_size = self._publication.queue_size
        if self.queue_size is None:
            self._unsent = self._unsent_parts() + parts, []
            while self._unsent_parts():
                self._send()
            return
        if self.is_busy or size > MAX_DIRECT:
            self.add(parts, size)
        else:
            self._unsent = parts, []
            with contextlib.suppress(BlockingIOError):
                self._send(socket.MSG_DONTWAIT)
        if self.is_busy and not self._has_thread:
            self._has_thread = self._publication.run.start_thread(self._send_queue) is not None

    def _send_ready(self) -> None:
        """Send what the socket takes."""
        # IndexError: the handler of a signal has published meanwhile, and so sent all
        with contextlib.suppress(BlockingIOError, IndexError):
            while self.is_busy:
                if not self._unsent_parts():
                    self._unsent = self.messages.popleft(), []
                self._send(socket.MSG_DONTWAIT)

    def _unsent_parts(self) -> list:
        """Return the parts that the socket has not taken yet."""
        parts, counts = self._unsent
        parts = [*parts]
        sent_bytes = sum(counts)
        while parts and sent_bytes >= len(parts[0]):
            sent_bytes -= len(parts.pop(0))
        if parts:
            parts[0] = memoryview(parts[0])[sent_bytes:]
        return parts

    def _send(self, flags: int = 0) -> None:
        """Have the socket take bytes, and keep their number.

        The handler of a signal may raise an exception between any two lines of Python: the next
        publish() then sends the rest. extend() sends and keeps the number in C.
        """
        _, counts = self._unsent
        counts.extend(
            map(self._connection.socket.sendmsg, [self._unsent_parts()[:MAX_PARTS]], [[]], [flags])
        )
        self._connection.stat_bytes += counts[-1]
        if not self._unsent_parts():
            self._connection.stat_num_msg += 1

    def _send_queue(self) -> None:
        try:
            send_while_waiting(self._connection.socket, self._send_rest)
        except CLOSED:
            self._connection.close()

    def _send_rest(self):
        """Send what the socket takes; return the event to wait for, None if that is all."""
        with self._lock:
            self._send_ready()
            self._has_thread = self.is_busy
            return select.POLLOUT if self._has_thread else None

    def close(self) -> None:
        """Close the connection, which ends the thread."""
        self._connection.close()
