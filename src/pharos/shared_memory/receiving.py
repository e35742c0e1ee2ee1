"""Negotiate shared memory with processes of this package on this host, and receive by it.

rospy asks each protocol of a node for its offer, and a publisher takes the first offer that it
supports. roscpp and nodes of rospy alone do not know this protocol, and take TCPROS.
"""
from __future__ import annotations

import array
import contextlib
import functools
import mmap
import operator
import os
import select
import socket
import struct
import threading

from rosgraph.network import (
    ROSHandshakeException,
    decode_ros_handshake_header,
    encode_ros_handshake_header,
)
from rospy.impl.transport import ProtocolHandler

from pharos.private_rospy.tcpros import (
    accept_clients,
    check_user,
    end_connection,
    shutdown_socket,
)
from pharos.private_rospy.xmlrpc import UNREACHABLE, ServerProxy
from pharos.shared_memory.sending import (
    MAX_PACKET,
    NO_FILE,
    PACKET,
    WHOLE,
    MemorySender,
    MemoryTransport,
    MessageMemory,
    is_plain,
)
from pharos.transcript import attempt

PROTOCOL = 'PHAROS-SHM-2'
MAX_HEADER = 1 << 17  # bytes of a connection header
RECEIPT = b'\0'
MAX_MESSAGES = 100  # that are taken before the first one is delivered
IDLE_PERIOD = 1.0  # seconds between two looks if a connection is left
_lock = threading.Lock()  # held while a listener is made, and the reader's thread starts or ends
_DESCRIPTOR_SIZE = array.array('i').itemsize


@functools.lru_cache(None)
def host_and_user() -> list[str | int]:
    """Return values that are equal for processes that may share memory."""
    with open('/proc/sys/kernel/random/boot_id') as file:
        return [file.read().strip(), os.getuid()]


class SharedMemoryHandler(ProtocolHandler):
    """The protocol of a node. The first reader that asks makes its socket."""

    def __init__(self, run) -> None:
        self.run = run
        self._listener: socket.socket | None = None

    def supports(self, protocol: str) -> bool:
        return protocol == PROTOCOL

    def get_supported(self) -> list[list]:
        return [[PROTOCOL, *host_and_user()]]

    @property
    def _tcpros_handler(self):
        return self.run.ros_handler.protocol_handlers[-1]

    # -- publishers

    def init_publisher(self, topic: str, protocol: list) -> tuple[int, str, list]:
        """Answer with the name of the socket.

        Readers of another host or user get TCPROS, and so do all if the node lacks memory.
        """
        if protocol[1:] != host_and_user() or self.run.lacks_memory:
            return self._tcpros_handler.init_publisher(topic, ['TCPROS'])
        with _lock:
            if not self._listener:
                listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
                listener.bind('')  # the kernel chooses a name that is not in a file system
                listener.listen()
                self.run.sockets.add(listener)
                serve = functools.partial(accept_clients, listener, self.run.stopping, self._accept)
                if not self.run.start_thread(serve):
                    return self._tcpros_handler.init_publisher(topic, ['TCPROS'])
                self._listener = listener
        return 1, '', [PROTOCOL, self._listener.getsockname()[1:].decode()]

    def _accept(self, sock: socket.socket, address: object) -> None:
        self.run.sockets.add(sock)
        if not self.run.start_thread(functools.partial(self._add_reader, sock)):
            sock.close()

    def _add_reader(self, sock: socket.socket) -> None:
        """Shake hands, and add a connection to the publisher."""
        try:
            sock.settimeout(self.run.node.client_timeout)
            check_user(sock)
            header = decode_ros_handshake_header(sock.recv(MAX_HEADER))
            publisher = self.run.topic_manager.pubs.get(header['topic'])
            if not publisher or publisher.closed:
                answer = {'error': f'{self.run.name} does not publish {header["topic"]}'}
            elif header['md5sum'] != publisher.data_class._md5sum:
                sent_type = publisher.data_class._type
                answer = {'error': f'{self.run.name} publishes {sent_type}: another md5sum'}
            else:
                publisher.make_header()
                answer = publisher.header
            sock.send(encode_ros_handshake_header(answer))
            if 'error' in answer:
                raise ConnectionError
            sock.settimeout(None)
        except (OSError, LookupError, struct.error, ROSHandshakeException):
            sock.close()
            return
        with publisher.lock:
            if not publisher.memory:
                publisher.memory = MessageMemory(self.run)
            sender = MemorySender(publisher, header['callerid'], sock)
            publisher.add_connection(sender)

    # -- subscriptions

    def create_transport(self, topic: str, uri: str, answer: list) -> tuple[int, str, int]:
        """Connect to a publisher, or by TCPROS if its socket cannot be reached or the class is no plain one."""
        subscription = self.run.topic_manager.subs.get(topic)
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            if not is_plain(subscription.data_class):
                raise ConnectionError('a field would come as bytes alone')
            sock.connect(b'\0' + answer[1].encode())
            check_user(sock)
        except OSError:
            sock.close()
            return self._connect_by_tcpros(topic, uri)
        self.run.sockets.add(sock)
        connection = MemoryReceiver(topic, uri, sock, subscription)
        if not subscription.add_connection(connection):
            connection.close()
            return 0, 'the subscription was closed', 0
        connect = functools.partial(_reader.call, connection, connection.connect)
        if not self.run.start_thread(connect):
            connection.close()
            return 0, 'no thread is left', 0
        return 1, '', 0

    def _connect_by_tcpros(self, topic: str, uri: str) -> tuple[int, str, int]:
        offer = self._tcpros_handler.get_supported()
        try:
            code, text, answer = ServerProxy(uri).requestTopic(  # type: ignore[misc]
                self.run.name, topic, offer
            )
        except UNREACHABLE as error:
            return 0, str(error), 0
        if code != 1:
            return code, text, 0  # type: ignore[return-value]
        return self._tcpros_handler.create_transport(topic, uri, answer)


class Reader:
    """The thread that reads all connections of this process by shared memory.

    Each round takes some 100 messages (MAX_MESSAGES), and delivers those in the order of sending. If a
    socket has a message, all that was sent before is there, too, but for what waits in a publisher
    for a receipt. The thread waits for no callback.
    """

    def __init__(self) -> None:
        self._connections: dict[int, MemoryReceiver] = {}  # by their descriptor
        self._thread: threading.Thread | None = None
        # the key of a message, and its bytes
        self._last_copy: tuple[tuple | None, bytes] = None, b''

    def add(self, connection: MemoryReceiver) -> None:
        """Read a connection from now on."""
        with _lock:
            self._connections[connection.descriptor] = connection
            if not self._thread:
                self._epoll = select.epoll()
                thread = threading.Thread(target=self._read_all, name='pharos reader', daemon=True)
                thread.start()
                self._thread = thread
            # the connection may be read already, or another thread may have closed it
            with contextlib.suppress(OSError, ValueError):
                self._epoll.register(connection.descriptor, select.EPOLLIN)
            if connection.done:
                self.remove(connection)

    def remove(self, connection: MemoryReceiver) -> None:
        """Read a connection no more."""
        if self._connections.get(connection.descriptor) is connection:
            self._connections.pop(connection.descriptor, None)  # two threads may be here
            with contextlib.suppress(OSError, ValueError):
                self._epoll.unregister(connection.descriptor)

    def copy_once(self, key: tuple, memory: memoryview) -> bytes:
        """Return the bytes of a message in memory.

        One copy is for all nodes of this process, unless another large message is read in between.
        """
        if key != self._last_copy[0]:
            self._last_copy = key, bytes(memory)
        return self._last_copy[1]

    def _read_all(self) -> None:
        while True:
            messages = attempt(self._take_messages) or []
            for _, connection, deliver in sorted(messages, key=operator.itemgetter(0)):
                self.call(connection, deliver)
            self._last_copy = None, b''
            with _lock:
                if not self._connections:
                    self._epoll.close()
                    self._thread = None
                    return

    def _take_messages(self) -> list[tuple[float, MemoryReceiver, functools.partial]]:
        """Wait for messages, and return them as ``(time of sending, connection, deliver)``."""
        messages: list = []
        timeout = IDLE_PERIOD
        while len(messages) < MAX_MESSAGES:
            events = self._epoll.poll(timeout)
            if not events:
                break
            for descriptor, _ in events:
                connection = self._connections.get(descriptor)
                if connection:
                    message = self.call(connection, connection.read)
                    if message:
                        messages.append(message)
            timeout = 0  # take what is there, and wait no more
        return messages

    def call(self, connection: MemoryReceiver, function):
        """Call a function of a connection, and return the value; an error ends the connection."""
        try:
            return function()
        except BlockingIOError:
            pass
        except Exception as error:  # such as a message that does not deserialize
            connection.end(error)
        return None


_reader = Reader()


class MemoryReceiver(MemoryTransport):
    """The subscription's end of a connection."""

    is_latched = False
    latch = None
    header = None
    # the message of the last pause(): the reader takes several at a time, and all of them wait
    _last_held: object = None

    def __init__(self, topic: str, uri: str, sock: socket.socket, subscription) -> None:
        super().__init__('i', topic, uri, sock)
        self._subscription = subscription
        self.descriptor = sock.fileno()
        self._maps: dict[int, mmap.mmap] = {}  # by the position of the file

    def connect(self) -> None:
        """Shake hands, and have the reader receive the messages."""
        self._shake_hands(self._subscription.data_class, self._subscription.run)
        _reader.add(self)

    def read(self) -> tuple[float, MemoryReceiver, functools.partial]:
        """Return the next message as ``(time of sending, connection, deliver)``.

        :raises EOFError: at the end of the connection
        """
        packet, ancillary, flags, _ = self._socket.recvmsg(
            MAX_PACKET + PACKET.size, socket.CMSG_SPACE(_DESCRIPTOR_SIZE), socket.MSG_DONTWAIT
        )
        descriptors = array.array('i', b''.join(data for _, _, data in ancillary))
        try:
            if not packet:
                raise EOFError
            if flags & socket.MSG_CTRUNC:
                raise OSError('this process has no descriptor left for a memory file')
            position, slot, size, dropped, send_time = PACKET.unpack_from(packet)
            for descriptor in descriptors:
                self._maps[position] = mmap.mmap(descriptor, 0, prot=mmap.PROT_READ)
        finally:
            for descriptor in descriptors:
                os.close(descriptor)  # the map stays
        # either the message, or what is left of it without the large field in the file
        data = packet[PACKET.size :]
        value = b''
        if position != NO_FILE:
            memory = memoryview(self._maps[position])[:size]
            value = _reader.copy_once((self.endpoint_id, self.name, send_time), memory)
            self._socket.send(RECEIPT)  # fails if the publisher has given this reader up
        return send_time, self, functools.partial(self._deliver, data, slot, value, dropped)

    def _deliver(self, data: bytes, slot: int, value: bytes, dropped: int) -> None:
        message = self._subscription.data_class()
        if slot == WHOLE:
            message.deserialize(data or value)
        else:
            message.deserialize(data)
            setattr(message, message.__slots__[slot], value)
        for inbox in self._subscription.inboxes:
            inbox.count_dropped(dropped)
        self._subscription.deliver(message, self, len(data) + len(value))

    def pause(self, message: object) -> None:
        """Read no more until resume(): messages wait in the socket, and in the publisher."""
        self._last_held = message
        _reader.remove(self)

    def resume(self, message: object) -> None:
        """Read again, if the message is that of the last pause()."""
        if self._last_held is message and not self.done:
            _reader.add(self)

    def end(self, error: Exception) -> None:
        """Close the connection, and connect again, unless the subscription is closed."""
        end_connection(self._subscription, self, self.endpoint_id, str(error))

    def _shake_hands(self, message_class: type, run) -> None:
        """Exchange the headers of TCPROS.

        :raises ROSHandshakeException: if the publisher refuses
        """
        self._socket.settimeout(run.node.client_timeout)
        protocol_class = run.modules.load('rospy.impl.tcpros_pubsub').TCPROSSub
        fields = protocol_class(self.name, message_class).get_header_fields()
        self._socket.send(encode_ros_handshake_header(fields))
        header = decode_ros_handshake_header(self._socket.recv(MAX_HEADER))
        if 'error' in header:
            raise ROSHandshakeException(header['error'])
        self._socket.settimeout(None)
        self.header = header
        self.callerid_pub = header['callerid']
        self.is_latched = header.get('latching') == '1'

    def close(self) -> None:
        if not self.done:
            super().close()
            _reader.remove(self)
            shutdown_socket(self._socket)
            self._socket.close()
            self._maps.clear()
