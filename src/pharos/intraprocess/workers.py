"""Run the callbacks of all nodes in a pool of threads, those of one node one at a time.

A publisher puts a message into the Inbox of each receiver and wakes a worker. A worker takes the
next node that has something to run, and wakes another worker for the rest, unless the callbacks of
that node were fast. There are at most as many workers as nodes, so that a callback that blocks
holds up its own node alone. They end with the last node. Inline inboxes are run by the publisher's
thread. A subscription of plain rospy has a thread of its own, as with rospy.
"""
import collections
import threading
from _thread import allocate_lock, get_ident
from time import perf_counter, sleep

from pharos.intraprocess.copier import size_of

BURST = 100e-6  # seconds; a publisher that woke a worker less than this ago does not wait for it
YIELD_LIMIT = 1e-3  # seconds that a publisher waits at most until the receiver's thread runs
YIELD_PAUSE = 0.02  # seconds without such a wait after one that was in vain
FAST = 50e-6  # seconds; a callback that takes less may run in the thread that reads the socket
LATE = 4e-3  # seconds that a callback may hold up those of other nodes
SENTRY_REST = 1.0  # seconds without such callbacks until the sentry rests
#: seconds until rospy's first callback: a connection between processes takes so long
FIRST_PAUSE = 0.05

INFINITE = float('inf')

_ready = collections.deque()
_idle = []
_workers = set()
_turns = set()
_guard = allocate_lock()  # of _workers and _turns
_no_yield_before = 0.0
_sentry = None


class Turns:
    """Whatever takes turns: the callbacks of one node, or those of one subscription of plain rospy.

    ``jobs`` has an Inbox once for each of its messages, or more often if some were dropped.
    """

    is_pooled = True
    scheduled = is_fast = is_held = closed = False
    thread = None  # its own, if it has one
    runner = None  # the identifier of the thread that runs it

    def __init__(self):
        self.jobs = collections.deque()
        self._running = allocate_lock()
        self._enter()

    def _enter(self):
        with _guard:
            _turns.add(self)

    def hold(self):
        """Run nothing until release(), but what this thread itself calls."""
        self._running.acquire()
        self.runner = get_ident()
        self.is_held = True

    def release(self):
        """Run what waits; for any thread."""
        with _guard:
            was_held = self.is_held
            self.is_held = False
        if was_held:
            self.runner = None
            self._running.release()
            self.wake()

    def pause(self):
        """Release it if this is the thread that holds it, and is about to sleep."""
        if self.runner == get_ident():
            self.release()

    def run(self):
        """Run what waits. If another thread is in here, return: that one runs this, too."""
        jobs = self.jobs
        while jobs and not self.closed and self._running.acquire(False):
            self.runner = get_ident()
            try:
                while jobs and not self.closed:
                    inbox = jobs.popleft()
                    try:
                        value, thaw, header = inbox.queue.popleft()
                    except IndexError:  # several were dropped at once
                        continue
                    inbox.taken += 1
                    if thaw is not None:
                        value = thaw(value)
                        value._connection_header = header
                        inbox.callback(value)
                    elif inbox.inline:
                        inbox.callback(value)
                    else:
                        began = perf_counter()
                        inbox.callback(value)
                        is_fast = perf_counter() - began < FAST
                        inbox.fast_in_a_row = inbox.fast_in_a_row + 1 if is_fast else 0
            finally:
                self.runner = None
                self._running.release()
        if self.closed:  # meanwhile
            self.forget()

    def call(self, block):
        """Run ``block()`` as if it were a callback, unless this is closed."""
        if self.runner == get_ident():
            return block()
        with self._running:
            self.runner = get_ident()
            try:
                if not self.closed:
                    block()
            finally:
                self.runner = None
        if self.closed:  # meanwhile
            self.forget()
        else:
            self.wake()

    def schedule(self):
        """Have a worker take it; True if one of the pool is to be woken for that."""
        if self.scheduled or not self.jobs:
            return False
        self.scheduled = True
        _ready.append(self)
        return True

    def wake(self):
        """Have a worker run it."""
        if self.schedule():
            _wake_worker()

    def close(self, timeout):
        """Forget what has not run, and wait for the callback that runs; True if it ended in time."""
        self.closed = True
        self.release()
        ended = self.runner == get_ident()
        if not ended and self._running.acquire(True, timeout):
            self._running.release()  # call() may wait for it
            ended = True
        self.jobs.clear()
        if ended:  # else it still counts, so that its blocked worker is replaced
            self.forget()
        return ended

    def forget(self):
        with _guard:
            _turns.discard(self)
        if not _turns:
            _end_pool()


class OwnTurns(Turns):
    """The callbacks of one subscription of plain rospy. They run in one thread, which ends with them.

    What a callback has made in its thread (a base of SQLite, a context of CUDA) it finds again.
    The first one runs some time after the subscription: the constructor that has subscribed may not
    have made yet what its callback uses.
    """

    is_pooled = False

    def __init__(self):
        super().__init__()
        self._begin = perf_counter() + FIRST_PAUSE

    def _enter(self):
        """Stay out of the pool."""

    def schedule(self):
        """Wake its thread; the pool has nothing to do."""
        if not self.scheduled and self.jobs:
            self.scheduled = True
            if self.thread:
                self.thread.rouse()
            else:
                self._start_thread()
        return False

    def _start_thread(self):
        with _guard:  # two publishers may be here
            if not self.thread:
                self.thread = _Thread(self._loop, 'pharos callbacks')
                self.thread.start()

    def call(self, block):
        """Run ``block()`` as if it were a callback, not before the first one may run."""
        self._wait_for_begin()
        super().call(block)

    def _wait_for_begin(self):
        sleep(max(0.0, self._begin - perf_counter()))

    def _loop(self):
        self._wait_for_begin()
        while not self.closed:
            self.scheduled = False
            self.run()
            self.thread.rest()

    def forget(self):
        """Let its thread end."""
        if self.thread:
            self.thread.rouse()


class _Thread:
    """A thread that rests until it is roused."""

    def __init__(self, loop, name):
        # released to wake the thread; held from the wake until the thread runs
        self._resting, self.awake = allocate_lock(), allocate_lock()
        self._resting.acquire()
        self.start = threading.Thread(target=loop, name=name, daemon=True).start

    def rouse(self):
        """End its rest, or its next one."""
        self.awake.acquire(False)
        try:
            self._resting.release()
        except RuntimeError:  # it is roused already
            pass

    def rest(self):
        """Wait until it is roused."""
        self._resting.acquire()
        if self.awake.locked():
            self.awake.release()


class _Worker(_Thread):
    """A thread of the pool."""

    def __init__(self):
        super().__init__(self._loop, 'pharos worker')

    def _loop(self):
        while True:
            try:
                turns = _ready.popleft()
            except IndexError:
                with _guard:
                    if not _turns:
                        _workers.discard(self)
                        break
                _idle.append(self)
                if _ready or not _turns:  # since then; nobody may have seen this one
                    _wake_worker()
                self.rest()
                continue
            if _ready:
                if turns.is_fast:
                    _watch()
                else:
                    _wake_worker()
            turns.scheduled = False
            began, waiting = perf_counter(), len(turns.jobs)
            turns.run()
            turns.is_fast = perf_counter() - began < FAST * waiting
        _wake_worker()


def _wake_worker():
    """Wake an idle worker, or start one if there are fewer than nodes."""
    try:
        worker = _idle.pop()
    except IndexError:
        with _guard:
            if len(_workers) < len(_turns):
                worker = _Worker()
                _workers.add(worker)
                worker.start()
        return None
    worker.rouse()
    return worker


class _Sentry(_Thread):
    """Has another worker run what waits behind a callback that was fast so far, and now blocks.

    It looks as often as need be while such callbacks run, and rests else.
    """

    is_needed = is_looking = False

    def __init__(self):
        super().__init__(self._loop, 'pharos sentry')

    def _loop(self):
        global _sentry
        while _turns and _sentry is self:
            self.is_looking = True
            since = perf_counter()
            while _turns and perf_counter() - since < SENTRY_REST:
                sleep(LATE)
                if self.is_needed:
                    self.is_needed = False
                    since = perf_counter()
                if _ready:
                    _wake_worker()
            self.is_looking = False
            if _turns and not self.is_needed:
                self.rest()
        if _sentry is self:
            _sentry = None


def _watch():
    """Have the sentry look after what a worker has left for later."""
    global _sentry
    sentry = _sentry
    if sentry is None:
        sentry = _sentry = _Sentry()
        sentry.start()
    sentry.is_needed = True
    if not sentry.is_looking:
        sentry.rouse()


class Inbox:
    """The messages that wait for one callback; a full one drops the oldest.

    :param callback: called as ``callback(message)``; raises nothing
    :param queue_size: number of messages; None or 0: as many as ``queue_bytes`` hold
    """

    queue_bytes = 64 << 20
    dropped = taken = fast_in_a_row = 0
    _taken_at_yield = -1

    def __init__(self, turns, callback, queue_size=None, inline=False, shared=False):
        self.turns, self.callback, self.inline, self.shared = turns, callback, inline, shared
        self.queue = collections.deque()
        self.limit = self.queue_size = queue_size or INFINITE

    def put(self, item, size=0):
        """Add ``(value, thaw, header)``; ``turns`` are to be woken or run then.

        :param item: one for all receivers: many make the collector of garbage run often
        :param size: the bytes of the value, if they are known
        """
        queue = self.queue
        waiting = len(queue)
        if not waiting:
            queue.append(item)
            return self.turns.jobs.append(self)
        if waiting >= self.limit or not waiting & (waiting - 1):  # at 1, 2, 4 ...
            self.limit = min(self.queue_size, self.most(size or size_of(item[0])))
            if waiting >= self.limit and self.taken != self._taken_at_yield:
                self._taken_at_yield = self.taken  # the receiver got on since
                sleep(1e-6)  # a publisher that never sleeps would starve it
        queue.append(item)
        is_full = False
        while len(queue) > self.limit:  # after append(), or the receiver finds it empty
            queue.popleft()
            self.dropped += 1
            is_full = True
        if not is_full:  # the receiver may have taken one meanwhile
            self.turns.jobs.append(self)

    def most(self, size):
        """Return how many messages of a size may wait."""
        return max(1, self.queue_bytes // size)

    def receive(self, message, size):
        """Take a message from the thread that reads a socket.

        That thread runs the callback, too, if it was fast ten times running: waking another takes
        longer. It runs one of plain rospy without a queue_size, as rospy has it: meanwhile messages
        wait in the sockets, and in the publisher, and none is lost.
        """
        if not self.turns.is_pooled and self.queue_size == INFINITE:
            return self.turns.call(lambda: self.callback(message))
        self.put((message, None, None), size)
        if self.inline or self.turns.is_pooled and self.fast_in_a_row >= 10:
            self.turns.run()
        else:
            self.turns.wake()


def hand_over(filled, last):
    """Have workers run what waits in some Turns.

    :param last: when the same publisher last did so
    :returns: the time, if a worker was woken, else ``last``
    """
    global _no_yield_before
    is_due = False
    woken = None
    for turns in filled:
        if not turns.scheduled:
            is_due |= turns.schedule()
            woken = turns.thread
    if is_due:
        woken = _wake_worker()  # which wakes another one, if there is more
    if not woken:
        return last
    now = perf_counter()
    # let the worker have the interpreter, which takes 5 ms if this thread keeps busy
    if now - last > BURST and now > _no_yield_before and not woken.awake.acquire(True, YIELD_LIMIT):
        _no_yield_before = now + YIELD_PAUSE
    return now


def _end_pool():
    global _sentry
    _wake_worker()
    if _sentry:
        _sentry.rouse()
        _sentry = None


def forget():
    """Have no workers in a forked child."""
    global _sentry
    for known in _ready, _idle, _workers, _turns:
        known.clear()
    _sentry = None
