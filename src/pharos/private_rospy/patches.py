"""Mend rospy: a table of patches, applied to each node's own copy.

Over ``def f(original, run, *args)``, ``@patch(module, target)`` has ``f`` called instead of the
target. ``original`` is the former function, and ``run`` the Run that owns the private module. Over
``def f(original, run)``, ``@replace(module, target)`` puts the returned object in the target's
place. Each docstring names the fault of rospy, of another library or of the master, then what the patch
does ("this").
"""
from __future__ import annotations

import socket
import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Callable
from urllib.parse import urlsplit

import rospkg
import rospy
from rosgraph.network import ROSHandshakeException, decode_ros_handshake_header, is_local_address

from pharos.intraprocess.callback_queues import TURN_LIMIT
from pharos.private_rospy import connections, tcpros, topics
from pharos.private_rospy.loader import Shim
from pharos.private_rospy.services import answer, call_by_proxy
from pharos.transcript import attempt

if TYPE_CHECKING:
    from pharos.private_rospy.run import Run

MAX_REQUEST = 1 << 20  # bytes of a connection header
POLL_INTERVAL = 60  # seconds between two looks for a stop; the stop itself wakes the server
#: module -> [(target, function that makes the replacement)]
TABLE: dict[str, list[tuple[str, Callable]]] = {}


#: the client that this thread answers: its address is ``(host, port)``; if it ends the node,
#: must_stop is True
_current_client = threading.local()


def replace(module: str, target: str) -> Callable:
    """Return a decorator that enters a maker of replacements into the table."""

    def add_to_table(make_replacement: Callable) -> Callable:
        TABLE.setdefault(module, []).append((target, make_replacement))
        return make_replacement

    return add_to_table


def patch(module: str, target: str) -> Callable:
    """Return a decorator that enters a function into the table, to be called for the target."""

    def add_to_table(function: Callable) -> Callable:
        def make_replacement(original: Callable, run: Run) -> Callable:
            return lambda *args, **kwargs: function(original, run, *args, **kwargs)

        replace(module, target)(make_replacement)
        return function

    return add_to_table


def apply(module: Any, run: Run) -> None:
    """Patch a private module, right after its code has run.

    :raises AttributeError: if a target is missing: this is not the rospy that the table is for
    """
    for target, make_replacement in TABLE.get(module.__name__, ()):
        class_name, _, name = target.rpartition('.')
        owner = getattr(module, class_name) if class_name else module
        setattr(owner, name, make_replacement(getattr(owner, name), run))


def overlay(cls: Any, methods: type, run: Run) -> type:
    """Set the methods of a plain class on a private class, and return the private class.

    ``rospy_NAME`` is the former method, or None. A subclass would recurse:
    ``super(_PublisherImpl, self)`` in rospy's code would find the subclass.
    """
    cls.run = run
    for name, method in vars(methods).items():
        if callable(method):
            setattr(cls, f'rospy_{name}', getattr(cls, name, None))
            setattr(cls, name, method)
    return cls


# -- servers


@patch('rosgraph.network', 'read_ros_handshake_header')
def read_handshake(
    original: Callable, run: Run, sock: socket.socket, *buffer: Any
) -> dict[str, str]:
    """rospy waits for ever for a silent peer, and reads headers of 4 GiB. This has limits."""
    run.limit_silence(sock)
    head = sock.recv(4, socket.MSG_WAITALL)
    size = int.from_bytes(head, 'little')
    data = head
    if size <= MAX_REQUEST:
        data += sock.recv(size, socket.MSG_WAITALL)
    run.deadlines.pop(sock, None)
    if len(data) < 4 + size:  # more than MAX_REQUEST, too little, or nothing in time
        raise ROSHandshakeException(f'no connection header of {size} bytes came in time')
    return decode_ros_handshake_header(data)


@patch('rospy.impl.tcpros_base', 'TCPROSServer._tcp_server_callback')
def accept(original: Callable, run: Run, self: Any, sock: socket.socket, address: Any) -> None:
    """rospy shakes hands in the thread that accepts: a silent client keeps out others.

    This starts a thread for each client.
    """

    def shake_hands() -> None:
        tcpros.keep_alive(sock)
        original(self, sock, address)

    run.sockets.add(sock)
    if not run.start_thread(shake_hands):
        sock.close()


@patch('rospy.impl.tcpros_base', 'TCPServer.run')
def accept_clients(original: Callable, run: Run, self: Any) -> None:
    """rospy's server ends for ever if the system has no descriptor left. This tries again."""
    tcpros.accept_clients(self.server_sock, run.stopping, self.inbound_handler)


@patch('rospy.impl.tcpros_base', 'TCPServer.shutdown')
def shutdown_server(original: Callable, run: Run, self: Any) -> None:
    """rospy closes the socket, which does not wake accept(): the port stays taken.

    This wakes accept(), and closes the socket.
    """
    self.is_shutdown = True
    tcpros.shutdown_socket(self.server_sock)
    self.server_sock.close()


@patch('rospy.impl.tcpros_pubsub', '_configure_pub_socket')
def no_delay(original: Callable, run: Run, sock: socket.socket, is_tcp_nodelay: bool) -> None:
    """rospy sends some messages 40 ms late, unless the subscriber asks for tcp_nodelay.

    This sets TCP_NODELAY for all subscribers.
    """
    original(sock, True)


@patch('rosgraph.xmlrpc', 'XmlRpcNode.start')
def start_xmlrpc(original: Callable, run: Run, self: Any) -> None:
    """rospy binds the port in another thread, and prints an error. This binds here, and raises."""
    # _run_init() prints an error that it also raises
    original.__globals__['print'] = lambda text: None
    self._run_init()
    server = self.server

    def serve() -> None:
        with server:  # closes the server's socket at the end
            while not self.is_shutdown:
                attempt(server.serve_forever, POLL_INTERVAL)

    if not run.start_thread(serve):
        raise RuntimeError(f'{run.name} cannot start: the system has no thread left, see ulimit -u')


@patch('rosgraph.xmlrpc', 'XmlRpcNode.shutdown')
def shutdown_xmlrpc(original: Callable, run: Run, self: Any, reason: str) -> None:
    """rospy only closes the socket, and its thread spins (ros_comm #2238). This ends the thread."""
    self.is_shutdown = True
    if self.server:
        self.handler._shutdown(reason)
        # as its shutdown() does, which would wait for the end of serve_forever()
        self.server._BaseServer__shutdown_request = True
        tcpros.shutdown_socket(self.server.socket)


@patch('rosgraph.xmlrpc', 'ThreadingXMLRPCServer.process_request')
def process_request(
    original: Callable, run: Run, self: Any, request: socket.socket, address: Any
) -> None:
    """rospy's threads and sockets wait for silent clients, even after a shutdown.

    The threads and sockets of this end with the run.
    """

    def answer() -> None:
        _current_client.address = address
        _current_client.must_stop = False
        self.process_request_thread(request, address)
        run.deadlines.pop(request, None)

    run.sockets.add(request)
    if run.stopping.is_set() or not run.start_thread(answer):
        self.shutdown_request(request)
    else:
        run.limit_silence(request)


@patch('rosgraph.xmlrpc', 'SilenceableXMLRPCRequestHandler.do_POST')
def wait_for_next(original: Callable, run: Run, self: Any) -> None:
    """rospy waits for ever for the next request. This has a limit.

    A call that ends the node is answered before: the stop closes the connection.
    """
    try:
        original(self)
        self.wfile.flush()
        run.limit_silence(self.connection)
    finally:
        if _current_client.must_stop:
            run.request_stop()


# -- life


@replace('rospy.core', 'signal_shutdown')
def signal_shutdown(original: Callable, run: Run) -> Callable:
    """rospy ends itself alone. This stops the node, in another thread.

    In a script it runs the hooks and closes rospy in this thread; the program's end stops the node.
    """
    run.rospy_signal_shutdown = original
    return run.signal_shutdown


@patch('rospy.core', 'is_shutdown')
def is_shutdown(original: Callable, run: Run) -> bool:
    """rospy is shut down only at the end of a stop, which waits for loops that ask this.

    This is True once the stop has begun; in a script, once its handlers and hooks have run.
    """
    run.checkpoint()
    if run.stopping.is_set():
        return True
    return original()


@patch('rosgraph.roslogging', 'RosStreamHandler.emit')
def print_line(original: Callable, run: Run, self: Any, record: Any) -> None:
    """rospy raises an exception if the terminal has gone, or a disk is full. This prints nothing then."""
    with suppress(OSError, ValueError):
        original(self, record)


@replace('rosgraph.roslogging', 'rospkg')
def cached_packages(original: Any, run: Run) -> Shim:
    """rosgraph searches all packages for the log's configuration, for each node.

    This searches once for all nodes.
    """
    return Shim(original, RosPack=rospkg.RosPack.get_instance)


@patch('rospy.impl.masterslave', 'ROSHandler._ready')
def ready(original: Callable, run: Run, self: Any, uri: str) -> None:
    """rospy registers in another thread, which then looks for departed peers for ever.

    This registers in this thread, and the watcher of all runs looks.
    """
    self.uri = uri
    run.make_findable(self, uri)
    self.reg_man.start(uri, self.masterUri)
    for topic in list(run.topic_manager.pubs):  # from before init_node()
        connections.connect_subscribers(run, topic)


@patch('rospy.impl.registration', 'RegManager.run')
def run_registration(original: Callable, run: Run, self: Any) -> None:
    """rospy connects to new publishers and looks for departed peers, in a thread for each node.

    This returns at once: publisher_update() connects, and the watcher of all runs looks.
    """


@patch('rospy.impl.masterslave', 'ROSHandler._shutdown')
def shut_down(original: Callable, run: Run, self: Any, reason: str = '') -> None:
    """rospy closes all connections here. This leaves the closing to the run's stop."""
    self.done = True


@patch('rospy.impl.masterslave', 'ROSHandler.shutdown')
def shut_down_from_outside(
    original: Callable, run: Run, self: Any, caller_id: str, msg: str = ''
) -> tuple[int, str, int]:
    """rospy obeys every caller, also a call for an earlier node at its URI (ros_comm #2241).

    This obeys callers on this host and on the master's, or all if allow_remote_shutdown is True.
    A call of the master must name this node.
    """
    host = _current_client.address[0]
    master_host = urlsplit(self.masterUri).hostname
    obeys = run.node.allow_remote_shutdown
    if host == socket.gethostbyname(master_host) or is_local_address(host):
        obeys = True
    if caller_id == '/master' and f'[{self.name}]' not in str(msg):
        obeys = False  # the call is for an earlier node, which had this URI
    _current_client.must_stop = obeys
    verb = 'stops' if obeys else 'does not stop'
    run.ros.logwarn(f'{verb} for {caller_id} at {host}: {msg}')
    return int(obeys), '' if obeys else 'only this host and the master may do that', 0


# -- topics


@replace('rospy.topics', '_PublisherImpl')
def overlay_publisher(original: Any, run: Run) -> type:
    """rospy serializes for all receivers. This freezes for links; see PublisherOverlay."""
    return overlay(original, topics.PublisherOverlay, run)


@replace('rospy.topics', '_SubscriberImpl')
def overlay_subscription(original: Any, run: Run) -> type:
    """rospy runs callbacks in the threads that read. This has inboxes; see SubscriptionOverlay."""
    return overlay(original, topics.SubscriptionOverlay, run)


@patch('rospy.topics', 'Subscriber.__init__')
def subscribe(original: Callable, run: Run, self: Any, *args: Any, **kwargs: Any) -> None:
    """rospy connects before the callback is there. This connects after, as add_callback() does."""
    original(self, *args, **kwargs)
    if self.callback is None:  # otherwise add_callback() has connected
        connections.connect_all(self.impl)


@patch('rospy.impl.tcpros_pubsub', 'robust_connect_subscriber')
def receive_and_retry(
    original: Callable,
    run: Run,
    connection: Any,
    address: Any,
    port: int,
    uri: str,
    callback: Any,
    topic: str,
) -> None:
    """rospy gives up silently, or tries ever more rarely. This logs, and tries each second.

    A publisher of another type is a failure of the node, and is not tried again.
    """
    # the callback is the subscription's receive_callback()
    tcpros.receive_until_end(connection, address, port, uri, callback.__self__)


@patch('rospy.impl.registration', 'RegManager.reg_added')
def register_once(
    original: Callable, run: Run, self: Any, name: str, data: str, registry: str
) -> None:
    """rospy tries for ever, and holds the lock of all topics. This tries once.

    The watcher registers later whatever the master lacks.
    """
    connections.register(run, registry, name, data)


@patch('rospy.impl.registration', 'RegManager.publisher_update')
def publisher_update(original: Callable, run: Run, self: Any, name: str, uris: list[str]) -> None:
    """rospy: ``for uri in uris: publisher_update(name, uris)``; a thread connects to each.

    This connects to all at the first call.
    """
    # publishers_changed() below has forgotten the list: the first call finds none; the further ones
    # find an equal one, and do nothing
    subscription = run.topic_manager.subs.get(name)
    if subscription and uris != subscription.publisher_uris:
        subscription.publisher_uris = uris
        connections.connect_all(subscription)


@patch('rospy.impl.masterslave', 'ROSHandler.publisherUpdate')
def publishers_changed(original: Callable, run: Run, self: Any, *args: Any) -> tuple[int, str, int]:
    """rospy ignores an update that the last publisher has left. This forgets the publishers.

    rospy then calls publisher_update() above, unless the list is empty.
    """
    if len(args) > 1:  # rospy refuses a call with too few arguments
        subscription = run.topic_manager.subs.get(args[1])
        if subscription:
            subscription.publisher_uris = []
    return original(self, *args)


@patch('rospy.impl.registration', 'RegManager.cleanup')
def cleanup(original: Callable, run: Run, self: Any, reason: str) -> None:
    """rospy closes nothing if the master does not answer in time. This tells it, and closes all topics."""
    try:
        original(self, reason)
    except Exception as error:
        run.ros.logwarn(
            f'the master at {run.master.url} does not answer: this node stays registered until'
            f' rosnode cleanup ({error!r})'
        )
    finally:
        run.topic_manager.close_all()


@patch('actionlib.simple_action_client', 'SimpleActionClient.send_goal')
def send_goal(original: Callable, run: Run, self: Any, *args: Any, **kwargs: Any) -> None:
    """actionlib drops an answer that comes before send_goal() returns. Here the answer waits.

    All queues of plain rospy pause, but for those in their first pause: the feedback stays before
    the result.
    """
    now = time.perf_counter()
    queues = [each for each in list(run.callback_queue.order.queues) if each.pause_end < now]
    queues = [each for each in queues if each is not run.callback_queue]
    for queue in queues:
        queue.pause(TURN_LIMIT)
    try:
        original(self, *args, **kwargs)
    finally:
        for queue in queues:
            queue.release()


# -- parameters, log, services


@patch('rospy.impl.masterslave', 'ROSHandler.paramUpdate')
def parameter_changed(original: Callable, run: Run, self: Any, *args: Any) -> tuple[int, str, int]:
    """rospy updates its own cache alone. This updates the node's parameters, too."""
    if len(args) > 1:  # rospy refuses a call with too few arguments
        run.read_parameters(args[1])
    return original(self, *args)


@patch('rospy.msproxy', 'MasterProxy.__setitem__')
@patch('rospy.msproxy', 'MasterProxy.__delitem__')
def set_parameter(original: Callable, run: Run, self: Any, key: str, *value: Any) -> None:
    """The master calls all other nodes at a change. This updates the node's own parameters, too."""
    original(self, key, *value)
    run.read_parameters(run.ros.resolve_name(key))


@replace('rospy.impl.rosout', 'rospy')
def rosout_without_master(original: Any, run: Run) -> Shim:
    """rospy asks the master at each log line, which registers a stopping node anew.

    This returns the default, and asks nobody.
    """
    return Shim(original, get_param_cached=lambda name, default=None: default)


@replace('rospy.service', 'ServiceException')
def service_exception(original: Any, run: Run) -> type[Exception]:
    """rospy's ServiceException would be another class for each node. Here all nodes share one."""
    return rospy.ServiceException


@patch('rospy.impl.tcpros_service', 'ServiceProxy.call')
def call_service(original: Callable, run: Run, self: Any, *args: Any, **kwargs: Any) -> Any:
    """rospy asks the master and connects for each call. A service of this process answers here.

    The caller waits for the answer anyway: so its thread may run the service's handler.
    """
    request = rospy.msg.args_kwds_to_message(self.request_class, args, kwargs)
    response = call_by_proxy(run, self, request)
    if response is None:
        return original(self, request)
    return response


@patch('rospy.impl.tcpros_service', 'ServiceImpl.handle')
def handle_call(original: Callable, run: Run, self: Any, connection: Any, header: dict) -> None:
    """rospy's thread ends with an exception if the client has gone. This closes the connection."""
    try:
        answer(run, original, self, connection, header)
    except (rospy.exceptions.TransportException, OSError):
        connection.close()
