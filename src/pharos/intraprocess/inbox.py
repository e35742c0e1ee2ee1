"""The messages on their way to one receiver."""
import collections
import time
from typing import Any, Callable, Deque, Dict, Optional, Protocol, Type

import genpy

from pharos.intraprocess.dispatcher import Dispatcher

# A publisher yields to a receiver that takes nothing from a full inbox once in so many seconds.
STARVATION_INTERVAL = 1e-3
# A delegate that takes so many seconds is slow: no thread that has a socket to read runs it.
FAST_CALLBACK = 1e-3
# A delegate that was not slow so many times in a row is run by the thread that reads the socket.
FAST_STREAK = 10

Thaw = Callable[[Any], genpy.Message]


class Receiver(Protocol):
    """Who gets the messages of a topic in this process."""

    topic: str
    message_class: Type[genpy.Message]
    queue_size: int  # messages that may wait; the oldest are dropped
    queue_bytes: int  # bytes of large messages that may wait; the newest always has room
    inline: bool  # whether the publisher's thread delivers
    shared: bool  # whether it gets the published message itself
    from_: Optional[str]  # name of the only node whose messages it wants; None: all

    def open_inbox(self, thaw: Thaw, header: Dict[str, str]) -> 'Inbox':
        """An inbox for what one publisher sends; called with the publisher's lock."""

    def deliver(self, message: genpy.Message, header: Optional[Dict[str, str]]) -> None:
        """Take a message; raises nothing. Called by one thread at a time, the dispatcher's choice.

        :param header: to be its ``_connection_header``; None: it has one already
        """

    def report(self, error: BaseException) -> None:
        """A message could not be made for the receiver; raises nothing."""

    def count_dropped(self) -> None:
        """A message was dropped; called by any publisher's thread."""


class Inbox:
    """The messages on their way to one receiver, through one connection: the oldest are dropped.

    One thread at a time puts (it holds the publisher's lock), one at a time runs (it holds the
    node's).

    :param thaw: makes the receiver's message of what was put; None where that is the message itself
    :param header: the ``_connection_header`` of the messages; None where they have one already
    """

    # Slots keep what each message needs close together in memory: a message that comes after a pause
    # then waits for fewer of the processor's cache lines.
    __slots__ = (
        'receiver',
        'dispatcher',
        'inline',
        'shared',
        '_thaw',
        '_header',
        '_queue',
        '_limit',
        '_schedule',
        '_is_scheduled',
        '_has_taken',
        '_last_yield',
        '_sizes',
        '_put_bytes',
        '_taken_bytes',
    )

    def __init__(
        self,
        receiver: Receiver,
        dispatcher: Dispatcher,
        thaw: Optional[Thaw] = None,
        header: Optional[Dict[str, str]] = None,
    ) -> None:
        self.receiver, self.dispatcher = receiver, dispatcher
        self.inline, self.shared = receiver.inline, receiver.shared
        if receiver.shared:  # a shared message is marked with the header when it is put
            thaw = header = None
        self._thaw, self._header = thaw, header
        self._queue: Deque[Any] = collections.deque()
        self._limit = receiver.queue_size
        self._schedule = dispatcher.inline.append if self.inline else dispatcher.scheduled.append
        self._is_scheduled = False
        self._has_taken = True  # since a publisher yielded
        self._last_yield = 0.0
        # the sizes of the messages in the queue, where sizes matter; for a moment that of one more
        self._sizes: Deque[int] = collections.deque()
        # Their difference is the bytes that wait. They are two, for the thread that puts changes
        # the one (minus what it drops), and the thread that runs the other, without a lock.
        self._put_bytes = self._taken_bytes = 0

    def put(self, value: Any, size: int = 0) -> None:
        """Add a message; the dispatcher is to be told afterwards.

        :param size: its bytes, if that matters
        """
        queue = self._queue
        if size:
            self._sizes.append(size)
            self._put_bytes += size
            if queue:
                self._make_room()
        elif len(queue) >= self._limit:
            self._make_room()
        queue.append(value)
        if not self._is_scheduled:
            self._is_scheduled = True
            self._schedule(self)

    @property
    def waiting_bytes(self) -> int:
        """The bytes of the large messages that wait."""
        return self._put_bytes - self._taken_bytes

    def is_full(self) -> bool:
        """Whether the oldest message is to be dropped for the newest, whose size is counted."""
        return (
            len(self._queue) >= self._limit
            or self._put_bytes - self._taken_bytes > self.receiver.queue_bytes
        )

    def _make_room(self) -> None:
        """Drop the oldest messages, where there is no room for another one."""
        if self.is_full():
            self._let_receiver_run()
        while self.is_full():
            try:
                self._queue.popleft()
            except IndexError:  # the receiver has taken them all
                return
            if self._sizes:
                self._put_bytes -= self._sizes.popleft()
            self.receiver.count_dropped()

    def _let_receiver_run(self) -> None:
        """A publisher that never lets go of the interpreter would starve the receiver."""
        if self._has_taken or time.perf_counter() - self._last_yield > STARVATION_INTERVAL:
            self._has_taken = False
            time.sleep(1e-6)
            self._last_yield = time.perf_counter()

    def run_next(self) -> bool:
        """Deliver the oldest message, if there is one still; returns whether there was."""
        # before looking at the queue: what is put from now on schedules the inbox itself
        self._is_scheduled = False
        queue = self._queue
        try:
            value = queue.popleft()
        except IndexError:
            return False
        self._has_taken = True
        if self._sizes:
            self._taken_bytes += self._sizes.popleft()
        if queue and not self._is_scheduled:
            self._is_scheduled = True
            self._schedule(self)
        if self._thaw is not None:
            try:
                value = self._thaw(value)
            except BaseException as error:
                self.receiver.report(error)
                return True
        self.receiver.deliver(value, self._header)
        return True

    def close(self) -> None:
        """Nothing more is put; what waits is delivered still."""


class SocketInbox(Inbox):
    """The messages that come to one receiver, one that is not inline, through TCPROS.

    As long as the delegate is fast, the thread that reads the socket runs it, for waking another
    one takes longer. But while it runs a slow one it does not read, and what that gets next has
    waited longest in the socket, for all that the queue is short (ros_comm #536, #1901). So slow
    delegates are the dispatcher thread's, and those not known yet.
    """

    __slots__ = ('_streak',)

    def __init__(self, receiver: Receiver, dispatcher: Dispatcher) -> None:
        super().__init__(receiver, dispatcher)
        self._schedule = dispatcher.schedule
        self._streak = 0  # how many times in a row it was fast, FAST_STREAK at the most

    def run_next(self) -> bool:
        begin = time.perf_counter()
        if not super().run_next():
            return False
        if time.perf_counter() - begin >= FAST_CALLBACK:
            self._streak, self._schedule = 0, self.dispatcher.schedule
        elif self._streak < FAST_STREAK:
            self._streak += 1
            if self._streak == FAST_STREAK:
                self._schedule = self.dispatcher.inline.append
        return True


class ThreadedInbox(Inbox):
    """An inbox with a dispatcher thread of its own, which ends with it."""

    inline = shared = False

    def __init__(
        self,
        receiver: Receiver,
        start_thread: Callable[..., Any],
        name: str,
        thaw: Thaw,
        header: Dict[str, str],
    ) -> None:
        super().__init__(receiver, Dispatcher(start_thread, name), thaw, header)
        # Code that was written for sockets may not be through with what it does at a publish()
        # when its answer comes.
        self.dispatcher.is_yielded_to = False
        self.closed = False  # nothing more arrives
        self.dispatcher.need_thread()

    def close(self) -> None:
        """The thread ends when what is there has been delivered."""
        self.closed = True
        self.dispatcher.finish()
