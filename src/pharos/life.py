"""The life of a node: started, stopped and started again, and the waits that end with it."""
import contextlib
import enum
import threading

from pharos import running, signals, stopping
from pharos.blocks import Souls, attempt, check_runs, name_of
from pharos.intraprocess.dispatcher import Dispatcher
from pharos.errors import NodeStoppedError, PharosError
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.instance import PrivateRospy
from pharos.seconds import check_seconds
from pharos.transcript import Transcript
from pharos.watcher import watcher_of


class Lifecycle(enum.Enum):
    """Where a node is in its life; see :attr:`Node.lifecycle`."""

    NEW = 'new'
    STARTING = 'starting'
    RUNNING = 'running'
    STOPPING = 'stopping'
    STOPPED = 'stopped'


class Life:
    """What a :class:`~pharos.Node` does to live; its blocks, channels and services are there."""

    connect_timeout = (
        2.0  #: seconds that a topic's first message waits for the subscribers the master knows
    )
    queue_bytes = (
        64 << 20
    )  #: bytes of messages, about, that wait for a slow receiver for each publisher, or one message
    allow_remote_shutdown = (
        False  #: whether any host may ask it to stop, not only this one and the master's
    )
    stop_timeout = 2.0  #: seconds that :meth:`stop` waits for souls, and for messages under way

    def _configure(self, master, settings):
        self.master = master
        self._settings = settings
        self._lifecycle = Lifecycle.NEW
        self._changing = stopping.changed  # guards _lifecycle
        self._rospy = self._dispatcher = None  # of the present run, or the last
        # the rospy of the run that starts, and the thread that starts it
        self._starting = self._starter = None
        self._is_start_ended = False  # whether a stop() is to end that start
        self._souls = Souls(self)
        self._channels, self._services = [], []

    def __init_subclass__(cls, **kwargs):
        super().__init_subclass__(**kwargs)
        for method in cls.start, cls.stop:
            check_runs(method, f'{cls.__name__}.{method.__name__}')
        if not stopping.is_once(cls.stop):
            cls.stop = stopping.once(cls.stop)

    def start(self):
        """Register with the master. A subclass overrides this, calls ``super().start()``, then
        makes its channels.

        Runs in the thread that creates the node. A stopped node starts again, under the same name
        and ports. Where a class has no ``start`` of its own, the channels, services and parameters
        that it had come back too, also where a start in between was interrupted.

        :raises PharosError: if the node is running already
        :raises MasterUnreachableError, NodeNameInUseError, PortInUseError: and the node is then as
            it was
        :raises NodeStoppedError: if :meth:`stop` was called meanwhile, and the node is then as it
            was
        """
        with signals.held(stopping.LIMIT):
            former = self._rospy
            self._start_run()
            if type(self).start is not Life.start:
                self._channels, self._services = [], []
            elif former:
                self._rospy.parameters.take_over(former.parameters)
        try:
            self._reopen()
        except BaseException as error:
            is_ended = not self.is_running
            self._stop_run()
            for channel in self._channels:
                channel._stopped()  # opened after another thread had stopped the node
            if is_ended and isinstance(error, Exception):
                raise NodeStoppedError(f'{self.name} was stopped while it started') from error
            raise

    def _reopen(self):
        """Open what the node had; it keeps all of that for its next start if this one is
        interrupted."""
        for opened in (*self._channels, *self._services):
            self._live_rospy()
            opened._open()
        with self.master.reached():
            self._rospy.parameters.renew()

    def _start_run(self):
        before = self._begin_start()
        try:
            instance = PrivateRospy(
                self._settings, self._asked_to_stop, lambda: self.allow_remote_shutdown
            )
            with stopping.changed:
                self._starting = instance
                is_ended = self._is_start_ended
            if is_ended:
                instance.end()
            instance.start(self.connect_timeout)
            self._finish_start(instance)
        except BaseException as error:
            with stopping.changed:
                is_ended = self._is_start_ended
                self._become(before)
            if is_ended and isinstance(error, Exception):
                raise NodeStoppedError(f'{self.name} was stopped while it started') from error
            raise
        watcher_of(self.master).check()

    def _begin_start(self):
        """Be STARTING, and known in this process before the master knows the node; returns what it
        was."""
        if not self._is_starting():
            with contextlib.suppress(TimeoutError):
                stopping.wait_for_end(self)  # what an overriding stop() does last
        with stopping.changed:
            if self._lifecycle not in (Lifecycle.NEW, Lifecycle.STOPPED):
                raise PharosError(
                    f'{self.name} is {self._lifecycle.value} already: stop() it before you start it'
                    ' again'
                )
            running.claim(self)
            before = self._lifecycle
            self._starter, self._is_start_ended = threading.get_ident(), False
            self._become(Lifecycle.STARTING)
        return before

    def _finish_start(self, instance):
        with stopping.changed:
            if not self._is_start_ended:
                self._rospy = instance
                # the same ports next time, also where any free one was asked for
                self._settings.tcp_port, self._settings.xmlrpc_port = (
                    instance.tcp_port,
                    instance.xmlrpc_port,
                )
                self._dispatcher = Dispatcher(instance.start_thread)
                instance.on_received = self._dispatcher.run
                instance.on_failure = self._hook_failed
                instance.refusals.on_refused = self._report_refusal
                self._become(Lifecycle.RUNNING)
                return
        instance.stop(0)
        raise NodeStoppedError('it is registered, and goes again')

    def _is_starting(self):
        return self._lifecycle is Lifecycle.STARTING

    def _is_ending(self):
        return self._lifecycle in (Lifecycle.STOPPING, Lifecycle.STOPPED)

    def _end_start(self):
        """Have the start end, where the node is starting: its caller gets a NodeStoppedError."""
        with stopping.changed:
            self._is_start_ended = self._is_starting()
            instance = self._starting
        if instance:
            instance.end()

    @stopping.once
    def stop(self):
        """End the souls, send what is under way, unregister, close the ports, end the threads.

        A subclass overrides this and calls ``super().stop()``. It runs once for each start, to its
        end, in the thread that was the first to ask for it: the program (here, a signal, its end)
        or ROS (``rosnode kill``). Who asks meanwhile, from any thread, waits until it has ended, as
        does the end of the program, but only until 30 s after its beginning. Called in a thread of
        the node's own, it does not wait for what that thread runs. A node that is still starting is
        stopped, too: its start raises NodeStoppedError.
        """
        self._stop_run()

    def _stop_run(self):
        with stopping.changed:
            if self._lifecycle is not Lifecycle.RUNNING:
                return
            self._become(Lifecycle.STOPPING)
        instance = self._rospy
        try:
            instance.end()
            ignoring = self._souls.end(self.stop_timeout)
            if ignoring:
                self.log(
                    (
                        f"left behind, for it did not end within {self.stop_timeout:g} s of the"
                        f" stop: {', '.join((thread.name for thread in ignoring))}. A soul ends by"
                        " itself if it waits with node.sleep() or loops over node.every()"
                    ),
                    level='warning',
                )
            self._dispatcher.close()
            left = instance.stop(self.stop_timeout, ignoring)
            if left:
                Transcript.show(
                    f"{self.name} left behind threads that did not end: {', '.join(left)}"
                )
            for channel in self._channels:
                channel._stopped()
        finally:
            self._become(Lifecycle.STOPPED)
            running.collect()
            watcher_of(self.master).check()

    def _is_own_thread(self):
        """Whether a stop() may have to wait for this thread."""
        if self._is_starting():
            return self._starter == threading.get_ident()
        return self._rospy is not None and self._rospy.owns(threading.current_thread())

    def _become(self, lifecycle):
        with stopping.changed:
            self._lifecycle = lifecycle
            if lifecycle is not Lifecycle.STARTING:
                self._starting = self._starter = None
            if lifecycle in (Lifecycle.NEW, Lifecycle.STOPPED):
                running.discard(self)
            stopping.changed.notify_all()

    def _is_anothers(self):
        """This is a process that was forked: the node runs in its parent, and here it is
        stopped."""
        self._lifecycle = Lifecycle.STOPPED
        self._changing = stopping.changed
        self._rospy = self._starting = None
        for channel in self._channels:
            channel._stopped()
        self._channels, self._services = [], []

    def _hook_failed(self, error):
        self._failures.report(error, None, f'a hook of on_shutdown of {self.name}')

    def _asked_to_stop(self, reason):
        attempt(lambda: self.log(f'stops: {reason}'))
        self._stop_for_others()

    def _stop_for_others(self):
        """Stop where no code of the user's asked for it, who would get what an overriding stop()
        raises."""
        try:
            self.stop()
        except BaseException as error:
            self._failures.report(error, self.stop, f'{name_of(self.stop)} of {self.name}')

    @property
    def name(self):
        """The node's name, as the master knows it: '/robot1/driver'."""
        return self._settings.name

    @name.setter
    def name(self, value):
        raise AttributeError(
            f'{self.name} is the name by which the master knows the node: give another one to'
            f' create(), as named={value!r}, and what else {type(self).__name__} is called to'
            ' another attribute'
        )

    @property
    def lifecycle(self):
        """A :class:`Lifecycle`."""
        return self._lifecycle

    @property
    def is_running(self):
        """Whether the node is started and no stop has begun."""
        return self._lifecycle is Lifecycle.RUNNING

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.stop()

    def sleep(self, seconds):
        """Wait for ``seconds`` of ROS time, or until the node stops; a soul is ended by that.

        The report: ``(Delay forSeconds: 1) wait``.
        """
        seconds = check_seconds('a sleep', seconds)
        with signals.waiting(), contextlib.suppress(rospy.ROSInterruptException):
            self._live_rospy().rospy.sleep(seconds)
        self._end_soul()

    def _end_soul(self):
        """End the soul that runs in this thread, if one does and the node stops."""
        if not self.is_running:
            self._souls.end_here()

    def every(self, seconds):
        """An iterator that turns at once and then every ``seconds`` of ROS time, without drift,
        until the node stops.

        A turn that takes longer than ``seconds`` delays the next, which then comes at once.
        """
        seconds = check_seconds('a period', seconds, above=0)
        return self._turns(self.ros.Rate(1.0 / seconds, reset=True))

    def _turns(self, rate):
        while self.is_running:
            yield
            with signals.waiting(), contextlib.suppress(rospy.ROSInterruptException):
                rate.sleep()

    def _live_rospy(self):
        if self._lifecycle not in (Lifecycle.RUNNING, Lifecycle.STOPPING):
            hint = ''
            if self._lifecycle is Lifecycle.NEW:
                hint = '; a start() of its own has to call super().start() before anything else'
            raise NodeStoppedError(
                f'{self.name} is {self._lifecycle.value}: start() it first{hint}'
            )
        return self._rospy
