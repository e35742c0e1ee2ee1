"""The threads that a process may have."""
import os
import resource
import threading
from typing import Any, Callable, Iterator

from pharos.errors import PharosError

_REFUSED = "can't start new thread"  # as Python says it


class NoThreadError(PharosError, RuntimeError):
    """The system gives no more threads; a RuntimeError, which Python raises then, too."""


def start(starting: Callable[[], Any], whose: str) -> None:
    """Start a thread by calling ``starting()``.

    :param whose: for whom, as the error names it
    :raises NoThreadError: if the system gives no more of them
    """
    try:
        starting()
    except RuntimeError as error:
        if _REFUSED not in str(error):
            raise
        raise NoThreadError(
            f'no thread for {whose}: {error}, beside {threading.active_count()} of this process. What'
            f' allows no more is {", ".join(_limits())}, or the memory. Raise it before the program'
            ' starts, or stop other nodes'
        ) from error


def check(whose: str) -> None:
    """Start a thread that ends at once.

    :raises NoThreadError: if the system gives no more of them
    """
    start(threading.Thread(target=lambda: None, name=f'{whose} check', daemon=True).start, whose)


def _limits() -> Iterator[str]:
    """What may be the limit, as it is set."""
    of_user, _ = resource.getrlimit(resource.RLIMIT_NPROC)
    if of_user != resource.RLIM_INFINITY and os.geteuid() != 0:
        yield f"ulimit -u ({of_user}, of all of the user's processes)"
    memory, _ = resource.getrlimit(resource.RLIMIT_AS)
    if memory != resource.RLIM_INFINITY:
        yield f'ulimit -v ({memory // 1024} kB of addresses, of which each takes several thousand)'
    yield 'the pids.max of a container, or TasksMax of a service'
