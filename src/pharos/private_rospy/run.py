"""Run: a node's life from a start to a stop, with its own rospy, souls, endpoints and failures.

One thread of this process, the watcher, looks after all runs.
"""
from __future__ import annotations

import atexit
import dataclasses
import enum
import errno
import functools
import os
import socket
import sys
import threading
import time
import xmlrpc.client
from contextlib import suppress
from http.client import HTTPException
from time import monotonic
from typing import TYPE_CHECKING, Sequence
from urllib.parse import urlsplit
from weakref import WeakSet
from xml.parsers.expat import ExpatError

from pharos.blocks import block_name
from pharos.errors import (
    MasterUnreachableError,
    MessageTypeError,
    NodeNameInUseError,
    PharosError,
    PortInUseError,
)
from pharos.failures import Failure, Failures
from pharos.intraprocess.callback_queues import CallbackOrder, CallbackQueue
from pharos.intraprocess.links import link_topic, runs, runs_lock
from pharos.private_rospy import patches
from pharos.private_rospy.loader import PrivateModules, Shim, private_path
from pharos.private_rospy.tcpros import shutdown_socket
from pharos.signals import may_be_signal
from pharos.transcript import Transcript
from pharos.waiting import let_others_run

if TYPE_CHECKING:
    from pharos.master import Master

MASTER_LIMIT = 5.0  # seconds for each question to a master or node
NAME_LIMIT = 1.0  # seconds for the question whether another node has the name
STOP_LIMIT = 2.0  # seconds that a stop waits for threads of rospy
CLOCK_LIMIT = 3.0  # seconds until a clock that stands still is told
HOLD_LIMIT = 2.0  # seconds that delegates wait for the end of start(); start() may wait for them
RETRY_DELAY = 1.0  # seconds until the next attempt to connect
WATCH_PERIOD = 0.5  # seconds between two looks of the watcher
LOOKS_PER_MASTER = 4  # looks of the watcher for each one at the masters
BACKLOG = 128  # clients that may wait for a connection; rospy allows five
UNREACHABLE = OSError, xmlrpc.client.Error, HTTPException, ExpatError
#: rospy's names of registries, in the order of the master's system state -> methods of the master
_REGISTER_METHODS = {
    'pub': 'registerPublisher',
    'sub': 'registerSubscriber',
    'srv': 'registerService',
}
_end_of_watch = threading.Event()


class Lifecycle(enum.Enum):
    """The states of a node; see :attr:`Node.lifecycle`."""

    NEW = 'new'
    STARTING = 'starting'
    RUNNING = 'running'
    STOPPING = 'stopping'
    STOPPED = 'stopped'


@dataclasses.dataclass
class Settings:
    """The settings of a node that hold for all its runs.

    :ivar name: the full name
    :ivar domain: the address that the node advertises; None until the first run has found one
    :ivar ports: for messages, and for ROS's calls; 0 until the first run has found one
    :ivar remappings: ROS's remappings and private parameters, such as '/a:=/b' and '_rate:=5'
    """

    name: str
    master: Master
    domain: str | None
    ports: tuple[int, int]
    remappings: Sequence[str]


class _Transport(xmlrpc.client.Transport):
    def make_connection(self, host):
        connection = super().make_connection(host)
        connection.timeout = self.limit
        return connection

    def single_request(self, *args):
        try:
            return super().single_request(*args)
        finally:  # a call that Ctrl-C ended leaves an answer, which the next call would read
            self.close()


class ServerProxy(xmlrpc.client.ServerProxy):
    """A proxy of the XML-RPC server at a URI; a call raises one of UNREACHABLE after a limit.

    :param limit: seconds
    """

    def __init__(self, uri, limit=MASTER_LIMIT):
        transport = _Transport()
        transport.limit = limit
        super().__init__(uri, transport)


class Run:
    """One run of a node. The node's start() makes the run; the next start makes another one.

    A stopped run stays with its node: its failures can still be read.

    :param node: the Node
    :param settings: the :class:`Settings` of the node
    :ivar ros: the node's own rospy
    :ivar modules: the private modules
    :ivar callback_queue: the CallbackQueue of the node's delegates
    :ivar ros_handler: rospy's ROSHandler, from make_findable() on
    :ivar rospy_signal_shutdown: rospy's own function, which a patch replaces
    """

    uri = ''  # of the XML-RPC server; '' until the server runs
    lacks_memory = False  # True if the system had no memory or descriptor for a memory file
    lifecycle = Lifecycle.STARTING

    def __init__(self, node, settings):
        self.node = node
        self.settings = settings
        self.name = settings.name
        self.master = settings.master
        self.failures = Failures()
        self.souls = {}  # thread -> its block, None for the node's soul, and True if it is required
        self.endpoints = []  # also those that the stop has closed, for the next start
        self.stopping = threading.Event()  # set when a stop begins: sleeps and waits end
        self.finished = threading.Event()  # set at the end of a stop: threads left behind end
        self.threads = set()
        self.ended_cpu_seconds = 0.0  # of threads that have ended
        self.troubles = set()  # texts for the log: a publisher must not log while it holds locks
        self.sockets = WeakSet()
        self.calls = WeakSet()  # sockets of calls of services
        self.deadlines = {}  # socket of a silent client -> the time when it is closed
        self.publisher_uris = {}  # topic -> URIs, the last list of the master
        self.retries = {}  # (topic, URI) -> the time to connect again, and the last error
        self.connecting = set()  # (topic, URI, id of the subscription) of attempts that go on
        self.callback_order = CallbackOrder(self.start_thread)
        self.callback_queue = CallbackQueue(self.callback_order)
        self.callback_queue.hold()  # until the node's start() has returned
        self.hold_deadline = monotonic()  # the watcher ends the hold at its next look after this
        if node._holds_delegates:  # else a user calls start(): there is no release after its end
            self.hold_deadline += HOLD_LIMIT
        namespace, _, self.base_name = self.name.rpartition('/')
        self.clock_deadline = monotonic() + CLOCK_LIMIT  # when a clock that stands is told
        self.environ = {
            'ROSCONSOLE_FORMAT': '[${severity}] [${time}]: ${node}: ${message}',
            **os.environ,
            'ROS_MASTER_URI': self.master.url,
            'ROS_NAMESPACE': namespace or '/',
        }
        if settings.domain:  # rospy looks for ROS_HOSTNAME before ROS_IP
            self.environ['ROS_HOSTNAME'] = settings.domain
        self.argv = [self.base_name, *settings.remappings]
        self.path = private_path()
        patch = functools.partial(patches.apply, run=self)
        self.modules = PrivateModules(self.substitutes(), patch)
        self.ros = self.modules.load('rospy')
        self.core = self.ros.core
        self.write_log = self.core._base_logger
        registration = self.modules.load('rospy.impl.registration')
        self.topic_manager = registration.get_topic_manager()
        self.service_manager = registration.get_service_manager()

    def substitutes(self):
        """Return the stand-ins that the node's modules import for some modules of Python."""
        run = self

        class Thread(threading.Thread):
            """A daemon thread of the node; the node's stop waits for its end."""

            def start(self):
                self.daemon = True
                run.threads.add(self)  # before its start: a stop waits for it
                self.run = functools.partial(run.run_thread, self, self.run)
                super().start()

        self.Thread = Thread
        client = Shim(xmlrpc.client, ServerProxy=ServerProxy)
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

    def run_thread(self, thread, target):
        """Run the target of a thread of the node, in this thread."""
        try:
            target()
        finally:
            self.ended_cpu_seconds += time.thread_time()
            self.threads.discard(thread)

    def start_thread(self, target):
        """Start a thread of the node, and return the thread.

        :returns: None if the system has no thread left: the caller must try again, or close what
            needs the thread; the watcher tells the log
        """
        function = getattr(target, 'func', target)
        thread = self.Thread(target=target, name=f'{self.name} ({function.__name__.strip("_")})')
        try:
            thread.start()
        except RuntimeError as error:
            self.troubles.add(
                f'{self.name} lacks a thread, and tries again: {error}; see ulimit -u'
            )
            return None
        return thread

    def sleep(self, seconds):
        """Stand in for ``time.sleep``: the node's stop ends the sleep.

        After the stop, a sleep ends its thread.
        """
        if self.finished.is_set():
            raise SystemExit  # in a thread that was left behind
        if seconds <= 0:
            let_others_run()
            return
        is_stopping = self.stopping.wait(seconds)
        if is_stopping:  # a loop may sleep on
            let_others_run()

    def checkpoint(self):
        """Do nothing: a run of a script handles its signals here.

        publish() and is_shutdown() call this, and so all loops of rospy programs do.
        """

    def signal_shutdown(self, reason):
        """Stand in for ``rospy.signal_shutdown``: stop the node in another thread."""
        self.request_stop()

    # -- state

    @property
    def is_active(self):
        """True if the node is registered: it runs, or its stop goes on."""
        return self.lifecycle in (Lifecycle.RUNNING, Lifecycle.STOPPING)

    def open_endpoints(self, endpoint_class):
        """Return the endpoints of a class that are open."""
        return [
            endpoint
            for endpoint in self.endpoints
            if isinstance(endpoint, endpoint_class) and not endpoint.closed
        ]

    def mark_stopped(self):
        """Mark the run as stopped, and its endpoints as closed."""
        for endpoint in self.endpoints:
            endpoint.closed = True
        self.lifecycle = Lifecycle.STOPPED

    def health_facts(self):
        """Return the facts of Node.health(), without the master's; ``pharos top`` asks for them."""
        from pharos.live.snapshot import health_facts

        return health_facts(self)

    def cpu_seconds(self):
        """Return the CPU time of the node's threads."""
        seconds = self.ended_cpu_seconds
        for thread in list(self.threads):
            with suppress(OSError):  # the thread ends at this moment
                if thread.is_alive():
                    seconds += time.clock_gettime(time.pthread_getcpuclockid(thread.ident))
        return seconds

    # -- failures

    def report_failure(self, error, block, role, message=None, channel=None, retry=None):
        """Keep an exception of a block; at the 1st, 10th, 100th time, log and show the exception.

        An exception that may come from a signal is raised again: Ctrl-C ends the program.

        :param role: the word for the block in the text, such as 'delegate'
        :param message: the message, request or value that the block was run on
        :param channel: the message's channel, or None
        :param retry: ``retry(message)`` runs the block again
        """
        if isinstance(error, (KeyboardInterrupt, SystemExit)) and may_be_signal():
            raise error
        failure = self.keep_failure(error, block, message, channel, retry)
        is_power_of_ten = str(failure.count).strip('0') == '1'
        if not is_power_of_ten:
            return
        with suppress(Exception):  # log or Transcript may not be writable: the node goes on
            text = f'{role} {block_name(block)} of {self.name}'
            if channel:
                text += f' on {channel.topic}'
            text += f' raised {type(error).__name__}: {error}'
            if failure.count > 1:
                text += f' ({failure.count} times)'
            log_text = f'{text}\n{failure.traceback[:-1]}'
            try:
                self.ros.logerr('%s', log_text.replace('\n', f'\n{self.name}: '))
            finally:
                if Transcript.receiver:  # else it would stand on the terminal twice
                    Transcript.show(text)

    def keep_failure(self, error, block, message=None, channel=None, retry=None):
        """Keep an exception of a block, without a log line, and return the Failure."""
        failure = Failure(error, block, message, channel, retry)
        self.failures.keep(failure)
        return failure

    def report_refusal(self, topic, reason):
        """Report a publisher that sends another type as a failure of the node."""
        error = MessageTypeError(f'{self.name} does not receive from {topic}: {reason}')
        self.report_failure(error, topic, 'connection')

    # -- start

    def start(self, **options):
        """Bind the ports, start the servers, and set the address and ports of the node.

        :param options: further options of ``rospy.init_node``
        :raises MasterUnreachableError, NodeNameInUseError, PortInUseError: stop() then cleans up
        """
        self._check_name_free()
        tcpros_base = self.modules.load('rospy.impl.tcpros_base')
        tcp_port, xmlrpc_port = self.settings.ports
        asked_port = tcp_port
        try:
            # rospy's own start finds this server, and makes none: rospy does not report a busy port
            server = tcpros_base.init_tcpros_server(tcp_port)
            tcp_server = tcpros_base.TCPServer(server._tcp_server_callback, tcp_port)
            server.tcp_ros_server = tcp_server
            tcp_server.server_sock.listen(BACKLOG)
            tcp_server.start()
            asked_port = xmlrpc_port
            ports = {'xmlrpc_port': xmlrpc_port, 'tcpros_port': tcp_server.port}
            options = {'disable_signals': True, **options, **ports}
            self.modules.load('rospy.client').init_node(self.base_name, self.argv, **options)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            raise PortInUseError(
                f'{self.name}: port {asked_port} is in use: choose another one, or 0 for any'
            ) from None
        address = urlsplit(self.uri)
        self.settings.ports = tcp_server.port, address.port
        self.settings.domain = self.settings.domain or address.hostname
        node = self.node
        node.uri = self.uri
        node.tcp_port, node.xmlrpc_port = self.settings.ports
        node.domain = self.settings.domain

    def _check_name_free(self):
        """Raise NodeNameInUseError if a node of this name answers within NAME_LIMIT."""
        uri = self.master.call('lookupNode', self.name)
        if not uri:
            return
        name = None
        with suppress(*UNREACHABLE):
            proxy = ServerProxy(uri, NAME_LIMIT)
            proxy.getPid('/pharos')  # raises if the URI is dead
            name = self.name
            name = proxy.getName('/pharos')[2]  # another node may have the URI; roscpp raises
        if name == self.name:
            raise NodeNameInUseError(
                f'{name} is running already, at {uri}: choose another name, or end that one'
            )

    def make_findable(self, handler, uri):
        """Offer shared memory and the facts for top; enter the run into ``links.runs``.

        The patch ``ready`` calls this when the XML-RPC server runs, before anything is registered.

        :param handler: rospy's ROSHandler
        :param uri: the URI of the node's XML-RPC server
        """
        self.ros_handler = handler
        self.uri = uri
        if self.master.shared_memory:
            from pharos.shared_memory.receiving import SharedMemoryHandler

            handler.protocol_handlers.insert(0, SharedMemoryHandler(self))
        handler.pharosHealth = lambda caller_id: (1, '', self.health_facts())
        with runs_lock:
            if not runs:
                _end_of_watch.clear()
                threading.Thread(target=_watch_runs, daemon=True).start()
            runs[uri] = self

    # -- registration and connections

    def register(self, registry, name, data):
        """Register a topic or service at the master; try once, since the watcher repairs the rest.

        Have all nodes of this process connect to a new publisher.

        :param registry: rospy's name of the registry: 'pub', 'sub' or 'srv'
        :param data: the name of the topic's type, or the URI of the service
        """
        method = _REGISTER_METHODS[registry]
        with suppress(MasterUnreachableError):
            publishers = self.master.call(method, name, data, self.uri, caller_id=self.name)
            if registry == 'sub' and publishers is not None:
                self.publisher_uris[name] = publishers
        if registry == 'pub':  # sooner than by the master's publisherUpdate
            for run in list(runs.values()):
                if run.master.url == self.master.url:
                    run.connect(name, self.uri)

    def connect_all(self, topic):
        """Connect to the publishers of a topic, from the last list of the master.

        Link those of this process in this thread, and connect to others in threads.
        """
        for uri in self.publisher_uris.get(topic, ()):
            if uri in runs:
                self.connect(topic, uri)
            else:
                self.start_connecting(topic, uri)

    def connect(self, topic, uri):
        """Connect the subscription of a topic to a publisher, by a link or a socket.

        Do nothing if they are connected, or if another thread connects them already.

        :param uri: the URI of the publisher's node
        """
        subscription = self.topic_manager.subs.get(topic)
        if self.stopping.is_set() or not subscription or subscription.has_connection(uri):
            return
        attempt = topic, uri, id(subscription)
        if attempt in self.connecting:
            return
        self.connecting.add(attempt)
        try:
            publisher_run = runs.get(uri)
            if publisher_run:
                link_topic(publisher_run, self, topic)
            else:
                self._negotiate(topic, uri, subscription)
        finally:
            self.connecting.discard(attempt)

    def _negotiate(self, topic, uri, subscription):
        """Have rospy offer the protocols of make_findable() and TCPROS, and connect by one."""
        code = None
        reason = ''
        try:
            code, _, _ = self.ros_handler._connect_topic(topic, uri)
        except (AttributeError, UnboundLocalError):
            pass  # rospy raises these if the subscription is closed meanwhile
        except RuntimeError as error:  # no thread is left, but rospy has added the connection
            reason = str(error)
            for connection in subscription.connections:
                if connection.endpoint_id == uri:
                    connection.close()
            code = 0
        if code not in (1, None):
            self.connect_later(topic, uri, reason)

    def connect_later(self, topic, uri, reason=''):
        """Have the watcher connect after RETRY_DELAY, if the master still names the publisher.

        :param reason: the text of the last error, for the log, or ''
        """
        self.retries[topic, uri] = monotonic() + RETRY_DELAY, reason

    def _retry_connections(self):
        for (topic, uri), (retry_time, reason) in list(self.retries.items()):
            if monotonic() < retry_time:
                continue
            del self.retries[topic, uri]
            if uri not in self.publisher_uris.get(topic, ()):
                continue
            if reason:
                self.troubles.add(f'{topic}: no connection to {uri}, it is tried again: {reason}')
            self.start_connecting(topic, uri)

    def start_connecting(self, topic, uri):
        """Connect in a thread, or later if the system has none left."""
        if not self.start_thread(functools.partial(self.connect, topic, uri)):
            self.connect_later(topic, uri)

    def register_missing(self, state):
        """Register the topics and services that the master's system state lacks.

        If the master knows nothing of the node, set its parameters anew, too.

        :param state: lists of (name, nodes) for publishers, subscribers and services
        """
        registered = set()
        for registry, entries in zip(_REGISTER_METHODS, state):
            registered.update((registry, name) for name, nodes in entries if self.name in nodes)
        topics = self.topic_manager
        services = self.service_manager
        getters = topics.get_publications, topics.get_subscriptions, services.get_services
        with topics.lock, services.lock:  # or a topic closed meanwhile would be registered again
            for registry, get_entries in zip(_REGISTER_METHODS, getters):
                for name, data in get_entries():
                    is_known = (registry, name) in registered
                    if not is_known and not self.stopping.is_set():
                        self.register(registry, name, data)
                        self.connect_all(name)
        if not registered and not self.stopping.is_set():  # this is a new master
            self.modules.load('rospy.client')._init_node_params(self.argv, self.name)
            for parameter in self.node._parameters:
                parameter.subscribe()

    def read_parameters(self):
        """Have the node's parameters read their values from the server."""
        for parameter in self.node._parameters:
            parameter.read()

    def limit_silence(self, sock):
        """Have the watcher shut a client's socket after the node's client_timeout.

        A client that speaks in time is taken out of ``deadlines``.
        """
        self.deadlines[sock] = monotonic() + self.node.client_timeout

    def check_peers(self):
        """Drop peers that have left (ros_comm #927) or are silent, and tell the log of troubles.

        End an overlong hold, and connect again after failures.

        The watcher calls this every WATCH_PERIOD.
        """
        self.topic_manager.check_all()
        self._retry_connections()
        while self.troubles:
            self.ros.logwarn_throttle_identical(60, self.troubles.pop())
        now = monotonic()
        if now > self.hold_deadline:
            self.callback_queue.release()
        if now > self.clock_deadline:
            self.clock_deadline += 1e9  # it is told once
            rostime = self.ros.rostime
            if not (rostime.is_wallclock() or rostime.get_time()):
                self.troubles.add('time stands still: /use_sim_time is set, and no /clock comes')
        for sock, deadline in list(self.deadlines.items()):
            if now > deadline:
                self.deadlines.pop(sock, None)
                shutdown_socket(sock)

    # -- stop

    def request_stop(self):
        """Stop the node, in another thread."""
        # not one of the node's threads: another stop would wait for that
        threading.Thread(target=self.node._stop_safely).start()

    def end_program(self, timeout):
        """Do nothing: a run of a script ends its program here, before all else stops.

        :param timeout: seconds for the program
        """

    def close_rospy(self, timeout):
        """Send messages under way, unregister, and close all topics and services.

        :param timeout: seconds for messages under way
        """
        self._begin_stop()  # the end of a script calls close_rospy() before stop()
        with runs_lock:
            runs.pop(self.uri, None)
            if not runs:
                _end_of_watch.set()
        deadline = monotonic() + timeout
        for publisher in list(self.topic_manager.pubs.values()):
            publisher.flush(deadline)
        self.rospy_signal_shutdown('stop')

    def _begin_stop(self):
        """End sleeps, waits and service calls of the node."""
        self.stopping.set()
        for sock in list(self.calls):
            shutdown_socket(sock)

    def stop(self, timeout):
        """Send messages under way, unregister, free ports and threads; log threads left behind.

        When this has returned, no thread of the node runs, unless one has blocked longer than its
        limit. The log names souls and delegates that have.

        :param timeout: seconds for souls, as long for the delegate that runs, and as long for
            messages under way
        """
        self.lifecycle = Lifecycle.STOPPING
        self.callback_queue.stop()
        self.end_program(timeout)
        self._begin_stop()
        left_behind = [thread.name for thread in join(self.souls, timeout)]
        has_ended = self.callback_queue.close(timeout)
        if not has_ended:
            left_behind.append('a delegate')
            self.threads.discard(self.callback_queue.thread)
        if left_behind:
            self.ros.logwarn(
                f'left behind, since they did not end in time: {", ".join(left_behind)}'
            )
        self.close_rospy(timeout)
        for sock in list(self.sockets):
            shutdown_socket(sock)
        self._wait_for_threads(STOP_LIMIT)
        self.finished.set()
        logging = self.modules.load('logging')
        logging.disable()  # or a thread left behind would open the file again
        logging.shutdown()
        for sock in list(self.sockets):
            sock.close()
        self.mark_stopped()

    def _wait_for_threads(self, timeout):
        """Wait for the end of all threads but souls; one that ends may have started another."""
        deadline = monotonic() + timeout
        while monotonic() < deadline:
            threads = set(self.threads) - set(self.souls) - {threading.current_thread()}
            live_threads = [thread for thread in threads if thread.is_alive()]
            if not live_threads:
                break
            join(live_threads, deadline - monotonic())


def join(threads, timeout):
    """Wait for the end of threads other than this one, and return those that go on.

    :param timeout: seconds for all of them together
    """
    deadline = monotonic() + timeout
    others = [thread for thread in threads if thread is not threading.current_thread()]
    for thread in others:
        thread.join(max(0.0, deadline - monotonic()))
    return [thread for thread in others if thread.is_alive()]


def _watch_runs():
    """Look after all runs until the last one ends; every two seconds, compare with the masters."""
    look_count = 0
    while True:
        is_over = _end_of_watch.wait(WATCH_PERIOD)
        if is_over:
            return
        look_count += 1
        for run in list(runs.values()):
            run.check_peers()
        run = None  # else a stopped run would live until the next look
        if look_count % LOOKS_PER_MASTER == 0:
            _ask_masters()


def _ask_masters():
    """Ask each master for its system state, and have the runs register again what is missing."""
    all_runs = list(runs.values())
    for url in {run.master.url for run in all_runs}:
        with suppress(*UNREACHABLE, PharosError):
            state = ServerProxy(url).getSystemState('/pharos')[2]
            for run in all_runs:
                if run.master.url == url and not run.stopping.is_set():
                    run.register_missing(state)
