"""Connections refused because the types of the two ends differ: found out about once, and told
once."""
import contextlib
import threading
import time
from typing import NamedTuple

from pharos.private_rospy import publishing
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.tcpros_connection import publisher_header

TIMEOUT = 1.0  # seconds in which a publisher that refused says what it publishes
REMEMBERED = (
    1000  # refusals of a node on each side; beyond, the oldest is told again when it is repeated
)


class Refusal(NamedTuple):
    """A publisher that a subscription cannot hear."""

    topic: str
    publisher: str  # its node's name, or its URI where it does not tell
    wanted: type  # the message class of the subscription
    offered: dict  # the publisher's connection header: type, md5sum, message_definition


class Refusals:
    """What the node of one :class:`~.instance.PrivateRospy` cannot hear, and who cannot hear it.

    Peers try again whenever the master names them a publisher, so that each refusal is remembered,
    for as long as the subscription or the publisher is there, or until the two do connect.

    :attr:`on_refused` is called with each :class:`Refusal` that is new.
    """

    def __init__(self, instance):
        self._instance = instance
        self._lock = threading.Lock()
        # (topic, URI) -> (rospy's subscription, what was said, the Refusal once it is known)
        self._publishers = {}
        self._subscribers = {}  # (topic, node name) -> (rospy's publisher, what was said)
        self._held = {}  # topic -> the refusals of which is not told yet
        self.on_refused = lambda refusal: None

    # -- who cannot be heard

    def publisher_refused(self, subscription, uri, said, ask, wanted=None):
        """A connection to the publisher at that URI has failed with what it said.

        :param subscription: rospy's _SubscriberImpl
        :param ask: ``ask()`` returns the publisher's connection header, or None if the reason is no
            type
        :param wanted: the message class, where it is not the subscription's
        """
        wanted = wanted or subscription.data_class
        key = subscription.resolved_name, uri
        with self._lock:
            if self._publishers.get(key, ())[:2] == (subscription, said):
                return
            _remember(self._publishers, key, (subscription, said, None))
        header = ask()
        if header is None or header.get('md5sum') == wanted._md5sum:
            self.publisher_connected(*key)  # it has gone, or changed its mind
            return
        refusal = Refusal(key[0], header.get('callerid', uri), wanted, header)
        with self._lock:
            self._publishers[key] = subscription, said, refusal
            held = self._held.get(key[0])
            if held is not None:
                held.append(refusal)
        publishing.notify()
        if held is None:
            self.on_refused(refusal)

    @contextlib.contextmanager
    def held(self, topic):
        """Tell of the refusals of a topic only afterwards, and of those that are left then in the
        list that it gives."""
        held = []
        with self._lock:
            self._held[topic] = held
        try:
            yield held
        finally:
            with self._lock:
                if self._held.get(topic) is held:
                    del self._held[topic]
            for refusal in held:
                self.on_refused(refusal)

    def message_refused(self, subscription, wanted, header):
        """A message came from a publisher that suits the subscription, which takes any type, but
        not a channel of it.

        :param header: the message's ``_connection_header``
        """
        uri = next(
            (
                connection.endpoint_id
                for connection in subscription.connections or ()
                if getattr(connection, 'callerid_pub', None) == header['callerid']
            ),
            header['callerid'],
        )
        self.header_refused(subscription, uri, wanted, header)

    def header_refused(self, subscription, uri, wanted, header):
        """A publisher's connection header is of another type than a channel of the subscription."""
        self.publisher_refused(
            subscription, uri, f"its md5sum is {header['md5sum']}", lambda: header, wanted
        )

    def publisher_connected(self, topic, uri):
        """Nothing is wrong with it now."""
        with self._lock:
            self._publishers.pop((topic, uri), None)

    def refuses(self, topic, uri):
        """Whether the node cannot hear the publisher at that URI."""
        with self._lock:
            subscription, _, refusal = self._publishers.get((topic, uri), (None, None, None))
        return refusal is not None and self._is_there(topic, uri, subscription)

    def count(self, topic=None):
        """How many publishers, of one topic or of all, the node cannot hear."""
        with self._lock:
            keys = list(self._publishers)
        return sum(self.refuses(*key) for key in keys if topic in (None, key[0]))

    def _is_there(self, topic, uri, subscription):
        """Whether both ends are there still."""
        if self._instance.subscriber(topic) is not subscription:
            return False
        neighbour = self._instance.connections.local_node_at(uri)
        # the master's word of a publisher of this process takes its time
        return (
            uri in subscription.publishers
            or neighbour is not None
            and neighbour.publisher(topic) is not None
        )

    # -- who cannot hear

    def subscriber_refused(self, publisher, name, said, line):
        """A subscriber was refused; ``line`` is the warning.

        :param publisher: rospy's _PublisherImpl
        """
        key, entry = (publisher.resolved_name, name), (publisher, said)
        with self._lock:
            is_new = self._subscribers.get(key) != entry
            _remember(self._subscribers, key, entry)
        publishing.notify()
        if is_new:
            self._instance.warn(line)

    def subscriber_connected(self, topic, name):
        """Nothing is wrong with it now."""
        with self._lock:
            self._subscribers.pop((topic, name), None)

    def subscribers(self, topic):
        """Names of the nodes that cannot hear what this one publishes on the topic."""
        publisher = self._instance.publisher(topic)
        with self._lock:
            return [
                key[1]
                for key, (refusing, _) in self._subscribers.items()
                if key[0] == topic and refusing is publisher
            ]


def _remember(entries, key, entry):
    entries.pop(key, None)  # the newest are the last
    entries[key] = entry
    if len(entries) > REMEMBERED:
        del entries[next(iter(entries))]


def suits(wanted, md5sum):
    """Whether one who wants messages of that class may hear those of that md5sum: ROS's rule."""
    return '*' in (wanted._md5sum, md5sum) or wanted._md5sum == md5sum


def check_md5sum(connection, wanted):
    """Raise TransportInitError if the publisher that rospy's connection has shaken hands with is of
    another type.

    rospy takes messages of another md5sum from a publisher that does not check.

    :param wanted: the message class of the subscription
    """
    header = connection.header
    if not suits(wanted, header['md5sum']):
        # as if it had said so itself: it is not to be tried again and again
        connection.header = {**header, 'error': f"its md5sum is {header['md5sum']}"}
        raise rospy.exceptions.TransportInitError(connection.header['error'])


def examine(instance, connection, topic, uri):
    """Find out why rospy's connection to the publisher at that URI failed."""
    header, subscription, address = (
        connection.header,
        instance.subscriber(topic),
        connection.dest_address,
    )
    if subscription is None or 'error' not in (header or ()) or instance.ended.is_set():
        return
    known = header if 'md5sum' in header else None
    instance.refusals.publisher_refused(
        subscription, uri, header['error'], lambda: known or _ask(address, topic)
    )


def _ask(address, topic):
    try:
        header = publisher_header(address, topic, time.monotonic() + TIMEOUT)
    except OSError:
        return None
    return None if 'error' in header else header
