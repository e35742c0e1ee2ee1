"""Show the graph of a master: who sends what to whom, their processes, and how."""
import collections
import dataclasses
import json
import pathlib
import re
import subprocess
import time
from typing import Any, NamedTuple
from xml.sax.saxutils import escape

from pharos import live
from pharos.errors import PharosError
from pharos.live import snapshot
from pharos.live.words import number
from pharos.master import Master

FORMATS = '.svg', '.png', '.pdf', '.dot'
#: what every node has
COMMON = re.compile(
    r'/(rosout|rosout_agg|statistics|clock)|.*/(parameter_updates|parameter_descriptions|get_loggers'
    r'|set_logger_level|set_parameters|pharos_looks_.*)'
)
#: transport -> how its arrows look
ARROWS = {
    'INTRAPROCESS': 'color="#0072B2", penwidth=2.6',
    'TCPROS': 'color="#D55E00", penwidth=1.2, style=dashed',
    'UDPROS': 'color="#009E73", penwidth=1.2, style=dotted',
    '': 'color="#8A8A8A", style=dotted, arrowhead=empty',
}
LEGEND = 'blue: INTRAPROCESS, no socket; red: TCPROS; grey: not connected; frames: processes'
NODE = 'shape=box, style="rounded,filled", fillcolor="{}"'
TOPIC = 'shape=box, style=filled, fillcolor="#FFF6D5"'
SERVICE = 'shape=cds, style=filled, fillcolor="#DDF3E8"'
GRAY = 'style="rounded,filled"; color="#9AA5B1"; fillcolor="#F5F7F9"'


class Edge(NamedTuple):
    """An arrow from a node to a topic, or from a topic to a node."""

    start: str
    end: str
    is_incoming: bool  # True if it ends at a node
    transports: tuple[str, ...]  # none if nothing is connected

    node = property(lambda self: self[self.is_incoming])
    topic = property(lambda self: self[not self.is_incoming])


class Graph:
    """A graph; made by :meth:`Master.graph`.

    :ivar nodes: ``{name: what was seen of it}``
    :ivar topics: ``{name: type}``
    :ivar edges: the arrows, each an :class:`Edge`
    :ivar rates: ``{topic: messages a second}``, if that was measured
    """

    def __init__(self, seen, rates, show_all=False, services=False, only='', hide='(?!)'):
        def is_shown(name):
            is_wanted = re.search(only, name) and not re.search(hide, name)
            return bool(is_wanted and (show_all or not COMMON.fullmatch(name)))

        self.snapshot, self.rates = seen, rates
        self.nodes = {name: node for name, node in seen.nodes.items() if is_shown(name)}
        self.edges: list[Edge] = []
        carried = collections.defaultdict(set)
        for link in seen.links:
            carried[link.topic, link.publisher, False].add(link.transport)
            carried[link.topic, link.subscriber, True].add(link.transport)
        for name, node in self.nodes.items():
            for topics, is_incoming in (node.publishes, False), (node.subscribes, True):
                for topic in filter(is_shown, topics):
                    ends = (topic, name) if is_incoming else (name, topic)
                    by = tuple(sorted(carried[topic, name, is_incoming]))
                    self.edges.append(Edge(*ends, is_incoming, by))
        used = {edge.topic for edge in self.edges}
        self.topics = {name: kind for name, kind in seen.topics.items() if name in used}
        shown = self.nodes.items() if services else ()
        self.services = {
            each: name for name, node in shown for each in filter(is_shown, node.offers)
        }

    def processes(self):
        """Return ``{(host, process id): the names of its nodes}``."""
        found = collections.defaultdict(list)
        for name, node in self.nodes.items():
            found[node.host, node.pid or f'of {name}'].append(name)
        return found

    def _about(self, topic):
        rate = self.rates.get(topic)
        return (self.topics[topic] or 'type unknown') + (f', {number(rate)} Hz' if rate else '')

    def text(self) -> str:
        """Return the graph for a terminal: each node with what it sends, receives and offers."""
        return '\n'.join(self._lines())

    def _lines(self):
        yield f'{self.snapshot.master}: {len(self.nodes)} nodes, {len(self.topics)} topics'
        for (host, pid), names in self.processes().items():
            yield f'process {pid}, {host}'
            for name in names:
                yield f'  {name}  {self.nodes[name].problem}'
                for edge in self.edges:
                    if name == edge.node:
                        yield self._line(edge, name)
                for service, node in self.services.items():
                    if node == name:
                        yield f'    offers {service}'

    def _line(self, edge, name):
        topic, own, peer = (edge.start, 2, 1) if edge.is_incoming else (edge.end, 1, 2)
        links = [each for each in self.snapshot.links if each.topic == topic and each[own] == name]
        peers = ', '.join(f'{link[peer]} ({link.transport})' for link in links) or 'not connected'
        return f'    {"<-" if edge.is_incoming else "->"} {topic}  {self._about(topic)}  {peers}'

    def dot(self) -> str:
        """Return the graph in graphviz's language."""
        return '\n'.join(self._dot())

    def _dot(self):
        at = time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(self.snapshot.time))
        yield 'digraph pharos { rankdir=LR; newrank=true; ranksep=0.4; nodesep=0.14; nslimit=2'
        yield 'node [fontname="Helvetica", fontsize=11, height=0.3]; edge [arrowsize=0.7]'
        yield f'label="{self.snapshot.master}, {at}\\n{LEGEND}"; labeljust=l; fontsize=10'
        homes = {name: home for home, names in self.processes().items() for name in names}
        inside = collections.defaultdict(list)
        for name, node in self.nodes.items():
            look = NODE.format('#EEEEEE' if node.problem else '#D9EAF7')
            about = 'does not answer' if node.problem else ''
            inside[homes[name]].append(_box('n', name, about, look))
        for topic in self.topics:  # beside its publishers, or else its subscribers
            edges = [edge for edge in self.edges if topic == edge.topic]
            senders = {homes[edge.start] for edge in edges if not edge.is_incoming}
            own = senders or {homes[edge.end] for edge in edges}
            home = own.pop() if len(own) == 1 else None
            inside[home].append(_box('t', topic, self._about(topic), TOPIC))
        for service, name in self.services.items():
            inside[homes[name]].append(_box('s', service, '', SERVICE))
            inside[None].append(f'{_id("n", name)} -> {_id("s", service)} [arrowhead=none]')
        yield from inside.pop(None, ())
        for home, lines in inside.items():
            yield f'subgraph {_id("cluster", str(home))} {{ label="process {home[1]}, {home[0]}"'
            yield from (f'labeljust=l; fontsize=10; {GRAY}', *lines, '}')
        for edge in self.edges:
            kinds = ('t', 'n') if edge.is_incoming else ('n', 't')
            for transport in edge.transports or ('',):
                arrow = ARROWS[transport]
                yield f'{_id(kinds[0], edge.start)} -> {_id(kinds[1], edge.end)} [{arrow}]'
        yield '}'

    def save(self, path: Any) -> None:
        """Write the picture to a file, whose suffix says how: .svg, .png, .pdf or .dot.

        :raises ValueError: if it has another suffix
        :raises PharosError: if graphviz is not installed, or does not draw it
        """
        path = pathlib.Path(path)
        if path.suffix not in FORMATS:
            raise ValueError(
                f'{path} is not a picture: its name ends in one of {", ".join(FORMATS)}'
            )
        is_dot = path.suffix == '.dot'
        path.write_bytes(self.dot().encode() if is_dot else self._draw(path.suffix[1:]))

    def _draw(self, kind):
        options = {'input': self.dot().encode(), 'stdout': subprocess.PIPE, 'timeout': 60}
        try:
            return subprocess.run(['dot', f'-T{kind}'], check=True, **options).stdout
        except (OSError, subprocess.SubprocessError) as error:
            raise PharosError(f'{error}: apt install graphviz, or leave out nodes') from error

    def _repr_svg_(self):
        return self._draw('svg').decode()

    def as_dict(self):
        """Return it as plain values, for JSON."""
        nodes = {name: dataclasses.asdict(node) for name, node in self.nodes.items()}
        for node in nodes.values():
            del node['ends']
        edges = [edge._asdict() for edge in self.edges]
        return {'nodes': nodes, 'topics': self.topics, 'edges': edges, 'rates': self.rates}

    def __repr__(self):
        return f'<Graph of {len(self.nodes)} nodes: see text() and save()>'


def _id(kind, name):
    return f'"{kind} {name}"'


def _box(kind, name, about, look):
    """Return a node, topic or service: its name, and something about it in small letters."""
    small = f'<br/><font point-size="9" color="#505050">{escape(about)}</font>' if about else ''
    bold = f'<b>{escape(name)}</b>' if kind == 'n' else escape(name)
    return f'{_id(kind, name)} [{look}, label=<{bold}{small}>]'


def graph_of(master, seconds=0, **options):
    """Do what :meth:`Master.graph` does."""
    before = seen = snapshot.take(master)
    if seconds:
        time.sleep(seconds)
        seen = snapshot.take(master)
    return Graph(seen, snapshot.topic_rates(before, seen), **options)


def graph(words):
    """Show the graph of the ROS master: processes, nodes, topics, and how messages go.

    graph                            as text
    graph --output graph.svg         as a picture: .svg, .png, .pdf (by graphviz) or .dot
    graph --rates 2 --hide '/tf'     with how often messages come, and without some names
    watch -n1 rosrun pharos graph    again and again
    """
    read = live.parser(graph.__doc__)
    read.add_argument('-o', '--output', metavar='FILE', help='a picture, instead of text')
    read.add_argument('--json', action='store_true', help='JSON, instead of text')
    read.add_argument('--all', action='store_true', help='also what all have, such as /rosout')
    read.add_argument('--services', action='store_true', help='services, too')
    read.add_argument('--only', default='', metavar='REGEX', help='of the names, those alone')
    read.add_argument('--hide', default='(?!)', metavar='REGEX', help='of the names, not those')
    read.add_argument('--rates', type=float, default=0, metavar='S', help='count messages so long')
    chosen = read.parse_args(words)
    which = {'show_all': chosen.all, 'only': chosen.only, 'hide': chosen.hide}
    found = graph_of(Master(), chosen.rates, services=chosen.services, **which)
    if chosen.output:
        found.save(chosen.output)
    else:
        print(json.dumps(found.as_dict()) if chosen.json else found.text())


def main():
    """Run the command."""
    return live.run(graph)
