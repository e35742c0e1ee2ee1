"""rospy's publishers, mended: they send through INTRAPROCESS too, and latch by value."""
import contextlib
import functools
import math
import os
import threading

from pharos.intraprocess.fanout import Fanout, links_of
from pharos.private_rospy.lifetime import Interruption
from pharos.private_rospy.sender import Sender

# notified whenever a publisher of this process gains or loses a connection
_changed = threading.Condition()


def mend_publisher(module, start_thread):
    """rospy.topics._PublisherImpl.

    rospy latches the user's object, which may change (ros_comm #1481), and one for all publishers
    of a node on the topic (#146). After a message that does not serialize, its buffer keeps a part
    that corrupts the stream.
    """
    publisher, base = module._PublisherImpl, module._TopicImpl
    init, write, shut = publisher.__init__, publisher.publish, publisher.close
    publisher.queue_bytes = math.inf  # that wait for a subscriber; an OutputChannel has a limit

    def __init__(self, name, data_class):
        init(self, name, data_class)
        self.fanout = Fanout(self, module)

    publisher.__init__ = __init__

    def publish(self, message, connection_override=None):
        """rospy calls this with the publisher's lock; an OutputChannel calls the fan-out's, since
        each frame costs."""
        if self.closed:
            return write(self, message)  # says so
        return self.fanout.publish(message, connection=connection_override)

    publisher.publish = publish

    def release(self):
        """rospy calls this after publish."""
        if self.publock is not None:
            self.publock.release()
        self.fanout.run()

    publisher.release = release

    def add_connection(self, connection):
        """rospy's, but for the latch; and no queue in front of a link, nor one whose thread waits
        for ever.

        rospy leaves open what it does not add.
        """
        link = getattr(connection, 'link', None)
        if link is None and self.queue_size is not None:
            connection = Sender(connection, self.queue_size, start_thread, self.queue_bytes)
        with _latched_first(self) as is_open:
            if not (is_open and self._add(connection, link)):
                connection.close()
                return False
            if link:
                self.fanout.send_latched(link.all_inboxes(), connection.endpoint_id)
            else:
                self.fanout.write_latched(connection)
        for listener in self.subscriber_listeners or ():
            listener.peer_subscribe(
                self.resolved_name,
                self.publish,
                functools.partial(self.publish, connection_override=connection),
            )
        notify()
        self.fanout.run()
        return True

    publisher.add_connection = add_connection

    def _add(self, connection, link):
        """Who counts the connections counts this one only when messages go through it."""
        lock = self.c_lock
        if lock is None:  # closed meanwhile
            return False
        with lock:
            if not base.add_connection(self, connection):
                return False
            # receivers may have come since the link was made, and have not seen it yet
            _refresh(self, link)
            return True

    publisher._add = _add

    def channels_changed(self, link):
        """The subscription at the other end of a link has other channels now."""
        with _latched_first(self) as is_open:
            if not is_open:
                return
            new = _refresh(self, link)
            # otherwise it is just being added, and that sends it
            if link.sending in (self.connections or ()):
                self.fanout.send_latched(new, link.sending.endpoint_id)
        self.fanout.run()

    publisher.channels_changed = channels_changed

    def remove_connection(self, connection):
        base.remove_connection(self, connection)
        _refresh(self)
        for listener in self.subscriber_listeners or ():  # rospy trips over None: closed meanwhile
            listener.peer_unsubscribe(self.resolved_name, len(self.connections))
        notify()

    publisher.remove_connection = remove_connection

    def close(self):
        shut(self)
        self.fanout.close()
        notify()

    publisher.close = close


@contextlib.contextmanager
def _latched_first(publisher):
    """Within this, nothing is published that would come before what is latched; gives whether the
    publisher is open.

    One that does not latch goes on: who comes need not wait for a publisher that itself waits for a
    slow subscriber, since it has no queue. One that latches does not wait for those of this process
    meanwhile.
    """
    lock = publisher.publock
    with contextlib.ExitStack() as stack:
        if lock is not None and publisher.is_latch:
            for link in links_of(publisher.connections or ()):
                stack.enter_context(link.unbounded())
            stack.enter_context(lock)
        yield lock is not None


def _refresh(publisher, link=None):
    """Have the fan-out go by the connections, and a link by the receivers, that there are; returns
    its new inboxes."""
    lock = publisher.c_lock
    if lock is None:  # closed meanwhile
        return []
    with lock:
        new = link.match_receivers() if link else []
        publisher.fanout.set_connections(publisher.connections or ())
        return new


def notify():
    """Have those who wait look again."""
    with _changed:
        _changed.notify_all()


def wait_until(predicate, timeout, lifetime):
    """Wait until ``predicate()``, which speaks of connections of publishers of this process, holds.

    :param timeout: seconds, None: no limit
    :param lifetime: of the node with whose stop the wait ends
    """
    with Interruption(notify, lifetime) as stop, _changed:
        _changed.wait_for(
            lambda: stop.came or predicate(), None if timeout is None else max(0.0, timeout)
        )


def _forget():
    """In a process that was forked, when another thread may have held the lock."""
    global _changed
    _changed = threading.Condition()


os.register_at_fork(after_in_child=_forget)
