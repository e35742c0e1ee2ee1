"""What a node's rospy holds while it runs, so that its stop leaves nothing behind: threads and
sockets."""
import contextlib
import inspect
import signal
import socket
import sys
import threading
import time
import weakref
from typing import Any, Callable, Iterable, List, Optional, TypeVar

from pharos import working_directory
from pharos.private_rospy import threads
from pharos.private_rospy.module_proxy import ModuleProxy
from pharos.signals import main_thread

# A signal that the kernel gives to another thread, or that comes just before the main thread waits,
# does not end that wait, after which Python would handle it.
SIGNAL_LATENCY = 0.2  # seconds that such a wait lasts at the most
JOIN_TIMEOUT = 2.0  # seconds that a thread is waited for
CUT_OFF_TIMEOUT = 0.5  # seconds likewise, when what sleeps in it is cut off
# A peer that vanishes says nothing: TCP notices that it is gone where it is asked to, here within
# half a minute.
KEEPALIVE_IDLE = 10  # seconds of silence after which the peer's host is asked whether it is there
KEEPALIVE_INTERVAL = 5  # seconds between two such questions
KEEPALIVE_COUNT = 4  # of them without an answer, and the connection is broken

# .lifetime: of the node on whose behalf the thread runs; .interruption: the innermost it is within;
# .was_cut_off: whether a ProgramCutOff was raised in it
_thread = threading.local()
T = TypeVar('T')


class ProgramCutOff(SystemExit):
    """Ends a thread of a program that goes on when the time that it has after the stop is up."""


def on_nobodys_behalf():
    """Within this, what waits in this thread ends with no node, whose thread it may be."""
    return _on_behalf_of(None)


@contextlib.contextmanager
def _on_behalf_of(lifetime):
    before = getattr(_thread, 'lifetime', None)
    _thread.lifetime = lifetime
    try:
        yield
    finally:
        _thread.lifetime = before


class Lifetime:
    """The threads and sockets of one run of a node, and the event that ends it.

    Sleeps inside rospy end when the node stops, as do waits in an :class:`Interruption`.

    :param name: the node's, for the names of its threads
    """

    raised = None  # what a handler of signals raised, and the main thread is to

    def __init__(self, name):
        self.name = name
        self.ended = threading.Event()  # set when the node stops
        # set when the node is unregistered, and its XML-RPC server closed
        self.silent = threading.Event()
        # whether the node has a program of its own, which may do its last things after the stop has
        # begun; until this, when what sleeps in it is cut off
        self.has_program, self.overdue = False, threading.Event()
        self.folder = None  # the working directory of its threads; None: the process's
        # identifiers of the thread that runs the hooks of on_shutdown, and that ends all in the end
        self.hooks_thread = self.ending_thread = None
        self.interruptions = set()  # of waits under way
        self.threads = weakref.WeakSet()
        self.main_thread = threading.main_thread()  # or its program's
        self.xmlrpc = None  # the node's XML-RPC server, once it is bound
        self._sockets = weakref.WeakSet()
        lifetime = self

        class Thread(threading.Thread):
            """A thread that is named after its node, ends with the process, and can be waited
            for."""

            is_waited_for = False  # whether a program goes on until it has ended

            def __init__(self, *args, **options):
                super().__init__(*args, **options)
                if options.get('daemon') is None:
                    self.daemon = lifetime.makes_daemons()

            def run(self):
                with lifetime.runs(self.is_from_elsewhere):
                    super().run()

            def start(self):
                is_rospys = str(getattr(self._target, '__module__', '')).startswith('rospy.')
                self.is_waited_for = not (self.daemon or is_rospys)
                self.daemon = True
                self.name = f'{lifetime.name} {self.name}'
                # one that a thread of the node starts has the working directory of that
                self.is_from_elsewhere = getattr(_thread, 'lifetime', None) is not lifetime
                lifetime.threads.add(self)
                threads.start(super().start, lifetime.name)

        class Timer(Thread, threading.Timer):
            """``threading.Timer`` of the node, whose stop cancels it, at the end of its program."""

        self.Thread, self.Timer = Thread, Timer
        #: what threading calls before it waits for threads, the first to be called last
        self.before_threads_end = []
        #: the module, as the node's program and libraries have it
        self.threading = ModuleProxy(
            threading,
            Thread=Thread,
            Timer=Timer,
            main_thread=lambda: self.main_thread,
            _register_atexit=self.before_threads_end.append,
        )

    def rename(self, name):
        """Have the threads be named after the node, which is called so from now on."""
        for thread in listed(self.threads):
            thread.name = thread.name.replace(self.name, name, 1)
        self.name = name

    def start_thread(self, target, args=(), name=None):
        """Run ``target`` in a thread of this lifetime; the same as ``_thread.start_new_thread``."""
        thread = self.Thread(target=target, args=args, name=name, daemon=True)
        thread.start()
        return thread

    def run_on_behalf(self, job, name):
        """Call ``job()`` in this thread, which is the process's, as in one of that name of the
        node's."""
        thread = threading.current_thread()
        process_name, thread.name = thread.name, f'{self.name} {name}'
        _thread.lifetime = self
        try:
            job()
        finally:
            _thread.lifetime = None
            thread.name = process_name

    def makes_daemons(self):
        """Whether threads that this one makes are daemons, unless they are told otherwise."""
        maker = threading.current_thread()
        return not (maker is self.main_thread or getattr(maker, 'is_waited_for', False))

    @contextlib.contextmanager
    def runs(self, is_from_elsewhere):
        """Within this, a thread of the node runs what it is for.

        :param is_from_elsewhere: whether none of the node's has started it
        """
        if is_from_elsewhere and self.folder:
            working_directory.enter(self.folder)
        try:
            with self.interrupts_waits():
                yield
        except ProgramCutOff:
            pass  # threading keeps silent about SystemExit itself alone
        except BaseException:
            hook = vars(self.threading).get('excepthook')  # the program's, if it has set one
            if hook is None:
                raise
            hook(threading.ExceptHookArgs([*sys.exc_info(), threading.current_thread()]))

    def interrupts_waits(self):
        """Within this, what waits in this thread does so on behalf of the node, and ends with
        it."""
        return _on_behalf_of(self)

    def begin_shutdown(self):
        """Begin the stop: all that waits on behalf of the node ends."""
        self.ended.set()
        for interruption in tuple(self.interruptions):
            interruption.wake()
        if not self.has_program:
            self._cancel_timers()

    def _cancel_timers(self):
        for thread in listed(self.threads):
            if isinstance(thread, self.Timer):
                thread.cancel()

    def await_end(self, threads, timeout):
        """Wait for the threads, for up to ``timeout`` seconds; what sleeps in a program still is cut
        off then, in threads that are daemons as soon as the program has ended."""
        join(threads, timeout)
        self.overdue.set()
        self._cancel_timers()
        if self.has_program:
            join(threads, CUT_OFF_TIMEOUT)

    def wait_for_threads(self):
        """Wait until those threads of the program have ended for which Python waits at its end, or
        the time is up."""
        for thread in listed(self.threads):
            if thread.is_waited_for and thread is not threading.current_thread():
                while thread.is_alive() and not self.overdue.is_set():
                    thread.join(SIGNAL_LATENCY)

    def sleep(self, seconds):
        """``time.sleep`` that ends with the node; ``sleep(0)`` yields, as rospy's publishers mean
        it to.

        What a program calls itself sleeps for as long as it says, also after the stop has begun, as
        do hooks of rospy.on_shutdown: what comes next is not to happen too early.

        :raises KeyboardInterrupt: in the main thread of a program for which rospy handles no signals
        :raises ProgramCutOff: in a thread of a program that has ended, or for which the time is up
        """
        is_programs = self.has_program and self._is_programs()
        if seconds <= 0:
            time.sleep(0)
        elif threading.get_ident() == self.hooks_thread:
            time.sleep(seconds)
        elif is_programs and (self.ended.is_set() or not _is_rospys(inspect.currentframe().f_back)):
            self._sleep_in_program(seconds)
        elif not self.ended.is_set():
            self._sleep_until(self.ended, seconds)
            self._interrupt()

    def _sleep_in_program(self, seconds):
        until = time.monotonic() + seconds
        if threading.current_thread() is self.main_thread:
            self._sleep_until(self.ended, seconds)
            self._interrupt()
        if getattr(_thread, 'was_cut_off', False):
            time.sleep(seconds)  # it has caught what was raised, and goes on
        self._sleep_until(self.overdue, until - time.monotonic())
        if self.overdue.is_set():
            _thread.was_cut_off = True
            raise ProgramCutOff(-signal.SIGTERM)

    def _is_programs(self):
        is_ending = threading.get_ident() == self.ending_thread
        return threading.current_thread() in self.threads and not is_ending

    def _interrupt(self):
        if threading.current_thread() is self.main_thread and self.ended.is_set():
            self.raise_pending()

    def raise_pending(self):
        """Raise what a handler of signals has raised, once."""
        raised, self.raised = self.raised, None
        if raised is not None:
            raise raised

    @staticmethod
    def _sleep_until(event, seconds):
        is_main = threading.current_thread() is main_thread()
        longest = SIGNAL_LATENCY if is_main else seconds
        until = time.monotonic() + seconds
        while seconds > 0 and not event.wait(min(seconds, longest)):
            seconds = until - time.monotonic()

    def track_socket(self, sock):
        """Shut this socket down at the end: a thread that waits for what comes through it then
        ends."""
        self._sockets.add(sock)

    def untrack_socket(self, sock):
        """Do not shut this socket down: its client is to hear that the node has stopped."""
        self._sockets.discard(sock)

    def finish_shutdown(self, abandoned=()):
        """Shut the sockets down, and wait for the threads but those that are ``abandoned``.

        :returns: the threads that did not end in time
        """
        self.begin_shutdown()
        for sock in listed(self._sockets):
            shutdown_socket(sock)
        others = set(listed(self.threads)) - {threading.current_thread(), *abandoned}
        # One that is not alive has ended, or is just being started, and will see that all has.
        return join(others, JOIN_TIMEOUT)


def listed(weak: 'weakref.WeakSet[T]') -> List[T]:
    """What is in a set; others may add to it meanwhile, at which its iteration raises."""
    while True:
        with contextlib.suppress(RuntimeError):
            return list(weak)


def _is_rospys(frame: Any) -> bool:
    """Whether it is rospy's code that runs there."""
    return str(frame.f_globals.get('__name__')).startswith('rospy.')


def wait_for(changed: Any, predicate: Callable[[], bool], timeout: Optional[float]) -> bool:
    """Wait until ``predicate()`` holds, which is looked at when ``changed`` is notified; returns
    False where the time was up before.

    In short waits, as :func:`join`.

    :param timeout: seconds, None: without limit
    """
    deadline = float('inf') if timeout is None else time.monotonic() + timeout
    with changed:
        while not predicate():
            left = deadline - time.monotonic()
            if left <= 0:
                return False
            changed.wait(min(left, SIGNAL_LATENCY))
    return True


def join(threads: Iterable[threading.Thread], timeout: float) -> List[threading.Thread]:
    """Wait until the threads have ended, for up to ``timeout`` seconds in all; returns those that
    have not.

    In short waits, so that the main thread handles a signal that came just before one began, too.
    """
    deadline = time.monotonic() + timeout
    left = [thread for thread in threads if thread.is_alive()]
    while left and time.monotonic() < deadline:
        left[0].join(max(0.0, min(deadline - time.monotonic(), SIGNAL_LATENCY)))
        left = [thread for thread in left if thread.is_alive()]
    return left


class Interruption:
    """Within this, a wait ends when a node stops: the one on whose behalf this thread runs, or
    another one given.

    A wait that begins only when the node stops already is for its last words, and is not ended,
    unless it is part of one that began before.

    :param wake: ``wake()`` makes the wait end, in whatever thread; None where :attr:`came` is all
        that is wanted
    """

    def __init__(
        self, wake: Optional[Callable[[], Any]] = None, lifetime: Optional[Lifetime] = None
    ) -> None:
        self.wake = wake or (lambda: None)
        self._outer = getattr(_thread, 'interruption', None)
        given = lifetime, getattr(_thread, 'lifetime', None)
        self.lifetimes = {each for each in given if each is not None and not each.ended.is_set()}
        if self._outer is not None:
            self.lifetimes |= self._outer.lifetimes

    @property
    def came(self) -> bool:
        """Whether the node stops."""
        return any(lifetime.ended.is_set() for lifetime in self.lifetimes)

    def __enter__(self) -> 'Interruption':
        _thread.interruption = self
        for lifetime in self.lifetimes:
            lifetime.interruptions.add(self)
        if self.came:
            self.wake()
        return self

    def __exit__(self, *error: Any) -> None:
        _thread.interruption = self._outer
        for lifetime in self.lifetimes:
            lifetime.interruptions.discard(self)


def is_after_stop() -> bool:
    """Whether the stop of the node on whose behalf this thread runs has begun."""
    lifetime = getattr(_thread, 'lifetime', None)
    return lifetime is not None and lifetime.ended.is_set()


def is_waiting() -> bool:
    """Whether this thread is within an :class:`Interruption`."""
    return getattr(_thread, 'interruption', None) is not None


def keep_alive(sock: socket.socket, while_sending: bool = False) -> None:
    """Have the connection break when its peer has silently gone, as with a cable pulled out.

    :param while_sending: also where something is under way to the peer, which TCP else goes on
        sending for a quarter of an hour; not for publishers, since a peer that stops reading is
        then taken for one that has gone
    """
    with contextlib.suppress(OSError):  # closed already
        if while_sending:
            limit = KEEPALIVE_IDLE + KEEPALIVE_INTERVAL * KEEPALIVE_COUNT
            option = socket.TCP_USER_TIMEOUT  # type: ignore[attr-defined]  # unknown to mypy 1.0
            sock.setsockopt(socket.IPPROTO_TCP, option, 1000 * limit)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, KEEPALIVE_IDLE)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, KEEPALIVE_INTERVAL)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, KEEPALIVE_COUNT)


def shutdown_socket(sock: socket.socket) -> None:
    """Shut a socket down: unlike ``close`` alone, this wakes a thread that waits on it."""
    with contextlib.suppress(OSError):  # not connected, or closed already
        sock.shutdown(socket.SHUT_RDWR)
