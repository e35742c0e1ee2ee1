"""Nodes: real ROS nodes of this process, written with blocks."""
from __future__ import annotations

import enum
import functools
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

    All methods may be called from any thread. A node's delegates run one at a time.

    :ivar name: the full name, as the master knows it: '/robot1/driver'
    :ivar master: its :class:`Master`
    :ivar soul: the block that says what the node does, called as ``soul(node)``, or None
    :ivar lifecycle: its state, a :class:`Lifecycle`
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

    run_class = Run
    lifecycle = Lifecycle.NEW
    master: Master
    run: Run

    def _configure(self, master, name, soul, delegate, domain, ports, remappings):
        taking(soul, 'soul', 1, 0)
        self.master, self.name, self.uri, self.domain = master, name, None, domain
        self.soul, self.delegate, self.remappings = soul, delegate, remappings
        self.tcp_port, self.xmlrpc_port = ports
        self._life = threading.RLock()  # held by a start, stop or restart
        self.opened = []  # channels, services and parameters, also while it is stopped
        self._senders = {}  # (topic, type) as given to send_to

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
            self.failures, self.souls = Failures(), {}
            self.lifecycle, self.run = Lifecycle.STARTING, self.run_class(self)
            nodes.append(self)
            opened, self.opened = self.opened, []
            try:
                self.run.start()
                self.lifecycle = Lifecycle.RUNNING
                for each in opened if type(self).start is Node.start else ():
                    each.open()
            except BaseException:
                self._end()  # waits for a ScriptNode's thread, which may still register
                self.opened = opened
                raise

    def _end(self):
        self.run.stop(self.stop_timeout)
        for each in self.opened:  # rospy has closed it
            each.closed = True
        self.lifecycle = Lifecycle.STOPPED
        nodes.remove(self)

    def stop(self) -> None:
        """End the souls, send what is under way, unregister, free ports and threads.

        Does nothing if the node is stopped. Waits up to :attr:`stop_timeout` for souls, and as long
        for messages under way; what goes on then is left behind, and named in the log.
        """
        with self._life:
            if self.is_running:
                self.lifecycle = Lifecycle.STOPPING
                self._end()

    def end_now(self):
        """Stop the node, whatever the stop() of its class raises; two threads may ask for it."""
        with self._life:
            try:
                if self.is_running:
                    self.stop()
            except Exception as error:
                self.report(error, self.stop, 'method')
            finally:
                Node.stop(self)

    def restart(self) -> None:
        """Stop the node and start it again, under its name and ports, with its channels and souls.

        Souls that had not ended run again from their first lines.

        :raises MasterUnreachableError: if the master does not answer, and the node runs on
        """
        with self._life:
            self.master.call('getPid')
            souls = {soul: block for soul, block in self.souls.items() if soul.is_alive()}
            nodes.append(self)  # stop() removes one; spin() must not find none
            try:
                self.stop()
                self.start()
            finally:
                nodes.remove(self)
            for soul, block in souls.items() if type(self).start is Node.start else ():
                self.fork(block, soul.name)

    def become(self, node_class: type[Node]) -> None:
        """Be a node of another class from now on; name, ports, connections and attributes stay.

        It happens between two delegates. Blocks that are methods of the node are looked up anew.
        Neither ``__init__`` nor ``start`` of the new class runs.

        :raises TypeError: if it is not a subclass of Node
        :raises AttributeError: if it lacks a method that is a block of the node
        """
        check_class(node_class)
        self.check_running()

        def change():
            receivers = self, *self.opened
            soul = rebound(self.soul, self, node_class)
            blocks = [rebound(each.delegate, self, node_class) for each in receivers]
            self.__class__, self.soul = node_class, soul
            for receiver, block in zip(receivers, blocks):
                receiver.delegate = block

        self.run.turns.call(change)

    def abandon(self):
        """Be stopped in a forked child: the node runs in the parent."""
        self.lifecycle = Lifecycle.STOPPED
        for each in self.opened:
            each.closed = True

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.stop()

    def check_running(self):
        """Raise NodeStoppedError if the node has not started, or has stopped."""
        if self.lifecycle not in (Lifecycle.RUNNING, Lifecycle.STOPPING):
            raise NodeStoppedError(
                f'{self.name} is {self.lifecycle.value}: start() it, by super() in a class of your own'
            )

    @property
    def is_running(self) -> bool:
        """True if the node is started and no stop has begun."""
        return self.lifecycle is Lifecycle.RUNNING

    @property
    def channels(self) -> list[Channel]:
        """The channels that are open."""
        return [each for each in self.opened if isinstance(each, Channel) and not each.closed]

    @property
    def ros(self):
        """The node's own rospy in this run, whole: ``node.ros.Timer``, ``node.ros.Time.now()``."""
        self.check_running()
        return self.run.ros

    def ros_import(self, name: str):
        """Return a library written on rospy, such as 'actionlib', bound to this run of the node."""
        self.check_running()
        return self.run.modules.load(name)

    def health(self) -> types.SimpleNamespace:
        """Return how the node is doing; asks the master.

        :returns: an object with ``registered`` (True if the master has the node, None if it does not
            answer), ``kind`` (its class), ``connections`` ({transport: how many}), ``dropped`` (how
            many messages), ``errors`` (how often blocks failed), ``threads``, ``souls`` (how many
            run in threads), ``ended_souls`` (their names)
        """
        registered = None
        with suppress(MasterUnreachableError):
            registered = self.master.call('lookupNode', self.name) == self.uri
        return types.SimpleNamespace(registered=registered, **self.told())

    def told(self):
        """Return what :meth:`health` knows without the master; top asks for it by XML-RPC."""
        from pharos.live.snapshot import told

        return told(self)

    describe = ExternalNode.describe

    def __repr__(self):
        return f'<{type(self).__name__} {self.name} {self.lifecycle.value}>'

    def execute(self):
        """Run the soul once, in this thread, and return its value (``node execute`` in the report)."""
        return self._run_soul(self._soul_or(None))

    def fork(self, block: Block | None = None, name: str | None = None) -> threading.Thread:
        """Run the soul, or ``block(node)``, in a thread of its own, and return the thread.

        The report (listing 3.8): ``[node execute] fork``. :meth:`stop` ends it at its next
        :meth:`sleep` or turn of :meth:`every`.
        """
        runs = self._soul_or(block)
        soul = self.run.Thread(target=self._run_soul, args=[runs], name=name or name_of(runs))
        self.souls[soul] = block
        soul.start()
        return soul

    def _soul_or(self, block):
        self.check_running()
        block = block or self.soul
        if taking(block, 'soul', 1, 0) is None:
            raise PharosError(f'{self.name} has no soul to run: give it one, node.soul = block')
        return block

    def _run_soul(self, block):
        before, here.node, is_own = here.node, self, block is self.soul
        try:
            return taking(block, 'soul', 1, 0)(self)
        except BaseException as error:
            if self.is_running or not isinstance(error, rospy.ROSException):  # else by the stop
                self.report(
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
            self.ros.sleep(seconds)
        if not self.is_running and here.node is self:
            raise NodeStoppedError(f'{self.name} stops, and this soul with it')

    def every(self, seconds: float) -> Iterator[int]:
        """Return an iterator that turns every so many seconds of ROS time, until the node stops.

        It counts its turns. A turn that takes longer delays the next.

        :raises ValueError: if ``seconds`` is not above 0
        """
        if not seconds > 0:
            raise ValueError(f'a period is a number of seconds above 0, not {seconds!r}')
        rate, stopping = self.ros.Rate(1 / seconds, reset=True), self.run.stopping

        def turns():
            turn = 0
            while not stopping.is_set():
                yield turn
                turn += 1
                with quiet_wait():
                    rate.sleep()

        return turns()

    # -- failures

    @property
    def errors(self) -> list[BaseException]:
        """The exceptions of blocks in this run of the node, the newest last; 100 kinds at most."""
        return [failure.error for failure in self.failures]

    def report(self, error, block, what, message=None, channel=None, again=None):
        """Keep what a block raised, and tell it at the 1st, 10th, 100th time; Ctrl-C goes on."""
        if isinstance(error, (KeyboardInterrupt, SystemExit)) and is_signalled():
            raise error
        failure = Failure(error, block, message, channel, again)
        self.failures.keep(failure)
        if str(failure.count).strip('0') != '1':
            return
        with suppress(Exception):  # neither log nor Transcript can be written
            line = f'{what} {name_of(block)} of {self.name}'
            line += f' on {channel.topic}' if channel else ''
            line += f' raised {type(error).__name__}: {error}'
            line += f' ({failure.count} times)' if failure.count > 1 else ''
            try:
                self.log(f'{line}\n{failure.traceback}', 'error')
            finally:
                Transcript.show(line)

    def refused(self, topic, reason):
        """Take note that a publisher sends another type."""
        error = MessageTypeError(f'{self.name} does not receive from {topic}: {reason}')
        self.report(error, topic, 'connection')

    def log(self, text, level: str = 'info') -> None:
        """Log a line to the screen, the log file and /rosout.

        :param level: 'debug', 'info', 'warning' (or 'warn'), 'error' or 'fatal'
        """
        if level not in ('debug', 'info', 'warn', 'warning', 'error', 'fatal'):
            raise ValueError(f'unknown level {level!r}: give info or error, and one text')
        if self.lifecycle not in (Lifecycle.RUNNING, Lifecycle.STOPPING):
            return Transcript.show(f'[{level.upper()}] {self.name}: {text}')
        # no wrapper between: rospy looks for the caller of this method
        self.run.core._base_logger('%s', (text,), {}, level=level)

    # -- topics

    def resolve(self, name: str) -> str:
        """Return the full name of a topic, service or parameter, remapped as the node's are.

        :raises ValueError: if it cannot be a name
        """
        self.check_running()
        return self.run.ros.resolve_name(legal_name(name).replace('~/', '~'))

    def peer_name(self, peer):
        """Return the full name of a Node, an ExternalNode, or a node given by its name."""
        name = getattr(peer, 'name', None)
        return name or rosgraph.names.resolve_name(node_name(peer), self.name)

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
        topic = self.resolve(topic)
        peer = from_ and self.peer_name(from_)
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
        topic = self.resolve(topic)
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
        was_open = channel and not channel.closed
        if not was_open:
            name = self.resolve(topic)
            given = type(block) if isinstance(block, Message) else None
            cls = self._class_of(name, typed_as or given)
            was_open = self._open_on(name, OutputChannel)
            channel = was_open[0] if was_open else OutputChannel(self, name, cls)
            self._senders[topic, typed_as] = channel
        try:
            return channel.send(block, to=to, **fields)
        except Exception:
            if not was_open:
                channel.close()
            raise

    def _open_on(self, topic, kind=Channel):
        return [each for each in self.channels if each.topic == topic and isinstance(each, kind)]

    def _class_of(self, topic, typed_as, is_receiver=False):
        known = [each.message_class for each in self._open_on(topic)]
        if typed_as is None and known:
            return known[0]
        type_ = typed_as or self.master.topic_type(topic)
        if type_ in (None, '*'):
            raise UnknownTopicError(
                f'the master knows no type of {topic}: give typed_as=, such as "std_msgs/String"'
            )
        ask = functools.partial(self._definition_of_publisher, topic) if is_receiver else None
        cls = messages.message_class(type_, ask)
        if known and known[0]._md5sum != cls._md5sum:
            raise MessageTypeError(
                f'{self.name} has {topic} open as {known[0]._type}, not as {cls._type}'
            )
        return cls

    def _definition_of_publisher(self, topic, type_):
        """Return the definition that a publisher sends when it is connected."""
        if not self.master.topic(topic).publishers:
            return None

        def find(end):
            headers = [each.header or {} for each in end.impl.connections]
            return [each['message_definition'] for each in headers if each.get('type') == type_]

        return (self._subscribed(find, self.connect_timeout, topic, self.ros.AnyMsg) or [None])[0]

    def _subscribed(self, find, timeout, *options):
        """Wait until ``find(subscriber)`` is true of a subscriber of rospy, and return what it is."""
        # not through a channel: a delegate may call this, whose turn it is
        end = self.ros.Subscriber(*options)
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
        came, topic = [], self.resolve(topic)

        def find(end):
            while came and where and not where(came[0]):
                del came[0]
            return came

        self.master.call('getPid')  # raises if it does not answer
        if timeout and not typed_as:
            typed_as = wait(lambda: self.master.topic_type(topic), timeout, self)
        cls = self._class_of(topic, typed_as, True)
        if self._subscribed(find, timeout, topic, cls, came.append):
            return came[0]
        if self.is_running:
            raise TimeoutError(f'no message on {topic} came within {timeout:g} s: is it published?')
        raise NodeStoppedError(f'{self.name} stopped while it waited for {topic}')

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
        return wait_for(lambda: self.lookup_service(name), timeout, self)

    def parameter(self, name: str, initialized=None) -> Parameter:
        """Return a parameter of the server, bound both ways; '~rate' is private.

        :param initialized: the value that it gets if it has none
        """
        name = self.resolve(name)
        known = [each for each in self.parameters if each.name == name]
        return known[0] if known else Parameter(self, name, initialized)

    @property
    def parameters(self) -> list[Parameter]:
        """The parameters that :meth:`parameter` has returned."""
        return [each for each in self.opened if isinstance(each, Parameter)]

    def read_parameters(self):
        """Have the parameters read their values."""
        for each in self.parameters:
            each.read()


def check_class(node_class):
    """Raise TypeError unless it is a class of nodes."""
    if not (isinstance(node_class, type) and issubclass(node_class, Node)):
        raise TypeError(f'a node is made of a subclass of Node, not {node_class!r}')


class BlockNode(Node):
    """A node made of blocks alone, for tests and prototypes: PhaROSBlockNode in the report."""
