"""The commands restart, stop, start and reload."""
from __future__ import annotations

from pharos.commands import argument_parser
from pharos.compose.control import control
from pharos.master import Master


def restart(arguments: list[str]) -> None:
    """Restart a node of a composition of this user on this host; its program is read anew."""
    _control(restart, arguments)


def stop(arguments: list[str]) -> None:
    """Stop a node of a composition of this user on this host; it stays stopped until a start."""
    _control(stop, arguments)


def start(arguments: list[str]) -> None:
    """Start a stopped node of a composition of this user on this host."""
    _control(start, arguments)


def reload(arguments: list[str]) -> None:
    """Have the edited program of a node of a composition take effect, while the node runs.

    Functions, members of classes, imports and values that are new or differ change in place. Objects,
    subscriptions and connections stay. Other statements take effect at a restart; the answer has their
    lines.
    """
    _control(reload, arguments)


def _control(command, arguments):
    parser = argument_parser(command)
    parser.add_argument('node', help='the full name of the node')
    name = '/' + parser.parse_args(arguments).node.lstrip('/')
    answer = control(command.__name__, name, Master())
    if command is reload:
        print(answer)
    elif answer != name:
        print(f'{name} is a node of the program {answer}: {command.__name__} of all its nodes')
