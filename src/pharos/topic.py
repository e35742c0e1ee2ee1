"""Topics: named buses, and the dispatchers that hand a node its channel."""
import time
from typing import (
    TYPE_CHECKING,
    Any,
    Callable,
    Dict,
    Iterator,
    List,
    Optional,
    Tuple,
    Type,
    TypeVar,
    Union,
)

import genpy
import rosgraph

from pharos import messages, node_registry, on_demand
from pharos.channel import Channel, InputChannel
from pharos.errors import (
    MasterUnreachableError,
    MessageTypeError,
    NodeStoppedError,
    PharosError,
    UnknownTopicError,
    UnknownTypeError,
    suggest,
)
from pharos.output_channel import OutputChannel
from pharos.private_rospy.deadlines import MARGIN, time_limit
from pharos.private_rospy.tcpros_connection import ask_publisher
from pharos.seconds import check_seconds

if TYPE_CHECKING:
    from pharos.live.watching import Bandwidth, Rate
    from pharos.master import Master
    from pharos.node import Node

POLL = 0.05  # seconds between two looks at the master's types
#: a type name or message class; None: what the node or the master knows
TypedAs = Union[None, str, Type[genpy.Message]]
InputType = TypeVar('InputType', bound=InputChannel)
QUEUE_SIZE = 1000  # messages kept for a slow receiver, where nothing else is said


class Topic:
    """A topic of one master.

    The report: "When a node asks for information or publishes information, it asks the right
    instance of PhaROSTopic to give it the correct channel." Topics hold no state: ask
    :meth:`Master.topic <pharos.Master.topic>` as you like.

    :ivar master: the :class:`Master` that it is of
    :ivar name: its full name
    """

    def __init__(self, master: 'Master', name: str) -> None:
        self.master = master
        self.name = name

    @property
    def type(self) -> str:
        """The type name, such as 'turtlesim/Velocity'.

        :raises UnknownTopicError: if the master knows no such topic, or nobody has given its type
            yet
        """
        types = dict(self.master.topic_types())
        name = types.get(self.name, rosgraph.names.ANYTYPE)
        if name != rosgraph.names.ANYTYPE:
            return name
        if self.publishers or self.subscribers:  # rosmaster does not list these
            raise UnknownTopicError(
                f'the type of {self.name} is not known yet, for only nodes of any type are there:'
                ' name it with typed_as=, or start the other node first'
            )
        raise UnknownTopicError(
            f'no node of {self.master.url} publishes or subscribes to'
            f' {self.name}{suggest(self.name, types)}: name its type with typed_as=, or'
            ' start the other node first'
        )

    @property
    def publishers(self) -> List[str]:
        """Names of the nodes that publish on it."""
        return self.master.system_state()[0].get(self.name, [])

    @property
    def subscribers(self) -> List[str]:
        """Names of the nodes that are interested in it."""
        return self.master.system_state()[1].get(self.name, [])

    @property
    def channels(self) -> List[Channel]:
        """The channels that nodes of this process have open on it."""
        return [
            channel
            for node in self.master.local_nodes()
            for channel in node.channels
            if channel.topic == self.name
        ]

    # -- for looking, at no cost while nobody does: :mod:`pharos.live.watching`

    def hz(self, seconds: float = 3.0) -> 'Rate':
        """How often messages come on it, counted for ``seconds`` of wall time: ``rostopic hz``.

        :returns: ``rate, min, max, std_dev, window``; 0 messages a second where fewer than two came
        :raises UnknownTopicError: if nobody publishes on it
        :raises NodeStoppedError: if the node whose soul or delegate asks stops meanwhile
        """
        rate: 'Rate' = _watching().hz(self, seconds)
        return rate

    def bw(self, seconds: float = 3.0) -> 'Bandwidth':
        """How many bytes a second come on it, counted as :meth:`hz` does: ``rostopic bw``.

        :returns: ``rate, mean, min, max, window``, in bytes; for INTRAPROCESS the bytes that TCPROS
            would have
        """
        bandwidth: 'Bandwidth' = _watching().bw(self, seconds)
        return bandwidth

    @property
    def last(self) -> genpy.Message:
        """The last message: at once where it is latched, else the next, within 3 s.

        :raises UnknownTopicError: if nobody publishes on it
        :raises TimeoutError: if none comes in time
        """
        return _watching().last(self)

    def watch(
        self, count: Optional[int] = None, block: Optional[Callable[[genpy.Message], Any]] = None
    ) -> None:
        """Show the next messages as they come, with long arrays cut: ``rostopic echo --noarr``.

        Ctrl-C ends it, and where this is no prompt, stops all nodes, as in :func:`spin`.

        :param count: how many, None: without end
        :param block: run ``block(message)`` in this thread instead of showing it on the Transcript
        :raises UnknownTopicError: if nobody publishes on it
        """
        _watching().watch(self, count, block)

    def input_channel(
        self,
        node: 'Node',
        typed_as: TypedAs = None,
        delegate: Optional[Callable[..., Any]] = None,
        queue_size: int = QUEUE_SIZE,
        inline: bool = False,
        shared: bool = False,
        from_: Any = None,
        wait: float = 0,
    ) -> InputChannel:
        """A new :class:`~pharos.InputChannel` of ``node``; see :meth:`Node.interested_in`.

        :raises TypeError, ValueError: if that is no node of this process, or one of another master
        """
        return self.open_input(
            InputChannel,
            node,
            typed_as,
            wait,
            delegate=delegate,
            queue_size=queue_size,
            inline=inline,
            shared=shared,
            from_=from_,
        )

    def open_input(
        self,
        channel_class: Type[InputType],
        node: 'Node',
        typed_as: TypedAs,
        wait: float,
        **options: Any,
    ) -> InputType:
        """A new input channel of that class, as :meth:`input_channel` gives it to ``node``.

        :param options: of the class
        """
        self._check_node(node)
        is_first = all(channel.topic != self.name for channel in node.channels)
        message_class = self.message_class(node, typed_as, wait, receives=True)
        if not is_first or message_class is typed_as or not messages.is_provisional(message_class):
            return channel_class(node, self.name, message_class, **options)
        with node.latest_run.rospy.refusals.held(self.name):
            channel = channel_class(node, self.name, message_class, **options)
            self._agree_with_publishers(channel)
        return channel

    def output_channel(
        self,
        node: 'Node',
        typed_as: TypedAs = None,
        latch: bool = False,
        queue_size: int = QUEUE_SIZE,
        connect_timeout: Optional[float] = None,
        wait: float = 0,
    ) -> OutputChannel:
        """A new :class:`~pharos.OutputChannel` of ``node``; see :meth:`Node.output_channel`.

        :raises TypeError, ValueError: as :meth:`input_channel`
        """
        self._check_node(node)
        return OutputChannel(
            node,
            self.name,
            self.message_class(node, typed_as, wait),
            latch=latch,
            queue_size=queue_size,
            connect_timeout=connect_timeout,
        )

    def message_class(
        self, node: 'Node', typed_as: TypedAs = None, wait: float = 0, receives: bool = False
    ) -> Type[genpy.Message]:
        """The message class of the topic for ``node``: ``typed_as``, else what the node knows, else
        the master's.

        Where no package here has the type, one who receives takes a live publisher's definition
        before one that was given at run time or is shipped: another would never connect.

        :param wait: seconds to wait until somebody has given it a type, and its definition where it
            is not known here
        :raises MessageTypeError: if the node uses the topic with another type already
        :raises NodeStoppedError: if the node stops meanwhile
        """
        wait = check_seconds('wait', wait, least=0)
        with time_limit(wait + MARGIN if wait else None):
            return self._message_class(node, typed_as, wait, receives)

    def class_for(self, message: genpy.Message) -> Type[genpy.Message]:
        """The message class by which a ready message is sent: its own.

        :raises MessageTypeError: if the topic is known to the master with another type
        """
        try:
            known = self.type
        except UnknownTopicError:
            known = message._type
        if message._type not in (known, rosgraph.names.ANYTYPE):
            raise MessageTypeError(f'{self.name} carries {known}, not {message._type}')
        return type(message)

    def _check_node(self, node: Any) -> None:
        if not node_registry.is_node(node):
            raise TypeError(
                f'a channel on {self.name} is given to a node of this process, not to {node!r}'
            )
        if node.master != self.master:
            raise ValueError(
                f'{self} is at another master than {node.name}: ask that for its topic'
            )
        node.current_run  # raises where it is stopped

    def _message_class(
        self, node: 'Node', typed_as: TypedAs, wait: float, receives: bool
    ) -> Type[genpy.Message]:
        known = next(
            (channel.message_class for channel in node.channels if channel.topic == self.name), None
        )
        if known and typed_as in (None, known._type):
            return known
        if typed_as is None:
            return self._class_in_time(node, time.monotonic() + wait, receives)
        asked = self._class_of(typed_as, receives)
        if known and asked._md5sum != known._md5sum:
            raise MessageTypeError(
                f'{node.name} uses {self.name} with the type {known._type} [{known._md5sum}]'
                f' already and cannot use it as {asked._type} [{asked._md5sum}] too: close that'
                ' channel first'
            )
        return asked

    def _class_of(self, type_or_class: Any, receives: bool) -> Type[genpy.Message]:
        """The class of a type: known here, or as the topic's publishers define it."""
        try:
            known = messages.message_class(type_or_class)
        except UnknownTypeError:
            own = self._local_classes(type_or_class)
            if own:
                return own[0]
            found = messages.class_from_publishers(self.name, type_or_class, self._headers())
            if found is None:
                raise
            return found
        if receives and known is not type_or_class and messages.is_provisional(known):
            own = self._local_classes(known._type)
            return next((cls for cls in own if cls._md5sum == known._md5sum), (own or [known])[0])
        return known

    def _headers(self) -> Iterator[Tuple[str, Dict[str, str]]]:
        """``(node name, connection header)`` of each publisher that answers, one by one."""
        for name in self.publishers:
            try:
                uri = self.master.call('lookupNode', name)
            except (rosgraph.MasterException, MasterUnreachableError):
                continue
            yield name, ask_publisher(uri, self.name)

    def _local_classes(self, type_: Any) -> List[Type[genpy.Message]]:
        """The classes with which nodes of this process publish that type on the topic."""
        instances = [node.latest_run.rospy for node in self.master.local_nodes()]
        classes = [instance.published_class(self.name) for instance in instances]
        return [cls for cls in classes if cls and cls._type == type_]

    def _agree_with_publishers(self, channel: InputChannel) -> None:
        """Have an input channel take the definition of a publisher elsewhere, where none suits it
        as it is.

        A publisher that is only asked for its definition takes that for a subscriber, and sends to
        nobody. So the channel subscribes with the definition that is known here, and one who
        refuses is believed.
        """
        instance = channel.node.latest_run.rospy
        instance.wait_until(
            lambda: instance.connections.has_heard_from_publishers(self.name),
            channel.node.connect_timeout,
        )
        if instance.connections.hears(self.name):
            return
        for refusal in instance.refusals.of(self.name):
            if refusal.offered.get('type') == channel.type:
                try:
                    cls = messages.class_of_header(refusal.offered)
                except PharosError:
                    continue  # it is told as one that cannot be heard
                channel.subscribe_as(cls)
                return

    def _class_in_time(self, node: 'Node', deadline: float, receives: bool) -> Type[genpy.Message]:
        """The class of the master's type, which may come until the deadline."""
        while True:
            try:
                return self._class_of(self.type, receives)
            except (UnknownTopicError, UnknownTypeError):  # no publisher is there yet
                if time.monotonic() >= deadline:
                    raise
            except NodeStoppedError as error:
                raise self._stopped(node) from error
            if node.latest_run.rospy.ended.wait(POLL):  # a master tells nobody of new types
                raise self._stopped(node)

    def _stopped(self, node: 'Node') -> NodeStoppedError:
        return NodeStoppedError(
            f'{node.name} stopped while it waited for the type of {self.name}: start it again first'
        )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Topic) and (self.name, self.master) == (other.name, other.master)

    def __hash__(self) -> int:
        return hash((self.name, self.master))

    def __repr__(self) -> str:
        return f'<Topic {self.name} of {self.master.url}>'


def _watching() -> Any:
    return on_demand.module('live.watching')
