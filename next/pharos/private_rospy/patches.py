"""What is mended in rospy: a table of patches, applied to each node's own copy.

``@patch(module, target)`` over ``def f(original, run, module)``, which returns the replacement;
``run`` is the Run whose copy is patched. The docstring says what is wrong with rospy's.
"""
from __future__ import annotations

import contextlib
import functools
import socket
import struct
import threading
import time
import types
from typing import Any, Callable

import rospy

from pharos.intraprocess.copier import copier_for
from pharos.private_rospy import transport
from pharos.private_rospy.loader import Shim

HANDSHAKE_SIZE = 1 << 20  # bytes of a connection header
REQUEST_SIZE = 1 << 20  # bytes of an XML-RPC request
#: module -> [(target, function)]
TABLE: dict[str, list[tuple[str, Callable]]] = {}
_client = threading.local()  # .address: of the client whose XML-RPC request this thread answers


def patch(module: str, target: str) -> Callable:
    """Enter a function into the table."""

    def enter(make):
        TABLE.setdefault(module, []).append((target, make))
        return make

    return enter


def apply(module: types.ModuleType, run: Any) -> None:
    """Patch a private module, right after its code has run; a missing target is an AttributeError."""
    for target, make in TABLE.get(module.__name__, ()):
        owner, _, name = target.rpartition('.')
        owner = getattr(module, owner) if owner else module
        original = getattr(owner, name)
        replacement = make(original, run, module)
        if isinstance(original, types.FunctionType) and callable(replacement):
            replacement = functools.wraps(original)(replacement)
        setattr(owner, name, replacement)


def overlay(cls: type, methods: type) -> type:
    """Set the methods of a plain class on a private class; ``rospy_NAME`` is what was there."""
    for name, method in vars(methods).items():
        if isinstance(method, types.FunctionType):
            setattr(cls, f'rospy_{name}', getattr(cls, name, None))
            setattr(cls, name, method)
    return cls


def close_listener(sock: socket.socket) -> None:
    """Close a listening socket; the shutdown wakes whoever waits for it."""
    try:
        sock.shutdown(socket.SHUT_RDWR)
    except OSError:
        pass
    sock.close()


# -- servers


@patch('rosgraph.network', 'read_ros_handshake_header')
def read_handshake(original, run, module):
    """Wait for ever for a peer that says nothing, too little, or announces 4 GiB."""

    def read_ros_handshake_header(sock, buffer, buff_size):
        deadline = time.monotonic() + run.client_timeout

        def read(size):
            data = b''
            while len(data) < size:
                sock.settimeout(max(deadline - time.monotonic(), 0.001))
                part = sock.recv(min(size - len(data), 4096))
                if not part:
                    raise module.ROSHandshakeException('it closed the connection')
                data += part
            return data

        try:
            head = read(4)
            (size,) = struct.unpack('<I', head)
            if size > HANDSHAKE_SIZE:
                raise module.ROSHandshakeException(f'it announces a header of {size} bytes')
            header = module.decode_ros_handshake_header(head + read(size))
        except socket.timeout:
            limit = f'{run.client_timeout:g} s'
            raise module.ROSHandshakeException(f'no connection header within {limit}') from None
        sock.settimeout(None)
        return header

    return read_ros_handshake_header


@patch('rospy.impl.tcpros_base', 'TCPROSServer._tcp_server_callback')
def accept(original, run, module):
    """Shakes hands in the thread that accepts: one silent client keeps out all others."""

    def _tcp_server_callback(self, sock, address):
        def shake_hands():
            _client.address = address
            transport.keep_alive(sock)
            original(self, sock, address)

        run.sockets.add(sock)
        run.start_thread(shake_hands, 'client')

    return _tcp_server_callback


@patch('rospy.impl.tcpros_base', 'logwarn')
def name_client(original, run, module):
    """Does not say which client it refused."""

    def logwarn(text, *args):
        host, port = getattr(_client, 'address', ('', 0))
        original(f'{host}:{port}: {text}', *args)

    return logwarn


@patch('rospy.impl.tcpros_base', 'rospyerr')
def log_no_traceback(original, run, module):
    """Logs a traceback for each client that says nonsense; a line says so already."""
    return lambda text, *args: None


@patch('rospy.impl.tcpros_base', 'rospywarn')
def warn_no_traceback(original, run, module):
    """Logs one for each attempt to connect."""
    return lambda text, *args: None


@patch('rospy.impl.tcpros_base', 'TCPServer._create_server_sock')
def listen(original, run, module):
    """Lets five clients wait."""

    def _create_server_sock(self):
        sock = original(self)
        sock.listen(128)
        return sock

    return _create_server_sock


@patch('rospy.impl.tcpros_base', 'TCPServer.shutdown')
def shutdown_server(original, run, module):
    """Closes the socket, which does not wake accept(), and the port stays taken."""

    def shutdown(self):
        self.is_shutdown = True
        close_listener(self.server_sock)

    return shutdown


@patch('rospy.impl.tcpros_base', '_is_use_tcp_keepalive')
def use_keepalive(original, run, module):
    """Asks the master before each first connection."""
    return lambda: False


@patch('rospy.impl.tcpros_pubsub', '_configure_pub_socket')
def no_delay(original, run, module):
    """Sends some messages 40 ms late, unless the subscriber asks for tcp_nodelay."""
    return lambda sock, is_tcp_nodelay: original(sock, True)


@patch('rosgraph.xmlrpc', 'XmlRpcNode.start')
def start_xmlrpc(original, run, module):
    """Binds its port in another thread, where an error is printed and cannot be raised."""

    def start(self):
        module.print = lambda text: None
        self._run_init()
        self.thread = run.start_thread(
            lambda: self.server.serve_forever(poll_interval=60), 'xmlrpc'
        )

    return start


@patch('rosgraph.xmlrpc', 'XmlRpcNode.shutdown')
def shutdown_xmlrpc(original, run, module):
    """Only closes the socket, on which its thread then spins (ros_comm #2238)."""

    def shutdown(self, reason):
        self.is_shutdown = True
        server, self.server = self.server, None
        if server:
            self.handler._shutdown(reason)
            server._BaseServer__shutdown_request = True
            close_listener(server.socket)

    return shutdown


@patch('rosgraph.xmlrpc', 'ThreadingXMLRPCServer.process_request')
def process_request(original, run, module):
    """Has threads and sockets that outlive it, and waits for silent clients."""

    def process_request(self, request, address):
        def answer():
            _client.address = address
            self.process_request_thread(request, address)
            run.deadlines.pop(request, None)

        run.deadlines[request] = time.monotonic() + run.client_timeout
        request.settimeout(run.client_timeout)
        run.sockets.add(request)
        run.start_thread(answer, 'request')

    return process_request


@patch('rosgraph.xmlrpc', 'SilenceableXMLRPCRequestHandler.do_POST')
def limit_request(original, run, module):
    """Reads requests of any size."""

    def do_POST(self):
        if int(self.headers.get('content-length', 0)) > REQUEST_SIZE:
            self.close_connection = True
            return self.send_error(413)
        original(self)
        run.deadlines[self.connection] = time.monotonic() + run.client_timeout

    return do_POST


# -- life


@patch('rospy.core', 'signal_shutdown')
def signal_shutdown(original, run, module):
    """Ends rospy alone: rosnode kill and the like are to stop the node as its user would."""
    run.end_rospy = original
    return lambda reason: run.on_shutdown(reason)


@patch('rospy.core', 'is_shutdown')
def is_shutdown(original, run, module):
    """Holds at the end of a stop, which waits for loops that ask it."""
    return lambda: run.stopping.is_set() or original()


@patch('rospy.impl.init', 'time')
def poll_often(original, run, module):
    """Looks every 0.1 s whether the node is registered."""
    return Shim(original, sleep=lambda seconds: original.sleep(min(seconds, 0.001)))


@patch('rospy.impl.masterslave', 'ROSHandler._ready')
def ready(original, run, module):
    """Starts a thread that then looks twice a second for departed subscribers."""

    def _ready(self, uri):
        self.uri = run.uri = uri
        run.handler = self
        run.known = {'pub': set(), 'sub': set(), 'srv': set()}
        self.reg_man.start(uri, self.masterUri)

    return _ready


@patch('rospy.impl.registration', 'RegManager.run')
def run_registration(original, run, module):
    """Is that thread's loop; the watcher does its work for all nodes."""
    return lambda self: None


@patch('rospy.impl.masterslave', 'ROSHandler._shutdown')
def shut_down(original, run, module):
    """Closes what the stop closes later."""

    def _shutdown(self, reason=''):
        self.done = True
        return True

    return _shutdown


@patch('rospy.impl.masterslave', 'ROSHandler.shutdown')
def shut_down_from_outside(original, run, module):
    """Obeys everybody, also if an earlier node at its URI is meant (ros_comm #2241)."""

    def shutdown(self, caller_id, msg=''):
        if caller_id == '/master' and f'[{self.name}]' not in str(msg):
            return 1, 'an earlier node at this address was meant', 0
        host = _client.address[0]
        if not (is_near(host, self.masterUri) or run.allows_shutdown()):
            run.ros.logwarn(f'refused to stop for {caller_id} at {host}')
            return 0, 'only this host and the master may do that', 0
        run.on_shutdown(f'{caller_id} says {msg}')
        return 1, 'shutdown', 0

    def is_near(address, master_uri):
        near = run.modules.load('rosgraph.network').get_local_addresses()
        with contextlib.suppress(OSError):
            near = [*near, socket.gethostbyname(master_uri.split('/')[2].rpartition(':')[0])]
        return address.startswith('127.') or address in near

    return shutdown


# -- topics


@patch('rospy.topics', '_PublisherImpl')
def publisher(original, run, module):
    """See PublisherOverlay."""
    return overlay(original, transport.PublisherOverlay)


@patch('rospy.topics', '_SubscriberImpl')
def subscription(original, run, module):
    """See SubscriptionOverlay."""
    return overlay(original, transport.SubscriptionOverlay)


@patch('rospy.topics', 'QueuedConnection')
def queued(original, run, module):
    """See Sender."""

    def make(connection, queue_size):
        if connection.transport_type == 'INTRAPROCESS':
            return connection
        return transport.Sender(connection, queue_size, run)

    return make


@patch('rospy.impl.tcpros_pubsub', 'robust_connect_subscriber')
def receive(original, run, module):
    """Gives up silently, or tries ever more rarely."""

    def robust_connect_subscriber(connection, address, port, uri, callback, topic):
        subscription = callback.__self__
        cls = subscription.data_class
        try:
            transport.receive(connection, address, port, uri, subscription, run)
            run.told.discard((topic, uri))
        except Exception as error:
            if 'remote error reported' in str(error):
                connection.close()
                transport.end_share(topic, uri, cls, run)
                return run.on_refused(topic, str(error))
            if not subscription.closed and (topic, uri) not in run.told:
                run.told.add((topic, uri))
                run.ros.logwarn(f'{topic}: no connection to {uri}, it is tried again: {error}')
        connection.close()
        transport.end_share(topic, uri, cls, run)
        if not subscription.closed:
            run.connect_again(topic, uri)

    return robust_connect_subscriber


@patch('rospy.impl.registration', 'RegManager.reg_added')
def reg_added(original, run, module):
    """Tries for ever with the lock of all topics held: one attempt, then the watcher repairs."""
    return lambda self, name, data, kind: run.register(kind, name, data)


@patch('rospy.impl.registration', 'RegManager.publisher_update')
def publisher_update(original, run, module):
    """Leaves it to its thread."""
    return lambda self, name, uris: run.update_publishers(name, uris)


@patch('rospy.impl.masterslave', 'ROSHandler.publisherUpdate')
def publishers_changed(original, run, module):
    """Does so once for each publisher, and does not hear that there is none."""

    def publisherUpdate(self, caller_id, topic, publishers):
        if not (isinstance(publishers, list) and all(isinstance(uri, str) for uri in publishers)):
            return -1, 'publishers are a list of URIs', 0
        run.update_publishers(topic, publishers)
        return 1, '', 0

    return publisherUpdate


@patch('rospy.impl.registration', 'RegManager.cleanup')
def cleanup(original, run, module):
    """Trips over a time-out, and then closes nothing."""

    def cleanup(self, reason):
        try:
            original(self, reason)
        finally:
            run.topics.close_all()

    return cleanup


# -- parameters, log, services


@patch('rospy.impl.masterslave', 'ROSHandler.paramUpdate')
def parameter_changed(original, run, module):
    """Tells its own cache alone."""

    def paramUpdate(self, caller_id, key, value):
        run.on_parameter('/' + str(key).strip('/'))
        return original(self, caller_id, key, value)

    return paramUpdate


@patch('rospy.msproxy', 'MasterProxy.__setitem__')
def set_parameter(original, run, module):
    """Tells others of the change, and not the node itself."""

    def __setitem__(self, key, value):
        original(self, key, value)
        run.on_parameter(module.rospy.names.resolve_name(key))

    return __setitem__


@patch('rospy.msproxy', 'MasterProxy.__delitem__')
def delete_parameter(original, run, module):
    """Likewise."""

    def __delitem__(self, key):
        original(self, key)
        run.on_parameter(module.rospy.names.resolve_name(key))

    return __delitem__


@patch('rospy.impl.rosout', 'rospy')
def rosout(original, run, module):
    """Asks the master for each line, which registers anew a node that stops."""
    return Shim(original, get_param_cached=lambda name, default=None: default)


@patch('rospy.service', 'ServiceException')
def service_exception(original, run, module):
    """Is another one for each node, which others could not catch."""
    return rospy.ServiceException


@patch('rospy.impl.tcpros_service', 'ServiceImpl.handle')
def handle_call(original, run, module):
    """Lets its thread end with an exception if the client has gone."""

    def handle(self, connection, header):
        try:
            original(self, connection, header)
        except (rospy.exceptions.TransportException, OSError):
            connection.close()

    return handle


@patch('rospy.impl.tcpros_service', 'ServiceImpl.error_handler')
def service_failed(original, run, module):
    """Takes it for an error of the service if the client has gone."""

    def error_handler(self, error, *about):
        if not isinstance(error, rospy.exceptions.TransportException):
            original(self, error, *about)

    return error_handler


@patch('rospy.impl.tcpros_service', 'ServiceProxy.call')
def call_service(original, run, module):
    """Has no way to a provider of the same process but a socket."""

    def call(self, *args, **kwargs):
        from pharos.private_rospy.run import local_service

        found = local_service(run.master_url, self.resolved_name)
        if not found or found[1].service_class._md5sum != self.service_class._md5sum:
            return original(self, *args, **kwargs)
        request = run.modules.load('rospy.msg').args_kwds_to_message(
            self.request_class, args, kwargs
        )
        freeze, thaw = copier_for(type(request))
        return answer(*found, thaw(freeze(request)), run.name)

    return call


def answer(run: Any, service: Any, request: Any, caller_id: str) -> Any:
    """Have a rospy.Service of this process answer a request, in this thread."""
    request._connection_header = {'callerid': caller_id, 'service': service.resolved_name}
    impl = run.modules.load('rospy.impl.tcpros_service')
    try:
        result = impl.convert_return_to_response(service.handler(request), service.response_class)
        freeze, thaw = copier_for(service.response_class)
        return thaw(freeze(result))
    except impl.ServiceException as error:
        raise impl.ServiceException(f'service cannot process request: {error}') from error
    except Exception as error:
        raise impl.ServiceException(f'error processing request: {error}') from error
