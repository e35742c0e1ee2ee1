"""The command top."""
from __future__ import annotations

import sys
import time

from rich.console import Console

from pharos.commands import argument_parser
from pharos.live.snapshot import take_snapshot
from pharos.live.top import node_rows, show, table
from pharos.master import Master


def top(arguments: list[str]) -> None:
    """Show the nodes of the ROS master in a live table; in a pipe, as `top | cat`, print it once.

    The columns are messages a second, transports, dropped messages, failures and
    CPU of nodes made with pharos. The command subscribes to nothing.

    Other commands: compose, graph, workspace, restart, stop, start, reload.
    """
    parser = argument_parser(top)
    parser.add_argument('--interval', type=float, default=1, help='seconds between measurements')
    options = parser.parse_args(arguments)
    master = Master()
    if sys.stdin.isatty() and sys.stdout.isatty():
        show(master, options.interval)
    else:
        start = take_snapshot(master)
        time.sleep(options.interval)
        Console(width=10_000).print(table(node_rows(take_snapshot(master), start)))
