"""What programs have in common: how they end."""
import os
import sys
from typing import Any, Callable, Optional

from pharos.errors import PharosError


def run(name: str, main: Callable[[], Optional[int]], about: Optional[str] = None) -> int:
    """Run the ``main`` of a program; returns its exit status, 0 after Ctrl-C.

    What is wrong is told in one line; who reads its output may stop early, or read no UTF-8::

        if __name__ == '__main__':
            sys.exit(program.run('camera', main, about=__doc__))

    :param name: the program's, for that line
    :param main: returns the exit status; None: 0
    :param about: what is printed instead where the program was called with ``--help``; None: that
        is left to ``main``
    """
    if not callable(main):
        raise TypeError(f"program.run('name', main) runs a function, and {main!r} is none")
    output: Any = sys.stdout  # None where the program was started without one
    try:
        if output is not None:
            output.reconfigure(errors='replace')
        if about is not None and {'-h', '--help'} & {*sys.argv[1:]}:
            status: Optional[int] = print(about.strip())
        else:
            status = main()
        if output is not None:
            output.flush()
        return status or 0
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


def check_output() -> None:
    """For a program that is there to print.

    :raises PharosError: if it was started without a standard output
    """
    if sys.stdout is None:
        raise PharosError('its standard output is closed: give it a file or a terminal')


def _print_to_nobody() -> None:
    """What Python still has to print at its end would fail again."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
