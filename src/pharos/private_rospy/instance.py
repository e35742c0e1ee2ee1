"""One node's rospy: loaded, started and stopped."""
import contextlib
import errno
import functools
import threading
import time
from typing import Any

import rosgraph.network

from pharos.errors import MasterUnreachableError, NodeStoppedError, PharosError, PortInUseError
from pharos.private_rospy import changes, logs, patches, process_rospy, refusals, registration
from pharos.private_rospy.acceptor import Acceptor, Limits
from pharos.private_rospy.lifetime import Lifetime, listed
from pharos.private_rospy.loader import PrivateImports
from pharos.private_rospy.own_process import OwnProcess
from pharos.private_rospy.patches import tcpros_server
from pharos.private_rospy.parameters import WatchedParameters
from pharos.private_rospy.deadlines import is_time_up, time_limit
from pharos.private_rospy.connections import Connections

POLL = 0.001  # seconds between rospy's own looks at whether it is registered; it takes 0.1 s


class PrivateRospy:
    """A rospy of one node, for one run of it: a stopped one is thrown away.

    :param settings: the :class:`~.settings.Settings` of the node
    :param on_stop_request: called as ``on_stop_request(reason)``, in a thread of its own, when ROS
        or a user of ``rospy.signal_shutdown`` asks the node to stop
    :param allows_remote_shutdown: ``allows_remote_shutdown()``: whether any host may ask for that
    """

    #: whether its log lines on the screen begin with its name; what a program prints may have it
    names_log_lines = True
    #: whether the master has forgotten it, or was away, and not all is repaired yet
    was_forgotten = _was_away = False
    #: called where another process asks for the node's health; returns what XML-RPC has
    tell_health: Any = dict

    def __init__(self, settings, on_stop_request, allows_remote_shutdown):
        self.settings = settings
        self.name, self.uri, self.domain = settings.name, None, None
        self._on_stop_request, self.allows_remote_shutdown = on_stop_request, allows_remote_shutdown
        self._stopping = threading.Lock()
        # whether a newer node has it: what registers this one again would end that one
        self.has_lost_name = False
        #: (method that undoes it, name, URI) of each registration that failed: a master that only
        #: hung goes on with it later
        self.unsure = set()
        #: names of the services of this node that another one offers, as the master last said
        self.services_of_others = set()
        #: called as ``on_failure(error, what='a hook of on_shutdown')`` with what that raised
        self.on_failure = lambda *failure: None
        #: called as ``on_init_node(name, register, xmlrpc_port, tcpros_port)`` when the program of
        #: the node calls rospy.init_node; None: the node has no program of its own
        self.on_init_node = None
        #: called after the callbacks of a batch of messages, in its thread
        self.on_received = lambda: None

        self.lifetime = Lifetime(self.name)
        self.ended = self.lifetime.ended  # the event set when the stop begins
        #: start_thread(target, args=(), name=None): a thread that the stop waits for
        self.start_thread = self.lifetime.start_thread
        #: wait_until(predicate, timeout): see changes.wait_until
        self.wait_until = functools.partial(changes.wait_until, self.lifetime)
        self.limits = Limits()
        self.service_clients = Acceptor('service', self)
        self.connections = Connections(self)
        self.refusals = refusals.Refusals(self)
        self.parameters = WatchedParameters(self)

        imports = PrivateImports(patch=lambda module: patches.apply(module, self))
        self._process = OwnProcess(
            imports,
            self.settings,
            self.lifetime,
            lambda *failure: self.on_failure(*failure),
            self.request_stop,
        )
        self._logging = logs.private_logging(imports)
        #: import_library(name): a library written on rospy, such as 'actionlib', for this node
        self.import_library = imports.import_library
        #: its sys, as its program and libraries import it
        self.system = imports.system
        self._run_main = imports.run_main
        self.module = imports.load('rospy')
        patches.check_applied(imports.modules)
        self._process.exit_handlers.clear()  # rospy's: the stop does what is in it
        #: rospy's _base_logger; it reports the caller of its caller, who must call it himself
        self.log = self.module.core._base_logger
        registries = self.module.impl.registration
        self.topics, self.service_manager = (
            registries.get_topic_manager(),
            registries.get_service_manager(),
        )
        #: publisher(topic), subscriber(topic): rospy's _PublisherImpl or _SubscriberImpl, or None
        self.publisher = self.topics.get_publisher_impl
        self.subscriber = self.topics.get_subscriber_impl

    def wait_for_registration(self, seconds):
        """What rospy waits with until it is registered, in steps of 0.1 s and for ever."""
        self._check_not_ended()
        if time.monotonic() > self._deadline:
            raise self._stopped_answering()
        time.sleep(min(seconds, POLL))

    def expect_program(self, folder):
        """The node is to be one of a program; called by the thread that loads it.

        :param folder: the working directory of its threads; None: the process's
        """
        self.lifetime.has_program, self.lifetime.folder = True, folder
        self._process.signals.begin()

    def run_main(self, path, argv):
        """Run a program as the node's, in this thread: what it raises, SystemExit too, comes through.

        :param argv: its ``sys.argv``, whole
        """
        self.lifetime.main_thread = threading.current_thread()
        with self._process.signals.of_this_thread():
            self._run_main(path, argv)
            if not isinstance(self.lifetime.raised, KeyboardInterrupt):  # it has ended without
                self.lifetime.raise_pending()

    def exit_main(self):
        """What Python does when the program's main thread has ended: wait for the threads that are
        no daemons, and run the handlers of atexit."""
        self._process.end_pools()
        self.lifetime.wait_for_threads()
        self._process.signals.forget()
        self._process.run_exit_handlers()

    def leave_signals_to_rospy(self):
        """The program has rospy handle signals from now on."""
        self._process.signals.leave_to_rospy(self.module.core._ros_signal)

    # -- life

    def rename(self, name):
        """Have the node, which is not registered yet, be called so."""
        self.name = self.settings.name = name
        self.lifetime.rename(name)

    def start(self, timeout, register=None):
        """Open the ports, claim the name, register. On an error, nothing is left behind.

        :param timeout: seconds that the master may take, if it is more than REGISTER_TIMEOUT
        :param register: called as ``register(xmlrpc_port=, tcpros_port=)`` instead of rospy's
            init_node
        :raises MasterUnreachableError, NodeNameInUseError, PortInUseError:
        :raises NodeStoppedError: if :meth:`begin_stop` was called meanwhile
        """
        settings, timeout = self.settings, max(registration.REGISTER_TIMEOUT, timeout)
        register = register or functools.partial(
            self.module.init_node, settings.base_name, argv=settings.argv, disable_signals=True
        )
        self._deadline = time.monotonic() + timeout
        with time_limit(timeout), self._reached():
            registration.claim_name(settings.master_url, self.name, timeout)
        # the first, so that the threads that rospy waits for end at once
        self.module.core._shutdown_hooks.insert(0, lambda reason: self._end_waits())
        try:
            with _ports_checked('tcp_port', settings.tcp_port):
                self.tcp_port = tcpros_server.listen(
                    self.module.impl.tcpros_base, settings.tcp_port
                )
            with _ports_checked('xmlrpc_port', settings.xmlrpc_port):
                # half of it until rospy is registered
                with time_limit(2 * timeout), self._reached():
                    register(xmlrpc_port=settings.xmlrpc_port, tcpros_port=settings.tcp_port)
            self._check_not_ended()
        except BaseException:
            self.finish_stop(0)
            raise
        self._close_idle_proxies()
        self.xmlrpc_port = self.lifetime.xmlrpc.port
        self.domain = self.import_library('rosgraph.network').get_host_name()
        if not self.lifetime.has_program:  # which goes on after that, to its end
            # rospy.signal_shutdown called by the node's own code
            self.module.core.add_preshutdown_hook(self._request_own_stop)
        if settings.note:
            self.warn(settings.note)
            settings.note = ''
        if not rosgraph.network.is_local_address(self.domain):
            self.warn(
                f'{self.domain}, which {self.name} tells others to come to, is no address of this'
                ' host: nobody reaches it unless something forwards its ports'
            )

    @contextlib.contextmanager
    def _reached(self):
        """Turns what rospy raises for want of the master into an error that names it."""
        try:
            yield
        except (*registration.COMMUNICATION_ERRORS, process_rospy.rospy.ROSInitException) as error:
            is_of_this_host = isinstance(error, OSError) and not isinstance(error, ConnectionError)
            if is_of_this_host and not is_time_up():
                raise  # a port is taken, a disk full
            self._check_not_ended()
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

    def _request_own_stop(self, reason):
        """The node's own code ends it, perhaps because it has seen that it stops already."""
        if not self.ended.is_set():
            self.request_stop(reason)

    def is_in_shutdown_hook(self):
        """Whether this thread has called the node's ``rospy.signal_shutdown``, and is in a hook;
        afterwards, that asks for the stop."""
        core = self.module.core
        return core._in_shutdown and not core._shutdown_flag and core._shutdown_lock._is_owned()

    def begin_stop(self):
        """Begin the stop: all that waits ends, ``is_shutdown()`` holds, and nothing more is read
        from sockets; nodes of this process still deliver until the dispatcher closes.

        To a program this is what Ctrl-C is: before, the hooks of on_shutdown run, unless rospy
        handles no signals for it.
        """
        self._process.signals.call_handler()
        if self.lifetime.has_program and not self.lifetime.raised:
            self._run_hooks()
        self._end_waits()
        self._process.signals.call_former_handler()

    def _end_waits(self):
        self.lifetime.begin_shutdown()
        waiting = [self.module.rostime.get_rostime_cond()]  # simulated time may stand still
        handler = self.handler
        if handler:
            waiting.append(handler.reg_man.cond)
        for changed in waiting:
            with changed:
                changed.notify_all()

    def finish_stop(self, flush_timeout, abandoned=()):
        """Send what is under way (for up to ``flush_timeout`` seconds), unregister, close the
        ports, end the threads.

        Returns the names of threads that did not end in time, but for those ``abandoned`` already.
        Harmless when done twice.
        """
        if not self._stopping.acquire(blocking=False):
            return []
        self._run_hooks()
        self.connections.withdraw()
        core = self.module.core
        self._flush(flush_timeout)
        self.lifetime.ending_thread = threading.get_ident()
        core.signal_shutdown('stop')
        with core._shutdown_lock:
            pass  # where the node's own code called that, it returned at once
        if self._process.has_exit_handlers():
            self.start_thread(self._process.run_exit_handlers, name='atexit')
        for proxy in list(core._xmlrpc_cache.values()):  # a thread that is left may add one
            proxy('close')()
        left = self.lifetime.finish_shutdown(abandoned)
        logs.close_handlers(self._logging)
        self.lifetime.ending_thread = None
        return [thread.name for thread in left]

    def _run_hooks(self):
        """Do what rospy's signal_shutdown does first: run the hooks of on_shutdown, each once.

        Where the node's own code has called that, this waits until it is through.
        """
        core = self.module.core
        with core._shutdown_lock:
            core._in_shutdown, self.lifetime.hooks_thread = True, threading.get_ident()
            try:
                while core._client_shutdown_hooks:
                    self._run_hook(core._client_shutdown_hooks.pop(0))
            finally:
                # what the node does last may be logged on /rosout
                core._in_shutdown = core._shutdown_flag
                self.lifetime.hooks_thread = None

    def _run_hook(self, hook):
        try:
            hook()
        except BaseException as error:  # the others run
            self.on_failure(error)

    def _flush(self, timeout):
        """Wait until what the node published is with the sockets, up to ``timeout`` seconds."""
        deadline = time.monotonic() + timeout
        for publisher in list(self.topics.pubs.values()):
            for connection in list(publisher.connections):
                if hasattr(connection, 'flush'):
                    connection.flush(deadline - time.monotonic())

    def repair(self, state, was_away):
        """Register with the master what it has forgotten; see :func:`.registration.repair`. Raises
        nothing."""
        if not self.is_registered:
            return
        self._close_idle_proxies()
        self._was_away = self._was_away or was_away
        try:
            registration.repair(self, state, self._was_away)
            if self.was_forgotten:
                self.parameters.restore_after_master_restart()
                self.module.logwarn(
                    'the master %s had forgotten %s: registered again',
                    self.settings.master_url,
                    self.name,
                )
            self.was_forgotten = self._was_away = False
        except (rosgraph.MasterException, *registration.COMMUNICATION_ERRORS) as error:
            self.module.logdebug(
                'cannot register with the master %s: %s', self.settings.master_url, error
            )

    def _close_idle_proxies(self):
        for proxy in list(self.module.core._xmlrpc_cache.values()):
            proxy.close_if_idle()

    @property
    def is_registered(self):
        """Whether the start is through, and neither a stop nor rospy's own shutdown has begun."""
        is_ending = self.ended.is_set() or self.module.core._in_shutdown
        return self.domain is not None and not is_ending

    # -- what others need of rospy's inside

    def warn(self, text):
        """A warning in the node's log."""
        self.module.logwarn('%s', text)

    def debug(self, text):
        """A line in the node's log for those who look for errors."""
        self.module.logdebug('%s', text)

    def published_class(self, topic):
        """The message class with which the node publishes on the topic; None where it does not."""
        publisher = self.publisher(topic)
        return publisher and publisher.data_class

    @property
    def thread_count(self):
        """How many threads the node has."""
        return sum(thread.is_alive() for thread in listed(self.lifetime.threads))

    def connection_header(self, publisher):
        """What a subscriber of rospy's _PublisherImpl gets as its messages'
        ``_connection_header``."""
        protocol = self.module.impl.tcpros_pubsub.TCPROSPub(
            publisher.resolved_name, publisher.data_class, publisher.is_latch, publisher.headers
        )
        return protocol.get_header_fields()

    @property
    def handler(self):
        """rospy's ROSHandler; None before the start and after the stop."""
        return getattr(self.lifetime.xmlrpc, 'handler', None)


@contextlib.contextmanager
def _ports_checked(what, port):
    """Turns the failure to bind a port into an error that names it."""
    try:
        yield
    except OSError as error:
        if error.filename:
            raise PharosError(
                f'the log {error.filename} cannot be opened ({error.strerror}): set ROS_LOG_DIR to a'
                ' folder in which it can'
            ) from error
        if error.errno not in (errno.EADDRINUSE, errno.EACCES):
            raise
        raise PortInUseError(
            f'{what} {port} cannot be bound ({error.strerror}): choose another port, or 0 for any'
            ' free one'
        ) from error
