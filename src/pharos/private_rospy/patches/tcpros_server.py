"""A node's TCPROS server: bound where errors can be raised, safe from bad clients, and closed."""
import contextlib
import io
import socket
import struct
import sys
import time

from pharos.intraprocess.sharing import numbered
from pharos.private_rospy.acceptor import BACKLOG, Acceptor, brief
from pharos.private_rospy.deadlines import seconds_left
from pharos.private_rospy.large_messages import LargeMessages
from pharos.private_rospy.lifetime import shutdown_socket
from pharos.private_rospy.names import NAME_LIMIT
from pharos.private_rospy.patches.table import patch, substitute
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.xmlrpc_server import answers_calls_of

HANDSHAKE_LIMIT = 1 << 20  # bytes of a connection header; real ones hold a message definition
MESSAGE_LIMIT = 1000000000  # bytes of a message; roscpp's limit

# the fields of a connection header that are shown to others
_SHOWN_FIELDS = {'callerid', 'topic', 'service', 'type', 'md5sum'}


class Unreadable(rospy.exceptions.TransportTerminated):
    """What came cannot be read, so that nothing that comes after it can be."""


def listen(tcpros_base, port):
    """Open a node's TCPROS server in this thread, where rospy does so at the first connection.

    :param tcpros_base: the node's ``rospy.impl.tcpros_base``
    :returns: the port
    :raises OSError: if it cannot be bound, of which rospy only prints a line
    """
    server = tcpros_base.init_tcpros_server(port)
    server.tcp_ros_server = tcpros_base.TCPServer(server._tcp_server_callback, port)
    server.tcp_ros_server.server_sock.listen(BACKLOG)
    server.tcp_ros_server.start()
    if tcpros_base.is_shutdown():  # since just now, where rospy found no server to shut down
        server.shutdown()
    return server.tcp_ros_server.port


@patch(
    'rosgraph.network',
    'read_ros_handshake_header',
    'listens for ever to a peer that is silent, slow or announces 4 GiB',
)
def read_ros_handshake_header(sock, b, buff_size, *, module, node):
    """Read the header of a connection within limits."""
    limit, length = node.limits.handshake_timeout, 4
    deadline = time.monotonic() + limit
    try:
        while b.tell() < length:
            sock.settimeout(seconds_left(deadline))
            received = sock.recv(buff_size)
            if not received:
                raise module.ROSHandshakeException('connection closed within the handshake')
            b.write(received)
            if b.tell() >= 4:
                length = 4 + struct.unpack_from('<I', b.getbuffer())[0]
            if length > HANDSHAKE_LIMIT:
                raise module.ROSHandshakeException(
                    f'a handshake of {length} bytes; the limit is {HANDSHAKE_LIMIT}'
                )
    except socket.timeout:
        raise module.ROSHandshakeException(f'no handshake within {limit:g} s') from None
    finally:
        with contextlib.suppress(OSError):  # closed meanwhile
            sock.settimeout(None)
    data = b.getvalue()
    b.seek(0)
    b.truncate()
    b.write(data[length:])  # the first message may have come along
    header = module.decode_ros_handshake_header(data[:length])
    for field in _SHOWN_FIELDS & header.keys():
        if len(header[field]) > NAME_LIMIT or not header[field].isprintable():
            raise module.ROSHandshakeException(f'{brief(header[field], 60)} can be no {field}')
    return header


@patch(
    'rospy.impl.tcpros_base',
    'TCPServer.run',
    'lets one silent client keep all others from connecting (ros_comm PR #1918)',
)
def accept_clients(self, *, node):
    """Let each client into a thread of its own, until the server is shut down."""
    # Closed by another thread, its descriptor could be another listener's when accept() gets it.
    with self.server_sock:
        Acceptor('TCPROS', node).accept(self.server_sock, self.inbound_handler)


@patch(
    'rospy.impl.tcpros_base',
    'TCPServer.shutdown',
    'closes the socket, which does not wake accept(), and the port stays taken',
)
def shutdown_server(self):
    """Wake the thread that accepts clients; it closes the socket."""
    self.is_shutdown = True
    shutdown_socket(self.server_sock)


@patch(
    'rospy.impl.tcpros_base',
    'TCPROSServer._tcp_server_callback',
    'logs tracebacks, and not whose fault it is',
)
def shake_hands(self, sock, client_addr, *, module):
    """Raise what is wrong with a client: the acceptor logs it."""
    header = module.read_ros_handshake_header(sock, io.BytesIO(), 4096)
    if 'topic' in header:
        refusal = self.topic_connection_handler(sock, client_addr, header)
    elif 'service' in header:
        refusal = self.service_connection_handler(sock, client_addr, header)
    else:
        refusal = 'no topic or service name detected'
    if refusal:
        if module.is_shutdown():
            refusal = 'node shutting down'
        module.write_ros_handshake_header(sock, {'error': str(refusal)})
        raise module.TransportInitError(f"{refusal} ({header.get('callerid', 'no caller id')})")


@substitute('rospy.impl.tcpros_base', 'rospyerr', 'logs tracebacks where a line says what is wrong')
def rospyerr(*, module):
    """The same for those who look for errors."""
    return module.rospydebug


@patch(
    'rospy.impl.tcpros_base',
    'TCPROSTransportProtocol.read_messages',
    'believes an announcement of 4 GiB, and copies a large message three times, into memory that it'
    ' asks the system for each time',
)
def read_messages(self, b, msg_queue, sock, *, module, original):
    """Refuse a message beyond the limit, and read one that the buffer does not hold past it."""
    (size,) = struct.unpack_from('<I', b.getbuffer())
    if size > MESSAGE_LIMIT:
        raise module.TransportException(f'a message of {size} bytes; the limit is {MESSAGE_LIMIT}')
    if self.direction != rospy.impl.transport.INBOUND:  # a service's, which its clients share
        original(self, b, msg_queue, sock)
        return
    large = getattr(self, 'large', None)
    if large is None:
        self.large = large = LargeMessages(self.buff_size)
    is_large = size > large.buff_size and b.tell() < 4 + size
    # the next is likely to be as large: read its length first, and all of it comes in one piece
    self.buff_size = 4 if is_large else large.buff_size
    if not is_large:
        original(self, b, msg_queue, sock)
        return
    data = large.read(b, size, sock)
    try:
        msg_queue.append(self.recv_data_class().deserialize(data))
    except Exception as error:  # as rospy's deserialize_messages
        raise module.DeserializationError(f'cannot deserialize: {error}') from error


@patch(
    'rospy.impl.tcpros_base',
    'TCPROSTransport.receive_once',
    'reads on what cannot be read, and lets no persistent service connection end with the node',
)
def receive_once(self, *, node, module, original):
    """End the connection where rospy would go on.

    :raises Unreadable: for what came
    """
    try:
        messages = original(self)
    except module.TransportTerminated:
        raise
    except module.TransportException as error:
        self.is_unreadable = True
        we_are_the_client = self.dest_address
        if we_are_the_client and not self.done and not module.is_shutdown():
            node.warn(f'connection with {self.endpoint_id} for {self.name} closed: {brief(error)}')
        raise Unreadable(str(error)) from None
    large = getattr(self.protocol, 'large', None)  # it is None where it was closed meanwhile
    if large is not None:
        self.stat_bytes += large.counted()
    if not messages and module.is_shutdown():
        raise module.TransportTerminated('the node stops')
    return messages


@patch('rospy.msg', 'serialize_message', 'numbers a message that others hold')
def serialize_message(b, seq, msg, *, original):
    """Number a copy of it."""
    original(b, seq, numbered(msg, seq))


@patch(
    'rospy.impl.tcpros_service',
    'ServiceImpl.error_handler',
    'takes it for an error that a client does not wait for its answer',
)
def report_service_error(self, e, exc_type, exc_value, tb, *, original):
    """Report what is an error of ours."""
    if not isinstance(e, (rospy.exceptions.TransportTerminated, ConnectionResetError)):
        original(self, e, exc_type, exc_value, tb)


@patch(
    'rospy.impl.tcpros_service',
    'ServiceImpl._handle_request',
    'leaves a caller without an answer where the handler raises what is no Exception',
)
def handle_request(self, transport, request, *, original):
    """Answer a SystemExit like any other error."""
    try:
        original(self, transport, request)
    except Exception:
        raise
    except BaseException as error:
        self.error_handler(error, *sys.exc_info())
        self._write_service_error(transport, f'error processing request: {error}')


@patch(
    'rospy.impl.tcpros_service',
    'ServiceImpl.handle',
    'waits for a client that asks nothing, and keeps one that asks nonsense',
)
def handle(self, transport, header, *, node):
    """Serve a client that has shaken hands, for one request unless it is persistent."""
    clients, sock = node.service_clients, transport.socket
    is_persistent = header.get('persistent', '').lower() in ('1', 'true')
    goes_on = header.get('probe') != '1'
    answers_calls_of(sock)
    try:
        address = sock.getpeername()
        while goes_on:
            if not is_persistent:  # one that is may say nothing for long
                clients.start_handshake(sock)
            requests = transport.receive_once()
            clients.finish_handshake(sock)
            for request in requests:
                self._handle_request(transport, request)
            goes_on = is_persistent
    except Unreadable as error:
        clients.log_rejection(address, error)
    except rospy.exceptions.TransportTerminated as error:
        clients.reject(sock, address, error)  # only where it was to ask something
    except (OSError, rospy.exceptions.TransportInitError):
        pass  # it has gone; what would tell it of that finds the transport closed
    finally:
        clients.finish_handshake(sock)
        transport.close()
