"""The way of a message from a publisher, through rospy's topics, to all who are interested."""
import functools
import struct
import threading
import time

from pharos.dispatcher import BURST
from pharos.private_rospy import copier
from pharos.private_rospy.sender import Sender

EARLY = 2.0    # seconds after the start in which log lines are kept for listeners that connect later
_changed = threading.Condition()    # notified whenever a publisher of this process gains or loses a connection
_clock = time.perf_counter


def mend_publisher(module):
    """rospy.topics._PublisherImpl: sends through INTRAPROCESS too; latches by value, for each of its publishers.

    rospy latches the user's object, which may change (ros_comm #1481), and one for all publishers of a node on the
    topic (#146). After a message that does not serialize, its buffer keeps a part that corrupts the stream.
    """
    publisher, base = module._PublisherImpl, module._TopicImpl
    init, write = publisher.__init__, publisher.publish

    def __init__(self, name, data_class):
        init(self, name, data_class)
        self._copier = copier.copier_for(data_class)
        self._latched = {}    # publisher -> the last message it latched, frozen
        self._early = _EarlyLines() if self.resolved_name == '/rosout' else None
        self._last = 0.0      # when the last message was put into an inbox
        self.refresh()
    publisher.__init__ = __init__

    def refresh(self):
        """Sort the connections out, whenever they change: by how a message goes to them."""
        with self.c_lock:
            links = [c.link for c in self.connections if c.transport_type == 'INTRAPROCESS']
            inboxes = [inbox for link in links for inbox in list(link.inboxes.values())]
            self._remote = [c for c in self.connections if c.transport_type != 'INTRAPROCESS']
            self._inboxes = inboxes
            self._dispatchers = _dispatchers(inboxes)
            self._inline = list({inbox.dispatcher for inbox in inboxes if inbox.inline})
    publisher.refresh = refresh

    def publish(self, message, connection_override=None, by=None, to=None):
        """rospy calls this with the publisher's lock, an OutputChannel without, since each frame costs.

        :param by: the channel whose message it is, None: a rospy Publisher's
        :param to: name of the only node that is to get it, None: all
        """
        lock = self.publock
        if lock is None or self.closed:
            return write(self, message)    # says so
        with lock:
            inboxes, remote, dispatchers = self._inboxes, self._remote, self._dispatchers
            if connection_override is not None:
                link = getattr(connection_override, 'link', None)
                inboxes, remote = (list(link.inboxes.values()), ()) if link else ((), [connection_override])
                dispatchers = _dispatchers(inboxes)
            elif to is not None:
                inboxes = [inbox for inbox in inboxes if inbox.channel.node.name == to]
                remote = [connection for connection in remote if connection.endpoint_id == to]
                dispatchers = _dispatchers(inboxes)
            latch = self.is_latch if by is None else by.latch
            if not (inboxes or remote or latch):
                return False
            self.seq += 1
            if getattr(message.__class__, '_has_header', False):
                message.header.seq = self.seq
                if message.header.frame_id is None:
                    message.header.frame_id = '0'
            if inboxes or latch:
                try:
                    frozen = self._copier.freeze(message)
                except struct.error as error:
                    raise module.ROSSerializationException(error) from error
            data = self._serialized(message, self.seq) if remote else None
            if latch:
                self._latched[by] = frozen
                if self._early is not None:
                    self._early.add(frozen)
            for inbox in inboxes:
                inbox.put(message if inbox.shared else frozen)
            woken = None
            for dispatcher in dispatchers:
                if dispatcher.idle:
                    dispatcher.wake()
                    woken = dispatcher
            if woken is not None:
                last, self._last = self._last, _clock()
                if self._last - last > BURST:
                    woken.give_way()
            if remote:
                self._write(data, remote)
        if by is not None:
            for dispatcher in self._inline:
                dispatcher.run()
        return True
    publisher.publish = publish

    def release(self):
        """rospy calls this after publish; a delegate that is inline runs without the lock, which others may wait for."""
        if self.publock is not None:
            self.publock.release()
        for dispatcher in self._inline:
            dispatcher.run()
    publisher.release = release

    def _serialized(self, message, seq):
        buffer = self.buff
        try:
            module.serialize_message(buffer, seq, message)
            return buffer.getvalue()
        finally:
            if not buffer.closed:
                buffer.seek(0)
                buffer.truncate()
    publisher._serialized = _serialized

    def _write(self, data, connections):
        self.message_data_sent += len(data)
        for connection in connections:
            try:
                connection.write_data(data)
            except Exception as error:    # the connection broke
                module.logdebug('publisher connection to [%s] terminated: %s' % (connection.endpoint_id, error))
                connection.close()
    publisher._write = _write

    def send_latched(self, inboxes):
        """Put what is latched into new inboxes."""
        for inbox in inboxes:
            for frozen in self._early or self._latched.values():
                inbox.put(self._copier.thaw(frozen) if inbox.shared else frozen)
        for dispatcher in _dispatchers(inboxes):
            if dispatcher.idle:
                dispatcher.wake()

    def write_latched(self, connection):
        """Write what is latched to a new TCPROS connection."""
        for frozen in self._early or self._latched.values():
            message = self._copier.thaw(frozen)
            self._write(self._serialized(message, message.header.seq if hasattr(message, 'header') else 0), [connection])

    def add_connection(self, connection):
        """rospy's, but for the latch; and no queue in front of a link, nor one whose thread waits for ever.

        rospy leaves open what it does not add.
        """
        link = getattr(connection, 'link', None)
        if link is None and self.queue_size is not None:
            connection = Sender(connection, self.queue_size)
        lock = self.publock
        if lock is None:    # closed meanwhile
            connection.close()
            return False
        with lock:    # so that the latched messages come before what is published now
            if not base.add_connection(self, connection):
                connection.close()
                return False
            if link:
                send_latched(self, list(link.inboxes.values()))
            else:
                write_latched(self, connection)
            self.refresh()
        for listener in self.subscriber_listeners or ():
            listener.peer_subscribe(self.resolved_name, self.publish,
                                    functools.partial(self.publish, connection_override=connection))
        _notify()
        for dispatcher in self._inline:
            dispatcher.run()
        return True
    publisher.add_connection = add_connection

    def channels_changed(self, link):
        """The subscription at the other end of a link has other channels now."""
        lock = self.publock
        if lock is None:
            return
        with lock:
            send_latched(self, link.match_channels())
            self.refresh()
        for dispatcher in self._inline:
            dispatcher.run()
    publisher.channels_changed = channels_changed

    def remove_connection(self, connection):
        base.remove_connection(self, connection)
        self.refresh()
        for listener in self.subscriber_listeners or ():    # rospy trips over None: closed meanwhile
            listener.peer_unsubscribe(self.resolved_name, len(self.connections))
        _notify()
    publisher.remove_connection = remove_connection

    def close(self):
        shut(self)
        self._remote = self._inboxes = self._dispatchers = self._inline = ()
        _notify()
    shut, publisher.close = publisher.close, close


def _dispatchers(inboxes):
    """Those whose threads run what is put into the inboxes."""
    return list({inbox.dispatcher for inbox in inboxes if not inbox.inline})


class _EarlyLines:
    """The first log lines of a node: its listeners connect a tenth of a second later, and would miss them."""

    def __init__(self):
        self._until = time.monotonic() + EARLY
        self._lines = []

    def add(self, line):
        if time.monotonic() < self._until:
            self._lines.append(line)
        else:
            self._lines = ()

    def __iter__(self):
        return iter(self._lines)

    def __bool__(self):
        return bool(self._lines) and time.monotonic() < self._until


def forget_latch(endpoint, channel):
    """A channel closes, and what it latched goes with it."""
    endpoint.impl._latched.pop(channel, None)


def _notify():
    with _changed:
        _changed.notify_all()


def wait_until(predicate, timeout):
    """Wait until ``predicate()``, which speaks of connections of publishers of this process, holds.

    :param timeout: seconds, None: no limit
    """
    with _changed:
        return _changed.wait_for(predicate, None if timeout is None else max(0.0, timeout))
