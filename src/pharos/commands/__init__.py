"""The commands of this package, which rosrun starts: ``rosrun pharos COMMAND [ARGUMENT ...]``."""
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


def argument_parser(command: Callable[[list[str]], int | None]) -> argparse.ArgumentParser:
    """Return a parser of arguments; the docstring of the command is its help."""
    parser = argparse.ArgumentParser(
        description=inspect.getdoc(command), formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--version', action='version', version=f'pharos {pharos.__version__}')
    return parser


def run_command(name: str, module_name: str = '') -> int:
    """Run the command of that name with the program's arguments, and return the exit status.

    The command gets no remappings of ROS. An error that the user can mend is printed in one line.

    :param module_name: the module here that has the command; default: that of its name
    """
    try:
        module = importlib.import_module(f'pharos.commands.{module_name or name}')
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
    except KeyboardInterrupt:
        return 130  # as a shell has it
    return 0
