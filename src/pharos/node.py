"""Nodes: real ROS nodes of this process, written with blocks."""
from typing import TYPE_CHECKING, Any, Callable, Optional, TypeVar, Union

from pharos import node_registry, on_demand
from pharos.becoming import become
from pharos.counts import counted
from pharos.health import Health, health_of
from pharos.node_topics import NodeWithTopics
from pharos.offered_service import OfferedService
from pharos.parameter import Parameter
from pharos.restarts import restart
from pharos.run import Run
from pharos.seconds import check_seconds
from pharos.service import Service
from pharos.starts import of_one_run
from pharos.wrong_guesses import names_its_methods, tells_keywords


Self = TypeVar('Self', bound='Node')


@names_its_methods
class Node(NodeWithTopics, is_base=True):
    """A ROS node of this process: made by :meth:`Master.create`, subclassed to override
    :meth:`start` and :meth:`stop`.

    The report (listing 3.1), a subclass of PhaROSNode, is in Python::

        class TurtleDriver(Node):
            def start(self):
                super().start()
                self.fork(TurtleDriver.publishing_loop)

    A node is configured before its ``__init__`` runs, which gets only the further keywords of
    ``create``.

    :ivar name: its name, as the master knows it: '/robot1/driver'
    :ivar master: the :class:`Master` that created it
    :ivar is_running: whether it is started, and no stop has begun; :attr:`lifecycle` says more
    :ivar soul: the block that says what it does, called as ``soul(node)``; may be set
    :ivar delegate: the block run for each message, called as ``delegate(message, channel)``; may be
        set
    :ivar channels: the channels that it has open
    :ivar errors: the exceptions that its blocks raised, the newest last
    :ivar failures: a :class:`Failure` for each of these: block, message, count, ``retry()`` ...
    :ivar ros: its own rospy, whole
    :ivar uri: the URI of its XML-RPC server
    :ivar domain: the address that it advertises
    :ivar tcp_port: its TCPROS port
    :ivar xmlrpc_port: its XML-RPC port
    :ivar connect_timeout: seconds that a topic's first message waits for subscribers; may be set
    :ivar stop_timeout: seconds that a stop waits for souls and messages; may be set
    :ivar queue_bytes: bytes of messages that wait for a slow receiver; may be set
    :ivar allow_remote_shutdown: whether any host may stop it, not only this one and the master's;
        may be set
    :ivar latest_run: what its present start, or the last one, has made; None before the first
    """

    #: whether its class has a start() of its own, which opens and forks all that the node has
    _starts_itself = False
    #: what starts and stops in its own way
    _kind = 'a node'

    if TYPE_CHECKING:

        def __init__(self) -> None:
            ...

    else:

        def __init__(self, *args, **kwargs):
            if args or kwargs:
                given = [*map(repr, args), *(f'{name}={kwargs[name]!r}' for name in kwargs)]
                raise TypeError(
                    f'Node.__init__ takes nothing, and got {", ".join(given)}: a name, soul and so'
                    ' on are given to create(), and what else is, to the __init__ of a class of'
                    f' your own, which calls super().__init__(); see help(Master.create)'
                )

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls._starts_itself = cls.start is not Node.start
        if 'start' in vars(cls):
            cls.start = of_one_run(cls.start)  # type: ignore[assignment]
        cls.stop = node_registry.one_stop_at_a_time(cls.stop)  # type: ignore[assignment]

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
        Run(self, self._settings).start(reopens=not self._starts_itself)

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

    def restart(self) -> None:
        """Stop the node and start it again, under its name and ports; returns when it runs.

        What it had comes back as after :meth:`start`, and the souls that were forked and had not
        ended run from their beginnings, each by the block and name that :meth:`fork` got; what a
        ``start()`` of the class's own forks, that forks again. A node that has stopped starts, with
        the souls that its stop has ended. Of several threads that ask at once, one does it, and the
        others wait.

        It may be called in a block of the node: a soul is ended by it; a delegate, or the block of
        a service or parameter, goes on to its end, but no connection of the former run carries what
        it answers.

        :raises MasterUnreachableError: if the master does not answer, and the node then runs on; or
            if it has gone since, and the node is then stopped
        :raises NodeStoppedError: if another thread stops the node meanwhile, or all nodes are
        :raises NodeNameInUseError, PortInUseError: and the node is then stopped
        """
        restart(self, forks_itself=self._starts_itself)

    def become(self, node_class: type) -> None:
        """Be a node of another class from now on, such as the one that a reload of its module has
        made of its own: its behaviour changes, its name, ports, connections, queues, counts and
        attributes stay::

            importlib.reload(turtles)
            driver.become(turtles.TurtleDriver)

        It happens when no delegate of the node runs, for which this waits: no message is lost, or
        comes twice. What are methods of the present class become those of the same names: the
        soul, delegates, blocks of services and parameters, and souls that are forked, which begin
        anew at their next turn of :meth:`every` (see :meth:`renew`). What runs goes on to its end
        as it was. What others were given, such as rospy's Timer, stays as it is.

        IPython's ``%autoreload 2`` does the same by itself when a module was edited, but for souls
        that loop, which :meth:`renew` has begin anew.

        Neither ``__init__`` nor ``start`` of the new class runs: attributes that only it has are to
        be set before, or have their values in the class.

        :raises PharosError: if the new class lacks one of those methods; or if this waits in a
            delegate of another node, and one of this node's waits for that delegate; nothing has
            changed then, nor after the others
        :raises TypeError: if it is no subclass of Node, one of scripts (where this is none, or the
            other way round), has other ``__slots__``, or a method that cannot be called as the
            former
        """
        if not (isinstance(node_class, type) and issubclass(node_class, Node)):
            raise TypeError(
                f'{self.name} becomes a node of another subclass of Node, not {node_class!r}'
            )
        if node_class._kind != self._kind:
            raise TypeError(
                f'{self.name} is {self._kind}, and {node_class.__name__} is the class of'
                f' {node_class._kind}, which starts in another way: create() one'
            )
        become(self, node_class)

    def __enter__(self: Self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        self.stop()

    # -- services, parameters, log

    @tells_keywords
    def serve(
        self,
        name: str,
        typed_as: Union[str, type],
        block: Callable[[Any], Any],
        only_nearby: bool = False,
    ) -> OfferedService:
        """Offer a service; returns a handle with ``close()``.

        ``block(request)`` runs in a thread of the caller's connection and returns a response, a
        dict, tuple or list of its fields, or its only field. An exception in it goes to the caller,
        and is reported as a delegate's.

        :param typed_as: service type name, such as 'std_srvs/Empty', or class
        :param only_nearby: answer only calls from this host and the master's
        :raises MasterUnreachableError: if the master does not answer; nothing is left behind then
        """
        name = self.current_run.resolve(name, 'service')
        return OfferedService(self, name, typed_as, block, only_nearby)

    @tells_keywords
    def lookup_service(
        self, name: str, persistent: bool = False, wait: Optional[float] = 0
    ) -> Service:
        """The :class:`Service` of that name, to be called in the name of this node.

        Its name is resolved as the node's other names are: in its namespace, remapped, '~reset' for
        one of its own. All else is as in :meth:`Master.lookup_service`, which knows full names
        alone.
        """
        name = self.current_run.resolve(name, 'service')
        return self.master.lookup_service(name, self.name, persistent, wait)

    @tells_keywords
    def wait_for_service(self, name: str, timeout: Optional[float] = None) -> Service:
        """Wait until a service of that name, resolved as in :meth:`lookup_service`, is offered, and
        return it; see :meth:`Master.wait_for_service`."""
        name = self.current_run.resolve(name, 'service')
        return self.master.wait_for_service(name, timeout, self.name)

    @tells_keywords
    def parameter(self, name: str, initialized: Any = None) -> Parameter:
        """The :class:`Parameter` of that name ('~rate' is private); set to ``initialized`` where it
        has no value."""
        return Parameter(self, self.current_run.resolve(name, 'parameter'), initialized)

    # -- what rospy offers beyond

    @property
    def ros(self) -> Any:
        """The node's own rospy, whole: ``node.ros.Timer``, ``node.ros.Time.now()``. It is for this
        run of the node."""
        return self.current_run.rospy.module

    def ros_import(self, name: str) -> Any:
        """A library written on rospy ('actionlib', 'message_filters', 'tf2_ros'), bound to this run
        of the node."""
        if not (isinstance(name, str) and all(map(str.isidentifier, name.split('.')))):
            raise TypeError(f"a library is given by its name, such as 'actionlib', not as {name!r}")
        return self.current_run.rospy.import_library(name)

    @property
    def uri(self) -> Optional[str]:
        """The URI of the node's XML-RPC server, None before the first start."""
        return self.latest_run.rospy.uri if self.latest_run else None

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

    def describe(self, seconds: float = 1.0) -> str:
        """The node in words: where it runs, its souls, topics with type, rate, counts and peers,
        services, parameters and failures. A master that hangs is waited for, for its time limit.

        :param seconds: for which messages are counted, for the rates; 0: no rates are told
        """
        seconds = check_seconds('seconds', seconds, least=0)
        text: str = on_demand.module('live.description').describe(self, seconds)
        return text

    def __repr__(self) -> str:
        health = f': {health_of(self, ask=False)}' if self.is_running else ''
        return f'<{type(self).__name__} {self.name} {self.lifecycle.value}{self._size()}{health}>'

    def _size(self) -> str:
        return f', {counted(len(self.channels), "channel")}'


class BlockNode(Node):
    """A node made of blocks alone, for tests and prototypes; ``help(Node)`` tells what it has.

    The report (listing 3.7)::

        node := master create: PhaROSBlockNode named: '/myNode' ... soul: [:myNode | ...].
        node execute
        node = master.create(BlockNode, named='/myNode', soul=lambda me: ...)
        node.execute()
    """
