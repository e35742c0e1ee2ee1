"""Have asyncio make an event loop in the main thread of a program, and close loops with their program."""
import asyncio
import contextlib
import sys
import threading
from typing import Any

from pharos.waiting import current

#: asyncio's policies derive from this; Python 3.14 has changed its name
_PREFIX = '_' if sys.version_info >= (3, 14) else ''
_POLICY: Any = getattr(asyncio.events, f'{_PREFIX}BaseDefaultEventLoopPolicy')


def _get_event_loop(policy: Any, original: Any = _POLICY.get_event_loop) -> Any:
    """Return the event loop of this thread; make one in the main thread of a program.

    asyncio makes one in the main thread of a process. (Python 3.14 makes none there.)
    """
    run = current.run
    if hasattr(run, 'event_loops') and threading.current_thread() is run.main:
        with contextlib.suppress(RuntimeError):
            return original(policy)
        policy.set_event_loop(policy.new_event_loop())
    return original(policy)


def _new_event_loop(policy: Any, original: Any = _POLICY.new_event_loop) -> Any:
    """Return a new event loop; the end of the program that has made the loop closes it."""
    loop = original(policy)
    if hasattr(current.run, 'event_loops'):
        current.run.event_loops.add(loop)
    return loop


_POLICY.get_event_loop = _get_event_loop
_POLICY.new_event_loop = _new_event_loop
