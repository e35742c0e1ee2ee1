"""Runs the delegates of one node, one at a time, and hands messages to it quickly.

A node's delegates run in one of two threads: in the thread that brings the message (a TCPROS
connection's, where the delegate is quick, or the publisher's where a channel is inline), or in the
node's dispatcher thread. Nobody ever waits for a busy node: what comes meanwhile waits in its inbox
for whoever is running the node. So no wiring deadlocks or recurses. Nor does a thread run a node
for long because others bring messages: those it leaves to the dispatcher thread.
"""
import _thread
import collections
import threading
import time

BURST = (
    100e-6  # seconds; a publisher that comes again within them does not give way to the receiver
)
GIVE_WAY = (
    1e-3  # seconds that a publisher at the most gives way, until the dispatcher thread has woken up
)
# seconds; so often a publisher gives way to a receiver that takes nothing from a full inbox
STARVING = 1e-3
QUICK = (
    1e-3  # seconds; a delegate that takes longer is not run by a thread that has a socket to read,
)
TRUSTED = 10  # and one is that has been quick so many times in a row
COURTESY = (
    1e-3  # seconds for which a thread that brings a message also runs what others bring meanwhile
)


class Inbox:
    """The messages on their way to one channel, through one connection: drops the oldest, counts.

    It is bounded by a number of messages and, where they are large, by their bytes; the newest
    always has room.

    One thread at a time puts (it holds the publisher's lock), one at a time runs (it holds the
    node's).

    :param channel: the InputChannel
    :param thaw: makes the receiver's message of what was put; None where that is the message itself
    :param header: the ``_connection_header`` of the messages; None where they have one already
    """

    # a message that comes alone meets cold caches: all that it needs lies together
    __slots__ = (
        'channel',
        'dispatcher',
        'inline',
        'shared',
        'arrived',
        'taken',
        'closed',
        '_thaw',
        '_header',
        '_queue',
        '_limit',
        '_announce',
        '_announced',
        '_seen',
        '_given',
        '_sizes',
        '_put_bytes',
        '_taken_bytes',
    )

    def __init__(self, channel, dispatcher, inline, thaw=None, header=None, shared=False):
        self.channel, self.dispatcher, self.inline, self.shared = (
            channel,
            dispatcher,
            inline,
            shared,
        )
        self.arrived = self.taken = 0
        self.closed = False  # nothing more arrives
        self._thaw, self._header = thaw, header
        self._queue = collections.deque(maxlen=channel.queue_size)
        self._limit = channel.queue_size
        self._announce = dispatcher.inline.append if inline else dispatcher.announced.append
        self._announced = False
        self._seen = -1  # how many were taken when a publisher last gave way,
        self._given = 0.0  # and when that was
        # of the large messages in the queue, and for a moment of one more
        self._sizes = collections.deque()
        self._put_bytes = self._taken_bytes = 0  # of those put and not dropped, and of those taken

    @property
    def dropped(self):
        return self.arrived - self.taken - len(self._queue)

    @property
    def is_empty(self):
        return not self._queue

    def close(self):
        """Nothing more arrives."""
        self.closed = True

    def put(self, value, size=0):
        """Add a message; the dispatcher is to be told afterwards.

        :param size: its bytes, if that matters
        """
        queue = self._queue
        if len(queue) == self._limit:
            self._let_receiver_run()
        if size:
            self._make_room(size)
        queue.append(value)
        self.arrived += 1
        if not self._announced:
            self._announced = True
            self._announce(self)

    def _let_receiver_run(self):
        """Where the queue is full, a publisher that never lets go of the interpreter would starve
        the receiver."""
        if self._seen != self.taken or time.perf_counter() - self._given > STARVING:
            self._seen = self.taken
            time.sleep(1e-6)
            self._given = time.perf_counter()

    def _make_room(self, size):
        """Drop the oldest messages, where there is no room for another of ``size`` bytes."""
        queue, sizes = self._queue, self._sizes
        self._put_bytes += size
        sizes.append(size)
        if queue and self._put_bytes - self._taken_bytes > self.channel.queue_bytes:
            self._let_receiver_run()
        while (
            self._put_bytes - self._taken_bytes > self.channel.queue_bytes
            or len(queue) == self._limit
        ):
            try:
                queue.popleft()
            except IndexError:  # the receiver has taken them all
                return
            self._put_bytes -= sizes.popleft()

    def run_next(self):
        """Run the delegate for the oldest message, if there is one still."""
        self._announced = (
            False  # before looking at the queue: what is put from now on announces itself
        )
        try:
            value = self._queue.popleft()
        except IndexError:
            return
        self.taken += 1
        if self._sizes:
            self._taken_bytes += self._sizes.popleft()
        if self._queue and not self._announced:
            self._announced = True
            self._announce(self)
        channel, thaw, header = self.channel, self._thaw, self._header
        if channel.closed:
            return
        channel.received += 1
        node = channel.node
        block = channel._delegate
        if block is None:
            block = node._delegate
            if block is None:
                return
        message = None
        try:
            message = value if thaw is None else thaw(value)
            if header is not None:
                message._connection_header = header
            block(message, channel)
        except BaseException as error:
            node._report(error, block, 'delegate', channel, message)


class SocketInbox(Inbox):
    """The messages that come to one channel, one that is not inline, through TCPROS.

    As long as the delegate is quick, the thread that reads the socket runs it, for waking another
    one takes longer. But while it runs a slow one it does not read, and what that gets next has
    waited longest in the socket, for all that the queue is short (ros_comm #536, #1901). So slow
    delegates are the dispatcher thread's, and those not known yet.
    """

    __slots__ = ('_quick',)

    def __init__(self, channel, dispatcher):
        super().__init__(channel, dispatcher, inline=False)
        self._announce = dispatcher.announce
        self._quick = 0  # how many times in a row, TRUSTED at the most

    def run_next(self):
        taken, begin = self.taken, time.perf_counter()
        super().run_next()
        if self.taken == taken:
            return
        if time.perf_counter() - begin >= QUICK:
            self._quick, self._announce = 0, self.dispatcher.announce
        elif self._quick < TRUSTED:
            self._quick += 1
            if self._quick == TRUSTED:
                self._announce = self.dispatcher.inline.append


class Dispatcher:
    """Whoever has messages for a node puts them into inboxes, then calls :meth:`run` for those that
    are inline or came
    through a socket, :meth:`wake` for others if the thread is :attr:`idle`.
    """

    def __init__(self, start_thread):
        self.inline = collections.deque()  # inboxes that whoever comes by may run
        self.announced = collections.deque()  # inboxes for the dispatcher thread
        self.idle = False  # whether that thread waits for inboxes
        self._running = threading.Lock()  # held by the thread that runs delegates,
        self._runner = None  # which is this one, by its identifier
        self._start_thread, self._started, self._closed = start_thread, threading.Lock(), False
        # bare locks as signals: every other primitive costs several of them
        self._woken, self._awake = _thread.allocate_lock(), _thread.allocate_lock()
        self._woken.acquire()
        self._awake.acquire()

    def run(self):
        """Run the delegates of the inline inboxes in this thread, unless another thread is running
        the node.

        It runs a message of each inbox that has some, and for a moment what comes meanwhile. The
        rest is left to the dispatcher thread: others that bring messages all the time would never
        let this thread go.
        """
        inline, running = self.inline, self._running
        turns, until = len(inline), None
        while inline and running.acquire(False):
            self._runner = _thread.get_ident()
            try:
                while inline:
                    if turns <= 0:
                        now = time.perf_counter()
                        until = until or now + COURTESY
                        if now > until:
                            break
                    turns -= 1
                    inline.popleft().run_next()
            except IndexError:
                pass  # close() cleared it
            finally:
                self._runner = None
                running.release()
            # looked at again: what was announced just before the release found the node busy
            if until and inline:
                self._leave_to_thread()
                return

    def _leave_to_thread(self):
        """Have the dispatcher thread run the inline inboxes that have messages."""
        if self._closed:
            return
        self.need_thread()
        try:
            for _ in range(len(self.inline)):
                self.announced.append(self.inline.popleft())
        except IndexError:
            pass  # another thread runs them
        if self.idle:
            self.wake()

    def is_run_here(self):
        """Whether it is this thread that runs delegates just now."""
        return self._runner == _thread.get_ident()

    def wait_for_delegate(self, timeout):
        """Wait until the delegate that another thread runs just now has ended, for up to
        ``timeout`` seconds."""
        if self.is_run_here():
            return
        if self._running.acquire(True, timeout):
            self._running.release()
            if self.inline:  # announced meanwhile by a thread that found the node busy
                self._leave_to_thread()

    def run_in_turn(self, job):
        """Run ``job()`` in this thread when no delegate runs; at once in one that it runs."""
        if self._runner == _thread.get_ident():
            job()
            return
        with self._running:
            self._runner = _thread.get_ident()
            try:
                job()
            finally:
                self._runner = None
        if self.inline:  # as in wait_for_delegate
            self._leave_to_thread()

    def need_thread(self):
        """Have the dispatcher thread, from the first channel on that is not inline."""
        if self._started.acquire(blocking=False):
            self._start_thread(self._loop, name='dispatcher')

    def announce(self, inbox):
        """Have the dispatcher thread run an inbox."""
        self.announced.append(inbox)
        if self.idle:
            self.wake()

    def wake(self):
        """Wake the dispatcher thread, which is idle."""
        self.idle = False
        self._awake.acquire(False)  # a stale acknowledgement
        _release(self._woken)

    def give_way(self):
        """Let the woken dispatcher thread have the interpreter: it would get it 5 ms later from a
        busy publisher."""
        self._awake.acquire(True, GIVE_WAY)

    def _loop(self):
        announced, inline = self.announced, self.inline
        acquire, release = self._running.acquire, self._running.release  # ``with`` costs more
        me = _thread.get_ident()
        while not self._closed:
            try:
                inbox = announced.popleft()
            except IndexError:
                self.idle = True
                if not announced and not self._closed:
                    self._woken.acquire()
                    _release(self._awake)
                self.idle = False
                continue
            acquire()
            self._runner = me
            try:
                inbox.run_next()
            finally:
                self._runner = None
                release()
            if inline:
                self.run()

    def close(self):
        """Forget what has not run, and end the thread."""
        self._closed = True
        self.inline.clear()
        self.announced.clear()
        self.wake()


def _release(lock):
    try:
        lock.release()
    except RuntimeError:
        pass  # it was free already: two had the same to say
