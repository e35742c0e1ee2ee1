"""Connections refused because the types of the two ends differ: found out about once, and told
once."""
import contextlib
import threading
import time
from typing import NamedTuple

from pharos.private_rospy import changes, registration
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.tcpros_connection import publisher_header

TIMEOUT = 1.0  # seconds in which a publisher that refused says what it publishes
# refusals of a topic on each side; beyond, the oldest is told again when it is repeated
REMEMBERED = 1000


class Refusal(NamedTuple):
    """A publisher that a subscription cannot hear."""

    topic: str
    publisher: str  # its node's name, or its URI where it does not tell
    wanted: type  # the message class of the subscription
    offered: dict  # the publisher's connection header: type, md5sum, message_definition


class Refusals:
    """What the node of one :class:`~.instance.PrivateRospy` cannot hear, and who cannot hear it.

    Peers try again whenever the master names them a publisher, so each refusal is remembered, with
    rospy's _SubscriberImpl or _PublisherImpl that it is of, until the two do connect.

    :attr:`on_refused` is called with each :class:`Refusal` that is new.
    """

    def __init__(self, node):
        self._node = node
        self._lock = threading.Lock()
        self._held = []  # topics of whose refusals is not told yet
        self.on_refused = lambda refusal: None

    # -- who cannot be heard

    def publisher_refused(self, subscription, uri, said, ask, wanted=None):
        """A connection to the publisher at that URI has failed with what it said.

        :param subscription: rospy's _SubscriberImpl
        :param ask: ``ask()`` returns the publisher's connection header, or None if the reason is no
            type
        :param wanted: the message class, where it is not the subscription's
        """
        topic, wanted = subscription.resolved_name, wanted or subscription.data_class
        with self._lock:
            if subscription.refused.get(uri, (None,))[0] == said:
                return
            _remember(subscription.refused, uri, (said, None))
        header = ask()
        if header is None or header.get('md5sum') == wanted._md5sum:
            # it has gone, or changed its mind, or the reason is another one, which may pass
            subscription.refused.pop(uri, None)
            self._node.connections.connect_later(subscription, uri, registration.RETRY_DELAY)
            return
        refusal = Refusal(topic, header.get('callerid', uri), wanted, header)
        with self._lock:
            subscription.refused[uri] = said, refusal
            is_held = topic in self._held
        changes.notify()
        if not is_held:
            self.on_refused(refusal)

    @contextlib.contextmanager
    def held(self, topic):
        """Within this, nothing is told of the refusals of a topic; afterwards, of those that are
        left then."""
        with self._lock:
            self._held.append(topic)
        try:
            yield
        finally:
            with self._lock:
                self._held.remove(topic)
                left = self.of(topic)
            for refusal in left:
                self.on_refused(refusal)

    def message_refused(self, subscription, wanted, header):
        """A message came from a publisher that suits the subscription, which takes any type, but
        not a channel of it.

        :param header: the message's ``_connection_header``
        """
        uri = header['callerid']
        for connection in subscription.connections or ():
            if getattr(connection, 'callerid_pub', None) == header['callerid']:
                uri = connection.endpoint_id
        self.header_refused(subscription, uri, wanted, header)

    def header_refused(self, subscription, uri, wanted, header):
        """A publisher's connection header is of another type than a channel of the subscription."""
        self.publisher_refused(
            subscription, uri, f"its md5sum is {header['md5sum']}", lambda: header, wanted
        )

    def publisher_connected(self, topic, uri):
        """Nothing is wrong with it now."""
        subscription = self._node.subscriber(topic)
        if subscription is not None:
            subscription.refused.pop(uri, None)

    def publishers_changed(self, subscription):
        """The master has named the publishers that there are: forget the others.

        Its word of one in this process takes its time.
        """
        for uri in subscription.refused.keys() - set(subscription.publishers):
            local = self._node.connections.local_node_at(uri)
            if local is None or local.publisher(subscription.resolved_name) is None:
                subscription.refused.pop(uri, None)

    def refuses(self, topic, uri):
        """Whether the node cannot hear the publisher at that URI."""
        subscription = self._node.subscriber(topic)
        return subscription is not None and subscription.refused.get(uri, (0, None))[1] is not None

    def of(self, topic):
        """The Refusal of each publisher of the topic that the node cannot hear."""
        subscription = self._node.subscriber(topic)
        entries = list(subscription.refused.values()) if subscription else []
        return [refusal for _, refusal in entries if refusal is not None]

    def count(self):
        """How many publishers, of all topics, the node cannot hear."""
        return sum(len(self.of(topic)) for topic, _ in self._node.topics.get_subscriptions())

    # -- who cannot hear

    def subscriber_refused(self, publisher, name, said, line):
        """A subscriber was refused; ``line`` is the warning.

        :param publisher: rospy's _PublisherImpl
        """
        with self._lock:
            is_new = publisher.refused.get(name) != said
            _remember(publisher.refused, name, said)
        changes.notify()
        if is_new:
            self._node.warn(line)

    def subscriber_connected(self, topic, name):
        """Nothing is wrong with it now."""
        publisher = self._node.publisher(topic)
        if publisher is not None:
            publisher.refused.pop(name, None)

    def subscribers(self, topic):
        """Names of the nodes that cannot hear what this one publishes on the topic."""
        publisher = self._node.publisher(topic)
        return list(publisher.refused) if publisher else []


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


def examine(node, connection, topic, uri):
    """Find out why rospy's connection to the publisher at that URI failed."""
    header, subscription = connection.header, node.subscriber(topic)
    address = connection.dest_address
    if subscription is None or 'error' not in (header or ()) or node.ended.is_set():
        return
    known = header if 'md5sum' in header else None
    node.refusals.publisher_refused(
        subscription, uri, header['error'], lambda: known or ask(address, topic)
    )


def ask(address, topic):
    """The connection header of a publisher, None where it does not tell."""
    try:
        header = publisher_header(address, topic, time.monotonic() + TIMEOUT)
    except OSError:
        return None
    return None if 'error' in header else header
