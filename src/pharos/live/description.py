"""Nodes in words: :meth:`Node.describe <pharos.Node.describe>` and that of an ExternalNode."""
import dataclasses
import os
import time
from typing import Any, Dict, Iterator, List, Optional, Tuple, Union

from pharos.blocks import text_of
from pharos.channel import InputChannel
from pharos.errors import PharosError
from pharos.external_node import ExternalNode
from pharos.live.answers import ALIVE, Answer, ask_all
from pharos.live.watching import number_text
from pharos.node import Node
from pharos.output_channel import OutputChannel
from pharos.probe import Look

TIMEOUT = 2.0  # seconds that a node has to answer
WIDTH = 70  # characters of a parameter's value that are shown

AnyNode = Union[Node, ExternalNode]
Types = Dict[str, Optional[str]]  # topic or service -> type; None: it is not known


class Description(str):
    """A text that looks the same at a prompt as it is printed."""

    def __repr__(self) -> str:
        return str(self)


@dataclasses.dataclass
class _Account:
    """What a node says at a time."""

    answer: Answer
    time: float
    #: (whether it is heard, topic) -> messages so far, where they are counted
    counts: Dict[Tuple[bool, str], int]
    #: likewise -> 'to <node> by <transport>' of each connection, or 'from'
    peers: Dict[Tuple[bool, str], List[str]]


def describe(node: AnyNode, seconds: float) -> Description:
    """The description of a node; where there are connections, rates are counted for so many
    seconds."""
    look = Look()
    before = _account_of(node)
    if seconds and before.answer.ends:
        look.pause(seconds)
        return Description('\n'.join(_lines(node, before, _account_of(node))))
    return Description('\n'.join(_lines(node, None, before)))


def _account_of(node: AnyNode) -> _Account:
    own = {node.name: node} if isinstance(node, Node) else {}
    answer = ask_all({node.name: node.uri}, own, TIMEOUT, counts=True)[node.name]
    now = _Account(answer, time.monotonic(), {}, {})
    for end in sorted(answer.ends or (), key=lambda end: end[:4]):
        key = end.is_inbound, end.topic
        peer = f"{'from' if end.is_inbound else 'to'} {_name_of(end.other, node)}"
        now.peers.setdefault(key, []).append(f'{peer} by {end.transport}')
        count = end.counts.get('received' if end.is_inbound else 'sent')
        if count is not None:
            former = now.counts.get(key, 0)
            # each subscriber gets a copy of what is sent, and each publisher sends something else
            now.counts[key] = former + count if end.is_inbound else max(former, count)
    for channel in _channels(node):
        if isinstance(channel, OutputChannel):
            now.counts[False, channel.topic] = channel.sent
    return now


def _name_of(other: str, node: AnyNode) -> str:
    """The name of the node at the other end, which publishers have for it, but subscribers not."""
    if not other.startswith('http'):
        return other
    for local in node.master.local_nodes():
        if local.uri == other:
            return local.name
    try:
        publishers, _, _ = node.master.system_state()
        for name in sorted({name for names in publishers.values() for name in names}):
            if node.master.uri_of(name) == other:
                return name
    except PharosError:  # the master is away
        pass
    return other


def _lines(node: AnyNode, before: Optional[_Account], now: _Account) -> Iterator[str]:
    own = node if isinstance(node, Node) else None
    yield from _own_head(own) if own else _head(node, now.answer)
    for title, is_heard, types in _topics(node):
        yield from _section(
            title,
            [_topic_line(own, is_heard, topic, types[topic], before, now) for topic in types],
        )
    yield from _section('offers', _services(node, now.answer.state == ALIVE))
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
    problem = f': {answer.problem}' if answer.problem else ''
    yield f'{node.name}: a node of another process, {answer.state}{problem}'
    yield f'  pid {answer.pid or "unknown"} at {answer.host}; {node.uri}'


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


def _topic_line(
    own: Optional[Node],
    is_heard: bool,
    topic: str,
    type_: Optional[str],
    before: Optional[_Account],
    now: _Account,
) -> str:
    """What there is to say of a topic of a node."""
    key = is_heard, topic
    parts = [_typed(topic, type_)]
    if before is not None and key in now.counts:
        count = now.counts[key] - before.counts.get(key, 0)
        parts.append(f'{number_text(max(0, count) / (now.time - before.time))} Hz')
    for channel in _channels(own) if own else ():
        if channel.topic == topic and isinstance(channel, InputChannel) == is_heard:
            parts.append(_channel_text(channel))
    parts.append(', '.join(now.peers.get(key, ['not connected'])))
    return ', '.join(parts)


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
    for name, value in sorted(found.items()) if isinstance(found, dict) else ():
        text = text_of(value)
        yield f'~{name}: {text if len(text) <= WIDTH else text[:WIDTH] + "..."}'
