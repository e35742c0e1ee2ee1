"""A node's two servers, XML-RPC and TCPROS: bound where errors can be raised, safe from bad clients, really closed."""
import struct
import time

from pharos.private_rospy.lifetime import shut

HANDSHAKE_TIMEOUT = 5.0          # seconds for the whole handshake, however slowly it comes
HANDSHAKE_LIMIT = 1 << 20        # bytes of a connection header; real ones hold a message definition
REQUEST_TIMEOUT = 30.0           # seconds that an XML-RPC client may be silent
REQUEST_LIMIT = 8 << 20          # bytes of an XML-RPC request
BACKLOG = 128                    # connections waiting to be accepted


def hooks(lifetime):
    """The load hooks of this module, for a node of that lifetime."""

    def limit_requests(module):
        """rosgraph.xmlrpc: a request may be silent or huge for ever, and runs in a thread that nobody knows."""
        handler, server, node = module.SilenceableXMLRPCRequestHandler, module.ThreadingXMLRPCServer, module.XmlRpcNode
        handler.timeout = REQUEST_TIMEOUT
        handler.wbufsize = -1                       # one segment per answer, and no waiting for its
        handler.disable_nagle_algorithm = True      # acknowledgement: 40 ms a call otherwise
        do_post = handler.do_POST

        def post(self):
            if int(self.headers.get('content-length', 0)) > REQUEST_LIMIT:
                self.close_connection = True
                self.send_error(413)
            else:
                do_post(self)
        handler.do_POST = post

        def process_request(self, request, address):
            lifetime.hold(request)
            lifetime.start_thread(self.process_request_thread, (request, address), 'xmlrpc')
        server.process_request = process_request

        def start(self):
            """Bind here, in the caller's thread, where an error can be raised; rosgraph prints it in another."""
            lifetime.xmlrpc = self
            self._run_init()
            self.accepting = lifetime.start_thread(self.server.serve_forever, (None,), 'xmlrpc-accept')
        node.start = start

        def shutdown(self, reason):
            """rosgraph only closes the socket, on which serve_forever then spins (ros_comm #2238)."""
            self.is_shutdown = True
            server, handler, self.server, self.handler = self.server, self.handler, None, None
            if handler:
                handler._shutdown(reason)
            if server:
                server._BaseServer__shutdown_request = True
                shut(server.socket)      # wakes serve_forever, which then sees the request
                self.accepting.join()    # closed any earlier, the socket could not wake it any more
                server.server_close()
        node.shutdown = shutdown

    def limit_handshake(module):
        """rosgraph.network: a peer that is silent, slow or announces 4 GiB is listened to for ever."""

        def read_ros_handshake_header(sock, buffer, size):
            deadline = time.monotonic() + HANDSHAKE_TIMEOUT
            try:
                while True:
                    left = deadline - time.monotonic()
                    if left <= 0:
                        raise module.ROSHandshakeException('no handshake within %g s' % HANDSHAKE_TIMEOUT)
                    sock.settimeout(left)
                    received = sock.recv(size)
                    if not received:
                        raise module.ROSHandshakeException('connection closed within the handshake')
                    buffer.write(received)
                    data = buffer.getvalue()
                    if len(data) < 4:
                        continue
                    length = 4 + struct.unpack_from('<I', data)[0]
                    if length > HANDSHAKE_LIMIT:
                        raise module.ROSHandshakeException('a handshake of %d bytes; the limit is %d'
                                                           % (length, HANDSHAKE_LIMIT))
                    if len(data) >= length:
                        buffer.seek(0)
                        buffer.truncate()
                        buffer.write(data[length:])    # the first message may have come along
                        return module.decode_ros_handshake_header(data)
            finally:
                try:
                    sock.settimeout(None)
                except OSError:
                    pass    # closed meanwhile
        module.read_ros_handshake_header = read_ros_handshake_header

    def accept_in_threads(module):
        """rospy.impl.tcpros_base: one silent client keeps all others from connecting (ros_comm PR #1918)."""
        server, tcp = module.TCPROSServer, module.TCPServer
        handshake, create = server._tcp_server_callback, tcp._create_server_sock

        def handshake_in_thread(self, sock, address):
            lifetime.hold(sock)
            lifetime.start_thread(handshake, (self, sock, address), 'handshake')
        server._tcp_server_callback = handshake_in_thread

        def create_server_sock(self):
            sock = create(self)
            sock.listen(BACKLOG)
            return sock
        tcp._create_server_sock = create_server_sock

        def shutdown(self):
            """close() alone does not wake accept(), and the port stays taken."""
            if not self.is_shutdown:
                self.is_shutdown = True
                shut(self.server_sock)
                self.server_sock.close()
        tcp.shutdown = shutdown

    def end_with_the_node(module):
        """rospy.impl.tcpros_base: a persistent service connection loops for ever once the node is shut down."""
        transport = module.TCPROSTransport
        receive = transport.receive_once

        def receive_once(self):
            messages = receive(self)
            if not messages and module.is_shutdown():
                raise module.TransportTerminated('the node stops')
            return messages
        transport.receive_once = receive_once

    def mend_connections(module):
        accept_in_threads(module)
        end_with_the_node(module)

    return {'rosgraph.xmlrpc': limit_requests, 'rosgraph.network': limit_handshake,
            'rospy.impl.tcpros_base': mend_connections}


def listen(tcpros_base, port):
    """Open a node's TCPROS server now, in this thread; rospy does so at the first connection and prints errors."""
    server = tcpros_base.init_tcpros_server(port)
    server.tcp_ros_server = tcpros_base.TCPServer(server._tcp_server_callback, port)
    server.tcp_ros_server.start()
    return server.tcp_ros_server.port
