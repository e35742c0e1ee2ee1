"""Ctrl-C, SIGTERM and SIGHUP, which stop the nodes where the program has no handlers of its own."""
import contextlib
import os
import signal
import sys
import threading
import time
import traceback
import _thread
from types import CodeType
from typing import Any, Callable, Iterator, List, Optional, Set

_DEFAULTS = {
    signal.SIGINT: signal.default_int_handler,
    signal.SIGTERM: signal.SIG_DFL,
    signal.SIGHUP: signal.SIG_DFL,
}

#: The attribute of an exception by which a signal ends the main thread. Kept here itself, it would
#: keep the frames of the program, and what is in them, until Python takes its modules apart.
_MARK = '_pharos_signal'

#: signals that have come to be ours, perhaps by way of a handler that the program has set since
taken_on: Set[int] = set()

_is_needed: Callable[[], bool] = bool  # see :func:`serve`
_stop_all: Callable[[], Any] = bool
_waits = 0  # how deep the main thread is in waits of ours, which end with the nodes
_holds: 'List[_Hold]' = []  # one for each start and stop that the main thread runs


class _Hold:
    """A stretch of the main thread's work that no signal may cut off, for up to ``limit`` seconds
    after it came."""

    def __init__(self, limit: float) -> None:
        self._limit = limit
        self.came: Optional[int] = None  # the first signal
        self._deadline = 0.0

    def keep(self, number: int) -> bool:
        """Keep a signal for the end; returns whether it waits until then."""
        if self.came is None:
            self.came, self._deadline = number, time.monotonic() + self._limit
        return time.monotonic() < self._deadline


def is_from_signal(error: BaseException) -> bool:
    """Whether a signal ends the program with this exception, and not what a block raised by itself.

    What the program's own handlers of signals raise in the main thread is for who installed them.
    """
    if hasattr(error, _MARK):
        return True
    if threading.current_thread() is not threading.main_thread():
        return False
    handlers = [signal.getsignal(number) for number in signal.valid_signals()]
    if isinstance(error, KeyboardInterrupt) and signal.default_int_handler in handlers:
        return True
    codes = [code_of(handler) for handler in handlers]
    return any(frame.f_code in codes for frame, _ in traceback.walk_tb(error.__traceback__))


def code_of(function: Any) -> Optional[CodeType]:
    """The code object that runs when a function, or another object, is called; None if not
    Python's."""
    if hasattr(function, '__code__'):
        return function.__code__
    return getattr(getattr(type(function), '__call__', None), '__code__', None)


def serve(is_needed: Callable[[], bool], stop_all: Callable[[], None]) -> None:
    """From now on, a signal that ends the program has ``stop_all()`` run first, in a thread of its
    own.

    While ``is_needed()`` does not hold, signals do what they do without us.
    """
    global _is_needed, _stop_all
    _is_needed, _stop_all = is_needed, stop_all
    # not Ctrl-C, which the main thread hears of without us
    _take_on(signal.SIGTERM, signal.SIGHUP)


def _take_on(*numbers: signal.Signals) -> None:
    """Handle the signals for which the program has no handlers, where this is the main thread,
    which alone can."""
    if threading.current_thread() is threading.main_thread():
        for number in numbers:
            if signal.getsignal(number) is _DEFAULTS[number]:
                signal.signal(number, _on_signal)
                taken_on.add(number)


@contextlib.contextmanager
def interruptible_wait() -> Iterator[None]:
    """Within this, a signal raises nothing in the main thread: the wait ends because the nodes
    stop."""
    global _waits
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _waits += 1
    try:
        yield
    finally:
        _waits -= 1


@contextlib.contextmanager
def held(limit: float, is_end: bool = False) -> Iterator[None]:
    """Within this, a signal raises nothing in the main thread, and afterwards what it would have
    raised.

    A start or a stop that is torn up half way leaves registrations behind, and the end of the
    program programs, too.

    :param limit: seconds after which a second signal raises all the same
    :param is_end: whether it is the end of the program, so that there is nothing to raise
        afterwards
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _take_on(*_DEFAULTS)
    hold = _Hold(limit)
    _holds.append(hold)
    try:
        yield
    finally:
        if hold in _holds:  # else the process was forked in it
            _holds.remove(hold)
        if hold.came is not None and not is_end:
            _raise(hold.came)


def _on_signal(number: int, frame: Any) -> None:
    if not (_holds or _is_needed()):
        _do_default(number, frame)
        return
    if number == signal.SIGINT and hasattr(sys, 'ps1'):
        # at the prompt, it ends the line that runs or is typed, and not what goes on beside it
        if not (_holds and _holds[-1].keep(number)):
            raise _exception(number)
        return
    # Not here, nor in a Thread, whose start takes a lock: the main thread may hold any lock just
    # now.
    _thread.start_new_thread(_stop_all, ())
    _raise(number)


def _raise(number: int) -> None:
    """End what the main thread does, if it does not end by itself, at once or when the hold
    ends."""
    if not (_holds and _holds[-1].keep(number) or _waits):
        raise _exception(number)


def _exception(number: int) -> BaseException:
    """What a signal raises. Not made where it is raised: with its own frame it would be a cycle."""
    # the status is the shell's for a process that the signal ended
    error = KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)
    setattr(error, _MARK, number)
    return error


def _do_default(number: int, frame: Any) -> None:
    """What Python and the system do with a signal."""
    if number == signal.SIGINT:
        signal.default_int_handler(number, frame)
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


def _forget() -> None:
    """In a process that was forked: it begins anew."""
    global _waits
    _waits = 0
    _holds.clear()


os.register_at_fork(after_in_child=_forget)
