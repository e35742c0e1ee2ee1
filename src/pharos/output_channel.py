"""Output channels: the end of a topic at which a node sends."""
import reprlib
import threading
import time
from typing import TYPE_CHECKING, Any, Callable, Dict, NoReturn, Optional, Set, Type, Union

import genpy

from pharos import first_message, messages
from pharos.blocks import check_filler, check_flag, check_runs
from pharos.channel import Channel
from pharos.errors import MessageTypeError, NodeStoppedError
from pharos.intraprocess.copier import copier_for
from pharos.intraprocess.fanout import ClosedFanout
from pharos.private_rospy.deadlines import time_limit
from pharos.private_rospy.registration import REGISTER_TIMEOUT
from pharos.seconds import check_limit
from pharos.signals import is_from_signal

if TYPE_CHECKING:
    from pharos.node import Node
    from pharos.run import Run


class OutputChannel(Channel):
    """The end at which a node sends, as :meth:`Node.output_channel` or ``send_to`` makes it.

    :ivar node: the node that has it
    :ivar topic: the name of the topic
    :ivar message_class: the class of its messages
    :ivar sent: how many messages were published
    :ivar latch: whether those get the last one who become interested later
    :ivar latched: what keeps it for them; None: nothing does
    :ivar refused: 0, for only an InputChannel refuses
    :ivar queue_size: messages that may wait for a slow receiver
    :ivar queue_bytes: bytes of large messages that may
    :ivar closed: whether it was closed for good
    """

    def __init__(
        self,
        node: 'Node',
        topic: str,
        message_class: Type[genpy.Message],
        latch: bool = False,
        queue_size: int = 1,
        connect_timeout: Optional[float] = None,
    ) -> None:
        super().__init__(node, topic, message_class, queue_size)
        self.latch = check_flag('latch', latch, ': a number of messages is queue_size=')
        self.latched = self._run.latch_for(topic, message_class) if latch else None
        self.sent = 0
        self._uninterested: Set[str] = set()  # names of nodes of which the log says so
        self._freeze = copier_for(message_class).freeze
        self._fanout: Any = ClosedFanout
        self._opener: Optional[threading.Thread] = None
        self._connected = threading.Event()
        self._begin(connect_timeout)

    def open(self, run: 'Run', connect_timeout: Optional[float] = None) -> None:
        timeout = self.node.connect_timeout if connect_timeout is None else connect_timeout
        deadline = time.monotonic() + timeout
        self._opener = threading.current_thread()
        try:
            endpoint = run.rospy.connections.advertise(
                self.topic,
                self.message_class,
                self.latched,
                timeout,
                self.queue_size,
                self.queue_bytes,
            )
            self._opened(
                run, endpoint, lambda: run.rospy.connections.unadvertise(endpoint, self.latched)
            )
            first_message.wait_for_known_subscribers(self, timeout, deadline)
        finally:
            self._connected.set()

    def _take(self, endpoint: Any) -> None:
        super()._take(endpoint)
        self._fanout = endpoint.impl.fanout

    def wait_until_connected(self, run: 'Run', timeout: float) -> None:
        """Wait for up to ``timeout`` seconds while another thread opens the channel and connects it
        to the subscribers that the master knows.

        :param run: that of the node with whose stop the wait ends
        """
        connected = self._connected  # another one from the stop on, which the next start sets
        if self._opener is not threading.current_thread() and not run.is_ending:
            connected.wait(timeout)

    def publish(self, message: genpy.Message, to: Any = None) -> None:
        """Send ``message`` to all who are interested, or to the node ``to`` alone.

        :param to: a name, Node or ExternalNode; see :meth:`Node.send_to`
        :raises MessageTypeError: if it is of another type, or a field holds what does not fit
        :raises UnknownNodeError: if there is no node ``to``
        :raises NodeStoppedError: if the channel is closed
        """
        if message.__class__ is not self.message_class:
            self._check_type(message)
        if to is not None:
            to = str(self._run.resolve_peer(to))
            self._check_is_there(to)
        try:
            is_sent = self._fanout.publish(message, self.latched, to)
        except Exception as error:
            self._explain(error, message)
        if is_sent or to is None:
            self.sent += 1

    def _check_is_there(self, name: str) -> None:
        """Raise UnknownNodeError if a message for that node alone has nowhere to go, since there is
        no such node."""
        endpoint = self._endpoint
        if endpoint is None or self._rospy.connections.reaches(endpoint, name):
            return
        with time_limit(max(REGISTER_TIMEOUT, self.node.connect_timeout)):
            self.node.master.uri_of(name)
        if name not in self._uninterested and not self.latch:
            self._uninterested.add(name)
            self.node.log(
                f'{name} is not interested in {self.topic}, or not connected yet: what'
                f' {self.node.name} sends to it alone goes nowhere',
                level='warning',
            )

    def _check_type(self, message: Any) -> None:
        allowed = self.message_class._md5sum, '*'
        if not isinstance(message, genpy.Message) or message._md5sum not in allowed:
            is_value = not isinstance(message, genpy.Message)
            raise MessageTypeError(
                f'{self.topic} carries {self.type}'
                f' ({messages.describe_fields(self.message_class)}), not'
                f' {reprlib.repr(message) if is_value else message._type}'
                + (': send() fills one by the names of its fields' if is_value else '')
            )

    def _explain(self, error: Exception, message: genpy.Message) -> NoReturn:
        """Raise our error for one that publishing raised, but that of a handler of signals."""
        if is_from_signal(error):
            raise error
        if not self.is_open or self._rospy.connections.is_closed(self._endpoint):
            raise NodeStoppedError(
                f'the channel of {self.node.name} on {self.topic} is closed: open another with'
                ' output_channel()'
            ) from error
        messages.check_fits(message)
        raise MessageTypeError(f'{self.type} cannot be sent on {self.topic}: {error}') from error

    def _unregister(self, endpoint: Any) -> None:
        self._fanout = ClosedFanout
        self._rospy.connections.unadvertise(endpoint, self.latched)

    def send(
        self,
        block: Union[Callable[[Any], Any], Dict[str, Any], genpy.Message, None] = None,
        *,
        to: Any = None,
        **fields: Any,
    ) -> Any:
        """Fill a fresh message and publish it, as :meth:`Node.send_to` does; returns it.

        :param block: ``block(message)`` that fills it; a dict of its fields, in which alone a field
            is set that is called ``block`` or ``to``; or a ready message, which is sent as it is
        :param to: see :meth:`Node.send_to`
        :param fields: by their names
        :raises TypeError: for a ready message and keywords beside it
        """
        if isinstance(block, genpy.Message):
            message = block
            self._check_type(message)
            messages.check_alone(message, fields)
        else:
            if to is not None:
                messages.check_not_hidden(self.message_class, block, to=to)
            if block is not None:
                check_runs(block, 'a block')
            try:
                message = messages.build(self.message_class, block, fields)
            except TypeError:
                check_filler(block, lambda: self.message_class)  # says how it is called
                raise
        if not self._fanout.connections:  # with nobody interested, nobody else looks at it
            try:
                self._freeze(message)
            except Exception:
                messages.check_fits(message)
                raise
        self.publish(message, to)
        return message

    def wait_for_subscribers(self, count: int = 1, timeout: Optional[float] = None) -> bool:
        """Wait until ``count`` subscribers are connected, for up to ``timeout`` seconds (None:
        without limit).

        Returns whether they are; ends early, with False, when the node stops; a soul of the node is
        ended by that.
        """
        timeout = check_limit('timeout', timeout)
        if self.is_open:
            self._rospy.wait_until(
                lambda: len(self.connections) >= count or not self.is_open, timeout
            )
        self._run.souls.end()
        return self.is_open and len(self.connections) >= count

    def node_stopped(self) -> None:
        super().node_stopped()
        self._fanout = ClosedFanout
        self._connected.set()
        self._opener, self._connected = None, threading.Event()
