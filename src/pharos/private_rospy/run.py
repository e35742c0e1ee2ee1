"""One run of one node: a rospy of its own, started and stopped."""
import atexit
import errno
import functools
import os
import socket
import sys
import threading
import time
import xmlrpc
from contextlib import suppress
from http.client import HTTPException
from time import monotonic
from urllib.parse import urlsplit
from weakref import WeakSet
from xml.parsers.expat import ExpatError
from xmlrpc import client as xmlrpc_client

from pharos.errors import MasterUnreachableError, NodeNameInUseError, PharosError, PortInUseError
from pharos.intraprocess.workers import Turns
from pharos.private_rospy import patches, transport
from pharos.private_rospy.loader import PrivateModules, Shim, own_path
from pharos.private_rospy.transport import runs

MASTER_LIMIT = 5.0  # seconds for each question to a master or node
STOP_LIMIT = 2.0  # seconds that a stop waits for threads of rospy
HOLD_LIMIT = 2.0  # seconds that delegates wait for the end of start(), which may wait for them
RETRY_DELAY = 1.0  # seconds until the next attempt to connect
WATCH_PERIOD = 0.25  # seconds between two looks; each fourth is at the masters, too
UNREACHABLE = OSError, xmlrpc_client.Error, HTTPException, ExpatError
_METHODS = {'pub': 'registerPublisher', 'sub': 'registerSubscriber', 'srv': 'registerService'}
_end_of_watch = threading.Event()


class _Transport(xmlrpc_client.Transport):
    def make_connection(self, host):
        connection = super().make_connection(host)
        connection.timeout = self.limit
        return connection

    def single_request(self, *args):
        try:
            return super().single_request(*args)
        finally:  # a call that Ctrl-C ended would spoil the next one
            self.close()


class ServerProxy(xmlrpc_client.ServerProxy):
    """One that gives up after ``limit`` seconds."""

    def __init__(self, uri, limit=MASTER_LIMIT):
        transport = _Transport()
        transport.limit = limit
        super().__init__(uri, transport)


class Run:
    """A rospy with a node.

    :param node: a Node, with a name, ports, settings, and methods that are called: ``_end_now()`` if
        ROS ends it, ``_read_parameters()``, ``_refused(topic, reason)``
    """

    uri = ''

    def __init__(self, node):
        self.node, self.name = node, node._name
        self.master_url = node._master.url
        self.stopping = threading.Event()
        self.over = threading.Event()  # set when threads that are left have nothing more to do
        self.threads = WeakSet()
        self.sockets, self.calls = WeakSet(), WeakSet()
        self.deadlines = {}  # socket of a client that is to say something -> until when
        self.publisher_uris = {}  # topic -> URIs, as the master last said
        self.connecting = set()  # (topic, URI, ...)
        self.relays = {}  # (topic, URI, class) -> publisher to those that share a connection
        self.turns = Turns()
        self.turns.hold()  # until the node's start() has returned
        self.hold_deadline = monotonic() + (HOLD_LIMIT if node._is_beginning else 0.0)
        namespace, _, self.base = node._name.rpartition('/')
        self.environ = {
            'ROSCONSOLE_FORMAT': '[${severity}] [${time}]: ${node}: ${message}',
            **os.environ,
            'ROS_MASTER_URI': node._master.url,
            'ROS_NAMESPACE': namespace or '/',
        }
        if node._domain:  # it comes before ROS_IP
            self.environ['ROS_HOSTNAME'] = node._domain
        self.argv = [self.base, *node._remappings]
        self.path = own_path()
        patch = functools.partial(patches.apply, run=self)
        self.modules = PrivateModules(self.substitutes(), patch)
        self.ros = self.modules.load('rospy')
        self.core = self.ros.core
        registration = self.modules.load('rospy.impl.registration')
        self.topics = registration.get_topic_manager()
        self.services = registration.get_service_manager()

    def substitutes(self):
        """Return what the node's modules import instead of some modules of Python."""
        run = self

        class Thread(threading.Thread):
            """A daemon thread of the node's, which its stop waits for."""

            def start(self):
                self.daemon = True
                super().start()
                run.threads.add(self)

        self.Thread = Thread
        client = Shim(xmlrpc_client, ServerProxy=ServerProxy)
        return {
            'os': Shim(os, environ=self.environ, register_at_fork=lambda **hooks: None),
            'sys': Shim(sys, argv=self.argv, path=self.path),
            'atexit': Shim(atexit, register=lambda function, *args, **kwargs: function),
            'threading': Shim(threading, Thread=Thread),
            'time': Shim(time, sleep=self.sleep),
            'socket': Shim(socket, setdefaulttimeout=lambda seconds: None),
            'xmlrpc': Shim(xmlrpc, client=client),
            'xmlrpc.client': client,
        }

    def start_thread(self, target):
        """Start a thread of the node's, and return it."""
        thread = self.Thread(target=target)
        thread.start()
        return thread

    def sleep(self, seconds):
        """Stand in for ``time.sleep``: the stop of the node ends it."""
        if self.over.is_set():
            raise SystemExit  # in a thread that was left behind
        if seconds <= 0 or not self.stopping.wait(seconds):
            time.sleep(0)

    def checkpoint(self):
        """Do what a signal asks for; rospy's loops call it when they publish or look for their end."""

    def signal_shutdown(self, reason):
        """Stop the node; stands in for ``rospy.signal_shutdown``."""
        self.end_node()

    # -- start

    def start(self, **options):
        """Bind the ports, then register; tell the node its address.

        :param options: more of those of ``rospy.init_node``

        :raises MasterUnreachableError, NodeNameInUseError, PortInUseError: stop() undoes the rest
        """
        base, node = self.modules.load('rospy.impl.tcpros_base'), self.node
        taken = node._master.call('lookupNode', self.name)
        port, xmlrpc_port = node._ports
        with suppress(*UNREACHABLE):
            if taken and ServerProxy(taken, 1.0).getPid('/pharos'):
                raise NodeNameInUseError(
                    f'{self.name} is running already, at {taken}: choose another name, or end that one'
                )
        try:
            server = base.init_tcpros_server(port)
            tcp = server.tcp_ros_server = base.TCPServer(server._tcp_server_callback, port)
            tcp.server_sock.listen(128)  # rospy lets five clients wait
            tcp.start()
            port = xmlrpc_port
            options = {
                'disable_signals': True,
                **options,
                'xmlrpc_port': port,
                'tcpros_port': tcp.port,
            }
            self.modules.load('rospy.client').init_node(self.base, self.argv, **options)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            raise PortInUseError(
                f'{self.name}: port {port} is in use: choose another one, or 0 for any'
            ) from None
        address = urlsplit(self.uri)
        node._ports = tcp.port, address.port
        node._domain = node._domain or address.hostname
        node.uri = self.uri
        node.tcp_port, node.xmlrpc_port = node._ports
        node.domain = node._domain

    def ready(self, handler, uri):
        """Be found and watched: the servers run, and nothing is registered yet."""
        self.handler, self.uri = handler, uri
        handler.pharosHealth = lambda caller_id: (1, '', self.node._told())
        with transport.guard:
            if not runs:
                _end_of_watch.clear()
                threading.Thread(target=_watch, daemon=True).start()
            runs[uri] = self

    # -- registration and connections

    def register(self, kind, name, data):
        """Tell the master of a topic or service; the watcher repairs what it does not hear of."""
        with suppress(MasterUnreachableError):
            value = self.node._master.call(
                _METHODS[kind], name, data, self.uri, caller_id=self.name
            )
            if kind == 'sub' and value:
                self.publisher_uris[name] = value
        for other in list(runs.values()) if kind == 'pub' else ():  # sooner than the master
            if other.master_url == self.master_url:
                other.connect(name, self.uri)

    def connect_all(self, topic):
        """Connect to the publishers of a topic that the master has named."""
        for uri in self.publisher_uris.get(topic, ()):
            connect = functools.partial(self.connect, topic, uri)
            connect() if uri in runs else self.start_thread(connect)

    def connect(self, topic, uri):
        """Connect a subscription to a publisher, unless it is or is about to be."""
        subscription, key = self.topics.subs.get(topic), (topic, uri)
        if self.stopping.is_set() or not subscription or subscription.has_connection(uri):
            return
        attempt = *key, id(subscription)
        if attempt in self.connecting:
            return
        self.connecting.add(attempt)
        code = 0
        try:
            if uri in runs:
                transport.link(runs[uri], self, topic)
            elif self.node._master.share_connections and transport.follow(self, *key, subscription):
                pass
            elif (code := self.handler._connect_topic(*key)[0]) != 1:
                self.start_thread(lambda: self.connect_again(*key))
        except (AttributeError, UnboundLocalError):  # rospy's, if it was closed meanwhile
            pass
        finally:
            self.connecting.discard(attempt)
            if code != 1:
                transport.end_share(self, *key, subscription)

    def connect_again(self, topic, uri, error=None):
        """Connect once more after a while, if the master still names the publisher."""
        if not self.stopping.wait(RETRY_DELAY) and uri in self.publisher_uris.get(topic, ()):
            if error:
                self.ros.logwarn_throttle_identical(
                    60, f'{topic}: no connection to {uri}, it is tried again: {error}'
                )
            self.connect(topic, uri)

    def register_missing(self, state):
        """Register what is not in the master's system state."""
        topics, services = self.topics, self.services
        known = {
            (kind, name)
            for kind, names in zip(_METHODS, state)
            for name, nodes in names
            if self.name in nodes
        }
        ours = topics.get_publications, topics.get_subscriptions, services.get_services
        with topics.lock, services.lock:  # what is closed meanwhile stays closed
            own = [(kind, *each) for kind, get in zip(_METHODS, ours) for each in get()]
            for each in own:
                if each[:2] not in known and not self.stopping.is_set():
                    self.register(*each)
                    self.connect_all(each[1])
        if not known and not self.stopping.is_set():  # the master has begun anew
            self.modules.load('rospy.client')._init_node_params(self.argv, self.name)
            for parameter in self.node._parameters:
                parameter.subscribe()

    def limit(self, sock):
        """Close a client's socket if it says nothing within the node's client_timeout."""
        self.deadlines[sock] = monotonic() + self.node.client_timeout

    # -- stop

    def end_node(self):
        """Stop the node, in another thread."""
        threading.Thread(target=self.node._end_now).start()  # no stop waits for it

    def shut_rospy_down(self, timeout):
        """Send what is under way, unregister, and close all topics and services.

        :param timeout: seconds for what is under way
        """
        self.stopping.set()
        with transport.guard:
            runs.pop(self.uri, None)
            if not runs:
                _end_of_watch.set()
        for sock in list(self.calls):
            transport.shut(sock)
        deadline = monotonic() + timeout
        for publisher in list(self.topics.pubs.values()):
            publisher.flush(deadline)
        self.shut_down('stop')  # rospy's own; its name calls signal_shutdown()

    def stop(self, timeout):
        """Send what is under way, unregister, free ports and threads; log what is left behind.

        :param timeout: seconds for souls, and as long for what is under way
        """
        self.stopping.set()
        for sock in list(self.calls):
            transport.shut(sock)
        left = [thread.name for thread in join(self.node._souls, timeout)]
        if not self.turns.close(timeout):
            left.append('a delegate')
        if left:
            self.ros.logwarn(f'left behind, since they did not end in time: {", ".join(left)}')
        self.shut_rospy_down(timeout)
        for sock in list(self.sockets):
            transport.shut(sock)
        join(set(self.threads) - set(self.node._souls), STOP_LIMIT)
        self.over.set()
        log = self.modules.load('logging')
        log.disable()  # or a thread that is late opens the file again
        log.shutdown()
        for sock in list(self.sockets):
            sock.close()


def join(threads, timeout):
    """Wait for the end of threads other than this one; returns those that go on."""
    deadline = monotonic() + timeout
    others = [thread for thread in threads if thread is not threading.current_thread()]
    for thread in others:
        thread.join(max(0.0, deadline - monotonic()))
    return [thread for thread in others if thread.is_alive()]


def _watch():
    """Look who has left or is silent; ask each master what it knows of our nodes, once a second."""
    looks = 0
    while not _end_of_watch.wait(WATCH_PERIOD):
        looks += 1
        nodes = list(runs.values())
        for run in nodes:
            run.topics.check_all()  # who has left (ros_comm #927)
            if monotonic() > run.hold_deadline:
                run.turns.release()
            for sock, deadline in list(run.deadlines.items()):
                if monotonic() > deadline:
                    run.deadlines.pop(sock, None)
                    transport.shut(sock)
        for url in () if looks % 4 else {run.master_url for run in nodes}:
            with suppress(*UNREACHABLE, PharosError):
                state = ServerProxy(url).getSystemState('/pharos')[2]
                for run in nodes:
                    if run.master_url == url and not run.stopping.is_set():
                        run.register_missing(state)
