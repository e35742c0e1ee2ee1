"""Run: a node's life from a start to a stop, with its own rospy, souls, endpoints and failures."""
from __future__ import annotations

import atexit
import collections
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
from typing import TYPE_CHECKING, Any, Callable, Iterable, Sequence
from urllib.parse import urlsplit
from weakref import WeakSet

import rospy

from pharos.blocks import block_name
from pharos.errors import MessageTypeError, PortInUseError
from pharos.failures import Failure, Failures
from pharos.intraprocess.callback_queues import CallbackOrder, CallbackQueue
from pharos.intraprocess.links import runs
import pharos.private_rospy.inspecting  # noqa: F401: it has inspect find private modules
from pharos.private_rospy import connections, patches
from pharos.private_rospy.loader import PrivateModules, Shim, private_path, remember_text
from pharos.private_rospy.tcpros import shutdown_socket
from pharos.private_rospy.xmlrpc import ServerProxy
from pharos.signals import may_be_signal
from pharos.transcript import Transcript
from pharos.waiting import current, let_others_run

if TYPE_CHECKING:
    from pharos.master import Master
    from pharos.node import Node

STOP_LIMIT = 2.0  # seconds that a stop waits for threads of rospy
CLOCK_LIMIT = 3.0  # seconds until a clock that stands still is told
JOIN_PERIOD = 0.01  # seconds until the threads are counted anew: one may have started another
HOLD_LIMIT = 2.0  # seconds that delegates wait for the end of start(); start() may wait for them
BACKLOG = 128  # clients that may wait for a connection; rospy allows five


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
    # the thread that runs the stop() of the node's class, or rospy's hooks: on a topic that it has
    # published to, the node's other threads publish no more, or a robot would drive on
    last_thread: int | None = None
    rospy_signal_shutdown: Callable
    Thread: type[threading.Thread]  # made by substitutes()
    ros_handler: Any

    def __init__(self, node: Node, settings: Settings) -> None:
        self.node = node
        self.settings = settings
        self.failures = Failures()
        # thread that runs -> name; block, None for the node's soul; True if it is required
        self.souls: dict[threading.Thread, tuple[str, Any, bool]] = {}
        # name -> the same, of those that the stop has ended, and of the node's soul if it has failed;
        # a restart forks them, too
        self.broken_souls: dict[str, tuple[str, Any, bool]] = {}
        # names, the newest last
        self.ended_souls: collections.deque[str] = collections.deque(maxlen=10)
        self.endpoints = []  # also those that the stop has closed, for the next start
        # set when a stop begins, in a script after its handlers and hooks: sleeps and waits end
        self.stopping = threading.Event()
        self.finished = threading.Event()  # set at the end of a stop: threads left behind end
        self.threads: set[threading.Thread] = set()
        self.ended_cpu_seconds = 0.0  # of threads that have ended
        # texts for the log: a publisher must not log while it holds locks
        self.troubles: set[str] = set()
        self.sockets: WeakSet[socket.socket] = WeakSet()
        self.calls: WeakSet[socket.socket] = WeakSet()  # sockets of calls of services
        # socket of a silent client -> the time when it is closed
        self.deadlines: dict[socket.socket, float] = {}
        # the pause ends when the node's start() has returned
        self.callback_queue = CallbackQueue(CallbackOrder(self.start_thread), HOLD_LIMIT)
        namespace, _, self.base_name = self.name.rpartition('/')
        self.clock_deadline = time.monotonic() + CLOCK_LIMIT  # when a clock that stands is told
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
        remember_text(sys.modules.get(type(node).__module__))
        patch = functools.partial(patches.apply, run=self)
        self.modules = PrivateModules(self.substitutes(), patch)
        self.ros: Any = self.modules.load('rospy')
        registration = self.ros.impl.registration
        self.topic_manager: Any = registration.get_topic_manager()
        self.service_manager: Any = registration.get_service_manager()

    def substitutes(self) -> dict[str, Any]:
        """Return the stand-ins that the node's modules import for some modules of Python.

        Make :attr:`Thread`, the class of the node's threads.
        """
        owner = self

        class Thread(threading.Thread):
            """A daemon thread of the node; the node's stop waits for its end."""

            def start(self) -> None:
                self.daemon = True
                owner.threads.add(self)  # before its start: a stop waits for it
                # Python calls self.run() in the thread: here run_thread(), which calls the former one
                self.run = functools.partial(owner.run_thread, self, self.run)  # type: ignore
                super().start()

        self.Thread = Thread
        client = Shim(xmlrpc.client, ServerProxy=ServerProxy)
        # a hook of fork or exit would keep each stopped run alive; rospy's 60 s for sockets would hold
        # for all of the process
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

    def run_thread(self, thread: threading.Thread, target: Callable) -> None:
        """Run the target of a thread of the node, in this thread. A SystemExit ends the thread alone."""
        try:
            with suppress(SystemExit):
                target()
        finally:
            self.ended_cpu_seconds += time.thread_time()
            self.threads.discard(thread)
            self.mark_ended(thread)

    def mark_ended(self, soul_thread: threading.Thread) -> None:
        """Keep the name of a soul that has ended; do nothing for another thread."""
        if self.souls.pop(soul_thread, None):
            self.ended_souls.append(soul_thread.name)

    def start_thread(self, target: Callable) -> threading.Thread | None:
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

    def sleep(self, seconds: float) -> None:
        """Stand in for ``time.sleep``: the node's stop ends the sleep.

        After the stop, a sleep ends its thread. A thread that answers a call of a service of the node ends
        at once: the caller must not hear of a success. So does a timer's: it would call once more.
        """
        if self.finished.is_set():
            raise SystemExit(f'{self.name} has stopped')  # in a thread that was left behind
        if seconds <= 0:
            let_others_run()
            return
        is_stopping = self.stopping.wait(seconds)
        if is_stopping:
            is_timer = isinstance(threading.current_thread(), self.ros.Timer)
            if is_timer or current.service_run is self:
                raise SystemExit(f'{self.name} stops')
            let_others_run()  # a loop may sleep on

    def checkpoint(self) -> None:
        """Do nothing: is_shutdown() calls this, and a script waits here for its handlers."""

    def signal_shutdown(self, reason: str) -> None:
        """Stand in for ``rospy.signal_shutdown``: stop the node in another thread."""
        self.request_stop()

    # -- state

    @property
    def name(self) -> str:
        """The node's full name."""
        return self.settings.name

    @property
    def master(self) -> Master:
        """The node's Master."""
        return self.settings.master

    def health_facts(self) -> dict[str, Any]:
        """Return the facts of Node.health(), without the master's; ``pharos top`` asks for them."""
        from pharos.live.health import facts_of

        return facts_of(self)

    def open_endpoints(self, endpoint_class: Any) -> list:
        """Return the endpoints of a class that are open."""
        return [
            endpoint
            for endpoint in list(self.endpoints)
            if isinstance(endpoint, endpoint_class) and not endpoint.closed
        ]

    def mark_stopped(self) -> None:
        """Mark the run as stopped, and its endpoints as closed."""
        for endpoint in self.endpoints:
            endpoint.closed = True
        self.lifecycle = Lifecycle.STOPPED
        if runs.get(self.uri) is self:  # only in a forked child: leave() has taken it out before
            del runs[self.uri]

    # -- failures

    def report_failure(
        self,
        error: BaseException,
        block: Any,
        role: str,
        message: Any = None,
        channel: Any = None,
        retry: Callable | None = None,
    ) -> None:
        """Keep an exception of a block; at the 1st, 10th, 100th time, log and show the exception.

        An exception that may come from a signal is raised again: Ctrl-C ends the program. A
        rospy.ROSException or SystemExit while the node stops is the end of a sleep, and no failure.

        :param role: the word for the block in the text, such as 'delegate'
        :param message: the message, request or value that the block was run on
        :param channel: the message's channel, or None
        :param retry: ``retry(message)`` runs the block again
        """
        if isinstance(error, (KeyboardInterrupt, SystemExit)) and may_be_signal():
            raise error
        if self.stopping.is_set() and isinstance(error, (rospy.ROSException, SystemExit)):
            return
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

    def keep_failure(self, error: BaseException, block: Any, *details: Any) -> Failure:
        """Keep an exception of a block, without a log line, and return the Failure.

        :param details: the message, channel and retry of the Failure
        """
        failure = Failure(error, block, *details)
        self.failures.keep(failure)
        return failure

    def report_refusal(self, topic: str, reason: str) -> None:
        """Report a publisher that sends another type as a failure of the node."""
        error = MessageTypeError(f'{self.name} does not receive from {topic}: {reason}')
        self.report_failure(error, topic, 'connection')

    # -- start

    def start(self, **options: Any) -> None:
        """Bind the ports, start the servers, and set the address and ports of the node.

        :param options: further options of ``rospy.init_node``
        :raises MasterUnreachableError, NodeNameInUseError, PortInUseError: stop() then cleans up
        """
        connections.take_name(self)
        tcpros_base = self.ros.impl.tcpros_base
        tcp_port, xmlrpc_port = self.settings.ports
        try:
            # a global of the node's rospy keeps the server: init_node() finds it there, and makes none.
            # rospy does not report a busy port
            server = tcpros_base.init_tcpros_server(tcp_port)
            tcp_server = tcpros_base.TCPServer(server._tcp_server_callback, tcp_port)
            server.tcp_ros_server = tcp_server
            tcp_server.server_sock.listen(BACKLOG)
            tcp_server.start()
            ports = {'xmlrpc_port': xmlrpc_port, 'tcpros_port': tcp_server.port}
            options = {'disable_signals': True, **options, **ports}
            self.ros.client.init_node(self.base_name, self.argv, **options)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            raise PortInUseError(
                f'{self.name}: port {tcp_port} or {xmlrpc_port} is in use: choose another one, or 0'
            ) from None
        address = urlsplit(self.uri)
        self.settings.ports = tcp_server.port, address.port  # type: ignore[assignment]
        self.settings.domain = self.settings.domain or address.hostname
        node = self.node
        node.uri = self.uri
        node.tcp_port, node.xmlrpc_port = self.settings.ports
        node.domain = self.settings.domain

    def make_findable(self, handler: Any, uri: str) -> None:
        """Offer shared memory and the facts for top; enter the run into ``links.runs``.

        The patch ``ready`` calls this when the XML-RPC server has its port, before anything is
        registered.

        :param handler: rospy's ROSHandler
        :param uri: the URI of the node's XML-RPC server
        """
        self.ros_handler = handler
        self.uri = uri
        if self.master.shared_memory:
            from pharos.shared_memory.receiving import SharedMemoryHandler

            handler.protocol_handlers.insert(0, SharedMemoryHandler(self))
        handler.pharosHealth = lambda caller_id: (1, '', self.health_facts())
        connections.enter(self)

    def read_parameters(self, key: str) -> None:
        """Have the node's parameters at a full name, above and below it read their values anew."""
        changed_name = key.rstrip('/') + '/'
        for parameter in self.node._parameters:
            name = parameter.name + '/'
            if name.startswith(changed_name) or changed_name.startswith(name):
                parameter.read()

    def limit_silence(self, sock: socket.socket) -> None:
        """Have the watcher shut a client's socket after the node's client_timeout.

        The end of a handshake takes the client out of ``deadlines``. A call of XML-RPC, with its answer,
        has that time as a whole.
        """
        self.deadlines[sock] = time.monotonic() + self.node.client_timeout

    # -- stop

    def request_stop(self) -> None:
        """Stop the node, in another thread."""
        # not one of the node's threads: another stop would wait for that
        threading.Thread(target=self.node._stop_safely).start()

    def end_program(self, timeout: float) -> set[threading.Thread]:
        """Do nothing: a run of a script ends its program here, before souls and rospy.

        :param timeout: seconds for the program
        :returns: threads that have had their time: the stop does not wait for them
        """
        return set()

    def close_rospy(self, timeout: float) -> None:
        """Send messages under way, unregister, and close all topics and services.

        :param timeout: seconds for messages under way
        """
        self._begin_stop()  # the end of a script calls close_rospy() before stop()
        connections.leave(self)
        deadline = time.monotonic() + timeout
        for publisher in list(self.topic_manager.pubs.values()):
            publisher.flush(deadline)
        self.last_thread = threading.get_ident()
        self.rospy_signal_shutdown('stop')

    def _begin_stop(self) -> None:
        """End sleeps, waits and service calls of the node."""
        if current.service_run is self:  # a service that stops its node goes on
            current.service_run = None
        self.stopping.set()
        for sock in items_of(self.calls):
            shutdown_socket(sock)

    def stop(self, timeout: float) -> None:
        """Send messages under way, unregister, free ports and threads; log souls left behind.

        When this has returned, no thread of the node runs, unless one has blocked longer than its
        limit. The log names souls and delegates that have.

        :param timeout: seconds for souls, as long for the delegate that runs, and as long for
            messages under way
        """
        self.lifecycle = Lifecycle.STOPPING
        self.callback_queue.stop()
        late_threads = self.end_program(timeout)
        self._begin_stop()
        souls = [thread for thread in list(self.souls) if thread not in late_threads]
        late_souls = join(souls, timeout)
        late_threads.update(late_souls)
        left_behind = [thread.name for thread in late_souls]
        has_ended = self.callback_queue.close(timeout)
        if not has_ended:
            left_behind.append('a delegate')
            late_threads.add(self.callback_queue.thread)  # type: ignore[arg-type]
        if left_behind:
            self.ros.logwarn(
                f'left behind, since they did not end in time: {", ".join(left_behind)}'
            )
        self.close_rospy(timeout)
        for sock in items_of(self.sockets):
            shutdown_socket(sock)  # wakes the threads that read; close() would not
        deadline = time.monotonic() + STOP_LIMIT
        # a thread that ends may have started another one
        while join(set(self.threads) - late_threads, JOIN_PERIOD) and time.monotonic() < deadline:
            pass
        self.finished.set()
        logging = self.modules.load('logging')
        logging.disable()  # or a thread left behind would open the file again
        logging.shutdown()
        for sock in items_of(self.sockets):
            sock.close()  # now that no thread uses it: another file may get its number
        self.mark_stopped()


def items_of(weak_set: WeakSet) -> list:
    """Return what is in a set; other threads may add to it meanwhile, which list() would not bear."""
    references = list(weak_set.data)  # type: ignore  # in C: no other thread runs in between
    return [item for item in (reference() for reference in references) if item is not None]


def join(threads: Iterable[threading.Thread], timeout: float) -> list[threading.Thread]:
    """Wait for the end of threads other than this one, and return those that go on.

    :param timeout: seconds for all of them together
    """
    deadline = time.monotonic() + timeout
    others = [
        thread
        for thread in threads
        if thread.is_alive() and thread is not threading.current_thread()
    ]
    for thread in others:
        thread.join(max(0.0, deadline - time.monotonic()))
    return [thread for thread in others if thread.is_alive()]
