"""Nodes: real ROS nodes of this process, written with blocks."""
from __future__ import annotations

import collections
import contextlib
import enum
import re
import sys
import threading
from typing import TYPE_CHECKING, Any, Callable, Iterator, NamedTuple

import genpy
import rosgraph.names
import rospy

from pharos import messages, program
from pharos.blocks import Block, name_of, rebound, taking
from pharos.channels import QUEUE_SIZE, Channel, InputChannel, OutputChannel
from pharos.errors import (
    MasterUnreachableError,
    MessageTypeError,
    NodeStoppedError,
    PharosError,
    UnknownTopicError,
    UnknownTypeError,
)
from pharos.failures import FailureList, Failures
from pharos.parameter import Parameter
from pharos.private_rospy.run import Run, join
from pharos.service import OfferedService, Service
from pharos.transcript import Transcript

if TYPE_CHECKING:
    from pharos.master import Master

_LEVELS = {level: level for level in ('debug', 'info', 'warning', 'error', 'critical')}
_LEVELS.update(warn='warning', err='error', fatal='critical')
LOOPBACK = re.compile(r'localhost|127(\.\d{1,3}){3}|::1')


class Lifecycle(enum.Enum):
    """The states of a node; see :attr:`Node.lifecycle`."""

    NEW = 'new'
    STARTING = 'starting'
    RUNNING = 'running'
    STOPPING = 'stopping'
    STOPPED = 'stopped'


class Health(NamedTuple):
    """How a node is doing; see :meth:`Node.health`."""

    #: True if the master has it at its URI; None if the master does not answer
    registered: bool | None
    connections: dict[str, int]  #: transport -> how many
    dropped: int  #: messages that its channels dropped
    errors: int  #: how often its blocks failed
    threads: int  #: of the node
    souls: int  #: that run in threads of their own
    ended_souls: list[str]  #: names of those that were forked and have ended

    def __str__(self) -> str:
        words = {True: ['registered'], False: ['not registered'], None: ['master away']}
        parts = words[self.registered] + [f'{n} {kind}' for kind, n in self.connections.items()]
        parts += [f'{self.dropped} dropped', f'{self.errors} errors', f'{self.threads} threads']
        ended = f', ended: {", ".join(self.ended_souls)}' if self.ended_souls else ''
        return ', '.join([*parts, f'{self.souls} souls{ended}'])


class Node:
    """A ROS node of this process, made by :meth:`Master.create`.

    The report: a subclass of PhaROSNode. A class of your own overrides :meth:`start` and
    :meth:`stop`, and calls ``super()``::

        class Driver(Node):
            def start(self):
                super().start()
                self.interested_in('/pose', 'turtlesim/Pose', delegate=self.on_pose)

            def on_pose(self, pose):
                self.send_to('/cmd_vel', typed_as='turtlesim/Velocity', linear=1.0)

    All methods may be called from any thread. A node's delegates run one at a time.
    """

    #: seconds that a start waits for the master, and a topic's first message for subscribers
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
    run: Run

    def __init__(self) -> None:
        """Take nothing; a class of your own may take what :meth:`Master.create` passes on."""

    def _configure(self, master, name, soul, delegate, domain, ports, remappings):
        self.master, self._name, self._settings = master, name, (domain, remappings)
        self._ports, self.lifecycle = ports, Lifecycle.NEW
        self.soul, self.delegate = soul, delegate
        self.failed = Failures(self._tell_failure)
        self._life = threading.RLock()  # held by a start, stop or restart
        self._opening = threading.RLock()  # of two threads that send first, one opens the channel
        self._opened: list[Any] = []  # channels, services and parameters, also while it is stopped
        self._senders: dict[str, OutputChannel] = {}  # topic as given to send_to -> its channel
        self._souls: dict[threading.Thread, tuple[Block | None, str]] = {}

    # -- life

    def start(self) -> None:
        """Register with the master.

        A stopped node starts again, under the same name and ports. Its channels, services and
        parameters come back, unless its class has a start() of its own, which opens them.

        :raises PharosError: if the node runs already
        :raises MasterUnreachableError, NodeNameInUseError, PortInUseError: and nothing is left
        """
        with self._life:
            if self.lifecycle not in (Lifecycle.NEW, Lifecycle.STOPPED):
                raise PharosError(f'{self.name} is {self.lifecycle.value} already')
            before, self.lifecycle = self.lifecycle, Lifecycle.STARTING
            domain, remappings = self._settings
            try:
                run = Run(
                    *(self.name, self.master.url, domain, self._ports, remappings),
                    *(self.client_timeout, self.master.share_connections),
                    on_shutdown=self._shut_down,
                    on_parameter=self.parameter_changed,
                    on_forgotten=self._put_back_parameters,
                    on_refused=self._refused,
                    allows_shutdown=lambda: self.allow_remote_shutdown,
                )
                run.start(max(self.connect_timeout, 1.0))
            except BaseException:
                self.lifecycle = before
                raise
            self.run, self.lifecycle = run, Lifecycle.RUNNING
            self._ports = self.tcp_port, self.xmlrpc_port
            self.failed, self._souls = Failures(self._tell_failure), {}
            program.nodes.append(self)
            opened, self._opened = self._opened, []
            if self._starts_itself:
                return
            self._opened = opened
            try:
                for each in opened:
                    each.open()
            except BaseException:
                self.stop()
                self._opened = opened
                raise

    @property
    def _starts_itself(self) -> bool:
        return type(self).start is not Node.start

    def stop(self) -> None:
        """End the souls, send what is under way, unregister, free ports and threads.

        Does nothing if the node is stopped. Waits up to :attr:`stop_timeout` for souls, and as long
        for messages under way; what goes on then is left behind, and named in the log.
        """
        if self.lifecycle is Lifecycle.STOPPING and self._is_own_thread():
            return
        with self._life:
            if self.lifecycle is not Lifecycle.RUNNING:
                return
            self.lifecycle = Lifecycle.STOPPING
            self.run.stopping.set()
            souls = join(self._souls, self.stop_timeout)
            if souls:
                names = ', '.join(thread.name for thread in souls)
                self.log(f'left behind, since they did not end in time: {names}', 'warning')
            left = self.run.stop(self.stop_timeout, souls)
            self._senders = {}
            for each in self._opened:
                each.node_stopped()
            self.lifecycle = Lifecycle.STOPPED
            if self in program.nodes:
                program.nodes.remove(self)
        if left:
            print(f'{self.name} has stopped and left behind: {", ".join(left)}', file=sys.stderr)

    def _is_own_thread(self) -> bool:
        return (
            threading.current_thread() in self.run.threads
            or self.run.turns.runner == threading.get_ident()
        )

    def end_now(self) -> None:
        """Stop the node, whatever the stop() of its class raises; two threads may ask for it."""
        if self.lifecycle is Lifecycle.STOPPING and self._is_own_thread():
            return
        with self._life:
            try:
                if self.is_running:
                    self.stop()
            except Exception as error:
                self.report(error, self.stop, 'method')
            finally:
                Node.stop(self)

    def _shut_down(self, reason: str) -> None:
        threading.Thread(target=self.end_now, name=f'stop {self.name}', daemon=True).start()

    def restart(self) -> None:
        """Stop the node and start it again, under its name and ports, with its channels and souls.

        Souls that were forked and had not ended run again from their first lines.

        :raises MasterUnreachableError: if the master does not answer, and the node runs on
        """
        with self._life:
            self.master.call('getPid')
            souls = [about for soul, about in self._souls.items() if soul.is_alive()]
            program.restarting.append(self)
            try:
                self.stop()
                self.start()
            finally:
                program.restarting.remove(self)
            for block, name in () if self._starts_itself else souls:
                self.fork(block, name)

    def become(self, node_class: type[Node]) -> None:
        """Be a node of another class from now on; name, ports, connections and attributes stay.

        It happens between two delegates. Blocks that are methods of the node are looked up anew.
        Neither ``__init__`` nor ``start`` of the new class runs.

        :raises TypeError: if it is no subclass of Node
        """
        if not (isinstance(node_class, type) and issubclass(node_class, Node)):
            raise TypeError(f'{self.name} can become a subclass of Node, not {node_class!r}')
        self.check_running()
        self.run.turns.call(lambda: self._become(node_class))

    def _become(self, node_class: type[Node]) -> None:
        before, self.__class__ = self.__class__, node_class
        try:
            blocks = rebound(self.soul, self), rebound(self.delegate, self)
            for each in self._opened:
                each.rebind()
        except AttributeError as error:
            self.__class__ = before
            raise PharosError(f'{node_class.__name__} lacks a method in use: {error}') from error
        self.soul, self.delegate = blocks

    def abandon(self) -> None:
        """Be stopped in a forked child: the node runs in the parent."""
        self.lifecycle, self._life = Lifecycle.STOPPED, threading.RLock()
        for each in self._opened:
            each.closed = True

    def __enter__(self):
        return self

    def __exit__(self, *error: Any) -> None:
        self.stop()

    def check_running(self) -> None:
        """Raise NodeStoppedError if the node has not started, or has stopped."""
        if self.lifecycle in (Lifecycle.RUNNING, Lifecycle.STOPPING):
            return
        state = self.lifecycle.value
        raise NodeStoppedError(
            f'{self.name} is {state}: start() it, by super() in a class of your own'
        )

    def remember(self, opened: Any) -> None:
        """Have a channel, service or parameter come back at the next start."""
        if opened not in self._opened:
            self._opened = [*self._opened, opened]

    def forget(self, opened: Any) -> None:
        """It was closed for good."""
        self._opened = [each for each in self._opened if each is not opened]
        self._senders = {}

    # -- properties

    @property
    def name(self) -> str:
        """The full name, as the master knows it: '/robot1/driver'."""
        return self._name

    @property
    def is_running(self) -> bool:
        """True if the node is started and no stop has begun."""
        return self.lifecycle is Lifecycle.RUNNING

    @property
    def uri(self) -> str | None:
        """The URI of the node's XML-RPC server, None before the first start."""
        return self.run.uri if hasattr(self, 'run') else None

    @property
    def domain(self) -> str | None:
        """The address that the node advertises, None before the first start."""
        return self.uri.split('/')[2].rpartition(':')[0] if self.uri else None

    @property
    def tcp_port(self) -> int:
        """The TCPROS port; the one asked for, before the first start."""
        return self.run.tcp_port if hasattr(self, 'run') else self._ports[0]

    @property
    def xmlrpc_port(self) -> int:
        """The XML-RPC port; the one asked for, before the first start."""
        return int(self.uri.rstrip('/').rpartition(':')[2]) if self.uri else self._ports[1]

    @property
    def channels(self) -> list[Channel]:
        """The channels that are open."""
        return [each for each in self._opened if isinstance(each, Channel) and each.is_open]

    @property
    def ros(self) -> Any:
        """The node's own rospy, whole: ``node.ros.Timer``, ``node.ros.Time.now()``.

        It belongs to this run of the node.
        """
        self.check_running()
        return self.run.ros

    def ros_import(self, name: str) -> Any:
        """Return a library written on rospy, such as 'actionlib', bound to this run of the node."""
        self.check_running()
        return self.run.modules.load(name)

    def health(self) -> Health:
        """Return how the node is doing; asks the master."""
        impls = [*self.run.topics.pubs.values(), *self.run.topics.subs.values()]
        kinds = (each.transport_type for impl in impls for each in impl.connections)
        souls = {soul: name for soul, (_, name) in self._souls.items()}
        try:
            registered = self.master.call('lookupNode', self.name) == self.uri
        except MasterUnreachableError:
            registered = None
        return Health(
            registered,
            dict(collections.Counter(kinds)),
            sum(getattr(channel, 'dropped', 0) for channel in self.channels),
            self.failed.total,
            sum(thread.is_alive() for thread in list(self.run.threads)),
            sum(soul.is_alive() for soul in souls),
            [name for soul, name in souls.items() if not soul.is_alive()],
        )

    def __repr__(self) -> str:
        return f'<{type(self).__name__} {self.name} {self.lifecycle.value}>'

    # -- souls

    @property
    def soul(self) -> Block | None:
        """The block that says what the node does, called as ``soul(node)``."""
        return self._soul

    @soul.setter
    def soul(self, block: Block | None) -> None:
        taking(block, 'soul', 1, 0)
        self._soul = block

    @property
    def delegate(self) -> Block | None:
        """The block run for each message, as ``block(message, channel)`` or ``block(message)``.

        The report: ``self receiverDelegate: [:message :channel | ...]``.
        """
        return self._delegate

    @delegate.setter
    def delegate(self, block: Block | None) -> None:
        self._delegate_runs = taking(block, 'delegate', 2, 1)
        self._delegate = block

    def execute(self) -> Any:
        """Run the soul once, in the calling thread, and return its value.

        The report (listing 3.7): ``node execute``. What the soul raises goes to :attr:`failures`.
        """
        self.check_running()
        if self.soul is None:
            raise PharosError(f'{self.name} has no soul to run: give it one, node.soul = block')
        return self._run_soul(self.soul)

    def fork(self, block: Block | None = None, name: str | None = None) -> threading.Thread:
        """Run the soul, or ``block(node)``, in a thread of its own, and return the thread.

        The report (listing 3.8): ``[node execute] fork``. :meth:`stop` ends it at its next
        :meth:`sleep` or turn of :meth:`every`.
        """
        self.check_running()
        if taking(block or self.soul, 'soul', 1, 0) is None:
            raise PharosError(f'{self.name} has no soul to run: give it one, node.soul = block')
        name = name or name_of(block or self.soul)
        soul = self.run.Thread(target=lambda: self._run_soul(block or self.soul), name=name)
        self._souls[soul] = block, name
        soul.start()
        return soul

    def _run_soul(self, block: Any) -> Any:
        try:
            with program.on_behalf_of(self):
                return taking(block, 'soul', 1, 0)(self)
        except BaseException as error:
            stopped = isinstance(error, (NodeStoppedError, rospy.ROSInterruptException))
            if not (stopped and not self.is_running):
                self.report(error, block, 'soul', again=lambda nothing: self._run_soul(self.soul))
        return None

    def sleep(self, seconds: float) -> None:
        """Sleep for some seconds of ROS time; the stop of the node ends it, and its soul.

        The report: ``(Delay forSeconds: 1) wait``.
        """
        self.check_running()
        run = self.run
        with program.quiet_wait(), contextlib.suppress(rospy.ROSInterruptException):
            run.ros.sleep(seconds)
        if run.stopping.is_set() and getattr(program._here, 'node', None) is self:
            raise NodeStoppedError(f'{self.name} stops, and this soul with it')

    def every(self, seconds: float) -> Iterator[int]:
        """Return an iterator that turns every so many seconds of ROS time, until the node stops.

        It counts its turns. A turn that takes longer delays the next.

        :raises ValueError: if ``seconds`` is not above 0
        """
        if not seconds > 0:
            raise ValueError(f'a period is a number of seconds above 0, not {seconds!r}')
        self.check_running()
        return self._turns(self.run.ros.Rate(1 / seconds, reset=True))

    def _turns(self, rate: Any) -> Iterator[int]:
        run, turn = self.run, 0
        while not run.stopping.is_set():
            yield turn
            turn += 1
            with program.quiet_wait(), contextlib.suppress(rospy.ROSInterruptException):
                rate.sleep()

    # -- failures

    @property
    def errors(self) -> list[BaseException]:
        """What blocks raised in this run of the node, the newest last; 100 kinds at most."""
        return [failure.error for failure in self.failed.all()]

    @property
    def failures(self) -> FailureList:
        """For each of :attr:`errors` a :class:`Failure`: what failed, on what, how often."""
        return self.failed.all()

    def report(self, error, block, what: str, message=None, channel=None, again=None) -> None:
        """Keep and tell what a block raised. Ctrl-C in the main thread goes on.

        :param what: 'soul', 'delegate' and so on
        """
        if isinstance(error, (KeyboardInterrupt, SystemExit)) and program.is_signalled():
            raise error
        where = f'{what} {name_of(block)} of {self.name}'
        where += f' on {channel.topic}' if channel else ''
        self.failed.report(error, block, where, message, channel, again)

    def _tell_failure(self, line: str, details: str) -> None:
        try:
            self.log(f'{line}\n{details}', 'error')
        finally:
            Transcript.show(line)

    def _refused(self, topic: str, reason: str) -> None:
        error = MessageTypeError(f'{self.name} does not receive from {topic}: {reason}')
        self.report(error, topic, 'connection')

    def log(self, text: Any, level: str = 'info') -> None:
        """Log a line to the screen, the log file and /rosout.

        :param level: 'debug', 'info', 'warning' (or 'warn'), 'error' or 'fatal'
        """
        if level not in _LEVELS:
            raise ValueError(f'there is no log level {level!r}: give one of {", ".join(_LEVELS)}')
        if self.lifecycle not in (Lifecycle.RUNNING, Lifecycle.STOPPING):
            return Transcript.show(f'[{level.upper()}] {self.name}: {text}')
        # no wrapper between: rospy looks for the caller of this method
        self.run.core._base_logger('%s', (text,), {}, level=_LEVELS[level])

    # -- topics

    def resolve(self, name: str) -> str:
        """Return the full name of a topic, service or parameter, remapped as the node's are.

        :raises ValueError: if it cannot be a name
        """
        self.check_running()
        is_text = isinstance(name, str) and name.isascii() and name
        if not is_text or not rosgraph.names.is_legal_name(name):
            raise ValueError(
                f'{name!r} cannot be a name of ROS: give one such as /robot1/pose or ~pose'
            )
        return self.run.ros.resolve_name('~' + name[2:] if name.startswith('~/') else name)

    def peer_name(self, peer: Any) -> str:
        """Return the full name of a Node, an ExternalNode, or a node given by its name.

        :raises UnknownNodeError: if the master knows none of this name
        """
        name = getattr(peer, 'name', None)
        if name is None:
            name = rosgraph.names.resolve_name(self.master.node_name(peer), self.name)
        return name

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

        :param typed_as: type name or message class; default: what the node or the master knows
        :param delegate: for this channel only; default: :attr:`delegate`
        :param queue_size: messages that wait at most; the oldest are dropped, and counted
        :param inline: the delegate runs in the thread of a publisher of this process
        :param shared: hand out the published object, which nobody may change
        :param from_: receive from that node alone: its name, Node or ExternalNode
        :raises UnknownTopicError, UnknownTypeError: if the type is not known
        :raises MasterUnreachableError: if the master does not answer; nothing is left behind
        """
        topic = self.resolve(topic)
        peer = None if from_ is None else self.peer_name(from_)
        self.master.call('getPid')
        cls = self._class_of(topic, typed_as, from_publisher=True)
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
        topic = self.resolve(topic)
        return OutputChannel(self, topic, self._class_of(topic, typed_as), latch, queue_size)

    def send_to(
        self,
        topic: str,
        block: Any = None,
        fill: Block | None = None,
        *,
        typed_as: str | type | None = None,
        to: Any = None,
        **fields: Any,
    ) -> genpy.Message:
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
        if isinstance(block, type) and issubclass(block, genpy.Message):
            typed_as, block = block, fill
        channel = self._senders.get(topic)
        if channel is None or channel.closed:
            channel = self._open_sender(topic, block, typed_as, fields)
        elif typed_as is not None and messages.message_class(typed_as) is not channel.message_class:
            channel._check_type(messages.message_class(typed_as))
        return channel.send(block, to=to, **fields)

    def _open_sender(self, given: str, block: Any, typed_as: Any, fields: dict) -> OutputChannel:
        topic = self.resolve(given)
        with self._opening:
            for channel in self.channels:
                if channel.topic == topic and isinstance(channel, OutputChannel):
                    break
            else:
                if typed_as is None and isinstance(block, genpy.Message):
                    typed_as = type(block)
                cls = self._class_of(topic, typed_as)
                messages.build(cls, None if callable(block) else block, fields)  # before all else
                channel = OutputChannel(self, topic, cls, False, QUEUE_SIZE)
            self._senders[given] = channel
        return channel

    def _class_of(self, topic: str, typed_as: Any, from_publisher: bool = False) -> type:
        known = [each.message_class for each in self.channels if each.topic == topic]
        if typed_as is None and known:
            return known[0]
        cls = self._find_class(topic, typed_as, from_publisher)
        if known and known[0]._md5sum != cls._md5sum:
            raise MessageTypeError(
                f'{self.name} has {topic} open as {known[0]._type}, not as {cls._type}'
            )
        return cls

    def _find_class(self, topic: str, typed_as: Any, from_publisher: bool) -> type:
        type_ = typed_as or self.master.topic_type(topic)
        if type_ in (None, '*'):
            raise UnknownTopicError(
                f'the master knows no type of {topic}: give typed_as=, such as "std_msgs/String"'
            )
        try:
            return messages.message_class(type_)
        except UnknownTypeError:
            cls = self._class_from_publisher(topic, type_) if from_publisher else None
            if cls is None:
                raise
            return cls

    def _class_from_publisher(self, topic: str, type_: str) -> type | None:
        """Return the class for the definition that a publisher sends when it is connected."""
        end = self.run.ros.Subscriber(topic, self.run.ros.AnyMsg)

        def definition():
            headers = [
                each.header for each in end.impl.connections if getattr(each, 'header', None)
            ]
            return [h['message_definition'] for h in headers if h.get('type') == type_]

        try:
            found = program.wait(definition, self.connect_timeout, self)
        finally:
            end.unregister()
        return messages.class_from_definition(type_, found[0]) if found else None

    def wait_for_message(
        self,
        topic: str,
        typed_as: str | type | None = None,
        timeout: float | None = None,
        where: Callable[[Any], Any] | None = None,
    ) -> genpy.Message:
        """Return the next message of a topic, for which ``where(message)`` is true.

        :param timeout: seconds, None: without limit
        :raises TimeoutError: if none comes in time
        :raises NodeStoppedError: if the node stops meanwhile
        """
        found: list[Any] = []

        def take(message):
            try:
                if where is None or where(message):
                    found.append(message)
            except Exception as error:
                found.append(error)

        topic = self.resolve(topic)
        self.master.call('getPid')
        # not through a channel: this may be called by a delegate, whose turn it is
        end = self.run.ros.Subscriber(topic, self._class_of(topic, typed_as, True), take)
        try:
            program.wait(lambda: found, timeout, self)
        finally:
            end.unregister()
        if not found:
            if not self.is_running:
                raise NodeStoppedError(f'{self.name} stopped while it waited for {topic}')
            raise TimeoutError(f'no message on {topic} came within {timeout:g} s: is it published?')
        if isinstance(found[0], Exception):
            raise found[0]
        return found[0]

    # -- services and parameters

    def serve(self, name: str, typed_as: str | type, block: Block) -> OfferedService:
        """Offer a service; returns a handle with ``close()``.

        ``block(request)`` runs in a thread of the caller's connection. It returns a response, a
        dict, tuple or list of its fields, or its only field; None for an empty response.
        """
        return OfferedService(self, self.resolve(name), messages.service_class(typed_as), block)

    def lookup_service(self, name: str) -> Service:
        """Return the service of that name, resolved as the node's names are."""
        return self.master.lookup_service(self.resolve(name), self.name)

    def wait_for_service(self, name: str, timeout: float | None = None) -> Service:
        """Wait until a service of that name is offered, and return it."""
        return self.master.wait_for_service(self.resolve(name), timeout, self.name)

    def parameter(self, name: str, initialized: Any = None) -> Parameter:
        """Return a parameter of the server, bound both ways; '~rate' is private.

        :param initialized: the value that it gets if it has none
        """
        name = self.resolve(name)
        for each in self._opened:
            if isinstance(each, Parameter) and each.name == name:
                return each
        return Parameter(self, name, initialized)

    def parameter_changed(self, name: str) -> None:
        """Have the parameters read their values that a change may concern."""
        for each in self._opened:
            if isinstance(each, Parameter) and each.overlaps(name):
                each.read()

    def _put_back_parameters(self) -> None:
        with contextlib.suppress(PharosError, OSError):
            client = self.run.modules.load('rospy.client')
            client._init_node_params(self.run.argv, self.name)
            for each in self._opened:
                if isinstance(each, Parameter):
                    each.open()


class BlockNode(Node):
    """A node made of blocks alone, for tests and prototypes.

    The report (listing 3.7)::

        node := master create: PhaROSBlockNode named: '/myNode' ... soul: [:myNode | ...].
        node = master.create(BlockNode, named='/myNode', soul=lambda me: ...)
    """
