"""Who receives through a link between two nodes of this process and is no channel: the callbacks of
plain rospy Subscribers, and rospy's statistics."""
import contextlib
import math

from pharos.intraprocess.copier import serialized, thawer
from pharos.intraprocess.inbox import ThreadedInbox
from pharos.private_rospy.condition import Condition
from pharos.private_rospy.socket_callback import SocketCallback

# bytes that wait beside a publisher's queue, as they do in the sockets of TCPROS
UNDER_WAY = 4 << 20
SMALL = 64  # bytes that a message is taken to have whose size is not told
WAITING = 1000  # messages that wait to be counted by the statistics


def plain_callbacks(subscriber):
    """``[(callback, arguments)]`` of a rospy subscription that are no channels'."""
    return [each for each in subscriber.callbacks or () if not isinstance(each[0], SocketCallback)]


class PlainReceiver(ThreadedInbox):
    """A receiver at the end of one link that is its own inbox; see
    :class:`~pharos.intraprocess.inbox.Receiver`."""

    from_ = None
    queue_size = queue_bytes = math.inf

    def __init__(self, link, start_thread, name):
        self.link, self.subscriber = link, link.subscriber
        self.topic, self.message_class = self.subscriber.resolved_name, self.subscriber.data_class
        thaw = thawer(link.publisher.data_class, self.message_class)
        super().__init__(self, start_thread, name, thaw, link.header)

    def open_inbox(self, thaw, header):
        return self

    def count_dropped(self):
        """Nobody asks, as in rospy."""

    def report(self, error):
        self.link.warn(f'a message on {self.topic} was lost: {error!r}')


class PlainCallbacks(PlainReceiver):
    """The callbacks of a rospy subscription that are no channels'.

    All is as over a socket. The callbacks run in a thread of the link, so that those of two
    publishers may wait for each other, and get one message for all of them. What does not fit into
    the publisher's queue is dropped, the oldest first; a publisher that has no queue waits.
    """

    def __init__(self, link, start_thread):
        self.latched = None  # the last message of a publisher that latches
        # notified when there is some, while a publisher waits for it
        self._room = Condition()
        # publishers that wait; and threads for which they are not to wait
        self._waiting = self._excused = 0
        super().__init__(link, start_thread, 'dispatcher')

    def put(self, value, size=0):
        """Add a message, when there is room for it."""
        if self.closed:
            return
        size = size or SMALL
        if self.link.publisher.queue_size is None:
            self._wait_for_room(size)
        super().put(value, size)

    def is_full(self):
        """Whether what waits is more than the subscriber wants, or than the sockets and the
        publisher's queue would hold."""
        waiting, size, publisher = len(self._queue), self.waiting_bytes, self.link.publisher
        if waiting >= (self.subscriber.queue_size or math.inf):
            return True
        return size > UNDER_WAY and (
            waiting >= (publisher.queue_size or math.inf) or size > publisher.queue_bytes
        )

    def _wait_for_room(self, size):
        if not self._has_room(size) and not self.dispatcher.is_run_here():
            with self._room:
                self._waiting += 1
                self._room.wait_for(lambda: self._has_room(size))
                self._waiting -= 1

    def _has_room(self, size):
        return (
            not self._queue
            or self.waiting_bytes + size <= UNDER_WAY
            or self.closed
            or self._excused
            or self.link.publisher.queue_size is not None
        )

    def deliver(self, message, header):
        """Run the callbacks."""
        if self._waiting:
            self._tell_of_room()
        message._connection_header = header
        if header.get('latching') == '1':
            self.latched = message
        self.subscriber.run_callbacks(message)

    def _tell_of_room(self):
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
        super().close()
        self._tell_of_room()


class Statistics(PlainReceiver):
    """Has rospy count what comes through the link, for what it tells on /statistics where the
    parameter /enable_statistics is true.

    In a thread of its own, as each TCPROS connection has one: neither the publisher nor the
    delegates wait for it, and when a message comes does not depend on when the node takes it.
    """

    queue_size = WAITING

    def __init__(self, link, start_thread):
        self._bytes = 0  # as a TCPROS connection would have brought
        super().__init__(link, start_thread, 'statistics')

    def deliver(self, message, header):
        """Count it."""
        self._bytes += 4 + len(serialized(message))
        statistics = self.subscriber.statistics_logger  # None: it was closed meanwhile
        if statistics is not None:
            statistics.callback(message, header['callerid'], self._bytes)
            if self.subscriber.statistics_logger is None:
                statistics.shutdown()  # or the callback would leave a publisher behind
