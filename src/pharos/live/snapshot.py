"""One look at the graph of a ROS master: hosts, processes, nodes, topics, services, connections."""
import dataclasses
import functools
import socket
import time
import xmlrpc.client
from typing import Any, Dict, Iterable, List, Optional, Set, Tuple

import rosgraph

from pharos.live.answers import ALIVE, DEAD, SILENT, Answer, Count, ask_all
from pharos.master import Master

__all__ = ['ALIVE', 'DEAD', 'SILENT', 'Snapshot', 'take']

TIMEOUT = 1.0  # seconds that all nodes have to answer, together
HERE = socket.gethostname()  # the name of the host that this program runs on


@dataclasses.dataclass(frozen=True)
class Connection:
    """What carries the messages of a topic from one node to another."""

    topic: str
    publisher: str  # the name of a node; its URI where the master knows none there
    subscriber: str
    transport: str  # 'INTRAPROCESS', 'TCPROS' or 'UDPROS'
    # what each end has counted; None: it does not say, or was not asked
    sent: Optional[Count] = None
    received: Optional[Count] = None

    @property
    def key(self) -> Tuple[str, str, str, str]:
        """What it has in common with itself in another snapshot."""
        return self.topic, self.publisher, self.subscriber, self.transport

    def rates_since(self, before: Optional['Connection']) -> Optional[Tuple[float, float]]:
        """Messages and bytes a second since an earlier look; None: they are not known.

        What one end counts is compared with what the same counted before.
        """
        if before is None:
            return None
        for count, former in (self.received, before.received), (self.sent, before.sent):
            found = count.rates_since(former) if count and former else None
            if found is not None:
                return found
        return None


@dataclasses.dataclass(frozen=True)
class SeenNode:
    """A node, whether it answers or not."""

    name: str
    uri: Optional[str]  # of its XML-RPC server; None: the master does not know it any more
    host: str  # the name of a :class:`Host`
    pid: Optional[int]  # on its host; None: it does not say
    state: str  # ALIVE, SILENT or DEAD
    problem: str  # why it is not ALIVE; '' for nothing
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

    #: what nodes of pharos tell of their health, by their names, if they were asked
    health: Dict[str, Dict[str, Any]] = dataclasses.field(default_factory=dict)

    @functools.cached_property
    def transports(self) -> Dict[Tuple[str, str, str], Set[str]]:
        """``{(topic, publisher, subscriber): by which messages go}``, where they are connected."""
        found: Dict[Tuple[str, str, str], Set[str]] = {}
        for each in self.connections:
            found.setdefault((each.topic, each.publisher, each.subscriber), set()).add(
                each.transport
            )
        return found


def take(
    master: Master,
    timeout: float = TIMEOUT,
    counts: bool = False,
    plain: Optional[Set[str]] = None,
) -> Snapshot:
    """Ask the master, and all nodes at once; returns the :class:`Snapshot`.

    Nodes that do not answer are in it, too, and marked so. It may be called in any thread.

    :param timeout: seconds that all nodes have to answer, together
    :param counts: ask them, too, what has come through their connections; nodes count that anyway
    :param plain: ask them for their health, too, but for those that are known not to be of pharos:
        these are their URIs, to which those found out now are added
    :raises MasterUnreachableError: if the master does not answer
    """
    publishers, subscribers, services = master.system_state()
    types = dict(master.topic_types())
    now = time.time()
    kinds = (publishers, subscribers, services)
    names = sorted({name for kind in kinds for users in kind.values() for name in users})
    uris = uris_of(master, names)
    own = {node.name: node for node in master.local_nodes() if uris.get(node.name) == node.uri}
    answers = ask_all(uris, own, timeout, counts, plain)
    hosts = _names_of_hosts(answers)
    uses = [_by_node(kind) for kind in kinds]
    nodes = {
        name: SeenNode(
            name,
            uris[name],
            hosts[name],
            answers[name].pid,
            answers[name].state,
            answers[name].problem,
            name in own,
            *[use.get(name, []) for use in uses],
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
        connections=connections_of(uris, answers),
        health={name: each.health for name, each in answers.items() if each.health},
    )


def uris_of(master: Master, names: Iterable[str]) -> Dict[str, Optional[str]]:
    """The URI of each node, asked for in one call, which roslaunch makes, too; None where the master
    has forgotten it meanwhile.

    :raises MasterUnreachableError: if the master does not answer
    """
    names = list(names)
    if not names:
        return {}
    api = master.api()
    with master.reached():
        questions = xmlrpc.client.MultiCall(api.handle)
        for name in names:
            questions.lookupNode(api.caller_id, name)
        answers: Any = questions()
        uris: Dict[str, Optional[str]] = {}
        for index, name in enumerate(names):
            code, _, uri = answers[index]
            uris[name] = str(uri) if code == 1 else None
    return uris


def _by_node(kind: Dict[str, List[str]]) -> Dict[str, List[str]]:
    """``{node: what it uses}``, where the master tells who uses what."""
    found: Dict[str, List[str]] = {}
    for what in sorted(kind):
        for name in {*kind[what]}:
            found.setdefault(name, []).append(what)
    return found


def _names_of_hosts(answers: Dict[str, Answer]) -> Dict[str, str]:
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


def connections_of(uris: Dict[str, Optional[str]], answers: Dict[str, Answer]) -> List[Connection]:
    """The connections, of which one end says at least that it has them.

    A publisher calls the other end by the name of the node, a subscriber by the URI.
    """
    names = {uri.rstrip('/'): name for name, uri in uris.items() if uri}
    found: Dict[Tuple[str, str, str, str], Dict[str, Any]] = {}
    for name, answer in answers.items():
        for end in answer.ends or ():
            other = names.get(end.other.rstrip('/'), end.other)
            ends = (other, name) if end.is_inbound else (name, other)
            counted = found.setdefault((end.topic, ends[0], ends[1], end.transport), {})
            if end.counted is not None:
                side = 'received' if end.is_inbound else 'sent'
                former = counted.get(side)
                counted[side] = end.counted if former is None else former + end.counted
    return [Connection(*each, **counted) for each, counted in sorted(found.items())]
