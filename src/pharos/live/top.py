"""What nodes, processes and topics of a graph are doing just now: what ``rosrun pharos top`` shows.

Nodes count what comes and goes in any case, so that two looks make rates, and nothing is subscribed
to; where nobody looks, nothing is done. What blocks failed at, and channels dropped, nodes of pharos
tell when they are asked; of CPU and memory the system tells, for the processes of this host.
"""
import concurrent.futures
import dataclasses
import fnmatch
from typing import Any, Collection, Dict, Iterable, List, Optional, Set, Tuple
import xmlrpc.client

import psutil

from pharos.external_node import node_api
from pharos.live.probing import Probes
from pharos.live.snapshot import ALIVE, Connection, Snapshot, rates, take
from pharos.master import Master
from pharos.probe import Look
from pharos.seconds import check_seconds

TIMEOUT = 1.0  # seconds that all nodes have to answer
CALLER = '/pharos'
ASKING = 32  # nodes that are asked side by side for what those of pharos tell
WRAP = 2**32  # bytes after which nodes count from the beginning


@dataclasses.dataclass(frozen=True)
class NodeRow:
    """A node. What is not known of it is None."""

    name: str
    host: str
    pid: Optional[int]
    state: str  # 'alive', 'silent' (it does not answer in time) or 'dead' (nobody is there)
    class_name: Optional[str]  # of a node of pharos
    received: Optional[float]  # messages a second
    sent: Optional[float]  # messages a second, however many hear them
    bytes_received: Optional[float]  # bytes a second through sockets
    bytes_sent: Optional[float]  # to all who hear them
    intraprocess: int  # connections
    tcpros: int  # connections, those by UDPROS among them
    dropped: Optional[int]  # messages, by its channels
    failures: Optional[int]  # of its blocks
    threads: Optional[int]  # of the node
    souls: Optional[int]  # in threads of their own


@dataclasses.dataclass(frozen=True)
class ProcessRow:
    """A process that runs nodes. What is not known of it, such as of another host's, is None."""

    pid: Optional[int]
    host: str
    nodes: List[str]
    cpu: Optional[float]  # percent of one processor
    memory: Optional[int]  # bytes that are in memory
    threads: Optional[int]
    received: Optional[float]  # these, as its nodes'
    sent: Optional[float]
    bytes_received: Optional[float]
    bytes_sent: Optional[float]
    dropped: Optional[int]
    failures: Optional[int]


@dataclasses.dataclass(frozen=True)
class TopicRow:
    """A topic."""

    name: str
    type: Optional[str]  # None: nobody has named it
    publishers: List[str]
    subscribers: List[str]
    rate: Optional[float]  # messages a second; None: nobody hears them, or they are not counted
    bandwidth: Optional[float]  # bytes a second that one subscriber gets through a socket
    intraprocess: int  # connections
    tcpros: int  # connections, those by UDPROS among them
    dropped: Optional[int]  # messages, by channels of nodes of pharos


@dataclasses.dataclass(frozen=True)
class Measurement:
    """What the graph of a master did for a while.

    All in it are plain values: ``dataclasses.asdict(measurement)`` is what ``top --json`` prints.
    """

    master: str  # its URL
    time: float  # its end, in seconds as of time.time()
    seconds: Optional[float]  # that it took; None: it is a first look, and there are no rates
    is_measured: bool  # whether rates of topics are those of subscriptions made for that
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
        self._asker = concurrent.futures.ThreadPoolExecutor(ASKING, 'top asks')
        self._others: Set[str] = set()  # URIs of nodes that are not of pharos
        self._processes: Dict[int, psutil.Process] = {}

    def __enter__(self) -> 'Meter':
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the subscriptions, if there are any."""
        self._asker.shutdown(wait=False)
        if self._probes is not None:
            self._probes.close()

    def measure(self) -> Measurement:
        """Look once more; the first look has no rates.

        :raises MasterUnreachableError: if the master does not answer
        """
        before, after = self._before, take(self.master, TIMEOUT, counts=True)
        if self._probes is not None:
            after = _without(after, self._probes.name)
        self._before = after
        health = self._health(after)
        traffic = Traffic(before, after)
        nodes = [
            _node_row(after, name, traffic, health.get(name, {}))
            for name in after.nodes
            if is_wanted(name, self.names)
        ]
        topics = [name for name in after.topics if is_wanted(name, self.names)]
        measured = self._probes.measure(topics) if self._probes else {}
        return Measurement(
            master=after.master,
            time=after.time,
            seconds=after.time - before.time if before else None,
            is_measured=self._probes is not None,
            nodes=nodes,
            processes=list(self._process_rows(after, nodes)),
            topics=[_topic_row(after, name, traffic, health, measured) for name in topics],
        )

    # -- what nodes of pharos tell

    def _health(self, snapshot: Snapshot) -> Dict[str, Dict[str, Any]]:
        """``{node: what it tells}``; others than those of pharos are asked once."""
        asked = {
            name: self._asker.submit(self._ask, node.uri)
            for name, node in snapshot.nodes.items()
            if node.state == ALIVE and node.uri and node.uri not in self._others
        }
        answers = {name: future.result() for name, future in asked.items()}
        return {name: answer for name, answer in answers.items() if answer}

    def _ask(self, uri: str) -> Optional[Dict[str, Any]]:
        try:
            code, _, value = node_api(uri, TIMEOUT).pharosHealth(CALLER)
        except xmlrpc.client.Fault:
            self._others.add(uri)
            return None
        except Exception:  # whatever it answers, it is one node of many, and may just have gone
            return None
        return dict(value) if code == 1 else None

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
                    **{
                        field: _sum(getattr(row, field) for row in own)
                        for field in (
                            *('received', 'sent', 'bytes_received', 'bytes_sent'),
                            *('dropped', 'failures'),
                        )
                    },
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


class Traffic:
    """What has gone through connections between two looks, a second."""

    def __init__(self, before: Optional[Snapshot], after: Snapshot) -> None:
        #: topic -> messages
        self.of_topic: Dict[str, float] = rates(before, after) if before else {}
        #: topic -> bytes that one subscriber gets
        self.bandwidth: Dict[str, float] = {}
        #: node -> messages, bytes
        self.received: Dict[str, float] = {}
        self.sent: Dict[str, float] = {}
        self.bytes_received: Dict[str, float] = {}
        self.bytes_sent: Dict[str, float] = {}
        if before is not None and after.time > before.time:
            self._compare(before, after, after.time - before.time)

    def _compare(self, before: Snapshot, after: Snapshot, seconds: float) -> None:
        former = {each.key: each for each in before.connections}
        # (topic, publisher) -> of its best connection
        messages: Dict[Tuple[str, str], float] = {}
        sizes: Dict[Tuple[str, str], float] = {}
        for each in after.connections:
            earlier = former.get(each.key)
            count = each.messages_since(earlier)
            if earlier is None or count is None:
                continue
            size = _bytes_since(earlier, each) / seconds
            ends = each.topic, each.publisher
            _raise_to(messages, ends, count / seconds)
            _raise_to(sizes, ends, size)
            _add(self.received, each.subscriber, count / seconds)
            _add(self.bytes_received, each.subscriber, size)
            _add(self.bytes_sent, each.publisher, size)
        for (topic, publisher), rate in messages.items():
            _add(self.sent, publisher, rate)
            _add(self.bandwidth, topic, sizes[topic, publisher])


def _bytes_since(before: Connection, after: Connection) -> int:
    for count, former in (
        (after.bytes_received, before.bytes_received),
        (after.bytes_sent, before.bytes_sent),
    ):
        if count is not None and former is not None:
            return (count - former) % WRAP
    return 0


def _raise_to(values: Dict[Any, float], key: Any, value: float) -> None:
    values[key] = max(values.get(key, 0.0), value)


def _add(values: Dict[str, float], key: str, value: float) -> None:
    values[key] = values.get(key, 0.0) + value


def _sum(values: Iterable[Any]) -> Any:
    """The sum of what is known; None where nothing is."""
    known = [value for value in values if value is not None]
    return sum(known) if known else None


def _node_row(snapshot: Snapshot, name: str, traffic: Traffic, health: Dict[str, Any]) -> NodeRow:
    node = snapshot.nodes[name]
    ends = [each for each in snapshot.connections if name in (each.publisher, each.subscriber)]
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
        **_transports(ends),
        dropped=sum(health['dropped'].values()) if health else None,
        failures=health.get('failures'),
        threads=health.get('threads'),
        souls=health.get('souls'),
    )


def _topic_row(
    snapshot: Snapshot,
    name: str,
    traffic: Traffic,
    health: Dict[str, Dict[str, Any]],
    measured: Dict[str, Tuple[float, float]],
) -> TopicRow:
    topic = snapshot.topics[name]
    hearers = [health[node] for node in topic.subscribers if node in health]
    rate, bandwidth = measured.get(name, (traffic.of_topic.get(name), traffic.bandwidth.get(name)))
    return TopicRow(
        name=name,
        type=topic.type,
        publishers=topic.publishers,
        subscribers=topic.subscribers,
        rate=rate,
        bandwidth=bandwidth,
        **_transports([each for each in snapshot.connections if each.topic == name]),
        dropped=_sum(hearer['dropped'].get(name, 0) for hearer in hearers),
    )


def _transports(connections: List[Connection]) -> Dict[str, int]:
    local = [each for each in connections if each.transport == 'INTRAPROCESS']
    return {'intraprocess': len(local), 'tcpros': len(connections) - len(local)}
