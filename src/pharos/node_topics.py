"""What nodes send and hear."""
from typing import TYPE_CHECKING, Any, Callable, Dict, List, Optional, Union

import genpy

from pharos import messages
from pharos.blocks import Block, attempt, check_filler
from pharos.channel import InputChannel
from pharos.next_message import next_message
from pharos.output_channel import OutputChannel
from pharos.private_rospy.deadlines import time_limit
from pharos.seconds import check_seconds
from pharos.souls import NodeWithSouls
from pharos.topic import QUEUE_SIZE, Topic, TypedAs
from pharos.wrong_guesses import tells_keywords

if TYPE_CHECKING:
    from pharos.external_node import ExternalNode
    from pharos.node import Node

    Peer = Union[str, Node, ExternalNode, None]

AnyChannel = Union[InputChannel, OutputChannel]

HINT_TIMEOUT = 0.5  # seconds that the master may take for what only makes an error clearer


class NodeWithTopics(NodeWithSouls, is_base=True):
    """The part of a Node that is about topics."""

    @tells_keywords
    def interested_in(
        self,
        topic: str,
        typed_as: TypedAs = None,
        delegate: Optional[Block] = None,
        queue_size: int = QUEUE_SIZE,
        inline: bool = False,
        shared: bool = False,
        from_: 'Peer' = None,
        wait: float = 0,
    ) -> InputChannel:
        """Receive the messages of a topic from now on; returns the :class:`InputChannel`.

        The report (listing 3.3)::

            self interestedIn: '/turtle1/command_velocity' typedAs: 'turtlesim/Velocity'
            self.interested_in('/turtle1/command_velocity', typed_as='turtlesim/Velocity')

        :param typed_as: type name or message class; None: the master's type for the topic, whose
            definition comes from a publisher where no package here has it
        :param delegate: block for this channel only, instead of the node's
        :param queue_size: messages kept while the node is busy; the oldest are dropped and counted.
            Of large messages no more are kept than have :attr:`queue_bytes` bytes, 64 MiB by
            default.
        :param inline: run the delegate in the publisher's thread, where that is a node of this
            process
        :param shared: get the very message that a node of this process published, and promise not
            to change it
        :param from_: only messages of that node: a name, resolved as the topic's is, a Node or
            ExternalNode; it need not be there yet
        :param wait: without ``typed_as``, seconds to wait until somebody has given the topic a type
        :raises UnknownTopicError, UnknownTypeError, MessageTypeError: if there is no type, or
            another
        :raises ValueError: if ``topic`` or ``from_`` cannot be a name
        :raises MasterUnreachableError: if the master does not answer; nothing is left behind then
        """
        return self._topic(topic).input_channel(
            self._node, typed_as, delegate, queue_size, inline, shared, from_, wait
        )

    @tells_keywords
    def output_channel(
        self,
        topic: str,
        typed_as: TypedAs = None,
        latch: bool = False,
        queue_size: int = QUEUE_SIZE,
        wait: float = 0,
    ) -> OutputChannel:
        """Publish on a topic from now on; returns the :class:`OutputChannel`.

        :param typed_as: type name or message class; None: the master's type for the topic
        :param latch: send the last message to those who become interested later, also after a
            restart of this node; one sent ``to=`` a node is for that node alone
        :param queue_size: messages kept for each slow receiver; the oldest are dropped
        :param wait: as in :meth:`interested_in`
        :raises MasterUnreachableError: if the master does not answer; nothing is left behind then
        """
        return self._topic(topic).output_channel(self._node, typed_as, latch, queue_size, wait=wait)

    def send_to(
        self,
        topic: str,
        block: Union[Block, Dict[str, Any], genpy.Message, None] = None,
        *,
        typed_as: TypedAs = None,
        to: 'Peer' = None,
        connect_timeout: Optional[float] = None,
        wait: float = 0,
        **fields: Any,
    ) -> genpy.Message:
        """Send one message, filled by keywords, ``block(message)``, or both; or a ready message.
        Returns it.

        The report (listing 3.1)::

            self sendTo: '/turtle1/command_velocity'
                a: [:message | message angular: 1.0. message linear: 2.0]
            self.send_to('/turtle1/command_velocity', angular=1.0, linear=2.0)

        Fields that have the name of one of these keywords are given in a dict, with all others::

            self.send_to('/orders', {'to': 'kitchen', 'wait': 5.0})

        The first message on a topic waits for the subscribers that the master knows, for up to
        ``connect_timeout`` seconds (None: the node's), so that it is not lost. A topic that has no
        type yet gets that of a ready message.

        :param block: ``block(message)``, a dict of fields, or a ready message, sent as it is
        :param to: send it to that node alone: a name, resolved as the topic's is, a Node or
            ExternalNode. One that is not interested in the topic gets nothing, and the log says so
            once.
        :param wait: as in :meth:`interested_in`
        :raises UnknownNodeError: if there is no node ``to``
        :raises ValueError: if ``topic`` or ``to`` cannot be a name
        :raises MessageTypeError: if a field does not exist or does not fit, or a ready message is
            of another type than the topic
        :raises UnknownTopicError, UnknownTypeError: if there is no type
        """
        run = self.current_run
        channel = run.send_channels.get(topic) if isinstance(topic, str) else None
        own: Optional[Dict[str, Any]] = None
        if to is not None or connect_timeout is not None or wait != 0:
            own = {'to': to, 'connect_timeout': connect_timeout, 'wait': wait or None}
            with time_limit(HINT_TIMEOUT):
                find = self._class_finder(topic, typed_as)
                cls = channel.message_class if channel else attempt(find)
            messages.check_not_hidden(cls, block, **own)
        if to is not None:
            to = run.resolve_peer(to)
        if connect_timeout is None:
            connect_timeout = self.connect_timeout
        else:
            connect_timeout = check_seconds('connect_timeout', connect_timeout)
        if wait != 0:
            wait = check_seconds('wait', wait, least=0)
        if channel is None or not channel.is_open:
            if not isinstance(block, genpy.Message):
                check_filler(block, self._class_finder(topic, typed_as))
            elif typed_as is None:
                typed_as = self._topic(topic).class_for(block)
            channel = run.sender(self._topic(topic), typed_as, connect_timeout, wait)
            run.send_channels[topic] = channel
            if own:
                messages.check_not_hidden(channel.message_class, block, **own)
        if typed_as not in (None, channel.message_class, channel.type):
            self._topic(topic).message_class(self._node, typed_as)  # refuses another type
        # another thread may be opening it just now
        channel.wait_until_connected(run, connect_timeout)
        return channel.send(block, to=to, **fields)

    def _class_finder(self, topic: str, typed_as: TypedAs) -> Callable[[], Any]:
        """Finds the class of what is sent on a topic, before a channel is opened."""
        return lambda: self._topic(topic).message_class(self._node, typed_as)

    @tells_keywords
    def wait_for_message(
        self,
        topic: str,
        typed_as: TypedAs = None,
        timeout: Optional[float] = None,
        where: Optional[Callable[[Any], Any]] = None,
    ) -> genpy.Message:
        """Wait for the next message on a topic, and return it; the latched one where there is one.
        As rospy's, with whose arguments it may be called::

            scan = self.wait_for_message('/scan', timeout=5)
            near = self.wait_for_message('/scan', where=lambda scan: min(scan.ranges) < 0.5)

        In any thread: a soul, a delegate, the main one. The node is interested in the topic for as
        long as it takes, and its delegates do not get the message for that.

        :param typed_as: as in :meth:`interested_in`. Without it, a topic that nobody has given a
            type yet is waited for, too, where there is a ``timeout``.
        :param timeout: seconds of wall time; None: without limit
        :param where: only a message for which ``where(message)`` holds; what it raises is raised
            here
        :raises TimeoutError: if none comes in time
        :raises UnknownTopicError: if the topic has no type, by then
        :raises NodeStoppedError: if the node stops meanwhile, or the one whose block waits
        :raises PharosError: in a delegate that runs in the thread which reads that topic's socket
        :raises UnknownTypeError, MessageTypeError, ValueError, MasterUnreachableError: as
            :meth:`interested_in`
        """
        return next_message(self._node, self._topic(topic), typed_as, timeout, where)

    @property
    def channels(self) -> List[AnyChannel]:
        """The channels that the node has open."""
        return self.latest_run.channels if self.latest_run else []

    @property
    def _node(self) -> 'Node':
        """It itself: there are no others that have topics than nodes."""
        node: Any = self
        return node

    def _topic(self, name: str) -> Topic:
        return Topic(self.master, self.current_run.resolve(name, 'topic'))
