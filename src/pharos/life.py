"""The life of a node: started, stopped and started again, and the waits that end with it."""
import contextlib
import enum
import threading

from pharos import running
from pharos.blocks import Souls
from pharos.dispatcher import Dispatcher
from pharos.errors import NodeStoppedError, PharosError
from pharos.private_rospy.host import rospy
from pharos.private_rospy.instance import PrivateRospy
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

    connect_timeout = 2.0    #: seconds that a topic's first message waits for the subscribers the master knows
    queue_bytes = 64 << 20   #: bytes of messages, about, that wait for a slow receiver for each publisher, or one message
    allow_remote_shutdown = False    #: whether any host may ask it to stop, not only this one and the master's
    stop_timeout = 2.0       #: seconds that :meth:`stop` waits for souls, and for messages under way

    def _configure(self, master, settings):
        self.master = master
        self.name = settings.name
        self._settings = settings
        self._lifecycle = Lifecycle.NEW
        self._changing = threading.Condition()    # guards _lifecycle
        self._rospy = self._dispatcher = None     # of the present run, or the last
        self._souls = Souls(self)
        self._channels, self._services = [], []

    def start(self):
        """Register with the master. A subclass overrides this, calls ``super().start()``, then makes its channels.

        Runs in the thread that creates the node. A stopped node starts again, under the same name and ports. Where a
        class has no ``start`` of its own, the channels, services and parameters that it had come back too.

        :raises PharosError: if the node is running already
        :raises MasterUnreachableError, NodeNameInUseError, PortInUseError: and the node is then as it was
        """
        with self._changing:
            if self._lifecycle not in (Lifecycle.NEW, Lifecycle.STOPPED):
                raise PharosError('%s is %s already: stop() it before you start it again'
                                  % (self.name, self._lifecycle.value))
            before, self._lifecycle = self._lifecycle, Lifecycle.STARTING
        with running.signals_deferred():
            try:
                instance = PrivateRospy(self._settings, self._asked_to_stop, lambda: self.allow_remote_shutdown)
                instance.start(self.connect_timeout)
            except BaseException:
                self._become(before)
                raise
            former, self._rospy = self._rospy, instance
            # the same ports next time, also where any free one was asked for
            self._settings.tcp_port, self._settings.xmlrpc_port = instance.tcp_port, instance.xmlrpc_port
            self._dispatcher = Dispatcher(instance.start_thread)
            instance.on_received = self._dispatcher.run
            self._become(Lifecycle.RUNNING)
            running.add(self)
            watcher_of(self.master).check()
        kept, self._channels = self._channels, []
        services, self._services = self._services, []
        if type(self).start is Life.start:
            for opened in (*kept, *services):
                opened._open()
            if former:
                instance.parameters.take_over(former.parameters)

    def stop(self):
        """End the souls, send what is under way, unregister, close the ports, end the threads.

        A subclass overrides this and calls ``super().stop()``. Harmless when done twice; may be called from any
        thread, also the node's own, in which case what that thread runs is not waited for.
        """
        with self._changing:
            if self._lifecycle is Lifecycle.STOPPING and not self._is_own_thread():
                self._changing.wait_for(lambda: self._lifecycle is Lifecycle.STOPPED, 2 * self.stop_timeout)
            if self._lifecycle is not Lifecycle.RUNNING:
                return
            self._lifecycle = Lifecycle.STOPPING
        instance = self._rospy
        try:
            instance.end_sleeps()
            ignoring = self._souls.end(self.stop_timeout)
            if ignoring:
                self.log('left behind, for it did not end within %g s of the stop: %s. A soul ends by itself if it '
                         'waits with node.sleep() or loops over node.every()'
                         % (self.stop_timeout, ', '.join(thread.name for thread in ignoring)), level='warning')
            self._dispatcher.close()
            left = instance.stop(self.stop_timeout, ignoring)
            if left:
                Transcript.show('%s left behind threads that did not end: %s' % (self.name, ', '.join(left)))
            for channel in self._channels:
                channel._stopped()
        finally:
            self._become(Lifecycle.STOPPED)
            running.discard(self)
            watcher_of(self.master).check()

    def _is_own_thread(self):
        return self._rospy.owns(threading.current_thread())

    def _become(self, lifecycle):
        with self._changing:
            self._lifecycle = lifecycle
            self._changing.notify_all()

    def _asked_to_stop(self, reason):
        self.log('stops: %s' % (reason,))
        self.stop()

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
        with running.waiting(), contextlib.suppress(rospy.ROSInterruptException):
            self._live_rospy().rospy.sleep(seconds)
        if not self.is_running:
            self._souls.end_here()

    def every(self, seconds):
        """An iterator that turns at once and then every ``seconds`` of ROS time, without drift, until the node stops.

        A turn that takes longer than ``seconds`` delays the next, which then comes at once.
        """
        if not seconds > 0:
            raise ValueError('a period is a number of seconds above 0, not %r' % (seconds,))
        return self._turns(self.ros.Rate(1.0 / seconds, reset=True))

    def _turns(self, rate):
        while self.is_running:
            yield
            with running.waiting(), contextlib.suppress(rospy.ROSInterruptException):
                rate.sleep()

    def _live_rospy(self):
        if self._lifecycle not in (Lifecycle.RUNNING, Lifecycle.STOPPING):
            raise NodeStoppedError('%s is %s: start() it first' % (self.name, self._lifecycle.value))
        return self._rospy
