"""rospy's publishers: they send through INTRAPROCESS too, and latch by value."""
import contextlib
import functools
import math
import struct
import traceback

from pharos.intraprocess.fanout import ClosedError, Fanout, Latch
from pharos.intraprocess.link import links_of
from pharos.private_rospy.patches.table import addition, patch
from pharos.private_rospy.changes import notify
from pharos.private_rospy.logs import StartupLines
from pharos.private_rospy.sender import Sender, Sockets
from pharos.signals import is_from_signal


@patch(
    'rospy.topics',
    '_PublisherImpl.__init__',
    'latches the object of the user, which may change (ros_comm #1481), and one for all publishers'
    ' of a node on the topic (#146)',
)
def init_publisher(self, name, data_class, *, original, module):
    """Have a fan-out, which latches."""
    original(self, name, data_class)
    self.queue_bytes = math.inf  # that wait for a subscriber; an OutputChannel has a limit
    self.fanout = Fanout(data_class, self.publock, Sockets(self, module))
    is_log = self.resolved_name == '/rosout'
    # of all Publishers of rospy on the topic; each OutputChannel has its own
    self.own_latch = StartupLines() if is_log else Latch()
    self.refused = {}  # name of each subscriber that was refused -> what was said


@patch(
    'rospy.topics',
    '_PublisherImpl.publish',
    'keeps a part of a message that does not serialize, which corrupts the stream',
)
def publish(self, message, connection_override=None, *, original, module):
    """Have the fan-out publish.

    rospy calls this with the lock of the publisher; an OutputChannel calls the fan-out itself,
    since each frame costs.
    """
    latch = self.own_latch if self.is_latch else None
    try:
        return self.fanout.publish(message, latch, None, connection_override, runs_inline=False)
    except ClosedError:
        return original(self, message)  # says so
    except struct.error as error:
        raise module.ROSSerializationException(error) from error


@patch('rospy.topics', '_PublisherImpl.release', 'knows no delegate that is to run after publish')
def release(self):
    """Run those that are inline, without the lock; rospy calls this after publish."""
    if self.publock is not None:
        self.publock.release()
    self.fanout.run()


@patch(
    'rospy.topics',
    '_PublisherImpl.add_connection',
    'puts a queue in front of each connection whose thread waits for ever, and leaves open what it'
    ' does not add',
)
def add_connection(self, c, *, node, module):
    """Send what is latched first, through the fan-out, and queue for TCPROS with a thread that
    ends."""
    link = getattr(c, 'link', None)
    with _latched_first(self) as is_open:
        with self.c_lock:
            if link is None and self.queue_size is not None:
                c = Sender(c, self.queue_size, node.start_thread, self.queue_bytes)
            # who counts the connections counts this one only when messages go through it
            others = [each for each in self.connections or () if each.endpoint_id != c.endpoint_id]
            _refresh(self, link, (*others, c))
            is_added = is_open and module._TopicImpl.add_connection(self, c)
            _refresh(self)
        if not is_added:
            c.close()
            return False
        self.fanout.send_latched(c)
    publish_single = functools.partial(self.publish, connection_override=c)
    _tell_listeners(self, node, 'peer_subscribe', self.publish, publish_single)
    notify()
    self.fanout.run()
    return True


@patch(
    'rospy.topics',
    '_PublisherImpl.set_queue_size',
    'takes the last of the sizes that Publishers on the topic ask for, and only for those who'
    ' connect later',
)
def set_queue_size(self, queue_size, *, node):
    """Take the largest, 0 being without limit, for those who are connected, too."""
    asked = [size for size in (self.queue_size, queue_size) if size is not None]
    with self.c_lock:
        self.queue_size = 0 if 0 in asked else max(asked)
        limits = self.queue_size, self.queue_bytes
        connections = []
        for connection in self.connections or ():
            if isinstance(connection, Sender):
                connection.resize(*limits)
            elif not hasattr(connection, 'link'):
                connection = Sender(connection, limits[0], node.start_thread, limits[1])
            connections.append(connection)
        self.connections = connections
        _refresh(self)


@addition('rospy.topics', '_PublisherImpl.receivers_changed', 'links call it')
def receivers_changed(self, link):
    """The subscription at the other end of a link has other receivers now."""
    with _latched_first(self) as is_open:
        if not is_open:
            return
        new = _refresh(self, link)
        # otherwise it is just being added, and that sends it
        if link.sending in (self.connections or ()):
            self.fanout.send_latched(link.sending, new)
    self.fanout.run()


@patch(
    'rospy.topics',
    '_TopicImpl._remove_connection',
    'goes by the number of a descriptor, which another connection may have by then: that one is'
    ' removed',
)
def remove_from_connections(self, connections, c):
    """Go by the connection, or the one that a Sender is in front of."""
    with contextlib.suppress(Exception):
        c.close()
    for each in tuple(connections):
        if each is c or getattr(each, '_connection', None) is c:
            connections.remove(each)
            number = each.fileno()
            if all(other.fileno() != number for other in connections):
                self.connection_poll.remove_fd(number)


@patch(
    'rospy.topics', '_PublisherImpl.remove_connection', 'trips over listeners that are gone by then'
)
def remove_connection(self, c, *, node, module):
    """Tell the fan-out, and the listeners that there are."""
    module._TopicImpl.remove_connection(self, c)
    _refresh(self)
    _tell_listeners(self, node, 'peer_unsubscribe', len(self.connections or ()))
    notify()


@patch('rospy.topics', '_PublisherImpl.close', 'knows no fan-out')
def close_publisher(self, *, original):
    """Close it, too."""
    original(self)
    self.fanout.close()
    notify()


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
            for link in links_of(publisher.connections):
                stack.enter_context(link.unbounded())
            stack.enter_context(lock)
        yield lock is not None


def _tell_listeners(publisher, node, method, *arguments):
    """Have a listener fail alone: who connects may be the thread of another node."""
    for listener in publisher.subscriber_listeners or ():
        try:
            getattr(listener, method)(publisher.resolved_name, *arguments)
        except BaseException as error:
            if is_from_signal(error):
                raise
            node.module.logerr('bad listener: %s\n%s', listener, traceback.format_exc())


def _refresh(publisher, link=None, connections=None):
    """Have the fan-out go by the connections, by default those that there are, and a link by the
    receivers; returns its new inboxes."""
    with publisher.c_lock:
        new = link.match_receivers() if link else []
        publisher.fanout.set_connections(connections or publisher.connections or ())
        return new
