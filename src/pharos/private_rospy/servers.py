"""A node's two servers, XML-RPC and TCPROS: bound where errors can be raised, safe from bad
clients, really closed."""
import io
import socket
import struct
import sys
import time

from pharos.private_rospy import xmlrpc_server
from pharos.private_rospy.acceptor import BACKLOG, Acceptor, brief
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.lifetime import shutdown_socket
from pharos.private_rospy.names import NAME_LIMIT
from pharos.intraprocess.sharing import numbered

HANDSHAKE_TIMEOUT = 5.0  # seconds for the whole handshake, however slowly it comes
HANDSHAKE_LIMIT = 1 << 20  # bytes of a connection header; real ones hold a message definition
MESSAGE_LIMIT = 1000000000  # bytes of a message; roscpp's limit

# the fields of a header that are shown to others
_NAMES = {'callerid', 'topic', 'service', 'type', 'md5sum'}
_CLIENT_GONE = rospy.exceptions.TransportTerminated, ConnectionResetError


def hooks(lifetime, warn, debug):
    """The load hooks of the two servers, for a node of that lifetime; ``warn(text)``,
    ``debug(text)`` write to its log."""

    def limit_handshake(module):
        """rosgraph.network: a peer that is silent, slow or announces 4 GiB is listened to for
        ever."""

        def read_ros_handshake_header(sock, buffer, size):
            deadline = time.monotonic() + HANDSHAKE_TIMEOUT
            try:
                while True:
                    left = deadline - time.monotonic()
                    if left <= 0:
                        raise module.ROSHandshakeException(
                            f'no handshake within {HANDSHAKE_TIMEOUT:g} s'
                        )
                    sock.settimeout(left)
                    received = sock.recv(size)
                    if not received:
                        raise module.ROSHandshakeException('connection closed within the handshake')
                    buffer.write(received)
                    if buffer.tell() < 4:
                        continue
                    length = 4 + struct.unpack_from('<I', buffer.getbuffer())[0]
                    if length > HANDSHAKE_LIMIT:
                        raise module.ROSHandshakeException(
                            'a handshake of %d bytes; the limit is %d' % (length, HANDSHAKE_LIMIT)
                        )
                    if buffer.tell() >= length:
                        break
            except socket.timeout:
                raise module.ROSHandshakeException(
                    f'no handshake within {HANDSHAKE_TIMEOUT:g} s'
                ) from None
            finally:
                try:
                    sock.settimeout(None)
                except OSError:
                    pass  # closed meanwhile
            data = buffer.getvalue()
            buffer.seek(0)
            buffer.truncate()
            buffer.write(data[length:])  # the first message may have come along
            header = module.decode_ros_handshake_header(data[:length])
            for field in _NAMES & header.keys():
                if len(header[field]) > NAME_LIMIT or not header[field].isprintable():
                    raise module.ROSHandshakeException(
                        f'{brief(header[field], 60)} can be no {field}'
                    )
            return header

        module.read_ros_handshake_header = read_ros_handshake_header

    def mend_connections(module):
        """rospy.impl.tcpros_base."""
        _accept_in_threads(module, Acceptor('TCPROS', lifetime, warn))
        _end_bad_connections(module, warn)
        # where it writes tracebacks, a line of the log says what is wrong
        module.rospyerr = module.rospydebug

    def mend_messages(module):
        """rospy.msg: it writes a traceback for each message that it cannot read, whoever sent
        it."""
        module.logging.getLogger('rospy.msg').setLevel(module.logging.CRITICAL)
        serialize = module.serialize_message
        # it would number what others hold
        module.serialize_message = lambda buffer, seq, message: serialize(
            buffer, seq, numbered(message, seq)
        )

    def expect_requests(module):
        """rospy.impl.tcpros_service: a client that asks nothing is waited for, and one that asks
        nonsense kept."""
        acceptor, service = Acceptor('service', lifetime, warn), module.ServiceImpl
        tell = service.error_handler

        def error_handler(self, error, *information):
            # that it did not wait for its answer is no error of ours
            if not isinstance(error, _CLIENT_GONE):
                tell(self, error, *information)

        service.error_handler = error_handler

        handle_request = service._handle_request

        def _handle_request(self, transport, request):
            """rospy leaves a caller without an answer where the handler raises what is no
            Exception."""
            try:
                handle_request(self, transport, request)
            except Exception:
                raise
            except BaseException as error:
                self.error_handler(error, *sys.exc_info())
                self._write_service_error(transport, f'error processing request: {error}')

        service._handle_request = _handle_request

        def handle(self, transport, header):
            sock, persistent = transport.socket, header.get('persistent', '').lower() in (
                '1',
                'true',
            )
            try:
                address = sock.getpeername()
                again = header.get('probe') != '1'
                while again:
                    if not persistent:  # a client that is may say nothing for long
                        acceptor.start_handshake(sock)
                    received = transport.receive_once()
                    acceptor.finish_handshake(sock)
                    for request in received:
                        self._handle_request(transport, request)
                    again = persistent
            except _Unreadable as error:
                acceptor.log_rejection(address, error)
            except rospy.exceptions.TransportTerminated as error:
                acceptor.reject(
                    sock, address, error
                )  # a persistent one is not expected, and may go
            except (OSError, rospy.exceptions.TransportInitError):
                pass  # it has gone; what would tell it of that finds the transport closed
            finally:
                acceptor.finish_handshake(sock)
                transport.close()

        service.handle = handle

    return {
        'rosgraph.network': limit_handshake,
        'rospy.impl.tcpros_base': mend_connections,
        'rospy.msg': mend_messages,
        'rospy.impl.tcpros_service': expect_requests,
        **xmlrpc_server.hooks(lifetime, warn, debug),
    }


def _accept_in_threads(module, acceptor):
    """rospy.impl.tcpros_base: one silent client keeps all others from connecting (ros_comm PR
    #1918)."""
    server, tcp = module.TCPROSServer, module.TCPServer
    tcp.run = lambda self: acceptor.accept(self.server_sock, self.inbound_handler)

    def shutdown(self):
        """close() alone does not wake accept(), and the port stays taken."""
        if not self.is_shutdown:
            self.is_shutdown = True
            shutdown_socket(self.server_sock)
            self.server_sock.close()

    tcp.shutdown = shutdown

    def shake_hands(self, sock, address):
        """rospy's logs tracebacks, and not whose fault it is."""
        header = module.read_ros_handshake_header(sock, io.BytesIO(), 4096)
        if 'topic' in header:
            refusal = self.topic_connection_handler(sock, address, header)
        elif 'service' in header:
            refusal = self.service_connection_handler(sock, address, header)
        else:
            refusal = 'no topic or service name detected'
        if refusal:
            if module.is_shutdown():
                refusal = 'node shutting down'
            module.write_ros_handshake_header(sock, {'error': str(refusal)})
            raise module.TransportInitError(f"{refusal} ({header.get('callerid', 'no caller id')})")

    server._tcp_server_callback = shake_hands


def _end_bad_connections(module, warn):
    """rospy.impl.tcpros_base: a stream that cannot be read is read on, and announcements of 4 GiB
    are believed."""
    transport, protocol = module.TCPROSTransport, module.TCPROSTransportProtocol
    receive, read = transport.receive_once, protocol.read_messages

    def read_messages(self, buffer, queue, sock):
        (size,) = struct.unpack_from('<I', buffer.getbuffer())
        if size > MESSAGE_LIMIT:
            raise module.TransportException(
                'a message of %d bytes; the limit is %d' % (size, MESSAGE_LIMIT)
            )
        read(self, buffer, queue, sock)

    protocol.read_messages = read_messages

    def receive_once(self):
        """A connection ends with the node, too: rospy's loop of a persistent service connection
        never does."""
        try:
            messages = receive(self)
        except module.TransportTerminated:
            raise
        except module.TransportException as error:
            # we are the client
            if self.dest_address and not self.done and not module.is_shutdown():
                warn(f'connection with {self.endpoint_id} for {self.name} closed: {brief(error)}')
            raise _Unreadable(str(error)) from None
        if not messages and module.is_shutdown():
            raise module.TransportTerminated('the node stops')
        return messages

    transport.receive_once = receive_once


class _Unreadable(rospy.exceptions.TransportTerminated):
    """What came cannot be read, so that nothing that comes after it can be."""


def listen(tcpros_base, port):
    """Open a node's TCPROS server now, in this thread; rospy does so at the first connection and
    prints errors."""
    server = tcpros_base.init_tcpros_server(port)
    server.tcp_ros_server = tcpros_base.TCPServer(server._tcp_server_callback, port)
    server.tcp_ros_server.server_sock.listen(BACKLOG)
    server.tcp_ros_server.start()
    return server.tcp_ros_server.port
