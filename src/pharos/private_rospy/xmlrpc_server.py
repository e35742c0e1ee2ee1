"""Who may say how much to a node's XML-RPC server, and for how long."""
import contextlib
import io
import ipaddress
import threading
import time
import urllib.parse
import xml.parsers.expat
import xmlrpc.client
import xmlrpc.server

from pharos.private_rospy.acceptor import brief
from pharos.private_rospy.addresses import addresses_of
from pharos.private_rospy.deadlines import DeadlineReader

REQUEST_LIMIT = 1 << 20  # bytes of a request

#: .handler: the RequestHandler whose client's call it answers, .connection: the socket of a client
_thread = threading.local()


class RequestHandler(xmlrpc.server.SimpleXMLRPCRequestHandler):
    """Reads the requests of one client, within limits, and answers them, in a thread of its own.

    Its server has the client's :class:`~.acceptor.Acceptor` as ``acceptor``, and the
    :class:`~.instance.PrivateRospy` as ``node``.
    """

    protocol_version = 'HTTP/1.1'
    is_answered = False  # whether the client has had an answer

    def setup(self):
        """Called by socketserver."""
        super().setup()
        self.rfile = io.BufferedReader(DeadlineReader(self.connection))

    def finish(self):
        """Called by socketserver."""
        with contextlib.suppress(OSError):  # the client has gone without its answer
            super().finish()

    def handle_one_request(self):
        """Called by http.server, until close_connection is set."""
        self.server.acceptor.start_handshake(self.connection)
        limits = self.server.node.limits
        patience = limits.idle_timeout if self.is_answered else limits.request_timeout
        self.rfile.raw.deadline = time.monotonic() + patience
        self.raw_requestline = b''
        try:
            super().handle_one_request()
        except OSError as error:
            self.close_connection = True
            self.log_error('%s', error)

    def log_error(self, format, *args):
        """Called by http.server, also where a client went that had nothing more to ask."""
        if self.raw_requestline or not self.is_answered:
            self.server.acceptor.reject(self.connection, self.client_address, format % args)

    def log_rejection(self, why):
        """Log what is wrong with a call of the client."""
        self.server.acceptor.log_rejection(self.client_address, why)

    def refuse(self, method, why):
        """Log that a call of the client is refused; returns the slave API's answer to it."""
        self.log_rejection(f'call of {method}: {why}')
        return -1, f'refused: {why}', 0

    def do_POST(self):
        """Called by http.server for a request whose header has come."""
        self.rfile.raw.deadline = time.monotonic() + self.server.node.limits.request_timeout
        length = self.headers.get('content-length', '')
        if not self.is_rpc_path_valid():
            self.send_error(404)
        elif not length.isdecimal() or 'transfer-encoding' in self.headers:
            self.send_error(411)
        elif len(length) > 10 or int(length) > REQUEST_LIMIT:
            self.send_error(413, f'a request of {length:.20} bytes; the limit is {REQUEST_LIMIT}')
        elif 'content-encoding' in self.headers:  # what is small may become huge
            self.send_error(415)
        else:
            self._answer(int(length))

    def _answer(self, length):
        body = self.rfile.read(length)
        try:
            if len(body) < length:
                raise ValueError(f'closed after {len(body)} of {length} bytes')
            _refuse_document_type(body)
            _, method = xmlrpc.client.loads(body)
        except Exception as error:  # xmlrpc raises whatever it is that it trips over
            text = brief(error).encode('ascii', 'replace').decode()
            self.send_error(400, f'no XML-RPC call: {text}')
            return
        self.server.acceptor.finish_handshake(self.connection)
        if method == 'shutdown':  # the client is to hear that the node has stopped
            self.server.node.lifetime.untrack_socket(self.connection)
            self.close_connection = True
        _thread.handler = self
        answers_calls_of(self.connection)
        answer = self.server._marshaled_dispatch(body)
        self.connection.settimeout(self.server.node.limits.request_timeout)
        self.send_response(200)
        self.send_header('Content-type', 'text/xml')
        self.send_header('Content-length', str(len(answer)))
        self.end_headers()
        self.wfile.write(answer)
        self.is_answered = True


def _refuse_document_type(body):
    """Raise an error where the body is no XML, or defines entities, by which a little of it becomes
    a lot."""

    def refuse(*_):
        raise ValueError('it has a document type')

    parser = xml.parsers.expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    parser.Parse(body, True)


def caller():
    """The :class:`RequestHandler` of the client whose call this thread answers."""
    return _thread.handler


def answers_calls_of(sock):
    """What this thread does from now on is for the client at that socket."""
    _thread.connection = sock


def ends_of_call():
    """The IP addresses, the client's and ours, of the call that this thread answers; two times the
    same for a call within this process."""
    connection = getattr(_thread, 'connection', None)
    if connection is None:
        return ['127.0.0.1', '127.0.0.1']
    ends = connection.getpeername(), connection.getsockname()
    return [address.partition('%')[0].replace('::ffff:', '') for address, *_ in ends]


def is_call_from_nearby(master_url):
    """Whether the call that this thread answers comes from this host, or that of the master."""
    try:
        client, here = map(ipaddress.ip_address, ends_of_call())
        if client == here or client.is_loopback:
            return True
        return client in addresses_of(urllib.parse.urlsplit(master_url).hostname)
    except OSError:  # the client has gone, or the name has no address that can be found now
        return False
