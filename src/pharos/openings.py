"""What a run of a node has open: channels, services and plots."""
import threading
from typing import TYPE_CHECKING, Any, Callable, Dict, List

from pharos import node_registry
from pharos.channel import InputChannel
from pharos.errors import NodeStoppedError
from pharos.intraprocess.fanout import Latch
from pharos.output_channel import OutputChannel
from pharos.topic import Topic

if TYPE_CHECKING:
    from pharos.node import Node


class Openings:
    """What is open, and what is to be opened again, as a :class:`~pharos.run.Run` has it.

    :attr:`opened` are those that it has, also those that are to be opened again, in the order of
    their opening.
    """

    def __init__(self, node: 'Node') -> None:
        self.node = node
        self.opened: List[Any] = []
        # topic name, as given to send_to -> its OutputChannel
        self.send_channels: Dict[str, Any] = {}
        # topic name -> the lock of the thread that opens a channel to send on it
        self._opening: Dict[str, Any] = {}
        self._is_closed = False  # whether the stop has come to what is open
        self._to_reopen: List[Any] = []  # those of the former run's that are closed still
        # what the former run had open, where the class's own start() opens channels: a channel that
        # it opens for a topic that one of these latched on goes on with that one's Latch
        self._former_opened: List[Any] = []

    @property
    def is_over(self) -> bool:
        """Whether the run has ended."""
        raise NotImplementedError

    def remember(
        self,
        opened: Any,
        what: str,
        take: Callable[[], Any] = lambda: None,
        give_back: Callable[[], Any] = lambda: None,
    ) -> None:
        """A channel or service is open from now on, also after a restart.

        :param what: its topic or name, for the error
        :param take: ``take()`` has it be open; raises nothing, and waits for nothing
        :raises NodeStoppedError: if the run has ended, after ``give_back()``: perhaps another one is
            there by now, which has opened it
        """
        with node_registry.changed:
            if not (self._is_closed or self.is_over):
                if opened not in self.opened:
                    # replaced, so that others may iterate meanwhile
                    self.opened = [*self.opened, opened]
                take()
                return
        give_back()
        raise NodeStoppedError(f'{self.node.name} stopped while it opened {what}: open it again')

    def forget(self, opened: Any) -> None:
        """It was closed for good."""
        with node_registry.changed:
            self.opened = [other for other in self.opened if other is not opened]
            self.send_channels.clear()

    def reopen(self, opened: Any) -> None:
        """Open what the former run had open, unless that is done, or a thread is doing it."""
        with node_registry.changed:
            if opened not in self._to_reopen:
                return
            self._to_reopen.remove(opened)
        try:
            opened.open(self)
        except BaseException:
            self._to_reopen.append(opened)  # for the next who needs it
            raise

    def latch_for(self, topic: str, message_class: Any) -> Latch:
        """The Latch of a new channel: the former run's, where start() opens that channel anew."""
        with node_registry.changed:
            for channel in self._former_opened:
                if (
                    isinstance(channel, OutputChannel)
                    and (channel.topic, channel.message_class) == (topic, message_class)
                    and channel.latched
                    and not channel.closed
                ):
                    self._former_opened.remove(channel)
                    return channel.latched
        return Latch()

    @property
    def channels(self) -> List[Any]:
        """The channels that are open."""
        channels = (InputChannel, OutputChannel)
        return [each for each in self.opened if isinstance(each, channels) and each.is_open]

    def sender(
        self, topic: Topic, typed_as: Any, connect_timeout: float, wait: float
    ) -> OutputChannel:
        """The channel for ``send_to``, opened by the first of several threads that come at once,
        for which the others wait."""
        opening = self._opening.setdefault(topic.name, threading.RLock())
        limit = max(0.0, wait + connect_timeout)
        # False: another thread is still opening it; this one then tries by itself
        is_mine = opening.acquire(timeout=min(limit, threading.TIMEOUT_MAX))
        try:
            for channel in self.opened:
                if isinstance(channel, OutputChannel) and channel.topic == topic.name:
                    self.reopen(channel)  # else a start would open it beside another one
                    return channel
            return topic.output_channel(
                self.node, typed_as, connect_timeout=connect_timeout, wait=wait
            )
        finally:
            if is_mine:
                opening.release()

    def close_opened(self) -> None:
        """The node stops, and its rospy closes all of it: nothing more is opened."""
        with node_registry.changed:
            self._is_closed = True
        for opened in self.opened:
            opened.node_stopped()
