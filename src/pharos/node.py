"""Nodes: real ROS nodes of this process, written with blocks."""
from __future__ import annotations

import enum
import functools
import re
import threading
import types
from contextlib import suppress
from typing import TYPE_CHECKING, Iterator

from genpy import Message
import rosgraph.names
import rospy

from pharos import messages
from pharos.blocks import Block, Receiver, name_of, rebound, taking
from pharos.channels import QUEUE_SIZE, Channel, InputChannel, OutputChannel
from pharos.errors import MasterUnreachableError, MessageTypeError, NodeStoppedError
from pharos.errors import PharosError, UnknownTopicError
from pharos.external_node import ExternalNode
from pharos.failures import Failure, Failures
from pharos.names import legal_name, node_name
from pharos.parameter import Parameter
from pharos.private_rospy.run import Run
from pharos.program import here, is_signalled, nodes, quiet_wait, wait, wait_for
from pharos.service import OfferedService, Service
from pharos.transcript import Transcript

if TYPE_CHECKING:
    from pharos.master import Master


class Lifecycle(enum.Enum):
    """The states of a node; see :attr:`Node.lifecycle`."""

    NEW = 'new'
    STARTING = 'starting'
    RUNNING = 'running'
    STOPPING = 'stopping'
    STOPPED = 'stopped'


class Node(Receiver):
    """A ROS node of this process, made by :meth:`Master.create`.

    The report: a subclass of PhaROSNode. A class of your own overrides :meth:`start` and
    :meth:`stop`, and calls ``super()``::

        class Driver(Node):
            def start(self):
                super().start()
                self.interested_in('/pose', 'turtlesim/Pose', delegate=self.on_pose)

            def on_pose(self, pose):
                self.send_to('/cmd_vel', typed_as='turtlesim/Velocity', linear=1.0)

    All methods may be called from any thread. A node's delegates run one at a time, and the first
    one when :meth:`start` has returned. All that this class has inside begins with an underscore: a
    class of your own may have a ``run``, ``report`` or ``state``.

    :ivar name: the full name, as the master knows it: '/robot1/driver'
    :ivar master: its :class:`Master`
    :ivar soul: the block that says what the node does, called as ``soul(node)``, or None
    :ivar uri: the URI of its XML-RPC server, None before the first start, as ``domain``, the
        address that it advertises, unless it was given
    :ivar tcp_port: its port for messages; before the first start the one asked for
    :ivar xmlrpc_port: its port for ROS's calls, likewise
    :ivar failures: for each of :attr:`errors` a :class:`Failure`: what failed, on what, how often
    """

    #: seconds that a topic's first message waits for subscribers
    connect_timeout = 2.0
    #: seconds that a stop waits for souls, and as long for messages under way
    stop_timeout = 2.0
    #: seconds that a client may be silent before it is closed
    client_timeout = 5.0
    #: bytes of messages that wait for a slow receiver, or one message
    queue_bytes = 64 << 20
    #: True if any host may end the node by ROS's shutdown call, not only this one and the master's
    allow_remote_shutdown = False

    master: Master
    name: str
    failures: Failures
    _run_class = Run
    _lifecycle = Lifecycle.NEW
    _run: Run
    _failures = Failures()
    _is_beginning = False  # True while a start() runs after which delegates are let run
    _master: Master = None  # type: ignore[assignment]

    def __init__(self, *args, **kwargs):
        """Do nothing: :meth:`Master.create` has given the node its name and all else.

        :raises PharosError: if the class is called, or this method with arguments
        """
        if args or kwargs or not self._master:
            kind = type(self).__name__
            given = (
                f'{kind} takes no {", ".join([*map(repr, args), *kwargs])}'
                if args or kwargs
                else kind
            )
            raise PharosError(
                f"{given}: write Master().create({kind}, named='{kind.lower()}'), and"
                ' super().__init__() without a name'
            )

    def _configure(self, master, name, soul, delegate, domain, ports, remappings):
        taking(soul, 'soul', 0, 1)
        self._name = name
        self._master = master
        self._domain = domain
        self._ports = ports
        self._remappings = remappings
        # what users read; their class may set these names to something else
        self.name = name
        self.master = master
        self.uri = None
        self.domain = domain
        self.tcp_port, self.xmlrpc_port = ports
        self.soul = soul
        self.delegate = delegate
        self._life = threading.RLock()  # held by a start, stop or restart
        self._opening = threading.Lock()  # held while send_to() opens a channel
        self._opened = []  # channels, services and parameters, also while it is stopped
        self._senders = {}  # (topic, type) as given to send_to

    # -- life

    def start(self) -> None:
        """Register with the master.

        A stopped node starts again, under the same name and ports. Its channels, services and
        parameters come back, unless its class has a start() of its own, which opens them.

        :raises PharosError: if the node runs already
        :raises MasterUnreachableError, NodeNameInUseError, PortInUseError: and nothing is left
        """
        if not self._master:
            Node.__init__(self)  # says how a node is made
        with self._life:
            if self._lifecycle not in (Lifecycle.NEW, Lifecycle.STOPPED):
                raise PharosError(f'{self._name} is {self._lifecycle.value} already')
            self._failures = self.failures = Failures()
            self._souls = {}
            self._lifecycle = Lifecycle.STOPPED  # it stays so if a script cannot be read
            run = self._run_class(self)
            self._run = run
            self._lifecycle = Lifecycle.STARTING
            nodes.append(self)
            opened = self._opened
            self._opened = []
            try:
                run.start()
                self._lifecycle = Lifecycle.RUNNING
                if not self._opens_channels():
                    for each in opened:
                        each.open()
                    run.turns.release()
            except BaseException:
                self._end()  # waits for a ScriptNode's thread, which may still register
                self._opened = opened
                raise

    def _opens_channels(self):
        """True if the start() of its class opens its channels itself."""
        return type(self).start is not Node.start

    def _begin(self):
        """Start, and let delegates run when the class's start() has returned."""
        self._is_beginning = True
        try:
            self.start()
        finally:
            self._is_beginning = False
        if self._lifecycle is Lifecycle.NEW:
            raise PharosError(f'{type(self).__name__}.start() must call super().start() first')
        self._run.turns.release()

    def _end(self):
        self._run.stop(self.stop_timeout)
        for each in self._opened:  # rospy has closed it
            each.closed = True
        self._lifecycle = Lifecycle.STOPPED
        nodes.remove(self)

    def stop(self) -> None:
        """End the souls, send what is under way, unregister, free ports and threads.

        Does nothing if the node is stopped. Waits up to :attr:`stop_timeout` for souls, and as long
        for messages under way; what goes on then is left behind, and named in the log.
        """
        with self._life:
            if self._lifecycle is Lifecycle.RUNNING:
                self._lifecycle = Lifecycle.STOPPING
                self._end()

    def _end_now(self):
        """Stop the node, whatever the stop() of its class raises; two threads may ask for it."""
        with self._life:
            try:
                if self._lifecycle is Lifecycle.RUNNING:
                    self.stop()
            except Exception as error:
                self._report(error, self.stop, 'method')
            finally:
                Node.stop(self)

    def restart(self) -> None:
        """Stop the node and start it again, under its name and ports, with its channels and souls.

        Souls that had not ended run again from their first lines.

        :raises MasterUnreachableError: if the master does not answer, and the node runs on
        """
        with self._life:
            self._master.call('getPid')
            souls = {soul: block for soul, block in self._souls.items() if soul.is_alive()}
            nodes.append(self)  # stop() removes one; spin() must not find none
            try:
                self.stop()
                self._begin()
            finally:
                nodes.remove(self)
            if not self._opens_channels():
                for soul, block in souls.items():
                    Node.fork(self, block, soul.name)

    def become(self, node_class: type[Node]) -> None:
        """Be a node of another class from now on; name, ports, connections and attributes stay.

        It happens between two delegates. Blocks that are methods of the node are looked up anew.
        Neither ``__init__`` nor ``start`` of the new class runs.

        :raises TypeError: if it is not a subclass of Node
        :raises AttributeError: if it lacks a method that is a block of the node
        """
        check_class(node_class)
        self._check_running()

        def change():
            receivers = self, *self._opened
            soul = rebound(self.soul, self, node_class)
            blocks = [rebound(each.delegate, self, node_class) for each in receivers]
            self.__class__, self.soul = node_class, soul
            for receiver, block in zip(receivers, blocks):
                receiver.delegate = block

        self._run.turns.call(change)

    def _abandon(self):
        """Be stopped in a forked child: the node runs in the parent."""
        self._lifecycle = Lifecycle.STOPPED
        for each in self._opened:
            each.closed = True

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.stop()

    def _check_running(self):
        """Raise NodeStoppedError if the node has not started, or has stopped."""
        if self._lifecycle not in (Lifecycle.RUNNING, Lifecycle.STOPPING):
            raise NodeStoppedError(
                f'{self._name} is {self._lifecycle.value}: start() it, by super() in a class of your own'
            )

    @property
    def is_running(self) -> bool:
        """True if the node is started and no stop has begun."""
        return self._lifecycle is Lifecycle.RUNNING

    @property
    def lifecycle(self) -> Lifecycle:
        """Its state."""
        return self._lifecycle

    @property
    def channels(self) -> list[Channel]:
        """The channels that are open."""
        return [each for each in self._opened if isinstance(each, Channel) and not each.closed]

    @property
    def ros(self):
        """The node's own rospy in this run, whole: ``node.ros.Timer``, ``node.ros.Time.now()``."""
        self._check_running()
        return self._run.ros

    def ros_import(self, name: str):
        """Return a library written on rospy, such as 'actionlib', bound to this run of the node."""
        self._check_running()
        return self._run.modules.load(name)

    def health(self) -> types.SimpleNamespace:
        """Return how the node is doing; asks the master.

        :returns: an object with ``registered`` (True if the master has the node, None if it does not
            answer), ``kind`` (its class), ``connections`` ({transport: how many}), ``dropped`` (how
            many messages), ``errors`` (how often blocks failed), ``threads``, ``souls`` (how many
            run in threads), ``ended_souls`` (their names)
        """
        registered = None
        with suppress(MasterUnreachableError):
            registered = self._master.call('lookupNode', self._name) == self._run.uri
        return types.SimpleNamespace(registered=registered, **self._told())

    def _told(self):
        """Return what :meth:`health` knows without the master; top asks for it by XML-RPC."""
        from pharos.live.snapshot import health_facts

        return health_facts(self)

    def describe(self, seconds: float = 1.0) -> str:
        """Return as text what it publishes, receives and offers, its peers, and how often."""
        from pharos.live.text_format import describe

        return describe(self._master, self._name, seconds)

    def __repr__(self):
        return f'<{type(self).__name__} {self._name} {self._lifecycle.value}>'

    def execute(self):
        """Run the soul once, in this thread, and return its value (``node execute`` in the report)."""
        return self._run_soul(self._soul_or(None))

    def fork(self, block: Block | None = None, name: str | None = None) -> threading.Thread:
        """Run the soul, or ``block(node)``, in a thread of its own, and return the thread.

        The report (listing 3.8): ``[node execute] fork``. :meth:`stop` ends it at its next
        :meth:`sleep` or turn of :meth:`every`.
        """
        runs = self._soul_or(block)
        soul = self._run.Thread(target=self._run_soul, args=[runs], name=name or name_of(runs))
        self._souls[soul] = block
        soul.start()
        return soul

    def _soul_or(self, block):
        self._check_running()
        block = block or self.soul
        if taking(block, 'soul', 0, 1) is None:
            raise PharosError(f'{self._name} has no soul to run: give it one, node.soul = block')
        return block

    def _run_soul(self, block):
        before, here.node, is_own = here.node, self, block is self.soul
        try:
            return taking(block, 'soul', 0, 1)(self)
        except BaseException as error:
            is_by_stop = self._run.stopping.is_set() and isinstance(error, rospy.ROSException)
            if not is_by_stop:
                self._report(
                    error,
                    block,
                    'soul',
                    again=lambda _: self._run_soul(self.soul if is_own else block),
                )
        finally:
            here.node = before
        return None

    def sleep(self, seconds: float) -> None:
        """Sleep for some seconds of ROS time; the stop of the node ends it, and its soul."""
        with quiet_wait():
            self._check_running()
            self._run.turns.pause()  # a start() that waits lets delegates run
            self._run.ros.sleep(seconds)
        if self._run.stopping.is_set() and here.node is self:
            raise NodeStoppedError(f'{self._name} stops, and this soul with it')

    def every(self, seconds: float) -> Iterator[int]:
        """Return an iterator that turns every so many seconds of ROS time, until the node stops.

        It counts its turns. A turn that takes longer delays the next.

        :raises ValueError: if ``seconds`` is not above 0
        """
        if not seconds > 0:
            raise ValueError(f'a period is a number of seconds above 0, not {seconds!r}')
        self._check_running()
        run = self._run
        rate = run.ros.Rate(1 / seconds, reset=True)

        def turns():
            turn = 0
            while not run.stopping.is_set():
                yield turn
                turn += 1
                run.turns.pause()  # a start() that waits lets delegates run
                with quiet_wait():
                    rate.sleep()

        return turns()

    # -- failures

    @property
    def errors(self) -> list[BaseException]:
        """The exceptions of blocks in this run of the node, the newest last; 100 kinds at most."""
        return [failure.error for failure in self._failures]

    def _report(self, error, block, what, message=None, channel=None, again=None):
        """Keep what a block raised, and tell it at the 1st, 10th, 100th time; Ctrl-C goes on."""
        if isinstance(error, (KeyboardInterrupt, SystemExit)) and is_signalled():
            raise error
        failure = self._keep_failure(error, block, message, channel, again)
        if str(failure.count).strip('0') != '1':
            return
        with suppress(Exception):  # neither log nor Transcript can be written
            line = f'{what} {name_of(block)} of {self._name}'
            line += f' on {channel.topic}' if channel else ''
            line += f' raised {type(error).__name__}: {error}'
            line += f' ({failure.count} times)' if failure.count > 1 else ''
            try:
                Node.log(self, f'{line}\n{failure.traceback}', 'error')
            finally:
                Transcript.show(line)

    def _keep_failure(self, error, block, message=None, channel=None, again=None):
        """Keep what a block raised, without telling it, and return the Failure."""
        failure = Failure(error, block, message, channel, again)
        self._failures.keep(failure)
        return failure

    def _refused(self, topic, reason):
        """Take note that a publisher sends another type."""
        error = MessageTypeError(f'{self._name} does not receive from {topic}: {reason}')
        self._report(error, topic, 'connection')

    def log(self, text, level: str = 'info') -> None:
        """Log a line to the screen, the log file and /rosout.

        :param level: 'debug', 'info', 'warning' (or 'warn'), 'error' or 'fatal'
        """
        if level not in ('debug', 'info', 'warn', 'warning', 'error', 'fatal'):
            raise ValueError(f'unknown level {level!r}: give info or error, and one text')
        if self._lifecycle not in (Lifecycle.RUNNING, Lifecycle.STOPPING):
            return Transcript.show(f'[{level.upper()}] {self._name}: {text}')
        # no wrapper between: rospy looks for the caller of this method
        self._run.core._base_logger('%s', (text,), {}, level=level)

    # -- topics

    def _resolve(self, name: str) -> str:
        """Return the full name of a topic, service or parameter, remapped as the node's are.

        :raises ValueError: if it cannot be a name
        """
        self._check_running()
        return self._run.ros.resolve_name(legal_name(name).replace('~/', '~'))

    def _peer_name(self, peer):
        """Return the full name of a Node, an ExternalNode, or a node given by its name."""
        if isinstance(peer, Node):
            return peer._name
        if isinstance(peer, ExternalNode):
            return peer.name
        return rosgraph.names.resolve_name(node_name(peer), self._name)

    def interested_in(
        self,
        topic: str,
        typed_as: str | type | None = None,
        delegate: Block | None = None,
        queue_size: int = QUEUE_SIZE,
        inline: bool = False,
        shared: bool = False,
        from_=None,
    ) -> InputChannel:
        """Receive the messages of a topic from now on.

        The report: ``self interestedIn: '/pose' typedAs: 'turtlesim/Pose'``.

        :param typed_as: type name or message class; default: what the node or the master knows
        :param delegate: for this channel only; default: :attr:`delegate`
        :param queue_size: messages that wait at most; the oldest are dropped, and counted
        :param inline: the delegate runs in the thread of a publisher of this process
        :param shared: hand out the published object, which nobody may change
        :param from_: receive from that node alone: its name, Node or ExternalNode
        :raises UnknownTopicError, UnknownTypeError: if the type is not known
        :raises MasterUnreachableError: if the master does not answer; nothing is left behind
        """
        topic = self._resolve(topic)
        peer = from_ and self._peer_name(from_)
        cls = self._class_of(topic, typed_as, is_receiver=True)
        return InputChannel(self, topic, cls, delegate, queue_size, inline, shared, peer)

    def output_channel(
        self,
        topic: str,
        typed_as: str | type | None = None,
        latch: bool = False,
        queue_size: int = QUEUE_SIZE,
    ) -> OutputChannel:
        """Open a channel to send to a topic; returns when the known subscribers are connected.

        :param latch: the last message goes to subscribers that come later, too
        :param queue_size: messages that wait for each subscriber at most
        """
        topic = self._resolve(topic)
        return OutputChannel(self, topic, self._class_of(topic, typed_as), latch, queue_size)

    def send_to(
        self,
        topic: str,
        block=None,
        fill: Block | None = None,
        *,
        typed_as: str | type | None = None,
        to=None,
        **fields,
    ) -> Message:
        """Send a message, and return it.

        The report: ``self sendTo: '/cmd_vel' a: [:msg | msg linear: 2.0]``::

            node.send_to('/cmd_vel', typed_as='turtlesim/Velocity', linear=2.0)
            node.send_to('/cmd_vel', Velocity, linear=2.0)
            node.send_to('/cmd_vel', lambda msg: setattr(msg, 'linear', 2.0))

        :param block: ``block(message)`` fills a new message; or a ready message, a dict of fields,
            or a message class, which is the type
        :param typed_as: the type; default: what the node or the master knows of the topic
        :param to: the node that alone gets it: a name, Node or ExternalNode
        :param fields: fill the message by name
        """
        if isinstance(block, type) and issubclass(block, Message):
            typed_as, block = block, fill
        channel = self._senders.get((topic, typed_as))
        if channel and not channel.closed:
            return channel.send(block, to=to, **fields)
        name = self._resolve(topic)
        given = type(block) if isinstance(block, Message) else None
        with self._opening:  # two threads that send first open one channel
            cls = self._class_of(name, typed_as or given)
            known = self._open_on(name, OutputChannel)
            channel = known[0] if known else OutputChannel(self, name, cls)
            self._senders[topic, typed_as] = channel
        try:
            return channel.send(block, to=to, **fields)
        except Exception:
            if not known:
                channel.close()
            raise

    def _open_on(self, topic, kind=Channel):
        return [
            each
            for each in self._opened
            if isinstance(each, kind) and each.topic == topic and not each.closed
        ]

    def _class_of(self, topic, typed_as, is_receiver=False):
        known = [each.message_class for each in self._open_on(topic)]
        if typed_as is None and known:
            return known[0]
        type_ = typed_as or self._master.topic_type(topic)
        if type_ in (None, '*'):
            raise UnknownTopicError(
                f'the master knows no type of {topic}: give typed_as=, such as "std_msgs/String"'
            )
        ask = functools.partial(self._definition_of_publisher, topic) if is_receiver else None
        cls = messages.message_class(type_, ask)
        if known and known[0]._md5sum != cls._md5sum:
            raise MessageTypeError(
                f'{self._name} has {topic} open as {known[0]._type}, not as {cls._type}'
            )
        return cls

    def _definition_of_publisher(self, topic, type_):
        """Return the definition that a publisher sends when it is connected."""
        if not self._master.topic(topic).publishers:
            return None

        def find(end):
            headers = [each.header or {} for each in end.impl.connections]
            return [each['message_definition'] for each in headers if each.get('type') == type_]

        return (
            self._subscribed(find, self.connect_timeout, topic, self._run.ros.AnyMsg) or [None]
        )[0]

    def _subscribed(self, find, timeout, *options):
        """Wait until ``find(subscriber)`` is true of a subscriber of rospy, and return what it is."""
        # not through a channel: a delegate may call this, whose turn it is
        end = self._run.ros.Subscriber(*options)
        try:
            return wait(lambda: find(end), timeout, self)
        finally:
            end.unregister()

    def wait_for_message(
        self,
        topic: str,
        typed_as: str | type | None = None,
        timeout: float | None = None,
        where: Block | None = None,
    ) -> Message:
        """Return the next message of a topic.

        :param timeout: seconds until its type is known, and as long for the message; None: without
            limit, for a topic of a known type
        :param where: skip messages unless ``where(message)`` is true
        :raises UnknownTopicError, TimeoutError: if none comes in time
        :raises NodeStoppedError: if the node stops meanwhile
        """
        came, topic = [], self._resolve(topic)

        def find(end):
            while came and where and not where(came[0]):
                del came[0]
            return came

        self._master.call('getPid')  # raises if it does not answer
        if timeout and not typed_as:
            typed_as = wait(lambda: self._master.topic_type(topic), timeout, self)
        cls = self._class_of(topic, typed_as, True)
        if self._subscribed(find, timeout, topic, cls, came.append):
            return came[0]
        if not self._run.stopping.is_set():
            raise TimeoutError(f'no message on {topic} came within {timeout:g} s: is it published?')
        raise NodeStoppedError(f'{self._name} stopped while it waited for {topic}')

    # -- services and parameters

    def serve(self, name: str, typed_as: str | type, block: Block) -> OfferedService:
        """Offer a service; returns a handle with ``close()``.

        ``block(request)`` runs in a thread of the caller's connection. It returns a response, a
        dict, tuple or list of its fields, or its only field; None for an empty response.
        """
        return OfferedService(self, self._resolve(name), messages.service_class(typed_as), block)

    def lookup_service(self, name: str) -> Service:
        """Return the service of that name, resolved as the node's names are."""
        return self._master.lookup_service(self._resolve(name), self._name)

    def wait_for_service(self, name: str, timeout: float | None = None) -> Service:
        """Wait until a service of that name is offered, and return it."""
        return wait_for(lambda: self.lookup_service(name), timeout, self)

    def parameter(self, name: str, initialized=None) -> Parameter:
        """Return a parameter of the server, bound both ways; '~rate' is private.

        :param initialized: the value that it gets if it has none
        """
        name = self._resolve(name)
        known = [each for each in self._parameters if each.name == name]
        return known[0] if known else Parameter(self, name, initialized)

    @property
    def _parameters(self) -> list[Parameter]:
        """The parameters that :meth:`parameter` has returned."""
        return [each for each in self._opened if isinstance(each, Parameter)]

    def _read_parameters(self):
        """Have the parameters read their values."""
        for each in self._parameters:
            each.read()


def check_class(node_class):
    """Raise TypeError unless it is a class of nodes."""
    if not (isinstance(node_class, type) and issubclass(node_class, Node)):
        raise TypeError(f'a node is made of a subclass of Node, not {node_class!r}')
    inside = {*vars(Node), *Node.__annotations__, '_name', '_opened', '_souls', '_life', '_end'}
    for cls in node_class.__mro__[: node_class.__mro__.index(Node)]:
        taken = [name for name in vars(cls) if name in inside and re.match('_[a-z]', name)]
        if taken and not cls.__module__.startswith('pharos.'):
            raise TypeError(
                f'{cls.__name__} has {", ".join(taken)}, as Node has: choose another name'
            )


class BlockNode(Node):
    """A node made of blocks alone, for tests and prototypes: PhaROSBlockNode in the report."""
