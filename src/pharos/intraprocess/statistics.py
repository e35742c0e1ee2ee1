"""What rospy tells on /statistics, where the parameter /enable_statistics is true: of INTRAPROCESS
connections, too."""
import queue

from pharos.intraprocess import copier

WAITING = 1000  # messages; what comes beyond is not counted


class Statistics:
    """Has rospy's statistics of a subscription count what comes through one link.

    It is an inbox of that link with a thread of its own, as each TCPROS connection has one: neither
    the publisher nor the delegates wait for it, and when a message comes does not depend on when
    the node takes it.

    :param subscriber: rospy's _SubscriberImpl, which has a ``statistics_logger``
    :param publisher_name: of the node at the other end
    :param thaw: makes the receiver's message of what was put
    """

    inline = shared = idle = False  # as a dispatcher, it wakes by itself

    def __init__(self, subscriber, publisher_name, thaw, start_thread):
        self.dispatcher = self
        self._subscriber, self._publisher_name, self._thaw = subscriber, publisher_name, thaw
        self._waiting = queue.SimpleQueue()
        self._bytes = 0  # as a TCPROS connection would have brought
        start_thread(self._run, name='statistics')

    def put(self, frozen, size=0):
        """Count a message."""
        if self._waiting.qsize() < WAITING:
            self._waiting.put((frozen,))

    def close(self):
        """The link has been closed."""
        self._waiting.put(None)

    def _run(self):
        while True:
            waiting = self._waiting.get()
            if waiting is None:
                return
            message = self._thaw(*waiting)
            self._bytes += 4 + len(copier.serialized(message))
            statistics = self._subscriber.statistics_logger  # None: it was closed meanwhile
            if statistics is not None:
                statistics.callback(message, self._publisher_name, self._bytes)
                if self._subscriber.statistics_logger is None:
                    statistics.shutdown()  # or the callback would leave a publisher behind
