"""A node's XML-RPC server: who may say how much to it, and for how long."""
import io
import ipaddress
import socket
import threading
import time
import urllib.parse
import xml.parsers.expat
import xmlrpc.client

from pharos.private_rospy.acceptor import BACKLOG, Acceptor, brief
from pharos.private_rospy.lifetime import shutdown_socket
from pharos.private_rospy.loader import Substitute

REQUEST_TIMEOUT = 30.0  # seconds from one answer until the next request has come, however slowly
REQUEST_LIMIT = 8 << 20  # bytes of a request
LARGE_REQUEST = 1 << 16  # bytes; of requests beyond, only so many are held at a time:
LARGE_REQUESTS = 8

REFUSED = 'refused: '  # how an answer begins by which a node defends itself
# .client: the address of the client whose call this thread answers; .here: ours
_call = threading.local()


def hooks(lifetime, warn, debug):
    """The load hooks of this module, for a node of that lifetime; ``warn(text)``, ``debug(text)``
    write to its log."""

    def limit_requests(module):
        """rosgraph.xmlrpc: a request may be silent or huge for ever, and runs in a thread that
        nobody knows."""
        acceptor = Acceptor('XML-RPC', lifetime, warn)
        module.SilenceableXMLRPCRequestHandler = _request_handler(
            module.SilenceableXMLRPCRequestHandler, acceptor, lifetime
        )
        server, node = module.ThreadingXMLRPCServer, module.XmlRpcNode
        dispatch = server._dispatch

        def _dispatch(self, method, parameters):
            """Nothing in rospy says whose the calls were that it refused.

            A call that ROS's slave API answers with an error is the caller's affair: peers come too
            late, or try.
            """
            try:
                answer = dispatch(self, method, parameters)
            except Exception as error:
                acceptor.log_rejection(_call.client, f'call of {brief(method)}: {error}')
                raise
            if type(answer) is tuple and answer[0] < 1:
                if answer[1].startswith(REFUSED):
                    acceptor.log_rejection(
                        _call.client, f'call of {method}: {answer[1][len(REFUSED):]}'
                    )
                else:
                    client = '%s:%s' % _call.client[:2]
                    debug(f'XML-RPC client {client}: call of {method}: {brief(answer[1])}')
            return answer

        server._dispatch = _dispatch

        def serve(self, sock, address):
            try:
                self.finish_request(sock, address)
            finally:
                self.shutdown_request(sock)

        server.serve = serve

        def start(self):
            """Bind here, in the caller's thread, where an error can be raised; rosgraph prints it
            in another."""
            lifetime.xmlrpc = self
            self._run_init()
            self.server.socket.listen(BACKLOG)
            ways_in = self.server.socket, self.server.serve
            self.accepting = lifetime.start_thread(acceptor.accept, ways_in, 'xmlrpc-accept')

        node.start = start

        def shutdown(self, reason):
            """rosgraph only closes the socket, on which its thread then spins (ros_comm #2238)."""
            self.is_shutdown = True
            server, handler = self.server, self.handler
            self.server = self.handler = None  # first, for others take that for stopped
            if handler:
                handler._shutdown(reason)
            if server:
                shutdown_socket(server.socket)
                self.accepting.join()  # closed any earlier, the socket could not wake it any more
                server.server_close()
            lifetime.silent.set()

        node.shutdown = shutdown

    def leave_logged_to_the_server(module):
        """rospy.impl.masterslave: writes tracebacks of calls with wrong arguments, and not whose
        they were."""
        module._logger = Substitute(module._logger, error=module._logger.debug)

    return {
        'rosgraph.xmlrpc': limit_requests,
        'rospy.impl.masterslave': leave_logged_to_the_server,
    }


class _Reader(io.RawIOBase):
    """What a client sends, until the deadline of its request."""

    def __init__(self, sock):
        super().__init__()
        self._socket = sock

    def begin(self):
        """The next request is expected."""
        self.received, self._deadline = 0, time.monotonic() + REQUEST_TIMEOUT

    def readable(self):
        return True

    def readinto(self, buffer):
        left = self._deadline - time.monotonic()
        if left <= 0:
            raise socket.timeout('time is up')
        self._socket.settimeout(left)
        count = self._socket.recv_into(buffer)
        self.received += count
        return count


def _request_handler(base, acceptor, lifetime):
    """The class that serves one client, derived from rosgraph's."""
    large = threading.BoundedSemaphore(LARGE_REQUESTS)

    class Handler(base):
        """Reads a client's requests, within limits, and answers them."""

        def setup(self):
            self.connection, self.answered = self.request, False
            # one segment per answer, and no waiting for its acknowledgement: 40 ms a call otherwise
            self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.rfile, self.wfile = io.BufferedReader(
                _Reader(self.connection)
            ), self.connection.makefile('wb')

        def handle(self):
            self.close_connection = False
            try:
                while not self.close_connection:
                    acceptor.start_handshake(self.connection)
                    self.rfile.raw.begin()
                    self.waits_for_us = False
                    self.handle_one_request()
            except OSError as error:
                self.log_error('%s', error)

        def log_error(self, format, *args):
            # else it went, having nothing more to ask
            if self.rfile.raw.received or not self.answered:
                acceptor.reject(self.connection, self.client_address, format % args)

        def handle_expect_100(self):
            """The client is told to go on when its request is accepted."""
            self.waits_for_us = True
            return True

        def do_POST(self):
            length, headers = self.headers.get('content-length', ''), self.headers
            if not self.is_rpc_path_valid():
                self.send_error(404)
            elif not length.isdecimal() or 'transfer-encoding' in headers:
                self.send_error(411)
            elif len(length) > 10 or int(length) > REQUEST_LIMIT:
                self.send_error(
                    413, 'a request of %.20s bytes; the limit is %d' % (length, REQUEST_LIMIT)
                )
            elif 'content-encoding' in headers:  # what is small may become huge
                self.send_error(415)
            elif int(length) <= LARGE_REQUEST:
                self._answer(int(length))
            elif large.acquire(blocking=False):
                try:
                    self._answer(int(length))
                finally:
                    large.release()
            else:
                self.send_error(503, 'too many large requests at once')

        def _answer(self, length):
            if self.waits_for_us:
                super().handle_expect_100()
                self.wfile.flush()
            body = self.rfile.read(length)
            try:
                if len(body) < length:
                    raise ValueError('closed after %d of %d bytes' % (len(body), length))
                _refuse_entities(body)
                parameters, method = xmlrpc.client.loads(body)
            except Exception as error:  # xmlrpc raises whatever it is that it trips over
                self.send_error(
                    400, 'no XML-RPC call: ' + brief(error).encode('ascii', 'replace').decode()
                )
                return
            if not acceptor.finish_handshake(self.connection):
                self.close_connection = True
                return
            if method == 'shutdown':
                lifetime.untrack_socket(self.connection)
                self.close_connection = True
            _call.client, _call.here = self.client_address, self.connection.getsockname()
            try:
                answer = xmlrpc.client.dumps(
                    (self.server._dispatch(method, parameters),), methodresponse=True
                )
            except Exception as error:
                answer = xmlrpc.client.dumps(
                    xmlrpc.client.Fault(1, f'{type(error).__name__}: {brief(error)}')
                )
            answer = answer.encode()
            self.connection.settimeout(REQUEST_TIMEOUT)
            self.send_response(200)
            self.send_header('Content-type', 'text/xml')
            self.send_header('Content-length', str(len(answer)))
            self.end_headers()
            self.wfile.write(answer)
            self.answered = True

    return Handler


def _refuse_entities(body):
    """Raise an error where the body is no XML, or defines entities, by which a little of it becomes
    a lot."""

    def refuse(*doctype):
        raise ValueError('it has a document type')

    parser = xml.parsers.expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    parser.Parse(body, True)


def ends_of_call():
    """The IP addresses, the client's and ours, of the call that this thread answers; None if it
    answers none."""
    if not hasattr(_call, 'client'):
        return None
    return [
        address[0].partition('%')[0].removeprefix('::ffff:')
        for address in (_call.client, _call.here)
    ]


def is_call_from_nearby(master_url):
    """Whether the call that this thread answers comes from this host, or that of the master."""
    ends = ends_of_call()
    if ends is None or ends[0] == ends[1] or ipaddress.ip_address(ends[0]).is_loopback:
        return True
    try:
        found = socket.getaddrinfo(urllib.parse.urlsplit(master_url).hostname, None)
    except OSError:  # the name has no address, or none that can be found now
        return False
    return ends[0] in {address[0] for *_, address in found}
