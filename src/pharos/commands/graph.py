"""Shows the graph of the ROS master: hosts, processes, nodes, topics, and how messages go.

  graph                                as text, for a terminal
  graph --output graph.svg             as a picture: .svg, .png, .pdf (by graphviz) or .dot
  graph --output graph.svg --watch     drawn again whenever the graph changes, until Ctrl-C
  graph --rates --hide tf leaf         with how often messages come, and without some topics

What every node has (/rosout, /statistics, /clock, parameter_updates, services for loggers) is left
out but for --all. How a picture is to be read says doc/graph.md.
"""
import argparse
import json
import sys
import time
from typing import List

import rosgraph

from pharos import Master, MasterUnreachableError, PharosError, program
from pharos.errors import suggest
from pharos.live.graph import GROUPS, HIDEABLE, Graph
from pharos.live.graphviz import check_format

PERIOD = 1.0  # seconds between two looks
RATES = 2.0  # seconds for which messages are counted, where nothing is said


def read_arguments(argv: List[str]) -> argparse.Namespace:
    """What argparse makes of the options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('-o', '--output', metavar='FILE', help='a picture, instead of text')
    parser.add_argument('--json', action='store_true', help='JSON for programs, instead of text')
    parser.add_argument('--watch', action='store_true', help='again whenever it changes')
    parser.add_argument('--all', action='store_true', help='also what every node has')
    parser.add_argument('--services', action='store_true', help='services, too')
    parser.add_argument(
        '--nodes-only', action='store_true', help='arrows from node to node, and no topics'
    )
    parser.add_argument(
        '--namespace', nargs='+', metavar='NAME', default=['/'], help='the nodes of these alone'
    )
    parser.add_argument(
        '--hide',
        nargs='+',
        choices=list(HIDEABLE),
        default=[],
        help='; '.join(f'{name}: {what}' for name, what in HIDEABLE.items()),
    )
    parser.add_argument(
        '--group', choices=GROUPS, default='process', help='what the frames of a picture are'
    )
    parser.add_argument(
        '--rates',
        nargs='?',
        type=float,
        const=RATES,
        default=0,
        metavar='SECONDS',
        help=f'how often messages come, counted for that long ({RATES:g} by default)',
    )
    options = parser.parse_args(argv)
    if not options.rates >= 0:
        parser.error(f'--rates is a number of seconds, 0 or more, not {options.rates:g}')
    if options.output and options.json:
        parser.error('give --output or --json, not both')
    if options.output:
        try:
            check_format(options.output)
        except ValueError as error:
            parser.error(str(error))
    return options


def look(master: Master, options: argparse.Namespace) -> Graph:
    """The graph as it is."""
    return master.graph(
        options.rates,
        show_all=options.all,
        services=options.services,
        nodes_only=options.nodes_only,
        namespace=options.namespace,
        hide=options.hide,
        group=options.group,
    )


def check_namespaces(graph: Graph) -> None:
    """Raise PharosError if there is nothing in the namespaces asked for."""
    known = graph.snapshot.nodes
    if known and not graph.nodes and graph.namespaces != ['/']:
        names = ', '.join(name.rstrip('/') for name in graph.namespaces)
        namespaces = {name.rpartition('/')[0] for name in known} | {*known}
        hint = suggest(graph.namespaces[0].rstrip('/'), namespaces)
        raise PharosError(f'no node is in {names}{hint}: see rosnode list')


def show(graph: Graph, options: argparse.Namespace) -> None:
    """Print or draw it."""
    if options.output:
        graph.save(options.output)
    elif options.json:
        print(json.dumps(graph.as_dict(), allow_nan=False), flush=True)
    else:
        print(graph.text(), flush=True)


def watch(master: Master, options: argparse.Namespace, last: Graph) -> None:
    """Show it again whenever it has changed, until Ctrl-C; rates always have."""
    is_away = False
    while True:
        time.sleep(PERIOD)
        try:
            graph = look(master, options)
        except MasterUnreachableError as error:
            if not is_away:
                print(f'graph: {error}; waiting for it', file=sys.stderr, flush=True)
            is_away = True
            continue
        is_away = False
        if options.rates or not graph.is_like(last):
            show(graph, options)
            last = graph


def run(options: argparse.Namespace) -> int:
    """Look once, and again if asked to; returns the exit status."""
    if not options.output:
        program.check_output()
    master = Master()
    graph = look(master, options)
    if not options.watch:
        check_namespaces(graph)
    show(graph, options)
    if options.watch:
        watch(master, options, graph)
    return 0


def main() -> int:
    """Do what the command line says; returns the exit status."""
    chosen = read_arguments(rosgraph.myargv()[1:])
    return program.run('graph', lambda: run(chosen))
