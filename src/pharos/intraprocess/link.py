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

from pharos.intraprocess import copier
from pharos.intraprocess.callbacks import CallbackInbox, is_of_channel
from pharos.private_rospy.refusals import suits
from pharos.intraprocess.statistics import Statistics

PROTOCOL = None  # its name, of this process alone


def _name_protocol():
    global PROTOCOL
    PROTOCOL = f'INTRAPROCESS-{uuid.uuid4().hex}'


_name_protocol()
os.register_at_fork(after_in_child=_name_protocol)


class Link:
    """A connection between a publisher and a subscription of two nodes of this process."""

    def __init__(self, publisher, subscriber, instance, other):
        # rospy's _PublisherImpl and _SubscriberImpl
        self._publisher, self._subscriber = (publisher, subscriber)
        # the subscriber's and the publisher's PrivateRospy
        self._instance, self._other = (instance, other)
        self.header = other.connection_header(publisher)
        self.publisher_name = other.name
        self.thaw = copier.thawer(publisher.data_class, subscriber.data_class)
        # receiver -> its inbox: channels, CallbackInbox for plain callbacks, and Statistics
        self.inboxes = {}
        self.sending = _End(
            self, rospy.impl.transport.OUTBOUND, publisher.resolved_name, instance.name
        )
        self.receiving = _End(
            self, rospy.impl.transport.INBOUND, subscriber.resolved_name, other.uri
        )
        self.receiving.callerid_pub = other.name

    def open(self):
        """Add the ends to the subscription and the publisher; returns whether both are open still.

        The publisher matches the receivers. Those that come between the two know the link already.
        """
        return self._subscriber.add_connection(self.receiving) and self._publisher.add_connection(
            self.sending
        )

    def match_receivers(self):
        """Have an inbox for each receiver that the subscription has; returns the new ones.

        The publisher calls this with its lock.
        """
        subscriber, before, start_thread = (
            self._subscriber,
            self.inboxes,
            self._instance.start_thread,
        )
        channels = [
            channel
            for channel in self._instance.connections.channels_on(subscriber.resolved_name)
            if channel.from_ in (None, self.publisher_name) and self._suits(channel)
        ]
        inboxes = {
            channel: before.get(channel) or self._channel_inbox(channel) for channel in channels
        }
        if subscriber.has_plain_callbacks():
            inboxes[CallbackInbox] = self._open_callback_inbox() or CallbackInbox(
                self, self._publisher, subscriber, start_thread
            )
        if subscriber.statistics_logger is not None:
            inboxes[Statistics] = before.get(Statistics) or Statistics(
                subscriber, self.publisher_name, self.thaw, start_thread
            )
        self.inboxes = inboxes
        plain = before.get(CallbackInbox)
        if plain is not None and inboxes.get(CallbackInbox) is not plain:
            plain.close()  # or its thread would stay: who removes the last callback may come later
        if self.sending.done or self.receiving.done:
            # the link was closed meanwhile, and does not see those opened since
            self._close_inboxes()
        return [inbox for receiver, inbox in inboxes.items() if before.get(receiver) is not inbox]

    def all_inboxes(self):
        """Where the publisher is to put its messages."""
        return list(self.inboxes.values())

    def _suits(self, channel):
        """Whether a channel can hear the publisher; the subscription that it shares with others may
        take any type."""
        if suits(channel.message_class, self.header['md5sum']):
            return True
        refuse = self._instance.refusals.header_refused
        # the publisher's lock may be held, and those who are told may publish
        self._instance.start_thread(
            refuse,
            (self._subscriber, self._other.uri, channel.message_class, self.header),
            'refusal',
        )
        return False

    def _close_inboxes(self):
        for inbox in self.all_inboxes():
            inbox.close()

    def _channel_inbox(self, channel):
        thaw = copier.thawer(self._publisher.data_class, channel.message_class)
        return channel._new_inbox(thaw, self.header)

    def _open_callback_inbox(self):
        inbox = self.inboxes.get(CallbackInbox)
        return None if inbox is None or inbox.closed else inbox

    def callback_added(self, callback):
        """The subscription has a callback more; returns the latched messages that it has missed."""
        inbox = self._open_callback_inbox()
        if inbox is None or is_of_channel(callback):
            self._publisher.channels_changed(self)
        elif inbox.latched is not None:
            return [inbox.latched]
        return []

    def callback_removed(self):
        """The subscription has a callback less."""
        inbox = self._open_callback_inbox()
        if inbox is not None and not self._subscriber.has_plain_callbacks():
            inbox.close()
        self._publisher.channels_changed(self)

    def unbounded(self):
        """Within this, no publisher waits for the callbacks of the subscription; see
        :class:`CallbackInbox`."""
        inbox = self._open_callback_inbox()
        return inbox.unbounded() if inbox else contextlib.nullcontext()

    def close(self, end):
        """One end was closed: the other goes too.

        In a thread of its own, for rospy closes ends under the lock of their topic, and the other's
        topic has its own.
        """
        self._close_inboxes()
        other, instance = (
            (self.receiving, self._instance) if end is self.sending else (self.sending, self._other)
        )
        if not other.done:
            instance.start_thread(other.close, name='closing')


class _End(rospy.impl.transport.Transport):
    """One end of a link, as rospy's topics keep it among their connections."""

    transport_type = 'INTRAPROCESS'
    latch = None  # those who come late get latched messages from the link

    def __init__(self, link, direction, topic, peer):
        super().__init__(direction, topic)
        self.link, self.endpoint_id, self.header = link, peer, link.header

    def get_transport_info(self):
        return f'INTRAPROCESS connection to [{self.endpoint_id}]'

    def close(self):
        if not self.done:
            self.done = True  # before any lock is taken: nothing more is sent through it
            super().close()
            self.link.close(self)


def protocol_handler(instance):
    """The handler of this transport for a node; a rospy ProtocolHandler."""

    class Handler(rospy.impl.transport.ProtocolHandler):
        def supports(self, protocol):
            return protocol == PROTOCOL

        def get_supported(self):
            return [[PROTOCOL]]

        def init_publisher(self, topic, protocol):
            return 1, 'ready', [PROTOCOL]

        def create_transport(self, topic, uri, parameters):
            other = instance.connections.local_node_at(uri)
            publisher = other and other.publisher(topic)
            subscriber = instance.subscriber(topic)
            if publisher is None or subscriber is None:
                return 0, f'{topic} has gone from {uri}', 0
            refusal = _refusal(publisher, subscriber, other, instance)
            if refusal:
                other.refusals.subscriber_refused(publisher, instance.name, refusal, refusal)
                instance.refusals.publisher_refused(
                    subscriber, uri, refusal, lambda: other.connection_header(publisher)
                )
                return 0, refusal, 0
            instance.refusals.publisher_connected(topic, uri)
            other.refusals.subscriber_connected(topic, instance.name)
            link = Link(publisher, subscriber, instance, other)
            if link.open():
                return 1, f'connected to {other.name}', 0
            link.receiving.close()
            return 0, f'{topic} was closed meanwhile', 0

    return Handler()


def _refusal(publisher, subscriber, other, instance):
    """Why the two cannot be connected, None if they can: the rule of rospy's TCPROS."""
    offered, asked = publisher.data_class, subscriber.data_class
    if asked._md5sum in ('*', offered._md5sum):
        return None
    return (
        f'{instance.name} wants {publisher.resolved_name} as {asked._type} [{asked._md5sum}], but'
        f' {other.name} publishes {offered._type} [{offered._md5sum}]: not connected'
    )
