"""The callbacks of plain rospy Subscribers at the end of a link between two nodes of this
process."""
import collections
import contextlib
import threading

from pharos.intraprocess.dispatcher import Dispatcher

# bytes that wait beside a publisher's queue, as they do in the sockets of TCPROS
UNDER_WAY = 4 << 20
SMALL = 64  # bytes that a message is taken to have whose size is not told


def is_of_channel(callback):
    """Whether a callback of a rospy Subscriber is a channel's, which has inboxes of its own."""
    return getattr(callback, 'is_of_channel', False)


class CallbackInbox:
    """The messages on their way to the callbacks of a rospy subscription, through one link.

    All is as over a socket. The callbacks run in a thread of the link, so that those of two
    publishers may wait for each other, and get one message for all of them. What does not fit into
    the publisher's queue is dropped, the oldest first; a publisher that has no queue waits.
    """

    inline = shared = False  # see dispatcher.Inbox

    def __init__(self, link, publisher, subscriber, start_thread):
        """:param publisher: rospy's _PublisherImpl
        :param subscriber: rospy's _SubscriberImpl
        """
        self.closed = False  # nothing more arrives
        self.latched = None  # the last message of a publisher that latches
        self.dispatcher = Dispatcher(start_thread)
        self._link, self._publisher, self._subscriber = link, publisher, subscriber
        self._queue, self._sizes = collections.deque(), collections.deque()
        self._put_bytes = self._taken_bytes = 0  # of those put and not dropped, and of those taken
        self._announced = False
        # notified when there is some, while a publisher waits for it
        self._room = threading.Condition()
        # publishers that wait; and threads for which they are not to wait
        self._waiting = self._excused = 0
        self.dispatcher.need_thread()

    def put(self, value, size=0):
        """Add a message; the dispatcher is to be woken afterwards."""
        if self.closed:
            return
        size = size or SMALL
        if self._waits_for_room(size):
            self._wait_for_room(size)
        self._put_bytes += size
        self._sizes.append(size)
        queue, publisher = self._queue, self._publisher
        while self._bytes > UNDER_WAY and 0 < (publisher.queue_size or 0) <= len(queue):
            self._make_room()
        while self._bytes > max(UNDER_WAY, publisher.queue_bytes) and queue:
            self._make_room()
        queue.append(value)
        if not self._announced:
            self._announced = True
            self.dispatcher.announced.append(self)

    @property
    def _bytes(self):
        return self._put_bytes - self._taken_bytes

    def _make_room(self):
        """Drop the oldest message; for the thread that puts."""
        with contextlib.suppress(IndexError):  # it has just been taken
            self._queue.popleft()
            self._put_bytes -= self._sizes.popleft()

    def _take(self):
        """Take the oldest message; for the thread that runs.

        Each of the two threads has a count of its own: neither may overwrite what the other has
        just counted.
        """
        value = self._queue.popleft()
        self._taken_bytes += self._sizes.popleft()
        return value

    def _waits_for_room(self, size):
        return (
            self._publisher.queue_size is None
            and self._queue
            and self._bytes + size > UNDER_WAY
            and not self.closed
            and not self._excused
            and not self.dispatcher.is_run_here()
        )

    def _wait_for_room(self, size):
        with self._room:
            self._waiting += 1
            self._room.wait_for(lambda: not self._waits_for_room(size))
            self._waiting -= 1

    def run_next(self):
        """Run the callbacks for the oldest message, if there is one still."""
        self._announced = (
            False  # before looking at the queue: what is put from now on announces itself
        )
        queue, limit = self._queue, self._subscriber.queue_size
        try:
            while limit and len(queue) > limit:
                self._take()
            value = self._take()
        except IndexError:
            return
        if self._waiting:
            self._notify()
        if queue and not self._announced:
            self._announced = True
            self.dispatcher.announced.append(self)
        if self._subscriber.callbacks:
            self._deliver(value)

    def _deliver(self, value):
        link = self._link
        message = link.thaw(value)
        message._connection_header = link.header
        if link.header.get('latching') == '1':
            self.latched = message
        self._subscriber.run_callbacks(message)

    def _notify(self):
        with self._room:
            self._room.notify_all()

    @contextlib.contextmanager
    def unbounded(self):
        """Within this, no publisher waits for room: it holds a lock that the thread needs which
        would make room."""
        with self._room:
            self._excused += 1
            self._room.notify_all()
        try:
            yield
        finally:
            with self._room:
                self._excused -= 1

    def close(self):
        """Nothing more arrives; the thread ends when the callbacks have got what is there."""
        if not self.closed:
            self.closed = True
            self._notify()
            self.dispatcher.announce(_End(self))

    @property
    def is_empty(self):
        return not self._queue


class _End:
    """The last that the dispatcher of an inbox runs."""

    def __init__(self, inbox):
        self._inbox = inbox

    def run_next(self):
        dispatcher = self._inbox.dispatcher
        if self._inbox.is_empty:
            dispatcher.close()
        else:
            dispatcher.announce(self)
