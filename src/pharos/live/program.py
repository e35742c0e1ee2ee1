"""What the programs of the command line have in common: how they end."""
import os
import sys
from typing import Any, Callable

from pharos.errors import PharosError


def run(name: str, main: Callable[[], int]) -> int:
    """Run a program that prints; returns its exit status.

    What is wrong is told in one line; who reads its output may stop early, or read no UTF-8.

    :param name: the program's, for that line
    :param main: returns the exit status
    """
    try:
        if sys.stdout is None:
            raise PharosError('its standard output is closed: give it a file or a terminal')
        output: Any = sys.stdout
        output.reconfigure(errors='replace')
        status = main()
        output.flush()
        return status
    except KeyboardInterrupt:
        return 0
    except BrokenPipeError:  # who reads it has enough
        _print_to_nobody()
        return 0
    except OSError as error:  # such as a full disk
        _print_to_nobody()
        problem: Any = error
    except (PharosError, ValueError) as error:
        problem = error
    print(f'{name}: {problem}', file=sys.stderr)
    return 1


def _print_to_nobody() -> None:
    """What Python still has to print at its end would fail again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
