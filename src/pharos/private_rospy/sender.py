"""What is on its way to subscribers over TCPROS."""
import collections
import io
import math
import socket
import time

from pharos.private_rospy.condition import Condition
from pharos.signals import is_from_signal

# bytes; copying more into the socket would hold the publisher up longer than waking a thread
AT_ONCE = 1 << 16


class Sockets:
    """Has rospy serialize the messages of a publisher and write them into sockets.

    See :class:`pharos.intraprocess.fanout.Sockets`; the publisher's lock is held.

    :param publisher: rospy's _PublisherImpl
    :param module: the rospy.topics that it is of
    """

    def __init__(self, publisher, module):
        self._publisher, self._module = publisher, module
        self._buffer = io.BytesIO()

    def serialize(self, message, seq):
        """The message, with its length."""
        buffer = self._buffer
        try:
            self._module.serialize_message(buffer, seq, message)
            return buffer.getvalue()
        finally:  # what does not serialize must leave nothing that would corrupt the stream
            buffer.seek(0)
            buffer.truncate()

    def write(self, data, connections):
        """Write it to each subscriber; one whose connection broke is left, as is one to which a
        handler of signals has perhaps cut it short."""
        self._publisher.message_data_sent += len(data)
        for connection in connections:
            try:
                connection.write_data(data)
            except BaseException as error:
                is_interrupted = not isinstance(error, Exception) or is_from_signal(error)
                if not is_interrupted or getattr(connection, 'is_unsure', True):
                    connection.close()
                if is_interrupted:
                    raise
                self._module.logdebug(
                    f'publisher connection to [{connection.endpoint_id}] terminated: {error}'
                )


class Sender:
    """A bounded queue in front of a rospy transport, and the thread that writes what does not fit
    into the socket.

    Instead of rospy's QueuedConnection, which has its thread write everything: waking it takes
    longer than writing. And which takes all that is queued out at once, so that it can neither drop
    nor count it any more.
    """

    def __init__(self, connection, queue_size, start_thread, queue_bytes=math.inf):
        """:param queue_size: messages, the oldest of which are dropped; 0: without limit
        :param queue_bytes: bytes of messages, likewise; the newest always has room
        """
        self._connection = connection
        self._queue, self._bytes = collections.deque(), 0
        self.resize(queue_size, queue_bytes)
        self._begun = b''  # the rest of a message whose beginning the socket has
        self._is_idle = True  # nothing is on its way but what the socket has
        self._error = None  # of the thread, for the next who publishes, as in rospy
        self.is_unsure = False  # whether who is interrupted leaves a part of a message, or disorder
        # guards what waits and how it is written; notified when there is something, or the last was written
        self._changed = Condition()
        self._cleanup = connection.cleanup_cb  # where it has been in use without a queue
        connection.set_cleanup_callback(self._closed)
        start_thread(self._run, name='sender')

    def resize(self, queue_size, queue_bytes):
        """Have other limits from the next message on; see :meth:`__init__`."""
        self._limit, self._byte_limit = queue_size or math.inf, queue_bytes

    def __getattr__(self, name):
        return getattr(self._connection, name)

    def write_data(self, data):
        """Send ``data``, a message with its length; never waits for the subscriber."""
        with self._changed:
            if self._error is not None:
                error, self._error = self._error, None
                raise error
            self.is_unsure = True
            if self._is_idle and len(data) <= AT_ONCE:
                sent = self._send(data)
                if sent == len(data):
                    self._connection.stat_num_msg += 1
                    self.is_unsure = False
                    return
                self._begun = data[sent:]
            else:
                self._enqueue(data)
            self._is_idle = False
            self._changed.notify_all()
            self.is_unsure = False
        time.sleep(0)  # else the thread gets the interpreter 5 ms later from a busy publisher

    def _enqueue(self, data):
        queue = self._queue
        queue.append(data)
        self._bytes += len(data)
        while len(queue) > self._limit or self._bytes > self._byte_limit and len(queue) > 1:
            self._bytes -= len(queue.popleft())

    def _send(self, data):
        """Return how many bytes the socket has taken."""
        connection = self._connection
        try:
            sent = connection.socket.send(data, socket.MSG_DONTWAIT)
        except (OSError, AttributeError):
            # it is full; or broken, or closed, as the thread will see
            return 0
        connection.stat_bytes += sent
        return sent

    def _run(self):
        connection = self._connection
        while True:
            with self._changed:
                self._is_idle = not self._begun and not self._queue
                if self._is_idle:
                    self._changed.notify_all()
                    self._changed.wait_for(lambda: self._begun or self._queue or connection.done)
                if connection.done:
                    return
                data, self._begun = self._begun, b''
                if not data:
                    data = self._queue.popleft()
                    self._bytes -= len(data)
            try:
                connection.write_data(data)
            except Exception as error:
                with self._changed:
                    self._error = error

    def _closed(self, connection):
        if self._cleanup:
            self._cleanup(connection)
        with self._changed:
            self._changed.notify_all()

    def flush(self, timeout):
        """Wait until everything published is with the socket, up to ``timeout`` seconds."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._is_idle or self._connection.done, max(0.0, timeout)
            )
