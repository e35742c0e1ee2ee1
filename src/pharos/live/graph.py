"""The graph of a ROS master: who sends what to whom, from which process, and how; as a picture."""
import dataclasses
import itertools
import os
import re
from typing import Any, Collection, Dict, Iterable, Iterator, List, Set, Tuple, Union

import rosgraph.names

from pharos.counts import counted
from pharos.errors import PharosError, suggest
from pharos.live import graphviz, snapshot
from pharos.live.answers import ALIVE
from pharos.live.dot import dot_of, sorry
from pharos.live.edges import HEARS, OFFERS, PUBLISHES, SENDS, Edge
from pharos.live.graph_text import text_of_graph
from pharos.live.snapshot import Host, Process, SeenNode, SeenService, SeenTopic, Snapshot
from pharos.live.traffic import Traffic
from pharos.lookers import is_looker
from pharos.master import Master
from pharos.probe import Look
from pharos.seconds import check_seconds

GROUPS = 'process', 'namespace', 'none'
#: what may be hidden -> what that is
HIDEABLE = {
    'leaf': 'topics that one node alone uses',
    'unheard': 'topics that nobody hears',
    'idle': 'topics of which nothing is connected',
    'tf': 'the topics of tf',
    'images': 'images, and what comes with them',
    'unreachable': 'nodes that do not answer',
}
#: what every node has, and says nothing of what it is for
_DEBUG_TOPICS = re.compile(
    r'/(rosout|rosout_agg|statistics|clock)|.*/(parameter_updates|parameter_descriptions)'
)
_DEBUG_SERVICES = re.compile(r'.*/(get_loggers|set_logger_level|set_parameters)')
_DEBUG_NODES = {'/rosout'}
_TF = re.compile(r'.*/tf(_static)?')
_IMAGES = {'Image', 'CompressedImage', 'CameraInfo', 'Packet'}  # theora's


class Graph:
    """What :meth:`Master.graph <pharos.Master.graph>` returns: a picture of a
    :class:`~pharos.live.snapshot.Snapshot`.

    :ivar nodes: ``{name: what was seen of it}``, of those that the picture shows
    :ivar topics: the same of topics
    :ivar services: the same of services
    :ivar edges: the arrows, each an :class:`~pharos.live.edges.Edge`
    :ivar rates: ``{topic: messages a second}``, where that was measured
    :ivar snapshot: all that was seen
    :ivar nodes_only: whether arrows go from node to node, instead of topics
    :ivar group: what the frames are: 'process', 'namespace' or 'none'
    :ivar namespaces: those of the nodes that it shows
    :param snapshot: what was seen
    :param rates: ``{topic: messages a second}``
    :param options: as of :meth:`Master.graph <pharos.Master.graph>`
    :raises TypeError, ValueError: if there is no such option
    """

    def __init__(
        self,
        snapshot: Snapshot,
        rates: Union[Dict[str, float], None] = None,
        show_all: bool = False,
        services: bool = False,
        nodes_only: bool = False,
        namespace: Union[str, Collection[str]] = '/',
        hide: Union[str, Collection[str]] = (),
        group: str = 'process',
    ) -> None:
        self.snapshot = snapshot
        self.rates = {} if rates is None else rates
        self.nodes_only = nodes_only
        self.group = _check_choice('group', group, GROUPS)
        self.namespaces = _check_namespaces(namespace)
        hidden = set(_names('what is to be hidden', hide, "'leaf'"))
        connected = {each.topic for each in snapshot.connections}
        for each in hidden:
            _check_choice('hide', each, HIDEABLE)
        self.nodes: Dict[str, SeenNode] = {
            name: node
            for name, node in snapshot.nodes.items()
            if _is_in(name, self.namespaces)
            and (show_all or not (name in _DEBUG_NODES or is_looker(name)))
            and (node.state == ALIVE or 'unreachable' not in hidden)
        }
        self.topics: Dict[str, SeenTopic] = {
            name: topic
            for name, topic in snapshot.topics.items()
            if (show_all or not _DEBUG_TOPICS.fullmatch(name))
            and {*topic.publishers, *topic.subscribers} & {*self.nodes}
            and not _is_hidden(topic, topic.name in connected, hidden)
        }
        self.services: Dict[str, SeenService] = {
            name: service
            for name, service in snapshot.services.items()
            if services
            and (show_all or not _DEBUG_SERVICES.fullmatch(name))
            and {*service.providers} & {*self.nodes}
        }
        self.edges: List[Edge] = list(self._sends() if nodes_only else self._uses())
        if nodes_only:
            self.topics = {}

    def _uses(self) -> Iterator[Edge]:
        """Who publishes and hears each topic, and what carries its messages."""
        transports = self._transports()
        for name, topic in self.topics.items():
            for node in topic.publishers:
                if node in self.nodes:
                    used = transports.get((name, node), ())
                    yield Edge(PUBLISHES, node, name, tuple(sorted(used)), (name,))
            for node in topic.subscribers:
                if node in self.nodes:
                    used = transports.get((name, node), ())
                    yield Edge(HEARS, name, node, tuple(sorted(used)), (name,))
        yield from self._offers()

    def _transports(self) -> Dict[Tuple[str, str], Set[str]]:
        """``{(topic, node): the transports that carry its messages}``; a node's with itself only
        where there is no other."""
        alone: Dict[Tuple[str, str], Set[str]] = {}
        with_others: Dict[Tuple[str, str], Set[str]] = {}
        for (topic, publisher, subscriber), transports in self.snapshot.transports.items():
            found = alone if publisher == subscriber else with_others
            for node in publisher, subscriber:
                found.setdefault((topic, node), set()).update(transports)
        return {**alone, **with_others}

    def _sends(self) -> Iterator[Edge]:
        """Who sends to whom, whatever the topic."""
        sent: Dict[Tuple[str, str], Tuple[Set[str], Set[str]]] = {}
        for name, topic in self.topics.items():
            publishers = [node for node in topic.publishers if node in self.nodes]
            subscribers = [node for node in topic.subscribers if node in self.nodes]
            for publisher, subscriber in itertools.product(publishers, subscribers):
                if publisher != subscriber:
                    _, topics = sent.setdefault((publisher, subscriber), (set(), set()))
                    topics.add(name)
        for link, used in self.snapshot.transports.items():
            if link[0] in self.topics and link[1:] in sent:
                sent[link[1:]][0].update(used)
        for ends, (transports, topics) in sorted(sent.items()):
            yield Edge(SENDS, *ends, tuple(sorted(transports)), tuple(sorted(topics)))
        yield from self._offers()

    def _offers(self) -> Iterator[Edge]:
        for name, service in self.services.items():
            for node in service.providers:
                if node in self.nodes:
                    yield Edge(OFFERS, node, name, (), ())

    @property
    def hosts(self) -> List[Host]:
        """The hosts and processes of the nodes."""
        hosts = []
        for host in self.snapshot.hosts:
            processes = [
                Process(process.pid, [name for name in process.nodes if name in self.nodes])
                for process in host.processes
                if {*process.nodes} & {*self.nodes}
            ]
            if processes:
                hosts.append(Host(host.name, host.is_here, processes))
        return hosts

    # -- as a picture

    def dot(self) -> str:
        """The graph in graphviz's language."""
        return dot_of(self)

    def text(self) -> str:
        """The graph for a terminal: each node with what it sends, hears and offers."""
        return text_of_graph(self)

    def save(self, path: Union[str, 'os.PathLike[str]']) -> None:
        """Write the picture to a file, all at once, so that who looks at it sees no half of one.

        :param path: its suffix says how: .svg, .png, .pdf or .dot
        :raises ValueError: if it has another suffix
        :raises PharosError: if it cannot be written, or graphviz is not there, which all but .dot
            need
        """
        graphviz.save(self.dot(), path)

    def _repr_svg_(self) -> str:
        """The picture in Jupyter, or why there is none."""
        try:
            return graphviz.render(self.dot(), 'svg').decode()
        except PharosError as error:
            return sorry(str(error))

    def is_like(self, other: 'Graph') -> bool:
        """Whether its picture says the same as another's, rates and what is counted aside."""
        return self._gist() == other._gist()

    def _gist(self) -> Tuple[Any, ...]:
        return self.nodes, self.topics, self.services, self.edges, self.group

    def as_dict(self) -> Dict[str, Any]:
        """What it shows, as plain values, ready for JSON."""
        return {
            'master': self.snapshot.master,
            'hosts': [dataclasses.asdict(host) for host in self.hosts],
            'nodes': {name: dataclasses.asdict(node) for name, node in self.nodes.items()},
            'topics': {
                name: {**dataclasses.asdict(topic), 'rate': self.rates.get(name)}
                for name, topic in self.topics.items()
            },
            'services': {name: dataclasses.asdict(each) for name, each in self.services.items()},
            'edges': [dataclasses.asdict(edge) for edge in self.edges],
        }

    def __repr__(self) -> str:
        return (
            f'<Graph of {self.snapshot.master}:'
            f" {counted(len(self.nodes), 'node')},"
            f" {counted(len(self.topics), 'topic')},"
            f" {counted(len(self.edges), 'edge')};"
            " print(graph.text()) shows it, graph.save('graph.svg') draws it>"
        )


def graph_of(master: Master, seconds: float = 0, **options: Any) -> Graph:
    """The graph of a master as it is; see :meth:`Master.graph <pharos.Master.graph>`."""
    seconds = check_seconds('seconds', seconds, least=0)
    if not seconds:
        return Graph(snapshot.take(master), **options)
    look = Look()  # from here on: a node that stops while others are asked ends the wait, too
    before = snapshot.take(master, counts=True)
    Graph(before, **options)  # complains of an option before all the time is spent
    look.pause(seconds)
    after = snapshot.take(master, counts=True)
    return Graph(after, Traffic(before.connections, after.connections).of_topic, **options)


def _check_choice(what: str, given: str, choices: Iterable[str]) -> str:
    if given not in choices:
        raise ValueError(
            f'{what} may be {", ".join(map(repr, choices))}, not {given!r}'
            f'{suggest(str(given), choices)}'
        )
    return given


def _check_namespaces(given: Union[str, Collection[str]]) -> List[str]:
    names = _names('a namespace', given, '/robot')
    return [rosgraph.names.make_global_ns(name) for name in names]


def _names(what: str, given: Union[str, Collection[str]], example: str) -> List[str]:
    """One name, or several, as a list."""
    names = [given] if not isinstance(given, Iterable) or isinstance(given, str) else list(given)
    if not all(isinstance(name, str) for name in names):
        raise TypeError(f'{what} is given by its name, such as {example}, not as {given!r}')
    return names


def _is_in(name: str, namespaces: Iterable[str]) -> bool:
    return any((name + '/').startswith(namespace) for namespace in namespaces)


def _is_hidden(topic: SeenTopic, is_connected: bool, hidden: Collection[str]) -> bool:
    """Whether a topic is of those that are not wanted."""
    kind = (topic.type or '').rpartition('/')[2]
    return (
        ('leaf' in hidden and len({*topic.publishers, *topic.subscribers}) < 2)
        or ('unheard' in hidden and not topic.subscribers)
        or ('idle' in hidden and not is_connected)
        or ('tf' in hidden and _TF.fullmatch(topic.name) is not None)
        or ('images' in hidden and kind in _IMAGES)
    )
