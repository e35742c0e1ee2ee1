"""One look at the graph of a ROS master: hosts, processes, nodes, topics, services, connections."""
import dataclasses
import os
import socket
import threading
import time
import urllib.parse
from typing import Any, Dict, Iterable, List, Optional, Set, Tuple

import rosgraph
import rosgraph.network

from pharos.errors import PharosError
from pharos.external_node import node_api
from pharos.master import Master
from pharos.node import Node

TIMEOUT = 1.0  # seconds that all nodes have to answer, together

ALIVE = 'alive'
SILENT = 'silent'  # it does not answer in time: too busy, stopped by a debugger, or out of reach
DEAD = 'dead'  # nobody is at its address any more, though the master has it still

CALLER = '/pharos'
HERE = socket.gethostname()  # the name of the host that this program runs on
INBOUND = 'i'  # the direction of a connection, in getBusInfo


@dataclasses.dataclass(frozen=True)
class Connection:
    """What carries the messages of a topic from one node to another."""

    topic: str
    publisher: str  # the name of a node; its URI where the master knows none there
    subscriber: str
    transport: str  # 'INTRAPROCESS', 'TCPROS' or 'UDPROS'


@dataclasses.dataclass(frozen=True)
class SeenNode:
    """A node, whether it answers or not."""

    name: str
    uri: Optional[str]  # of its XML-RPC server; None: the master does not know it any more
    host: str  # the name of a :class:`Host`
    pid: Optional[int]  # on its host; None: it does not say
    state: str  # ALIVE, SILENT or DEAD
    problem: str  # why it is not ALIVE, or does not tell its connections; '' for nothing
    is_own: bool  # whether it runs in this process
    publishes: List[str]  # topics
    hears: List[str]  # topics
    offers: List[str]  # services


@dataclasses.dataclass(frozen=True)
class SeenTopic:
    """A topic that somebody publishes or hears."""

    name: str
    type: Optional[str]  # None: nobody has named it
    publishers: List[str]  # names of nodes
    subscribers: List[str]


@dataclasses.dataclass(frozen=True)
class SeenService:
    """A service that somebody offers."""

    name: str
    providers: List[str]  # names of nodes


@dataclasses.dataclass(frozen=True)
class Process:
    """A process that runs nodes; one of which no process id is known is taken for one node's."""

    pid: Optional[int]
    nodes: List[str]


@dataclasses.dataclass(frozen=True)
class Host:
    """A computer that runs nodes, called as they call it; all its names and addresses mean one.

    That of this program is called by its own name. Containers that share its network count to it.
    """

    name: str
    is_here: bool  # whether it is the computer that this program runs on
    processes: List[Process]


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """What the graph of a master was at a time; see :func:`take`.

    All in it are plain values: ``dataclasses.asdict(snapshot)`` is ready for JSON.
    """

    master: str  # its URL
    time: float  # seconds, as of time.time()
    hosts: List[Host]
    nodes: Dict[str, SeenNode]
    topics: Dict[str, SeenTopic]
    services: Dict[str, SeenService]
    connections: List[Connection]

    def transports(self, topic: str, node: str) -> Set[str]:
        """The transports by which a node's messages of a topic come and go."""
        return {
            each.transport
            for each in self.connections
            if each.topic == topic and node in (each.publisher, each.subscriber)
        }


@dataclasses.dataclass
class _Answer:
    """What a node has said so far; filled in by a thread of its own."""

    host: str  # as the node calls it
    address: Optional[str] = None  # of the host; None: not known
    is_here: bool = False
    pid: Optional[int] = None
    bus_info: Optional[List[List[Any]]] = None  # as of getBusInfo
    error: Optional[Exception] = None

    @property
    def state(self) -> str:
        if self.bus_info is not None:
            return ALIVE
        is_dead = isinstance(self.error, (ConnectionRefusedError, socket.gaierror))
        return DEAD if is_dead else SILENT

    @property
    def problem(self) -> str:
        if self.bus_info is not None:
            return ''
        return 'it has not answered in time' if self.error is None else str(self.error)


def take(master: Master, timeout: float = TIMEOUT) -> Snapshot:
    """Ask the master, and all nodes at once; returns the :class:`Snapshot`.

    Nodes that do not answer are in it, too, and marked so. It may be called in any thread.

    :param timeout: seconds that all nodes have to answer, together
    :raises MasterUnreachableError: if the master does not answer
    """
    publishers, subscribers, services = master.system_state()
    types = dict(master.topic_types())
    now = time.time()
    kinds = (publishers, subscribers, services)
    names = sorted({name for kind in kinds for users in kind.values() for name in users})
    uris = _uris_of(master, names)
    own = {node.name: node for node in master.local_nodes() if uris.get(node.name) == node.uri}
    answers = _ask_all(uris, own, timeout)
    hosts = _names_of_hosts(answers)
    nodes = {
        name: SeenNode(
            name,
            uris[name],
            hosts[name],
            answers[name].pid,
            answers[name].state,
            answers[name].problem,
            name in own,
            *[sorted(what for what, users in kind.items() if name in users) for kind in kinds],
        )
        for name in names
    }
    return Snapshot(
        master=master.url,
        time=now,
        hosts=_hosts(nodes),
        nodes=nodes,
        topics={
            name: SeenTopic(
                name,
                None if types.get(name) == rosgraph.names.ANYTYPE else types.get(name),
                sorted(publishers.get(name, [])),
                sorted(subscribers.get(name, [])),
            )
            for name in sorted({*publishers, *subscribers})
        },
        services={name: SeenService(name, sorted(services[name])) for name in sorted(services)},
        connections=_connections(uris, answers),
    )


def _uris_of(master: Master, names: Iterable[str]) -> Dict[str, Optional[str]]:
    """The URI of each node; None where the master has forgotten it meanwhile."""
    api = master.api()
    uris: Dict[str, Optional[str]] = {}
    with master.reached():
        for name in names:
            try:
                uris[name] = str(api.lookupNode(name))
            except rosgraph.MasterError:
                uris[name] = None
    return uris


# -- what the nodes say


def _ask_all(
    uris: Dict[str, Optional[str]], own: Dict[str, Node], timeout: float
) -> Dict[str, _Answer]:
    """What the nodes at these URIs say until ``timeout`` seconds are over.

    Each has a thread, which is left to itself where it takes longer: looking up the name of a host
    has no limit of its own.
    """
    deadline = time.monotonic() + timeout
    answers = {name: _Answer(_host_name(uri)) for name, uri in uris.items()}
    threads = [
        threading.Thread(
            target=_ask,
            args=(answers[name], uri, own.get(name), timeout),
            name=f'snapshot of {name}',
            daemon=True,
        )
        for name, uri in uris.items()
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(0.0, deadline - time.monotonic()))
    return {name: dataclasses.replace(answer) for name, answer in answers.items()}


def _ask(answer: _Answer, uri: Optional[str], own: Optional[Node], timeout: float) -> None:
    """Fill in the answer of a node, for up to ``timeout`` seconds a call."""
    try:
        if uri is None:
            raise ConnectionRefusedError('the master does not know it any more')
        if own is not None:
            answer.is_here, answer.pid = True, os.getpid()
            answer.bus_info = own.current_run.rospy.topics.get_pub_sub_info()
            return
        answer.is_here, answer.address = _locate(answer.host)
        api = node_api(uri, timeout)
        answer.pid = int(_value(api.getPid(CALLER)))
        answer.bus_info = list(_value(api.getBusInfo(CALLER)))
    except Exception as error:  # whatever it answers, it is one node of many
        answer.error = error


def _value(answer: Any) -> Any:
    """The value in an answer of ROS's slave API: a code (1: done), a text, the value."""
    code, text, value = answer
    if code != 1:
        raise PharosError(str(text))
    return value


def _host_name(uri: Optional[str]) -> str:
    return urllib.parse.urlsplit(uri or '').hostname or 'unknown'


def _locate(host: str) -> Tuple[bool, str]:
    """``(whether it is this computer, its address)``."""
    address = str(socket.getaddrinfo(host, None)[0][4][0])
    return rosgraph.network.is_local_address(host), address


# -- what is made of it


def _names_of_hosts(answers: Dict[str, _Answer]) -> Dict[str, str]:
    """The name of the host of each node: one for all names of an address."""
    names: Dict[Optional[str], str] = {}
    for answer in answers.values():
        names.setdefault(answer.address or answer.host, answer.host)
    return {
        name: HERE if answer.is_here else names[answer.address or answer.host]
        for name, answer in answers.items()
    }


def _hosts(nodes: Dict[str, SeenNode]) -> List[Host]:
    """The hosts of the nodes, this one first, and their processes."""
    processes: Dict[str, Dict[Any, List[str]]] = {}
    for name, node in nodes.items():
        key = name if node.pid is None else node.pid
        processes.setdefault(node.host, {}).setdefault(key, []).append(name)
    return [
        Host(
            host,
            host == HERE,
            [Process(nodes[names[0]].pid, names) for names in processes[host].values()],
        )
        for host in sorted(processes, key=lambda host: (host != HERE, host))
    ]


def _connections(uris: Dict[str, Optional[str]], answers: Dict[str, _Answer]) -> List[Connection]:
    """The connections, of which one end says at least that it has them.

    A publisher calls the other end by the name of the node, a subscriber by the URI.
    """
    names = {uri.rstrip('/'): name for name, uri in uris.items() if uri}
    found = set()
    for name, answer in answers.items():
        for _, other, direction, transport, topic, *more in answer.bus_info or ():
            if more and not more[0]:  # it is not connected (yet)
                continue
            other = names.get(str(other).rstrip('/'), other)
            ends = (other, name) if direction == INBOUND else (name, other)
            found.add((topic, *ends, transport))
    return [Connection(*each) for each in sorted(found)]
