"""One node's rospy: loaded, started and stopped."""
import atexit
import contextlib
import errno
import logging.config
import os
import socket
import sys
import threading
import time
import xmlrpc
import xmlrpc.client
import _thread

import rosgraph

from pharos.errors import MasterUnreachableError, NodeStoppedError, PortInUseError
from pharos.private_rospy import (
    process_rospy,
    logs,
    patches,
    publishing,
    refusals,
    registration,
)
from pharos.private_rospy.acceptor import Acceptor
from pharos.private_rospy.lifetime import Lifetime
from pharos.private_rospy.loader import PrivateImports, Substitute
from pharos.private_rospy.patches import tcpros_server
from pharos.private_rospy.parameters import WatchedParameters
from pharos.private_rospy.proxies import ServerProxy, is_time_up, time_limit
from pharos.private_rospy.connections import Connections

POLL = 0.001  # seconds between rospy's own looks at whether it is registered; it takes 0.1 s


class PrivateRospy:
    """A rospy of one node, for one run of it: a stopped one is thrown away.

    :param settings: the :class:`~.settings.Settings` of the node
    :param on_stop_request: called as ``on_stop_request(reason)``, in a thread of its own, when ROS
        or a user of ``rospy.signal_shutdown`` asks the node to stop
    :param allows_remote_shutdown: ``allows_remote_shutdown()``: whether any host may ask for that
    """

    def __init__(self, settings, on_stop_request, allows_remote_shutdown):
        self.settings = settings
        self.name = settings.name
        self._on_stop_request, self.allows_remote_shutdown = on_stop_request, allows_remote_shutdown
        self.lifetime = Lifetime(self.name)
        self.service_clients = Acceptor('service', self)
        self._stopping = threading.Lock()
        # whether a newer node has it: what registers this one again would end that one
        self.has_lost_name = False
        self.on_failure = lambda error: None  # called with what a hook of rospy.on_shutdown raised
        # called after the callbacks of a batch of messages, in its thread
        self.on_received = lambda: None
        self.uri = None
        self.connections = Connections(self)
        self.refusals = refusals.Refusals(self)
        self.parameters = WatchedParameters(self)
        self._modules = self._load()
        self.rospy = self._modules.load('rospy')
        patches.check_applied(self._modules.modules)
        # rospy's own registries of Publishers and Subscribers, and of Services
        self.topics = self.rospy.impl.registration.get_topic_manager()
        self.service_manager = self.rospy.impl.registration.get_service_manager()

    def _load(self):
        lifetime, logging_module = self.lifetime, logs.private_logging()
        proxies = Substitute(xmlrpc.client, ServerProxy=ServerProxy)
        private_os = Substitute(os, environ=self.settings.environ)
        modules = PrivateImports(
            patch=lambda module: patches.apply(module, self),
            substitutes={
                'os': private_os,
                'sys': Substitute(sys, argv=self.settings.argv),
                'logging': logging_module,
                # running.py stops the node at the end of the program
                'atexit': Substitute(atexit, register=lambda function, *args, **kwargs: function),
                'threading': Substitute(threading, Thread=lifetime.Thread),
                '_thread': Substitute(_thread, start_new_thread=lifetime.start_thread),
                'time': Substitute(time, sleep=lifetime.sleep),
                # rospy sets the whole process's
                'socket': Substitute(socket, setdefaulttimeout=lambda timeout: None),
                'xmlrpc': Substitute(xmlrpc, client=proxies),
                'xmlrpc.client': proxies,
            },
        )
        logging_module.os = private_os  # the configuration file is evaluated with this
        logging_module.config = modules.load_apart('logging.config', logging.__path__)
        self._logging = logging_module
        return modules

    def wait_for_registration(self, seconds):
        """What rospy waits with until it is registered, in steps of 0.1 s and for ever."""
        self._check_not_ended()
        if time.monotonic() > self._deadline:
            raise self._stopped_answering()
        time.sleep(min(seconds, POLL))

    def module(self, name):
        """A module of the node's rospy, such as 'rospy.core'."""
        return self._modules.load(name)

    def import_library(self, name):
        """A library written on rospy, such as 'actionlib', bound to this node."""
        return self._modules.load(name)

    # -- life

    def start(self, timeout):
        """Open the ports, claim the name, register. On an error, nothing is left behind.

        :param timeout: seconds that the master may take
        :raises MasterUnreachableError, NodeNameInUseError, PortInUseError:
        :raises NodeStoppedError: if :meth:`end` was called meanwhile
        """
        settings = self.settings
        self._deadline = time.monotonic() + timeout
        with time_limit(timeout), self._reached():
            registration.claim_name(settings.master_url, self.name, timeout)
        core = self._modules.load('rospy.core')
        # the first, so that the threads that rospy waits for end at once
        core._shutdown_hooks.insert(0, self._wake)
        try:
            with _ports_checked('tcp_port', settings.tcp_port):
                self.tcp_port = tcpros_server.listen(
                    self._modules.load('rospy.impl.tcpros_base'), settings.tcp_port
                )
            with _ports_checked('xmlrpc_port', settings.xmlrpc_port):
                # half of it until rospy is registered
                with time_limit(2 * timeout), self._reached():
                    self.rospy.init_node(
                        settings.base_name,
                        argv=settings.argv,
                        disable_signals=True,
                        xmlrpc_port=settings.xmlrpc_port,
                        tcpros_port=settings.tcp_port,
                    )
            self._check_not_ended()
        except BaseException:
            self.stop(0)
            raise
        self.xmlrpc_port = self.lifetime.xmlrpc.port
        self.domain = self._modules.load('rosgraph.network').get_host_name()
        # rospy.signal_shutdown called by the node's own code
        core.add_preshutdown_hook(self.request_stop)

    @contextlib.contextmanager
    def _reached(self):
        """Turns what rospy raises where the time is up into an error that names the master."""
        try:
            yield
        except (*registration.COMMUNICATION_ERRORS, process_rospy.rospy.ROSInitException) as error:
            if not is_time_up():
                raise
            raise self._stopped_answering() from error

    def _stopped_answering(self):
        return MasterUnreachableError(
            f'the ROS master {self.settings.master_url} stopped answering while'
            f' {self.name} registered: is its host busy, or gone?'
        )

    def _check_not_ended(self):
        if self.ended.is_set():
            raise NodeStoppedError(f'{self.name} was stopped while it started')

    def request_stop(self, reason):
        """Have the node stopped, from a thread that the stop need not wait for."""
        if not self._stopping.locked():
            threading.Thread(
                target=self._on_stop_request, args=(reason,), name=self.name + ' stop', daemon=True
            ).start()

    def end(self):
        """Begin the stop: all that waits ends, ``is_shutdown()`` holds, and nothing more is
        received."""
        self.lifetime.begin_shutdown()
        changed = self._modules.load('rospy.rostime').get_rostime_cond()
        with changed:
            changed.notify_all()  # simulated time may stand still

    def stop(self, flush_timeout, abandoned=()):
        """Send what is under way (for up to ``flush_timeout`` seconds), unregister, close the
        ports, end the threads.

        Returns the names of threads that did not end in time, but for those ``abandoned`` already.
        Harmless when done twice.
        """
        if not self._stopping.acquire(blocking=False):
            return []
        self.connections.close()
        self.parameters.close()
        core = self._modules.load('rospy.core')
        self._flush(flush_timeout)
        core.signal_shutdown('stop')
        with core._shutdown_lock:
            pass  # where the node's own code called that, it returned at once
        for proxy in list(core._xmlrpc_cache.values()):  # a thread that is left may add one
            proxy('close')()
        left = self.lifetime.end(abandoned)
        logs.close_handlers(self._logging)
        return [thread.name for thread in left]

    def _flush(self, timeout):
        """Wait until what the node published is with the sockets, up to ``timeout`` seconds."""
        deadline = time.monotonic() + timeout
        for publisher in list(self.topics.pubs.values()):
            for connection in list(publisher.connections):
                if hasattr(connection, 'flush'):
                    connection.flush(deadline - time.monotonic())

    def _wake(self, reason):
        self.lifetime.begin_shutdown()
        if self.lifetime.xmlrpc and self.lifetime.xmlrpc.handler:
            changed = self.lifetime.xmlrpc.handler.reg_man.cond
            with changed:
                changed.notify_all()

    def repair(self, state, was_away):
        """Register with the master what it has forgotten; see :func:`.registration.repair`. Raises
        nothing."""
        if self.handler is None or self.ended.is_set():
            return
        try:
            if registration.repair(self, state, was_away):
                self.rospy.logwarn(
                    'the master %s had forgotten %s: registered again',
                    self.settings.master_url,
                    self.name,
                )
                self.parameters.put_back()
        except (rosgraph.MasterException, *registration.COMMUNICATION_ERRORS) as error:
            self.rospy.logdebug(
                'cannot register with the master %s: %s', self.settings.master_url, error
            )

    # -- what the facade needs of rospy's inside

    @property
    def log(self):
        """rospy's ``_base_logger``: it reports the caller of its caller, so ``node.log`` must call
        it itself."""
        return self._modules.load('rospy.core')._base_logger

    @property
    def start_thread(self):
        """``start_thread(target, args=(), name=None)``: a thread that the stop waits for."""
        return self.lifetime.start_thread

    def track_socket(self, sock):
        """Shut the socket down when the node stops, at the latest."""
        self.lifetime.track_socket(sock)

    @property
    def interrupts_waits(self):
        """``with interrupts_waits():`` what waits in this thread does so on behalf of the node, and
        ends with it."""
        return self.lifetime.interrupts_waits

    def wait_until(self, predicate, timeout):
        """Wait until ``predicate()``, which speaks of connections in this process, holds, or the
        node stops.

        :param timeout: seconds, None: no limit
        """
        publishing.wait_until(predicate, timeout, self.lifetime)

    def wait_until_silent(self, timeout):
        """Wait until the node is unregistered, and nobody can ask it anything, for up to
        ``timeout`` seconds."""
        self.lifetime.silent.wait(timeout)

    @property
    def ended(self):
        """The event set when the stop begins."""
        return self.lifetime.ended

    def warn(self, text):
        """A warning in the node's log."""
        self.rospy.logwarn('%s', text)

    def debug(self, text):
        """A line in the node's log for those who look for errors."""
        self.rospy.logdebug('%s', text)

    @property
    def thread_count(self):
        """How many threads the node has."""
        return sum(thread.is_alive() for thread in list(self.lifetime.threads))

    def owns(self, thread):
        """Whether the thread is one of this node's."""
        return thread in self.lifetime.threads

    def publisher(self, topic):
        """rospy's _PublisherImpl of the topic, None if there is none."""
        return self.topics.get_publisher_impl(topic)

    def subscriber(self, topic):
        """rospy's _SubscriberImpl of the topic, None if there is none."""
        return self.topics.get_subscriber_impl(topic)

    @property
    def services(self):
        """rospy's own ``{name: rospy Service}`` of what the node offers; it changes with that."""
        return self._modules.load('rospy.impl.registration').get_service_manager().map

    @property
    def as_response(self):
        """``as_response(value, response_class)``: what the handler of a rospy Service returned, as
        a response."""
        return self._modules.load('rospy.impl.tcpros_service').convert_return_to_response

    def connection_header(self, publisher):
        """What a subscriber of rospy's _PublisherImpl gets as its messages'
        ``_connection_header``."""
        return (
            self._modules.load('rospy.impl.tcpros_pubsub')
            .TCPROSPub(
                publisher.resolved_name, publisher.data_class, publisher.is_latch, publisher.headers
            )
            .get_header_fields()
        )

    @property
    def parameter_cache(self):
        """rospy's own cache of parameters."""
        return self._modules.load('rospy.impl.paramserver').get_param_server_cache()

    @property
    def handler(self):
        """rospy's ROSHandler; None when it is stopping."""
        return self.lifetime.xmlrpc.handler


class _ports_checked:
    """Turns the failure to bind a port into an error that names it."""

    def __init__(self, what, port):
        self._what, self._port = what, port

    def __enter__(self):
        return self

    def __exit__(self, kind, error, traceback):
        if isinstance(error, OSError) and error.errno in (errno.EADDRINUSE, errno.EACCES):
            raise PortInUseError(
                '%s %d cannot be bound (%s): choose another port, or 0 for any free one'
                % (self._what, self._port, error.strerror)
            ) from error
