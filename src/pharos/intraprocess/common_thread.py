"""One thread of this process runs the fast delegates of several nodes, one after the other, where a
message goes to all of them.

Waking a thread, and passing it the interpreter, takes longer than a fast delegate does. So the
publisher wakes this one thread, and not each node's. Then it waits for the interpreter, as it would
anyway. When it has got it, the thread is through; or a delegate waits for something, or computes for
long: then the publisher takes back what has not begun, and wakes the threads of those nodes. So no
node waits longer for another than it does where each runs in its own thread.
"""
import contextlib
import os
import threading
from typing import Any, Callable, Iterable, Optional

from pharos.intraprocess.dispatcher import CLOSED_INTERVAL, Dispatcher

_changing = threading.Lock()
_common: 'Optional[CommonThread]' = None  # from its first use until no node runs


class CommonThread(Dispatcher):
    """Runs the dispatchers of nodes as these run inboxes."""

    thread: threading.Thread

    def __init__(self) -> None:
        super().__init__(self._start, 'pharos common dispatcher')
        self.need_thread()

    def _start(self, target: Callable[[], Any], name: str) -> None:
        self.thread = threading.Thread(target=target, name=name, daemon=True)
        self.thread.start()

    def yield_gil(self) -> None:
        """Let the thread have the interpreter; what it has not begun with when it lets go of that is
        run by the nodes' own threads."""
        try:
            super().yield_gil()
            self._take_back()
        except BaseException:  # a handler of signals has raised it
            self._take_back()
            raise

    def _take_back(self) -> None:
        dispatcher: Any = None
        try:
            while self.scheduled:
                with contextlib.suppress(IndexError, ValueError):  # the thread has come to it
                    dispatcher = self.scheduled[0]
                    self.scheduled.remove(dispatcher)
                    dispatcher.wake()
        except BaseException:  # a handler of signals has raised it, perhaps just before the waking
            if dispatcher is not None:
                dispatcher.wake()
            raise


def take(dispatchers: Iterable[Dispatcher]) -> Optional[CommonThread]:
    """Have those that are idle and fast be run by the common thread, to which the publisher has to
    yield when it has woken the others; returns None where it is busy, or they are too few."""
    fast = [
        dispatcher
        for dispatcher in dispatchers
        if dispatcher.idle and dispatcher.is_fast and dispatcher.is_yielded_to
    ]
    if len(fast) < 2:
        return None
    common = _common
    if common is None:
        common = _begin()
        if not any(dispatcher.is_fast for dispatcher in fast):
            end()  # their nodes have ended meanwhile, perhaps as the last ones
    if common is None or not common.idle:
        return None
    try:
        for dispatcher in fast:
            dispatcher.idle = False
            common.scheduled.append(dispatcher)
        common.wake()
    except BaseException:  # a handler of signals has raised it, and nobody else would wake them
        for dispatcher in fast:
            dispatcher.wake()
        raise
    return common


def _begin() -> Optional[CommonThread]:
    global _common
    with _changing:
        try:
            _common = _common or CommonThread()
        except RuntimeError:  # the process has as many threads as it may
            return None
        return _common


def end() -> None:
    """End the thread, for no node runs any more; it is waited for, unless a delegate in it waits for
    this thread."""
    global _common
    with _changing:
        common, _common = _common, None
    if common is not None:
        common.finish()
        if common.thread is not threading.current_thread():
            common.thread.join(CLOSED_INTERVAL)


def _forget() -> None:
    """In a process that was forked, where the thread is not."""
    global _common, _changing
    _common, _changing = None, threading.Lock()


os.register_at_fork(after_in_child=_forget)
