"""How the things of a graph look in a notebook: as HTML, or as a picture where that says more.

:func:`html_of` is for any program, :func:`equip` has IPython use it. For pictures of messages see
:mod:`pharos.live.pictures`, for those of graphs :meth:`Master.graph <pharos.Master.graph>`.
"""
import html
from typing import Any, Callable, Iterator, Optional, Tuple

import genpy

from pharos import messages
from pharos.blocks import attempt
from pharos.channel import Channel
from pharos.external_node import ExternalNode
from pharos.live.explanation import explain
from pharos.live.message_text import cut
from pharos.live.pictures import has_picture, register
from pharos.master import Master
from pharos.node import Node
from pharos.offered_service import OfferedService
from pharos.parameter import Parameter
from pharos.service import Service
from pharos.topic import Topic

_KINDS = (
    *(genpy.Message, Master, Node, ExternalNode, Topic, Channel),
    *(Service, OfferedService, Parameter),
)


def html_of(thing: Any) -> Optional[str]:
    """A message as a table of its fields, and a node, topic, channel, service, parameter or master
    as :func:`~pharos.live.explanation.explain` has it; None for all else."""
    if isinstance(thing, genpy.Message):
        rows = ''.join(
            f'<tr><td style="text-align:left">{name}</td>'
            f'<td style="text-align:left"><code>{html.escape(value)}</code></td></tr>'
            for name, value in _rows(thing, '')
        )
        return f'<table><caption>{html.escape(thing._type)}</caption>{rows}</table>'
    text = explain(thing, seconds=0)
    if text is None:
        return None
    first, _, rest = text.partition('\n')
    return f'<pre><b>{html.escape(first)}</b>\n{html.escape(rest)}</pre>'


def _rows(message: Any, path: str) -> Iterator[Tuple[str, str]]:
    """``(name, value as text)`` of all fields, those of messages in it by their paths."""
    for name, _ in messages.fields_of(type(message)):
        value = getattr(message, name, None)  # None: a block has deleted it
        if isinstance(value, genpy.Message):
            yield from _rows(value, f'{path}{name}.')
        else:
            yield path + name, genpy.message.strify_message(cut(value)).strip()


def equip(shell: Any) -> Callable[[], None]:
    """Have a session of IPython's show things so where it can; returns a function that ends it."""
    formatters = shell.display_formatter.formatters
    register(shell)
    for kind in _KINDS:
        formatters['text/html'].for_type(kind, _html)

    def end() -> None:
        for kind in _KINDS:
            for formatter in formatters.values():
                formatter.pop(kind, None)

    return end


def _html(thing: Any) -> Optional[str]:
    """The HTML, which browsers prefer to a picture: none where there is one."""
    if has_picture(thing):
        return None
    text: Optional[str] = attempt(lambda: html_of(thing))
    return text
