"""One look at the graph of a ROS master: hosts, processes, nodes, topics, services, connections."""
import dataclasses
import socket
import time
from typing import Any, Dict, Iterable, List, Optional, Set, Tuple

import rosgraph

from pharos.live.answers import ALIVE, DEAD, SILENT, Answer, ask_all
from pharos.master import Master

__all__ = ['ALIVE', 'DEAD', 'SILENT', 'Snapshot', 'take', 'rates']

TIMEOUT = 1.0  # seconds that all nodes have to answer, together
HERE = socket.gethostname()  # the name of the host that this program runs on


@dataclasses.dataclass(frozen=True)
class Connection:
    """What carries the messages of a topic from one node to another."""

    topic: str
    publisher: str  # the name of a node; its URI where the master knows none there
    subscriber: str
    transport: str  # 'INTRAPROCESS', 'TCPROS' or 'UDPROS'
    # messages and bytes since it was made, as each end counts them; None: it does not say, or was
    # not asked
    sent: Optional[int] = None
    received: Optional[int] = None
    bytes_sent: Optional[int] = None
    bytes_received: Optional[int] = None

    @property
    def key(self) -> Tuple[str, str, str, str]:
        """What it has in common with itself in another snapshot."""
        return self.topic, self.publisher, self.subscriber, self.transport

    def messages_since(self, before: Optional['Connection']) -> Optional[int]:
        """How many messages have come through since an earlier look; None: it is not known.

        What one end counts is compared with what the same counted before. One that counts less is
        connected anew.
        """
        if before is None:
            return None
        for count, former in (self.received, before.received), (self.sent, before.sent):
            if count is not None and former is not None and count >= former:
                return count - former
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

    def transports(self, topic: str, node: str) -> Set[str]:
        """The transports by which a node's messages of a topic come and go."""
        return {
            each.transport
            for each in self.connections
            if each.topic == topic and node in (each.publisher, each.subscriber)
        }


def take(master: Master, timeout: float = TIMEOUT, counts: bool = False) -> Snapshot:
    """Ask the master, and all nodes at once; returns the :class:`Snapshot`.

    Nodes that do not answer are in it, too, and marked so. It may be called in any thread.

    :param timeout: seconds that all nodes have to answer, together
    :param counts: ask them, too, what has come through their connections; nodes count that anyway
    :raises MasterUnreachableError: if the master does not answer
    """
    publishers, subscribers, services = master.system_state()
    types = dict(master.topic_types())
    now = time.time()
    kinds = (publishers, subscribers, services)
    names = sorted({name for kind in kinds for users in kind.values() for name in users})
    uris = _uris_of(master, names)
    own = {node.name: node for node in master.local_nodes() if uris.get(node.name) == node.uri}
    answers = ask_all(uris, own, timeout, counts)
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


def _connections(uris: Dict[str, Optional[str]], answers: Dict[str, Answer]) -> List[Connection]:
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
            for what, count in end.counts.items():
                counted[what] = counted.get(what, 0) + count  # there may be two
    return [Connection(*each, **counted) for each, counted in sorted(found.items())]


def rates(before: Snapshot, after: Snapshot) -> Dict[str, float]:
    """``{topic: messages a second}`` between two snapshots taken with ``counts``.

    Of a topic that nobody hears nothing is counted, and so nothing told; of one with several
    publishers, those of all of them are.
    """
    seconds = after.time - before.time
    former = {each.key: each for each in before.connections}
    fastest: Dict[Tuple[str, str], float] = {}  # (topic, publisher) -> rate, of its best connection
    for connection in after.connections:
        count = connection.messages_since(former.get(connection.key))
        if count is not None and seconds > 0:
            ends = connection.topic, connection.publisher
            fastest[ends] = max(fastest.get(ends, 0.0), count / seconds)
    found: Dict[str, float] = {}
    for (topic, _), rate in fastest.items():
        found[topic] = found.get(topic, 0.0) + rate
    return found
