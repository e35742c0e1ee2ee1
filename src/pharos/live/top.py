"""Show what the nodes, processes and topics of a graph are doing just now: ``rosrun pharos top``.

Nodes count what comes and goes in any case, so that two looks make rates. Nothing is subscribed to.
"""
import collections
import json
import os
import select
import sys
import termios
import time
import tty

import psutil
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table

from pharos import live
from pharos.errors import MasterUnreachableError
from pharos.live import snapshot
from pharos.live.words import number
from pharos.master import Master

VIEWS = 'nodes', 'processes', 'topics'
KEYS = 'n nodes  p processes  t topics  s sort by the next column  q quit'
WHOLE = 'NODE', 'TOPIC', 'PID'  # columns that are shown whole, however narrow the terminal is
BAD = 'DROP', 'FAIL', 'PROBLEM'  # columns in which all but 0 is red
SUMS = 'IN/S', 'OUT/S', 'IN B/S', 'OUT B/S', 'DROP', 'FAIL'


class Meter:
    """Looks again and again, and tells what has happened since the last time."""

    def __init__(self, master, names=()):
        self._master, self._names = master, names
        self._before = snapshot.take(master)
        self._processes: dict[int, psutil.Process] = {}

    def measure(self):
        """Return ``{view: rows}``; a row is ``{column: value}``, None if it is not known.

        :raises MasterUnreachableError: if the master does not answer
        """
        before, self._before = self._before, snapshot.take(self._master)
        nodes, topics = (
            [row for row in rows(before, self._before) if self._is_wanted(next(iter(row.values())))]
            for rows in (_nodes, _topics)
        )
        return {'nodes': nodes, 'processes': list(self._by_process(nodes)), 'topics': topics}

    def _is_wanted(self, name):
        return not self._names or any(part in name for part in self._names)

    def _by_process(self, nodes):
        """Yield the sums of each process's nodes, and what the system tells if it is here."""
        processes = collections.defaultdict(list)
        for row in nodes:
            processes[row['HOST'], row['PID'] or row['NODE']].append(row)
        for (host, pid), rows in processes.items():
            found = {'PID': pid, 'HOST': host, 'CPU%': None, 'MEM': None, 'THR': None}
            if host == 'here' and isinstance(pid, int):
                try:
                    process = self._processes.setdefault(pid, psutil.Process(pid))
                    found['CPU%'] = process.cpu_percent()
                    found['MEM'], found['THR'] = process.memory_info().rss, process.num_threads()
                except psutil.Error:  # it has ended
                    pass
            sums = {column: sum(row[column] or 0 for row in rows) for column in SUMS}
            yield {**found, **sums, 'NODES': ' '.join(row['NODE'] for row in rows)}


def _nodes(before, now):
    came = collections.defaultdict(lambda: [0, 0])
    went = collections.defaultdict(dict)
    sizes = collections.defaultdict(float)
    for link, (rate, size) in now.rates_since(before).items():
        came[link.subscriber][0] += rate
        came[link.subscriber][1] += size
        sizes[link.publisher] += size
        sent = went[link.publisher]
        sent[link.topic] = max(sent.get(link.topic, 0), rate)  # however many receive it
    for name, node in now.nodes.items():
        own = [link.transport for link in now.links if name in link[1:3]]
        yield {
            'NODE': name,
            'CLASS': node.health.get('kind'),
            'HOST': node.host,
            'PID': node.pid,
            'IN/S': came[name][0],
            'OUT/S': sum(went[name].values()),
            'IN B/S': came[name][1],
            'OUT B/S': sizes[name],
            'LOCAL': own.count('INTRAPROCESS'),
            'TCP': own.count('TCPROS'),
            'DROP': node.health.get('dropped'),
            'FAIL': node.health.get('errors'),
            'PROBLEM': node.problem,
        }


def _topics(before, now):
    rates, sizes = (snapshot.topic_rates(before, now, what) for what in (0, 1))
    nodes = now.nodes.values()
    for name, kind in now.topics.items():
        links = [link.transport for link in now.links if link.topic == name]
        yield {
            'TOPIC': name,
            'TYPE': kind,
            'HZ': rates.get(name),
            'B/S': sizes.get(name),
            'PUB': sum(name in node.publishes for node in nodes),
            'SUB': sum(name in node.subscribes for node in nodes),
            'LOCAL': links.count('INTRAPROCESS'),
            'TCP': links.count('TCPROS'),
        }


def table(rows, sort=0):
    """Return the rows by a column: words by the alphabet, numbers the largest first."""
    columns = list(rows[0]) if rows else ['nothing there']
    by = columns[sort % len(columns)]

    def order(row):
        value = row[by]
        return (value, 0) if isinstance(value, str) else ('', -(value or 0))

    made = Table(box=None, padding=(0, 1, 0, 0))
    for column in columns:
        is_text = any(isinstance(row[column], str) for row in rows)
        title = f'[reverse]{column}[/]' if column == by else column
        no_wrap = column in WHOLE
        made.add_column(title, justify='left' if is_text else 'right', no_wrap=no_wrap)
    for row in sorted(rows, key=order):
        made.add_row(*(_cell(column, value) for column, value in row.items()))
    return made


def _cell(column, value):
    is_number = column != 'PID' and not isinstance(value, str)
    text = number(value) if is_number else str(value or '-')
    return f'[bold red]{text}[/]' if column in BAD and value else text


def show(meter, interval):
    """Show the tables until q or Ctrl-C."""
    view, sort, said = VIEWS[0], 0, ''
    keys = sys.stdin.fileno()
    terminal = termios.tcgetattr(keys)
    tty.setcbreak(keys)
    try:
        with Live(screen=True, auto_refresh=False) as shown:
            found, due = meter.measure(), time.monotonic() + interval
            while True:
                shown.update(Group(KEYS, said, table(found[view], sort)), refresh=True)
                ready = select.select([keys], [], [], max(0, due - time.monotonic()))[0]
                key = os.read(keys, 1).decode('latin-1') if ready else ''
                if key == 'q':
                    return
                sort = sort + 1 if key == 's' else 0 if key in {*'npt'} else sort
                view = next((each for each in VIEWS if each[0] == key), view)
                if not key:
                    due = time.monotonic() + interval
                    try:
                        found, said = meter.measure(), ''
                    except MasterUnreachableError as error:
                        said = str(error)
    finally:
        termios.tcsetattr(keys, termios.TCSADRAIN, terminal)


def top(words):
    """Show what nodes, processes and topics are doing.

    Messages and bytes a second, transports, what was dropped, failures, CPU and memory. Nothing is
    subscribed to for it.

    top NAME ...        of nodes and topics those with that in their names
    """
    read = live.parser(top.__doc__)
    read.add_argument('names', nargs='*', metavar='NAME', help='a part of a name')
    read.add_argument('--once', action='store_true', help='print the tables once')
    read.add_argument('--json', action='store_true', help='print them once, as JSON')
    read.add_argument('--interval', type=float, default=1, metavar='S', help='between two looks')
    chosen = read.parse_args(words)
    meter = Meter(Master(), chosen.names)
    if sys.stdin.isatty() and sys.stdout.isatty() and not (chosen.once or chosen.json):
        return show(meter, chosen.interval)
    meter.measure()
    time.sleep(chosen.interval)
    found = meter.measure()
    if chosen.json:
        return print(json.dumps(found))
    for view in VIEWS:
        Console(width=None if sys.stdout.isatty() else 10000).print(table(found[view]))


def main():
    """Run the command."""
    return live.run(top)
