"""Mend rospy: a table of patches, applied to each node's own copy.

Over ``def f(original, run, *args)``, ``@patch(module, target)`` has ``f`` called instead of the
target; ``run`` is the Run whose copy is patched. Over ``def f(original, run)``, ``@replace(module,
target)`` puts what it returns in the target's place. Each docstring says what is wrong with
rospy: read it after the word 'rospy'.
"""
import socket
import threading
from urllib.parse import urlsplit

import rospkg
import rospy
from rosgraph.network import ROSHandshakeException, decode_ros_handshake_header, is_local_address

from pharos.private_rospy import transport
from pharos.private_rospy.loader import Shim

LARGEST = 1 << 20  # bytes of a connection header, and of an XML-RPC request
#: module -> [(target, function that makes the replacement)]
TABLE = {}


class _Client(threading.local):
    address = ()  # of the client whose request this thread answers


_client = _Client()


def replace(module, target):
    """Enter a function that makes a replacement into the table."""

    def enter(make):
        TABLE.setdefault(module, []).append((target, make))
        return make

    return enter


def patch(module, target):
    """Enter a function that is called instead of another one into the table."""

    def enter(function):
        def make(original, run):
            return lambda *args, **kwargs: function(original, run, *args, **kwargs)

        replace(module, target)(make)
        return function

    return enter


def apply(module, run):
    """Patch a private module, right after its code has run; a missing target is an AttributeError."""
    for target, make in TABLE.get(module.__name__, ()):
        owner, _, name = target.rpartition('.')
        owner = getattr(module, owner) if owner else module
        setattr(owner, name, make(getattr(owner, name), run))


def overlay(cls, methods, run):
    """Set the methods of a plain class on a private class; ``rospy_NAME`` is what was there.

    A subclass would recurse: rospy calls ``super(_PublisherImpl, self)``, and would find it.
    """
    cls.run = run
    for name, method in vars(methods).items():
        if callable(method):
            setattr(cls, f'rospy_{name}', getattr(cls, name, None))
            setattr(cls, name, method)
    return cls


# -- servers


@patch('rosgraph.network', 'read_ros_handshake_header')
def read_handshake(original, run, sock, *buffer):
    """Wait for ever for a peer that says nothing, too little, or announces 4 GiB."""
    run.limit(sock)
    head = sock.recv(4, socket.MSG_WAITALL)
    size = int.from_bytes(head, 'little')
    data = head + sock.recv(size, socket.MSG_WAITALL) if size <= LARGEST else b''
    run.deadlines.pop(sock, None)
    if len(data) < 4 + size:
        raise ROSHandshakeException(f'no connection header of {size} bytes came in time')
    return decode_ros_handshake_header(data)


@patch('rospy.impl.tcpros_base', 'TCPROSServer._tcp_server_callback')
def accept(original, run, self, sock, address):
    """Shakes hands in the thread that accepts: one silent client keeps out all others."""

    def shake_hands():
        _client.address = address
        transport.keep_alive(sock)
        original(self, sock, address)

    run.sockets.add(sock)
    run.start_thread(shake_hands)


@patch('rospy.impl.tcpros_base', 'logwarn')
def name_client(original, run, text, *args):
    """Does not say which client it refused."""
    original(f'{":".join(map(str, _client.address))}: {text}', *args)


@patch('rospy.impl.tcpros_base', 'rospyerr')
@patch('rospy.impl.tcpros_base', 'rospywarn')
def log_no_traceback(original, run, *args):
    """Log a traceback for each client that says nonsense; a line says so already."""


@patch('rospy.impl.tcpros_base', 'TCPServer.shutdown')
def shutdown_server(original, run, self):
    """Closes the socket, which does not wake accept(), and the port stays taken."""
    self.is_shutdown = True
    transport.shut(self.server_sock)
    self.server_sock.close()


@patch('rospy.impl.tcpros_pubsub', '_configure_pub_socket')
def no_delay(original, run, sock, is_tcp_nodelay):
    """Sends some messages 40 ms late, unless the subscriber asks for tcp_nodelay."""
    original(sock, True)


@patch('rosgraph.xmlrpc', 'XmlRpcNode.start')
def start_xmlrpc(original, run, self):
    """Binds its port in another thread, where an error is printed and cannot be raised."""
    original.__globals__['print'] = lambda text: None
    self._run_init()
    server = self.server

    def serve():
        with server:  # closes it
            server.serve_forever(poll_interval=60)

    run.start_thread(serve)


@patch('rosgraph.xmlrpc', 'XmlRpcNode.shutdown')
def shutdown_xmlrpc(original, run, self, reason):
    """Only closes the socket; its thread then spins (ros_comm #2238)."""
    self.is_shutdown = True
    if self.server:
        self.handler._shutdown(reason)
        self.server._BaseServer__shutdown_request = True
        transport.shut(self.server.socket)


@patch('rosgraph.xmlrpc', 'ThreadingXMLRPCServer.process_request')
def process_request(original, run, self, request, address):
    """Has threads and sockets that outlive it, and waits for silent clients."""

    def answer():
        _client.address = address
        self.process_request_thread(request, address)
        run.deadlines.pop(request, None)

    run.limit(request)
    run.sockets.add(request)
    if run.stopping.is_set():
        transport.shut(request)
    run.start_thread(answer)


@patch('rosgraph.xmlrpc', 'SilenceableXMLRPCRequestHandler.do_POST')
def limit_request(original, run, self):
    """Reads requests of any size."""
    if int(self.headers.get('content-length', 0)) > LARGEST:
        return self.send_error(413)
    original(self)
    run.limit(self.connection)


# -- life


@replace('rospy.core', 'signal_shutdown')
def signal_shutdown(original, run):
    """Ends rospy alone: rosnode kill and the like are to stop the node as its user would."""
    run.shut_down = original
    return run.signal_shutdown


@patch('rospy.core', 'is_shutdown')
def is_shutdown(original, run):
    """Is true too late: a stop waits for the loops that ask it."""
    run.checkpoint()
    return run.stopping.is_set() or original()


@replace('rosgraph.roslogging', 'rospkg')
def packages(original, run):
    """Searches all packages for rosgraph's configuration of the log, again for each node."""
    return Shim(original, RosPack=rospkg.RosPack.get_instance)


@patch('rospy.impl.masterslave', 'ROSHandler._ready')
def ready(original, run, self, uri):
    """Starts a thread that then looks twice a second for departed subscribers."""
    self.uri = uri
    run.ready(self, uri)
    self.reg_man.start(uri, self.masterUri)


@patch('rospy.impl.registration', 'RegManager.run')
def run_registration(original, run, self):
    """Looks for new publishers in a thread for each node; the watcher does so for all."""


@patch('rospy.impl.masterslave', 'ROSHandler._shutdown')
def shut_down(original, run, self, reason=''):
    """Closes what the stop closes later."""
    self.done = True


@patch('rospy.impl.masterslave', 'ROSHandler.shutdown')
def shut_down_from_outside(original, run, self, caller_id, msg=''):
    """Obeys everybody, also if an earlier node at its URI is meant (ros_comm #2241)."""
    host, master = _client.address[0], urlsplit(self.masterUri).hostname
    is_near = host == socket.gethostbyname(master) or is_local_address(host)
    is_meant = caller_id != '/master' or f'[{self.name}]' in str(msg)
    obeys = is_meant and (is_near or run.node.allow_remote_shutdown)
    if obeys:
        run.end_node()
    else:
        run.ros.logwarn(f'does not stop for {caller_id} at {host}: {msg}')
    return int(obeys), 'only this host and the master may do that', 0


@patch('rospy.timer', 'Timer.__init__')
def start_timer(original, run, self, period, callback, *args, **kwargs):
    """Calls once more at a stop, which ends its sleep."""
    original(self, period, lambda event: run.stopping.is_set() or callback(event), *args, **kwargs)


# -- topics


@replace('rospy.topics', '_PublisherImpl')
def publisher(original, run):
    """See PublisherOverlay."""
    return overlay(original, transport.PublisherOverlay, run)


@replace('rospy.topics', '_SubscriberImpl')
def subscription(original, run):
    """See SubscriptionOverlay."""
    return overlay(original, transport.SubscriptionOverlay, run)


@patch('rospy.topics', 'Subscriber.__init__')
def subscribe(original, run, self, *args, **kwargs):
    """Connects before it has its callback: add_callback() does so after; without one it is here."""
    original(self, *args, **kwargs)
    if self.callback is None:  # else add_callback() has connected it
        run.connect_all(self.resolved_name)


@patch('rospy.topics', 'QueuedConnection')
def queued(original, run, connection, queue_size):
    """See Sender."""
    is_link = isinstance(connection, transport.Link)
    return connection if is_link else transport.Sender(connection, queue_size, run)


@patch('rospy.impl.tcpros_pubsub', 'robust_connect_subscriber')
def receive(original, run, connection, address, port, uri, callback, topic):
    """Gives up silently, or tries ever more rarely."""
    subscription, error = callback.__self__, None
    try:
        transport.receive(connection, address, port, uri, subscription, run)
    except Exception as problem:
        error = str(problem)
    connection.close()
    transport.end_share(run, topic, uri, subscription)
    if error and ('md5sum' in error or 'do not match' in error):  # rospy compares the names, too
        run.node._refused(topic, error)
    elif not subscription.closed:
        run.connect_again(topic, uri, error)


@patch('rospy.impl.registration', 'RegManager.reg_added')
def reg_added(original, run, self, name, data, kind):
    """Tries for ever with the lock of all topics held: one attempt, then the watcher repairs."""
    run.register(kind, name, data)


@patch('rospy.impl.registration', 'RegManager.publisher_update')
def publisher_update(original, run, self, name, uris):
    """Leaves it to its thread; is called once for each publisher."""
    if uris != run.publisher_uris.get(name):
        run.publisher_uris[name] = uris
        run.connect_all(name)


@patch('rospy.impl.masterslave', 'ROSHandler.publisherUpdate')
def publishers_changed(original, run, self, *args):  # it checks their number and types
    """Does not hear that the last publisher has left."""
    for topic in args[1:2]:
        run.publisher_uris.pop(topic, None)
    return original(self, *args)


@patch('rospy.impl.registration', 'RegManager.cleanup')
def cleanup(original, run, self, reason):
    """Trips over a time-out, and then closes nothing."""
    try:
        original(self, reason)
    finally:
        run.topics.close_all()


@patch('actionlib.simple_action_client', 'SimpleActionClient.send_goal')
@patch('actionlib.simple_action_client', 'SimpleActionClient._handle_transition')
def keep_goal(original, run, self, *args, **kwargs):
    """Drops what comes before send_goal() returns, as the answer of a node of this process may."""
    with self.done_condition:
        return original(self, *args, **kwargs)


# -- parameters, log, services


@patch('rospy.impl.masterslave', 'ROSHandler.paramUpdate')
def parameter_changed(original, run, self, *args):
    """Tells its own cache alone."""
    run.node._read_parameters()
    return original(self, *args)


@patch('rospy.msproxy', 'MasterProxy.__setitem__')
@patch('rospy.msproxy', 'MasterProxy.__delitem__')
def set_parameter(original, run, self, key, *value):
    """Tells others of the change, and not the node itself."""
    original(self, key, *value)
    run.node._read_parameters()


@replace('rospy.impl.rosout', 'rospy')
def rosout(original, run):
    """Asks the master for each line, which registers anew a node that stops."""
    return Shim(original, get_param_cached=lambda name, default=None: default)


@replace('rospy.service', 'ServiceException')
def service_exception(original, run):
    """Is another one for each node, which others could not catch."""
    return rospy.ServiceException


@patch('rospy.impl.tcpros_service', 'ServiceImpl.handle')
def handle_call(original, run, self, connection, header):
    """Lets its thread end with an exception if the client has gone."""
    try:
        original(self, connection, header)
    except (rospy.exceptions.TransportException, OSError):
        connection.close()
