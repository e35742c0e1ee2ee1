"""What a program has of a process of its own, and a node's program, libraries and rospy have of the
node: environment, arguments, exit handlers, signals, threads and child processes."""
import atexit
import contextlib
import functools
import inspect
import math
import os
import posixpath
import signal
import socket
import threading
import time
import xmlrpc
import xmlrpc.client
import _posixsubprocess
import _thread
from typing import Any, Dict

from pharos.errors import PharosError
from pharos.private_rospy.lifetime import JOIN_TIMEOUT
from pharos.private_rospy.module_proxy import ModuleProxy
from pharos.private_rospy.proxies import ServerProxy

_getsignal, _set_signal = signal.getsignal, signal.signal
_main_thread = threading.main_thread
_programs: Dict[int, Any] = {}  # identifier of a program's main thread -> its OwnProcess


@functools.lru_cache(maxsize=None)
def _share_signals():
    """Have what is shared, such as the reactor of Twisted or an event loop of asyncio, find itself
    in the main thread, and set handlers, in a program's main thread, too: Python lets only its own
    one.
    """
    for name in OwnProcess.SIGNAL_FUNCTIONS:
        setattr(signal, name, _by_program(name, getattr(signal, name)))
    threading.main_thread = _by_program('main_thread', threading.main_thread)


def _by_program(name, real):
    @functools.wraps(real)
    def function(*args, **kwargs):
        program = _programs.get(threading.get_ident())
        return (program.functions[name] if program else real)(*args, **kwargs)

    return function


def hear_signals():
    """Have SIGUSR1 and SIGUSR2 from elsewhere, which end a process, be for the programs that have
    handlers for them; Python lets only its main thread see to that."""
    if threading.current_thread() is _main_thread():
        for number in signal.SIGUSR1, signal.SIGUSR2:
            if _getsignal(number) is signal.SIG_DFL:
                _set_signal(number, _on_signal)


def _on_signal(number, frame):
    handling = [program for program in tuple(_programs.values()) if program.handles(number)]
    if not handling:
        _set_signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    for program in handling:
        # not in a Thread, whose start takes a lock, which the main thread may hold just now
        _thread.start_new_thread(program.handle, (number,))


def _set_default_timeout(timeout):
    """``socket.setdefaulttimeout``, but for rospy, which means its own sockets."""
    if not inspect.currentframe().f_back.f_globals['__name__'].startswith('rospy.'):
        socket.setdefaulttimeout(timeout)


class OwnProcess:
    """Puts into a set of private modules what stands in for Python's.

    :param imports: the :class:`~.loader.PrivateImports`
    :param settings: the :class:`~.settings.Settings` of the node
    :param report: called with what an exit handler or a handler of signals raised, and with what
        that is, where it is not of the end
    :param request_stop: called with the reason why a signal ends the program
    """

    #: those of the module signal that each program has for itself
    SIGNAL_FUNCTIONS = (
        *('signal', 'getsignal', 'set_wakeup_fd'),
        *('alarm', 'setitimer', 'getitimer', 'raise_signal'),
    )

    def __init__(self, imports, settings, lifetime, report, request_stop):
        self._environ, self._lifetime, self._report = settings.environ, lifetime, report
        self._request_stop = request_stop
        self.exit_handlers = []  # (function, arguments, keyword arguments), the first to run last
        self._before_threads_end = []  # likewise, what threading calls
        self._wakeup_fd, self._signal_handlers = -1, {}
        self._former_handlers = {}  # those of before rospy had its own, which calls them in the end
        self._alarm_timer, self._alarm_due, self._alarm_interval = None, 0.0, 0.0
        #: what stands in for functions of the modules signal and threading, in a program
        self.functions = {
            'signal': self._set_signal_handler,
            'getsignal': self._signal_handler,
            'set_wakeup_fd': self._set_wakeup_fd,
            'alarm': self._alarm,
            'setitimer': self._set_timer,
            'getitimer': self._timer,
            'raise_signal': self._raise_signal,
            'main_thread': lambda: lifetime.main_thread,
        }
        signals = {name: self.functions[name] for name in self.SIGNAL_FUNCTIONS}
        proxies = ModuleProxy(xmlrpc.client, ServerProxy=ServerProxy)
        own_os = self._os(imports)
        imports.system.argv = settings.argv
        imports.modules.update(
            {
                'os': own_os,
                'os.path': own_os.path,
                'posixpath': own_os.path,
                'atexit': ModuleProxy(atexit, register=self._at_exit, unregister=self._not_at_exit),
                'signal': ModuleProxy(signal, pause=lifetime.ended.wait, **signals),
                'threading': ModuleProxy(
                    threading,
                    Thread=lifetime.Thread,
                    Timer=lifetime.Timer,
                    main_thread=self.functions['main_thread'],
                    _register_atexit=self._before_threads_end.append,
                ),
                '_thread': ModuleProxy(_thread, start_new_thread=lifetime.start_thread),
                'time': ModuleProxy(time, sleep=lifetime.sleep),
                'socket': ModuleProxy(socket, setdefaulttimeout=_set_default_timeout),
                'xmlrpc': ModuleProxy(xmlrpc, client=proxies),
                'xmlrpc.client': proxies,
                '_posixsubprocess': ModuleProxy(_posixsubprocess, fork_exec=self._fork_exec),
            }
        )

    # -- environment and child processes

    def _os(self, imports):
        own_os = imports.twin(
            os,
            environ=self._environ,
            putenv=self._environ.__setitem__,
            unsetenv=lambda name: self._environ.pop(name, None),
            system=self._system,
            kill=self._kill,
            execv=lambda path, arguments: os.execve(path, arguments, self._environ),
        )
        own_os.path = imports.twin(posixpath, os=own_os)
        return own_os

    def _system(self, command):
        """``os.system``."""
        child = os.posix_spawn('/bin/sh', ['sh', '-c', command], self._environ)
        return os.waitpid(child, 0)[1]

    def _fork_exec(self, *arguments):
        """What subprocess and multiprocessing start programs by."""
        *before, environ = arguments[:6]
        if environ is None:
            environ = [
                os.fsencode(name) + b'=' + os.fsencode(value)
                for name, value in self._environ.items()
            ]
        return _posixsubprocess.fork_exec(*before, environ, *arguments[6:])

    # -- the end

    def _at_exit(self, function, *args, **kwargs):
        """``atexit.register``."""
        self.exit_handlers.append((function, args, kwargs))
        return function

    def _not_at_exit(self, function):
        """``atexit.unregister``."""
        self.exit_handlers[:] = [each for each in self.exit_handlers if each[0] != function]

    def end_pools(self):
        """Have the threads of executors end when their work is done, as Python does at its end."""
        while self._before_threads_end:
            self._attempt(self._before_threads_end.pop())

    def run_exit_handlers(self):
        """Run the handlers of atexit, the last first, each once."""
        self._attempt(self._lifetime.raise_pending)  # where it could not, report it
        while self.exit_handlers:
            function, args, kwargs = self.exit_handlers.pop()
            self._attempt(function, *args, **kwargs)
        self.end_pools()  # of a library, and of a program that has not come to its end

    def _attempt(self, function, *args, **kwargs):
        try:
            function(*args, **kwargs)
        except (SystemExit, KeyboardInterrupt):
            pass  # the node ends already
        except BaseException as error:
            self._report(error)

    # -- signals

    def _set_signal_handler(self, number, handler):
        """``signal.signal``, in whatever thread."""
        if not callable(handler) and handler not in (signal.SIG_DFL, signal.SIG_IGN):
            raise TypeError(
                'signal handler must be signal.SIG_IGN, signal.SIG_DFL, or a callable object'
            )
        number = signal.Signals(number)
        before = self._signal_handler(number)
        self._signal_handlers[number] = handler
        return before

    def _signal_handler(self, number):
        """``signal.getsignal``."""
        return self._signal_handlers.get(number) or _getsignal(number)

    def _set_wakeup_fd(self, descriptor, *, warn_on_full_buffer=True):
        """``signal.set_wakeup_fd``."""
        before, self._wakeup_fd = self._wakeup_fd, descriptor
        return before

    def _alarm(self, seconds):
        """``signal.alarm``."""
        return math.ceil(self._set_timer(signal.ITIMER_REAL, seconds)[0])

    def _set_timer(self, which, seconds, interval=0.0):
        """``signal.setitimer``: a thread of the node calls the handler of SIGALRM."""
        before = self._timer(which)
        if self._alarm_timer is not None:
            self._alarm_timer.cancel()
        self._alarm_timer, self._alarm_interval = None, interval
        if seconds > 0:
            self._alarm_due = time.monotonic() + seconds
            self._alarm_timer = timer = self._lifetime.Timer(seconds, self._ring)
            timer.daemon = True
            timer.start()
        return before

    def _timer(self, which):
        """``signal.getitimer``."""
        if which != signal.ITIMER_REAL:
            raise signal.ItimerError(
                'a script shares its process, and has no timer of CPU time: run it as a process of'
                ' its own'
            )
        if self._alarm_timer is None:
            return 0.0, 0.0
        return max(self._alarm_due - time.monotonic(), 0.0), self._alarm_interval

    def _ring(self):
        again = self._alarm_interval
        self._set_timer(signal.ITIMER_REAL, again, again)
        self._run_handler(signal.SIGALRM)

    def _raise_signal(self, number):
        """``signal.raise_signal``: it calls the program's handler, where it has one."""
        if self.handles(number):
            handler = self._signal_handlers[number]
            if callable(handler):
                handler(number, None)
        else:
            os.kill(os.getpid(), number)

    def _kill(self, process, number):
        """``os.kill``."""
        if process == os.getpid():
            self._raise_signal(number)
        else:
            os.kill(process, number)

    def handles(self, number):
        """Whether the program has a handler of its own for the signal, or ignores it."""
        return self._signal_handlers.get(number, signal.SIG_DFL) != signal.SIG_DFL

    def handle(self, number):
        """Have a thread of the node call its handler of the signal."""
        self._lifetime.start_thread(self._run_handler, (number,), name=signal.Signals(number).name)

    def _run_handler(self, number):
        name = signal.Signals(number).name
        handler = self._signal_handlers.get(number)
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

    @contextlib.contextmanager
    def main_thread(self):
        """Within this, this is the main thread of the program."""
        _share_signals()
        _programs[threading.get_ident()] = self
        try:
            yield
        finally:
            del _programs[threading.get_ident()]

    def forget_signals(self):
        """Call none of the handlers: there is no program any more that they could end."""
        self._signal_handlers, self._former_handlers, self._wakeup_fd = {}, {}, -1

    def leave_signals_to_rospy(self):
        """rospy.init_node sets handlers, which call those that are there when it has shut down."""
        for number in {signal.SIGINT, signal.SIGTERM} & self._signal_handlers.keys():
            self._former_handlers[number] = self._signal_handlers.pop(number)

    def call_signal_handler(self):
        """Call the handler of SIGINT, or else SIGTERM, as these signals would end the program."""
        handlers = self._signal_handlers
        if handlers:
            self._call_one_of(handlers)

    def call_former_signal_handler(self):
        """Likewise, for one that the program set before rospy.init_node."""
        self._call_one_of(self._former_handlers)

    def _call_one_of(self, handlers):
        """What takes longer is not waited for."""
        descriptor = self._wakeup_fd
        self.forget_signals()
        for number in signal.SIGINT, signal.SIGTERM:
            handler = handlers.get(number)
            if callable(handler):
                if descriptor >= 0:
                    with contextlib.suppress(OSError):  # it is full, or closed
                        os.write(descriptor, bytes([number]))
                thread = self._lifetime.start_thread(
                    self._call_handler, (handler, number), name=number.name
                )
                thread.join(JOIN_TIMEOUT)
                return

    def _call_handler(self, handler, number):
        self._lifetime.is_interruptible = False  # it is instead of KeyboardInterrupt
        try:
            handler(number, None)
        except BaseException as error:  # the main thread is to raise it, as in a process
            self._lifetime.raised = error
