"""What nodes, processes and topics of a graph are doing just now: what ``rosrun pharos top`` shows.

Nodes count what comes and goes in any case, so that two looks make rates, and nothing is subscribed
to; where nobody looks, nothing is done. What blocks failed at, and channels dropped, nodes of pharos
tell when they are asked; of CPU and memory the system tells, for the processes of this host.
"""
import collections
import dataclasses
import fnmatch
import time
from typing import Any, Collection, DefaultDict, Dict, Iterable, List, Optional, Set, Tuple

import psutil

from pharos.live.probing import Probes
from pharos.live.snapshot import Snapshot, take
from pharos.live.traffic import Traffic
from pharos.lookers import is_looker
from pharos.master import Master
from pharos.probe import Look
from pharos.seconds import check_seconds

TIMEOUT = 1.0  # seconds that all nodes have to answer
# what a process does, as its nodes do it
_SUMMED = 'received', 'sent', 'bytes_received', 'bytes_sent', 'dropped', 'failures'


@dataclasses.dataclass(frozen=True)
class NodeRow:
    """A node. What is not known of it is None."""

    name: str
    host: str
    pid: Optional[int]
    state: str  #: 'alive', 'silent' (it does not answer in time) or 'dead' (nobody is there)
    class_name: Optional[str]  #: of a node of pharos
    received: Optional[float]  #: messages a second
    sent: Optional[float]  #: messages a second, however many hear them
    bytes_received: Optional[float]  #: bytes a second through sockets
    bytes_sent: Optional[float]  #: to all who hear them
    intraprocess: int  #: connections
    tcpros: int  #: connections, those by UDPROS among them
    dropped: Optional[int]  #: messages, by its channels
    failures: Optional[int]  #: of its blocks
    threads: Optional[int]  #: of the node
    souls: Optional[int]  #: in threads of their own


@dataclasses.dataclass(frozen=True)
class ProcessRow:
    """A process that runs nodes. What is not known of it, such as of another host's, is None."""

    pid: Optional[int]
    host: str
    nodes: List[str]
    cpu: Optional[float]  #: percent of one processor
    memory: Optional[int]  #: bytes that are in memory
    threads: Optional[int]
    received: Optional[float]  #: these, as its nodes'
    sent: Optional[float]
    bytes_received: Optional[float]
    bytes_sent: Optional[float]
    dropped: Optional[int]
    failures: Optional[int]


@dataclasses.dataclass(frozen=True)
class TopicRow:
    """A topic."""

    name: str
    type: Optional[str]  #: None: nobody has named it
    publishers: List[str]
    subscribers: List[str]
    rate: Optional[float]  #: messages a second; None: nobody hears them, or they are not counted
    bandwidth: Optional[float]  #: bytes a second that one subscriber gets through a socket
    intraprocess: int  #: connections
    tcpros: int  #: connections, those by UDPROS among them
    dropped: Optional[int]  #: messages, by channels of nodes of pharos


@dataclasses.dataclass(frozen=True)
class Measurement:
    """What the graph of a master did for a while.

    All in it are plain values: ``dataclasses.asdict(measurement)`` is what ``top --json`` prints.
    """

    master: str  #: its URL
    time: float  #: its end, in seconds as of time.time()
    seconds: Optional[float]  #: that it took; None: it is a first look, and there are no rates
    is_measured: bool  #: whether rates of topics are those of subscriptions made for that
    nodes: List[NodeRow]
    processes: List[ProcessRow]
    topics: List[TopicRow]


def measure(
    master: Master, seconds: float = 1.0, names: Collection[str] = (), probes: bool = False
) -> Measurement:
    """Look twice, and tell what has happened in between.

    :param names: those that are wanted; see :func:`is_wanted`
    :param probes: subscribe to all topics that are wanted meanwhile, also to those that nobody
        hears: their rates are measured then, which costs what a subscriber does
    :raises MasterUnreachableError: if the master does not answer
    :raises NodeStoppedError: if the node whose soul or delegate asks stops meanwhile
    """
    seconds, look = check_seconds('seconds', seconds, above=0), Look()
    with Meter(master, names, probes) as meter:
        meter.measure()
        look.pause(seconds)
        return meter.measure()


def is_wanted(name: str, names: Collection[str]) -> bool:
    """Whether a name is among those wanted: parts of names, or patterns as of a shell; all, if there
    are none."""
    return not names or any(
        fnmatch.fnmatchcase(name, wanted) if set(wanted) & set('*?[') else wanted in name
        for wanted in names
    )


class Meter:
    """Looks at a graph again and again, and tells each time what has happened since the time before.

    See :func:`measure`. For one thread at a time.
    """

    def __init__(self, master: Master, names: Collection[str] = (), probes: bool = False) -> None:
        self.master, self.names = master, tuple(names)
        self._probes = Probes(master) if probes else None
        self._before: Optional[Snapshot] = None
        self._measured_at = 0.0  # by time.monotonic()
        self._plain: Set[str] = set()  # URIs of nodes that are not of pharos
        self._processes: Dict[int, psutil.Process] = {}

    def __enter__(self) -> 'Meter':
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the subscriptions, if there are any."""
        if self._probes is not None:
            self._probes.close()

    def measure(self) -> Measurement:
        """Look once more; the first look has no rates.

        :raises MasterUnreachableError: if the master does not answer
        """
        before, measured_before = self._before, self._measured_at
        after = take(self.master, TIMEOUT, counts=True, plain=self._plain)
        self._measured_at = time.monotonic()
        if self._probes is not None:
            after = _without(after, self._probes.name)
        self._before = after
        traffic = Traffic(before.connections if before else (), after.connections)
        links = _Links(after)
        nodes = [
            _node_row(after, name, traffic, links.of_node[name])
            for name in after.nodes
            if is_wanted(name, self.names) and (self.names or not is_looker(name))
        ]
        topics = [name for name in after.topics if is_wanted(name, self.names)]
        measured = self._probes.measure(topics) if self._probes else {}
        return Measurement(
            master=after.master,
            time=after.time,
            seconds=self._measured_at - measured_before if before else None,
            is_measured=self._probes is not None,
            nodes=nodes,
            processes=list(self._process_rows(after, nodes)),
            topics=[
                _topic_row(after, name, traffic, links.of_topic[name], measured) for name in topics
            ],
        )

    # -- what the system tells

    def _process_rows(self, snapshot: Snapshot, nodes: List[NodeRow]) -> Iterable[ProcessRow]:
        rows = {row.name: row for row in nodes}
        here = set()
        for host in snapshot.hosts:
            for process in host.processes:
                own = [rows[name] for name in process.nodes if name in rows]
                if not own:
                    continue
                if host.is_here and process.pid:
                    here.add(process.pid)
                yield ProcessRow(
                    pid=process.pid,
                    host=host.name,
                    nodes=[row.name for row in own],
                    **self._usage(process.pid if host.is_here else None),
                    **{field: _sum(getattr(row, field) for row in own) for field in _SUMMED},
                )
        self._processes = {pid: each for pid, each in self._processes.items() if pid in here}

    def _usage(self, pid: Optional[int]) -> Dict[str, Any]:
        """CPU since the last look, memory and threads of a process of this host."""
        usage: Dict[str, Any] = {'cpu': None, 'memory': None, 'threads': None}
        if pid is None:
            return usage
        try:
            known = self._processes.get(pid)
            process = known or psutil.Process(pid)
            with process.oneshot():
                cpu = process.cpu_percent()  # since it was last asked for
                usage.update(memory=process.memory_info().rss, threads=process.num_threads())
        except psutil.Error:  # it has ended
            self._processes.pop(pid, None)
            return usage
        if known is None:
            self._processes[pid] = process
        else:
            usage['cpu'] = cpu
        return usage


def _without(snapshot: Snapshot, name: str) -> Snapshot:
    """The snapshot without the node of that name, and what it alone has brought about."""
    topics = {
        topic.name: dataclasses.replace(
            topic,
            publishers=[other for other in topic.publishers if other != name],
            subscribers=[other for other in topic.subscribers if other != name],
        )
        for topic in snapshot.topics.values()
    }
    return dataclasses.replace(
        snapshot,
        nodes={other: node for other, node in snapshot.nodes.items() if other != name},
        topics={
            topic.name: topic for topic in topics.values() if topic.publishers or topic.subscribers
        },
        connections=[
            each for each in snapshot.connections if name not in (each.publisher, each.subscriber)
        ],
    )


def _sum(values: Iterable[Any]) -> Any:
    """The sum of what is known; None where nothing is."""
    known = [value for value in values if value is not None]
    return sum(known) if known else None


class _Links:
    """The transports of the connections of each node and topic."""

    def __init__(self, snapshot: Snapshot) -> None:
        self.of_node: DefaultDict[str, List[str]] = collections.defaultdict(list)
        self.of_topic: DefaultDict[str, List[str]] = collections.defaultdict(list)
        for each in snapshot.connections:
            self.of_topic[each.topic].append(each.transport)
            for node in {each.publisher, each.subscriber}:
                self.of_node[node].append(each.transport)


def _node_row(snapshot: Snapshot, name: str, traffic: Traffic, transports: List[str]) -> NodeRow:
    node, health = snapshot.nodes[name], snapshot.health.get(name, {})
    return NodeRow(
        name=name,
        host=node.host,
        pid=node.pid,
        state=node.state,
        class_name=health.get('class'),
        received=traffic.received.get(name),
        sent=traffic.sent.get(name),
        bytes_received=traffic.bytes_received.get(name),
        bytes_sent=traffic.bytes_sent.get(name),
        **_counted(transports),
        dropped=sum(health['dropped'].values()) if health else None,
        failures=health.get('failures'),
        threads=health.get('threads'),
        souls=health.get('souls'),
    )


def _topic_row(
    snapshot: Snapshot,
    name: str,
    traffic: Traffic,
    transports: List[str],
    measured: Dict[str, Tuple[float, float]],
) -> TopicRow:
    topic = snapshot.topics[name]
    hearers = [snapshot.health[node] for node in topic.subscribers if node in snapshot.health]
    rate, bandwidth = measured.get(name, (traffic.of_topic.get(name), traffic.bandwidth.get(name)))
    return TopicRow(
        name=name,
        type=topic.type,
        publishers=topic.publishers,
        subscribers=topic.subscribers,
        rate=rate,
        bandwidth=bandwidth,
        **_counted(transports),
        dropped=_sum(hearer['dropped'].get(name, 0) for hearer in hearers),
    )


def _counted(transports: List[str]) -> Dict[str, int]:
    local = transports.count('INTRAPROCESS')
    return {'intraprocess': local, 'tcpros': len(transports) - local}
