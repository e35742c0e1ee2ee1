"""Negotiate shared memory with processes of this package on this host, and receive by it.

rospy asks each protocol of a node for its offer, and a publisher takes the first offer that it
supports. roscpp and nodes of rospy alone do not know this protocol, and take TCPROS.
"""
import array
import functools
import mmap
import os
import socket
import struct
import threading

from rosgraph.network import (
    ROSHandshakeException,
    decode_ros_handshake_header,
    encode_ros_handshake_header,
)
from rospy.impl.transport import ProtocolHandler

from pharos.private_rospy.run import UNREACHABLE, ServerProxy
from pharos.private_rospy.tcpros import check_user, receive_until_end, shutdown_socket
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

PROTOCOL = 'PHAROS-SHM'
MAX_HEADER = 1 << 17  # bytes of a connection header
ACCEPT_PAUSE = 1.0  # seconds after an error
RECEIPT = b'\0'
_DESCRIPTOR_SIZE = array.array('i').itemsize


@functools.lru_cache(None)
def host_and_user():
    """Return values that are equal for processes that may share memory."""
    with open('/proc/sys/kernel/random/boot_id') as file:
        return [file.read().strip(), os.getuid()]


class SharedMemoryHandler(ProtocolHandler):
    """The protocol of a node. The first reader that asks makes its socket."""

    def __init__(self, run):
        self.run = run
        self._listener = None
        self._lock = threading.Lock()  # held while the socket is made

    def supports(self, protocol):
        return protocol == PROTOCOL

    def get_supported(self):
        return [[PROTOCOL, *host_and_user()]]

    @property
    def _tcpros_handler(self):
        return self.run.ros_handler.protocol_handlers[-1]

    # -- publishers

    def init_publisher(self, topic, protocol):
        """Answer with the name of the socket; readers of another host or user get TCPROS."""
        if protocol[1:] != host_and_user():
            return self._tcpros_handler.init_publisher(topic, ['TCPROS'])
        with self._lock:
            if not self._listener:
                self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
                self._listener.bind('')  # the kernel chooses a name that is not in a file system
                self._listener.listen()
                self.run.sockets.add(self._listener)
                self.run.start_thread(self._accept)
        return 1, '', [PROTOCOL, self._listener.getsockname()[1:].decode()]

    def _accept(self):
        while not self.run.stopping.is_set():
            try:
                sock, _ = self._listener.accept()
            except OSError:  # the stop has closed it, or no descriptor is left
                self.run.stopping.wait(ACCEPT_PAUSE)
                continue
            self.run.sockets.add(sock)
            self.run.start_thread(functools.partial(self._add_reader, sock))

    def _add_reader(self, sock):
        """Shake hands, and add a connection to the publisher."""
        sock.settimeout(self.run.node.client_timeout)
        try:
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
        except (OSError, LookupError, struct.error, ROSHandshakeException):
            sock.close()
            return
        if 'error' in answer:
            sock.close()
            return
        sock.settimeout(None)
        with publisher.lock:
            if not publisher.memory:
                publisher.memory = MessageMemory(self.run)
            sender = MemorySender(
                publisher.resolved_name,
                header['callerid'],
                sock,
                publisher.memory,
                publisher.queue_size,
            )
            publisher.add_connection(sender)

    # -- subscriptions

    def create_transport(self, topic, uri, answer):
        """Connect to a publisher, or by TCPROS if its socket cannot be reached."""
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
        connection = MemoryReceiver(topic, uri, sock)
        if not subscription.add_connection(connection):
            connection.close()
            return 0, 'the subscription was closed', 0
        receive = functools.partial(connection.receive, subscription, self.run)
        self.run.start_thread(
            functools.partial(receive_until_end, self.run, subscription, connection, uri, receive)
        )
        return 1, '', 0

    def _connect_by_tcpros(self, topic, uri):
        offer = self._tcpros_handler.get_supported()
        try:
            code, text, answer = ServerProxy(uri).requestTopic(self.run.name, topic, offer)
        except UNREACHABLE as error:
            return 0, str(error), 0
        if code != 1:
            return code, text, 0
        return self._tcpros_handler.create_transport(topic, uri, answer)


class MemoryReceiver(MemoryTransport):
    """The subscription's end of a connection."""

    is_latched = False
    latch = None
    header = None

    def __init__(self, topic, uri, sock):
        super().__init__('i', topic, uri, sock)
        self._maps = {}  # position -> map of a file

    def receive(self, subscription, run):
        """Shake hands, and receive messages until the connection ends."""
        message_class = subscription.data_class
        self._shake_hands(message_class, run)
        subscription.begin_delivery(self)
        while not self.done:
            packet, ancillary, flags, _ = self._socket.recvmsg(
                MAX_PACKET + PACKET.size, socket.CMSG_SPACE(_DESCRIPTOR_SIZE)
            )
            if not packet:
                return
            if flags & socket.MSG_CTRUNC:
                raise OSError('this process has no descriptor left for a memory file')
            position, slot, size, dropped = PACKET.unpack_from(packet)
            for _, _, descriptor in ancillary:
                self._map(position, descriptor)
            data = packet[PACKET.size :]
            if position == NO_FILE:
                message = message_class().deserialize(data)
            else:
                value = self._maps[position][:size]
                self._socket.send(RECEIPT)  # fails if the publisher has given this reader up
                if slot == WHOLE:
                    message = message_class().deserialize(value)
                else:
                    message = message_class().deserialize(data)
                    setattr(message, message.__slots__[slot], value)
            for inbox in subscription.inboxes:
                inbox.dropped += dropped
            subscription.deliver(message, self, len(data) + size)

    def _shake_hands(self, message_class, run):
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

    def _map(self, position, descriptor):
        """Map a file that came with a packet."""
        number = array.array('i', descriptor)[0]
        try:
            self._maps[position] = mmap.mmap(number, 0, prot=mmap.PROT_READ)
        finally:
            os.close(number)

    def close(self):
        if not self.done:
            super().close()
            shutdown_socket(self._socket)
            self._socket.close()
            self._maps.clear()
