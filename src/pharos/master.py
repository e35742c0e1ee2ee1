"""The proxy of a ROS master."""
import subprocess
from typing import (
    TYPE_CHECKING,
    Any,
    Callable,
    Collection,
    Dict,
    Iterable,
    List,
    Optional,
    TypeVar,
    Union,
)

import rosgraph
from rosgraph.rosenv import ROS_MASTER_URI

from pharos import attributes, embedded_master, node_registry, on_demand, ros_process, starts
from pharos.blocks import check_block, check_flag
from pharos.errors import PharosError, UnknownNodeError, suggest
from pharos.external_node import ExternalNode
from pharos.master_services import MasterServices
from pharos.node import Node
from pharos.parameters import Parameters
from pharos.private_rospy.addresses import check_port, check_url
from pharos.private_rospy.deadlines import MARGIN, time_limit
from pharos.program_files import AnyPath
from pharos.ros_process import RosProcess
from pharos.seconds import check_limit
from pharos.topic import Topic
from pharos.watcher import watcher_of
from pharos.wrong_guesses import names_its_methods, tells_keywords

if TYPE_CHECKING:
    from typing_extensions import ParamSpec  # part of typing since Python 3.10

    from pharos.compose.composition import Composition
    from pharos.compose.script import ScriptNode

    Init = ParamSpec('Init')
NodeType = TypeVar('NodeType', bound=Node)
AnyNode = Union[Node, ExternalNode]


@names_its_methods
class Master(MasterServices):
    """The proxy of a ROS master: creates nodes, and finds others.

    The report (listing 3.2)::

        master := PhaROSMaster url: 'http://127.0.0.1:11311/'
        master = Master('http://127.0.0.1:11311/')

    Masters whose URLs mean one address ('localhost' and '127.0.0.1') are equal; a host name is
    looked up where two are compared.

    :ivar url: its URL
    :ivar share_connections: whether its nodes share connections, as below
    :param url: URL of the ROS master; None: ROS_MASTER_URI, else ROS's default. Makes no connection
        yet.
    :param share_connections: the nodes that it creates, and others of this process that do so, share
        one TCPROS connection to each publisher elsewhere, which sends to one of them alone, and
        whose messages are read once
    :raises ValueError: if it is no URL
    """

    def __init__(self, url: Optional[str] = None, *, share_connections: bool = False) -> None:
        self.share_connections = check_flag('share_connections', share_connections)
        self.url: str = (
            check_url(rosgraph.get_master_uri(), ROS_MASTER_URI) if url is None else check_url(url)
        )
        # the process of an embedded master
        self._child: Optional['subprocess.Popen[str]'] = None

    @classmethod
    def embedded(cls, port: int = 0) -> 'Master':
        """A ROS master of one's own, with /rosout, as a child of this process; ``roscore`` is not
        needed.

        It ends with :meth:`stop`, its ``with`` block, or this process, however that ends. It is for
        this host alone unless ROS_IP or ROS_HOSTNAME say otherwise.

        :param port: its port, 0 for any free one
        :raises PortInUseError: if the port is taken
        """
        child, url = embedded_master.start(check_port('port', port))
        master = cls(url)
        master._child = child
        node_registry.at_end(master.stop)  # the child would end by itself, but perhaps after us
        return master

    def stop(self) -> None:
        """Stop this process's nodes at an embedded master, and end it. Harmless when done twice.

        :raises PharosError: if it is not embedded: other nodes need it
        """
        if self._child is None:
            raise PharosError(
                f'{self} is not embedded in this program: stop it where it was started'
            )
        node_registry.not_at_end(self.stop)
        for node in self.local_nodes():
            node_registry.stop(node)
        if self._child.returncode is None:
            embedded_master.end(self._child)

    def __enter__(self) -> 'Master':
        return self

    def __exit__(self, *error: object) -> None:
        if self._child is not None:
            self.stop()

    @tells_keywords
    def create(
        self,
        node_class: 'Callable[Init, NodeType]',
        named: str,
        domain: Optional[str] = None,
        tcp_port: int = 0,
        xmlrpc_port: int = 0,
        soul: Optional[Callable[..., Any]] = None,
        delegate: Optional[Callable[..., Any]] = None,
        argv: Optional[List[str]] = None,
        *args: 'Init.args',
        **kwargs: 'Init.kwargs',
    ) -> NodeType:
        """Create, register and start a node; returns it.

        The report (listing 3.7)::

            master create: PhaROSBlockNode named: '/myNode' domain: '127.0.0.1'
                tcpPort: 9999 xmlRpcPort: 6123 soul: [...]
            master.create(BlockNode, named='/myNode', domain='127.0.0.1',
                          tcp_port=9999, xmlrpc_port=6123, soul=...)

        :param node_class: Node, BlockNode or a subclass
        :param named: the node's name, which may carry a namespace: '/robot1/driver'
        :param domain: the address that the node advertises and, if it is loopback, the only one it
            listens on; None: what ROS_HOSTNAME, ROS_IP or the host's name say
        :param tcp_port: TCPROS port, 0 for any free one
        :param xmlrpc_port: XML-RPC port, 0 for any free one
        :param soul: block that says what the node does, called as ``soul(node)``
        :param delegate: block run for each message, called as ``delegate(message, channel)``
        :param argv: ROS remappings and private parameters (a script passes ``sys.argv``). Of
            several nodes with the same ``argv`` the first takes the ``__name`` in it, for good; the
            others keep ``named``, in the namespace of ``__ns``; all else holds for all.
            ``eye:image:=/camera/image``, ``eye:__name:=left`` and ``eye:_rate:=5`` are for the one
            whose ``named`` ends in 'eye'.
        :param args, kwargs: for the node's ``__init__``
        :raises MasterUnreachableError, NodeNameInUseError, PortInUseError: and nothing is left
            behind
        :raises ValueError: if a name, port or address cannot be one, also an address in
            ROS_HOSTNAME or ROS_IP
        """
        node = attributes.make(
            node_class,
            self,
            named,
            soul,
            delegate,
            args,
            kwargs,
            domain=domain,
            tcp_port=tcp_port,
            xmlrpc_port=xmlrpc_port,
            argv=argv,
        )
        starts.start_made(node)
        return node

    @tells_keywords
    def run(
        self,
        package: str,
        executable: str,
        *args: object,
        name: Optional[str] = None,
        remap: Optional[Dict[str, str]] = None,
        params: Optional[Dict[str, object]] = None,
        on_line: Optional[Callable[[str], Any]] = None,
    ) -> RosProcess:
        """Start a ROS program at this master, as ``rosrun`` does; returns the :class:`RosProcess`.

        :param args: its further arguments
        :param name: the name of its node, for ``__name:=``
        :param remap: ``{name: name}`` of remappings
        :param params: ``{name: value}`` of private parameters, called 'rate' or '~rate', which keep
            their types: with ``name``, they are set on the parameter server, else by the program
        :param on_line: block called as ``on_line(text)`` for each line of its output, in a thread
            of its own
        :raises UnknownNodeError: if there is no such package or program
        :raises TypeError, ValueError: if an argument, name or parameter cannot be one
        """
        return ros_process.run(self, package, executable, args, name, remap, params, on_line)

    def launch(
        self,
        package: Optional[AnyPath],
        file: Optional[AnyPath] = None,
        on_line: Optional[Callable[[str], Any]] = None,
        **args: object,
    ) -> RosProcess:
        """Start a launch file at this master, as ``roslaunch`` does; returns the
        :class:`RosProcess`.

        ``master.launch('my_robot', 'robot.launch')``, or by its path: ``master.launch(path)``.

        :param package: a ROS package; None: ``file`` is a path
        :param file: the name of the launch file in it; None: ``package`` is its path
        :param args: the launch file's arguments
        :param on_line: block called as ``on_line(text)`` for each line of its output, in a thread
            of its own
        :raises UnknownNodeError: if there is no such package or launch file
        :raises TypeError, ValueError: if what is given can be none, or an argument is None
        """
        return ros_process.launch(self, package, file, args, on_line)

    @tells_keywords
    def load(
        self,
        package: AnyPath,
        executable: Optional[str] = None,
        *args: object,
        name: Optional[str] = None,
        namespace: Optional[str] = None,
        remap: Optional[Dict[str, str]] = None,
        params: Optional[Dict[str, object]] = None,
        output: Optional[str] = None,
    ) -> 'ScriptNode':
        """Run a rospy program, unmodified, as a node of this process; returns the
        :class:`~pharos.ScriptNode`.

        It returns when the program's ``rospy.init_node`` has registered the node; see
        :meth:`ScriptNode.start`.

        :param package: where ``executable`` is, as ``rosrun`` looks it up; without that, the path
            of the program
        :param args: its further arguments
        :param name: the name of its node, for ``__name:=``; None: the one that it gives to
            ``init_node``
        :param namespace: the namespace of its node, for ``__ns:=``
        :param remap: ``{name: name}`` of remappings
        :param params: as of :meth:`run`
        :param output: 'screen': what it prints has the name of its node before each line; a path:
            it goes to that file, but for its errors; None: it goes where this program prints
        :raises UnknownNodeError: if there is no such package or program
        :raises NodeNameInUseError: if another node has its name
        :raises PharosError: if it is no Python program, or raised an exception before it was a node
        """
        node: 'ScriptNode' = on_demand.module('compose.script').load(
            self,
            package,
            executable,
            args,
            name,
            namespace,
            remap,
            params=params,
            output=output,
        )
        return node

    @tells_keywords
    def compose(
        self,
        package: Optional[AnyPath],
        file: Optional[AnyPath] = None,
        *,
        only: Collection[str] = (),
        apart: Collection[str] = (),
        share_connections: bool = False,
        **args: object,
    ) -> 'Composition':
        """Start a launch file whose Python nodes all run in this process, unmodified; returns the
        :class:`~pharos.Composition`.

        What else is in it (C++, nodes of other machines, those with a launch-prefix) runs as
        ``roslaunch`` starts it, in processes of their own. A node that cannot be started is told,
        and the others go on.

        :param package: a ROS package; None: ``file`` is a path
        :param file: the name of the launch file in it; None: ``package`` is its path
        :param only: the names of the nodes that are wanted; all, if there are none
        :param apart: the names of Python nodes that are to have processes of their own
        :param share_connections: the nodes share connections, as those of :class:`Master` with that
        :param args: the launch file's arguments
        :raises UnknownNodeError: if there is no such package, launch file, argument or node in it
        :raises PharosError: if roslaunch cannot read the file
        :raises MasterUnreachableError: if the master does not answer
        """
        composition: 'Composition' = on_demand.module('compose.composition').compose(
            self, package, file, only, apart, share_connections, args
        )
        return composition

    # -- what is there

    def nodes(self) -> List[AnyNode]:
        """All nodes: a Node where it runs in this process, an ExternalNode elsewhere."""
        local = {node.name: node for node in self.local_nodes()}
        names = {name for kind in self.system_state() for users in kind.values() for name in users}
        local.update((node.name, node) for node in self.local_nodes())  # one may just have started
        return [
            local[name] if name in local else ExternalNode(self, name) for name in sorted(names)
        ]

    def node(self, name: str) -> AnyNode:
        """The node of that name.

        :raises UnknownNodeError: if the master knows none
        """
        name = self.name_of(name, 'node')
        known = {node.name: node for node in self.nodes()}
        if name not in known:
            raise self._unknown(name, known)
        return known[name]

    def uri_of(self, name: str) -> str:
        """The URI of the XML-RPC server of the node of that name.

        :raises UnknownNodeError: if the master knows none
        :raises ValueError: if it is no text
        """
        if not isinstance(name, str):
            raise ValueError(f'a node name is a string, not {name!r}')
        try:
            return str(self.call('lookupNode', name))
        except rosgraph.MasterError:
            raise self._unknown(name, [node.name for node in self.nodes()]) from None

    def _unknown(self, name: str, known: Iterable[str]) -> UnknownNodeError:
        return UnknownNodeError(
            f'no node {name} at {self.url}{suggest(name, known)}: see rosnode list'
        )

    def wait_for_node(self, name: str, timeout: Optional[float] = None) -> AnyNode:
        """Wait until a node of that name is there, which means registered and not dead; returns it.

        :param timeout: seconds, None: without limit, 0: whether it is there now
        :raises UnknownNodeError: if it does not come in time
        :raises MasterUnreachableError: if the master has not answered in that time either
        """
        name, timeout = self.name_of(name, 'node'), check_limit('timeout', timeout)
        with time_limit(timeout):
            node: Optional[AnyNode] = self.look_until_found(
                lambda: self.live_node(name), timeout, name
            )
        if node is None:  # there was no time to look
            with time_limit(MARGIN):
                node = self.live_node(name)
        if node is None:
            self.call('getPid', timeout=MARGIN)
            raise UnknownNodeError(
                f'no node {name} came to {self.url} within {timeout:g} s: is it started, with that'
                ' master, and under that name?'
            )
        return node

    def live_node(self, name: str) -> Optional[AnyNode]:
        """The node of that name, if it is there; one that only starts, has died or is unknown is
        not: None."""
        for node in self.local_nodes():
            if node.name == name:
                return node if node.is_running and node.uri else None
        return ExternalNode(self, name) if self.is_node_alive(name, or_busy=True) else None

    def on_change(self, block: Callable[[str, str, bool], Any]) -> Callable[[], None]:
        """Run ``block(kind, name, is_there)`` for each node, topic and service that comes or goes.

        ``kind`` is 'node', 'topic' or 'service'. It runs in the thread that watches the master,
        within a second, and may raise: that ends nothing. Returns a function that ends it. What is
        there by now has not come; a master that is away is taken for one that has nothing yet.
        """
        if block is None:
            raise TypeError('on_change needs a block to run, called as block(kind, name, is_there)')
        return watcher_of(self).listen(check_block(block, 'block', ('kind', 'name', 'is_there')))

    @property
    def parameters(self) -> Parameters:
        """The parameter server as a mapping: ``master.parameters['/rosdistro']``."""
        return Parameters(self)

    def local_nodes(self) -> List[Node]:
        """The nodes of this process at this master."""
        return [node for node in node_registry.nodes() if node.master == self]

    def topics(self) -> List[Topic]:
        """All topics that somebody publishes on or is interested in."""
        publishers, subscribers, _ = self.system_state()
        return [Topic(self, name) for name in sorted({*publishers, *subscribers})]

    def topic(self, name: str) -> Topic:
        """The topic of that name, whether anybody uses it yet or not."""
        return Topic(self, self.name_of(name, 'topic'))

    def __repr__(self) -> str:
        return f'<Master {self.url}>'
