"""Signals, as a program has them that shares its process with others."""
import contextlib
import functools
import math
import os
import signal
import threading
import time
import _thread
from typing import Any, Dict

from pharos.errors import PharosError
from pharos.private_rospy.lifetime import JOIN_TIMEOUT
from pharos.private_rospy.module_proxy import ModuleProxy
from pharos.signals import main_thread

# Python's, also within a program
_getsignal, _set_signal = signal.getsignal, signal.signal
_programs: Dict[int, Any] = {}  # identifier of a program's main thread -> its OwnSignals


@functools.lru_cache(maxsize=None)
def _share():
    """Have what is shared, such as the reactor of Twisted or an event loop of asyncio, find itself
    in the main thread, and set handlers, in a program's main thread, too: Python lets only its own
    one.
    """
    for name in OwnSignals.FUNCTIONS:
        setattr(signal, name, _by_program(name, getattr(signal, name)))
    threading.main_thread = _by_program('main_thread', threading.main_thread)


def _by_program(name, real):
    @functools.wraps(real)
    def function(*args, **kwargs):
        program = _programs.get(threading.get_ident())
        return (getattr(program, name) if program else real)(*args, **kwargs)

    return function


def _on_signal(number, frame):
    handling = [program for program in tuple(_programs.values()) if program.handles(number)]
    if not handling:
        _set_signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    for program in handling:
        # not in a Thread, whose start takes a lock, which the main thread may hold just now
        _thread.start_new_thread(program.handle, (number,))


class OwnSignals:
    """What stands in for functions of the module signal, which have the same names here.

    :param lifetime: of the node
    :param report: called with what a handler raised, and with what that is
    :param request_stop: called with the reason why a signal ends the program
    """

    #: those that each program has for itself
    FUNCTIONS = (
        *('signal', 'getsignal', 'set_wakeup_fd'),
        *('alarm', 'setitimer', 'getitimer', 'raise_signal'),
    )

    def __init__(self, lifetime, report, request_stop):
        self._lifetime, self._report, self._request_stop = lifetime, report, request_stop
        self._handlers = {}
        self._former_handlers = {}  # those of before rospy had its own, which calls them in the end
        self._rospys_handler = None
        self._wakeup_fd = -1
        self._timer, self._due, self._interval = None, 0.0, 0.0  # of SIGALRM
        #: the module
        self.module = ModuleProxy(
            signal,
            pause=lifetime.ended.wait,
            **{name: getattr(self, name) for name in self.FUNCTIONS},
        )

    def main_thread(self):
        """``threading.main_thread``."""
        return self._lifetime.main_thread

    # -- as of the module signal

    def signal(self, number, handler):
        """In whatever thread."""
        if not callable(handler) and handler not in (signal.SIG_DFL, signal.SIG_IGN):
            raise TypeError(
                'signal handler must be signal.SIG_IGN, signal.SIG_DFL, or a callable object'
            )
        number = signal.Signals(number)
        before = self.getsignal(number)
        self._handlers[number] = handler
        return before

    def getsignal(self, number):
        """What the process ignores, its programs do, too; its handlers are none of theirs."""
        if number in self._handlers:
            return self._handlers[number]
        handler = _getsignal(number)
        return signal.SIG_DFL if callable(handler) else handler

    def set_wakeup_fd(self, descriptor, *, warn_on_full_buffer=True):
        """Is written to before a handler is called."""
        before, self._wakeup_fd = self._wakeup_fd, descriptor
        return before

    def alarm(self, seconds):
        """By :meth:`setitimer`."""
        return math.ceil(self.setitimer(signal.ITIMER_REAL, seconds)[0])

    def setitimer(self, which, seconds, interval=0.0):
        """A thread of the node calls the handler of SIGALRM."""
        before = self.getitimer(which)
        if self._timer is not None:
            self._timer.cancel()
        self._timer, self._interval = None, interval
        if seconds > 0:
            self._due = time.monotonic() + seconds
            self._timer = timer = self._lifetime.Timer(seconds, self._ring)
            timer.daemon = True
            timer.start()
        return before

    def getitimer(self, which):
        """Of real time alone."""
        if which != signal.ITIMER_REAL:
            raise signal.ItimerError(
                'a script shares its process, and has no timer of CPU time: run it as a process of'
                ' its own'
            )
        if self._timer is None:
            return 0.0, 0.0
        return max(self._due - time.monotonic(), 0.0), self._interval

    def _ring(self):
        again = self._interval
        self.setitimer(signal.ITIMER_REAL, again, again)
        self._run_handler(signal.SIGALRM)

    def raise_signal(self, number):
        """It calls the program's handler, where it has one."""
        if self.handles(number):
            handler = self._handlers[number]
            if callable(handler):
                handler(number, None)
        else:
            os.kill(os.getpid(), number)

    def kill(self, process, number):
        """``os.kill``."""
        if process == os.getpid():
            self.raise_signal(number)
        else:
            os.kill(process, number)

    # -- signals that come

    def handles(self, number):
        """Whether the program has a handler of its own for the signal, or ignores it."""
        return self._handlers.get(number, signal.SIG_DFL) != signal.SIG_DFL

    def handle(self, number):
        """Have a thread of the node call its handler of the signal."""
        self._lifetime.start_thread(self._run_handler, (number,), name=signal.Signals(number).name)

    def _run_handler(self, number):
        name = signal.Signals(number).name
        handler = self._handlers.get(number)
        try:
            if callable(handler):
                handler(number, None)
            elif handler != signal.SIG_IGN:
                error = PharosError(f'{name} came, for which the program has no handler')
                self._report(error, 'the program')
                self._request_stop(name)
        except (SystemExit, KeyboardInterrupt):
            self._request_stop(name)
        except BaseException as error:
            self._report(error, f'the handler of {name}')

    # -- the life of a program

    def begin(self):
        """A program is to run: it has the handler of SIGINT that Python sets, and SIGUSR1 and
        SIGUSR2 from elsewhere, which end a process, are for the programs that have handlers for
        them, where this is Python's main thread, which alone can see to that."""
        self._handlers[signal.SIGINT] = signal.default_int_handler
        if threading.current_thread() is main_thread():
            for number in signal.SIGUSR1, signal.SIGUSR2:
                if _getsignal(number) is signal.SIG_DFL:
                    _set_signal(number, _on_signal)

    @contextlib.contextmanager
    def of_this_thread(self):
        """Within this, this is the main thread of the program."""
        _share()
        _programs[threading.get_ident()] = self
        try:
            yield
        finally:
            del _programs[threading.get_ident()]

    def forget(self):
        """Call none of the handlers: there is no program any more that they could end."""
        self._handlers, self._former_handlers, self._wakeup_fd = {}, {}, -1

    def leave_to_rospy(self, handler):
        """rospy.init_node sets its handler, which calls those that are there when it has shut down,
        and keeps silent about Ctrl-C."""
        self._rospys_handler = handler
        for number in signal.SIGINT, signal.SIGTERM:
            former = self.signal(number, handler)
            if former is not signal.default_int_handler:
                self._former_handlers[number] = former

    def call_handler(self):
        """Call the handler of SIGINT, or else SIGTERM, as these signals would end the program; not
        rospy's, for the stop does what that does."""
        self._call_one_of(self._handlers)

    def call_former_handler(self):
        """Likewise, for one that the program set before rospy.init_node."""
        self._call_one_of(self._former_handlers)

    def _call_one_of(self, handlers):
        """What takes longer is not waited for."""
        for number in signal.SIGINT, signal.SIGTERM:
            handler = handlers.get(number)
            if callable(handler) and handler is not self._rospys_handler:
                descriptor = self._wakeup_fd
                self.forget()
                if descriptor >= 0:
                    with contextlib.suppress(OSError):  # it is full, or closed
                        os.write(descriptor, bytes([number]))
                thread = self._lifetime.start_thread(
                    self._call_handler, (handler, number), name=number.name
                )
                thread.join(JOIN_TIMEOUT)
                return

    def _call_handler(self, handler, number):
        try:
            handler(number, None)
        except BaseException as error:  # the main thread is to raise it, as in a process
            self._lifetime.raised = error
