"""How the channels of a node are connected through its rospy, and to the nodes of this process."""
import contextlib
import os
import select
import threading
from typing import Any, Dict

from pharos.errors import NodeStoppedError
from pharos.private_rospy.addresses import is_same_master
from pharos.private_rospy.names import Resolved
from pharos.private_rospy import changes, departures, registration, shared_connections, threads
from pharos.private_rospy.deadlines import time_limit
from pharos.private_rospy.descriptors import ForConnections
from pharos.private_rospy.lifetime import Interruption
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.proxies import ServerProxy, interruption
from pharos.private_rospy.registration import UNREGISTER_TIMEOUT, registered
from pharos.private_rospy.socket_callback import SocketCallback

TCPROS = 'TCPROS'  # as ROS calls it

_running: Dict[str, Any] = {}  # URI -> the PrivateRospy that runs there, in this process


def local_nodes():
    """The PrivateRospys of the running nodes of this process."""
    return list(_running.values())


class Connections:
    """The channels of one :class:`~.instance.PrivateRospy`."""

    def __init__(self, node):
        self._node = node
        self._receivers = {}  # topic -> those that :meth:`subscribe` has connected to it
        self._lock = threading.Lock()  # held to change that
        # topic -> URIs, of which the master told a new publisher
        self.subscribers_at_registration = {}
        # topics of which the log says that subscribers did not connect in time
        self.told_late = set()
        self._descriptors = ForConnections(node)
        self._reading = {}  # identifier of a thread -> the topic whose socket it reads
        # (topic, URI) of each publisher just being connected to -> whether somebody asked again
        self._connecting = {}

    def announce(self):
        """The node runs: its neighbours may connect to it."""
        _running[self._node.uri] = self._node
        departures.watch(self._node)
        if self._node.ended.is_set():  # a node that ends at once may have been withdrawn before
            self.withdraw()

    def withdraw(self):
        """The node stops."""
        departures.ignore(self._node)
        if _running.get(self._node.uri) is self._node:
            del _running[self._node.uri]

    # -- channels

    def subscribe(self, receiver, inbox, timeout):
        """rospy's Subscriber for a receiver, connected to the publishers in this process.

        The master's word of them takes its time.

        :param receiver: a :class:`pharos.intraprocess.inbox.Receiver`
        :param inbox: of the receiver, for what comes through sockets
        :param timeout: seconds that all may take
        :raises MasterUnreachableError: if it cannot be registered
        :raises NodeStoppedError: if the node stops meanwhile
        :raises PharosError: if there are no descriptors for a connection to a publisher
        """
        topic, callback = receiver.topic, SocketCallback(receiver, inbox, self._node)
        self._descriptors.check(topic)
        with self._lock:
            self._receivers[topic] = (*self.receivers_on(topic), receiver)
        endpoint = None
        try:
            # rospy's queue_size would drop without counting; the inbox has one that counts
            endpoint = registered(
                lambda: self._node.module.Subscriber(
                    Resolved(topic),
                    receiver.message_class,
                    callback,
                    tcp_nodelay=True,
                ),
                _unregister,
                timeout,
            )
            self._connect_to_neighbours(topic, timeout)
        except BaseException as error:
            self._forget(receiver)
            if endpoint is not None:
                _unregister(endpoint)
            # rospy's own words for it; what derives from it says something else
            if type(error) is rospy.ROSException and self._node.ended.is_set():
                raise NodeStoppedError(
                    f'{self._node.name} stopped while it opened {topic}: start() it first'
                ) from error
            raise
        return endpoint

    def _connect_to_neighbours(self, topic, timeout):
        publishers = [other for other in self._neighbours() if other.publisher(topic)]
        for other in publishers:
            self.connect(topic, other.uri, is_local=True)
        name, refuses = self._node.name, self._node.refusals.refuses
        self._node.wait_until(
            lambda: all(
                other.connections.sends_to(name, topic) or refuses(topic, other.uri)
                for other in publishers
            ),
            timeout,
        )

    def unsubscribe(self, receiver, endpoint):
        """End what :meth:`subscribe` began."""
        self._forget(receiver)
        _unregister(endpoint)

    def _forget(self, receiver):
        topic = receiver.topic
        with self._lock:
            others = tuple(other for other in self.receivers_on(topic) if other is not receiver)
            self._receivers[topic] = others

    def advertise(self, topic, message_class, latch, timeout, queue_size, queue_bytes):
        """rospy's Publisher; subscribers in this process are told at once.

        rosmaster tells them in steps of 0.1 s.

        :param latch: the :class:`pharos.intraprocess.fanout.Latch` to go on with, None: none
        :param timeout: seconds that the master may take
        :param queue_size: messages that wait for a slow subscriber elsewhere,
        :param queue_bytes: and their bytes
        :raises MasterUnreachableError: if it cannot be registered
        """
        endpoint = registered(
            lambda: self._node.module.Publisher(
                Resolved(topic),
                message_class,
                latch=latch is not None,
                queue_size=queue_size,
                tcp_nodelay=True,
            ),
            _unregister,
            timeout,
        )
        fanout = endpoint.impl.fanout
        endpoint.impl.queue_bytes = queue_bytes
        endpoint.impl.set_queue_size(queue_size)  # again, with these bytes
        if latch is not None:
            fanout.resume(latch)
            fanout.run()
        try:
            for other in self._neighbours():
                if other.subscriber(topic):
                    other.connections.connect(topic, self._node.uri, is_local=True)
        except BaseException:
            self.unadvertise(endpoint, latch)
            raise
        return endpoint

    def known_subscribers(self, topic):
        """Names of the nodes that the master knew to be interested when this one registered as a
        publisher.

        None where the master must be asked: of others it told the URI alone, and of a second
        channel nothing.
        """
        nodes = [_running.get(uri) for uri in self.subscribers_at_registration.pop(topic, [None])]
        return None if None in nodes else {node.name for node in nodes}

    @staticmethod
    def unadvertise(endpoint, latch):
        """End what :meth:`advertise` began."""
        endpoint.impl.fanout.forget(latch)
        _unregister(endpoint)

    @staticmethod
    def of(endpoint):
        """``[(peer node name, transport)]`` of a rospy Publisher or Subscriber.

        rospy looks twice a second for subscribers that have left; until then they count as
        connected (ros_comm #927).
        """
        topic = endpoint.impl
        if topic is None:
            return []
        is_publisher = endpoint.reg_type == 'pub'
        connections = topic.fanout.connections if is_publisher else topic.connections
        return [
            (_peer(connection), connection.transport_type)
            for connection in connections
            # a subscriber's thread sees the end by itself
            if not (connection.done or is_publisher and _has_left(connection))
        ]

    @staticmethod
    def reaches(endpoint, name):
        """Whether a rospy Publisher is connected to the node of that name."""
        topic = endpoint.impl  # None from the moment on in which another thread closes it
        return topic is not None and topic.fanout.reaches(name)

    @staticmethod
    def is_closed(endpoint):
        """Whether rospy has closed a Publisher or Subscriber, as it does when the node stops."""
        topic = endpoint.impl
        return topic is None or topic.closed

    # -- links

    def receivers_on(self, topic):
        """The receivers that :meth:`subscribe` has connected to the topic."""
        return self._receivers.get(topic, ())

    def connect(self, topic, uri, is_local=False):
        """Connect the subscription to the publisher at that URI, unless it is connected.

        Who asks while that is under way need not wait: where it fails, it is tried once more, for
        what was no publisher a moment ago may be one now.

        :param is_local: that is a node of this process, and the caller waits for the connection
        :returns: as all calls of ROS's slave API: a code (1: done), a text, 0
        :raises NoThreadError: if it is local, and the system gives no thread that would answer
        :raises PharosError: if it is local, and there are no descriptors to connect
        """
        key = topic, uri
        with self._lock:
            if key in self._connecting:
                self._connecting[key] = True
                return 1, f'connecting to {uri} already', 0
            self._connecting[key] = False
        while True:
            # A publisher elsewhere that hangs is not waited for when the node stops.
            waits = None if is_local else Interruption(lifetime=self._node.lifetime)
            try:
                with waits or contextlib.nullcontext():
                    answer = self._negotiate(topic, uri, is_local)
            except BaseException:  # else nobody would ever connect to it again
                with self._lock:
                    del self._connecting[key]
                raise
            with self._lock:
                if answer[0] == 1 or not self._connecting[key]:
                    del self._connecting[key]
                    break
                self._connecting[key] = False
        subscriber = self._node.subscriber(topic)
        if subscriber is not None:
            if answer[0] == 1:
                subscriber.out_of_reach.discard(uri)
            else:
                subscriber.out_of_reach.add(uri)
            changes.notify()
        return answer

    def connect_later(self, subscriber, uri, delay):
        """Connect a subscription to the publisher at that URI in so many seconds, unless it, or the
        node, ends before."""
        self._descriptors.tell_lack(subscriber.resolved_name)
        self._node.start_thread(self._connect_later, (subscriber, uri, delay), 'reconnect')

    def _connect_later(self, subscriber, uri, delay):
        if not self._node.ended.wait(delay) and not subscriber.closed:
            self.connect(subscriber.resolved_name, uri)

    def _negotiate(self, topic, uri, is_local):
        """What rospy's ROSHandler._connect_topic does, for as long as the node is interested."""
        while True:
            handler, subscriber = self._node.handler, self._node.subscriber(topic)
            if handler is None or subscriber is None or self._node.ended.is_set():
                return 0, f'{self._node.name} or its interest in {topic} ends', 0
            if subscriber.has_connection(uri):
                return 1, f'connected to {uri} already', 0
            transports = tuple(handler.protocol_handlers or ())
            offered = [each for transport in transports for each in transport.get_supported()]
            try:
                proxy = ServerProxy(uri)
                with contextlib.nullcontext() if is_local else interruption(proxy):
                    code, text, chosen = proxy.requestTopic(self._node.name, topic, offered)
                return (code, text, 0) if code <= 0 else self._open(transports, topic, uri, chosen)
            except ConnectionRefusedError as error:
                return 0, str(error), 0
            except Exception as error:  # whatever it answered, or what reading it lacks
                self._give_up(topic, uri)
                if is_local:  # else this goes on for as long as there is nothing to answer with
                    threads.check(f'{self._node.name} to connect to {topic}')
                    self._descriptors.check(topic)
                else:
                    self._descriptors.tell_lack(topic, error)
                self._node.ended.wait(registration.RETRY_DELAY)
            if uri not in subscriber.publishers:
                return 0, f'the master knows no publisher of {topic} at {uri}', 0

    def _open(self, transports, topic, uri, chosen):
        for transport in transports:
            if chosen and transport.supports(chosen[0]):
                if chosen[0] == TCPROS and self._node.settings.shares_connections:
                    return shared_connections.connect(self._node, topic, uri, tuple(chosen[1:]))
                try:
                    return transport.create_transport(topic, uri, chosen)
                except AttributeError:  # rospy's, where there is no subscription any more
                    return 0, f'the interest of {self._node.name} in {topic} ends', 0
        return 0, f'{uri} chose {chosen}, which was not offered', 0

    def _give_up(self, topic, uri):
        """Have no connection to that publisher, of one that nobody reads."""
        subscriber = self._node.subscriber(topic)
        for connection in tuple(subscriber and subscriber.connections or ()):
            if connection.endpoint_id == uri:
                connection.is_given_up = True
                connection.close()

    def sends_to(self, name, topic):
        """Whether the node, if it publishes on the topic at all, is connected to the subscriber of
        that name."""
        publisher = self._node.publisher(topic)
        return publisher is None or any(
            connection.endpoint_id == name and not _has_left(connection)
            for connection in publisher.fanout.connections
        )

    def hears(self, topic):
        """Whether the node is connected to a publisher that suits it."""
        subscriber = self._node.subscriber(topic)
        return any(
            getattr(connection, 'is_heard', False)
            for connection in (subscriber and subscriber.connections or ())
        )

    def has_heard_from_publishers(self, topic):
        """Whether it is, or none of those that the master has named will suit it."""
        subscriber, refuses = self._node.subscriber(topic), self._node.refusals.refuses
        return (
            subscriber is None
            or self.hears(topic)
            or all(
                uri in subscriber.out_of_reach or refuses(topic, uri)
                for uri in subscriber.publishers
            )
        )

    @contextlib.contextmanager
    def reading(self, topic):
        """Within this, the thread reads the socket of a connection to a publisher of the topic."""
        self._reading[threading.get_ident()] = topic
        try:
            yield
        finally:
            del self._reading[threading.get_ident()]

    def is_read_here(self, topic):
        """Whether this thread reads what comes on the topic, and runs a delegate meanwhile."""
        return self._reading.get(threading.get_ident()) == topic or shared_connections.is_read_here(
            self._node, topic
        )

    @staticmethod
    def local_node_at(uri):
        """The PrivateRospy of this process at that URI, None if there is none."""
        return _running.get(uri)

    def _neighbours(self):
        """The nodes of this process at the same master, this one among them."""
        master = self._node.settings.master_url
        return [
            other for other in local_nodes() if is_same_master(other.settings.master_url, master)
        ]


# a process that was forked has none of these nodes, whose sockets are its parent's
os.register_at_fork(after_in_child=_running.clear)


def _unregister(endpoint):
    with time_limit(UNREGISTER_TIMEOUT):
        endpoint.unregister()


def _has_left(connection):
    """Whether the subscriber at the other end of a publisher's connection has closed it."""
    if hasattr(connection, 'link'):  # whose end here is closed somewhat later
        return connection.link.is_closed
    poll = select.poll()
    try:
        poll.register(connection.socket, select.POLLRDHUP)
    except (TypeError, ValueError):  # it is just being closed
        return True
    return bool(poll.poll(0))


def _peer(connection):
    # a publisher's end is called after the subscriber's node; a subscriber's after the publisher's
    # URI, and it knows the name once the handshake is through
    name = getattr(connection, 'callerid_pub', 'unknown')
    if name == 'unknown':
        other = _running.get(connection.endpoint_id)
        name = other.name if other else connection.endpoint_id
    return name
