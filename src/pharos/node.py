"""Nodes: real ROS nodes of this process, written with blocks."""
import threading

from pharos import messages
from pharos.blocks import attempt, check_block, check_delegate, check_soul, name_of
from pharos.errors import MessageTypeError, NodeStoppedError, PharosError
from pharos.external_node import ExternalNode
from pharos.failures import Failures
from pharos.health import health_of
from pharos.life import Life
from pharos.offered_service import OfferedService
from pharos.parameter import Parameter
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.names import Resolved, check_name
from pharos.private_rospy.settings import Settings
from pharos.seconds import check_seconds
from pharos.topic import QUEUE_SIZE, Topic
from pharos.transcript import Transcript


class Node(Life):
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

    def __init__(self):
        if '_settings' not in vars(self):
            name = type(self).__name__
            raise TypeError(
                f'a node is made by a master: Master().create({name}, named=...), not {name}()'
            )

    def __init_subclass__(cls, **kwargs):
        super().__init_subclass__(**kwargs)
        for name in ('soul', 'delegate'):
            if name in vars(cls) and not isinstance(vars(cls)[name], property):
                raise TypeError(
                    f'{cls.__name__}.{name} would never run: each node has a {name} of its own,'
                    f' given to create() or set. Name it otherwise, and set self.{name} in start()'
                )

    def _configure(self, master, settings, soul, delegate):
        super()._configure(master, settings)
        self.soul, self.delegate = soul, delegate
        self._opening = threading.Lock()  # held to change _channels
        self._first_sends = {}  # topic name -> the lock of the thread that opens its channel
        self._senders = {}  # topic name, as given to send_to -> the channel that it went through
        self._failures = Failures(self._tell_failure)

    # -- blocks

    @property
    def soul(self):
        """The block that says what the node does, called as ``soul(node)`` by :meth:`execute` and
        :meth:`fork`.

        May be replaced while the node runs, and takes effect with the next run.
        """
        return self._soul

    @soul.setter
    def soul(self, block):
        self._soul = check_soul(block)

    @property
    def delegate(self):
        """The block run for each message received, called as ``delegate(message, channel)``.

        The report: ``self receiverDelegate: [:message :channel | ...]``. Delegates of a node run
        one at a time. It may be replaced while the node runs, and takes effect with the next
        message.
        """
        return self._delegate

    @delegate.setter
    def delegate(self, block):
        self._delegate = check_delegate(block)

    def execute(self):
        """Run the soul once, in the calling thread, and return its value.

        The report (listing 3.7): ``node execute``. An exception in the soul is reported (see
        :attr:`errors`) and ends only this run, which then returns None.
        """
        self._live_rospy()
        return self._souls.run(self._the_soul(), self._the_soul)

    def fork(self, block=None, name=None):
        """Run the soul, or ``block(node)``, in a thread of its own, and return the thread.

        The report (listing 3.8): ``[node execute] fork``. :meth:`stop` ends it at its next
        :meth:`sleep` or turn of
        :meth:`every`.
        """
        present = self._the_soul if block is None else (lambda: check_soul(block))
        return self._souls.fork(present(), present, name or 'soul', self._live_rospy().start_thread)

    def _the_soul(self):
        if self._soul is None:
            raise PharosError(
                f'{self.name} has no soul to run: give it one with soul= or node.soul ='
            )
        return self._soul

    @property
    def errors(self):
        """The exceptions that blocks raised, the newest last: of identical ones the newest alone.

        100 are kept, among them the first, for it may be the cause of the others. Who has seen to
        them may ``pop`` or ``clear`` them.
        """
        return self._failures.errors

    @property
    def failures(self):
        """For each of :attr:`errors` its :class:`~pharos.Failure`: what failed, on what, how
        often."""
        return self._failures.all()

    def _report(self, error, block, what, channel=None, message=None, again=None):
        """Keep and tell what a block raised, which ends nothing but that run of it.

        See :meth:`Failures.report`.
        """
        if not self.is_running and isinstance(
            error, (NodeStoppedError, rospy.ROSInterruptException)
        ):
            return  # that is how the stop of a node ends its souls
        where = f'{what} {name_of(block)} of {self.name}'
        if channel is not None:
            where += f' on {channel.topic}'
            again = channel._run_again
        self._failures.report(error, block, where, channel, message, again)

    def _report_refusal(self, refusal):
        """Keep and tell, once, that a publisher's messages do not come, for they are of another
        type."""
        error = MessageTypeError(
            messages.explain_refusal(
                self.name, refusal.topic, refusal.wanted, refusal.publisher, refusal.offered
            )
        )
        self._failures.report(
            error, None, f'connection of {self.name} to {refusal.publisher} for {refusal.topic}'
        )

    def _tell_failure(self, line, details):
        attempt(lambda: self.log(f'{line}\n{details}' if details else line, level='error'))
        Transcript.show(line)

    # -- topics

    def interested_in(
        self,
        topic,
        typed_as=None,
        delegate=None,
        queue_size=QUEUE_SIZE,
        inline=False,
        shared=False,
        from_=None,
        wait=0,
    ):
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

    def output_channel(self, topic, typed_as=None, latch=False, queue_size=QUEUE_SIZE, wait=0):
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
        self, topic, block=None, *, typed_as=None, to=None, connect_timeout=None, wait=0, **fields
    ):
        """Send one message, filled by ``block(message)``, by keywords, or both; returns it.

        The report (listing 3.1)::

            self sendTo: '/turtle1/command_velocity' a: [:message | message angular: 1.0. message
            linear: 2.0] self.send_to('/turtle1/command_velocity', angular=1.0, linear=2.0)

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
            to = self._name_of(to)
        if connect_timeout is None:
            connect_timeout = self.connect_timeout
        else:
            connect_timeout = check_seconds('connect_timeout', connect_timeout)
        if wait != 0:
            wait = check_seconds('wait', wait)
        channel = self._senders.get(topic) if isinstance(topic, str) else None
        if channel is None or not channel.is_open:
            check_block(block, 'block', ('message',))
            bus = self._topic(topic)
            channel = self._sending_channel(bus) or self._open_sending_channel(
                bus, typed_as, connect_timeout, wait
            )
            self._senders[topic] = channel
        if typed_as not in (None, channel.message_class, channel.type):
            self._topic(topic).message_class(self, typed_as)  # refuses another type
        # another thread may be opening it just now
        channel.wait_until_connected(connect_timeout)
        return channel.send(block, to=to, **fields)

    def _sending_channel(self, topic):
        channels = [channel for channel in self.channels if channel.topic == topic.name]
        return next((channel for channel in channels if hasattr(channel, 'publish')), None)

    def _open_sending_channel(self, topic, typed_as, connect_timeout, wait):
        """Open a channel for :meth:`send_to`; of several threads that come at once, one does, and
        the others wait."""
        opening = self._first_sends.setdefault(topic.name, threading.RLock())
        limit = max(0.0, wait + connect_timeout)
        is_mine = opening.acquire(timeout=min(limit, threading.TIMEOUT_MAX))
        try:
            return self._sending_channel(topic) or topic.output_channel(
                self, typed_as, connect_timeout=connect_timeout, wait=wait
            )
        finally:
            if is_mine:
                opening.release()

    @property
    def channels(self):
        """The channels that the node has open."""
        return [channel for channel in self._channels if channel.is_open]

    def _topic(self, name):
        return Topic(self.master, self._resolve(name, 'topic'))

    def _resolve(self, name, what):
        """A name as the node means it, in its namespace and remapped, in full."""
        resolve = self._live_rospy().rospy.resolve_name
        name = check_name(name, what, private=True)
        # where rospy takes what follows for a global name (ros_comm #3044)
        return check_name(resolve('~' + name[2:] if name.startswith('~/') else name), what)

    def _name_of(self, peer):
        """The full name of a node that messages come from or go to.

        :param peer: a name, Node or ExternalNode
        :raises ValueError: if it is none of these, or of another master
        """
        if isinstance(peer, (Node, ExternalNode)):
            if peer.master != self.master:
                raise ValueError(
                    f'{peer} is at another master than {self.name}, and nothing goes from one to'
                    ' the other'
                )
            return Resolved(peer.name)
        if isinstance(peer, Resolved):
            return peer
        if not isinstance(peer, str):
            raise ValueError(f'from_= and to= are a node or its name, not {peer!r}')
        return Resolved(self._resolve(peer, 'node'))

    def _remember_channel(self, channel):
        with self._opening:
            if channel not in self._channels:
                # replaced, so that others may iterate meanwhile
                self._channels = [*self._channels, channel]

    def _forget_channel(self, channel):
        with self._opening:
            self._channels = [other for other in self._channels if other is not channel]
            self._senders.clear()

    # -- services, parameters, log

    def serve(self, name, typed_as, block):
        """Offer a service; returns a handle with ``close()``.

        ``block(request)`` runs in a thread of the caller's connection and returns a response, a
        dict, tuple or list of its fields, or its only field. An exception in it goes to the caller,
        and is reported as a delegate's.

        :param typed_as: service type name, such as 'std_srvs/Empty', or class
        :raises MasterUnreachableError: if the master does not answer; nothing is left behind then
        """
        return OfferedService(self, self._resolve(name, 'service'), typed_as, block)

    def parameter(self, name, initialized=None):
        """The :class:`Parameter` of that name ('~rate' is private); set to ``initialized`` where it
        has no value."""
        return Parameter(self, self._resolve(name, 'parameter'), initialized)

    def log(self, text, level='info'):
        """Log a line on /rosout, the node's log file and the screen, with the file and line of the
        caller.

        :param level: 'debug', 'info', 'warning' (or 'warn'), 'error' or 'fatal'
        """
        try:
            level = _LEVELS[level]
        except KeyError:
            raise ValueError(f"no log level {level!r}: there are {', '.join(_LEVELS)}") from None
        if self._rospy is not None:
            log = self._rospy.log
            # no wrapper between: rospy looks for the caller of this method
            log('%s', (text,), {}, level=level)

    # -- what rospy offers beyond

    @property
    def ros(self):
        """The node's own rospy, whole: ``node.ros.Timer``, ``node.ros.Time.now()``. It is for this
        run of the node."""
        return self._live_rospy().rospy

    def ros_import(self, name):
        """A library written on rospy ('actionlib', 'message_filters', 'tf2_ros'), bound to this run
        of the node."""
        if not isinstance(name, str):
            raise TypeError(f"a library is given by its name, such as 'actionlib', not as {name!r}")
        return self._live_rospy().import_library(name)

    @property
    def uri(self):
        """The URI of the node's XML-RPC server, None before the first start."""
        return self._rospy and self._rospy.uri

    @property
    def tcp_port(self):
        """The TCPROS port; the one asked for, before the first start."""
        return self._settings.tcp_port

    @property
    def xmlrpc_port(self):
        """The XML-RPC port; the one asked for, before the first start."""
        return self._settings.xmlrpc_port

    @property
    def domain(self):
        """The address that the node advertises, None before the first start."""
        return self._rospy and self._rospy.domain

    def health(self):
        """How the node is doing: ``registered, reachable_since, connections, dropped, errors,
        threads``, a named tuple.

        Asks the master, for up to 5 s; ``str()`` of it is one line, which ``repr(node)`` shows too.
        """
        return health_of(self, ask=True)

    def __repr__(self):
        health = f': {health_of(self, ask=False)}' if self.is_running else ''
        return (
            f'<{type(self).__name__} {self.name} {self._lifecycle.value},'
            f' {len(self.channels)} channels{health}>'
        )


class BlockNode(Node):
    """A node made of blocks alone, for tests and prototypes.

    The report (listing 3.7)::

        node := master create: PhaROSBlockNode named: '/myNode' ... soul: [:myNode | ...]. node
        execute node = master.create(BlockNode, named='/myNode', soul=lambda me: ...);
        node.execute()
    """


def make(node_class, master, named, soul, delegate, args, kwargs, **settings):
    """A new node of ``node_class``, configured and not yet started."""
    if not (isinstance(node_class, type) and issubclass(node_class, Node)):
        raise TypeError(f'a node is made of a subclass of Node, or BlockNode; not {node_class!r}')
    node = node_class.__new__(node_class)
    node._configure(master, Settings(named, master.url, **settings), soul, delegate)
    node.__init__(*args, **kwargs)
    return node


_LEVELS = {
    'debug': 'debug',
    'info': 'info',
    'warning': 'warning',
    'warn': 'warning',
    'error': 'error',
    'err': 'error',
    'fatal': 'critical',
    'critical': 'critical',
}
