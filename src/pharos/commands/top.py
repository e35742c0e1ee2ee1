"""Shows what the nodes, processes and topics of a graph are doing: messages and bytes a second,
transports, what was dropped, failures, CPU and memory; a live table in the terminal.

Nothing is subscribed to for it: nodes count what goes through their connections in any case. A topic
that nobody hears has no rate then; --measure subscribes to all topics that are shown. Failures, and
messages dropped, are those of nodes of pharos, CPU and memory those of processes of this host; what
is not known is '-', or null.

keys:  n nodes  p processes  t topics (or Tab)   s sorts by the next column, S by the one before
       r reverses  / filters by part of a name (Enter keeps it, Escape clears it)
       space pauses  arrows and pages scroll  q, or Ctrl-C, quits

columns:  IN/S, OUT/S messages a second   IN B/S, OUT B/S bytes a second through sockets
          HZ, B/S the messages and bytes a second that one subscriber gets   LOCAL, TCP connections
          within a process, and through sockets   DROP messages   FAIL failures of blocks
"""
import argparse
import dataclasses
import importlib
import json
from typing import Any, List

import rosgraph

from pharos import Master, PharosError, program
from pharos.errors import missing
from pharos.live import top
from pharos.live.terminal import is_interactive
from pharos.seconds import check_seconds

JSON = """
--json prints one object; what is not known is null:
  master, time (of its end, seconds since 1970), seconds (that were measured), is_measured
  nodes: a list of name, host, pid, state ('alive', 'silent', 'dead'), class_name, received, sent
    (messages a second), bytes_received, bytes_sent (a second, through sockets), intraprocess, tcpros
    (connections), dropped, failures, threads, souls
  processes: a list of pid, host, nodes (names), cpu (percent of one processor), memory (bytes),
    threads, received, sent, bytes_received, bytes_sent, dropped, failures
  topics: a list of name, type, publishers, subscribers (names), rate (messages a second), bandwidth
    (bytes a second, for one subscriber), intraprocess, tcpros (connections), dropped
Names stay as they are; there may be more of them.
"""


def read_arguments(words: List[str]) -> argparse.Namespace:
    """What argparse makes of the options."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog=JSON,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        'names',
        nargs='*',
        metavar='NAME',
        help="nodes and topics, by a part of their names or a pattern such as '/robot*'",
    )
    parser.add_argument('--once', action='store_true', help='print the tables once')
    parser.add_argument('--json', action='store_true', help='print them once, as JSON')
    parser.add_argument(
        '--interval', metavar='S', default='1', help='seconds between two looks; 1, if not given'
    )
    parser.add_argument(
        '--measure', action='store_true', help='subscribe to the topics, and measure their rates'
    )
    options = parser.parse_args(words)
    try:
        options.interval = check_seconds('--interval', float(options.interval), above=0)
    except ValueError:
        parser.error(f'--interval is a number of seconds above 0, not {options.interval!r}')
    return options


def load_screen() -> Any:
    """The module that draws.

    :raises PharosError: if what it needs is not installed
    """
    try:
        return importlib.import_module('pharos.live.top_screen')
    except ModuleNotFoundError as error:
        if (error.name or '').partition('.')[0] != 'rich':
            raise
        raise PharosError(
            missing('rich draws the tables', error, 'python3-rich') + ', or have --json'
        ) from None


def run(options: argparse.Namespace) -> int:
    """Do it; returns the exit status."""
    program.check_output()
    master = Master()
    screen = None if options.json else load_screen()
    if screen and not options.once and is_interactive():
        with top.Meter(master, options.names, options.measure) as meter:
            return screen.show(meter, options.interval)
    measurement = top.measure(master, options.interval, options.names, options.measure)
    if options.names and not (measurement.nodes or measurement.topics):
        raise PharosError(
            f'no node or topic has {" or ".join(options.names)} in its name: see rosnode list and'
            ' rostopic list'
        )
    if screen is None:
        print(json.dumps(dataclasses.asdict(measurement), indent=2, allow_nan=False))
    else:
        screen.print_once(measurement)
    return 0


def main() -> int:
    """Do what the command line says; returns the exit status."""
    chosen = read_arguments(rosgraph.myargv()[1:])
    return program.run('top', lambda: run(chosen))
