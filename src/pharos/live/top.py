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
from typing import Any

from rich.live import Live
from rich.table import Table

from pharos.errors import MasterUnreachableError, PharosError
from pharos.live.snapshot import Snapshot, publisher_rates, take_snapshot
from pharos.master import Master

HELP = 'q quit  j k choose a node; if it is of a composition: r restart  x stop  a start  l reload'
ACTIONS = {'r': 'restart', 'x': 'stop', 'a': 'start', 'l': 'reload'}  # key -> action
WIDE_COLUMNS = 'NODE', 'PID'  # are never cut, however narrow the terminal is
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
                'PID': node.pid and str(node.pid),
                'CPU%': _cpu_percent(name, snapshot, start),
                'IN/S': sum(rate for link, rate in link_rates.items() if link.subscriber == name),
                # a message counts once, however many nodes receive it
                'OUT/S': sum(rate for (_, sender), rate in message_rates.items() if sender == name),
                'LOCAL': transports.count('INTRAPROCESS'),
                'SHM': transports.count('SHARED_MEMORY'),
                'TCP': transports.count('TCPROS'),
                'DROP': node.health.get('dropped'),
                'FAIL': node.health.get('errors'),
                'PROBLEM': node.problem or _hang(node.health),
            }
        )
    return rows


def _hang(health):
    """Return a text if a callback of a node of pharos has run for long, else None."""
    seconds = health.get('callback_seconds', 0)
    if seconds >= HANG:
        return f'delegate for {seconds:.0f} s, {health["waiting"]} wait'


def table(rows: list[dict[str, Any]], chosen_node: str = '') -> Table:
    """Return a table of rows.

    :param chosen_node: the row of this node is marked
    """
    rich_table = Table(box=None, padding=(0, 1, 0, 0))
    for column in rows[0] if rows else ['nothing there']:
        rich_table.add_column(column, no_wrap=column in WIDE_COLUMNS)
    for row in rows:
        style = 'reverse' if row.get('NODE') == chosen_node else None
        rich_table.add_row(*map(_cell_text, row.values()), style=style)
    return rich_table


def _cell_text(value):
    if value in (None, ''):
        return '-'
    return value if isinstance(value, str) else f'{round(value, 1):g}'


def show(master: Master, interval: float) -> None:
    """Show the table in the terminal until the key q or Ctrl-C.

    :param interval: seconds without a key until the next snapshot
    """
    keyboard = sys.stdin.fileno()
    terminal_settings = termios.tcgetattr(keyboard)
    tty.setcbreak(keyboard)
    try:
        with Live(screen=True, auto_refresh=False) as screen:
            _show_nodes(screen, master, interval, keyboard)
    finally:
        termios.tcsetattr(keyboard, termios.TCSADRAIN, terminal_settings)


def _show_nodes(screen, master, interval, keyboard):
    start = take_snapshot(master)
    rows = node_rows(take_snapshot(master), start)
    chosen_node = problem = answer = ''
    while True:
        page = Table.grid()
        page.add_row(HELP)
        page.add_row(problem or answer)
        page.add_row(table(rows, chosen_node))
        screen.update(page, refresh=True)
        if select.select([keyboard], [], [], interval)[0]:
            key = os.read(keyboard, 1).decode('latin-1')
            if key == 'q':
                return
            if key in 'jk':
                chosen_node = _next_node(rows, chosen_node, 1 if key == 'j' else -1)
            elif key in ACTIONS and chosen_node:
                answer = _control(ACTIONS[key], chosen_node, master)
        else:
            try:
                snapshot = take_snapshot(master)
                rows = node_rows(snapshot, start)
                start = snapshot
                problem = ''
            except MasterUnreachableError as error:
                problem = str(error)


def _next_node(rows, chosen_node, step):
    """Return the node that comes after the chosen one, or before; the first if there is none."""
    names = [row['NODE'] for row in rows]
    if chosen_node not in names:
        return names[0] if names else ''
    return names[(names.index(chosen_node) + step) % len(names)]


def _control(action, name, master):
    """Restart, stop, start or reload a node, and return a line that says how that went."""
    from pharos.compose.control import control

    try:
        return f'{action} done: {control(action, name, master)}'
    except PharosError as error:
        return str(error)
