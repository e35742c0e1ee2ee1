"""The command top."""
from __future__ import annotations

import json
import sys
import time

from rich.console import Console

from pharos.commands import argument_parser
from pharos.live.snapshot import take_snapshot
from pharos.live.top import node_rows, show, table
from pharos.master import Master


def top(arguments: list[str]) -> None:
    """Show the nodes of the ROS master in a live table; in a pipe, print it once.

    The columns are messages a second, transports, dropped messages, failures and
    CPU of nodes made with pharos. The command subscribes to nothing.

    Other commands: compose, graph, workspace, restart, stop, start, reload.
    """
    parser = argument_parser(top)
    parser.add_argument('--once', action='store_true', help='print the table once')
    parser.add_argument('--json', action='store_true', help='print the table once, as JSON')
    parser.add_argument('--interval', type=float, default=1, help='seconds between measurements')
    options = parser.parse_args(arguments)
    master = Master()
    is_live = sys.stdin.isatty() and not (options.once or options.json)
    if is_live and sys.stdout.isatty():
        show(master, options.interval)
        return
    start = take_snapshot(master)
    time.sleep(options.interval)
    rows = node_rows(take_snapshot(master), start)
    if options.json:
        print(json.dumps({'nodes': rows}))
    else:
        # in a pipe or file, nothing is cut
        console = Console(width=None if sys.stdout.isatty() else 10_000, markup=False)
        console.print(table(rows, console.width))
