"""Overlays for rospy's publishers and subscriptions: they send to links and sockets, and receive.

:mod:`pharos.private_rospy.patches` sets these methods on each node's own copy of rospy's classes.
"""
from __future__ import annotations

import contextlib
import functools
import time
from _thread import get_ident
from typing import Any, Callable, Iterable, NamedTuple

import rospy

from pharos.intraprocess.callback_queues import CallbackQueue, hand_over
from pharos.intraprocess.copier import SERIALIZE_ERRORS, copier_for, copy_of
from pharos.intraprocess.inboxes import Inbox
from pharos.intraprocess.links import links_of
from pharos.private_rospy.connections import connect_all
from pharos.private_rospy.sharing import leave, share_of
from pharos.private_rospy.tcpros import CLOSED, MessageParts, Sender
from pharos.signals import silenced_threads

SOCKET_BYTES = 6 << 20  # bytes that the two sockets of a connection hold, roughly
HELD_BYTES = 1 << 20  # bytes that wait here; what follows by shared memory waits in the publisher
SHARED_QUEUE = 10  # messages: a guess at the queue_size of the publisher of a shared connection
FLUSH_PERIOD = 0.001  # seconds between two looks
#: seconds until the first callback of a subscription: a connection between processes takes so long,
#: and many constructors subscribe before they have set all that their callback uses
FIRST_PAUSE = 0.05


class PublisherOverlay:
    """Methods for a node's own rospy.topics._PublisherImpl; ``rospy_NAME`` is rospy's method.

    rospy serializes for all receivers. rospy latches the user's object, one for all Publishers of
    a topic. If a message does not serialize, rospy keeps its first bytes in a buffer, and they
    corrupt the next message. These methods freeze for links, and serialize into a new buffer for
    sockets.

    They do not make a subclass: ``super(_PublisherImpl, self)`` in rospy's code would find the
    subclass, and recurse.

    :ivar run: the Run; patches.overlay() sets it on the class
    """

    def __init__(self, name: str, data_class: type) -> None:
        self.rospy___init__(name, data_class)
        self.lock = self.publock  # rospy's close() sets publock to None
        self.has_last_word = False  # True once Run.last_thread has published
        # channel, or None for all Publishers of plain rospy -> frozen message. add_connection(),
        # link_topic() and add_callback() hand them to what is new, OutputChannel.open() its own to the
        # next run; its close() drops it
        self.latches = {}
        self.last_wake = 0.0
        self.freeze, self.thaw = copier_for(data_class)
        self.has_header = getattr(data_class, '_has_header', False)
        self.header = None  # for links and shared memory, by make_header(); ``headers`` is rospy's
        self.memory = None  # a MessageMemory, from SharedMemoryHandler's first reader on
        # None: find them anew. rospy makes a new list of connections at each change, but at the end
        self.receivers: Receivers | None = None

    def acquire(self) -> None:
        """Take no lock: rospy locks here for the whole of a publish().

        Our publish() has a lock of its own, and frees it before inline delegates run.
        """

    def release(self) -> None:
        """Do nothing: rospy unlocks here after a publish()."""

    def enable_latch(self) -> None:  # rospy calls this after registering, when links may exist
        self.is_latch = True
        if self.header:
            self.header['latching'] = '1'

    def make_header(self) -> None:
        """Make the connection header for links: the one that TCPROS sends."""
        with self.lock:
            if self.header is None:
                # not load(), which has a lock: a program that imports may hold it, and make a topic
                protocol_class = self.run.modules.by_name['rospy.impl.tcpros_pubsub'].TCPROSPub
                protocol = protocol_class(
                    self.resolved_name, self.data_class, self.is_latch, self.headers
                )
                self.header = protocol.get_header_fields()

    def add_connection(self, connection: Any) -> bool:
        if not getattr(connection, 'has_own_queue', False):
            connection = Sender(connection, self)
        with self.lock:
            self.add_receiver(connection)
            for frozen in list(self.latches.values()):
                self.write(self.thaw(frozen), [connection])
        return True

    def add_receiver(self, connection: Any) -> None:
        """Add a connection or a link, without the messages that are latched."""
        # not _PublisherImpl's own, which also sends the latched message, and calls listeners
        type(self).__base__.add_connection(self, connection)
        self.call_listeners(
            'peer_subscribe', self.publish, lambda message: self.publish(message, connection)
        )

    def remove_connection(self, connection: Any) -> None:
        if not self.closed:  # rospy trips over attributes that its close() has set to None
            type(self).__base__.remove_connection(self, connection)
            self.call_listeners('peer_unsubscribe', len(self.connections))

    def call_listeners(self, method: str, *arguments: Any) -> None:
        """Have listeners called one after another, as in rospy, and in no thread that holds a lock.

        The callback queue of the node's delegates calls them.
        """
        for listener in list(self.subscriber_listeners or ()):  # None: rospy's close() goes on
            block = functools.partial(getattr(listener, method), self.resolved_name, *arguments)
            Inbox(self.run.callback_queue, functools.partial(self._call, block)).receive(None)

    def _call(self, block: Callable, message: None) -> None:
        try:
            block()
        except Exception as error:
            self.run.report_failure(error, block.func, 'listener')  # type: ignore[attr-defined]

    def publish(self, message: Any, connection_override: Any = None, channel: Any = None) -> None:
        """Publish to the links, then to memory files and sockets; drop what a silenced thread publishes.

        If a node has inline delegates, all its waiting jobs run in this thread, after the lock is
        free.

        :param connection_override: publish to that connection alone; None: to all
        :param channel: the OutputChannel that publishes; None: a Publisher of plain rospy
        :raises rospy.ROSException: if the topic is closed; plain rospy returns if the node stops
        """
        with self.lock:
            # looked at under the lock: so what the handler publishes to this topic comes last
            if silenced_threads and get_ident() in silenced_threads and self.name != '/rosout':
                return
            last_thread = self.run.last_thread
            if last_thread and self.name != '/rosout':
                if last_thread == get_ident():
                    self.has_last_word = True
                elif self.has_last_word:
                    return
            if self.closed:
                # rospy's publish() returns in this case, too
                if channel is None and self.run.stopping.is_set():
                    return
                raise rospy.ROSException('publish() to a closed topic')
            self.seq += 1
            if connection_override is None:
                receivers = self.receivers
                if receivers is None or receivers.connections is not self.connections:
                    receivers = receivers_of(self.connections)
                    self.receivers = receivers
                is_latched = self.is_latch
                if channel:
                    is_latched = channel.latch
            else:
                receivers = receivers_of([connection_override])
                is_latched = False
            _, inboxes_by_thaw, inline_queues, thread_queues, others = receivers
            if self.has_header and message._has_header:  # as serialize_message does; not AnyMsg
                message.header.seq = self.seq
                if message.header.frame_id is None:
                    message.header.frame_id = '0'
            # nobody serializes the message of a channel
            needs_check = channel is not None and not others
            if inboxes_by_thaw or is_latched or needs_check:
                frozen = self.freeze(message)
                if is_latched:
                    self.latches[channel] = frozen
                for thaw, inboxes in inboxes_by_thaw.items():
                    item = frozen, thaw, self.header
                    for inbox in inboxes:  # without thaw: the message itself, as from a socket
                        inbox.put((message, None, None) if inbox.shared else item)
            if others:
                self.write(message, others)
            if channel:
                channel.sent += 1
        for callback_queue in inline_queues:
            callback_queue.run_jobs(in_turn=False)
        if thread_queues:
            # actionlib stores a goal after publish(): the answer must not come before that. Here it
            # does not come sooner than usual; patches.send_goal() has it wait
            may_wait = channel is not None
            self.last_wake = hand_over(thread_queues, self.last_wake, may_wait)

    def write(self, message: Any, connections: list) -> None:
        """Serialize a message, and write it to memory files and sockets.

        If a connection fails, it closes, and its subscriber connects anew.
        """
        senders = []
        if self.memory:
            senders, connections = self.memory.sort(connections)
        try:
            memory_parts, buffer = self._serialize(message, senders, connections)
        # a thawed copy has lists or bytes for numpy's arrays; freeze() raises if that is not enough
        except SERIALIZE_ERRORS:
            message = self.thaw(self.freeze(message))
            memory_parts, buffer = self._serialize(message, senders, connections)
        if senders:
            self.memory.write(memory_parts, senders)
        wire_parts, size = buffer.with_length()
        self.message_data_sent += size
        for connection in connections:
            try:
                connection.write_data(wire_parts, size)
            except CLOSED:
                connection.close()

    def _serialize(self, message: Any, senders: list, connections: list) -> tuple:
        """Return the parts of a message for memory files, and a MessageParts for sockets."""
        memory_parts = None
        buffer = MessageParts()
        if senders:
            memory_parts = self.memory.split(message)
        if connections:
            message.serialize(buffer)
        return memory_parts, buffer

    def flush(self, deadline: float) -> None:
        """Wait until the sockets have taken all messages, or until a deadline as monotonic time."""
        while any(getattr(connection, 'is_busy', False) for connection in self.connections):
            if time.monotonic() > deadline:
                break
            time.sleep(FLUSH_PERIOD)

    def close(self) -> None:
        close_topic(self)
        if self.memory:
            self.memory.close()
        # rospy has set these to None; a connection that comes at this moment reads them
        self.headers = {}
        self.subscriber_listeners = []


class PlainInbox(Inbox):
    """The messages that wait for a subscription's callbacks of plain rospy; all share one Inbox."""

    def __init__(self, subscription: Any, first_pause: float) -> None:
        callback_queue = CallbackQueue(subscription.run.callback_queue.order, first_pause)
        super().__init__(callback_queue, subscription.call_plain)
        self.subscription = subscription
        self.queue_bytes = subscription.run.node.queue_bytes

    def receive(self, message: Any, size: int, connection: Any) -> None:  # type: ignore[override]
        """Take a message from a connection.

        Without a queue_size, messages wait in the sockets and in the publisher until the callbacks
        have ended; those of a shared connection wait here. The thread that reads a socket of TCPROS
        runs the callbacks. By shared memory the Reader leaves the connection if HELD_BYTES wait,
        until the callbacks have run on the last of them.
        """
        paused_connection = None
        if self.queue_size is None and not connection.share:  # who reads for several waits for none
            if connection.transport_type == 'TCPROS':
                self.put((message, None, None), size)
                self.callback_queue.run_jobs_here()
                return
            if (len(self.messages) + 1) * size >= HELD_BYTES:
                connection.pause(message)
                paused_connection = connection
        self.put((message, None, paused_connection), size)
        self.callback_queue.request_thread()

    def run_callback(self, job: tuple) -> None:
        """Run the callbacks on the message of a job, and have its connection read again."""
        super().run_callback(job)
        self._resume(job)

    def forget(self, job: tuple) -> bool:
        is_dropped = super().forget(job)
        if is_dropped:
            self._resume(job)
        return is_dropped

    def _resume(self, job: tuple) -> None:
        """Have a paused connection read again, which its job has in the place of a header."""
        message, thaw, paused_connection = job[2]
        if paused_connection and not thaw:
            paused_connection.resume(message)

    def capacity_for(self, size: int) -> int:
        """Return how many messages would wait between processes: in publishers and in sockets."""
        connections = self.subscription.connections
        queue_sizes = [link.publisher.queue_size for link in links_of(connections)]
        queue_sizes += [SHARED_QUEUE for connection in connections if connection.share]
        # a publisher without a queue_size loses no message; connections of other kinds wait themselves
        publishers_drop = len(queue_sizes) == len(connections) and all(queue_sizes)
        if self.queue_size or not queue_sizes or not publishers_drop:
            return super().capacity_for(size)
        socket_messages = min(SOCKET_BYTES, self.queue_bytes) // size
        return sum(queue_sizes) + max(1, socket_messages)


class SubscriptionOverlay:
    """Methods for a node's own rospy.topics._SubscriberImpl; ``rospy_NAME`` is rospy's method.

    A callback that is an Inbox gets messages directly: these are the node's channels. All other
    callbacks of a topic share one PlainInbox, and run one after another. Those of two topics run
    side by side: one may wait for the other.

    :ivar run: as in PublisherOverlay
    :ivar inboxes: the inboxes of all callbacks; links share this very list
    :ivar publisher_uris: the publishers in the last list of the master
    :ivar retries: a dict: URI of a publisher -> the time to connect again, and the last error
    :ivar attempts: a dict: URI of a publisher -> an object of the attempt to connect that goes on
    """

    def __init__(self, name: str, data_class: type) -> None:
        self.rospy___init__(name, data_class)
        self.tcp_nodelay = True  # else a publisher may hold a small message back for 40 ms
        self.inboxes = []
        self.publisher_uris = []
        self.retries = {}
        self.attempts = {}
        self.is_leaving = False  # True once close() has begun: no shared connection may be joined
        self.plain_inbox = None  # type: Any

    def add_link(self, link: Any) -> bool:
        """Add a link, unless the topic is closed or has a connection to that node.

        :returns: True if the link was added
        """
        with self.c_lock:
            if self.closed or self.has_connection(link.endpoint_id):
                return False
            self.add_connection(link)
            return True

    def update_inboxes(self) -> list:
        """Find the inboxes of all callbacks anew, have the publishers do so, and return the links.

        A change of the callbacks calls this.
        """
        with self.c_lock:  # two threads may change the callbacks at once
            callbacks = self.callbacks or ()
            inboxes = [callback for callback, _ in callbacks if isinstance(callback, Inbox)]
            if len(inboxes) < len(callbacks):
                if not self.plain_inbox:
                    self.plain_inbox = PlainInbox(self, first_pause_for(callbacks))
                # the last Subscriber that has one sets it
                self.plain_inbox.queue_size = self.queue_size
                inboxes.append(self.plain_inbox)
            self.inboxes[:] = inboxes  # the links have this very list
            links = links_of(self.connections)
        for link in links:
            with link.publisher.lock:  # a publish() may find its receivers at this moment
                link.publisher.receivers = None
        return links

    def deliver(self, message: Any, connection: Any, size: int) -> None:
        """Count a message that came by a connection, and give it to all subscriptions that hear that.

        :param size: bytes of the message; by TCPROS with those of its length
        """
        connection.stat_bytes += size
        connection.stat_num_msg += 1
        latch = None
        if connection.is_latched:
            # one for all later callbacks; those of now may change the message
            latch = copy_of(message)
            latch._connection_header = connection.header
        # before the message is given: a callback may add another one at once
        share = connection.share
        if share:
            with share.lock:
                connection.latch = latch
                self.give(connection.subscriptions, message, connection, size)
        else:
            connection.latch = latch
            self.give([self], message, connection, size)

    def give(self, subscriptions: Iterable, message: Any, connection: Any, size: int) -> None:
        """Give each inbox of some subscriptions a message of its own; shared ones get one and the same."""
        inboxes = []
        for each in subscriptions:
            inboxes += each.inboxes
            if each.statistics_logger:
                each.statistics_logger.callback(
                    message, connection.callerid_pub, connection.stat_bytes
                )
        # copied before the first callback may change the message
        own_messages = [
            message if inbox.shared or len(inboxes) == 1 else copy_of(message) for inbox in inboxes
        ]
        for inbox, own_message in zip(inboxes, own_messages):
            own_message._connection_header = connection.header
            inbox.receive(own_message, size, connection)

    def call_plain(self, message: Any) -> None:
        """Run the callbacks of plain rospy on a message."""
        for callback, args in self.callbacks or ():
            if not isinstance(callback, Inbox):
                self._invoke_plain(callback, args, message)

    def _invoke_plain(self, callback: Callable, args: Any, message: Any) -> None:
        # of sys.exit(), which would end the thread of the callbacks; a signal raises in the main thread
        with contextlib.suppress(SystemExit):
            self._invoke_callback(message, callback, args)

    def add_callback(self, callback: Any, args: Any) -> None:
        self.rospy_add_callback(callback, args)
        links = self.update_inboxes()
        latch_inbox = callback  # a channel
        if not isinstance(callback, Inbox):  # only the new callback gets the latched messages
            invoke = functools.partial(self._invoke_plain, callback, args)
            latch_inbox = Inbox(self.plain_inbox.callback_queue, invoke)
        for link in links:
            for frozen in list(link.publisher.latches.values()):
                latch_inbox.put((frozen, link.thaw, link.header))
        latch_inbox.callback_queue.request_thread()
        connect_all(self)

    def add_connection(self, connection: Any) -> bool:
        if connection.transport_type == 'TCPROS':
            share = share_of(self, connection.endpoint_id)
            if share:
                return share.add(self, connection)  # _connect() has its lock
        return self.rospy_add_connection(connection)

    def remove_callback(self, callback: Any, args: Any) -> None:
        self.rospy_remove_callback(callback, args)
        self.update_inboxes()

    def close(self) -> None:
        leave(self)
        close_topic(self)
        if self.plain_inbox:
            self.plain_inbox.callback_queue.close(0)


def first_pause_for(callbacks: Iterable[tuple]) -> float:
    """Return how many seconds some callbacks must wait for the constructor that subscribes.

    A method in C, such as list.append, has the module None, and wait_for_message()'s callback is of
    rospy.client: they use nothing that a constructor sets.
    """
    modules = {getattr(callback, '__module__', '') for callback, _ in callbacks}
    return 0.0 if modules <= {None, 'rospy.client'} else FIRST_PAUSE


class Receivers(NamedTuple):
    """The receivers of the messages of a publisher."""

    connections: list  # all of them
    inboxes_by_thaw: dict[Callable, list[Inbox]]
    inline_queues: list[CallbackQueue]  # of inline inboxes
    thread_queues: list[CallbackQueue]  # of the other inboxes
    others: list  # the connections that are not links


def receivers_of(connections: list) -> Receivers:
    """Return the receivers of messages that are published to some connections."""
    links = links_of(connections)
    inboxes = {}
    inline_queues = []
    other_queues = []
    for link in links:
        inboxes.setdefault(link.thaw, []).extend(link.inboxes)
    for inbox in sum(inboxes.values(), []):
        queues = inline_queues if inbox.inline else other_queues
        queues.append(inbox.callback_queue)
    others = [connection for connection in connections if connection not in links]
    return Receivers(connections, inboxes, inline_queues, other_queues, others)


def close_topic(impl: Any) -> None:
    """Close a publisher or subscription.

    Links close before rospy's close() holds its lock: a link needs the locks of both its ends.
    rospy closes the rest, but leaves its epoll object open.
    """
    for link in links_of(impl.connections):
        link.close()
    impl.rospy_close()
    impl.connection_poll.poller.close()


def connections_of(ros_object: Any) -> list:
    """Return the connections of a rospy.Publisher or rospy.Subscriber."""
    impl = ros_object.impl
    if not impl or impl.closed:
        return []
    impl.check()  # rospy notices only now and then that peers have left (ros_comm #927)
    with impl.c_lock:  # a check() of the watcher sets the new list while it holds this
        return impl.connections
