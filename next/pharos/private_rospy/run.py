"""One run of one node: a rospy of its own, started and stopped."""
from __future__ import annotations

import atexit
import contextlib
import errno
import gc
import http.client
import itertools
import os
import socket
import sys
import threading
import time
import weakref
import xml.parsers.expat
import xmlrpc.client
from typing import Any, Callable, Iterable

import _thread

from pharos.errors import MasterUnreachableError, NodeNameInUseError, PortInUseError
from pharos.intraprocess.workers import Turns
from pharos.private_rospy import patches, transport
from pharos.private_rospy.loader import PrivateModules, Shim

MASTER_LIMIT = 5.0  # seconds for each question to a master or node
STOP_LIMIT = 2.0  # seconds likewise, when the node stops
WATCH_PERIOD = 1.0  # seconds between two looks at a master
UNREACHABLE = (
    OSError,
    xmlrpc.client.Error,
    http.client.HTTPException,
    xml.parsers.expat.ExpatError,
)
_METHODS = {'pub': 'registerPublisher', 'sub': 'registerSubscriber', 'srv': 'registerService'}
_stops = itertools.count(1)

#: the runs of this process by the URI of their node
runs: dict[str, Run] = {}
_watch_guard = threading.Lock()
_end_of_watch = threading.Event()


class ServerProxy(xmlrpc.client.ServerProxy):
    """One that gives up after a time limit in seconds."""

    limit = MASTER_LIMIT

    def __init__(self, uri: str, limit: float | None = None, **options: Any):
        proxy = self

        class Transport(xmlrpc.client.Transport):
            def make_connection(self, host):
                connection = super().make_connection(host)
                connection.timeout = proxy.limit if limit is None else limit
                if connection.sock:
                    connection.sock.settimeout(connection.timeout)
                return connection

        super().__init__(uri, **{'transport': Transport(), **options})


class Run:
    """A rospy with a node.

    :param name: the full name of the node
    :param ports: those of TCPROS and XML-RPC, 0 for any
    :param remappings: ROS's remappings and private parameters, as arguments
    :param callbacks: ``on_shutdown(reason)`` is called if ROS ends the node, ``on_parameter(name)``
        when a watched parameter changes, ``on_forgotten()`` when a restarted master has
        been told of the node again, ``on_refused(text)`` if a publisher sends another type,
        ``allows_shutdown()`` is True if any host may end the node
    """

    def __init__(
        self,
        name: str,
        master_url: str,
        domain: str | None,
        ports: tuple[int, int],
        remappings: Iterable[str],
        client_timeout: float,
        shares_connections: bool,
        **callbacks: Callable,
    ):
        self.name, self.master_url, self.ports = name, master_url, ports
        self.client_timeout, self.shares_connections = client_timeout, shares_connections
        vars(self).update(callbacks)
        namespace, _, self.base = name.rpartition('/')
        self.stopping = threading.Event()
        self.threads: weakref.WeakSet[threading.Thread] = weakref.WeakSet()
        self.sockets: weakref.WeakSet[socket.socket] = weakref.WeakSet()
        self.deadlines: dict[socket.socket, float] = {}  # of clients that are to say something
        self.publishers: dict[str, list[str]] = {}  # topic -> URIs, as the master last said
        self.connecting: set[tuple[str, str]] = set()  # topic, URI
        self.told: set[tuple[str, str]] = set()  # likewise: of whose loss the log knows
        self.uri, self.tcp_port, self.turns = '', 0, Turns(name)
        self.environ = {
            **os.environ,
            'ROS_MASTER_URI': master_url,
            'ROS_NAMESPACE': namespace or '/',
        }
        self.environ.setdefault('ROSCONSOLE_FORMAT', '[${severity}] [${time}]: ${node}: ${message}')
        if domain is not None:
            self.environ.pop('ROS_IP', None)
            self.environ['ROS_HOSTNAME'] = domain
        self.argv = [self.base, *remappings]
        self.modules = PrivateModules(
            self._substitutes(), lambda module: patches.apply(module, self)
        )
        self.ros = self.modules.load('rospy')
        self.core = self.modules.load('rospy.core')
        registration = self.modules.load('rospy.impl.registration')
        self.topics, self.services = (
            registration.get_topic_manager(),
            registration.get_service_manager(),
        )
        classes = transport.link_classes(self.modules.load('rospy.impl.transport'))
        self.Link, self.Follower = classes

    def _substitutes(self) -> dict[str, Any]:
        run = self

        class Thread(threading.Thread):
            """A daemon thread of the node's, which its stop waits for."""

            def start(self):
                self.daemon = True
                super().start()
                run.threads.add(self)

        class Proxy(ServerProxy):
            limit = property(lambda self: STOP_LIMIT if run.stopping.is_set() else MASTER_LIMIT)

        def sleep(seconds):
            if seconds <= 0 or not run.stopping.wait(seconds):
                time.sleep(0)

        self.Thread = Thread
        client = Shim(xmlrpc.client, ServerProxy=Proxy)
        start_thread = Shim(
            _thread, start_new_thread=lambda target, args: run.start_thread(lambda: target(*args))
        )
        return {
            'os': Shim(os, environ=self.environ),
            'sys': Shim(sys, argv=self.argv),
            'atexit': Shim(atexit, register=lambda function, *args, **kwargs: function),
            'threading': Shim(threading, Thread=Thread),
            'time': Shim(time, sleep=sleep),
            'socket': Shim(socket, setdefaulttimeout=lambda seconds: None),
            'xmlrpc': Shim(xmlrpc, client=client),
            'xmlrpc.client': client,
            '_thread': start_thread,
        }

    def start_thread(self, target: Callable[[], Any], name: str | None = None) -> threading.Thread:
        """Start a thread of the node's."""
        thread = self.Thread(target=target, name=name)
        thread.start()
        return thread

    # -- start

    def start(self, timeout: float) -> None:
        """Bind the ports, then register.

        :param timeout: seconds that the master may take to answer
        :raises MasterUnreachableError, NodeNameInUseError, PortInUseError: and nothing is left
        """
        global _end_of_watch
        base = self.modules.load('rospy.impl.tcpros_base')
        port, xmlrpc_port = self.ports
        try:
            self._check_name(timeout)
            server = base.init_tcpros_server(port)
            server.tcp_ros_server = base.TCPServer(server._tcp_server_callback, port)
            server.tcp_ros_server.start()
            self.tcp_port, port = server.tcp_ros_server.port, xmlrpc_port
            options = dict(xmlrpc_port=port, tcpros_port=self.tcp_port, disable_signals=True)
            self.ros.init_node(self.base, argv=self.argv, **options)
        except BaseException as error:
            self.stop(0, [])
            if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
                raise PortInUseError(
                    f'{self.name}: port {port} is in use: choose another one, or 0 for any'
                ) from None
            raise
        with _watch_guard:
            if not runs:
                _end_of_watch = threading.Event()
                watcher = threading.Thread(target=_watch, args=[_end_of_watch], daemon=True)
                watcher.start()
            runs[self.uri] = self
        for topic in list(self.topics.pubs):
            self.link_subscribers(topic)
        for topic in list(self.topics.subs):
            self.update_publishers(topic, self.publishers.get(topic, []))

    def _check_name(self, timeout: float) -> None:
        try:
            code, _, uri = ServerProxy(self.master_url, timeout).lookupNode('/pharos', self.name)
        except UNREACHABLE as error:
            raise MasterUnreachableError(
                f'{self.name} cannot start: no ROS master answers at {self.master_url} ({error}):'
                ' start roscore, or give the right URL'
            ) from None
        if code != 1:
            return
        with contextlib.suppress(*UNREACHABLE):
            if ServerProxy(uri, 1.0).getPid('/pharos'):
                raise NodeNameInUseError(
                    f'{self.name} is running already, at {uri}: choose another name, or end that one'
                )
        self.unregister_stale(uri)

    def unregister_stale(self, uri: str) -> None:
        """Unregister what a dead node of this name has left at the master."""
        master = ServerProxy(self.master_url)
        publishers, subscribers, services = master.getSystemState('/pharos')[2]
        for topic in (name for name, nodes in publishers if self.name in nodes):
            master.unregisterPublisher(self.name, topic, uri)
        for topic in (name for name, nodes in subscribers if self.name in nodes):
            master.unregisterSubscriber(self.name, topic, uri)
        for service in (name for name, nodes in services if self.name in nodes):
            code, _, address = master.lookupService(self.name, service)
            if code == 1:
                master.unregisterService(self.name, service, address)

    # -- registration and connections

    def call(self, method: str, *args: Any) -> Any:
        """Call the master in the name of the node; returns ``[code, message, value]``."""
        return getattr(self.core.xmlrpcapi(self.master_url), method)(self.name, *args)

    def register(self, kind: str, name: str, data: str) -> None:
        """Tell the master of a topic or service; the watcher repairs what it does not hear of."""
        try:
            code, _, value = self.call(_METHODS[kind], name, data, self.uri)
        except UNREACHABLE:
            return
        if kind == 'sub' and code == 1:
            self.update_publishers(name, value)
        elif kind == 'pub':
            self.link_subscribers(name)  # the master takes 0.1 s for that

    def link_subscribers(self, topic: str) -> None:
        """Link a publisher of this run with all subscriptions of this process."""
        for other in list(runs.values()):
            if other.master_url == self.master_url and topic in other.topics.subs:
                other.connect(topic, self.uri)

    def update_publishers(self, topic: str, uris: list[str]) -> None:
        """Connect to the publishers of a topic that the master names."""
        self.publishers[topic] = uris
        for uri in uris:
            if uri in runs:
                self.connect(topic, uri)
            else:
                self.start_thread(lambda uri=uri: self.connect(topic, uri), f'connect {topic}')

    def connect(self, topic: str, uri: str) -> None:
        """Connect a subscription to a publisher, unless it is or is about to be."""
        subscription = self.topics.subs.get(topic)
        if self.stopping.is_set() or not subscription or subscription.has_connection(uri):
            return
        if (topic, uri) in self.connecting:
            return
        self.connecting.add((topic, uri))
        try:
            if uri in runs:
                refusal = transport.connect(runs[uri], self, topic)
                if refusal:
                    self.on_refused(topic, refusal)
                return
            if self.shares_connections and transport.follow(self, topic, uri, subscription):
                return
            if not self.handler.done and self.handler._connect_topic(topic, uri)[0] != 1:
                self.start_thread(lambda: self.connect_again(topic, uri), f'connect {topic}')
        except AttributeError:
            if topic in self.topics.subs:
                raise  # else it was closed meanwhile, for which rospy does not look
        finally:
            self.connecting.discard((topic, uri))

    def connect_again(self, topic: str, uri: str) -> None:
        """Connect once more after a while, if the master still names the publisher."""
        if not self.stopping.wait(transport.RETRY_DELAY) and uri in self.publishers.get(topic, ()):
            self.connect(topic, uri)

    def register_missing(self, state: list) -> None:
        """Register what is not in the master's system state."""
        registries = (
            ('pub', self.topics.lock, self.topics.get_publications),
            ('sub', self.topics.lock, self.topics.get_subscriptions),
            ('srv', self.services.lock, self.services.get_services),
        )
        forgotten = False
        for (kind, lock, own), theirs in zip(registries, map(dict, state)):
            for name, data in own():
                if self.name in theirs.get(name, ()) or name not in self.known[kind]:
                    continue
                forgotten = True
                with lock:  # what is closed meanwhile stays closed
                    if not self.stopping.is_set() and [name, data] in [
                        list(each) for each in own()
                    ]:
                        self.register(kind, name, data)
            self.known[kind] = {name for name, _ in own()}
        if forgotten and not self.stopping.is_set():
            self.on_forgotten()

    def close_late_clients(self) -> None:
        """Close the clients that take too long to say what they want."""
        for sock, deadline in list(self.deadlines.items()):
            if time.monotonic() > deadline:
                self.deadlines.pop(sock, None)
                shut(sock)

    # -- stop

    def stop(self, timeout: float, left: list[threading.Thread]) -> list[str]:
        """Send what is under way, unregister, free ports and threads.

        :param timeout: seconds for what is under way, and for threads
        :param left: threads not to be waited for
        :returns: the names of the threads that go on
        """
        self.stopping.set()
        with _watch_guard:
            runs.pop(self.uri, None)
            if not runs:
                _end_of_watch.set()
        ended = self.turns.close(timeout)
        deadline = time.monotonic() + timeout
        for publisher in list(self.topics.pubs.values()):
            for connection in publisher.connections:
                if isinstance(connection, transport.Sender):
                    connection.flush(deadline)
        impls = [*self.topics.pubs.values(), *self.topics.subs.values()]
        self.end_rospy('stop')
        for sock in list(self.sockets):
            shut(sock)
        for impl in impls:
            impl.connection_poll.poller.close()
        for proxy in self.core._xmlrpc_cache.values():
            proxy('close')()
        left_threads = join([thread for thread in self.threads if thread not in left], STOP_LIMIT)
        self.modules.close_logging()
        gc.collect(2 if next(_stops) % 20 == 0 else 1)
        return [thread.name for thread in left_threads] + ([] if ended else ['a delegate'])


def shut(sock: socket.socket) -> None:
    """Have whoever reads from a socket find it closed."""
    with contextlib.suppress(OSError):
        sock.shutdown(socket.SHUT_RDWR)


def join(threads: Iterable[threading.Thread], timeout: float) -> list[threading.Thread]:
    """Wait for the end of threads other than this one; returns those that go on."""
    deadline = time.monotonic() + timeout
    threads = [thread for thread in threads if thread is not threading.current_thread()]
    for thread in threads:
        thread.join(max(0.0, deadline - time.monotonic()))
    return [thread for thread in threads if thread.is_alive()]


def local_service(master_url: str, name: str, uri: str | None = None) -> tuple[Run, Any] | None:
    """Return the run of this process that offers a service, and its rospy.Service."""
    for run in list(runs.values()):
        service = run.services.get_service(name)
        if service and run.master_url == master_url and uri in (None, service.uri):
            return run, service
    return None


def _watch(end: threading.Event) -> None:
    """Ask each master once a second what it knows of our nodes: it may have been started again."""
    while not end.wait(WATCH_PERIOD):
        nodes = list(runs.values())
        for run in nodes:
            run.close_late_clients()
            run.topics.check_all()  # rospy looks twice a second who has left (ros_comm #927)
        for url in {run.master_url for run in nodes}:
            with contextlib.suppress(*UNREACHABLE):
                state = ServerProxy(url).getSystemState('/pharos')[2]
                for run in nodes:
                    if run.master_url == url and not run.stopping.is_set():
                        run.register_missing(state)
