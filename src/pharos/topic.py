"""Topics, which hand nodes their channels."""
from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from genpy import Message

from pharos.blocks import Block
from pharos.channels import Channel, InputChannel, OutputChannel

if TYPE_CHECKING:
    from pharos.master import Master
    from pharos.node import Node


@dataclasses.dataclass(frozen=True)
class Topic:
    """A topic of a master: the named bus, which hands nodes their channels.

    :ivar name: the topic's full name
    """

    master: Master
    name: str

    @property
    def type(self) -> str | None:
        """The name of the topic's message type, None if the master knows none."""
        return self.master.topic_type(self.name)

    @property
    def publishers(self) -> list[str]:
        """The names of the nodes that publish on the topic."""
        return self.master.system_state()[0].get(self.name, [])

    @property
    def subscribers(self) -> list[str]:
        """The names of the nodes that receive from the topic."""
        return self.master.system_state()[1].get(self.name, [])

    @property
    def channels(self) -> list[Channel]:
        """The open channels of this topic in nodes of this process."""
        channels = [channel for node in self.master.own_nodes() for channel in node.channels]
        return [channel for channel in channels if channel.topic == self.name]

    def hz(self, seconds: float = 1.0):
        """Measure the rate and the size of messages for some seconds; ``bw`` is the same method.

        :raises UnknownTopicError: if nobody publishes on the topic
        """
        from pharos.live import watching

        return watching.measure(self, seconds)

    bw = hz

    @property
    def last(self) -> Message:
        """The latched message, or else the next one.

        :raises UnknownTopicError: if nobody publishes on the topic
        :raises TimeoutError: if no message comes within 3 s
        """
        from pharos.live import watching

        return watching.last(self)

    def watch(self, count: int | None = None, block: Block | None = None) -> None:
        """Show the next messages, or run ``block(message)`` on them.

        :param count: the number of messages, None: until Ctrl-C
        """
        from pharos.live import watching

        watching.watch(self, count, block)

    def input_channel(self, node: Node, typed_as=None, **options) -> InputChannel:
        """Hand a node its end to receive at; see :meth:`Node.interested_in`."""
        return node.interested_in(self.name, typed_as, **options)

    def output_channel(self, node: Node, typed_as=None, **options) -> OutputChannel:
        """Hand a node its end to send at; see :meth:`Node.output_channel`."""
        return node.output_channel(self.name, typed_as, **options)
