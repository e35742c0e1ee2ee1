"""Tell numbers, messages and nodes in words."""
import time

import genpy

from pharos.errors import UnknownNodeError
from pharos.live import snapshot

LONGEST = 12  # values of an array, and lines of a text, that are shown


def number(value):
    """Return a number in at most five characters, '-' for None: 9.9, 120, 1.2k, 35M."""
    if value is None:
        return '-'
    for unit in ('', 'k', 'M'):
        if abs(value) < 999.5:
            digits = 0 if value == int(value) or value > 99 else 1
            return f'{value:.{digits}f}{unit}'
        value /= 1000
    return f'{value:.1f}G'


def text_of(message):
    """Return a message as ``rostopic echo`` prints it, with long arrays and texts cut."""
    return genpy.message.strify_message(_cut(message))


def _cut(value):
    if isinstance(value, genpy.Message):
        copy = object.__new__(type(value))
        for name in value.__slots__:
            setattr(copy, name, _cut(getattr(value, name)))
        return copy
    if isinstance(value, str) and len(value) > LONGEST * 80:
        return f'{value[:LONGEST * 80]} ... {len(value)} in all'
    if isinstance(value, (bytes, list, tuple)) and len(value) > LONGEST:
        first = ', '.join(str(_cut(each)) for each in value[:3])
        return _Text(f'[{first}, ... {len(value)} in all]')
    return value


class _Text:
    """Is written by genpy as it is."""

    def __init__(self, text):
        self.text = text

    def __str__(self):
        return self.text


class Description(str):
    """A text that is shown as it is."""

    __repr__ = str.__str__


def describe(master, name, seconds):
    """Return a node in words; its rates are counted for so many seconds.

    :raises UnknownNodeError: if the master does not know the node
    """
    before = snapshot.take(master)
    time.sleep(seconds)
    now = snapshot.take(master)
    if name not in now.nodes:
        raise UnknownNodeError(f'no node {name} is known at {now.master}: see rosnode list')
    seen, rates = now.nodes[name], now.rates_since(before)
    health = ', '.join(f'{what} {value}' for what, value in seen.health.items())
    lines = [f'{name}: pid {seen.pid} at {seen.host}, {seen.uri} {seen.problem}', f'  {health}']
    for title, topics, own, peer in (
        ('publishes', seen.publishes, 1, 2),
        ('subscribes to', seen.subscribes, 2, 1),
    ):
        for topic in topics:
            links = [link for link in now.links if link.topic == topic and link[own] == name]
            peers = ', '.join(f'{link[peer]} by {link.transport}' for link in links) or 'nobody'
            rate = max((rates.get(link, (0, 0))[0] for link in links), default=0)
            lines.append(f'  {title} {topic} [{now.topics[topic]}] {number(rate)} Hz: {peers}')
    return Description('\n'.join([*lines, *(f'  offers {service}' for service in seen.offers)]))
