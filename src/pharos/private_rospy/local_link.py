"""INTRAPROCESS: messages between nodes of one process without a socket, as a transport that ROS
negotiates.

A subscriber offers its protocols to the publisher, which picks the first that it supports. This one
is named for the process and offered before TCPROS: another process does not know the name and falls
back to TCPROS. Discovery stays the master's, and getBusInfo shows the connections.
"""
import contextlib
import os
import uuid

import rospy.impl.transport

from pharos.intraprocess.link import Link
from pharos.private_rospy.plain_receivers import PlainCallbacks, Statistics, plain_callbacks
from pharos.private_rospy.refusals import suits
from pharos.private_rospy.socket_callback import SocketCallback

PROTOCOL = None  # its name, of this process alone


def _name_protocol():
    global PROTOCOL
    PROTOCOL = f'INTRAPROCESS-{uuid.uuid4().hex}'


_name_protocol()
os.register_at_fork(after_in_child=_name_protocol)


class End(rospy.impl.transport.Transport):
    """One end of a link, as rospy's topics keep it among their connections."""

    transport_type = 'INTRAPROCESS'
    callerid_pub = 'unknown'  # the publisher's name, when it sends through the link
    latch = None  # those who come late get latched messages from the link
    is_heard = True  # its publisher is of the right type

    def __init__(self, link, direction, topic, peer, node):
        super().__init__(direction, topic)
        # getBusStats tells the connections of a node apart by this, which its own rospy counts
        self.id = node.module.impl.transport.Transport(direction).id
        self.link, self.endpoint_id, self.header = link, peer, link.header
        self._first = link.publisher.fanout.seq

    # what getBusStats tells; no bytes go through
    stat_num_msg = property(
        lambda self: self.link.publisher.fanout.seq - self._first, lambda self, value: None
    )

    def get_transport_info(self):
        return f'INTRAPROCESS connection to [{self.endpoint_id}]'

    def close(self):
        if not self.done:
            self.done = True  # before any lock is taken: nothing more is sent through it
            super().close()
            self.link.close(self)


class LocalLink(Link):
    """A link between rospy's _PublisherImpl of one node and the _SubscriberImpl of another.

    :param node: the subscriber's PrivateRospy
    :param other: the publisher's
    """

    end_class = End

    def __init__(self, publisher, subscriber, node, other):
        super().__init__(publisher.data_class, other.connection_header(publisher))
        self.publisher, self.subscriber = publisher, subscriber
        self._node, self._other = node, other
        self._callbacks = self._statistics = None  # the receivers that are no channels
        self.sending = self.end_class(
            self, rospy.impl.transport.OUTBOUND, publisher.resolved_name, node.name, other
        )
        self.receiving = self.end_class(
            self, rospy.impl.transport.INBOUND, subscriber.resolved_name, other.uri, node
        )

    def open(self):
        """Add the ends to the subscription and the publisher; returns whether both are open still.

        The publisher matches the receivers. Those that come between the two know the link already.
        """
        is_open = self.subscriber.add_connection(self.receiving) and self.publisher.add_connection(
            self.sending
        )
        if is_open and self.sending.done:  # closed before it was added, and so not removed by that
            self.publisher.remove_connection(self.sending)
            is_open = False
        # actionlib goes by the name: who has one hears what is published from now on
        self.receiving.callerid_pub = self._other.name
        return is_open

    def receivers(self):
        """The channels that hear the publisher, and the subscription's callbacks and statistics."""
        subscriber, node = self.subscriber, self._node
        receivers = [
            receiver
            for receiver in node.connections.receivers_on(subscriber.resolved_name)
            if receiver.from_ in (None, self._other.name) and self._suits(receiver)
        ]
        if plain_callbacks(subscriber):
            if self._open_callbacks() is None:
                self._callbacks = PlainCallbacks(self, node.start_thread)
            receivers.append(self._callbacks)
        if subscriber.statistics_logger is not None:
            if self._statistics is None:
                self._statistics = Statistics(self, node.start_thread)
            receivers.append(self._statistics)
        return receivers

    def _suits(self, receiver):
        """Whether a channel can hear the publisher; the subscription that it shares with others may
        take any type."""
        if suits(receiver.message_class, self.header['md5sum']):
            return True
        # in a thread: the publisher's lock may be held, and those who are told may publish
        self._node.start_thread(
            self._node.refusals.header_refused,
            (self.subscriber, self._other.uri, receiver.message_class, self.header),
            'refusal',
        )
        return False

    def _open_callbacks(self):
        callbacks = self._callbacks
        return None if callbacks is None or callbacks.closed else callbacks

    def callback_added(self, callback):
        """The subscription has a callback more; returns the latched messages that it has missed."""
        callbacks = self._open_callbacks()
        if callbacks is None or isinstance(callback, SocketCallback):
            self.publisher.receivers_changed(self)
        elif callbacks.latched is not None:
            return [callbacks.latched]
        return []

    def callback_removed(self):
        """The subscription has a callback less."""
        callbacks = self._open_callbacks()
        if callbacks is not None and not plain_callbacks(self.subscriber):
            callbacks.close()
        self.publisher.receivers_changed(self)

    def warn(self, text):
        """A warning in the log of the subscriber's node."""
        self._node.warn(text)

    def unbounded(self):
        """Within this, no publisher waits for the callbacks of the subscription; see
        :class:`PlainCallbacks`."""
        callbacks = self._open_callbacks()
        return callbacks.unbounded() if callbacks else contextlib.nullcontext()

    def close(self, end):
        """One end was closed: the other goes too.

        In a thread of its own, for rospy closes ends under the lock of their topic, and the other's
        topic has its own.
        """
        self.close_inboxes()
        other, node = (
            (self.receiving, self._node) if end is self.sending else (self.sending, self._other)
        )
        if not other.done:
            node.start_thread(other.close, name='closing')


class IntraprocessHandler(rospy.impl.transport.ProtocolHandler):
    """The handler of this transport for the node of a PrivateRospy."""

    def __init__(self, node):
        self._node = node

    def supports(self, protocol):
        return protocol == PROTOCOL

    def get_supported(self):
        return [[PROTOCOL]]

    def init_publisher(self, topic, protocol):
        return 1, 'ready', [PROTOCOL]

    def create_transport(self, topic, uri, parameters):
        node, other = self._node, self._node.connections.local_node_at(uri)
        publisher = other and other.publisher(topic)
        subscriber = node.subscriber(topic)
        if publisher is None or subscriber is None:
            return 0, f'{topic} has gone from {uri}', 0
        refusal = _refusal(publisher, subscriber, other, node)
        if refusal:
            other.refusals.subscriber_refused(publisher, node.name, refusal, refusal)
            node.refusals.publisher_refused(
                subscriber, uri, refusal, lambda: other.connection_header(publisher)
            )
            return 0, refusal, 0
        node.refusals.publisher_connected(topic, uri)
        other.refusals.subscriber_connected(topic, node.name)
        link = LocalLink(publisher, subscriber, node, other)
        if link.open():
            return 1, f'connected to {other.name}', 0
        link.receiving.close()
        return 0, f'{topic} was closed meanwhile', 0


def _refusal(publisher, subscriber, other, node):
    """Why the two cannot be connected, None if they can: the rule of rospy's TCPROS."""
    offered, asked = publisher.data_class, subscriber.data_class
    if asked._md5sum in ('*', offered._md5sum):
        return None
    return (
        f'{node.name} wants {publisher.resolved_name} as {asked._type} [{asked._md5sum}], but'
        f' {other.name} publishes {offered._type} [{offered._md5sum}]: not connected'
    )
