"""A graph as text, for a terminal."""
from typing import TYPE_CHECKING, Collection, Dict, Iterator, List, Tuple

from pharos.counts import counted
from pharos.live.answers import ALIVE
from pharos.live.edges import SENDS, Edge
from pharos.live.figures import rate_text

if TYPE_CHECKING:
    from pharos.live.graph import Graph


def text_of_graph(graph: 'Graph') -> str:
    """Hosts, processes and nodes, and of each node what it sends, hears and offers."""
    return '\n'.join(_lines(graph)) + '\n'


def _lines(graph: 'Graph') -> Iterator[str]:
    yield f'{graph.snapshot.master}: {_summary(graph)}'
    uses = _Uses(graph)
    for host in graph.hosts:
        yield f'host {host.name}'
        for process in host.processes:
            yield '  ' + ('no process known' if process.pid is None else f'process {process.pid}')
            for name in process.nodes:
                node = graph.nodes[name]
                state = '' if node.state == ALIVE else f'  [{node.state}: {node.problem}]'
                yield f'    {name}{state}'
                yield from ('      ' + line for line in uses.of(name))


def _summary(graph: 'Graph') -> str:
    processes = sum(len(host.processes) for host in graph.hosts)
    counts = [
        counted(len(graph.nodes), 'node'),
        counted(processes, 'process', 'processes'),
        counted(len(graph.hosts), 'host'),
    ]
    if not graph.nodes_only:
        counts.append(counted(len(graph.topics), 'topic'))
    return ', '.join(counts)


class _Uses:
    """What the nodes of a graph do with its topics and services."""

    def __init__(self, graph: 'Graph') -> None:
        self._graph = graph
        self._sends: Dict[str, List[Edge]] = {}  # from and to each node
        for edge in graph.edges:
            if edge.kind == SENDS:
                for node in edge.start, edge.end:
                    self._sends.setdefault(node, []).append(edge)

    def of(self, node: str) -> Iterator[str]:
        """A line for each thing that the node sends, hears and offers."""
        for edge in self._sends.get(node, ()):
            arrow, peer = ('->', edge.end) if node == edge.start else ('<-', edge.start)
            yield f'{arrow} {peer} ({_joined(edge.transports)})  {", ".join(edge.topics)}'
        for name, topic in self._graph.topics.items():
            if node in topic.publishers:
                peers = [(name, node, subscriber) for subscriber in topic.subscribers]
                heard = 'to ' + self._peers(peers, 2) if peers else 'nobody hears it'
                yield f'-> {name}  {self._about(name)}  {heard}'
        for name, topic in self._graph.topics.items():
            if node in topic.subscribers:
                peers = [(name, publisher, node) for publisher in topic.publishers]
                sent = 'from ' + self._peers(peers, 1) if peers else 'nobody publishes it'
                yield f'<- {name}  {sent}'
        for name, service in self._graph.services.items():
            if node in service.providers:
                yield f'offers {name}'

    def _about(self, topic: str) -> str:
        rate = self._graph.rates.get(topic)
        said = self._graph.topics[topic].type or 'type unknown'
        return said if rate is None else f'{said}, {rate_text(rate)}'

    def _peers(self, ends: List[Tuple[str, str, str]], other: int) -> str:
        return ', '.join(
            f'{each[other]} ({_joined(self._graph.snapshot.transports.get(each, ()))})'
            for each in ends
        )


def _joined(transports: Collection[str]) -> str:
    return ' and '.join(sorted(transports)) or 'not connected'
