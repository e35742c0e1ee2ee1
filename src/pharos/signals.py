"""Ctrl-C, SIGTERM and SIGHUP, which stop the nodes where the program has no handlers of its own."""
import contextlib
import itertools
import logging
import os
import signal
import sys
import threading
import time
import traceback
import _thread
from types import CodeType, FrameType
from typing import Any, Callable, Iterator, List, Optional, Set

import rosgraph

from pharos.private_rospy.process_rospy import rospy

#: Python's, also where a script is told that it is in its own
main_thread = threading.main_thread

_DEFAULTS = {
    signal.SIGINT: signal.default_int_handler,
    signal.SIGTERM: signal.SIG_DFL,
    signal.SIGHUP: signal.SIG_DFL,
}

#: The attribute of an exception by which a signal ends the main thread. Kept here itself, it would
#: keep the frames of the program, and what is in them, until Python takes its modules apart.
_MARK = '_pharos_signal'

HOLD_LIMIT = 30.0  # seconds after which a signal cuts off even a start or a stop
PATIENCE = 1.0  # seconds, likewise, for other calls of ours, from the end of the nodes on
REMINDER = 0.01  # seconds between two looks at whether the main thread can be cut off
#: has it look. It is none of those that come, so that none of these is taken for it, and does
#: nothing where it comes late.
_REMINDER_SIGNAL = signal.SIGURG
#: where code is that may hold a lock just now which the nodes need to stop, and Python to end
_OURS = tuple(
    os.path.join(os.path.dirname(file), '')
    for file in (__file__, rosgraph.__file__, rospy.__file__, logging.__file__)
)
_PYTHONS = os.path.dirname(os.__file__), '<frozen '
#: functions of Python's that run when something is freed, where it drops what is raised: those that
#: close sockets and files, name them in a ResourceWarning, and take them out of weak collections
_FINALIZERS = {'__repr__', 'close', '_real_close', '_close_conn', '_remove', 'remove'}

#: signals that have come to be ours, perhaps by way of a handler that the program has set since
taken_on: Set[int] = set()

_is_needed: Callable[[], bool] = bool  # see :func:`serve`
_stop_all: Callable[[], Any] = bool
_waits = 0  # how deep the main thread is in waits of ours, which end with the nodes
_is_cut_off = False  # whether the innermost of them is cut off by what the signal raises instead
_holds = 0  # how many starts and stops, within one another, the main thread runs
_coming: 'Optional[_Signal]' = None  # has come, and not yet ended what the main thread does


class _Signal:
    """A signal that ends what the main thread does as soon as that can be cut off.

    Torn up at any moment, a call of ours leaves a registration behind, or a lock held for ever.

    :param error: what a handler of the program's own raised within a :func:`held`
    """

    def __init__(self, number: int, error: Optional[BaseException] = None) -> None:
        self.number, self.error = number, error
        # at the prompt, it ends the line that runs or is typed, and not what goes on beside it
        self.is_at_prompt = number == signal.SIGINT and is_at_prompt()
        self._came = time.monotonic()
        self._stopped = self._came if self.is_at_prompt else None  # when the nodes had

    def stop_nodes(self) -> None:
        """Stop all nodes; afterwards, the main thread is waited for no longer than PATIENCE."""
        _stop_all()
        self._stopped = time.monotonic()

    def remind(self) -> None:
        """Have the main thread's handler look again and again, until it has raised an exception."""
        identifier = main_thread().ident
        while self.error is not None or signal.getsignal(self.number) is _on_signal:
            time.sleep(REMINDER)  # first: mostly it is cut off at once, and needs none
            if _coming is not self:
                return
            signal.pthread_kill(identifier, _REMINDER_SIGNAL)  # type: ignore[arg-type]

    def may_cut_off(self, frame: Optional[FrameType]) -> bool:
        """Whether the main thread, which is at that frame, can be cut off there."""
        now = time.monotonic()
        if _holds:
            return now - self._came > HOLD_LIMIT
        if _waits:
            return True
        if any(_is_finalizer(each.f_code) for each in _with_callers(frame)):
            return now - self._came > HOLD_LIMIT
        if self._stopped is None:
            return not _runs_ours(frame)
        return now - self._stopped > PATIENCE or not _runs_ours(_without_pythons(frame), 1)

    def exception(self) -> BaseException:
        """What it raises in the main thread."""
        return _exception(self.number) if self.error is None else self.error


class _Postponing:
    """A handler of the program's own while the main thread is in a :func:`held`: it is called at
    once, and what it raises is raised afterwards."""

    def __init__(self, number: int, handler: Any) -> None:
        self._number = number
        # one of these where the end of the last held() was itself interrupted
        self._handler: Any = handler._handler if isinstance(handler, _Postponing) else handler

    @classmethod
    def of_all(cls) -> 'List[_Postponing]':
        """Those for the handlers of the program's own that there are."""
        handlers = ((number, signal.getsignal(number)) for number in range(1, signal.NSIG))
        ours = _on_signal, _look_again
        return [cls(*each) for each in handlers if callable(each[1]) and each[1] not in ours]

    def begin(self) -> None:
        """From now on."""
        signal.signal(self._number, self)

    def __call__(self, number: int, frame: Optional[FrameType]) -> None:
        try:
            self._handler(number, frame)
        except BaseException as error:
            if not _holds:
                raise
            if _coming is None:
                _come(_Signal(number, error))
            _look_again(number, frame)

    def end(self) -> None:
        """The program's own is the handler again, unless the program has set another one."""
        current: Any = signal.getsignal(self._number)
        if current is self:
            signal.signal(self._number, self._handler)


def _runs_ours(frame: Optional[FrameType], depth: Optional[int] = None) -> bool:
    """Whether code of ours is among the frame and its callers, or the first ``depth`` of them."""
    frames = itertools.islice(_with_callers(frame), depth)
    return any(each.f_code.co_filename.startswith(_OURS) for each in frames)


def _without_pythons(frame: Optional[FrameType]) -> Optional[FrameType]:
    """The innermost frame that is not in Python's own library, but for what of that is ours."""
    for each in _with_callers(frame):
        if _runs_ours(each, 1) or not each.f_code.co_filename.startswith(_PYTHONS):
            return each
    return None


def _is_finalizer(code: CodeType) -> bool:
    """Whether the code may run because something is freed."""
    is_pythons = code.co_filename.startswith(_PYTHONS)
    return code.co_name == '__del__' or is_pythons and code.co_name in _FINALIZERS


def _with_callers(frame: Optional[FrameType]) -> Iterator[FrameType]:
    while frame is not None:
        yield frame
        frame = frame.f_back


def is_from_signal(error: BaseException) -> bool:
    """Whether a signal ends the program with this exception, and not what a block raised by itself.

    What the program's own handlers of signals raise in the main thread is for who installed them.
    """
    # not by hasattr: the exception may have a __getattr__ of its own
    if _MARK in object.__getattribute__(error, '__dict__'):
        return True
    if threading.current_thread() is not main_thread():
        return False
    handlers = [signal.getsignal(number) for number in signal.valid_signals()]
    if isinstance(error, KeyboardInterrupt) and signal.default_int_handler in handlers:
        return True
    codes = [code_of(handler) for handler in handlers]
    return any(frame.f_code in codes for frame, _ in traceback.walk_tb(error.__traceback__))


def code_of(function: Any) -> Any:
    """The code object that runs when a function, or another object, is called; None if not
    Python's."""
    if hasattr(function, '__code__'):
        return function.__code__
    return getattr(getattr(type(function), '__call__', None), '__code__', None)


def is_at_prompt() -> bool:
    """Whether lines are typed at a prompt: Python's, IPython's, or the one that ``python -i`` gives
    after the program."""
    return hasattr(sys, 'ps1') or bool(sys.flags.inspect)


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
    if threading.current_thread() is main_thread():
        for number in numbers:
            if signal.getsignal(number) is _DEFAULTS[number]:
                signal.signal(number, _on_signal)
                taken_on.add(number)


@contextlib.contextmanager
def interruptible_wait(is_cut_off: bool = False) -> Iterator[None]:
    """Within this, a signal raises nothing in the main thread: the wait ends because the nodes
    stop.

    :param is_cut_off: whether it raises at once, as in code of the user's: for a wait that holds no
        lock, and of which there is nothing to return
    """
    global _waits, _is_cut_off
    if threading.current_thread() is not main_thread():
        yield
        return
    _waits += 1
    former, _is_cut_off = _is_cut_off, is_cut_off
    try:
        yield
    finally:
        _waits -= 1
        _is_cut_off = former


@contextlib.contextmanager
def held(is_end: bool = False) -> Iterator[None]:
    """Within this, a signal raises nothing in the main thread, and afterwards what it would have
    raised, by a handler that the program had before, too.

    A start or a stop that is torn up half way leaves registrations behind, and the end of the
    program programs, too. After HOLD_LIMIT seconds it is cut off all the same.

    :param is_end: whether it is the end of the program, so that there is nothing to raise
        afterwards
    """
    global _coming, _holds
    if threading.current_thread() is not main_thread():
        yield
        return
    _take_on(*_DEFAULTS)
    handlers = [] if _holds else _Postponing.of_all()
    try:
        for handler in handlers:
            handler.begin()
        _holds += 1
        yield
    finally:
        _holds = max(0, _holds - 1)  # 0: the process was forked in it
        for handler in handlers:
            handler.end()
        coming = _coming
        if coming is not None and not _holds and not (_waits and coming.error is None):
            _coming = None
            if not is_end:
                raise coming.exception()


def _on_signal(number: int, frame: Optional[FrameType]) -> None:
    if _coming is None or _coming.error is not None:
        if not (_holds or _is_needed()):
            _do_default(number, frame)
            return
        coming = _Signal(number)
        # Not here, nor in a Thread, whose start takes a lock: the main thread may hold any lock
        # just now.
        if not coming.is_at_prompt:
            _thread.start_new_thread(coming.stop_nodes, ())
            if _waits and not (_holds or _is_cut_off):
                return  # the wait ends with the nodes
        _come(coming)
    _look_again(number, frame)


def _come(coming: _Signal) -> None:
    global _coming
    _coming = coming
    signal.signal(_REMINDER_SIGNAL, _look_again)
    _thread.start_new_thread(coming.remind, ())


def _look_again(_: int, frame: Optional[FrameType]) -> None:
    """Cut the main thread off, if it can be."""
    global _coming
    if _coming is not None and _coming.may_cut_off(frame):
        coming, _coming = _coming, None
        raise coming.exception()


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
    global _waits, _is_cut_off, _holds, _coming
    _waits = _holds = 0
    _is_cut_off, _coming = False, None


os.register_at_fork(after_in_child=_forget)
