"""Draw the graph of a master: nodes in their processes, topics, and the links between them."""
from __future__ import annotations

import collections
import os
import pathlib
import re
import subprocess
import time
from typing import TYPE_CHECKING, Any, Iterator, NamedTuple
from xml.sax.saxutils import escape

from pharos.errors import PharosError, UnknownNodeError
from pharos.live.snapshot import Link, Snapshot, publisher_rates, take_snapshot

if TYPE_CHECKING:
    from pharos.master import Master

DRAW_TIMEOUT = 60  # seconds that graphviz has for a picture
#: nodes and topics that a graph leaves out
COMMON_NAMES = re.compile(
    r'/(rosout|rosout_agg|statistics|clock)|.*/(parameter_updates|parameter_descriptions|get_loggers'
    r'|set_logger_level|set_parameters|pharos_looks_.*)'
)
#: transport -> the style of its arrows
ARROW_STYLES = {
    'INTRAPROCESS': 'color="#0072B2", penwidth=2.6',
    'TCPROS': 'color="#D55E00", penwidth=1.2, style=dashed',
    'SHARED_MEMORY': 'color="#CC79A7", penwidth=2.6, style=dashed',
    'UDPROS': 'color="#009E73", penwidth=1.2, style=dotted',
}
LOOSE_STYLE = 'color="#8A8A8A", style=dotted, arrowhead=empty'  # of arrows without a connection
LEGEND = (
    'blue: INTRAPROCESS, no socket; purple: SHARED_MEMORY; red: TCPROS; grey: not connected;'
    ' frames: processes'
)
NODE_STYLE = 'shape=box, style="rounded,filled", fillcolor="#D9EAF7"'
TOPIC_STYLE = 'shape=box, style=filled, fillcolor="#FFF6D5"'
FRAME_STYLE = 'style="rounded,filled"; color="#9AA5B1"; fillcolor="#F5F7F9"'


class Edge(NamedTuple):
    """An arrow from a node to a topic, or from a topic to a node."""

    node: str
    topic: str
    is_incoming: bool  # True if the arrow ends at the node
    links: list[Link]  # empty if nothing is connected
    start: str  # the name of the node or topic where the arrow begins
    end: str

    @property
    def transports(self) -> tuple[str, ...]:
        """The transports of the links."""
        return tuple(sorted({link.transport for link in self.links}))

    def peers(self) -> Iterator[str]:
        """Yield the nodes at the other ends, as '/node (transport)'."""
        for link in self.links:
            name = link.publisher if self.is_incoming else link.subscriber
            yield f'{name} ({link.transport})'


class Graph:
    """The graph of a master; :meth:`Master.graph` makes one.

    :param only: a regular expression; nodes and topics without it in their names are left out
    :param hide: a regular expression; nodes and topics with it in their names are left out
    :ivar nodes: ``{name: NodeReport}``
    :ivar topics: ``{name: type}``, '*' if the master knows no type
    :ivar edges: the arrows, each an :class:`Edge`
    :ivar rates: ``{topic: messages a second}``, empty if they were not measured
    """

    def __init__(
        self, snapshot: Snapshot, rates: dict[str, float], only: str = '', hide: str = '^$'
    ):
        def is_visible(name):
            is_hidden = COMMON_NAMES.fullmatch(name) or re.search(hide, name)
            return re.search(only, name) and not is_hidden

        self.snapshot = snapshot
        self.rates = rates
        self.nodes = {name: node for name, node in snapshot.nodes.items() if is_visible(name)}
        self.edges: list[Edge] = []
        for name, node in self.nodes.items():
            for topics, role in (node.publishes, 'publisher'), (node.subscribes, 'subscriber'):
                is_incoming = role == 'subscriber'
                for topic in filter(is_visible, topics):
                    links = [
                        link
                        for link in snapshot.links
                        if link.topic == topic and getattr(link, role) == name
                    ]
                    ends = (topic, name) if is_incoming else (name, topic)
                    self.edges.append(Edge(name, topic, is_incoming, links, *ends))
        names = sorted({edge.topic for edge in self.edges})
        self.topics = {name: snapshot.topic_types.get(name, '*') for name in names}

    def _process_of(self, name):
        """Return ``(host, process id)``; a node without a known id is a process of its own."""
        node = self.nodes[name]
        return node.host, node.pid or f'of {name}'

    def _topic_label(self, topic):
        """Return the type of a topic, and the rate if one was measured."""
        label = self.topics[topic]
        rate = self.rates.get(topic)
        if rate:
            label += f', {round(rate, 1):g} Hz'
        return label

    # -- as text

    def text(self) -> str:
        """Return the graph for a terminal: each node with its topics and peers."""
        return '\n'.join(self._text_lines())

    __repr__ = text

    def _text_lines(self):
        yield f'{self.snapshot.master}: {len(self.nodes)} nodes, {len(self.topics)} topics'
        processes = collections.defaultdict(list)
        for name in self.nodes:
            processes[self._process_of(name)].append(name)
        for (host, process_id), names in processes.items():
            yield f'process {process_id}, {host}'
            for name in names:
                yield f'  {name}  {self.nodes[name].problem}'
                yield from self.edge_lines(name)

    def edge_lines(self, node_name: str) -> Iterator[str]:
        """Yield a line for each topic of a node, with the node's peers."""
        for edge in self.edges:
            if edge.node == node_name:
                arrow = '<-' if edge.is_incoming else '->'
                peer_text = ', '.join(edge.peers()) or 'not connected'
                yield f'    {arrow} {edge.topic}  {self._topic_label(edge.topic)}  {peer_text}'

    def as_dict(self) -> dict[str, Any]:
        """Return the graph as plain values, for JSON."""
        nodes = {
            name: {**vars(node), 'links': len(node.links)} for name, node in self.nodes.items()
        }
        edges = [{**edge._asdict(), 'transports': edge.transports} for edge in self.edges]
        return {'nodes': nodes, 'topics': self.topics, 'edges': edges, 'rates': self.rates}

    # -- as a picture

    def dot(self) -> str:
        """Return the graph in the language of graphviz."""
        return '\n'.join(self._dot_lines())

    def _dot_lines(self):
        yield 'digraph pharos { rankdir=LR; newrank=true; ranksep=0.4; nodesep=0.14; nslimit=2'
        yield 'node [fontname="Helvetica", fontsize=11, height=0.3]; edge [arrowsize=0.7]'
        yield f'label="{self.snapshot.master}\\n{LEGEND}"; labeljust=l; fontsize=10'
        frames = collections.defaultdict(list)  # (host, process id) -> ids of nodes and topics
        for name, node in self.nodes.items():
            yield _dot_box('n', name, node.problem, NODE_STYLE)
            frames[self._process_of(name)].append(_dot_id('n', name))
        for topic in self.topics:
            yield _dot_box('t', topic, self._topic_label(topic), TOPIC_STYLE)
            frames[self._topic_process(topic)].append(_dot_id('t', topic))
        frames.pop(None, None)  # topics of several processes have no frame
        for (host, process_id), ids in frames.items():
            frame_id = _dot_id('cluster', f'{process_id} {host}')
            yield f'subgraph {frame_id} {{ label="process {process_id}, {host}"'
            yield f'labeljust=l; fontsize=10; {FRAME_STYLE}'
            yield from ids
            yield '}'
        for edge in self.edges:
            node_id = _dot_id('n', edge.node)
            topic_id = _dot_id('t', edge.topic)
            arrow = f'{topic_id} -> {node_id}' if edge.is_incoming else f'{node_id} -> {topic_id}'
            for transport in edge.transports or ['none']:
                yield f'{arrow} [{ARROW_STYLES.get(transport, LOOSE_STYLE)}]'
        yield '}'

    def _topic_process(self, topic):
        """Return the process of the publishers, or else of the subscribers; None if of several."""
        edges = [edge for edge in self.edges if edge.topic == topic]
        output_edges = [edge for edge in edges if not edge.is_incoming]
        processes = {self._process_of(edge.node) for edge in output_edges or edges}
        return processes.pop() if len(processes) == 1 else None

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a picture to a file; the suffix tells the format: .svg, .png, .pdf or .dot.

        :raises PharosError: if graphviz is not installed, knows no such format, or fails
        """
        file = pathlib.Path(path)
        suffix = file.suffix[1:]
        file.write_bytes(self.dot().encode() if suffix == 'dot' else self._draw(suffix))

    def _draw(self, picture_format):
        """Return the bytes of a picture that graphviz draws."""
        try:
            return subprocess.check_output(
                ['dot', f'-T{picture_format}'], input=self.dot().encode(), timeout=DRAW_TIMEOUT
            )
        except (OSError, subprocess.SubprocessError) as error:
            raise PharosError(f'{error}: apt install graphviz, or leave out nodes') from error

    def _repr_svg_(self):
        return self._draw('svg').decode()


def _dot_id(prefix, name):
    """Return an id for graphviz; the prefix tells a node from a topic of its name."""
    return f'"{prefix} {name}"'


def _dot_box(prefix, name, caption, style):
    """Return the box of a node or topic, with a caption in small letters."""
    label = escape(name)
    if caption:
        label += f'<br/><font point-size="9" color="#505050">{escape(caption)}</font>'
    return f'{_dot_id(prefix, name)} [{style}, label=<{label}>]'


def graph_of(master: Master, seconds: float = 0, **names: str) -> Graph:
    """Return the graph of :meth:`Master.graph`.

    :param seconds: how long messages are counted, for rates; 0: no rates
    :param names: ``only`` and ``hide`` of :class:`Graph`
    :raises MasterUnreachableError: if the master does not answer
    """
    start = take_snapshot(master)
    if not seconds:
        return Graph(start, {}, **names)
    time.sleep(seconds)
    snapshot = take_snapshot(master)
    topic_rates: dict[str, float] = collections.defaultdict(float)
    for (topic, _), rate in publisher_rates(snapshot.rates_since(start)).items():
        topic_rates[topic] += rate
    return Graph(snapshot, topic_rates, **names)


def describe(master: Master, node_name: str, seconds: float) -> str:
    """Return a text about a node, with rates that are counted for some seconds.

    :raises UnknownNodeError: if the master does not know the node
    """
    graph = graph_of(master, seconds)
    node = graph.snapshot.nodes.get(node_name)
    if not node:
        raise UnknownNodeError(f'no node {node_name} is known at {master.url}: see rosnode list')
    health = ', '.join(f'{fact} {value}' for fact, value in node.health.items())
    lines = [f'{node_name}: pid {node.pid} at {node.host}, {node.uri} {node.problem}\n    {health}']
    lines += graph.edge_lines(node_name)
    lines += [f'    offers {service}' for service in node.offers]
    return '\n'.join(lines)
