"""Run the callbacks of all nodes in a pool of threads, each node's one at a time.

A publisher puts a message into the Inbox of each receiver, and wakes a worker. A worker takes the
next callback queue that has a job. The worker wakes another one for the rest, unless the callbacks
of that queue were fast. There are at most as many workers as nodes: a callback that blocks holds up
its own node alone. Workers end with the last node. A publisher's thread runs inline inboxes. A
subscription of plain rospy has a thread of its own, as with rospy.
"""
import collections
import threading
from contextlib import suppress
from _thread import allocate_lock, get_ident
from time import perf_counter, sleep, thread_time

from pharos.intraprocess.copier import size_of

BURST = 100e-6  # seconds; a publisher that woke a thread less than this ago does not wait for one
YIELD_LIMIT = 1e-3  # seconds that a publisher waits at most until the receiver's thread runs
YIELD_PAUSE = 0.02  # seconds without such a wait after one that reached its limit
FAST = 50e-6  # seconds; a callback that takes less may run in the thread that reads the socket
FAST_RUNS = 10  # fast callbacks in a row, until the thread that reads runs the next one
SHORT_RUN = 1e-3  # seconds
SENTRY_PERIOD = 4e-3  # seconds that a callback may hold up those of other nodes
SENTRY_REST = 1.0  # seconds without an alert until the sentry rests
#: seconds until rospy's first callback: a connection between processes takes so long
FIRST_PAUSE = 0.05

INFINITE = float('inf')

_ready_queues = collections.deque()
_idle_workers = []
_workers = set()
_pooled_queues = set()
_pool_lock = allocate_lock()  # of _workers, _pooled_queues, and attributes of queues
_no_yield_before = 0.0
_sentry = None


class CallbackQueue:
    """Runs callbacks one at a time: those of a node, or of one subscription of plain rospy.

    ``jobs`` has an Inbox once for each of its messages, or more often if some were dropped. Each
    message waits in its Inbox as ``(value, thaw, header)``. The value is a frozen message. If
    ``thaw`` is None, the value is the message itself, which came from a socket or is shared.

    :ivar is_pooled: True if workers run the jobs, False if a thread of the queue's own does
    :ivar is_scheduled: True from schedule() until a thread takes the queue
    :ivar is_fast: True if the last callbacks were fast
    :ivar is_held: True between hold() and release()
    """

    is_pooled = True
    is_scheduled = False
    is_fast = False
    is_held = False
    closed = False
    cpu_seconds = 0.0  # that its jobs took in threads of the pool, or in its own
    own_thread = None
    running_thread = None  # the identifier of the thread that runs or holds the queue

    def __init__(self):
        self.jobs = collections.deque()
        self._jobs_lock = allocate_lock()
        self._join_pool()

    def _join_pool(self):
        with _pool_lock:
            _pooled_queues.add(self)

    def hold(self):
        """Run nothing until release(), except blocks that this thread passes to call()."""
        self._jobs_lock.acquire()
        self.running_thread = get_ident()
        self.is_held = True

    def release(self):
        """End a hold, if there is one; any thread may do so."""
        with _pool_lock:
            was_held = self.is_held
            self.is_held = False
        if was_held:
            self.running_thread = None
            self._jobs_lock.release()
            self.request_thread()

    def release_before_sleep(self):
        """End a hold by this thread, which would sleep while delegates wait."""
        if self.running_thread == get_ident():
            self.release()

    def run_jobs(self):
        """Run all jobs in this thread, unless another thread does so already."""
        jobs = self.jobs
        while jobs and not self.closed and self._jobs_lock.acquire(False):
            self.running_thread = get_ident()
            try:
                while jobs and not self.closed:
                    inbox = jobs.popleft()
                    try:
                        value, thaw, header = inbox.queue.popleft()
                    except IndexError:  # several messages were dropped at once
                        continue
                    inbox.taken_count += 1
                    if thaw is not None:
                        message = thaw(value)
                        message._connection_header = header
                        inbox.callback(message)
                    elif inbox.inline:
                        inbox.callback(value)
                    else:  # receive() runs fast callbacks in the thread that reads a socket
                        start_time = perf_counter()
                        inbox.callback(value)
                        is_fast = perf_counter() - start_time < FAST
                        inbox.fast_runs = inbox.fast_runs + 1 if is_fast else 0
            finally:
                self.running_thread = None
                self._jobs_lock.release()
        if self.closed:  # close() may have given up waiting for a callback of this thread
            self._leave_pool()

    def is_current(self):
        """True if this thread runs one of the callbacks."""
        return self.running_thread == get_ident()

    def call(self, block):
        """Run ``block()`` in this thread, while no callback runs, unless the queue is closed.

        If this thread runs a callback of the queue, run the block at once.
        """
        if self.is_current():
            block()
            return
        with self._jobs_lock:
            self.running_thread = get_ident()
            try:
                if not self.closed:
                    block()
            finally:
                self.running_thread = None
        if self.closed:  # as in run_jobs()
            self._leave_pool()
        else:
            self.request_thread()

    def schedule(self):
        """Put the queue into the pool's list, if it has jobs and is not there.

        :returns: True if the caller must wake a worker
        """
        if self.is_scheduled or not self.jobs:
            return False
        self.is_scheduled = True
        _ready_queues.append(self)
        return True

    def request_thread(self):
        """Wake a thread to run the jobs."""
        if self.schedule():
            _wake_worker()

    def close(self, timeout):
        """Drop all jobs, and wait for the callback that runs.

        :param timeout: seconds
        :returns: True if that callback has ended, or runs in this thread
        """
        self.closed = True
        self.release()
        has_ended = self.running_thread == get_ident()
        if not has_ended and self._jobs_lock.acquire(True, timeout):
            self._jobs_lock.release()  # call() may wait for the lock
            has_ended = True
        self.jobs.clear()
        if has_ended:  # else the queue still counts: another worker may replace the blocked one
            self._leave_pool()
        return has_ended

    def _leave_pool(self):
        with _pool_lock:
            _pooled_queues.discard(self)
        if not _pooled_queues:
            _end_pool()


class ThreadedCallbackQueue(CallbackQueue):
    """Runs the callbacks of one subscription of plain rospy in one thread of its own.

    The thread ends with the subscription. Objects bound to their thread (a connection of SQLite, a
    context of CUDA) keep working. The first callback runs FIRST_PAUSE after the subscription: many
    constructors subscribe before they have set all that their callback uses.
    """

    is_pooled = False

    def __init__(self):
        super().__init__()
        self._first_run_time = perf_counter() + FIRST_PAUSE

    def _join_pool(self):
        """Stay out of the pool."""

    def schedule(self):
        """Wake the queue's own thread; return False, since no worker is needed."""
        if not self.is_scheduled and self.jobs:
            self.is_scheduled = True
            if self.own_thread:
                self.own_thread.wake()
            else:
                self._start_thread()
        return False

    def _start_thread(self):
        with _pool_lock:  # two publishers may be here
            if not self.own_thread:
                self.own_thread = _RestingThread(self._loop, 'pharos callbacks')
                self.own_thread.start()

    def call(self, block):
        """Run ``block()`` as CallbackQueue.call() does; wait until FIRST_PAUSE is over."""
        self._wait_for_first_run()
        super().call(block)

    def _wait_for_first_run(self):
        sleep(max(0.0, self._first_run_time - perf_counter()))

    def _loop(self):
        self._wait_for_first_run()
        while not self.closed:
            self.is_scheduled = False
            self.run_jobs()
            self.cpu_seconds = thread_time()
            self.own_thread.rest()

    def _leave_pool(self):
        """Let the queue's own thread end."""
        if self.own_thread:
            self.own_thread.wake()


class _RestingThread:
    """A thread that rests until another thread wakes this one."""

    def __init__(self, loop, name):
        self._rest_lock = allocate_lock()  # released to wake the thread
        # held from the wake until the thread runs, and then by a publisher that waited for that
        self._start_lock = allocate_lock()
        self._rest_lock.acquire()
        self.start = threading.Thread(target=loop, name=name, daemon=True).start

    def wake(self):
        """End the thread's rest; if the thread does not rest, its next rest ends at once."""
        self._start_lock.acquire(False)
        try:
            self._rest_lock.release()
        except RuntimeError:  # another thread has woken this one already
            pass

    def rest(self):
        """Wait until another thread calls wake(); called by this thread alone."""
        self._rest_lock.acquire()
        if self._start_lock.locked():
            self._start_lock.release()

    def wait_until_running(self, timeout):
        """Wait until the thread runs after a wake(); return True if the thread runs in time.

        This caller then holds the lock until the end of the thread's next rest().
        """
        return self._start_lock.acquire(True, timeout)


class _Worker(_RestingThread):
    """A thread of the pool; runs callback queues that are ready until the last node has ended."""

    def __init__(self):
        super().__init__(self._loop, 'pharos worker')
        self._last_cpu = 0.0  # of this thread, when it was read
        self._short_seconds = 0.0  # of short runs since then

    def _count_cpu(self, callback_queue, duration):
        """Add the CPU time of a run to the queue's.

        A short run is taken for busy all the time: to read the clock takes as long as a delegate.
        """
        if duration < SHORT_RUN:
            self._short_seconds += duration
            callback_queue.cpu_seconds += duration
            return
        cpu = thread_time()
        callback_queue.cpu_seconds += max(0.0, cpu - self._last_cpu - self._short_seconds)
        self._last_cpu = cpu
        self._short_seconds = 0.0

    def _loop(self):
        while True:
            try:
                callback_queue = _ready_queues.popleft()
            except IndexError:
                with _pool_lock:
                    if not _pooled_queues:
                        _workers.discard(self)
                        break
                _idle_workers.append(self)
                if _ready_queues or not _pooled_queues:
                    _wake_worker()  # a thread that scheduled before the append() saw no idle worker
                self.rest()
                continue
            if _ready_queues:
                if callback_queue.is_fast:
                    _alert_sentry()
                else:
                    _wake_worker()
            callback_queue.is_scheduled = False
            job_count = len(callback_queue.jobs)
            start_time = perf_counter()
            callback_queue.run_jobs()
            duration = perf_counter() - start_time
            callback_queue.is_fast = duration < FAST * job_count
            self._count_cpu(callback_queue, duration)
        _wake_worker()  # each worker that ends has the next one end


def _wake_worker():
    """Wake an idle worker, and return the worker.

    If all workers are busy and fewer than the pooled queues, start one. Return None then: a
    publisher does not wait for a worker that starts.
    """
    try:
        worker = _idle_workers.pop()
    except IndexError:
        with _pool_lock:
            if len(_workers) < len(_pooled_queues):
                worker = _Worker()
                _workers.add(worker)
                worker.start()
        return None
    worker.wake()
    return worker


class _Sentry(_RestingThread):
    """Wakes a worker for the queues behind a callback that was fast so far, and now blocks.

    A worker alerts the sentry if it leaves ready queues for after a fast one. From then on the
    sentry looks every SENTRY_PERIOD, and rests after SENTRY_REST without an alert.
    """

    is_needed = False
    is_looking = False

    def __init__(self):
        super().__init__(self._loop, 'pharos sentry')

    def _loop(self):
        global _sentry
        while _pooled_queues and _sentry is self:
            self.is_looking = True
            last_need = perf_counter()
            while _pooled_queues and perf_counter() - last_need < SENTRY_REST:
                sleep(SENTRY_PERIOD)
                if self.is_needed:
                    self.is_needed = False
                    last_need = perf_counter()
                if _ready_queues:
                    _wake_worker()
            self.is_looking = False
            if _pooled_queues and not self.is_needed:
                self.rest()
        if _sentry is self:
            _sentry = None


def _alert_sentry():
    """Have the sentry look after the ready queues that a worker leaves for later."""
    global _sentry
    sentry = _sentry
    if sentry is None:
        sentry = _Sentry()
        _sentry = sentry  # before the start: the loop compares itself with _sentry
        sentry.start()
    sentry.is_needed = True
    if not sentry.is_looking:
        sentry.wake()


class Inbox:
    """The messages that wait for one callback; a full one drops the oldest.

    :param callback_queue: the CallbackQueue that runs the callback
    :param callback: called as ``callback(message)``; raises nothing
    :param queue_size: number of messages; None or 0: as many as ``queue_bytes`` hold
    :param inline: True: the thread of the publisher runs the callback
    :param shared: True: the callback gets the published object, not a copy
    :ivar dropped: the number of dropped messages
    :ivar taken_count: the number of messages taken for the callback
    """

    queue_bytes = 64 << 20
    dropped = 0
    taken_count = 0
    fast_runs = 0  # in a row
    _count_at_yield = -1

    def __init__(self, callback_queue, callback, queue_size=None, inline=False, shared=False):
        self.callback_queue = callback_queue
        self.callback = callback
        self.inline = inline
        self.shared = shared
        self.queue = collections.deque()
        self.queue_size = queue_size or INFINITE
        self.capacity = self.queue_size

    def put(self, item, size=0):
        """Add a message; the caller then wakes or runs the callback queue.

        :param item: ``(value, thaw, header)``; a publisher has one tuple for all receivers, since
            many tuples make the collector of garbage run often
        :param size: the bytes of the value; 0: unknown
        """
        queue = self.queue
        count = len(queue)
        if not count:
            queue.append(item)
            self.callback_queue.jobs.append(self)
            return
        is_power_of_two = not count & (count - 1)
        if count >= self.capacity or is_power_of_two:  # not each time: the estimate takes long
            self.capacity = min(self.queue_size, self.capacity_for(size or size_of(item[0])))
            if count >= self.capacity and self.taken_count != self._count_at_yield:
                # sleep, or a publisher that never sleeps would starve the receiver; not again until
                # the receiver has taken a message: it may be blocked
                self._count_at_yield = self.taken_count
                sleep(1e-6)
        # append, then drop: a receiver that runs meanwhile must not find the queue empty
        queue.append(item)
        is_full = False
        while len(queue) > self.capacity:
            with suppress(IndexError):  # the receiver has taken all meanwhile
                queue.popleft()
                self.dropped += 1
            is_full = True
        if not is_full:  # else the job of the dropped message is left for this one
            self.callback_queue.jobs.append(self)

    def capacity_for(self, size):
        """Return how many messages of ``size`` bytes may wait."""
        return max(1, self.queue_bytes // size)

    def receive(self, message, size):
        """Take a message from a socket; the thread that reads the socket calls this.

        If the callback was fast ten times in a row, this thread runs the next one, too: to wake
        another thread takes longer. This thread also runs callbacks of plain rospy without a
        queue_size, as in rospy. Meanwhile messages wait in the sockets and in the publisher.

        :param size: the bytes of the message; 0: unknown
        """
        callback_queue = self.callback_queue
        if not callback_queue.is_pooled and self.queue_size == INFINITE:
            callback_queue.call(lambda: self.callback(message))
            return
        self.put((message, None, None), size)
        if self.inline or callback_queue.is_pooled and self.fast_runs >= FAST_RUNS:
            callback_queue.run_jobs()
        else:
            callback_queue.request_thread()


def hand_over(callback_queues, last_wake, may_wait):
    """Wake threads to run the jobs of some callback queues; a publisher calls this.

    :param last_wake: the last time that the same publisher woke a thread, as of perf_counter()
    :param may_wait: True: wait up to YIELD_LIMIT until the thread runs
    :returns: the time now if a thread was woken, else ``last_wake``
    """
    global _no_yield_before
    is_worker_needed = False
    thread = None
    # schedule() wakes own threads; ``thread`` is the one to wait for, and any will do
    for callback_queue in callback_queues:
        if not callback_queue.is_scheduled:
            is_worker_needed |= callback_queue.schedule()
            thread = callback_queue.own_thread
    if is_worker_needed:
        thread = _wake_worker()  # this worker wakes another one if there are more queues
    if not thread:
        return last_wake
    now = perf_counter()
    # a busy publisher keeps the interpreter for 5 ms, unless it waits for the thread to run
    if may_wait and now - last_wake > BURST and now > _no_yield_before:
        is_running = thread.wait_until_running(YIELD_LIMIT)
        if not is_running:
            _no_yield_before = now + YIELD_PAUSE
    return now


def _end_pool():
    global _sentry
    _wake_worker()
    if _sentry:
        _sentry.wake()
        _sentry = None


def reset_after_fork():
    """Forget all workers in a forked child: their threads run in the parent alone."""
    global _sentry
    for collection in _ready_queues, _idle_workers, _workers, _pooled_queues:
        collection.clear()
    _sentry = None
