"""Format numbers, messages and nodes as text."""
from __future__ import annotations

import time
from typing import TYPE_CHECKING

import genpy

from pharos.errors import UnknownNodeError
from pharos.live.snapshot import take_snapshot

if TYPE_CHECKING:
    from pharos.master import Master

MAX_ITEMS = 12  # items of an array, and lines of a text, that are shown
LINE_LENGTH = 80


def short_number(value: float) -> str:
    """Return a number in at most five characters: 9.9, 120, 1.2k, 35M."""
    for unit in '', 'k', 'M':
        if abs(value) < 999.5:
            if value > 99 or value == int(value):
                return f'{value:.0f}{unit}'
            return f'{value:.1f}{unit}'
        value /= 1000
    return f'{value:.1f}G'


def message_text(message: genpy.Message) -> str:
    """Return a message as ``rostopic echo`` prints it, with long arrays and texts cut."""
    return genpy.message.strify_message(_short_value(message))


def _short_value(value):
    """Return a copy of a message, or of a value in one, that is short enough to be shown."""
    if isinstance(value, genpy.Message):
        message = object.__new__(type(value))  # skips the default values of __init__
        for field in value.__slots__:
            setattr(message, field, _short_value(getattr(value, field)))
        return message
    max_length = MAX_ITEMS * LINE_LENGTH
    if isinstance(value, str) and len(value) > max_length:
        return f'{value[:max_length]} ... {len(value)} in all'
    if isinstance(value, (bytes, list, tuple)) and len(value) > MAX_ITEMS:
        first_items = ', '.join(str(_short_value(item)) for item in value[:3])
        return _PlainText(f'[{first_items}, ... {len(value)} in all]')
    return value


class _PlainText:
    """A text that genpy writes without quotes, since it is not a str."""

    def __init__(self, text):
        self._text = text

    def __str__(self):
        return self._text


class Description(str):
    """A text that a prompt shows without quotes."""

    __repr__ = str.__str__


def describe(master: Master, node_name: str, seconds: float) -> Description:
    """Return a text about a node, with rates that are counted for some seconds.

    :raises UnknownNodeError: if the master does not know the node
    """
    start = take_snapshot(master)
    time.sleep(seconds)
    snapshot = take_snapshot(master)
    if node_name not in snapshot.nodes:
        raise UnknownNodeError(f'no node {node_name} is known at {master.url}: see rosnode list')
    node = snapshot.nodes[node_name]
    link_rates = snapshot.rates_since(start)

    def topic_text(topic, is_incoming):
        links = snapshot.links_of(node_name, topic, is_incoming)
        peers = [f'{link.peer_of(node_name)} by {link.transport}' for link in links]
        peer_text = ', '.join(peers) or 'nobody'
        rates = [link_rates[link].messages for link in links if link in link_rates]
        rate_text = short_number(max(rates, default=0))
        return f'{topic} [{snapshot.topics[topic]}] {rate_text} Hz: {peer_text}'

    health = ', '.join(f'{fact} {value}' for fact, value in node.health.items())
    lines = [f'{node_name}: pid {node.pid} at {node.host}, {node.uri} {node.problem}']
    lines.append(f'  {health}')
    lines += [f'  publishes {topic_text(topic, False)}' for topic in node.publishes]
    lines += [f'  subscribes to {topic_text(topic, True)}' for topic in node.subscribes]
    lines += [f'  offers {service}' for service in node.offers]
    return Description('\n'.join(lines))
