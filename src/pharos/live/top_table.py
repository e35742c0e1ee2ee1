"""Tables of a Measurement: those of ``rosrun pharos top``. Needs Debian's python3-rich."""
from typing import Any, Callable, Collection, List, NamedTuple, Optional

from rich.table import Table
from rich.text import Text

from pharos.live.figures import short_number, short_rate
from pharos.live.message_text import printable
from pharos.live.top import Measurement, is_wanted

VIEWS = ('nodes', 'processes', 'topics')
WIDEST = 10000  # columns; more than any table has
BAD = 'bold red'


class Column(NamedTuple):
    """A column of a table; what it holds sorts as it is, with what is not known at the end."""

    title: str
    value: Callable[[Any], Any]  # of a row
    text: Callable[[Any], str]  # of a value
    is_number: bool = True
    least_width: int = 0  # of the terminal, for it to be shown
    is_bad: bool = False  # whether it is, where it is not 0
    share: int = 0  # of the width that the numbers leave


def _percent(value: float) -> str:
    return f'{value:.0f}%'


def _node(row: Any) -> str:
    return row.name if row.state == 'alive' else f'{row.name} ({row.state})'


def _known(text: Callable[[Any], str]) -> Callable[[Any], str]:
    """The same for what may not be known."""
    return lambda value: '-' if value is None else text(value)


def _number(title: str, field: str, text: Callable[[Any], str], **more: Any) -> Column:
    return Column(title, lambda row: getattr(row, field), _known(text), **more)


def _word(title: str, value: Callable[[Any], Any], **more: Any) -> Column:
    return Column(title, value, _known(str), is_number=False, **more)


_TRAFFIC = (
    _number('IN/S', 'received', short_rate),
    _number('OUT/S', 'sent', short_rate),
    _number('IN B/S', 'bytes_received', short_number),
    _number('OUT B/S', 'bytes_sent', short_number),
)
_TRANSPORT = (
    _number('LOCAL', 'intraprocess', short_number),
    _number('TCP', 'tcpros', short_number),
)
_DROPPED = _number('DROP', 'dropped', short_number, is_bad=True)
_TROUBLE = (_DROPPED, _number('FAIL', 'failures', short_number, is_bad=True))
COLUMNS = {
    'nodes': (
        _word('NODE', _node, share=1),
        _word('CLASS', lambda row: row.class_name, least_width=110, share=1),
        _word('HOST', lambda row: row.host, least_width=130),
        _number('PID', 'pid', str, least_width=100),
        *_TRAFFIC,
        *_TRANSPORT,
        *_TROUBLE,
    ),
    'processes': (
        _number('PID', 'pid', str),
        _word('HOST', lambda row: row.host, least_width=100),
        _number('CPU', 'cpu', _percent),
        _number('MEM', 'memory', short_number),
        _number('THR', 'threads', str, least_width=100),
        *_TRAFFIC,
        *_TROUBLE,
        _word('NODES', lambda row: ' '.join(row.nodes), share=1),
    ),
    'topics': (
        _word('TOPIC', lambda row: row.name, share=3),
        _word('TYPE', lambda row: row.type, share=2),
        _number('HZ', 'rate', short_rate),
        _number('B/S', 'bandwidth', short_number),
        Column('PUB', lambda row: len(row.publishers), str),
        Column('SUB', lambda row: len(row.subscribers), str),
        *_TRANSPORT,
        _DROPPED,
    ),
}


def columns(view: str, width: int) -> List[Column]:
    """Those of a view that a terminal of that width has room for."""
    return [column for column in COLUMNS[view] if width >= column.least_width]


def rows(measurement: Measurement, view: str, wanted: Collection[str] = ()) -> List[Any]:
    """The rows of a view: of the processes, those with a node that is wanted."""
    found: List[Any] = getattr(measurement, view)
    if view == 'processes':
        return [row for row in found if any(is_wanted(name, wanted) for name in row.nodes)]
    return [row for row in found if is_wanted(row.name, wanted)]


def sort(found: List[Any], column: Column, is_reversed: bool) -> List[Any]:
    """The rows by a column: numbers the largest first, words by the alphabet, or the other way
    round; what is not known comes last."""
    known = [row for row in found if column.value(row) is not None]
    known.sort(key=column.value, reverse=column.is_number is not is_reversed)
    return [*known, *(row for row in found if column.value(row) is None)]


def table(
    found: List[Any], shown: List[Column], sorted_by: Optional[Column] = None, expand: bool = False
) -> Table:
    """A table of rows.

    :param sorted_by: the column whose title is marked
    :param expand: whether it is to be as wide as the terminal
    """
    made = Table(box=None, padding=(0, 1, 0, 0), header_style='bold', expand=expand)
    for column in shown:
        title = Text(column.title, style='reverse' if column is sorted_by else '')
        made.add_column(
            title,
            justify='right' if column.is_number else 'left',
            no_wrap=True,
            overflow='ellipsis',
            ratio=column.share or None,
        )
    for row in found:
        made.add_row(*(_cell(column, row) for column in shown))
    return made


def _cell(column: Column, row: Any) -> Text:
    value = column.value(row)
    is_bad = column.is_bad and value or getattr(row, 'state', 'alive') != 'alive'
    return Text(printable(column.text(value)), style=BAD if is_bad else '')


def plain_tables(measurement: Measurement) -> List[Table]:
    """A table for each view, with all columns."""
    return [table(rows(measurement, view), columns(view, WIDEST)) for view in VIEWS]
