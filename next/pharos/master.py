"""The Master: the proxy of a ROS master, which creates nodes and finds those of others."""
from __future__ import annotations

import atexit
import collections.abc
import contextlib
import os
import re
import subprocess
import sys
import urllib.parse
from typing import Any, Iterator, Sequence

import rosgraph.names

from pharos import program
from pharos.blocks import Block
from pharos.channels import Topic, refuses
from pharos.errors import (
    MasterUnreachableError,
    PortInUseError,
    UnknownNodeError,
    UnknownServiceError,
)
from pharos.external_node import ExternalNode
from pharos.node import Node
from pharos.parameter import check_value
from pharos.private_rospy.run import UNREACHABLE, ServerProxy
from pharos.ros_process import RosProcess, find_launch_file, find_program
from pharos.service import Service

CALLER_ID = '/pharos'
_DOMAIN = re.compile(r'[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?|[0-9A-Fa-f:]+')
_first_with: dict[tuple[str, ...], Node] = {}  # argv -> the first node that was created with it


class Parameters(collections.abc.MutableMapping):
    """The parameter server as a mapping: names to values."""

    def __init__(self, master: Master):
        self._master = master

    def __getitem__(self, name: str) -> Any:
        name = self._checked(name)
        if not self._master.call('hasParam', name):
            raise KeyError(name)
        return self._master.call('getParam', name)

    def __setitem__(self, name: str, value: Any) -> None:
        check_value(name, value)
        self._master.call('setParam', self._checked(name), value)

    def __delitem__(self, name: str) -> None:
        self[name]
        self._master.call('deleteParam', name)

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self._master.call('getParamNames')))

    def __len__(self) -> int:
        return len(self._master.call('getParamNames'))

    def _checked(self, name: Any) -> str:
        if not isinstance(name, str) or not rosgraph.names.is_legal_name(name):
            raise ValueError(f'{name!r} cannot be the name of a parameter: give one such as /rate')
        return rosgraph.names.make_global_ns(name).rstrip('/') or '/'


class Master:
    """A ROS master, by its URL. Makes no connection yet.

    The report: ``PhaROSMaster url: 'http://127.0.0.1:11311/'``::

        master = Master('http://127.0.0.1:11311/')

    :param url: default: ROS_MASTER_URI, else ROS's default
    :param share_connections: nodes of this process that receive from one external publisher on one
        topic share a connection
    :raises ValueError: if the URL is malformed
    """

    def __init__(self, url: str | None = None, share_connections: bool = False):
        url = url or os.environ.get('ROS_MASTER_URI') or 'http://localhost:11311/'
        try:
            parts = urllib.parse.urlsplit(url)
            host, port = parts.hostname, parts.port
        except (ValueError, TypeError, AttributeError):
            host = port = None
        if (
            not host
            or ' ' in host
            or not port
            or parts.scheme != 'http'
            or parts.path not in ('', '/')
        ):
            raise ValueError(
                f"{url!r} cannot be the URL of a master: give one such as 'http://127.0.0.1:11311/'"
            )
        host = f'[{host}]' if ':' in host else '127.0.0.1' if host == 'localhost' else host
        self.url, self.share_connections = f'http://{host}:{port}/', share_connections
        self.parameters = Parameters(self)
        self._process: subprocess.Popen | None = None
        program.handle_signals()

    # -- a master of one's own

    @classmethod
    def embedded(cls, port: int = 0) -> Master:
        """Start a ROS master as a child of this process.

        :meth:`stop`, the end of its ``with`` block, or that of this process ends it.

        :param port: 0: any free one
        :raises PortInUseError: if the port is taken
        """
        environ = dict(os.environ, PYTHONPATH=os.pathsep.join(path for path in sys.path if path))
        environ.setdefault('ROS_HOSTNAME', environ.pop('ROS_IP', '127.0.0.1'))
        pipes = {'stdin': subprocess.PIPE, 'stdout': subprocess.PIPE, 'text': True}
        command = [sys.executable, '-m', 'pharos.master_program', str(port)]
        process = subprocess.Popen(command, env=environ, start_new_session=True, **pipes)
        url = process.stdout.readline().strip()
        if not url.startswith('http://'):
            process.communicate()
            if url == 'busy':
                raise PortInUseError(f'port {port} is in use: choose another one, or 0 for any')
            raise MasterUnreachableError('no master could start: is python3-rosmaster installed?')
        master = cls(url)
        master._process = process
        atexit.register(master.stop)
        return master

    def stop(self) -> None:
        """End an embedded master, and do nothing to another."""
        atexit.unregister(self.stop)
        process, self._process = self._process, None
        if process:
            for node in self.own_nodes():
                node.end_now()
            process.stdin.close()
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            process.stdout.close()

    def __enter__(self) -> Master:
        return self

    def __exit__(self, *error: Any) -> None:
        self.stop()

    # -- asking

    def call(self, method: str, *args: Any, caller_id: str = CALLER_ID) -> Any:
        """Call a method of the master's API; returns its value, None if it says no.

        :raises MasterUnreachableError: if it does not answer within 5 s
        """
        try:
            code, _, value = getattr(ServerProxy(self.url), method)(caller_id, *args)
        except UNREACHABLE as error:
            raise MasterUnreachableError(
                f'no ROS master answers at {self.url} ({error}): start roscore, or give the right URL'
            ) from None
        return value if code == 1 else None

    def is_reachable(self) -> bool:
        """True if it answers."""
        try:
            return bool(self.pid)
        except MasterUnreachableError:
            return False

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it answers, and return True.

        :param timeout: seconds, None: without limit
        :raises MasterUnreachableError: if it does not answer in time
        """
        program.wait(self.is_reachable, timeout)
        return bool(self.pid)

    @property
    def pid(self) -> int:
        """The number of its process, on its host."""
        return self.call('getPid')

    def system_state(self) -> tuple[dict[str, list[str]], ...]:
        """Return ``(publishers, subscribers, services)``, each ``{name: [node names]}``."""
        return tuple(map(dict, self.call('getSystemState')))

    def topic_type(self, name: str) -> str | None:
        """Return the type of a topic, None if the master knows none."""
        return dict(self.call('getTopicTypes')).get(name)

    def topics(self) -> list[Topic]:
        """Return all topics."""
        publishers, subscribers, _ = self.system_state()
        return [Topic(self, name) for name in sorted({**publishers, **subscribers})]

    def topic(self, name: str) -> Topic:
        """Return the topic of that name, which need not exist yet."""
        if not isinstance(name, str) or not rosgraph.names.is_legal_name(name):
            raise ValueError(f'{name!r} cannot be the name of a topic: give one such as /pose')
        return Topic(self, rosgraph.names.make_global_ns(name).rstrip('/'))

    # -- nodes

    def create(
        self,
        node_class: type[Node],
        named: str,
        domain: str | None = None,
        tcp_port: int = 0,
        xmlrpc_port: int = 0,
        soul: Block | None = None,
        delegate: Block | None = None,
        argv: Sequence[str] | None = None,
        **kwargs: Any,
    ) -> Any:
        """Create a node, register and start it, and return it.

        The report: ``master create: Driver named: '/driver' domain: '127.0.0.1' tcpPort: 8080
        xmlRpcPort: 8081``.

        :param named: its name, perhaps with a namespace: '/robot1/driver'
        :param domain: the address that it advertises; if it is loopback, the only one that it
            listens on; default: what ROS_HOSTNAME, ROS_IP or the host say
        :param tcp_port: 0: any free one, as ``xmlrpc_port``
        :param argv: ROS's remappings and private parameters; a script passes ``sys.argv``
        :param kwargs: what the ``__init__`` of the class takes
        :raises NodeNameInUseError, PortInUseError, MasterUnreachableError: and nothing is left
        """
        if not (isinstance(node_class, type) and issubclass(node_class, Node)):
            raise TypeError(f'a node is made of a subclass of Node, not {node_class!r}')
        if domain is not None and not (isinstance(domain, str) and _DOMAIN.fullmatch(domain)):
            raise ValueError(f'{domain!r} cannot be an address: give one such as 127.0.0.1')
        for port in tcp_port, xmlrpc_port:
            if not (isinstance(port, int) and 0 <= port < 65536):
                raise ValueError(f'{port!r} cannot be a port: give 0 to 65535')
        mappings = [arg for arg in argv or () if rosgraph.names.is_legal_remap(arg)]
        name, remappings = self._named(self.node_name(named), mappings)
        node = node_class.__new__(node_class)
        node._configure(self, name, soul, delegate, domain, (tcp_port, xmlrpc_port), remappings)
        if name != named and any(arg.startswith('__name:=') for arg in mappings):
            _first_with[tuple(mappings)] = node
        node.__init__(**kwargs)
        try:
            node.start()
        except BaseException:
            node.end_now()
            raise
        return node

    def node_name(self, name: Any) -> str:
        """Return the name if it can be a node's.

        :raises ValueError: if it cannot
        """
        if not (
            isinstance(name, str) and re.fullmatch(r'/?[A-Za-z]\w*(/[A-Za-z]\w*)*', name, re.A)
        ):
            raise ValueError(
                f'{name!r} cannot be the name of a node: give one such as /robot1/driver'
            )
        return name

    def _named(self, name: str, mappings: list[str]) -> tuple[str, list[str]]:
        """Return the full name of a new node, and the remappings that are left for rospy."""
        given = dict(arg.split(':=', 1) for arg in mappings)
        namespace, _, base = name.rpartition('/')
        if not name.startswith('/'):
            outer = given.get('__ns') or os.environ.get('ROS_NAMESPACE', '/')
            namespace = rosgraph.names.ns_join(rosgraph.names.make_global_ns(outer), namespace)
        elif '__ns' in given:
            namespace = rosgraph.names.make_global_ns(given['__ns'])
        first = _first_with.get(tuple(mappings))
        if '__name' in given and (
            first is None or first.master.url != self.url or not first.is_running
        ):
            base = self.node_name(given['__name'])
        rest = [arg for arg in mappings if not arg.startswith(('__name:=', '__ns:='))]
        return f'{namespace.rstrip("/")}/{base}', rest

    def own_nodes(self) -> list[Node]:
        """Return the nodes of this process that run at this master."""
        return [node for node in program.nodes if node.master.url == self.url]

    def nodes(self) -> list[Node | ExternalNode]:
        """Return all nodes, of this process and others."""
        names = {name for kind in self.system_state() for users in kind.values() for name in users}
        found = []
        for name in sorted(names):
            with contextlib.suppress(UnknownNodeError):  # it has gone meanwhile
                found.append(self.node(name))
        return found

    def node(self, name: str) -> Node | ExternalNode:
        """Return the node of that name.

        :raises UnknownNodeError: if there is none
        """
        name = rosgraph.names.make_global_ns(self.node_name(name)).rstrip('/')
        for node in self.own_nodes():
            if node.name == name:
                return node
        external = ExternalNode(self, name)
        external.uri  # raises if there is none
        return external

    def may_live(self, name: str) -> bool:
        """False if the node of that name refuses connections, or is not registered."""
        uri = self.call('lookupNode', name)
        return bool(uri) and not refuses(uri)

    def wait_for_node(self, name: str, timeout: float | None = None) -> Node | ExternalNode:
        """Wait until a node of that name is there, and return it.

        :raises UnknownNodeError: if it does not come in time
        """

        def find():
            with contextlib.suppress(UnknownNodeError, MasterUnreachableError):
                return self.node(name)

        return program.wait(find, timeout) or self.node(name)

    # -- services

    def services(self) -> list[str]:
        """Return the names of all services."""
        return sorted(self.system_state()[2])

    def lookup_service(self, name: str, caller_id: str = CALLER_ID) -> Service:
        """Return the service of that name, to be called.

        The report: ``master lookupService: '/clear' with: '/myID'``.

        :raises UnknownServiceError: if nobody offers it
        """
        if not isinstance(name, str) or not rosgraph.names.is_legal_name(name):
            raise ValueError(f'{name!r} cannot be the name of a service: give one such as /clear')
        return Service(self, rosgraph.names.make_global_ns(name).rstrip('/'), caller_id)

    def wait_for_service(
        self, name: str, timeout: float | None = None, caller_id: str = CALLER_ID
    ) -> Service:
        """Wait until a service is offered, and return it.

        :raises UnknownServiceError: if it is not in time
        """

        def find():
            with contextlib.suppress(UnknownServiceError, MasterUnreachableError, OSError):
                return self.lookup_service(name, caller_id)

        return program.wait(find, timeout) or self.lookup_service(name, caller_id)

    # -- programs

    def run(self, package: str, executable: str, *args: Any, on_line: Any = None) -> RosProcess:
        """Run a program of ROS at this master, as rosrun does.

        :param on_line: ``on_line(text)`` is called for each line that it prints
        """
        path = find_program(package, executable)
        return RosProcess([path, *map(str, args)], self.url, on_line)

    def launch(
        self, package: str | None, file: str, on_line: Any = None, **args: Any
    ) -> RosProcess:
        """Run a launch file at this master, as roslaunch does; ``package`` None: it is a path."""
        path = find_launch_file(package, file)
        arguments = [f'{name}:={value}' for name, value in args.items()]
        roslaunch = [sys.executable, '-c', 'import roslaunch; roslaunch.main()', '--skip-log-check']
        return RosProcess([*roslaunch, path, *arguments], self.url, on_line)

    def graph(self, seconds: float = 0) -> Any:
        """Return the :class:`Graph` of all nodes and topics, with rates if it looks for a while."""
        from pharos.live.graph import graph_of

        return graph_of(self, seconds)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Master) and self.url == other.url

    def __hash__(self) -> int:
        return hash(self.url)

    def __repr__(self) -> str:
        return f'<Master {self.url}>'
