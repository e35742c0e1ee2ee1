"""The command ``pharos``, which runs the commands of this package without rosrun.

usage: pharos COMMAND [ARGUMENT ...]

  workspace       a session in IPython, with the live graph at hand
  compose         run the Python nodes of a launch file in one process
  top             a live table of nodes
  graph           the nodes, topics and links, as text or as a picture
  restart, stop, start, reload    do so with a node of a composition

'pharos COMMAND --help' tells the arguments of a command.
"""
from __future__ import annotations

import argparse
import importlib
import inspect
import os
import re
import sys
from typing import Callable

import rosgraph

import pharos

#: name of a command, and of its function -> module; compose has a main(), too, which ends its threads
COMMANDS = {
    'workspace': 'workspace',
    'compose': 'compose',
    'top': 'top',
    'graph': 'graph',
    'restart': 'control',
    'stop': 'control',
    'start': 'control',
    'reload': 'control',
}


def main() -> int:
    """Run the command that the first argument names, and return the exit status."""
    name = sys.argv[1] if sys.argv[1:] else '--help'
    if name not in COMMANDS:
        print(__doc__)
        return 0 if name.startswith('-') else 1
    sys.argv[:2] = [f'pharos {name}']
    if name == 'compose':
        return importlib.import_module('pharos.commands.compose').main()
    return run_command(name)


def argument_parser(command: Callable[[list[str]], int | None]) -> argparse.ArgumentParser:
    """Return a parser of arguments; the docstring of the command is its help."""
    return argparse.ArgumentParser(
        description=inspect.getdoc(command), formatter_class=argparse.RawDescriptionHelpFormatter
    )


def run_command(name: str) -> int:
    """Run the command of that name with the program's arguments, and return the exit status.

    The command gets no remappings of ROS. An error that the user can mend is printed in one line.
    """
    try:
        module = importlib.import_module(f'pharos.commands.{COMMANDS[name]}')
        status = getattr(module, name)(rosgraph.myargv()[1:])
        sys.stdout.flush()
        return status or 0
    except BrokenPipeError:  # by `| head`; the exit of Python flushes once more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (pharos.PharosError, ValueError, OSError, re.error) as error:
        print(f'{name}: {error}', file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        package = str(error.name).lower()
        print(f'{name}: {error}: on Debian, apt install python3-{package}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:  # the usual end of a command that runs on
        pass
    return 0
