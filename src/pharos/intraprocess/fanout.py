"""The way of a message from a publisher to all who are interested."""
import io
import struct
import time

from pharos.intraprocess.dispatcher import BURST
from pharos.intraprocess import copier, sharing

EARLY = 2.0  # seconds after the start in which log lines are kept for listeners that connect later
_clock = time.perf_counter


class Fanout:
    """Where the messages of one node on one topic go, through INTRAPROCESS and TCPROS, and what is
    latched.

    :param publisher: rospy's _PublisherImpl
    :param module: the rospy.topics that it is of
    """

    # a message that comes alone meets cold caches: all that it needs lies together
    __slots__ = (
        '_lock',
        '_closed',
        '_seq',
        '_has_header',
        '_freeze',
        '_ways',
        '_last',
        '_size',
        '_mark',
        '_publisher',
        '_module',
        '_thaw',
        '_buffer',
        '_latches',
        '_early',
        'connections',
    )

    def __init__(self, publisher, module):
        self._publisher, self._module = publisher, module
        self._lock, self._closed, self._seq = publisher.publock, False, 0
        self._has_header = getattr(publisher.data_class, '_has_header', False)
        self._freeze, self._thaw, self._size = copier.copier_for(publisher.data_class)[:3]
        self._buffer = io.BytesIO()
        self._latches = {}  # channel, None: rospy's Publishers -> its Latch
        self._early = _EarlyLines() if publisher.resolved_name == '/rosout' else None
        self._last = 0.0  # when the last message woke a dispatcher
        self.set_connections(())

    def set_connections(self, connections):
        """Sort the connections out, whenever they change: by how a message goes to them."""
        inboxes, remote = _split(connections)
        inline = list({inbox.dispatcher for inbox in inboxes if inbox.inline})
        mark = None  # of the messages that receivers share
        if any(inbox.shared for inbox in inboxes):
            mark = sharing.Mark(links_of(connections)[0].header)
        self._mark = mark
        # all at once: somebody may be publishing
        self._ways = inboxes, remote, _dispatchers(inboxes), inline, mark
        # those through which a message goes that is published from now on
        self.connections = tuple(connections)

    def publish(self, message, by=None, to=None, connection=None):
        """Send a message to all; returns whether there is anybody.

        :param by: the channel whose message it is; None: a rospy Publisher's, which calls
            :meth:`run` when it has released the lock
        :param to: name of the only node that is to get it, None: all
        :param connection: the only connection through which it is to go, None: all
        """
        with self._lock:
            if self._closed:
                raise self._module.ROSException('publish() to a closed topic')
            inboxes, remote, dispatchers, inline, mark = self._ways
            if to is not None or connection is not None:
                inboxes, remote = self._only(to, connection)
                dispatchers = _dispatchers(inboxes)
                mark = mark if any(inbox.shared for inbox in inboxes) else None
            latch = self._publisher.is_latch if by is None else by.latch
            if not (inboxes or remote or latch):
                return False
            self._seq += 1
            if self._has_header and message._md5sum != '*':  # AnyMsg has none
                if sharing.is_held(message.header):
                    message = sharing.with_own_header(message)
                message.header.seq = self._seq
                if message.header.frame_id is None:
                    message.header.frame_id = '0'
            if inboxes or latch:
                try:
                    frozen = self._freeze(message)
                except struct.error as error:
                    raise self._module.ROSSerializationException(error) from error
            data = self._serialized(message, self._seq) if remote else None
            if latch:
                self._latch(by, frozen, to or connection and connection.endpoint_id)
            if mark is not None:
                message = mark.put_on(message)
            if inboxes:
                size = self._size_of(message, frozen) if self._size else 0
                for inbox in inboxes:
                    inbox.put(message if inbox.shared else frozen, size)
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
            for dispatcher in inline:
                dispatcher.run()
        return True

    def _size_of(self, message, frozen):
        return len(frozen) if type(frozen) is bytes else self._size(message)

    def run(self):
        """Run the delegates that are inline, without the lock, which others may wait for."""
        for dispatcher in self._ways[3]:
            dispatcher.run()

    def reaches(self, name):
        """Whether the node of that name gets what is sent to it alone."""
        return any(self._only(name, None))

    def _only(self, name, connection):
        """The inboxes and the TCPROS connections of a node, or of a connection."""
        if connection is not None:
            return _split([connection])
        return _split([other for other in self._publisher.connections if other.endpoint_id == name])

    def _serialized(self, message, seq):
        buffer = self._buffer
        try:
            self._module.serialize_message(buffer, seq, message)
            return buffer.getvalue()
        finally:  # what does not serialize must leave nothing that would corrupt the stream
            buffer.seek(0)
            buffer.truncate()

    def _write(self, data, connections):
        self._publisher.message_data_sent += len(data)
        for connection in connections:
            try:
                connection.write_data(data)
            except Exception as error:  # the connection broke
                self._module.logdebug(
                    f'publisher connection to [{connection.endpoint_id}] terminated: {error}'
                )
                connection.close()

    def _latch(self, by, frozen, receiver):
        if by not in self._latches:
            self._latches[by] = Latch() if by is None else by.latched
        self._latches[by].keep(frozen, receiver)
        if self._early is not None:
            self._early.add(frozen)

    def _latched_for(self, receiver):
        """What is latched for the node of that name, frozen."""
        latches = tuple(self._latches.values())  # a channel may close meanwhile
        return self._early or [frozen for latch in latches for frozen in latch.of(receiver)]

    def send_latched(self, inboxes, receiver):
        """Put what is latched into new inboxes; :meth:`run` is to be called when the lock is
        released.

        :param receiver: the name of the node whose inboxes they are
        """
        if self._publisher.is_latch:
            with self._lock:
                for frozen in self._latched_for(receiver):
                    self._put_latched(frozen, inboxes)

    def _put_latched(self, frozen, inboxes):
        message = self._thaw(frozen)
        size = self._size_of(message, frozen) if self._size else 0
        for inbox in inboxes:
            inbox.put(self._mark.put_on(self._thaw(frozen)) if inbox.shared else frozen, size)
        for dispatcher in _dispatchers(inboxes):
            if dispatcher.idle:
                dispatcher.wake()

    def write_latched(self, connection):
        """Write what is latched to a new TCPROS connection."""
        if self._publisher.is_latch:
            with self._lock:
                for frozen in self._latched_for(connection.endpoint_id):
                    self._write_latched(frozen, connection)

    def _write_latched(self, frozen, connection):
        message = self._thaw(frozen)
        seq = message.header.seq if self._has_header else 0
        self._write(self._serialized(message, seq), [connection])

    def resume(self, channel):
        """A channel opens again: who has connected by now gets what it latched before, too.

        :meth:`run` is to be called afterwards.
        """
        with self._lock:
            self._latches[channel] = channel.latched
            for connection in self._publisher.connections:
                for frozen in channel.latched.of(connection.endpoint_id):
                    link = getattr(connection, 'link', None)
                    if link is None:
                        self._write_latched(frozen, connection)
                    else:
                        self._put_latched(frozen, link.all_inboxes())

    def forget(self, channel):
        """A channel closes, and what it latched goes with it."""
        self._latches.pop(channel, None)

    def close(self):
        """Nothing is sent any more."""
        self._closed = True
        self.set_connections(())


class Latch:
    """What one channel sent last, for those who come late; it outlives the run of the node.

    What went to one node alone is for that node alone: for it, the last message is another one than
    for all others.
    """

    def __init__(self):
        self._to_all = ()  # the message, frozen, if there is one
        self._to_one = {}  # node name -> likewise, where that is newer

    def keep(self, frozen, receiver):
        """Keep a message that was sent to the node of that name, None: to all."""
        if receiver is None:
            self._to_all, self._to_one = (frozen,), {}
        else:
            self._to_one[receiver] = (frozen,)

    def of(self, receiver):
        """The last message for the node of that name, frozen; none or one."""
        return self._to_one.get(receiver, self._to_all)


def links_of(connections):
    """The links among the connections of a publisher or a subscription, as rospy has them."""
    return [
        connection.link for connection in connections if connection.transport_type == 'INTRAPROCESS'
    ]


def _split(connections):
    """The inboxes behind those that are INTRAPROCESS, and the others."""
    inboxes = [inbox for link in links_of(connections) for inbox in link.all_inboxes()]
    return inboxes, [
        connection for connection in connections if connection.transport_type != 'INTRAPROCESS'
    ]


def _dispatchers(inboxes):
    """Those whose threads run what is put into the inboxes."""
    return list({inbox.dispatcher for inbox in inboxes if not inbox.inline})


class _EarlyLines:
    """The first log lines of a node: its listeners connect a tenth of a second later, and would
    miss them."""

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
