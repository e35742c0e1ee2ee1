"""Nodes in words: :meth:`Node.describe <pharos.Node.describe>` and that of an ExternalNode."""
import dataclasses
import os
import time
from typing import Any, Dict, Iterator, List, Optional, Tuple, Union

from pharos.blocks import text_of
from pharos.channel import InputChannel
from pharos.errors import PharosError
from pharos.external_node import ExternalNode
from pharos.live.answers import ALIVE, Answer, End, ask_all
from pharos.live.figures import rate_text
from pharos.live.snapshot import Connection, connections_of, uris_of
from pharos.live.traffic import Traffic
from pharos.node import Node
from pharos.output_channel import OutputChannel
from pharos.probe import Look

TIMEOUT = 2.0  # seconds that a node has to answer
WIDTH = 70  # characters of a parameter's value that are shown

AnyNode = Union[Node, ExternalNode]
Rates = Dict[Tuple[bool, str], float]  # (whether it is heard, topic) -> messages a second
Types = Dict[str, Optional[str]]  # topic or service -> type; None: it is not known


class Description(str):
    """A text that looks the same at a prompt as it is printed."""

    def __repr__(self) -> str:
        return str(self)


@dataclasses.dataclass
class _Account:
    """What a node says at a time."""

    answer: Answer
    connections: List[Connection]
    sent: Dict[str, int]  # topic -> messages so far, through a channel
    time: float  # when these were counted, in seconds as of time.monotonic()


def describe(node: AnyNode, seconds: float) -> Description:
    """The description of a node; where there are connections, rates are counted for so many
    seconds."""
    look = Look()
    now, rates = _account_of(node), {}
    if seconds and now.answer.ends:
        look.pause(seconds)
        before, now = now, _account_of(node)
        rates = _rates(node.name, before, now)
    return Description('\n'.join(_lines(node, now.answer, rates)))


def _account_of(node: AnyNode) -> _Account:
    is_own, uris = isinstance(node, Node), {node.name: node.uri}
    own = {node.name: node} if isinstance(node, Node) else {}
    answers = ask_all(uris, own, TIMEOUT, counts=True, plain=None if is_own else set())
    sent = {
        channel.topic: channel.sent
        for channel in _channels(node)
        if isinstance(channel, OutputChannel)
    }
    now = time.monotonic()
    return _Account(answers[node.name], connections_of(uris, answers), sent, now)


def _rates(name: str, before: _Account, now: _Account) -> Rates:
    """Messages a second of its topics; a channel counts those, too, that nobody hears."""
    traffic = Traffic(before.connections, now.connections)
    rates = {(True, topic): rate for (topic, by), rate in traffic.heard.items() if by == name}
    for (topic, publisher), (rate, _) in traffic.published.items():
        if publisher == name:
            rates[False, topic] = rate
    for topic, count in now.sent.items():
        sent = count - before.sent.get(topic, 0)
        rates[False, topic] = max(0, sent) / (now.time - before.time)
    return rates


def _peers(node: AnyNode, ends: List[End]) -> Dict[Tuple[bool, str], List[str]]:
    """``{(whether it is heard, topic): 'to <node> by <transport>' of each connection, or 'from'}``."""
    names = _names_of(node, [end for end in ends if end.other.startswith('http')])
    peers: Dict[Tuple[bool, str], List[str]] = {}
    for end in sorted(ends, key=lambda end: end[:4]):
        way = 'from' if end.is_inbound else 'to'
        peer = f'{way} {names.get(end.other, end.other)} by {end.transport}'
        peers.setdefault((end.is_inbound, end.topic), []).append(peer)
    return peers


def _names_of(node: AnyNode, ends: List[End]) -> Dict[str, str]:
    """``{URI: name}`` of the nodes at the other ends: publishers have the names, subscribers not."""
    names = {local.uri: local.name for local in node.master.local_nodes() if local.uri}
    topics = {end.topic for end in ends if end.other not in names}
    if topics:
        try:
            publishers, _, _ = node.master.system_state()
            users = sorted({name for topic in topics for name in publishers.get(topic, ())})
            uris = uris_of(node.master, users)
            names.update({uri: name for name, uri in uris.items() if uri})
        except PharosError:  # the master is away
            pass
    return names


def _lines(node: AnyNode, answer: Answer, rates: Rates) -> Iterator[str]:
    own = node if isinstance(node, Node) else None
    yield from _own_head(own) if own else _head(node, answer)
    peers = _peers(node, answer.ends or [])
    dropped = (answer.health or {}).get('dropped', {})
    for title, is_heard, types in _topics(node):
        lines = []
        for topic, type_ in types.items():
            parts = [_typed(topic, type_), *_counted(own, is_heard, topic, rates)]
            if is_heard and topic in dropped:
                parts.append(f'dropped {dropped[topic]}')
            parts.append(', '.join(peers.get((is_heard, topic), ['not connected'])))
            lines.append(', '.join(parts))
        yield from _section(title, lines)
    yield from _section('offers', _services(node, answer.state == ALIVE))
    yield from _section('parameters', list(_parameters(node)))
    if own:
        yield from _section('failures', [repr(failure) for failure in own.failures])


def _section(title: str, lines: List[str]) -> Iterator[str]:
    if lines:
        yield title
        yield from (f'  {line}' for line in lines)


def _own_head(node: Node) -> Iterator[str]:
    yield f'{node.name}: {type(node).__name__}, {node.lifecycle.value}: {node.health()}'
    yield f'  pid {os.getpid()} at {node.domain}, this process; {node.uri}, TCPROS {node.tcp_port}'
    souls = [soul.name for soul in node.latest_run.souls.forked] if node.is_running else []
    if souls:
        yield f"  souls: {', '.join(souls)}"


def _head(node: AnyNode, answer: Answer) -> Iterator[str]:
    health = answer.health or {}
    class_name = f"{health['class']}, " if health else ''
    problem = f': {answer.problem}' if answer.problem else ''
    yield f'{node.name}: {class_name}a node of another process, {answer.state}{problem}'
    yield f'  pid {answer.pid or "unknown"} at {answer.host}; {node.uri}'
    if health:
        dropped = sum(health['dropped'].values())
        counts = (f'{health[what]} {what}' for what in ('failures', 'souls', 'threads'))
        yield f"  {dropped} dropped, {', '.join(counts)}"


def _channels(node: AnyNode) -> List[Any]:
    return list(node.channels) if isinstance(node, Node) else []


def _topics(node: AnyNode) -> List[Tuple[str, bool, Types]]:
    """(what it does with them, whether it hears them, the topics)."""
    publishes: Types = {}
    hears: Types = {}
    if isinstance(node, ExternalNode):
        publishes, hears = node.publications, node.subscriptions
    elif node.is_running:
        topics = node.latest_run.rospy.topics
        publishes, hears = dict(topics.get_publications()), dict(topics.get_subscriptions())
    return [
        ('publishes', False, dict(sorted(publishes.items()))),
        ('hears', True, dict(sorted(hears.items()))),
    ]


def _counted(own: Optional[Node], is_heard: bool, topic: str, rates: Rates) -> Iterator[str]:
    """What is known of the messages of a topic of a node."""
    rate = rates.get((is_heard, topic))
    if rate is not None:
        yield rate_text(rate)
    for channel in _channels(own) if own else ():
        if channel.topic == topic and isinstance(channel, InputChannel) == is_heard:
            yield _channel_text(channel)


def _channel_text(channel: Any) -> str:
    if isinstance(channel, OutputChannel):
        return f"sent {channel.sent}{', latched' if channel.latch else ''}"
    refused = f', refused {channel.refused}' if channel.refused else ''
    from_ = f', from {channel.from_} alone' if channel.from_ else ''
    return f'received {channel.received}, dropped {channel.dropped}{refused}{from_}'


def _typed(name: str, type_: Optional[str]) -> str:
    return f'{name} [{type_ or "of unknown type"}]'


def _services(node: AnyNode, is_alive: bool) -> List[str]:
    """Those that it offers; one that does not answer is not asked for their types."""
    types: Types = {}
    if isinstance(node, ExternalNode):
        for name in node.services:
            types[name] = _type_of_service(node, name) if is_alive else None
    elif node.is_running:
        manager = node.latest_run.rospy.service_manager
        for name, _ in manager.get_services():
            service = manager.get_service(name)  # None: it was closed meanwhile
            types[name] = service and service.service_class._type
    return [_typed(*each) for each in sorted(types.items())]


def _type_of_service(node: ExternalNode, name: str) -> Optional[str]:
    try:
        return node.master.lookup_service(name).type
    except PharosError:
        return None


def _parameters(node: AnyNode) -> Iterator[str]:
    """Those that are the node's own."""
    try:
        found = node.master.parameters.get(node.name, {})
    except PharosError as error:
        yield str(error)
        return
    except ValueError:  # rospy's node has another name than one of ours could, and none of these
        return
    for name, value in sorted(found.items()) if isinstance(found, dict) else ():
        text = text_of(value)
        yield f'~{name}: {text if len(text) <= WIDTH else text[:WIDTH] + "..."}'
