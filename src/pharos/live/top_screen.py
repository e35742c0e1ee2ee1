"""The screen of ``rosrun pharos top``. Needs Debian's python3-rich."""
import os
import signal
import threading
import time
from typing import Any, List, Optional

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from pharos.errors import MasterUnreachableError
from pharos.live.message_text import printable
from pharos.live.terminal import Terminal
from pharos.live.top import Measurement, Meter
from pharos.live.top_table import (
    BAD,
    VIEWS,
    Column,
    columns,
    plain_tables,
    rows,
    sort,
    table,
)

KEYS = 'q quit  n nodes  p processes  t topics  s sort  r reverse  / filter  space pause'
LINES = 4  # beside the rows: what is looked at, how, the titles and the keys


class Screen:
    """What is shown, and how; changed by keys."""

    def __init__(self, measurement: Measurement, interval: float) -> None:
        self.measurement = measurement
        self.interval = interval
        self.away_since: Optional[float] = None  # the master does not answer, in seconds as of time
        self.is_paused = False
        self.view = VIEWS[0]
        self.filter = ''
        self.is_typing = False  # the filter
        self.top = 0  # the row that is shown first
        self._sorted_by = {'processes': 'CPU'}  # view -> title of a column; else the first one
        self._is_reversed = False

    # -- keys

    def press(self, key: str, console: Console) -> bool:
        """Do what a key asks for; returns whether it is to go on."""
        page = max(1, console.height - LINES)
        moves = {'up': -1, 'down': 1, 'page up': -page, 'page down': page}
        moves.update(home=-self.top, end=len(self._rows(console)))
        if key in moves:
            last = max(0, len(self._rows(console)) - page)
            self.top = min(max(0, self.top + moves[key]), last)
        elif self.is_typing:
            self._type(key)
        elif key in ('q', 'Q'):
            return False
        else:
            self._choose(key, console)
        return True

    def _type(self, key: str) -> None:
        self.top = 0
        if key in ('\n', 'escape'):
            self.is_typing = False
            self.filter = self.filter if key == '\n' else ''
        elif key == '\x7f':
            self.filter = self.filter[:-1]
        elif key.isprintable():
            self.filter += key

    def _choose(self, key: str, console: Console) -> None:
        views = {view[0]: view for view in VIEWS}
        if key in views:
            self.view, self.top = views[key], 0
        elif key == '\t':
            self.view, self.top = VIEWS[(VIEWS.index(self.view) + 1) % len(VIEWS)], 0
        elif key in 'sS':
            shown = columns(self.view, console.width)
            index = shown.index(self._sorting(console)) + (1 if key == 's' else -1)
            self._sorted_by[self.view] = shown[index % len(shown)].title
        elif key == 'r':
            self._is_reversed = not self._is_reversed
        elif key == '/':
            self.is_typing, self.filter = True, ''
        elif key == 'escape':
            self.filter = ''
        elif key == ' ':
            self.is_paused = not self.is_paused

    # -- what is drawn

    def _sorting(self, console: Console) -> Column:
        shown = columns(self.view, console.width)
        title = self._sorted_by.get(self.view)
        return next((column for column in shown if column.title == title), shown[0])

    def _rows(self, console: Console) -> List[Any]:
        wanted = [self.filter] if self.filter else []
        found = rows(self.measurement, self.view, wanted)
        return sort(found, self._sorting(console), self._is_reversed)

    def drawn(self, console: Console) -> Group:
        """All of it."""
        found, room = self._rows(console), max(0, console.height - LINES)
        visible = found[self.top : self.top + room]
        shown = columns(self.view, console.width)
        padding = [Text() for _ in range(room - len(visible))]
        return Group(
            self._line(self._heading(), console),
            self._line(self._state(len(found), len(visible)), console),
            table(visible, shown, self._sorting(console), expand=True),
            *padding,
            self._line(Text(KEYS, style='dim'), console),
        )

    @staticmethod
    def _line(text: Text, console: Console) -> Text:
        text.no_wrap, text.overflow = True, 'ellipsis'
        text.truncate(console.width, overflow='ellipsis')
        return text

    def _heading(self) -> Text:
        found = self.measurement
        text = Text('pharos top  ', style='bold')
        text.append(time.strftime('%H:%M:%S', time.localtime(found.time)))
        text.append(f'  every {self.interval:g} s  ')
        if found.is_measured:
            text.append('rates measured  ')
        if self.away_since is not None:
            since = time.strftime('%H:%M:%S', time.localtime(self.away_since))
            text.append(f'MASTER AWAY since {since}  ', style=BAD)
        return text.append(printable(found.master))

    def _state(self, count: int, visible: int) -> Text:
        text = Text()
        for view in VIEWS:
            number = len(getattr(self.measurement, view))
            text.append(f' {number} {view} ', style='reverse' if view == self.view else '')
            text.append(' ')
        if self.filter or self.is_typing:
            text.append(f' filter: {printable(self.filter)}')
            text.append('_' if self.is_typing else '', style='bold')
        if visible < count:
            text.append(f'  {self.top + 1} to {self.top + visible} of {count}')
        if self.is_paused:
            text.append('  PAUSED', style=BAD)
        return text


def show(meter: Meter, interval: float) -> int:
    """Show what the meter measures until a key or a signal ends it; returns the exit status.

    :param interval: seconds between two looks
    :raises MasterUnreachableError: if the master does not answer at the beginning
    """
    for size in 'COLUMNS', 'LINES':  # which rich takes as they are
        if os.environ.get(size) == '0':
            del os.environ[size]
    console, terminal = Console(), Terminal()
    screen = Screen(meter.measure(), interval)
    looking_on = _LookingOn(meter, screen, terminal)
    looking_on.start()
    try:
        while True:
            ended_by = _draw(console, terminal, screen, looking_on)
            if ended_by is not signal.SIGTSTP:
                break
            os.kill(os.getpid(), signal.SIGSTOP)  # and here it goes on, in the foreground again
    finally:
        looking_on.end()
        terminal.close()
    return 0 if ended_by is None or ended_by is signal.SIGINT else 128 + ended_by


def _draw(
    console: Console, terminal: Terminal, screen: Screen, looking_on: '_LookingOn'
) -> Optional[signal.Signals]:
    """Have the screen until something ends it; returns the signal that did, None for a key."""
    try:
        with terminal, Live(console=console, screen=True, auto_refresh=False) as live:
            while terminal.ended_by is None:
                if looking_on.failed_with is not None:
                    raise looking_on.failed_with
                live.update(screen.drawn(console), refresh=True)
                keys = terminal.keys()
                if not all(screen.press(key, console) for key in keys):
                    return None
    except OSError:
        if terminal.ended_by is not signal.SIGHUP:  # else there is no terminal any more
            raise
    return terminal.ended_by


class _LookingOn(threading.Thread):
    """Measures again and again: a master or a node may take its time."""

    def __init__(self, meter: Meter, screen: Screen, terminal: Terminal) -> None:
        super().__init__(name='top looks on', daemon=True)
        self._meter, self._screen, self._terminal = meter, screen, terminal
        self._ended = threading.Event()
        self._lock = threading.Lock()  # held to wake the terminal, which may be closed
        self.failed_with: Optional[BaseException] = None

    def run(self) -> None:
        screen = self._screen
        while not self._ended.wait(screen.interval) and self.failed_with is None:
            if screen.is_paused:
                continue
            try:
                screen.measurement = self._meter.measure()
                screen.away_since = None
            except MasterUnreachableError:
                screen.away_since = screen.away_since or time.time()
            except Exception as error:
                self.failed_with = error
            with self._lock:
                if not self._ended.is_set():
                    self._terminal.wake()

    def end(self) -> None:
        """Measure no more, and wake nobody."""
        with self._lock:
            self._ended.set()


def print_once(measurement: Measurement) -> None:
    """Print a Measurement as text, all columns of all tables, however long their lines are."""
    console = Console(width=10000, highlight=False, soft_wrap=True)
    for each in plain_tables(measurement):
        with console.capture() as captured:
            console.print(each)
        print('\n'.join(line.rstrip() for line in captured.get().splitlines()), end='\n\n')
