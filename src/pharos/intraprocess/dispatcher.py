"""Runs the delegates of one node, one at a time, and hands messages to it quickly.

A node's delegates run in the thread that brings the message (a TCPROS connection's, where the
delegate is fast, or the publisher's where a channel is inline), in the node's dispatcher thread, or
where they are fast in the common one (see :mod:`~.common_thread`). No one who brings a message
waits for a busy node: what comes meanwhile waits in its inbox for whoever is running the node. So
no wiring deadlocks or recurses. (The ``close()`` of a channel and the ``retry()`` of a failure do
wait for the delegate that runs.) Nor does a thread run a node for long because others bring
messages: those it leaves to the dispatcher thread.
"""
import collections
import os
import threading
import time
from _thread import allocate_lock, get_ident
from typing import Any, Callable, Deque, Dict, Optional, Protocol

from pharos.errors import PharosError

# seconds; a publisher that comes again within them does not yield to the receiver
BURST_INTERVAL = 100e-6
# seconds for which a publisher at the most yields, until the dispatcher thread has woken up
YIELD_LIMIT = 1e-3
# seconds between two looks of who waits for a delegate at whether the node has stopped
CLOSED_INTERVAL = 0.1
# seconds for which a thread that brings a message also runs what others bring meanwhile
COURTESY = 1e-3
# A turn of the dispatcher thread that takes so many seconds, from its waking on, is slow.
FAST_TURN = 1e-3
# A thread that runs others, too, may run a node with so much credit: each turn that is not slow adds
# one, up to a limit, and a slow one takes ten, so that one of ten may be, as on a busy machine.
FAST_CREDIT, MAX_CREDIT, SLOW_COST = 30, 40, 10

# identifier of a thread -> the dispatcher in which it waits for its turn; guarded by the lock, so
# that of threads that wait for one another one alone gives up
_awaited: 'Dict[int, Dispatcher]' = {}
_looking = threading.Lock()


class Runnable(Protocol):
    """What a dispatcher runs: an inbox, or another dispatcher."""

    def run_next(self) -> bool:
        """Deliver the oldest message, if there is one; returns whether there was, and raises nothing."""


class Dispatcher:
    """Whoever has messages for a node puts them into inboxes, then calls :meth:`run` for those that
    are inline or came through a socket, :meth:`wake` for others if the thread is :attr:`idle`.

    :param start_thread: ``start_thread(target, name=name)``
    :param on_behalf: ``on_behalf(run, name)`` calls ``run()`` in another thread than the node's as if
        it were that; None: no thread that runs other nodes, too, is to run this one
    """

    def __init__(
        self,
        start_thread: Callable[..., Any],
        name: str = 'dispatcher',
        on_behalf: Optional[Callable[[Callable[[], Any], str], Any]] = None,
    ) -> None:
        self.inline: Deque[Runnable] = collections.deque()  # that whoever comes by may run
        self.scheduled: Deque[Runnable] = collections.deque()  # for the dispatcher thread
        self.idle = False  # whether that thread waits for inboxes
        self.is_yielded_to = True  # whether publishers that wake it let it run before they go on
        self.is_fast = False  # whether a thread that runs others, too, may run it
        self._on_behalf = on_behalf
        self._credit = 0  # for turns that were fast
        self._is_elsewhere = False  # whether such a thread runs it, for whose delegate a stop waits
        # held by the thread that runs delegates; an RLock, which knows by whom
        self._running = threading.RLock()
        self._runner: Optional[int] = None  # that thread, by its identifier
        self._start_thread, self._name = start_thread, name
        self._thread_claim = threading.Lock()  # taken for good by who starts the thread
        self._closed = self._finishing = False
        # Two bare locks serve as signals, for every other primitive costs several of them. Each is
        # held until it is released to say something: that the thread is to wake up, and that it has.
        self._wake_signal, self._awake_signal = allocate_lock(), allocate_lock()
        self._wake_signal.acquire()
        self._awake_signal.acquire()

    def run(self) -> None:
        """Run the delegates of the inline inboxes in this thread, unless another thread is running
        the node.

        It runs a message of each inbox that has some, and for a moment what comes meanwhile. The
        rest is left to the dispatcher thread: others that bring messages all the time would never
        let this thread go.
        """
        if self._runner is not None and self.is_run_here():
            return  # it looks again itself
        inline, running = self.inline, self._running
        owed = len(inline)  # runs that are due in any case: those of the inboxes that wait now
        deadline = 0.0  # of what comes meanwhile; 0.0 until all that was owed has run
        try:
            while inline and running.acquire(False):
                self._runner = get_ident()
                try:
                    while inline:
                        if self._closed:
                            return
                        if owed <= 0:
                            now = time.perf_counter()
                            deadline = deadline or now + COURTESY
                            if now > deadline:
                                break
                        owed -= 1
                        inline[0].run_next()
                        inline.popleft()  # not before: a handler of signals may raise at any call
                except IndexError:
                    pass  # close() cleared it
                finally:
                    self._runner = None
                    running.release()
                # looked at again: what was scheduled just before the release found the node busy
                if deadline and inline:
                    self._leave_to_thread()
                    return
        except BaseException:
            self._let_go()
            raise

    def _let_go(self) -> None:
        """Release the lock, where this thread holds it: a handler of signals may have raised what
        ends the taking of it when it was taken already."""
        if self.is_run_here():
            self._runner = None
        _release(self._running)

    def _leave_to_thread(self) -> None:
        """Have the dispatcher thread run the inline inboxes that have messages."""
        if self._closed:
            return
        self.need_thread()
        try:
            while self.inline and self._running.acquire(False):  # else who runs them looks again
                while self.inline:
                    self.scheduled.append(self.inline[0])
                    self.inline.popleft()
                self._running.release()
        except BaseException as error:
            self._let_go()
            if not isinstance(error, IndexError):  # close() cleared it
                raise
        if self.idle:
            self.wake()

    def is_run_here(self) -> bool:
        """Whether it is this thread that runs delegates just now."""
        return self._runner == get_ident()

    def wait_for_delegate(self, timeout: float) -> None:
        """Wait until the delegate that another thread runs just now has ended, for up to
        ``timeout`` seconds."""
        if self.is_run_here():
            return
        try:
            is_free = self._running.acquire(True, timeout)
            if is_free:
                self._running.release()
        except BaseException:
            self._let_go()
            raise
        if is_free and self.inline:  # scheduled meanwhile by a thread that found the node busy
            self._leave_to_thread()

    def run_in_turn(self, job: Callable[[], Any]) -> bool:
        """Run ``job()`` in this thread when no delegate runs; at once in one that it runs.

        :returns: False where it was closed before
        :raises PharosError: if a delegate that runs waits, perhaps by way of others, for one that
            this thread runs
        """
        if self.is_run_here():
            job()
            return True
        me = get_ident()
        try:
            try:
                while not self._running.acquire(True, CLOSED_INTERVAL):
                    if self._closed:
                        return False
                    with _looking:
                        _awaited[me] = self
                        self._check_not_for_each_other(me)
            finally:
                _awaited.pop(me, None)
            self._runner = me
            is_open = not self._closed
            if is_open:
                job()
            self._runner = None
            self._running.release()
        except BaseException:
            self._let_go()
            raise
        if self.inline:  # as in wait_for_delegate
            self._leave_to_thread()
        return is_open

    def _check_not_for_each_other(self, me: int) -> None:
        dispatcher: Optional[Dispatcher] = self
        for _ in range(len(_awaited)):
            runner = dispatcher and dispatcher._runner
            if runner == me:
                del _awaited[me]
                raise PharosError(
                    'delegates of several nodes wait for one another to end, each to have a block'
                    ' of the other\'s node run again, or that node become another: do so in a'
                    ' soul, or fork() it'
                )
            dispatcher = _awaited.get(runner or 0)

    def need_thread(self) -> None:
        """Have the dispatcher thread, from the first channel on that is not inline."""
        if self._thread_claim.acquire(blocking=False):
            try:
                self._start_thread(self._run_thread, name=self._name)
            except BaseException:  # the next one may have it
                self._thread_claim.release()
                raise

    def schedule(self, inbox: Runnable) -> None:
        """Have the dispatcher thread run an inbox."""
        self.scheduled.append(inbox)
        if self.idle:
            self.wake()

    def wake(self) -> None:
        """Wake the dispatcher thread, which is idle."""
        self.idle = False
        try:
            self._awake_signal.acquire(False)  # takes back what was said of an earlier waking
        finally:  # a handler of signals may raise, also at the call of a function of ours
            try:
                self._wake_signal.release()
            except RuntimeError:
                pass  # it was free already: two had the same to say

    def yield_gil(self) -> None:
        """Let the woken dispatcher thread have the interpreter: it would get it 5 ms later from a
        busy publisher.

        Until a fast delegate has run: the publisher would not get the interpreter back before, and
        waking it, too, takes as long as such a delegate does.
        """
        if not self._awake_signal.acquire(True, YIELD_LIMIT):
            self._note_turn(FAST_TURN)  # too long, whatever the turn takes by itself

    def run_next(self) -> bool:
        """Run what is scheduled, in the thread of another dispatcher; raises nothing."""
        begun = time.perf_counter()
        try:
            assert self._on_behalf
            self._on_behalf(self._run_scheduled, self._name)
        finally:
            self._note_turn(time.perf_counter() - begun)
            self.idle = True
            # what came meanwhile, also for a thread that found the node busy
            if self.scheduled or self.inline:
                self._leave_to_thread()
        return True

    def _run_scheduled(self) -> None:
        """Run a message of each inbox that is scheduled, unless another thread is running the
        node."""
        if not self._running.acquire(False):
            return
        self._runner, self._is_elsewhere = get_ident(), True
        try:
            for _ in range(len(self.scheduled)):
                if self._closed:
                    return
                self.scheduled.popleft().run_next()
        except IndexError:
            pass  # close() cleared it, or the node's own thread takes them
        finally:
            self._runner, self._is_elsewhere = None, False
            self._running.release()

    def _run_thread(self) -> None:
        self._loop()
        if self._is_elsewhere:
            with self._running:
                pass  # who waits for this thread waits for the delegate

    def _loop(self) -> None:
        scheduled, inline = self.scheduled, self.inline
        acquire, release = self._running.acquire, self._running.release  # ``with`` costs more
        me = get_ident()
        begun: Optional[float] = None  # when the turn began, where its length matters
        is_awaited = False  # whether a publisher may wait for the first delegate
        while True:
            try:
                inbox = scheduled.popleft()
            except IndexError:
                if is_awaited:
                    is_awaited = False
                    _release(self._awake_signal)
                if self._closed or self._finishing:
                    return
                if begun is not None:
                    self._note_turn(time.perf_counter() - begun)
                self.idle = True
                if not (scheduled or self._closed or self._finishing):
                    self._wake_signal.acquire()
                    is_awaited = self.is_fast
                    if not is_awaited:
                        _release(self._awake_signal)
                self.idle = False
                begun = None if self.is_fast or not self._on_behalf else time.perf_counter()
                continue
            acquire()
            self._runner = me
            try:
                if self._closed:  # while this thread waited for the delegate of another one
                    return
                inbox.run_next()
            finally:
                self._runner = None
                release()
            if is_awaited:
                is_awaited = False
                _release(self._awake_signal)
            if inline:
                self.run()

    def _note_turn(self, seconds: float) -> None:
        if seconds < FAST_TURN:
            self._credit = min(self._credit + 1, MAX_CREDIT)
        else:
            self._credit = max(self._credit - SLOW_COST, 0)
        self.is_fast = self._credit >= FAST_CREDIT
        if self._closed:  # perhaps since just now
            self.is_fast = False

    def finish(self) -> None:
        """End the thread when all that is scheduled has run."""
        self._finishing = True
        self.wake()

    def close(self) -> None:
        """Forget what has not run, and end the thread; a delegate that runs goes on to its end."""
        self._closed, self.is_fast = True, False
        if self.is_run_here():
            self._is_elsewhere = False  # its delegate ends the node, and nobody waits for that one
        self.inline.clear()
        self.scheduled.clear()
        self.wake()


def _forget() -> None:
    """In a process that was forked, when another thread may have held the lock."""
    global _looking
    _looking = threading.Lock()
    _awaited.clear()


os.register_at_fork(after_in_child=_forget)


def _release(lock: Any) -> None:
    try:
        lock.release()
    except RuntimeError:
        pass  # it is free already, for two had the same to say, or another thread's
