"""Inboxes: the bounded queues in which messages wait for callbacks."""
from __future__ import annotations

import collections
import math
import threading
from contextlib import suppress
from typing import Any

from pharos.intraprocess.copier import size_of
from pharos.waiting import let_others_run


class BoundedQueue:
    """Messages that wait; a full queue drops the oldest.

    ``queue_size`` is the number of messages that wait at most. 0: as many as ``queue_bytes`` hold.
    None is the same as 0 within a process (PlainInbox has more), and by shared memory. By TCPROS,
    None means no queue, as in rospy: publish() waits for the socket. For a subscription of plain
    rospy, PlainInbox.receive says what None means.

    :ivar messages: the messages that wait, the oldest first
    :ivar dropped: the number of dropped messages
    """

    queue_bytes = 64 << 20
    dropped = 0
    # of all queues; of a kind that the handler of a signal may take again
    _count_lock = threading.RLock()

    def __init__(self, queue_size: int | None = None) -> None:
        self.messages: collections.deque[Any] = collections.deque()
        self.queue_size = queue_size

    def capacity_for(self, size: int) -> int:
        """Return how many messages of ``size`` bytes may wait."""
        return int(min(self.queue_size or math.inf, max(1, self.queue_bytes // max(1, size))))

    def add(self, message: Any, size: int) -> None:
        """Add a message of so many bytes; if the queue is full, drop the oldest."""
        self.messages.append(message)
        self.drop_beyond(self.capacity_for(size))

    def drop_beyond(self, capacity: int) -> None:
        """Drop the oldest messages, until no more than so many are left."""
        while self.messages:
            # the receiver, or another publisher, may take the oldest away in between
            with suppress(IndexError, ValueError):
                oldest = self.messages[0]  # before the look: popleft() might take the newest
                if len(self.messages) <= capacity:
                    return
                self.messages.remove(oldest)
                if self.forget(oldest):
                    self.count_dropped(1)

    def count_dropped(self, number: int) -> None:
        """Add to the dropped messages; several publishers may do so at once."""
        with self._count_lock:
            self.dropped += number

    def forget(self, message: Any) -> bool:
        """Free what a message holds; return True if it was dropped, False if its receiver has taken it."""
        return True


class Inbox(BoundedQueue):
    """The messages that wait for a channel, or for all callbacks of plain rospy of a topic.

    ``jobs`` of the callback queue owns what waits; ``messages`` counts it, and orders the drops. A
    message waits as the job ``(number, inbox, (value, thaw, header))``. The value is a frozen
    message. If ``thaw`` is None, the value is the message itself, which came from a socket or is
    shared, and has its header already; PlainInbox uses that place. Several publishers may be here
    at once: who takes a job out of the callback queue's ``jobs`` runs it or drops it. A run takes it
    from ``jobs`` first, a drop from ``messages``.

    :param callback_queue: the CallbackQueue that runs the callback
    :param callback: called as ``callback(message)``; raises no Exception
    :param queue_size: as for BoundedQueue
    :param inline: True: the thread of the publisher runs the callback
    :param shared: True: the callback gets the published object, not a copy
    """

    def __init__(self, callback_queue, callback, queue_size=None, inline=False, shared=False):
        super().__init__(queue_size)
        self.callback = callback
        self.inline = inline
        self.shared = shared
        # the last answer of capacity_for(), which put() asks if the queue is full, and at powers of two
        self._capacity = math.inf
        if callback_queue:  # a channel attaches when it opens
            self.attach(callback_queue)

    def attach(self, callback_queue):
        """Have a callback queue run the callback from now on."""
        self.callback_queue = callback_queue
        self._jobs = callback_queue.jobs
        self._next_number = callback_queue.order.numbers.__next__
        callback_queue.order.queues[callback_queue] = None

    def put(self, item: tuple, size: int = 0) -> None:
        """Add a message; the caller then wakes or runs the callback queue.

        :param item: ``(value, thaw, header)``
        :param size: the bytes of the value; 0: unknown
        """
        count = len(self.messages)
        # to estimate the size takes long: only if the queue is full, or at a power of two
        if count and (count >= self._capacity or not count & (count - 1)):
            self._capacity = self.capacity_for(size or size_of(item[0]))
            if count >= self._capacity:  # else a publisher that never sleeps starves the receiver
                let_others_run()
        job = self._next_number(), self, item
        self.messages.append(job)
        self._jobs.append(job)
        if count >= self._capacity:  # drop last: a receiver must not find the queue empty
            self.drop_beyond(self._capacity)  # type: ignore[arg-type]

    def forget(self, job: tuple) -> bool:
        """Take a job away; return False if the thread has taken the job already."""
        with suppress(ValueError):
            self._jobs.remove(job)
            return True
        return False

    def run_callback(self, job: tuple) -> None:
        """Run the callback on the message of a job; who runs the callback queue calls this."""
        try:
            self.messages.remove(job)
        except ValueError:  # drop_beyond() has taken the message, and forget() comes too late
            pass
        value, thaw, header = job[2]
        if thaw is not None:
            value = thaw(value)
            value._connection_header = header
        self.callback(value)

    def receive(self, message: Any, size: int = 0, connection: Any = None) -> None:
        """Take a message, as the thread that reads a connection does.

        :param size: the bytes of the message; 0: unknown
        """
        self.put((message, None, None), size)
        self.callback_queue.request_thread()
