"""A graph in graphviz's language."""
import collections
import os.path
import re
import time
from typing import TYPE_CHECKING, Dict, Iterable, Iterator, List, Optional, Tuple
from xml.sax.saxutils import escape

from pharos.counts import counted
from pharos.live.answers import ALIVE, DEAD
from pharos.live.colors import BLUE, GREEN, VERMILION
from pharos.live.edges import HEARS, OFFERS, SENDS, Edge
from pharos.live.figures import rate_text
from pharos.live.snapshot import SeenNode, SeenTopic

if TYPE_CHECKING:
    from pharos.live.graph import Graph

GREY = '#8A8A8A'
FONT = 'Helvetica,Arial,sans-serif'
LINE = 26  # characters after which a name is broken
LISTED = 3  # topics that an arrow between nodes names

#: transport -> an arrow's colour, how else it is drawn, what the legend shows for it, and says of it
STYLES = {
    'INTRAPROCESS': (BLUE, 'penwidth=2.6', '━━━▶', 'INTRAPROCESS: no socket'),
    'TCPROS': (VERMILION, 'penwidth=1.2, style=dashed', '╌╌╌▶', 'TCPROS'),
    'UDPROS': (GREEN, 'penwidth=1.2, style=dotted, arrowhead=vee', '┈┈┈▷', 'UDPROS'),
    '': (GREY, 'penwidth=1, style=dotted, arrowhead=empty', '┈┈┈▷', 'nothing connected'),
    'service': (GREEN, 'penwidth=1, arrowhead=none', '───', 'offers a service'),
}


def dot_of(graph: 'Graph') -> str:
    """The text for graphviz."""
    lines = [
        'digraph pharos {',
        '  rankdir=LR; newrank=true; ranksep=0.4; nodesep=0.14; splines=true; pad=0.2',
        '  nslimit=2; nslimit1=2',  # else a tangle of a hundred nodes takes minutes
        f'  fontname="{FONT}"; fontsize=11; labelloc=b; labeljust=l; bgcolor=white',
        f'  node [fontname="{FONT}", fontsize=11, margin="0.07,0.03", height=0.3, color="#404040"]',
        f'  edge [fontname="{FONT}", fontsize=9, arrowsize=0.7]',
        f'  label=<{_legend(graph)}>',
        *('  ' + line for line in _Frames(graph).lines()),
        *('  ' + line for edge in graph.edges for line in _arrows(edge)),
        '}',
    ]
    return '\n'.join(lines) + '\n'


# -- names and labels


def _quote(text: str) -> str:
    return '"' + text.replace('\\', '\\\\').replace('"', '\\"').replace('\n', ' ') + '"'


def _id(kind: str, name: str) -> str:
    """How graphviz calls it: a node and a topic may have the same name."""
    return _quote(f'{kind} {name}')


def _lines_of(name: str) -> List[str]:
    """A name, broken before slashes where it is long."""
    lines = ['']
    for part in re.findall('/*[^/]+|/+$', name) or ['(no name)']:
        if lines[-1] and len(lines[-1]) + len(part) > LINE:
            lines.append('')
        lines[-1] += part
    return lines


def _label(name: str, about: str = '', bold: bool = False, color: str = '#505050') -> str:
    """A name, and something about it in small letters, as graphviz's HTML."""
    rows = [f'<b>{escape(line)}</b>' if bold else escape(line) for line in _lines_of(name)]
    if about:
        rows.append(f'<font point-size="9" color="{color}">{escape(about)}</font>')
    return _table(rows)


def _table(rows: Iterable[str]) -> str:
    """Lines below each other; of those that <br/> makes the letters touch."""
    cells = ''.join(f'<tr><td>{row}</td></tr>' for row in rows)
    return f'<<table border="0" cellborder="0" cellspacing="0" cellpadding="1">{cells}</table>>'


def _node_line(node: SeenNode) -> str:
    about, style, look = '', 'rounded,filled', 'fillcolor="#D9EAF7"'
    if node.state != ALIVE:
        about = 'dead' if node.state == DEAD else 'does not answer'
        style, look = (
            'rounded,filled,dashed',
            f'fillcolor="#EEEEEE", color="{VERMILION}", penwidth=2',
        )
    said = [node.uri or '', f'process {node.pid}' if node.pid else '', node.problem]
    tip = ', '.join([node.name, *filter(None, said)])
    return (
        f'{_id("node", node.name)} [shape=box, style="{style}", {look}, tooltip={_quote(tip)},'
        f' label={_label(node.name, about, bold=True, color="#A03000")}]'
    )


def _topic_line(topic: SeenTopic, rate: Optional[float]) -> str:
    about = topic.type or 'type unknown'
    if rate is not None:
        about += f', {rate_text(rate)}'
    return (
        f'{_id("topic", topic.name)} [shape=box, style=filled, fillcolor="#FFF6D5",'
        f' label={_label(topic.name, about)}, tooltip={_quote(topic.name)}]'
    )


def _service_line(name: str) -> str:
    return (
        f'{_id("service", name)} [shape=cds, style=filled, fillcolor="#DDF3E8",'
        f' label={_label(name)}, tooltip={_quote(name)}]'
    )


# -- arrows


def _arrows(edge: Edge) -> Iterator[str]:
    """An arrow for each transport."""
    start = _id('topic' if edge.kind == HEARS else 'node', edge.start)
    ends = {HEARS: 'node', SENDS: 'node', OFFERS: 'service'}
    end = _id(ends.get(edge.kind, 'topic'), edge.end)
    transports = ('service',) if edge.kind == OFFERS else edge.transports or ('',)
    label = ''
    if edge.kind == SENDS:
        more = len(edge.topics) - LISTED
        names = [*edge.topics[:LISTED], *([f'and {more} more'] if more > 0 else [])]
        label = f', label={_table(map(escape, names))}'
    for transport in transports:
        color, style, *_ = STYLES[transport if transport in STYLES else 'TCPROS']
        yield f'{start} -> {end} [color="{color}", {style}{label}, tooltip={_quote(_said_of(edge, transport))}]'
        label = ''


def _said_of(edge: Edge, transport: str) -> str:
    means = f' by {transport}' if transport in edge.transports else ''
    return f'{edge.start} {edge.kind} {edge.end}{means}'


def sorry(text: str) -> str:
    """A picture, as SVG, that says why there is no other."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{8 * len(text) + 20}" height="30">'
        f'<text x="10" y="20" font-family="{FONT}" font-size="14">{escape(text)}</text></svg>'
    )


# -- frames


def _namespaces(name: str) -> Tuple[str, ...]:
    """The namespaces that a name is in, from the outermost: ('/robot', '/robot/arm')."""
    parts = name.split('/')[1:-1]
    return tuple('/' + '/'.join(parts[: depth + 1]) for depth in range(len(parts)))


class _Frames:
    """The frames of a graph, each with what is in it alone.

    A topic is in that of its publishers, if they have one in common: what leaves a process crosses
    its frame. One that nobody publishes is in that of its subscribers.
    """

    def __init__(self, graph: 'Graph') -> None:
        self._graph = graph
        #: path of frames -> what is in the innermost of them
        self._lines: Dict[Tuple[str, ...], List[str]] = collections.defaultdict(list)
        self._labels: Dict[Tuple[str, ...], str] = {}
        self._paths: Dict[str, Tuple[str, ...]] = {}  # name of a node -> its frames
        if graph.group == 'process':
            self._frame_processes()
        elif graph.group == 'namespace':
            self._frame_namespaces()
        self._known = {(), *self._labels}
        for name, node in graph.nodes.items():
            self._lines[self._paths.get(name, ())].append(_node_line(node))
        for topic in graph.topics.values():
            path = self._place(topic.name, topic.publishers, topic.subscribers)
            self._lines[path].append(_topic_line(topic, graph.rates.get(topic.name)))
        for service in graph.services.values():
            path = self._place(service.name, service.providers)
            self._lines[path].append(_service_line(service.name))

    def _frame_processes(self) -> None:
        """Processes, and hosts around them where there are several."""
        hosts = self._graph.hosts
        for host in hosts:
            around: Tuple[str, ...] = (f'host {host.name}',) if len(hosts) > 1 else ()
            if around:
                self._labels[around] = f'host {host.name}'
            for process in host.processes:
                path = around
                if process.pid is not None:
                    path = (*around, f'process {host.name} {process.pid}')
                    self._labels[path] = f'process {process.pid}'
                self._paths.update({name: path for name in process.nodes})

    def _frame_namespaces(self) -> None:
        for name in self._graph.nodes:
            self._paths[name] = _namespaces(name)
            for depth, namespace in enumerate(self._paths[name], 1):
                self._labels[self._paths[name][:depth]] = namespace

    def _place(self, name: str, *users: List[str]) -> Tuple[str, ...]:
        """The innermost frame in which all of its first users are that the graph has; where frames
        are namespaces, the name says it."""
        if self._graph.group == 'namespace':
            path = _namespaces(name)
            return next(path[:end] for end in range(len(path), -1, -1) if path[:end] in self._known)
        first = next(filter(None, ({*nodes} & {*self._graph.nodes} for nodes in users)))
        paths = [self._paths.get(node, ()) for node in first]
        return tuple(os.path.commonprefix(paths))

    def lines(self, path: Tuple[str, ...] = ()) -> Iterator[str]:
        """The text of a frame's inside."""
        yield from self._lines.get(path, ())
        for inner in sorted({known[: len(path) + 1] for known in self._below(path)}):
            is_host = inner[-1].startswith('host ')
            yield f'subgraph {_quote("cluster " + " ".join(inner))} {{'
            yield (
                f'  label={_quote(self._labels[inner])}; labelloc=t; labeljust=l; fontsize=10;'
                f' fontcolor="#505050"; margin=7; penwidth={1.6 if is_host else 1};'
                f' style="{"dashed" if is_host else "rounded,filled"}"; color="#9AA5B1";'
                f' fillcolor="#F5F7F9"'
            )
            yield from ('  ' + line for line in self.lines(inner))
            yield '}'

    def _below(self, path: Tuple[str, ...]) -> Iterable[Tuple[str, ...]]:
        return (
            known
            for known in {*self._lines, *self._labels}
            if len(known) > len(path) and known[: len(path)] == path
        )


def _legend(graph: 'Graph') -> str:
    """What the picture is of, and what its arrows mean."""
    seen = graph.snapshot
    used = {transport for edge in graph.edges for transport in edge.transports}
    if any(edge.kind == OFFERS for edge in graph.edges):
        used.add('service')
    if any(not edge.transports and edge.kind != OFFERS for edge in graph.edges):
        used.add('')
    cells = ['<td bgcolor="#D9EAF7" border="1" style="rounded">node</td>']
    if graph.topics:
        cells.append('<td bgcolor="#FFF6D5" border="1">topic</td>')
    cells += [
        f'<td><font color="{color}">{sample}</font> {said}</td>'
        for transport, (color, _, sample, said) in STYLES.items()
        if transport in used
    ]
    if graph.group == 'process':
        cells.append('<td bgcolor="#F5F7F9" border="1" color="#9AA5B1">frame: process</td>')
    when = time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(seen.time))
    about = f'{seen.master}, {when}: {counted(len(graph.nodes), "node")}'
    if not graph.nodes_only:
        about += f', {counted(len(graph.topics), "topic")}'
    return (
        '<table border="0" cellborder="0" cellspacing="4">'
        f'<tr>{"".join(cells)}</tr>'
        f'<tr><td align="left" colspan="{len(cells)}"><font color="#505050">{escape(about)}</font>'
        '</td></tr></table>'
    )
