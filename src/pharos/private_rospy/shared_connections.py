"""One TCPROS connection to a publisher elsewhere for all nodes of this process that hear it.

Each node is connected by a link, as to a publisher of this process, whose messages come from the
one socket: they are read and deserialized once. The publisher has a single subscriber, the node
that connected first, also after that has left the connection to the others.
"""
import contextlib
import os
import threading
import weakref
from typing import Any, Dict

from pharos.intraprocess.copier import copier_for
from pharos.intraprocess.fanout import ClosedError, Fanout, Latch
from pharos.private_rospy import changes, registration, threads
from pharos.private_rospy.acceptor import brief
from pharos.private_rospy.deadlines import deadline_in
from pharos.private_rospy.lifetime import SIGNAL_LATENCY
from pharos.private_rospy.local_link import End, LocalLink
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.refusals import ask, suits
from pharos.private_rospy.tcpros_connection import NoMessageError, TcprosConnection

CONNECT_TIMEOUT = 10.0  # seconds that one attempt may take, as for connections of one's own
# in what getBusInfo tells of such a connection
SHARED = 'shared by nodes of this process'
QUEUE_BYTES = 64 << 20  # bytes that wait for the callbacks of plain rospy in one node

# (topic, URI of the publisher, message class, '*' for all that take any type) -> the SharedConnection
_shared: Dict[Any, Any] = {}
_reading: Dict[int, Any] = {}  # identifier of a thread -> the SharedConnection that it reads
# by the keys of the first, the _Turn of who makes the connection, which others then share
_turns: Any = weakref.WeakValueDictionary()
_looking = threading.Lock()  # held to look for one there, for two threads would each find none


class SharedConnection:
    """The connection to a publisher elsewhere, and to the links of the nodes that share it what
    rospy's _PublisherImpl is, and the publisher's PrivateRospy.

    :param key: its place among those that there are
    :param connection: a :class:`.TcprosConnection` that has been shaken hands on
    """

    module = rospy
    queue_size = 0  # no publisher waits for plain callbacks: what does not fit is dropped
    queue_bytes = QUEUE_BYTES

    def __init__(self, key, data_class, connection):
        self._key = key
        self.resolved_name, self.uri, _ = key
        self.data_class = data_class
        self.name = connection.header.get('callerid', 'unknown')
        self.bytes = 0  # that have come
        self._connection = connection
        self._publock = threading.RLock()
        self._data = b''  # the message that has just come, serialized
        self._freeze_message = copier_for(data_class).freeze
        self.fanout = Fanout(data_class, self._publock, None, self._freeze)
        self._latch = Latch() if connection.header.get('latching') == '1' else None
        self._thread = None

    def connection_header(self, publisher):
        """What the messages have as their ``_connection_header``: the publisher's."""
        return self._connection.header

    # -- as rospy's _PublisherImpl, to links

    def add_connection(self, end):
        """Send through a link from now on, first what is latched; returns whether the connection is
        there still."""
        with self._publock:
            is_open = not self.fanout.is_closed
            if is_open:
                end.set_cleanup_callback(self.remove_connection)
                end.link.match_receivers()
                self.fanout.set_connections((*self.fanout.connections, end))
                self.fanout.send_latched(end)
                if self._thread is None:  # nothing is read before somebody hears it
                    name = f'{self.resolved_name} of {self.name}'
                    thread = threading.Thread(target=self._read, name=name, daemon=True)
                    threads.start(thread.start, name)
                    self._thread = thread  # where there is none, the next who connects may have it
        if not is_open:
            end.close()
        self.fanout.run()
        return is_open

    def receivers_changed(self, link):
        """The subscription at the other end of a link has other receivers now."""
        with self._publock:
            new = link.match_receivers()
            self.fanout.set_connections(self.fanout.connections)
            if link.sending in self.fanout.connections:
                self.fanout.send_latched(link.sending, new)
        self.fanout.run()

    def remove_connection(self, end):
        """Send through a link no more."""
        with self._publock:
            left = [each for each in self.fanout.connections if each is not end]
            self.fanout.set_connections(left)
        self.close_where_unheard()

    def close_where_unheard(self):
        """Close it if no link is there: what came would wait for who connects next."""
        with self._publock:
            if not self.fanout.connections:
                self._close()

    # -- the socket

    def _read(self):
        """Hand on what comes, until either side closes."""
        _reading[threading.get_ident()] = self
        try:
            while not self.fanout.is_closed:
                self._data = data = self._connection.read_message()
                self.bytes += 4 + len(data)
                message = self.data_class().deserialize(data)
                self.fanout.publish(message, self._latch, runs_inline=False)
                for end in self.fanout.connections:
                    end.link.run_inline()
        except ClosedError:
            pass
        except BaseException as error:
            # that it has gone is told nowhere, for each node tries to connect again
            if isinstance(error, NoMessageError) or not isinstance(error, OSError):
                self._tell_unreadable(error)
        finally:
            del _reading[threading.get_ident()]
            self._close()
            self._connection.close()

    def _tell_unreadable(self, error):
        said = brief(str(error) or repr(error))
        text = f'connection with {self.name} for {self.resolved_name} closed: {said}'
        for end in self.fanout.connections:
            end.link.receiving.is_unreadable = True
            end.link.warn(text)

    def _freeze(self, message):
        """What is kept of it; where it could not be sent on, for deserializing has put seconds of a
        time beyond what the wire takes, what has come."""
        try:
            return self._freeze_message(message)
        except Exception:
            return self._data

    def _close(self):
        with self._publock:
            ends = self.fanout.connections
            self.fanout.close()
        if _shared.get(self._key) is self:
            del _shared[self._key]
        self._connection.shut_down()
        if self._thread is None:  # which closes it
            self._connection.close()
        for end in ends:
            end.close()


class _End(End):
    """The end of a link at a shared connection: to all who ask, the node's own connection."""

    transport_type = 'TCPROS'
    stat_bytes = property(
        lambda self: self.link.publisher.bytes - self._first_byte, lambda self, value: None
    )

    def __init__(self, link, *arguments):
        super().__init__(link, *arguments)
        self._first_byte = link.publisher.bytes

    def get_transport_info(self):
        """As of rospy's connections."""
        return f'TCPROS connection to [{self.endpoint_id}], {SHARED}'


class SharedLink(LocalLink):
    """A link from a connection that is shared to rospy's _SubscriberImpl of one node."""

    end_class = _End

    def run_inline(self):
        """Run the node's delegates that are inline, as the thread of a connection of its own would."""
        if any(inbox.inline for inbox in self.inboxes.values()):
            self._node.lifetime.run_on_behalf(self._node.on_received, self.subscriber.resolved_name)

    def is_of(self, node):
        """Whether it is that node that hears through the link."""
        return self._node is node

    def close(self, end):
        """One end was closed: the other goes too; but that of the connection has no lock that
        others hold meanwhile."""
        if end is self.sending:
            super().close(end)
        else:
            self.close_inboxes()
            self.sending.close()


def connect(node, topic, uri, address):
    """Connect the subscription of a node to the publisher at that URI, through the connection that
    others have, or a new one that others may share.

    :param node: the subscriber's PrivateRospy
    :param address: (host, port) of the publisher
    :returns: as all calls of ROS's slave API: a code (1: done), a text, 0
    """
    subscriber = node.subscriber(topic)
    if subscriber is None:
        return 0, f'the interest of {node.name} in {topic} ends', 0
    try:
        shared, refusal = _connection_for(node, subscriber, uri, address)
    except OSError as error:
        node.connections.connect_later(subscriber, uri, registration.RETRY_DELAY)
        return 0, f'cannot connect to {uri}: {error}', 0
    if refusal is not None:
        node.refusals.publisher_refused(subscriber, uri, *refusal)
        return 0, refusal[0], 0
    node.refusals.publisher_connected(topic, uri)
    link = SharedLink(shared, subscriber, node, shared)
    is_open = link.open()
    shared.close_where_unheard()
    if is_open:
        changes.notify()
        return 1, f'connected to {shared.name}', 0
    link.receiving.close()
    return 0, f'{topic} was closed meanwhile', 0


def _connection_for(node, subscriber, uri, address):
    """``(the SharedConnection, None)``; or where the publisher refuses, ``(None, (what it said, a
    function that returns its connection header))``.

    :raises OSError: if it does not answer, or the node stops while another one makes the connection
    """
    topic, data_class = subscriber.resolved_name, subscriber.data_class
    # Those who have a class of their own of the same md5sum, numpy_msg's for one, or one that cannot
    # read what comes, are not in the way of the others.
    key = topic, uri, '*' if data_class._md5sum == '*' else data_class
    with _turn(node, key):
        shared = _shared.get(key)
        if shared is not None:
            return shared, None
        protocol = node.module.impl.tcpros_pubsub.TCPROSSub(
            topic, data_class, tcp_nodelay=subscriber.tcp_nodelay
        )
        connection = TcprosConnection(
            address, protocol.get_header_fields(), deadline_in(CONNECT_TIMEOUT)
        )
        header = connection.header
        refusal = header.get('error')
        if refusal is None and 'md5sum' not in header:
            connection.close()
            raise ConnectionError('its connection header has no md5sum')
        if refusal is None and not suits(data_class, header['md5sum']):
            refusal = f"its md5sum is {header['md5sum']}"
        if refusal is not None:
            connection.close()
            return None, (refusal, lambda: header if 'md5sum' in header else ask(address, topic))
        _shared[key] = shared = SharedConnection(key, data_class, connection)
        return shared, None


def is_read_here(node, topic):
    """Whether this thread reads what that node hears on the topic through a connection that is
    shared."""
    shared = _reading.get(threading.get_ident())
    return (
        shared is not None
        and shared.resolved_name == topic
        and any(end.link.is_of(node) for end in shared.fanout.connections)
    )


class _Turn:
    """Whose turn it is to make a connection."""

    def __init__(self):
        self.lock = threading.Lock()
        self.failures = 0


@contextlib.contextmanager
def _turn(node, key):
    """Within this, no other node makes the connection.

    :raises OSError: if another one could not, for whom this one has waited; or if the node stops
    """
    with _looking:
        turn = _turns.setdefault(key, _Turn())
    before = turn.failures
    while not turn.lock.acquire(timeout=SIGNAL_LATENCY):
        if node.ended.is_set():
            raise ConnectionAbortedError(f'{node.name} stops')
    try:
        if turn.failures != before:
            raise ConnectionError('another node could not connect to it')
        yield
    except OSError:
        turn.failures += not node.ended.is_set()
        raise
    finally:
        turn.lock.release()


def _forget():
    """In a process that was forked, which has none of the threads that read, or make a
    connection."""
    global _looking
    _looking = threading.Lock()
    _shared.clear()
    _reading.clear()
    _turns.clear()


os.register_at_fork(after_in_child=_forget)
