"""What a node publishes and hears: mended where rospy loses messages."""
import threading
import time


RECONNECT_DELAY = 0.05    # seconds; a publisher that accepts and closes at once is not to be stormed
_changed = threading.Condition()    # notified whenever a publisher of this process gains or loses a connection


def hooks(instance):
    """The load hooks of this module, for the :class:`~.instance.PrivateRospy` given."""

    def mend_topics(module):
        """rospy.topics."""
        module.is_shutdown = instance.is_shut_down
        publisher, subscriber = module._PublisherImpl, module._SubscriberImpl
        publish, receive = publisher.publish, subscriber.receive_callback

        def publish_or_reset(self, message, connection_override=None):
            """After a message that does not serialize, rospy's buffer keeps its part, which corrupts the stream."""
            try:
                return publish(self, message, connection_override)
            except BaseException:
                if self.buff is not None and not self.buff.closed:
                    self.buff.seek(0)
                    self.buff.truncate()
                raise
        publisher.publish = publish_or_reset

        def receive_callback(self, messages, connection):
            """Channels only queue in their callbacks, so that of a batch the newest are kept; delegates run then."""
            receive(self, messages, connection)
            instance.on_received()
        subscriber.receive_callback = receive_callback

        remove = subscriber.remove_connection

        def remove_connection(self, connection):
            """rospy lets a link that broke go, though its publisher may be there, or there again under its old URI."""
            remove(self, connection)
            if connection.header and not self.closed:    # without a header, it never was a link
                instance.start_thread(_reconnect, (instance, self, connection.endpoint_id), 'reconnect')
        subscriber.remove_connection = remove_connection

        for method in 'add_connection', 'remove_connection', 'close':
            _notify_after(publisher, method)

    def know_what_is_under_way(module):
        """rospy.impl.tcpros_pubsub: a queue knows nothing of the messages it has taken out and not yet sent."""
        queued = module.QueuedConnection
        init = queued.__init__

        def __init__(self, connection, queue_size):
            self._idle = threading.Event()
            init(self, connection, queue_size)
        queued.__init__ = __init__

        def _run(self):
            connection = self._connection
            while not connection.done:
                with self._lock:
                    while not self._queue and not connection.done:
                        self._idle.set()
                        self._cond_data_available.wait()
                    self._idle.clear()
                    batch, self._queue = self._queue, []
                for data in batch:
                    try:
                        connection.write_data(data)
                    except Exception as error:    # the next publish raises it, as in rospy
                        with self._lock:
                            self._error = error
            self._idle.set()
        queued._run = _run

        def flush(self, timeout):
            """Wait until everything published is with the socket, up to ``timeout`` seconds."""
            with self._lock:
                if not self._queue and self._idle.is_set():
                    return
                self._idle.clear()    # what is queued may not have been taken out yet
            self._idle.wait(max(0.0, timeout))
        queued.flush = flush

    return {'rospy.topics': mend_topics, 'rospy.impl.tcpros_pubsub': know_what_is_under_way}


def _reconnect(instance, subscriber, uri):
    if not instance.ended.wait(RECONNECT_DELAY) and not subscriber.closed:
        instance.connect(subscriber.resolved_name, uri)


def _notify_after(publisher, method):
    original = getattr(publisher, method)

    def notifying(self, *args):
        result = original(self, *args)
        with _changed:
            _changed.notify_all()
        return result
    setattr(publisher, method, notifying)


def wait_until(predicate, timeout):
    """Wait until ``predicate()``, which speaks of connections of publishers of this process, holds.

    :param timeout: seconds, None: no limit
    """
    with _changed:
        return _changed.wait_for(predicate, None if timeout is None else max(0.0, timeout))


def connections(endpoint, names):
    """``[(peer node name, transport name)]`` of a rospy Publisher or Subscriber.

    :param names: ``{URI: node name}`` of nodes that need not be asked
    """
    impl = endpoint.impl
    return [(_peer(connection, names), connection.transport_type) for connection in (impl.connections if impl else ())]


def _peer(connection, names):
    # a publisher's end is called after the subscriber's node; a subscriber's after the publisher's URI, and it
    # knows the name once the handshake is through
    name = getattr(connection, 'callerid_pub', 'unknown')
    return name if name != 'unknown' else names.get(connection.endpoint_id, connection.endpoint_id)


def flush(topic_manager, timeout):
    """Wait until what the node published is with the sockets, up to ``timeout`` seconds in all."""
    deadline = time.monotonic() + timeout
    for publisher in list(topic_manager.pubs.values()):
        for connection in list(publisher.connections):
            if hasattr(connection, 'flush'):
                connection.flush(deadline - time.monotonic())
