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
from typing import Any, Callable, Iterator, Optional, Set

#: seconds for which a start, a stop or the end of the program is not cut off by signals
HOLD_LIMIT = 30.0
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
_holds = 0  # how deep it is in starts and stops
_kept: Optional[int] = None  # the first signal that came in one of them
_deadline = 0.0  # by time.monotonic(), until which it is kept


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
def held(is_end: bool = False) -> Iterator[None]:
    """Within this, a signal raises nothing in the main thread, and afterwards what it would have
    raised; but a second one does at once, HOLD_LIMIT seconds later.

    A start or a stop that is torn up half way leaves registrations behind, and the end of the
    program programs, too.

    :param is_end: whether it is the end of the program, so that there is nothing to raise
        afterwards
    """
    global _holds, _kept
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _take_on(*_DEFAULTS)
    _holds += 1
    try:
        yield
    finally:
        _holds = max(0, _holds - 1)  # 0 where the process was forked in it
        if _kept is not None and not _holds:
            number, _kept = _kept, None
            if not is_end:
                _raise(number)


def _is_held(number: int) -> bool:
    """Keep a signal for the end of what no signal may cut off; returns whether it waits until
    then."""
    global _kept, _deadline
    if _holds and _kept is None:
        _kept, _deadline = number, time.monotonic() + HOLD_LIMIT
    return bool(_holds) and time.monotonic() < _deadline


def _on_signal(number: int, frame: Any) -> None:
    if not (_holds or _is_needed()):
        _do_default(number, frame)
        return
    if number == signal.SIGINT and hasattr(sys, 'ps1'):
        # at the prompt, it ends the line that runs or is typed, and not what goes on beside it
        if not _is_held(number):
            raise _exception(number)
        return
    # Not here, nor in a Thread, whose start takes a lock: the main thread may hold any lock just
    # now.
    _thread.start_new_thread(_stop_all, ())
    _raise(number)


def _raise(number: int) -> None:
    """End what the main thread does, if it does not end by itself, at once or when the hold
    ends."""
    if not (_is_held(number) or _waits):
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
    global _waits, _holds, _kept
    _waits = _holds = 0
    _kept = None


os.register_at_fork(after_in_child=_forget)
