"""Failures of a node as a table: ``node.failures`` at a prompt."""
import html
import itertools
import re
import reprlib
import shutil
import textwrap
import time
from typing import Any, Iterator, List, Sequence

import genpy

from pharos import blocks
from pharos.failures import Failure
from pharos.live import message_text

HEADS = '#', 'count', 'when', 'block', 'cause', 'message'
GAP = '  '
LEAST = 12  # characters that a column has where the terminal is narrow
LONGEST = 160  # characters of a cause or message that are shown
DIGITS = 3  # of a number in a message
ROWS = 10  # failures that are shown: the newest
DAY = 24 * 60 * 60  # seconds


def as_text(failures: Sequence[Failure]) -> str:
    """The table, as wide as the terminal at the most."""
    if not failures:
        return 'no failures'
    rows = [list(HEADS), *_rows(failures)]
    widths = [max(map(len, column)) for column in zip(*rows)]
    room = shutil.get_terminal_size().columns - len(GAP) * (len(HEADS) - 1)
    while sum(widths) > room and max(widths) > LEAST:
        widths[widths.index(max(widths))] -= 1
    lines = [line for row in rows for line in _lines(row, widths)]
    return '\n'.join(lines + _more(failures))


def _lines(row: Sequence[str], widths: Sequence[int]) -> Iterator[str]:
    """A row, in as many lines as its longest cell needs."""
    wrapped = [textwrap.wrap(text, width) for text, width in zip(row, widths)]
    for cells in itertools.zip_longest(*wrapped, fillvalue=''):
        yield GAP.join(cell.ljust(width) for cell, width in zip(cells, widths)).rstrip()


def as_html(failures: Sequence[Failure]) -> str:
    """The table for a browser."""
    if not failures:
        return 'no failures'
    rows = [''.join(f'<td>{html.escape(text)}</td>' for text in row) for row in _rows(failures)]
    head = ''.join(f'<th>{head}</th>' for head in HEADS)
    table = f"<table><tr>{head}</tr>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>"
    return table + ''.join(_more(failures))


def _more(failures: Sequence[Failure]) -> List[str]:
    rest = len(failures) - ROWS
    return [f'... {rest} more, which are older'] if rest > 0 else []


def _rows(failures: Sequence[Failure]) -> List[List[str]]:
    rows = []
    for number, failure in list(enumerate(failures))[-ROWS:]:
        is_recent = time.time() - failure.time < DAY
        when = time.strftime('%H:%M:%S' if is_recent else '%Y-%m-%d', time.localtime(failure.time))
        cause = f'{type(failure.error).__name__}: {failure.text}'
        block = re.sub(' of /[^ ]*', '', failure.where, count=1)  # of the node, whose table it is
        cells = number, failure.count, when, block, cause, _message(failure.message)
        texts = [message_text.printable(' '.join(str(cell).split())) for cell in cells]
        rows.append([text if len(text) <= LONGEST else f'{text[:LONGEST]}...' for text in texts])
    return rows


def _message(message: Any) -> str:
    if message is None:
        return ''
    if not isinstance(message, genpy.Message):
        return str(blocks.attempt(lambda: reprlib.repr(message), '?'))
    # a block may have put into it what does not fit
    return str(blocks.attempt(lambda: _fields(message_text.cut(message)), f'<{message._type}>'))


def _fields(message: Any) -> str:
    """In one line that is broken between fields alone: ``x=2.62, y=3.63``."""
    return ', '.join(f'{name}={_value(getattr(message, name))}' for name in message.__slots__)


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f'{value:.{DIGITS}g}'
    if isinstance(value, genpy.TVal):
        return f'{value.to_sec()}'
    if isinstance(value, genpy.Message):
        return f'({_fields(value)})'
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    return repr(value) if isinstance(value, str) else str(value)
