"""Run the callbacks of a node in its own threads, in the order in which their messages came.

A callback queue has one thread. A node has one queue for its delegates, and one for each subscription
of plain rospy. The thread begins a callback when those on earlier messages of the node have ended, or
have run for SLOW; :meth:`CallbackQueue.delays` and TURN_LIMIT have more. Four other threads run
callbacks: a publisher runs the queue of an inline channel, a thread that reads a TCPROS connection
of one node runs those of plain rospy without a queue_size, one that subscribes runs a new callback of plain rospy
on the latched message of another process, and the caller of Failure.retry() runs one.
"""
from __future__ import annotations

import collections
import contextlib
import itertools
import threading
import time
from threading import get_ident
from typing import Any, Callable

BURST = 100e-6  # seconds; a publisher that woke a thread less than this ago does not wait for one
YIELD_LIMIT = 1e-3  # seconds that a publisher waits at most until the receiver's thread runs
SLOW = 3e-3  # seconds; the callbacks on later messages do not wait longer for one that runs
TURN_PERIOD = 1e-3  # seconds between two looks whether it is a queue's turn
TURN_LIMIT = 0.05  # seconds that a callback waits at most, also for those that have not begun


class CallbackOrder:
    """The order of the callbacks of one node.

    Each message gets a number when it reaches the node. A queue has its turn if no other one delays
    it: by a callback that runs, or if it runs none, by a message with a lower number that waits.

    :param start_thread: ``start_thread(target)`` returns a thread of the node, None if the system
        has no more threads
    :ivar numbers: the numbers of the messages to come
    :ivar queues: a dict with the callback queues that have an inbox as its keys
    """

    def __init__(self, start_thread: Callable) -> None:
        self.start_thread = start_thread
        self.numbers = itertools.count()
        self.queues = {}

    def has_turn(self, callback_queue: CallbackQueue, number: float) -> bool:
        """True if the queue does not pause, and no callback on an earlier message delays its next one."""
        now = time.perf_counter()
        if now < callback_queue.pause_end:
            return False
        for queue in list(self.queues):
            if queue is not callback_queue and queue.delays(number, now):
                return False
        return True

    def pass_turn(self) -> None:
        """Wake the thread that waits for its turn with the lowest number."""
        waiting_queues = [
            queue for queue in list(self.queues) if queue.running_thread and not queue.begin_time
        ]
        if waiting_queues:
            min(waiting_queues, key=CallbackQueue.next_number).wake()


class CallbackQueue:
    """Runs callbacks one at a time: a node's delegates, or those of a subscription of plain rospy.

    The thread starts with the first message that no publisher runs inline, and ends with the queue.
    Objects bound to their thread (a connection of SQLite, a context of CUDA) keep working, unless a
    channel of the node is inline.

    :param order: the CallbackOrder of the node
    :param first_pause: seconds that the queue pauses at first. A queue that is made meanwhile prolongs
        the pause to the end of its own: a constructor may subscribe to several topics before it has
        set all that its callbacks use
    :ivar jobs: the messages of all inboxes, as Inbox says
    :ivar pause_end: the time when the pause ends, as of perf_counter(); 0 after the pause. No callback
        begins before it, unless release() ends the pause
    :ivar running_thread: the identifier of the thread that runs callbacks, or waits for their turn; or None
    :ivar thread: the thread of the queue; False before the first message, None if the system had no
        thread left, or the thread has ended by an exception
    :ivar begin_time: the time when the callback that runs began, as of perf_counter(), or None
    """

    closed = False
    running_thread = None
    begin_time: float | None = None
    # True if the last callback took longer than SLOW; stays as it was while the node has one queue
    _was_slow = False
    thread: Any = False

    def __init__(self, order: CallbackOrder, first_pause: float = 0.0) -> None:
        self.order = order
        self.jobs = collections.deque()
        self._maker = get_ident()  # the thread that has made the queue
        self.pause_end = 0.0
        if first_pause:
            self.pause(first_pause)
            now = time.perf_counter()
            for queue in list(order.queues):
                if now < queue.pause_end < self.pause_end:
                    queue.pause_end = self.pause_end
        # The next two locks guard nothing. They are signals, which any thread may give: the handler of
        # a signal may raise between any two lines of a publisher, and the next message gives them again.
        # Locked: the thread may sleep. Unlocked: it has to look for jobs before it sleeps, and that
        # look locks it. Who runs the queue takes it: in the thread's rest, in the pause, and in a wait for
        # the turn.
        self._wake_lock = threading.Lock()
        self._wake_lock.acquire()
        # Locked: a publisher has woken the thread, which has not begun to look, or has waited for that.
        # The thread unlocks it before it looks: so a publisher waits for the thread by taking it.
        self.request_lock = threading.Lock()
        # These two guard, as locks do.
        self._loop_lock = threading.Lock()  # held by the thread: there is but one
        self._running_lock = threading.Lock()  # held by the thread that runs callbacks

    def pause(self, seconds: float) -> None:
        """Begin no callback for so many seconds, unless release() ends the pause before."""
        self.pause_end = time.perf_counter() + seconds

    def release(self) -> None:
        """End the pause; any thread may do so."""
        self.pause_end = 0.0
        self.request_thread()

    def release_before_sleep(self) -> None:
        """End the pause if this thread has made the queue: it would sleep while delegates wait."""
        if self.pause_end and self._maker == get_ident():
            self.release()

    def is_current(self) -> bool:
        """True if this thread runs one of the callbacks."""
        return self.running_thread == get_ident()

    # -- the order

    def next_number(self) -> float:
        """Return the number of the next message; infinity if there is none."""
        try:
            return self.jobs[0][0]
        except IndexError:  # another thread has taken the message
            return float('inf')

    def delays(self, number: float, now: float) -> bool:
        """True if a callback on the message of that number must wait for one of this queue."""
        # first: who takes the message has set begin_time before
        waiting_number = self.next_number()
        begin_time = self.begin_time
        if begin_time:
            # one that was slow the last time delays nobody while it runs
            return not (self._was_slow or now - begin_time > SLOW)
        if now < self.pause_end:
            return False
        return waiting_number < number

    def _wait_for_turn(self) -> None:
        """Wait until callbacks on earlier messages have ended, or have run for SLOW."""
        deadline = time.perf_counter() + TURN_LIMIT
        while not self.order.has_turn(self, self.next_number()) and not self.closed:
            if time.perf_counter() > deadline:
                break
            self._wake_lock.acquire(True, TURN_PERIOD)

    # -- running

    def run_jobs(self, in_turn: bool = True) -> None:
        """Run all jobs in this thread, unless another thread does so already, or the queue pauses.

        Of two threads that come at one moment, one waits, and runs what the other has left.

        :param in_turn: False: begin at once, whatever other queues of the node do
        """
        jobs = self.jobs
        order = self.order
        if self.pause_end:
            self.request_thread()
            return
        # the outer loop: a publisher that adds a job after the inner one, before the release, finds the
        # lock taken, and leaves the job to this thread
        while jobs and not self.closed and not self._running_lock.locked():
            with self._running_lock:  # in C: the handler of a signal cannot raise in between
                self.running_thread = get_ident()
                try:
                    while jobs and not self.closed:
                        if len(order.queues) > 1:
                            self._run_in_order(in_turn)
                        else:
                            self._run_next()
                finally:
                    self.running_thread = None
                    self.begin_time = None

    def _run_next(self) -> None:
        try:
            job = self.jobs.popleft()
        except IndexError:  # a publisher has dropped the last one
            return
        self.begin_time = time.perf_counter()
        job[1].run_callback(job)
        self.begin_time = None

    def _run_in_order(self, in_turn: bool) -> None:
        """Run the next job in the queue's turn, and say so to the other queues of the node."""
        if in_turn:
            self._wait_for_turn()
        begin_time = self.begin_time = time.perf_counter()
        if self._was_slow:  # the next callbacks need not wait for this one
            self.order.pass_turn()
        try:
            if not self.closed:  # else a stop has begun
                self._run_next()
        finally:
            self._was_slow = time.perf_counter() - begin_time > SLOW
            self.order.pass_turn()

    def run_jobs_here(self) -> None:
        """Run all jobs in this thread; wait while another thread runs some of them."""
        self._wait_for_pause_end()
        while self.jobs and not self.closed:
            self.run_jobs()
            with self._running_lock:
                pass
        if self.closed:  # a wait here may have taken the wake of the queue's own thread
            self.wake()

    def run_exclusively(self, block: Any) -> None:
        """Run ``block()`` in this thread, while no callback runs, unless the queue is closed.

        If this thread runs a callback of the queue, run the block at once.
        """
        if self.is_current():
            block()
            return
        with self._running_lock:
            self.running_thread = get_ident()
            try:
                if not self.closed:
                    block()
            finally:
                self.running_thread = None
        self.request_thread()

    # -- the thread

    def request_thread(self) -> bool:
        """Have the thread run the jobs; return True if it has slept, and this has woken it."""
        if self.closed or not self.jobs:
            return False
        if not self.thread:
            # if no thread is left, the next message or the watcher tries again. Set here, too: the thread
            # may begin late, and a second one would be started
            self.thread = self.order.start_thread(self._loop)
        elif self._wake_lock.locked():
            self.request_lock.acquire(False)
            self.wake()
            return not self.running_thread
        return False

    def wake(self) -> None:
        """End the thread's rest or wait; if there is none, the next one ends at once."""
        with contextlib.suppress(RuntimeError):  # another thread has woken this one already
            self._wake_lock.release()

    def _wait_for_pause_end(self) -> None:
        """Wait until the pause is over; release() and stop() wake this."""
        while self.pause_end and not self.closed:
            pause = self.pause_end - time.perf_counter()
            if pause > 0:
                self._wake_lock.acquire(True, pause)
            else:
                self.pause_end = 0.0

    def _loop(self) -> None:
        if not self._loop_lock.acquire(False):  # two publishers have started a thread
            return
        self.thread = threading.current_thread()
        try:
            while not self.closed:
                self._wait_for_pause_end()
                with contextlib.suppress(RuntimeError):  # nobody has locked it
                    self.request_lock.release()
                self.run_jobs()
                if not self.closed:
                    self._wake_lock.acquire()
        finally:
            if not self.closed:  # after an exception the next message starts another thread
                self.thread = None
            self._loop_lock.release()

    def stop(self) -> None:
        """Begin no more callbacks."""
        self.closed = True
        self.order.queues.pop(self, None)
        self.wake()

    def close(self, timeout: float) -> bool:
        """Begin no more callbacks, and wait for the callback that runs; drop all jobs if it has ended.

        :param timeout: seconds
        :returns: True if that callback has ended, or runs in this thread
        """
        self.stop()
        if self.is_current():
            return True
        has_ended = self._running_lock.acquire(True, timeout)
        if has_ended:
            self._running_lock.release()  # run_exclusively() may wait for the lock
            self.jobs.clear()
        return has_ended


def hand_over(callback_queues: list[CallbackQueue], last_wake: float, may_wait: bool) -> float:
    """Wake the threads of some callback queues; a publisher calls this.

    :param last_wake: what the last call for the same publisher has returned
    :param may_wait: True: then wait until each thread that has slept runs, up to YIELD_LIMIT; after one
        that takes so long wait for no other
    :returns: the time of the last wake, as of perf_counter()
    """
    now = time.perf_counter()
    woken_queues = [each for each in callback_queues if each.request_thread()]
    if not woken_queues:
        return last_wake
    # a busy publisher keeps the interpreter for 5 ms, unless it waits for the threads to run
    if may_wait and now - last_wake > BURST:
        for callback_queue in woken_queues:
            # _loop() frees the lock
            if not callback_queue.request_lock.acquire(True, YIELD_LIMIT):
                break
    return time.perf_counter()  # after the wait: to wait is no rest of the publisher
