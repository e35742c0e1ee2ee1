"""Measure the nodes of a master, and show them as a table in a terminal.

Nodes count their messages anyway. Two snapshots give rates, so top subscribes to nothing.
"""
from __future__ import annotations

import contextlib
import os
import select
import sys
import termios
import tty
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from pharos.errors import MasterUnreachableError, PharosError
from pharos.live.snapshot import Snapshot, publisher_rates, take_snapshot
from pharos.master import Master

HELP = """q quit  s sort by the next column  / filter (Enter, Esc)  j k choose a node
r restart  x stop  a start  l reload the chosen node, if it is of a composition"""
ACTIONS = {'r': 'restart', 'x': 'stop', 'a': 'start', 'l': 'reload'}  # key -> action
WIDE_COLUMNS = 'NODE', 'PID'  # are never cut, however narrow the terminal is
ALARM_COLUMNS = 'DROP', 'FAIL', 'PROBLEM'  # are red unless the value is 0 or unknown
NARROW_WIDTH = 100  # characters; a narrower terminal has no room for the next two
OPTIONAL_COLUMNS = 'CLASS', 'HOST'
HEADER_HEIGHT = 5  # lines above the first row
HANG = 3.0  # seconds of a callback that are a problem


def _cpu_percent(name, snapshot, start):
    """Return the load of a node of pharos since the snapshot before, None if it is unknown."""
    with contextlib.suppress(KeyError):
        end_seconds = snapshot.nodes[name].health['cpu_seconds']
        seconds = end_seconds - start.nodes[name].health['cpu_seconds']
        return max(0.0, 100 * seconds / (snapshot.time - start.time))
    return None


def node_rows(snapshot: Snapshot, start: Snapshot) -> list[dict[str, Any]]:
    """Return a row ``{column: value}`` for each node; a value is None if it is unknown.

    :param start: an earlier snapshot: the rates are those since then
    """
    rows = []
    link_rates = snapshot.rates_since(start)
    message_rates = publisher_rates(link_rates)
    for name, node in snapshot.nodes.items():
        transports = [
            link.transport for link in snapshot.links if name in (link.publisher, link.subscriber)
        ]
        rows.append(
            {
                'NODE': name,
                'CLASS': node.health.get('kind'),
                'HOST': node.host,
                'PID': node.pid,
                'CPU%': _cpu_percent(name, snapshot, start),
                'IN/S': sum(rate for link, rate in link_rates.items() if link.subscriber == name),
                # a message counts once, however many nodes receive it
                'OUT/S': sum(rate for (_, sender), rate in message_rates.items() if sender == name),
                'LOCAL': transports.count('INTRAPROCESS'),
                'SHM': transports.count('SHARED_MEMORY'),
                'TCP': transports.count('TCPROS'),
                'DROP': node.health.get('dropped'),
                'FAIL': node.health.get('errors'),
                'PROBLEM': node.problem or _hang(node.health) or node.health.get('lock'),
            }
        )
    return rows


def _hang(health):
    """Return a text if a callback of a node of pharos has run for long, else None."""
    seconds = health.get('callback_seconds', 0)
    if seconds >= HANG:
        return f'delegate for {seconds:.0f} s, {health["waiting"]} wait'


def table(rows: list[dict[str, Any]], width: int, chosen: str = '') -> Table:
    """Return a table of rows.

    :param width: characters of a line; if there are few, some columns are left out
    :param chosen: the row of this node is marked
    """
    columns = list(rows[0]) if rows else ['nothing there']
    if width < NARROW_WIDTH:
        columns = [column for column in columns if column not in OPTIONAL_COLUMNS]
    rich_table = Table(box=None, padding=(0, 1, 0, 0))
    for column in columns:
        rich_table.add_column(column, no_wrap=column in WIDE_COLUMNS)
    for row in rows:
        cells = [_cell(column, row[column]) for column in columns]
        rich_table.add_row(*cells, style='reverse' if row['NODE'] == chosen else '')
    return rich_table


def _cell(column, value):
    if value in (None, ''):
        return '-'
    text = f'{round(value, 1):g}' if isinstance(value, float) else str(value)
    return Text(text, style='bold red' if column in ALARM_COLUMNS and value else '')


def _sort_key(value):
    """Sort numbers by size, the largest first, then texts by the alphabet, then the unknown."""
    if value in (None, ''):
        return 2, 0
    if isinstance(value, str):
        return 1, value
    return 0, -value


def show(master: Master, interval: float) -> None:
    """Show the table in the terminal until the key q or Ctrl-C.

    :param interval: seconds without a key until the next snapshot
    """
    keyboard = sys.stdin.fileno()
    terminal_settings = termios.tcgetattr(keyboard)
    tty.setcbreak(keyboard)
    try:
        with Live(console=Console(markup=False), screen=True, auto_refresh=False) as live:
            _show_nodes(live, master, interval, keyboard)
    finally:
        termios.tcsetattr(keyboard, termios.TCSADRAIN, terminal_settings)


def _show_nodes(live, master, interval, keyboard):
    start = take_snapshot(master)
    screen = _Screen(master, live.console, node_rows(take_snapshot(master), start))
    problem = ''
    while True:
        live.update(screen.page(problem), refresh=True)
        if select.select([keyboard], [], [], interval)[0]:
            key = os.read(keyboard, 1).decode('latin-1')
            if key == 'q' and not screen.is_typing:
                return
            screen.press(key)
        else:
            try:
                snapshot = take_snapshot(master)
                screen.rows = node_rows(snapshot, start)
                start = snapshot
                problem = ''
            except MasterUnreachableError as error:
                problem = str(error)


@dataclass
class _Screen:
    """The page that top shows in a terminal, as the keys have set it."""

    master: Master
    console: Console
    rows: list[dict[str, Any]]
    sort_column: str = 'NODE'
    filter: str = ''  # nodes without this text in their names are left out
    is_typing: bool = False  # True while keys extend the filter
    chosen_node: str = ''
    answer: str = ''  # of the last action

    def press(self, key):
        """Do what a key stands for; unknown keys do nothing."""
        if self.is_typing:
            self._type(key)
        elif key == '/':
            self.is_typing = True
            self.filter = ''
            self.chosen_node = ''  # the filter may hide the node
        elif key == 's' and self.rows:
            self.sort_column = _neighbour(list(self.rows[0]), self.sort_column, 1)
        elif key in 'jk':
            names = [row['NODE'] for row in self._visible_rows()]
            self.chosen_node = _neighbour(names, self.chosen_node, 1 if key == 'j' else -1)
        elif key in ACTIONS and self.chosen_node:
            self.answer = _control(ACTIONS[key], self.chosen_node, self.master)

    def _type(self, key):
        if key in '\r\n':  # Enter is one or the other, as Python's release has it
            self.is_typing = False
        elif key == '\x1b':  # Escape
            self.is_typing = False
            self.filter = ''
        elif key == '\x7f':  # Backspace
            self.filter = self.filter[:-1]
        elif key.isprintable():
            self.filter += key

    def _visible_rows(self):
        """Return the rows that the filter leaves, in their order, as far as there is room."""
        rows = [row for row in self.rows if self.filter in row['NODE']]
        rows.sort(key=lambda row: _sort_key(row[self.sort_column]))
        return rows[: self.console.height - HEADER_HEIGHT]

    def page(self, problem):
        """Return the page.

        :param problem: the reason why the rows are old, or an empty text
        """
        rows = self._visible_rows()
        page = Table.grid()
        counts = f'{len(rows)} of {len(self.rows)} nodes, sorted by {self.sort_column}'
        page.add_row(f'{HELP}\n{counts}, filter: {self.filter}\n{problem or self.answer}')
        page.add_row(table(rows, self.console.width, self.chosen_node))
        return page


def _neighbour(names, name, step):
    """Return the name that comes after a name, or before; the first if the name is not there."""
    if name not in names:
        return names[0] if names else ''
    return names[(names.index(name) + step) % len(names)]


def _control(action, name, master):
    """Restart, stop, start or reload a node, and return a line that says how that went."""
    from pharos.compose.control import control

    try:
        return f'{action} done: {control(action, name, master)}'
    except PharosError as error:
        return str(error)
