"""The command top."""
from __future__ import annotations

import json
import sys
import time

from rich.console import Console

from pharos.commands import argument_parser
from pharos.live.top import Meter, show, table
from pharos.master import Master

FILE_WIDTH = 10000  # columns of the table if it is not for a terminal, so that nothing is cut


def top(arguments: list[str]) -> None:
    """Show the nodes of the ROS master in a live table.

    The columns are messages a second, transports, dropped messages, failures and
    CPU of nodes made with pharos. The command subscribes to nothing.

    Other commands: compose, graph, workspace, restart, stop, start, reload.
    """
    parser = argument_parser(top)
    parser.add_argument('--once', action='store_true', help='print the table once')
    parser.add_argument('--json', action='store_true', help='print JSON once')
    parser.add_argument(
        '--interval', type=float, default=1, metavar='S', help='seconds between measurements'
    )
    options = parser.parse_args(arguments)
    meter = Meter(Master())
    if sys.stdin.isatty() and sys.stdout.isatty() and not (options.once or options.json):
        show(meter, options.interval)
        return
    time.sleep(options.interval)
    rows = meter.measure()
    if options.json:
        print(json.dumps({'nodes': rows}))
        return
    console = Console(width=None if sys.stdout.isatty() else FILE_WIDTH)
    console.print(table(rows))
