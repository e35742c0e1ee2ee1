"""Ctrl-C, SIGTERM and SIGHUP, which stop the nodes where the program has no handlers of its own."""
import contextlib
import os
import signal
import sys
import threading
import time
import traceback
import _thread

_DEFAULTS = {
    signal.SIGINT: signal.default_int_handler,
    signal.SIGTERM: signal.SIG_DFL,
    signal.SIGHUP: signal.SIG_DFL,
}

#: The attribute of an exception by which a signal ends the main thread. Kept here itself, it would
#: keep the frames of the program, and what is in them, until Python takes its modules apart.
_MARK = '_pharos_signal'

_is_needed = _end = None  # see :func:`serve`
_waiting = 0  # how deep the main thread is in a wait of ours, which ends with the nodes
_taken_on = set()  # signals for which the program had no handlers
_held = []  # of each start and stop that the main thread runs, the _Hold


class _Hold:
    """A stretch of the main thread's work that no signal may cut off, for up to ``limit`` seconds
    after it came."""

    def __init__(self, limit):
        self._limit = limit
        self.came = None  # the first signal,
        self._when = None  # and when it came, by time.monotonic()

    def take(self, number):
        """Keep a signal for the end; returns whether it waits until then."""
        if self.came is None:
            self.came, self._when = number, time.monotonic()
        return time.monotonic() - self._when < self._limit


def is_from_signal(error):
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


def code_of(function):
    """The code object that runs when a function, or another object, is called; None if not
    Python's."""
    if hasattr(function, '__code__'):
        return function.__code__
    return getattr(getattr(type(function), '__call__', None), '__code__', None)


def serve(is_needed, end):
    """From now on, a signal that ends the program has ``end()`` run first, in a thread of its own.

    While ``is_needed()`` does not hold, signals do what they do without us.
    """
    global _is_needed, _end
    _is_needed, _end = is_needed, end
    # not Ctrl-C, which the main thread hears of without us
    install(signal.SIGTERM, signal.SIGHUP)


def install(*numbers):
    """Take on the signals for which the program has no handlers, where this is the main thread,
    which alone can."""
    if threading.current_thread() is threading.main_thread():
        for number in numbers:
            if signal.getsignal(number) is _DEFAULTS[number]:
                signal.signal(number, _on_signal)
                _taken_on.add(number)


def is_taken_on(number):
    """Whether the signal has come to be ours, perhaps by way of a handler that the program has
    installed since."""
    return number in _taken_on


@contextlib.contextmanager
def waiting():
    """Within this, a signal raises nothing in the main thread: the wait ends because the nodes
    stop."""
    global _waiting
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _waiting += 1
    try:
        yield
    finally:
        _waiting -= 1


@contextlib.contextmanager
def held(limit, is_end=False):
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
    install(*_DEFAULTS)
    hold = _Hold(limit)
    _held.append(hold)
    try:
        yield
    finally:
        if hold in _held:  # else the process was forked in it
            _held.remove(hold)
        if hold.came is not None and not is_end:
            _raise(hold.came)


def _on_signal(number, frame):
    if not (_held or _is_needed()):
        _do_default(number, frame)
        return
    if number == signal.SIGINT and hasattr(sys, 'ps1'):
        # at the prompt, it ends the line that runs or is typed, and not what goes on beside it
        if not (_held and _held[-1].take(number)):
            raise _exception(number)
        return
    # Not here, nor in a Thread, whose start takes a lock: the main thread may hold any lock just
    # now.
    _thread.start_new_thread(_end, ())
    _raise(number)


def _raise(number):
    """End what the main thread does, if it does not end by itself, at once or when the hold
    ends."""
    if _held and _held[-1].take(number) or _waiting:
        return
    raise _exception(number)


def _exception(number):
    """What a signal raises. Not made where it is raised: with its own frame it would be a cycle."""
    # the status is the shell's for a process that the signal ended
    error = KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)
    setattr(error, _MARK, number)
    return error


def _do_default(number, frame):
    """What Python and the system do with a signal."""
    if number == signal.SIGINT:
        signal.default_int_handler(number, frame)
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


def _forget():
    """In a process that was forked: it begins anew."""
    global _waiting
    _waiting = 0
    _held.clear()


os.register_at_fork(after_in_child=_forget)
