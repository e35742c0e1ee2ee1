"""INTRAPROCESS links: connections from a publisher to a subscription of the same process.

A link has two ends: one in the list of connections of rospy's publisher, and one in the list of its
subscription. rospy itself lists links; add_link() refuses a second one.
"""
from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, Callable, Protocol

from rospy.impl.transport import Transport
from rospy.names import TOPIC_ANYTYPE

from pharos.intraprocess.copier import thaw_function

if TYPE_CHECKING:
    from pharos.intraprocess.inboxes import Inbox
    from pharos.private_rospy.run import Run

#: the runs of this process by the URI of their node
runs: dict[str, Run] = {}
runs_lock = threading.Lock()


class Connection(Protocol):
    """One end of a connection, as publishers and subscriptions use it; for annotations alone.

    A Link, a Sender around rospy's TCPROSTransport, a MemorySender and a MemoryReceiver are such
    ends, and so is the TCPROSTransport of a subscription. The first group is what all of them have.
    """

    #: 'o' for the publisher's end, 'i' for the subscription's
    direction: str
    #: the full name of the topic
    name: str
    #: 'o': the name of the subscriber's node; 'i': the URI of the publisher's
    endpoint_id: str
    #: 'INTRAPROCESS', 'SHARED_MEMORY' or 'TCPROS'
    transport_type: str
    #: True once the connection is closed
    done: bool
    #: the number of messages that went through; a link has that of its publisher, since its topic opened
    stat_num_msg: int
    #: the number of bytes that went through; a link leaves it at 0
    stat_bytes: int

    def close(self) -> None:
        """Close the connection, and say so to the publisher or subscription that has it."""

    # -- a publisher's end

    #: True for a link or a MemorySender; absent from rospy's TCPROSTransport, which gets a Sender
    has_own_queue: bool
    #: True while messages wait for the receiver; absent from a link, which has none of its own
    is_busy: bool

    def write_data(self, parts: list[bytes], size: int) -> None:
        """Send a message in parts, or queue what a full socket does not take; by TCPROS alone."""

    # -- a subscription's end

    #: the connection header that the publisher has sent; None until it has come
    header: dict[str, str] | None
    #: the name of the publisher's node, from the header
    callerid_pub: str
    #: True if the publisher latches; a link has none of this
    is_latched: bool
    #: the latched message, which later callbacks get; always None for a link
    latch: Any
    #: the Share of a shared connection, else None
    share: Any
    #: the subscriptions that hear a shared connection, else none
    subscriptions: list | tuple


def peer_of(connection: Connection) -> str | None:
    """Return the name of the node at the other end; None if its header has not come yet."""
    if connection.direction == 'o':
        return connection.endpoint_id
    return connection.header and connection.header['callerid']  # type: ignore[return-value]


class LocalTransport(Transport):
    """One end of a connection that is not a socket of TCPROS.

    :ivar has_own_queue: True: a publisher's end needs no Sender
    """

    has_own_queue = True

    def __init__(self, direction: str, topic: str, endpoint_id: str) -> None:
        super().__init__(direction, topic)
        self.endpoint_id = endpoint_id

    def get_transport_info(self) -> str:
        return f'{self.transport_type} connection to [{self.endpoint_id}]'


class Link(LocalTransport):
    """One end of a link, which looks like a connection of rospy's.

    No message passes through this object. A publisher puts messages into the inboxes of its links.

    :param direction: 'o' for the publisher's end, 'i' for the subscription's
    :param thaw: makes a message of the subscription's class from a frozen one
    :param inboxes: those of the subscription
    :ivar other_end: the Link at the other end
    """

    latch = None  # rospy would send a latched message again; the overlay has its own latches
    header = property(lambda self: self.publisher.header)
    callerid_pub = property(peer_of)  # actionlib reads this
    transport_type = 'INTRAPROCESS'
    # the publisher counts for all links: to touch ten links takes as long as to run ten delegates.
    # The setter is for rospy, which sets the count to 0 at first
    stat_num_msg = property(lambda self: self.publisher.seq, lambda self, zero: None)

    def __init__(
        self,
        direction: str,
        publisher: Any,
        endpoint_id: str,
        thaw: Callable[[Any], Any],
        inboxes: list[Inbox],
    ) -> None:
        super().__init__(direction, publisher.name, endpoint_id)
        self.publisher = publisher
        self.thaw = thaw
        self.inboxes = inboxes

    def close(self) -> None:
        """Close both ends: rospy closes no connection of a publisher that has left the topic."""
        if self.done:  # type: ignore[has-type]
            return
        self.done = True
        self.other_end.done = True
        for end in self, self.other_end:
            if end.cleanup_cb:
                end.cleanup_cb(end)


def link_topic(sender: Run, receiver: Run, topic: str) -> None:
    """Link two runs of this process on a topic, if one publishes and the other subscribes.

    Hand over the latched messages. A publisher of another type is reported as a failure of the
    receiver. Do nothing if the two are connected already.

    :param sender: the run of the publishing node
    :param receiver: the run of the receiving node
    :param topic: the full name of the topic
    """
    publisher = sender.topic_manager.pubs.get(topic)
    subscription = receiver.topic_manager.subs.get(topic)
    if not publisher or not subscription:
        return
    sent_class = publisher.data_class
    wanted_class = subscription.data_class
    if wanted_class._md5sum not in (sent_class._md5sum, TOPIC_ANYTYPE):
        receiver.report_refusal(
            topic, f'{sender.name} publishes {sent_class._type}, not {wanted_class._type}'
        )
        return
    publisher.make_header()
    thaw = thaw_function(sent_class, wanted_class)
    with publisher.lock:
        sender_end = Link('o', publisher, receiver.name, thaw, subscription.inboxes)
        receiver_end = Link('i', publisher, sender.uri, thaw, subscription.inboxes)
        sender_end.other_end = receiver_end
        receiver_end.other_end = sender_end
        if publisher.closed or not subscription.add_link(receiver_end):
            return
        publisher.add_receiver(sender_end)
        if publisher.closed or sender_end.done:  # one side has closed meanwhile, without this end
            receiver_end.close()
            publisher.remove_connection(sender_end)
            return
        for frozen in list(publisher.latches.values()):  # a channel may close meanwhile
            for inbox in sender_end.inboxes:
                inbox.put((frozen, thaw, publisher.header))
    for inbox in sender_end.inboxes:
        inbox.callback_queue.request_thread()


def links_of(connections: list[Connection]) -> list[Link]:
    """Return those of some connections that are links."""
    return [connection for connection in connections if isinstance(connection, Link)]
