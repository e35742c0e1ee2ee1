"""What ``thing?`` tells at a prompt of the things of a graph: type, fields, who is there, how often.

:func:`explain` is for any program, :func:`equip` has IPython use it.
"""
from typing import Any, Callable, Dict, Iterable, Iterator, List, Optional

from pharos import messages
from pharos.channel import Channel, InputChannel
from pharos.counts import counted
from pharos.errors import PharosError
from pharos.external_node import ExternalNode
from pharos.master import Master
from pharos.node import Node
from pharos.offered_service import OfferedService
from pharos.parameter import Parameter
from pharos.service import Service
from pharos.topic import Topic

SECONDS = 1.0  # for which messages are counted


def explain(thing: Any, seconds: float = SECONDS) -> Optional[str]:
    """A topic, channel, node, service, parameter or master in words, as it is now; None for all
    else.

    :param seconds: for which messages are counted, to tell how often they come; 0: that is not told
    """
    for kind, lines in _LINES.items():
        if isinstance(thing, kind):
            return '\n'.join(_as_far_as_told(lines(thing, seconds)))
    return None


def _as_far_as_told(lines: Iterable[str]) -> Iterator[str]:
    try:
        yield from lines
    except (PharosError, ValueError) as error:
        yield str(error)


def _node(node: Any, seconds: float) -> Iterator[str]:
    yield str(node.describe(seconds))


def _topic(topic: Topic, seconds: float) -> Iterator[str]:
    type_ = topic.type
    yield f'{topic.name} [{type_}]'
    yield from _fields('fields', lambda: messages.message_class(type_))
    yield from _users(topic, seconds)


def _channel(channel: Channel, seconds: float) -> Iterator[str]:
    yield f'{channel.topic} [{channel.type}], an {type(channel).__name__} of {channel.node.name}'
    yield from _fields('fields', lambda: channel.message_class)
    if isinstance(channel, InputChannel):
        yield f'  received {channel.received}, dropped {channel.dropped}, refused {channel.refused}'
    else:
        yield f"  sent {getattr(channel, 'sent', 0)}"
    peers = [f'{name} by {transport}' for name, transport in channel.connections]
    yield f'  connected with {_all(peers)}'
    yield from _users(channel.node.master.topic(channel.topic), seconds)


def _users(topic: Topic, seconds: float) -> Iterator[str]:
    """Who uses a topic, and how often messages come on it."""
    yield f'  published by {_all(topic.publishers)}'
    yield f'  heard by {_all(topic.subscribers)}'
    if seconds and topic.publishers:
        yield f'  {topic.hz(seconds)}'


def _service(service: Any, seconds: float) -> Iterator[str]:
    yield f'{service.name} [{service.type}]'
    yield from _fields('request', lambda: service.service_class._request_class)
    yield from _fields('response', lambda: service.service_class._response_class)
    master = service.master if isinstance(service, Service) else service.node.master
    yield f'  offered by {_all(master.system_state()[2].get(service.name, []))}'


def _parameter(parameter: Parameter, seconds: float) -> Iterator[str]:
    value = parameter.value
    yield f'{parameter.name} = {value!r} [{type(value).__name__}], a parameter of {parameter.node.name}'


def _master(master: Master, seconds: float) -> Iterator[str]:
    yield f'the ROS master {master.url}, process {master.pid}'
    names = [node.name for node in master.nodes()]
    local = {node.name for node in master.local_nodes()}
    yield f'  nodes of this process {_all([name for name in names if name in local])}'
    yield f'  others {_all([name for name in names if name not in local])}'
    topics = counted(len(master.topics()), 'topic')
    yield f"  {topics}, {counted(len(master.services()), 'service')}"


def _fields(title: str, find_class: Callable[[], Any]) -> Iterator[str]:
    """The fields of a message class, those of the messages in it indented."""
    yield f'  {title}'
    try:
        yield from _fields_of(find_class(), '    ')
    except PharosError as error:
        yield f'    {error}'


def _fields_of(cls: Any, indent: str) -> Iterator[str]:
    fields = messages.fields_of(cls)
    for name, type_ in fields:
        yield f'{indent}{name}: {type_}'
        base = type_.partition('[')[0]
        nested = messages.nested_class(cls, base) if '/' in base else None
        if nested is not None:
            yield from _fields_of(nested, indent + '  ')
    if not fields:
        yield f'{indent}none'


def _all(names: List[str]) -> str:
    return ', '.join(names) or 'nobody'


_LINES: Dict[type, Callable[[Any, float], Iterator[str]]] = {
    Node: _node,
    ExternalNode: _node,
    Topic: _topic,
    Channel: _channel,
    Service: _service,
    OfferedService: _service,
    Parameter: _parameter,
    Master: _master,
}


# -- in IPython


def equip(shell: Any) -> Callable[[], None]:
    """Have ``thing?`` of a session of IPython's tell it, in a terminal or a notebook, and
    ``thing??`` what it says otherwise, too; returns a function that ends it."""
    inspector = shell.inspector
    describe_otherwise = inspector.info

    def info(thing: Any, *args: Any, **options: Any) -> Any:
        found = describe_otherwise(thing, *args, **options)
        text = explain(thing)
        if text is not None:
            found['docstring'] = text
            if not options.get('detail_level'):
                for title in 'class_docstring', 'init_docstring', 'file', 'string_form', 'length':
                    found[title] = None
        return found

    def end() -> None:
        del inspector.info

    inspector.info = info
    return end
