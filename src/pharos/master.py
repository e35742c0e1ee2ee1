"""The Master: a proxy of a ROS master. It creates nodes, and finds those of other processes."""
from __future__ import annotations

import collections.abc
import contextlib
import inspect
import os
import re
from time import monotonic  # by name: real, also in a simulation
from typing import TYPE_CHECKING, Any, Sequence, TypeVar
from weakref import WeakValueDictionary
from xmlrpc.client import dumps, loads

from rosgraph.names import get_ros_namespace, is_legal_remap, load_mappings, ns_join

from pharos import signals
from pharos.blocks import Block
from pharos.errors import MasterUnreachableError
from pharos.names import check_node_class, full_name, node_name
from pharos.node import Node
from pharos.private_rospy.run import Settings
from pharos.private_rospy.xmlrpc import CALLER_ID, UNREACHABLE, ServerProxy
from pharos.topic import Topic
from pharos.transcript import show_once
from pharos.waiting import wait_for

if TYPE_CHECKING:
    from pharos.compose.child_process import RosProcess
    from pharos.compose.composition import Composition
    from pharos.compose.script import ScriptNode
    from pharos.live.external_node import ExternalNode
    from pharos.live.graph import Graph
    from pharos.live.service_client import Service

SLOW_ANSWER = 1.0  # seconds; the first that takes longer is told
LIFE_LIMIT = 0.5  # seconds that a node has to show that the node lives
_URL = re.compile(r'http://(\[[\w:]+\]|[\w.-]+):([1-6]?\d{1,4})/?')

N = TypeVar('N', bound=Node)


class Parameters(collections.abc.MutableMapping):
    """The parameter server as a mapping of names to values; a name without a slash gets one.

    Values are bools, ints, floats, strings, lists and dicts. All methods ask the master.
    """

    def __init__(self, call: Block) -> None:
        self._call = call

    def __getitem__(self, name: str) -> Any:
        value = self._call('getParam', full_name(name))
        if value is None:
            raise KeyError(name)
        return value

    def __setitem__(self, name: str, value: Any) -> None:
        try:
            loads(dumps((value,)))
        except Exception as error:
            raise ValueError(f'{name} cannot be set to {value!r}: {error}') from None
        self._call('setParam', full_name(name), value)

    def __delitem__(self, name: str) -> None:
        self[name]  # raises KeyError
        self._call('deleteParam', full_name(name))

    def __iter__(self) -> collections.abc.Iterator[str]:
        return iter(sorted(self._call('getParamNames')))

    def __len__(self) -> int:
        return len(self._call('getParamNames'))


class Master:
    """A proxy of the ROS master at a URL. The constructor makes no connection yet.

    The report: ``PhaROSMaster url: 'http://127.0.0.1:11311/'``::

        master = Master('http://127.0.0.1:11311/')

    A Master made in the main thread has SIGINT, SIGTERM and SIGHUP stop all nodes of this process.
    Signals that the program handles stay the program's. Masters with equal URLs are equal. Methods
    that ask the master raise MasterUnreachableError if the master does not answer.

    :param url: default: ROS_MASTER_URI, or else http://localhost:11311/
    :param share_connections: True: the nodes of this process that hear one topic of one other process
        by TCPROS share one connection. Each has its own message, queue and counts
    :param shared_memory: False: nodes use TCPROS between processes of this package on one host, too;
        default: what PHAROS_SHARED_MEMORY says, 0 or 1, else True
    :raises ValueError: if the URL is malformed
    """

    _environ = os.environ  # for ROS_NAMESPACE; a script's Master has its own
    # remappings -> the first node that was created with them
    _first_nodes: WeakValueDictionary[tuple, Node] = WeakValueDictionary()

    def __init__(
        self,
        url: str | None = None,
        shared_memory: bool | None = None,
        share_connections: bool = False,
    ) -> None:
        url = url or os.environ.get('ROS_MASTER_URI') or 'http://localhost:11311/'
        parts = _URL.fullmatch(str(url).lower())
        if not parts:
            raise ValueError(
                f"{url!r} cannot be the URL of a master: give one such as 'http://127.0.0.1:11311/'"
            )
        host = '127.0.0.1' if parts[1] == 'localhost' else parts[1]
        self.url = f'http://{host}:{parts[2]}/'
        if shared_memory is None:
            shared_memory = os.environ.get('PHAROS_SHARED_MEMORY') != '0'
        self.shared_memory = shared_memory and hasattr(os, 'memfd_create')
        self.share_connections = share_connections
        self.parameters = Parameters(self.call)
        self._process: Any = None
        signals.handle_signals()

    # -- an embedded master

    @classmethod
    def embedded(cls, port: int = 0) -> Master:
        """Start a ROS master as a child of this process.

        The master ends with its ``with`` block, at :meth:`stop`, or with this process. A /rosout
        node passes log lines on to /rosout_agg, as with roscore.

        :param port: 0: any free port
        :raises PortInUseError: if the port is taken
        """
        from pharos.compose.child_process import start_master

        url, process = start_master(port)
        master = cls(url)
        master._process = process
        return master

    def stop(self) -> None:
        """Stop the nodes of an embedded master in this process, and end the master.

        Do nothing to any other master.
        """
        process = self._process
        self._process = None
        if process:
            for node in self.own_nodes():
                node._stop_safely()
            with process:  # waits for its end
                process.stdin.close()

    def __enter__(self) -> Master:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    # -- questions

    def call(self, method: str, *args: Any, caller_id: str = CALLER_ID) -> Any:
        """Call a method of the master's API, and return its value; None if the master refuses.

        :param method: such as 'lookupNode'
        :param caller_id: the name of the node that calls
        :raises MasterUnreachableError: if the master does not answer within 5 s
        """
        start = monotonic()
        try:
            code, _, value = getattr(ServerProxy(self.url), method)(caller_id, *args)
        except UNREACHABLE as error:
            raise MasterUnreachableError(
                f'no ROS master answers at {self.url} ({error}): start roscore, or give the right URL'
            ) from None
        duration = monotonic() - start
        if duration > SLOW_ANSWER:
            text = f'the ROS master at {self.url} is slow: an answer took {duration:.1f} s'
            show_once(self.url, text)
        return value if code == 1 else None

    def is_reachable(self) -> bool:
        """True if the master answers."""
        with contextlib.suppress(MasterUnreachableError):
            return bool(self.pid)
        return False

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the master answers, and return True.

        In a soul, the stop of the soul's node ends the wait, too.

        :param timeout: seconds, None: without limit
        :raises MasterUnreachableError: if the master does not answer in time
        """
        return bool(wait_for(lambda: self.pid, timeout, f'a ROS master at {self.url}'))

    @property
    def pid(self) -> int:
        """The number of the master's process, on its host."""
        return self.call('getPid')

    def system_state(self) -> tuple[dict[str, list[str]], ...]:
        """Return ``(publishers, subscribers, services)``, each ``{name: [node names]}``."""
        return tuple(map(dict, self.call('getSystemState')))

    def topic_type(self, name: str) -> str | None:
        """Return the type of a topic, by its full name; None if the master knows none."""
        return dict(self.call('getTopicTypes')).get(name)

    def topics(self) -> list[Topic]:
        """Return the topics that have a publisher or a subscriber."""
        publishers, subscribers, _ = self.system_state()
        return [Topic(self, name) for name in sorted({**publishers, **subscribers})]

    def topic(self, name: str) -> Topic:
        """Return the topic of that name, which need not exist yet.

        :raises ValueError: if a topic cannot have the name
        """
        return Topic(self, full_name(name))

    # -- nodes

    def create(
        self,
        node_class: type[N],
        named: str,
        domain: str | None = None,
        tcp_port: int = 0,
        xmlrpc_port: int = 0,
        soul: Block | None = None,
        delegate: Block | None = None,
        argv: Sequence[str] | None = None,
        **kwargs: Any,
    ) -> N:
        """Create a node, start and register the node, and return the node.

        The report: ``master create: Driver named: '/driver' domain: '127.0.0.1' tcpPort: 8080
        xmlRpcPort: 8081``.

        :param node_class: :class:`Node`, or a subclass
        :param named: the node's name, perhaps with a namespace: '/robot1/driver'
        :param domain: the address that the node advertises; a loopback address is also the only one
            that the node listens on; default: ROS_HOSTNAME, ROS_IP or the host's address
        :param tcp_port: the port for messages and services, 0: any free port
        :param xmlrpc_port: the port for ROS's calls, 0: any free port
        :param soul: the node's soul, ``soul(node)``; :meth:`Node.fork` runs the soul
        :param delegate: the block for messages of channels without a delegate
        :param argv: ROS's remappings and private parameters; a script passes ``sys.argv``
        :param kwargs: the arguments of the ``__init__`` of the class
        :raises NodeNameInUseError, PortInUseError, MasterUnreachableError: and nothing is left
        :raises TypeError: if the class is not a Node, or its ``__init__`` takes other arguments
        :raises ValueError: if the name, the address or a port cannot be one
        """
        check_node_class(node_class, Node)
        if not (domain is None or isinstance(domain, str) and re.fullmatch(r'[\w.:-]+', domain)):
            raise ValueError(f'{domain!r} cannot be an address: give one such as 127.0.0.1')
        for port in tcp_port, xmlrpc_port:
            if port not in range(65536):
                raise ValueError(f'{port!r} cannot be a port: give 0 to 65535')
        mappings = [argument for argument in argv or () if is_legal_remap(argument)]
        # __init__ of a class may use self.name already: so the node gets its settings before
        node = node_class.__new__(node_class)
        name = self._remapped_name(node, node_name(named), tuple(mappings))
        # the full name contains these already, and rospy would apply them once more
        remappings = [each for each in mappings if not each.startswith(('__name:=', '__ns:='))]
        settings = Settings(name, self, domain, (tcp_port, xmlrpc_port), remappings)
        node._configure(settings, soul, delegate)
        try:
            inspect.signature(node.__init__).bind(**kwargs)  # type: ignore[misc]
        except TypeError as error:
            raise TypeError(
                f'{node_class.__name__} cannot be created with {", ".join(kwargs) or "so little"}:'
                f" its __init__ says {error} (a unique name: named=anonymous_name('driver'))"
            ) from None
        node.__init__(**kwargs)  # type: ignore[misc]
        try:
            node._start_held()
        except BaseException:
            node._stop_safely()
            raise
        return node

    def _remapped_name(self, node: Node, name: str, mappings: tuple[str, ...]) -> str:
        """Return the full name of a new node; ``__name`` goes to one node of those remappings."""
        special_names = load_mappings(mappings)
        if '__name' in special_names:
            first = self._first_nodes.get(mappings)
            if not (first and first.is_running and first._settings.master == self):
                self._first_nodes[mappings] = node
                namespace = name[: name.rfind('/') + 1]
                name = namespace + node_name(special_names['__name'])
        # the namespace of a launch file's group holds for '/driver', too, as in rospy.init_node()
        if '__ns' in special_names and name.startswith('/'):
            name = name[name.rfind('/') + 1 :]
        return ns_join(get_ros_namespace(self._environ, mappings), name)

    def own_nodes(self) -> list[Node]:
        """Return the nodes of this process at this master that run, start, stop or restart."""
        return [node for node in signals.own_nodes() if node._settings.master == self]

    def nodes(self) -> list[Node | ExternalNode]:
        """Return all nodes that the master knows: Nodes of this process, and ExternalNodes."""
        names: set[str] = set()
        for registry in self.system_state():
            names.update(*registry.values())
        return [self._find_node(name) for name in sorted(names)]

    def node(self, name: str) -> Node | ExternalNode:
        """Return the node of that name: a Node if of this process, else an ExternalNode.

        :raises UnknownNodeError: if the master knows no such node
        """
        node = self._find_node(full_name(node_name(name)))
        if not isinstance(node, Node):
            node.uri  # raises if the master does not know the node
        return node

    def _find_node(self, name: str) -> Node | ExternalNode:
        nodes = [node for node in self.own_nodes() if node._settings.name == name]
        if not nodes:
            from pharos.live.external_node import ExternalNode

            return ExternalNode(self, name)
        for node in nodes:
            # a script that makes its node with pharos has the node's name, and no uri
            if node._current_run.uri:
                return node
        return nodes[0]

    def may_live(self, name: str) -> bool:
        """True unless the node of that name refuses connections, or is not registered."""
        uri = self.call('lookupNode', name)
        if not uri:
            return False
        try:
            ServerProxy(uri, LIFE_LIMIT).getPid(CALLER_ID)
        except UNREACHABLE as error:
            return not isinstance(error, ConnectionRefusedError)
        return True

    def wait_for_node(self, name: str, timeout: float | None = None) -> Node | ExternalNode:
        """Wait until a node of that name is registered, and return the node.

        :param timeout: seconds, None: without limit
        :raises UnknownNodeError: if no such node is registered in time
        """
        return wait_for(lambda: self.node(name), timeout, f'the node {name}')

    # -- services

    def services(self) -> list[str]:
        """Return the names of all services."""
        return sorted(self.system_state()[2])

    def lookup_service(self, name: str, caller_id: str = CALLER_ID) -> Service:
        """Return a service that can be called.

        The report: ``master lookupService: '/clear' with: '/myID'``.

        :param caller_id: the name of the calling node, which the provider gets
        :raises UnknownServiceError: if nobody offers the service
        """
        from pharos.live.service_client import Service

        return Service(self, full_name(name), caller_id)

    def wait_for_service(
        self, name: str, timeout: float | None = None, caller_id: str = CALLER_ID
    ) -> Service:
        """Wait until a service is offered, and return the service.

        :param timeout: seconds, None: without limit
        :raises UnknownServiceError: if nobody offers the service in time
        """
        return wait_for(
            lambda: self.lookup_service(name, caller_id), timeout, f'the service {name}'
        )

    # -- programs

    def run(
        self,
        package: str,
        executable: str,
        *args: Any,
    ) -> RosProcess:
        """Run a program of ROS as a process at this master, as rosrun does.

        What it prints is in ``output`` of the process, and not shown. ``terminate()`` ends it.

        :param args: the program's arguments
        :raises UnknownNodeError: if there is no such program
        """
        from pharos.compose.child_process import run_program

        return run_program(self.url, package, executable, args)

    def launch(self, package: str | None, file: str, **args: Any) -> RosProcess:
        """Run a launch file in a process of roslaunch, at this master.

        :param package: None: ``file`` is a path
        :param args: the arguments of the launch file
        :raises UnknownNodeError: if there is no such file
        """
        from pharos.compose.child_process import run_launch_file

        return run_launch_file(self.url, package, file, args)

    def load(
        self,
        package: str,
        executable: str | None = None,
        *args: Any,
        name: str | None = None,
        namespace: str | None = None,
        remap: dict[str, str] | None = None,
        params: dict[str, Any] | None = None,
        here: bool = False,
    ) -> ScriptNode:
        """Run a program of rospy, unmodified, as a node of this process.

        Return when the program has called ``rospy.init_node`` or has ended, after 10 s at most.

        :param package: without ``executable``, the path of the program
        :param args: the program's arguments
        :param name: the node's name; default: the name that the program gives to ``init_node``
        :param namespace: the node's namespace
        :param remap: names of the program -> other names
        :param params: names of the node's private parameters -> values
        :param here: True: run the program in this process even if the program shows windows
        :raises UnknownNodeError: if there is no such program
        :raises PharosError: if the program cannot run in this process, or fails before init_node
        """
        from pharos.compose.script import load

        return load(self, package, executable, args, name, namespace, remap or {}, params, here)

    def compose(
        self,
        package: str | None,
        file: str,
        *,
        only: Sequence[str] = (),
        apart: Sequence[str] = (),
        here: Sequence[str] = (),
        groups: Sequence[Sequence[str]] = (),
        share_connections: bool = True,
        **args: Any,
    ) -> Composition:
        """Run the Python nodes of a launch file in this process.

        roslaunch starts the other nodes in processes of their own: C++, other machines, and nodes
        with a launch-prefix, a cwd or windows.

        :param package: None: ``file`` is a path
        :param only: the names of the nodes that run; none: all
        :param apart: the names of nodes that run in processes of their own
        :param here: the names of nodes that run in this process even if they show windows
        :param groups: lists of names; the nodes of each list run in one process
        :param share_connections: as for :class:`Master`
        :param args: the arguments of the launch file
        :raises UnknownNodeError: if there is no such file, argument or node
        :raises PharosError: if roslaunch cannot read the file
        """
        from pharos.compose.composition import compose

        master = type(self)(self.url, self.shared_memory, share_connections)
        return compose(master, package, file, args, only, apart, here, groups)

    def graph(self, seconds: float = 0) -> Graph:
        """Return the :class:`Graph` of all nodes and topics.

        :param seconds: how long messages are counted, for rates; 0: no rates
        """
        from pharos.live.graph import graph_of

        return graph_of(self, seconds)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Master) and self.url == other.url

    def __hash__(self) -> int:
        return hash(self.url)

    def __repr__(self) -> str:
        return f'<Master {self.url}>'
