"""Nodes: real ROS nodes of this process, written with blocks."""
import contextlib
import functools
import inspect
import numbers
import threading
from typing import TYPE_CHECKING, Any, Callable, Iterator, List, Optional, Type, Union

import genpy

from pharos import node_registry, signals
from pharos.blocks import attempt, check_block, check_delegate, check_runs, check_soul
from pharos.channel import InputChannel, OutputChannel
from pharos.errors import NodeStoppedError, PharosError
from pharos.failures import Failure, Failures
from pharos.health import Health, health_of
from pharos.offered_service import OfferedService
from pharos.parameter import Parameter
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.settings import Settings
from pharos.run import Lifecycle, Run
from pharos.seconds import check_seconds
from pharos.topic import QUEUE_SIZE, Topic
from pharos.transcript import Transcript

if TYPE_CHECKING:
    from pharos.external_node import ExternalNode
    from pharos.master import Master

    Peer = Union[str, 'Node', ExternalNode, None]

Block = Optional[Callable[..., Any]]
TypedAs = Union[str, Type[genpy.Message], None]
Channel = Union[InputChannel, OutputChannel]


class Node:
    """A ROS node of this process: made by :meth:`Master.create`, subclassed to override
    :meth:`start` and :meth:`stop`.

    The report (listing 3.1), a subclass of PhaROSNode, is in Python::

        class TurtleDriver(Node):
            def start(self):
                super().start()
                self.fork(TurtleDriver.publishing_loop)

    A node is configured before its ``__init__`` runs, which gets only the further keywords of
    ``create``.
    """

    #: seconds that a topic's first message waits for the subscribers the master knows
    connect_timeout = 2.0
    #: bytes of messages, about, that wait for a slow receiver for each publisher, or one message
    queue_bytes = 64 << 20
    #: whether any host may ask it to stop, not only this one and the master's
    allow_remote_shutdown = False
    #: seconds that :meth:`stop` waits for souls, and for messages under way
    stop_timeout = 2.0

    #: the run of the present start, or the last one; None before the first start
    latest_run: Run = None  # type: ignore[assignment]
    #: whether a start opens again what the last run had; a start() of one's own opens it itself
    _reopens = True

    def __init__(self) -> None:
        if '_settings' not in vars(self):
            name = type(self).__name__
            raise TypeError(
                f'a node is made by a master: Master().create({name}, named=...), not {name}()'
            )

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for name in ('soul', 'delegate'):
            if name in vars(cls) and not isinstance(vars(cls)[name], property):
                raise TypeError(
                    f'{cls.__name__}.{name} would never run: each node has a {name} of its own,'
                    f' given to create() or set. Name it otherwise, and set self.{name} in start()'
                )
        for name in _CHECKED.intersection(vars(cls)):
            value = getattr(cls, name)
            if not isinstance(value, property) and _checked(name, value) is not value:
                setattr(cls, name, _checked(name, value))
        for method in cls.start, cls.stop:
            check_runs(method, f'{cls.__name__}.{method.__name__}')
        cls._reopens = cls.start is Node.start
        if 'start' in vars(cls):
            cls.start = _of_one_run(cls.start)  # type: ignore[assignment]
        cls.stop = node_registry.one_stop_at_a_time(cls.stop)  # type: ignore[assignment]

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _CHECKED:
            if name in ('start', 'stop') or name in _SET_ONCE and name in vars(self):
                raise _not_to_be_set(name)
            value = _checked(name, value)
        super().__setattr__(name, value)

    def _configure(
        self, master: 'Master', settings: Settings, soul: Block, delegate: Block
    ) -> None:
        self.master = master
        self._settings = settings
        self._errors = Failures(self._tell_failure)
        self.soul, self.delegate = soul, delegate

    # -- life

    def start(self) -> None:
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
        Run(self, self._settings).start(self._reopens)

    @node_registry.one_stop_at_a_time
    def stop(self) -> None:
        """End the souls, send what is under way, unregister, close the ports, end the threads.

        A subclass overrides this and calls ``super().stop()``. It runs once for each start, to its
        end, in the thread that was the first to ask for it: the program (here, a signal, its end)
        or ROS (``rosnode kill``). Who asks meanwhile, from any thread, waits until it has ended, as
        does the end of the program, but only until 30 s after its beginning. Called in a thread of
        the node's own, it does not wait for what that thread runs. A node that is still starting is
        stopped, too: its start raises NodeStoppedError.
        """
        self.current_run.end()

    @property
    def name(self) -> str:
        """The node's name, as the master knows it: '/robot1/driver'."""
        return self._settings.name

    @name.setter
    def name(self, value: Any) -> None:
        raise AttributeError(
            f'{self.name} is the name by which the master knows the node: give another one to'
            f' create(), as named={value!r}, and what else {type(self).__name__} is called to'
            ' another attribute'
        )

    @property
    def lifecycle(self) -> Lifecycle:
        """A :class:`Lifecycle`."""
        return Lifecycle.NEW if self.latest_run is None else self.latest_run.lifecycle

    @property
    def is_running(self) -> bool:
        """Whether the node is started and no stop has begun."""
        return self.lifecycle is Lifecycle.RUNNING

    @property
    def current_run(self) -> Run:
        """The :class:`~pharos.run.Run` of the present start.

        :raises NodeStoppedError: if the node is not started
        """
        if node_registry.is_superseded(self):
            raise NodeStoppedError(f'{self.name} was stopped while it started, and started again')
        run, lifecycle = self.latest_run, self.lifecycle
        if run is not None and lifecycle in (Lifecycle.RUNNING, Lifecycle.STOPPING):
            return run
        hint = ''
        if lifecycle is Lifecycle.NEW:
            hint = '; a start() of its own has to call super().start() before anything else'
        raise NodeStoppedError(f'{self.name} is {lifecycle.value}: start() it first{hint}')

    def __enter__(self) -> 'Node':
        return self

    def __exit__(self, *error: Any) -> None:
        self.stop()

    def sleep(self, seconds: float) -> None:
        """Wait for ``seconds`` of ROS time, or until the node stops; a soul is ended by that.

        The report: ``(Delay forSeconds: 1) wait``.
        """
        seconds = check_seconds('a sleep', seconds)
        run = self.current_run
        with signals.interruptible_wait(), contextlib.suppress(rospy.ROSInterruptException):
            run.rospy.rospy.sleep(seconds)
        run.end_soul()

    def every(self, seconds: float) -> Iterator[None]:
        """An iterator that turns at once and then every ``seconds`` of ROS time, without drift,
        until the node stops.

        A turn that takes longer than ``seconds`` delays the next, which then comes at once.
        """
        seconds = check_seconds('a period', seconds, above=0)
        return self.current_run.turns(self.ros.Rate(1.0 / seconds, reset=True))

    # -- blocks

    @property
    def soul(self) -> Block:
        """The block that says what the node does, called as ``soul(node)`` by :meth:`execute` and
        :meth:`fork`.

        May be replaced while the node runs, and takes effect with the next run.
        """
        return self._soul

    @soul.setter
    def soul(self, block: Block) -> None:
        self._soul = check_soul(block)

    @property
    def delegate(self) -> Block:
        """The block run for each message received, called as ``delegate(message, channel)``.

        The report: ``self receiverDelegate: [:message :channel | ...]``. Delegates of a node run
        one at a time. It may be replaced while the node runs, and takes effect with the next
        message.
        """
        return self._delegate

    @delegate.setter
    def delegate(self, block: Block) -> None:
        self._delegate = check_delegate(block)

    def execute(self) -> Any:
        """Run the soul once, in the calling thread, and return its value.

        The report (listing 3.7): ``node execute``. An exception in the soul is reported (see
        :attr:`errors`) and ends only this run, which then returns None.
        """
        return self._soul_runner(None)()

    def fork(self, block: Block = None, name: Optional[str] = None) -> threading.Thread:
        """Run the soul, or ``block(node)``, in a thread of its own, and return the thread.

        The report (listing 3.8): ``[node execute] fork``. :meth:`stop` ends it at its next
        :meth:`sleep` or turn of :meth:`every`.
        """
        return self.current_run.fork(self._soul_runner(block), name or 'soul')

    def _soul_runner(self, block: Block) -> Callable[[], Any]:
        """What runs the soul, or ``block``, as it is now; run again later, as it is then."""
        run, soul = self.current_run, self._soul if block is None else check_soul(block)
        if soul is None:
            raise PharosError(
                f'{self.name} has no soul to run: give it one with soul= or node.soul ='
            )
        return lambda: run.run_soul(soul, again=lambda nothing: self._soul_runner(block)())

    @property
    def errors(self) -> Failures:
        """The exceptions that blocks raised, the newest last: of identical ones the newest alone.

        100 are kept, among them the first, for it may be the cause of the others. Who has seen to
        them may ``pop`` or ``clear`` them.
        """
        return self._errors

    @property
    def failures(self) -> List[Failure]:
        """For each of :attr:`errors` its :class:`~pharos.Failure`: what failed, on what, how
        often."""
        return self._errors.all()

    def _tell_failure(self, line: str, details: str) -> None:
        attempt(lambda: self.log(f'{line}\n{details}' if details else line, level='error'))
        Transcript.show(line)

    # -- topics

    def interested_in(
        self,
        topic: str,
        typed_as: TypedAs = None,
        delegate: Block = None,
        queue_size: int = QUEUE_SIZE,
        inline: bool = False,
        shared: bool = False,
        from_: 'Peer' = None,
        wait: float = 0,
    ) -> InputChannel:
        """Receive the messages of a topic from now on; returns the :class:`InputChannel`.

        The report (listing 3.3)::

            self interestedIn: '/turtle1/command_velocity' typedAs: 'turtlesim/Velocity'
            self.interested_in('/turtle1/command_velocity', typed_as='turtlesim/Velocity')

        :param typed_as: type name or message class; None: the master's type for the topic, whose
            definition comes from a publisher where no package here has it
        :param delegate: block for this channel only, instead of the node's
        :param queue_size: messages kept while the node is busy; the oldest are dropped and counted.
            Of large messages no more are kept than have :attr:`queue_bytes` bytes, 64 MiB by
            default.
        :param inline: run the delegate in the publisher's thread, where that is a node of this
            process
        :param shared: get the very message that a node of this process published, and promise not
            to change it
        :param from_: only messages of that node: a name, resolved as the topic's is, a Node or
            ExternalNode; it need not be there yet
        :param wait: without ``typed_as``, seconds to wait until somebody has given the topic a type
        :raises UnknownTopicError, UnknownTypeError, MessageTypeError: if there is no type, or
            another
        :raises ValueError: if ``topic`` or ``from_`` cannot be a name
        :raises MasterUnreachableError: if the master does not answer; nothing is left behind then
        """
        return self._topic(topic).input_channel(
            self, typed_as, delegate, queue_size, inline, shared, from_, wait
        )

    def output_channel(
        self,
        topic: str,
        typed_as: TypedAs = None,
        latch: bool = False,
        queue_size: int = QUEUE_SIZE,
        wait: float = 0,
    ) -> OutputChannel:
        """Publish on a topic from now on; returns the :class:`OutputChannel`.

        :param typed_as: type name or message class; None: the master's type for the topic
        :param latch: send the last message to those who become interested later, also after a
            restart of this node; one sent ``to=`` a node is for that node alone
        :param queue_size: messages kept for each slow receiver; the oldest are dropped
        :param wait: as in :meth:`interested_in`
        :raises MasterUnreachableError: if the master does not answer; nothing is left behind then
        """
        return self._topic(topic).output_channel(self, typed_as, latch, queue_size, wait=wait)

    def send_to(
        self,
        topic: str,
        block: Block = None,
        *,
        typed_as: TypedAs = None,
        to: 'Peer' = None,
        connect_timeout: Optional[float] = None,
        wait: float = 0,
        **fields: Any,
    ) -> genpy.Message:
        """Send one message, filled by ``block(message)``, by keywords, or both; returns it.

        The report (listing 3.1)::

            self sendTo: '/turtle1/command_velocity'
                a: [:message | message angular: 1.0. message linear: 2.0]
            self.send_to('/turtle1/command_velocity', angular=1.0, linear=2.0)

        The first message on a topic waits for the subscribers that the master knows, for up to
        ``connect_timeout`` seconds (None: the node's), so that it is not lost.

        :param to: send it to that node alone: a name, resolved as the topic's is, a Node or
            ExternalNode. One that is not interested in the topic gets nothing, and the log says so
            once.
        :param wait: as in :meth:`interested_in`
        :raises UnknownNodeError: if there is no node ``to``
        :raises ValueError: if ``topic`` or ``to`` cannot be a name
        :raises MessageTypeError: if a field does not exist or does not fit
        :raises UnknownTopicError, UnknownTypeError: if there is no type
        """
        if to is not None:
            to = self.current_run.resolve_peer(to)
        if connect_timeout is None:
            connect_timeout = self.connect_timeout
        else:
            connect_timeout = check_seconds('connect_timeout', connect_timeout)
        if wait != 0:
            wait = check_seconds('wait', wait, least=0)
        run = self.current_run
        channel = run.send_channels.get(topic) if isinstance(topic, str) else None
        if channel is None or not channel.is_open:
            check_block(block, 'block', ('message',))
            channel = run.sender(self._topic(topic), typed_as, connect_timeout, wait)
            run.send_channels[topic] = channel
        if typed_as not in (None, channel.message_class, channel.type):
            self._topic(topic).message_class(self, typed_as)  # refuses another type
        # another thread may be opening it just now
        channel.wait_until_connected(connect_timeout)
        return channel.send(block, to=to, **fields)

    @property
    def channels(self) -> List[Channel]:
        """The channels that the node has open."""
        return self.latest_run.channels if self.latest_run else []

    def _topic(self, name: str) -> Topic:
        return Topic(self.master, self.current_run.resolve(name, 'topic'))

    # -- services, parameters, log

    def serve(self, name: str, typed_as: TypedAs, block: Callable[[Any], Any]) -> OfferedService:
        """Offer a service; returns a handle with ``close()``.

        ``block(request)`` runs in a thread of the caller's connection and returns a response, a
        dict, tuple or list of its fields, or its only field. An exception in it goes to the caller,
        and is reported as a delegate's.

        :param typed_as: service type name, such as 'std_srvs/Empty', or class
        :raises MasterUnreachableError: if the master does not answer; nothing is left behind then
        """
        return OfferedService(self, self.current_run.resolve(name, 'service'), typed_as, block)

    def parameter(self, name: str, initialized: Any = None) -> Parameter:
        """The :class:`Parameter` of that name ('~rate' is private); set to ``initialized`` where it
        has no value."""
        return Parameter(self, self.current_run.resolve(name, 'parameter'), initialized)

    def log(self, text: str, level: str = 'info') -> None:
        """Log a line on /rosout, the node's log file and the screen, with the file and line of the
        caller.

        :param level: 'debug', 'info', 'warning' (or 'warn'), 'error' or 'fatal'
        """
        try:
            level = _LEVELS[level]
        except KeyError:
            raise ValueError(f"no log level {level!r}: there are {', '.join(_LEVELS)}") from None
        if self.latest_run is not None:
            log = self.latest_run.rospy.log
            # no wrapper between: rospy looks for the caller of this method
            log('%s', (text,), {}, level=level)

    # -- what rospy offers beyond

    @property
    def ros(self) -> Any:
        """The node's own rospy, whole: ``node.ros.Timer``, ``node.ros.Time.now()``. It is for this
        run of the node."""
        return self.current_run.rospy.rospy

    def ros_import(self, name: str) -> Any:
        """A library written on rospy ('actionlib', 'message_filters', 'tf2_ros'), bound to this run
        of the node."""
        if not isinstance(name, str):
            raise TypeError(f"a library is given by its name, such as 'actionlib', not as {name!r}")
        return self.current_run.rospy.import_library(name)

    @property
    def uri(self) -> Optional[str]:
        """The URI of the node's XML-RPC server, None before the first start."""
        return self.latest_run.rospy.uri if self.latest_run else None

    @property
    def tcp_port(self) -> int:
        """The TCPROS port; the one asked for, before the first start."""
        return self._settings.tcp_port

    @property
    def xmlrpc_port(self) -> int:
        """The XML-RPC port; the one asked for, before the first start."""
        return self._settings.xmlrpc_port

    @property
    def domain(self) -> Optional[str]:
        """The address that the node advertises, None before the first start."""
        return self.latest_run.rospy.domain if self.latest_run else None

    def health(self) -> Health:
        """How the node is doing: ``registered, reachable_since, connections, dropped, errors,
        threads``, a named tuple.

        Asks the master, for up to 5 s; ``str()`` of it is one line, which ``repr(node)`` shows too.
        """
        return health_of(self, ask=True)

    def __repr__(self) -> str:
        health = f': {health_of(self, ask=False)}' if self.is_running else ''
        return (
            f'<{type(self).__name__} {self.name} {self.lifecycle.value},'
            f' {len(self.channels)} channels{health}>'
        )


def _of_one_run(start: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(start)
    def start_in_run(node: Node, *args: Any, **kwargs: Any) -> Any:
        with node_registry.start_of(node):
            return start(node, *args, **kwargs)

    return start_in_run


_METHODS = frozenset(name for name, value in vars(Node).items() if inspect.isfunction(value))
_SET_ONCE = frozenset(['master', '_settings', '_errors'])
_SECONDS = frozenset(['connect_timeout', 'stop_timeout'])
#: attributes without which a node could not work, nor stop
_CHECKED = _METHODS | _SET_ONCE | _SECONDS | {'queue_bytes'}


def _checked(name: str, value: Any) -> Any:
    """The value that an attribute of Node's gets, in a class or one of its nodes."""
    if name in _SECONDS:
        return check_seconds(name, value)
    is_number = isinstance(value, numbers.Real)
    if name == 'queue_bytes' and not (is_number and value > 0):
        raise ValueError(f'queue_bytes is a number of bytes above 0, not {value!r}')
    if name in _METHODS and not callable(value):
        raise _not_to_be_set(name)
    return value


def _not_to_be_set(name: str) -> AttributeError:
    return AttributeError(
        f'{name} is what each Node has, and needs: give what else has that name another one'
    )


class BlockNode(Node):
    """A node made of blocks alone, for tests and prototypes.

    The report (listing 3.7)::

        node := master create: PhaROSBlockNode named: '/myNode' ... soul: [:myNode | ...].
        node execute
        node = master.create(BlockNode, named='/myNode', soul=lambda me: ...)
        node.execute()
    """


def make(
    node_class: Type[Node],
    master: 'Master',
    named: str,
    soul: Block,
    delegate: Block,
    args: Any,
    kwargs: Any,
    **settings: Any,
) -> Node:
    """A new node of ``node_class``, configured and not yet started."""
    if not (isinstance(node_class, type) and issubclass(node_class, Node)):
        raise TypeError(f'a node is made of a subclass of Node, or BlockNode; not {node_class!r}')
    node = node_class.__new__(node_class)
    node._configure(master, Settings(named, master.url, **settings), soul, delegate)
    node.__init__(*args, **kwargs)  # type: ignore[misc]
    return node


# names of levels -> rospy's
_LEVELS = {level: level for level in ('debug', 'info', 'warning', 'error', 'critical')}
_LEVELS.update(warn='warning', err='error', fatal='critical')
