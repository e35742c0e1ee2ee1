"""Nodes: real ROS nodes of this process, written with blocks."""
from __future__ import annotations

import functools
import threading
import types
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Iterator

from genpy import Message
import rosgraph.names

from pharos import definitions, signals
from pharos.blocks import Block, DelegateHolder, block_name, with_arguments
from pharos.channels import (
    QUEUE_SIZE,
    Channel,
    InputChannel,
    OutputChannel,
    class_of,
    find_to_send,
    wait_subscribed,
)
from pharos.errors import (
    MasterUnreachableError,
    MessageTypeError,
    NodeStoppedError,
    PharosError,
)
from pharos.failures import Failures
from pharos.names import legal_name, node_name
from pharos.parameter import Parameter
from pharos.private_rospy.run import Lifecycle, Run, Settings
from pharos.service import OfferedService
from pharos.transcript import Transcript
from pharos.waiting import current, wait, wait_for

if TYPE_CHECKING:
    from pharos.live.service_client import Service
    from pharos.master import Master


class Node(DelegateHolder):
    """A ROS node of this process, made by :meth:`Master.create`.

    The report: a subclass of PhaROSNode. A subclass overrides :meth:`start` and :meth:`stop`, and
    calls ``super()``::

        class Driver(Node):
            def start(self):
                super().start()
                self.interested_in('/pose', 'turtlesim/Pose', delegate=self.on_pose)

            def on_pose(self, pose):
                self.send_to('/cmd_vel', typed_as='turtlesim/Velocity', linear=1.0)

    All methods may be called from any thread. A node's delegates run one at a time, in one thread of
    the node, unless it has an inline channel. After create() and restart(), the first one runs when
    :meth:`start` has returned, or sleeps, or after 2 s. Delegates
    and callbacks of plain rospy begin in the order in which their messages came; doc/guide.md says
    how long one that blocks delays others. All private names of this class begin with an underscore:
    a subclass may have a ``run``, ``report`` or ``state``. Methods that need a started node raise
    NodeStoppedError if the node has not started, or has stopped.

    :ivar name: the full name, as registered at the master: '/robot1/driver'
    :ivar master: the node's :class:`Master`
    :ivar soul: the block with the node's own work, called as ``soul(node)``, or None
    :ivar uri: the URI of the node's XML-RPC server; None before the first start
    :ivar domain: the address that the node advertises; None before the first start, unless given
    :ivar tcp_port: the port for messages and services; before the first start the one asked for
    :ivar xmlrpc_port: the port for ROS's calls; before the first start the one asked for
    :ivar failures: a :class:`Failure` for each of :attr:`errors`: the block, its message, the count
    """

    #: seconds that the opening of an output channel waits for subscribers
    connect_timeout = 2.0
    #: seconds that a stop waits for souls, for the delegate that runs, and for messages under way
    stop_timeout = 2.0
    #: seconds that a client may be silent before the node closes its connection
    client_timeout = 5.0
    #: bytes of messages that may wait for a slow receiver, but for those in memory files; a larger
    #: message waits alone
    queue_bytes = 64 << 20
    #: True if any host may end the node by ROS's shutdown call; False: this host and the master's
    allow_remote_shutdown = False

    master: Master
    name: str
    failures = Failures()
    _run_class = Run
    _current_run: Run = None  # type: ignore[assignment]
    _settings: Settings = None  # type: ignore[assignment]
    _is_start_held = False  # True while _start_held() runs
    _has_run_soul = False  # True once fork() or execute() was called

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing: :meth:`Master.create` has given the node its name and settings.

        :raises PharosError: if a program calls the class, or gives this method arguments
        """
        if self._settings and not args and not kwargs:
            return
        name = type(self).__name__
        given = ', '.join([*map(repr, args), *kwargs])
        raise PharosError(
            f"{name}({given}): write Master().create({name}, named='{name.lower()}'), and super().__init__()"
            ' without a name'
        )

    def __init_subclass__(cls, **options: Any) -> None:
        """Have the stop() of a class run only if there is something to stop, and have the last word.

        It says so if it does not call that of Node.
        """
        super().__init_subclass__(**options)
        own_stop: Any = vars(cls).get('stop')
        if own_stop:

            def stop(self: Node, *args: Any, **kwargs: Any) -> Any:
                if not self._is_active:
                    return None
                run = self._current_run
                former_thread = run.last_thread  # that of a stop() that goes on
                run.last_thread = former_thread or threading.get_ident()
                try:
                    value = own_stop(self, *args, **kwargs)
                finally:
                    run.last_thread = former_thread
                if self.is_running:
                    self.log(f'{cls.__name__}.stop() must call super().stop()', 'error')
                return value

            cls.stop = functools.update_wrapper(stop, own_stop)  # type: ignore[assignment]

    def _configure(self, settings: Settings, soul: Block | None, delegate: Block | None) -> None:
        with_arguments(soul, 'soul', 0, 1)  # raises if the block is not a soul
        self._settings = settings
        self._life_lock = threading.RLock()  # held by a start, stop or restart
        self._send_lock = threading.Lock()  # held while send_to() opens a channel
        # (topic, type) as given to send_to -> OutputChannel
        self._send_channels: dict[tuple, OutputChannel] = {}
        # for users alone, whose class may give these names another meaning: this package reads _settings
        self.name = settings.name
        self.master = settings.master
        self.domain = settings.domain
        self.tcp_port, self.xmlrpc_port = settings.ports
        self.uri: str | None = None
        self.soul = soul
        self.delegate = delegate

    # -- life

    def start(self) -> None:
        """Register with the master.

        A stopped node starts again, under the same name and ports. Its channels, services and
        parameters come back. If its class has a start() of its own, that one opens them instead.

        :raises PharosError: if the node runs already
        :raises MasterUnreachableError, NodeNameInUseError, PortInUseError: and nothing is left
        """
        if not self._settings:
            Node.__init__(self)  # says how a node is made
        with self._life_lock:
            if self.lifecycle not in (Lifecycle.NEW, Lifecycle.STOPPED):
                raise PharosError(f'{self._settings.name} is {self.lifecycle.value} already')
            # the endpoints of the run before
            endpoints = self._current_run.endpoints if self._current_run else []
            run = self._run_class(self, self._settings)
            self._current_run = run
            self.failures = run.failures
            signals.started_nodes.append(self)
            try:
                run.start()
                run.lifecycle = Lifecycle.RUNNING
                if not self._has_own_start:
                    for endpoint in endpoints:
                        endpoint.open()
                if not self._is_start_held:
                    run.callback_queue.release()
            except BaseException:
                self._stop_run()
                run.endpoints = endpoints  # the next start opens them: those of the run before
                raise

    @property
    def _has_own_start(self) -> bool:
        """True if the node's class has a start(), which opens its endpoints and forks its souls."""
        return type(self).start is not Node.start

    def _start_held(self) -> None:
        """Start, and let delegates run when the start() of the node's class has returned.

        If a user calls start(), Node.start() itself lets delegates run.
        """
        self._is_start_held = True
        try:
            self.start()
        finally:
            self._is_start_held = False
        if self.lifecycle is Lifecycle.NEW:
            raise PharosError(f'{type(self).__name__}.start() must call super().start() first')
        self._current_run.callback_queue.release()

    def stop(self) -> None:
        """End the souls, send messages under way, unregister, free ports and threads.

        Do nothing if the node is stopped. Wait up to :attr:`stop_timeout` for souls, then for the
        delegate that runs, then for messages. The log names souls that go on after that. In a soul or
        delegate, return at once if a stop goes on already: that one waits for this thread.
        """
        run = self._current_run
        if (
            run
            and run.stopping.is_set()
            and (current.node is self or run.callback_queue.is_current())
        ):
            return  # the stop that goes on waits for this soul or delegate
        with self._life_lock:
            if self.is_running:
                self._stop_run()

    def _stop_run(self) -> None:
        try:
            self._current_run.stop(self.stop_timeout)
        except (KeyboardInterrupt, SystemExit):
            # of a signal: its own stop, in the thread 'pharos end', must find the node running;
            # stopping stays set
            self._current_run.lifecycle = Lifecycle.RUNNING
            raise
        signals.started_nodes.remove(self)

    def _stop_safely(self) -> None:
        """Stop the node, even if the stop() of its class raises; for any number of threads."""
        with self._life_lock:
            try:
                self.stop()
            except Exception as error:
                self._current_run.report_failure(error, self.stop, 'method')
            finally:
                Node.stop(self)  # does nothing if the class's stop() has called it

    def restart(self) -> None:
        """Stop and start the node, with the same name, ports, channels and souls.

        Each soul that had not ended before the stop begins anew, at its first line; so does the node's
        :attr:`soul` if it had failed. If the node's class has a start() of its own, that one opens the
        channels and forks the souls instead.

        :raises MasterUnreachableError: if the master does not answer; the node runs on
        """
        with self._life_lock:
            former_run = self._last_run
            self._settings.master.call('getPid')  # raises if the master does not answer
            live_souls = list(former_run.souls.values())
            signals.started_nodes.append(self)  # once more, or spin() would return
            try:
                self.stop()
                self._start_held()
            finally:
                signals.started_nodes.remove(self)
            if not self._has_own_start:
                names = [name for name, *_ in live_souls]
                broken_souls = [
                    each for each in former_run.broken_souls.values() if each[0] not in names
                ]
                for name, block, required in live_souls + broken_souls:
                    Node.fork(self, block, name, required)  # the class may have another fork()

    def become(self, node_class: type[Node]) -> None:
        """Change the node's class; its name, ports, connections and attributes stay.

        The change happens between two delegates, or at once if a delegate calls this. Methods that
        are blocks of the node become those of the new class; its start() does not run.

        :raises TypeError: if the class is not one of nodes
        :raises AttributeError: if the class lacks a method that is a block of the node
        """
        from pharos.live.editing import become

        self._check_active()
        become(self, node_class, Node)

    def reload(self) -> str:
        """Have the edited files of the node's class or program take effect; return lines on that.

        Objects, subscriptions and connections stay; doc/live.md says what changes, and what cannot.

        :raises PharosError: if a file is not valid, with its name and line. No function, class or value
            has changed, but definitions before that line have run, and new names are there
        """
        from pharos.live.editing import reload

        self._check_active()
        return reload(self)

    def __enter__(self):
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def _check_active(self) -> None:
        """Raise NodeStoppedError if the node has not started, or has stopped."""
        if not self._is_active:
            raise NodeStoppedError(
                f'{self._settings.name} is {self.lifecycle.value}: start() it,'
                ' by super() in a class of your own'
            )

    @property
    def _last_run(self) -> Run:
        """The run that goes on, or else the last one.

        :raises NodeStoppedError: before the first start
        """
        if not self._current_run:
            self._check_active()
        return self._current_run

    @property
    def _is_active(self) -> bool:
        """True if the node runs, or its stop goes on."""
        return self.lifecycle in (Lifecycle.RUNNING, Lifecycle.STOPPING)

    @property
    def is_running(self) -> bool:
        """True if the node has started, and no stop has begun.

        A stop that a signal has broken off leaves it True: the node's next stop is the signal's own.
        """
        return self.lifecycle is Lifecycle.RUNNING

    @property
    def lifecycle(self) -> Lifecycle:
        """The node's state: NEW, STARTING, RUNNING, STOPPING or STOPPED."""
        return self._current_run.lifecycle if self._current_run else Lifecycle.NEW

    @property
    def channels(self) -> list[Channel]:
        """The channels that are open."""
        return self._current_run.open_endpoints(Channel) if self._current_run else []

    @property
    def ros(self) -> Any:
        """The node's own rospy, such as ``node.ros.Timer``; each run has another one.

        After a stop it is the last run's, whose ``is_shutdown()`` is True: a loop on it ends.
        """
        return self._last_run.ros

    def ros_import(self, name: str) -> Any:
        """Return a private copy, for this run, of a library on rospy such as 'actionlib'."""
        import pharos.live.private_classes  # noqa: F401: it has dataclasses work in the library

        self._check_active()
        return self._current_run.modules.load(name)

    def health(self) -> types.SimpleNamespace:
        """Ask the master for the node, and return how the node is doing.

        :returns: an object with ``registered`` (True if the master has the node, None if the master
            is silent), ``kind`` (the class's name), ``connections`` ({transport: number}),
            ``dropped`` (number of messages), ``errors`` (how often blocks failed), ``threads``
            (number), ``cpu_seconds``, ``souls`` (number of those that run in threads),
            ``ended_souls`` (names of the last ten), ``callback_seconds`` (since the callback has begun that runs
            now), ``waiting`` (number of messages), ``lock`` (a text if an import has turned the lock of a
            free-threaded Python on again, else '')
        """
        run = self._last_run
        registered = None
        with suppress(MasterUnreachableError):
            uri = self._settings.master.call('lookupNode', self._settings.name)
            registered = uri == run.uri
        return types.SimpleNamespace(registered=registered, **run.health_facts())

    def describe(self, seconds: float = 1.0) -> str:
        """Return the node's topics, services, peers and rates as text; count for some seconds."""
        from pharos.live.graph import describe

        return describe(self._settings.master, self._settings.name, seconds)

    def __repr__(self) -> str:
        return f'<{type(self).__name__} {self._settings.name} {self.lifecycle.value}>'

    # -- souls

    def execute(self) -> Any:
        """Run the soul once, in this thread, and return its value; None if the soul fails.

        The report: ``node execute``. An exception of the soul goes to :attr:`failures`.
        """
        return self._run_soul(self._check_soul(self.soul))

    def fork(
        self, block: Block | None = None, name: str | None = None, required: bool = False
    ) -> threading.Thread:
        """Run the soul, or ``block(node)``, in a thread of its own, and return the thread.

        The report (listing 3.8): ``[node execute] fork``. :meth:`stop` ends the soul at its next
        :meth:`sleep` or turn of :meth:`every`. An exception of the soul goes to :attr:`failures`,
        but for a SystemExit or a rospy.ROSException after a stop has begun.

        :param name: the thread's name; default: the block's
        :param required: True: when the soul ends, the node stops, and ``spin()`` ends the program
            with status 1, so that a launch file's ``respawn`` and ``required`` see it
        """
        soul = self._check_soul(block or self.soul)
        run = self._current_run
        name = name or block_name(soul)
        entry = name, block, required  # None: a restart runs the soul that the node has then
        thread = run.Thread(target=self._run_soul, args=[soul, required, entry], name=name)
        run.souls[thread] = entry
        thread.start()
        return thread

    def _check_soul(self, block: Block | None) -> Block:
        """Return the block; raise an error if the node is not active or the block is not a soul."""
        self._check_active()
        if with_arguments(block, 'soul', 0, 1) is None:
            raise PharosError(f'{self._settings.name} has no soul: give it one, node.soul = block')
        self._has_run_soul = True
        return block  # type: ignore[return-value]

    def _run_soul(self, block: Block, required: bool = False, entry: Any = None) -> Any:
        run = self._current_run  # a restart makes another one
        former = current.node, current.run
        current.node = self
        current.run = run
        # a retry runs the soul that the node has then; a block of fork() is run again itself
        is_node_soul = block is self.soul

        def retry(message: None) -> None:
            self._run_soul(self.soul if is_node_soul else block)  # type: ignore[arg-type]

        try:
            value = with_arguments(block, 'soul', 0, 1)(self)
            if entry and not run.stopping.is_set():  # it has returned by itself
                run.broken_souls.pop(entry[0], None)
                entry = None
            return value
        except BaseException as error:
            run.report_failure(error, block, 'soul', retry=retry)
        finally:
            current.node, current.run = former
            if entry and (run.stopping.is_set() or entry[1] is None):
                run.broken_souls[entry[0]] = entry
            if required and not run.stopping.is_set():
                self.log(f'stops: {block_name(block)}, which is required, has ended', 'error')
                signals.lost_names.add(self._settings.name)
                run.request_stop()
        return None

    def sleep(self, seconds: float) -> None:
        """Sleep for some seconds of ROS time; the node's stop ends the sleep, and the soul.

        A sleep in start() lets delegates run from now on.

        :raises NodeStoppedError: if the stop has begun before; in a soul also if it begins meanwhile
        :raises SystemExit: in the block of a service, if the stop begins meanwhile; NodeStoppedError if
            /use_sim_time is set, or Ctrl-C or SIGTERM stops it
        """
        self._check_active()
        run = current.run if current.node is self else self._current_run
        is_late = run.stopping.is_set()
        if not is_late:
            with signals.QuietWait():
                run.callback_queue.release_before_sleep()
                run.ros.sleep(seconds)
        is_block = current.node is self or current.service_run is run
        if is_late or is_block and run.stopping.is_set():
            raise NodeStoppedError(f'{self._settings.name} stops, and with it this soul or loop')

    def every(self, seconds: float) -> Iterator[int]:
        """Return an iterator that turns every so many seconds of ROS time, until the node stops.

        The values are the numbers of the turns, from 0 on. A longer turn delays the next one.

        :raises ValueError: if ``seconds`` is not above 0
        """
        if not seconds > 0:
            raise ValueError(f'a period is a number of seconds above 0, not {seconds!r}')
        self._check_active()
        run = self._current_run
        rate = run.ros.Rate(1 / seconds, reset=True)

        def turns() -> Iterator[int]:
            turn = 0
            while not run.stopping.is_set():
                yield turn
                turn += 1
                run.callback_queue.release_before_sleep()
                with signals.QuietWait():
                    rate.sleep()

        return turns()

    # -- failures

    @property
    def errors(self) -> list[BaseException]:
        """The exceptions of blocks in this run of the node, the newest last; 100 kinds at most."""
        failures = self._current_run.failures if self._current_run else []
        return [failure.error for failure in failures]

    def log(self, text: Any, level: str = 'info') -> None:
        """Log a line to the screen, the log file and /rosout; of a stopped node, to the Transcript.

        :param level: 'debug', 'info', 'warning' (or 'warn'), 'error' or 'fatal'
        :raises ValueError: for another level
        """
        if level not in ('debug', 'info', 'warn', 'warning', 'error', 'fatal'):
            raise ValueError(f'unknown level {level!r}: give info or error, and one text')
        if self._is_active:
            # called from here, not from a helper: rospy logs the caller of this method
            self._current_run.ros.core._base_logger('%s', (text,), {}, level=level)
        else:
            Transcript.show(f'[{level.upper()}] {self._settings.name}: {text}')

    # -- topics

    def _resolve(self, name: str) -> str:
        """Return the full name of a topic, service or parameter; apply the node's remappings.

        :raises ValueError: if the name is not legal
        """
        self._check_active()
        return self._current_run.ros.resolve_name(legal_name(name).replace('~/', '~'))

    def _peer_name(self, peer: Any) -> str:
        """Return the full name of a Node, an ExternalNode, or a node given by its name."""
        if isinstance(peer, Node):
            return peer._settings.name
        name = getattr(peer, 'name', peer)  # an ExternalNode has one
        return rosgraph.names.resolve_name(node_name(name), self._settings.name)

    def interested_in(
        self,
        topic: str,
        typed_as: str | type | None = None,
        delegate: Block | None = None,
        queue_size: int = QUEUE_SIZE,
        inline: bool = False,
        shared: bool = False,
        from_: Any = None,
    ) -> InputChannel:
        """Receive the messages of a topic from now on.

        The report: ``self interestedIn: '/pose' typedAs: 'turtlesim/Pose'``.

        :param typed_as: type name or message class; default: the type known to node or master
        :param delegate: for this channel only; default: :attr:`delegate`
        :param queue_size: messages that wait at most; the oldest are dropped, and counted
        :param inline: True: a publisher of this process runs the delegate in its own thread, and with
            it the node's other delegates if messages wait for them
        :param shared: True: the delegate gets the published object itself, which nobody may change
        :param from_: receive from that node alone: its name, Node or ExternalNode
        :raises UnknownTopicError, UnknownTypeError: if the type is not known
        :raises MessageTypeError: if the node has the topic open with another type
        :raises MasterUnreachableError: if the master does not answer; nothing is left behind
        :raises ValueError: if both ``shared`` and ``from_`` are given
        """
        topic = self._resolve(topic)
        if shared and from_:
            raise ValueError(
                f'{topic}: give shared or from_, not both: a shared message does not name its sender'
            )
        peer_name = self._peer_name(from_) if from_ else None
        message_class = class_of(self, topic, typed_as)
        return InputChannel(
            self, topic, message_class, delegate, queue_size, inline, shared, peer_name
        )

    def output_channel(
        self,
        topic: str,
        typed_as: str | type | None = None,
        latch: bool = False,
        queue_size: int = QUEUE_SIZE,
    ) -> OutputChannel:
        """Open a channel to send to a topic, and wait until the known subscribers are connected.

        The wait lasts up to :attr:`connect_timeout`. The log names subscribers that are late.

        :param typed_as: as for :meth:`interested_in`, with the same errors
        :param latch: True: later subscribers get the last message, too
        :param queue_size: messages that wait for each subscriber in another process at most
        """
        topic = self._resolve(topic)
        return OutputChannel(self, topic, class_of(self, topic, typed_as), latch, queue_size)

    def send_to(
        self,
        topic: str,
        block: Any = None,
        *values: Any,
        typed_as: str | type | None = None,
        to: Any = None,
        **fields: Any,
    ) -> Message:
        """Send a message to a topic, and return the message.

        The first message opens a channel, or takes an open one; see :meth:`output_channel`.
        The report: ``self sendTo: '/cmd_vel' a: [:msg | msg linear: 2.0]``::

            node.send_to('/cmd_vel', typed_as='turtlesim/Velocity', linear=2.0)
            node.send_to('/cmd_vel', lambda msg: setattr(msg, 'linear', 2.0))

        :param block: ``block(message)`` fills a new message; or a ready message, or a dict of
            fields, or the value of the only field; or a message class, which is the type
        :param typed_as: as for :meth:`interested_in`, with the same errors
        :param to: the node that alone gets the message: a name, Node or ExternalNode
        :param fields: fill the message by name
        :raises MessageTypeError: if the message does not fit the topic, or has no such field
        :raises UnknownNodeError: if the node ``to`` is not connected
        """
        if values:
            raise MessageTypeError(
                f'send_to({topic!r}, ...) takes one value: name the fields, as in data={values[-1]!r},'
                f' and the type, as in typed_as={block!r}'
            )
        if isinstance(block, type):
            typed_as = block
            block = None
        channel = self._send_channels.get((topic, typed_as))
        if channel and not channel.closed:
            return channel.send(block, to=to, **fields)
        with self._send_lock:  # two threads that send first open one channel
            message_class = type(block) if isinstance(block, Message) else None
            channel, is_new = find_to_send(self, self._resolve(topic), typed_as or message_class)
            self._send_channels[topic, typed_as] = channel
        try:
            return channel.send(block, to=to, **fields)
        except Exception:
            if is_new:
                channel.close()
            raise

    def wait_for_message(
        self,
        topic: str,
        typed_as: str | type | None = None,
        timeout: float | None = None,
        where: Block | None = None,
    ) -> Message:
        """Return the next message of a topic; a latched one comes at once.

        :param timeout: seconds until the type is known, and as long for the message; None: without
            limit, but the type must be known
        :param where: skip messages unless ``where(message)`` is true
        :raises UnknownTopicError: if the topic's type is not known in time
        :raises TimeoutError: if no such message comes in time
        :raises NodeStoppedError: if the node stops meanwhile
        """
        topic = self._resolve(topic)
        received: list[Message] = []

        def find_wanted(subscriber: Any) -> list[Message]:
            """Drop messages up to the first wanted one, and return the rest."""
            while received and where and not where(received[0]):
                del received[0]
            return received

        master = self._settings.master
        master.call('getPid')  # raises if the master does not answer
        if timeout and not typed_as:
            typed_as = wait(lambda: master.topic_type(topic), timeout, self)
        message_class = class_of(self, topic, typed_as)
        if wait_subscribed(self, find_wanted, timeout, topic, message_class, received.append):
            return received[0]
        if not self._current_run.stopping.is_set():
            raise TimeoutError(f'no message on {topic} came within {timeout:g} s: is it published?')
        raise NodeStoppedError(f'{self._settings.name} stopped while it waited for {topic}')

    # -- services and parameters

    def serve(self, name: str, typed_as: str | type, block: Block) -> OfferedService:
        """Offer a service, and return an object with ``close()``.

        ``block(request)`` runs in a thread of the caller's connection; or in the caller's thread, if
        that is one of this process, and the call has no ``timeout``. Several calls may run at once. The
        block returns a response, a dict, tuple or list of its fields, or its only field; None for an
        empty response. If the block raises an exception, the caller gets an error, and :attr:`failures` an entry.

        :raises PharosError: if the node offers the service already
        :raises UnknownTypeError: if the type is not known
        """
        return OfferedService(self, self._resolve(name), definitions.service_class(typed_as), block)

    def lookup_service(self, name: str) -> Service:
        """Return the service of a name that the node resolves, or raise UnknownServiceError."""
        return self._settings.master.lookup_service(self._resolve(name), self._settings.name)

    def wait_for_service(self, name: str, timeout: float | None = None) -> Service:
        """Wait until a service of that name is offered, and return the service.

        :param timeout: seconds, None: without limit; the node's stop ends the wait, too
        :raises UnknownServiceError: if nobody offers the service in time
        """
        self._check_active()
        return wait_for(lambda: self.lookup_service(name), timeout, f'the service {name}', self)

    def parameter(self, name: str, initialized: Any = None) -> Parameter:
        """Return a parameter of the server, bound both ways; '~rate' is private to the node.

        :param name: each call with the same name returns the same object
        :param initialized: the value that the parameter gets if the server has none
        """
        name = self._resolve(name)
        for parameter in self._parameters:
            if parameter.name == name:
                return parameter
        return Parameter(self, name, initialized)

    @property
    def _parameters(self) -> list[Parameter]:
        """The parameters that :meth:`parameter` has returned."""
        return self._current_run.open_endpoints(Parameter)


class BlockNode(Node):
    """A node made of blocks alone, for tests and prototypes: PhaROSBlockNode in the report."""
