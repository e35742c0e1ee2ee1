"""Receive from a topic for a while. Each function starts a node of its own, and stops the node."""
from __future__ import annotations

import contextlib
import itertools
import queue
import time
from typing import TYPE_CHECKING, Iterator, NamedTuple

import rospy
from genpy import Message
from rosgraph.names import anonymous_name

from pharos.blocks import Block
from pharos.errors import UnknownTopicError
from pharos.live.text_format import message_text
from pharos.node import BlockNode
from pharos.transcript import Transcript
from pharos.waiting import wait

if TYPE_CHECKING:
    from pharos.topic import Topic

LAST_TIMEOUT = 3.0  # seconds that Topic.last waits
FIRST_TIMEOUT = 1.0  # seconds that a measurement waits for the first message
MAX_WAITING = 1000  # messages that wait for the block of watch(); further ones are dropped


class Rate(NamedTuple):
    """The rate and the size of the messages of a topic, as measured for a while."""

    rate: float  # messages in one second
    bandwidth: float  # bytes in one second
    window: int  # messages that were counted


@contextlib.contextmanager
def looking_node(topic: Topic) -> Iterator[BlockNode]:
    """Create a node that lives in the ``with`` block, to receive from a topic.

    :raises UnknownTopicError: if nobody publishes on the topic
    """
    if not topic.publishers:
        raise UnknownTopicError(f'nobody publishes on {topic.name}: see master.topics()')
    name = anonymous_name('pharos_looks')
    with topic.master.create(BlockNode, named=name) as node:
        yield node


def measure(topic: Topic, seconds: float) -> Rate:
    """Measure the rate of a topic for :meth:`Topic.hz`, from the first message on."""
    times: list[float] = []
    sizes: list[int] = []

    def count(message):
        times.append(time.monotonic())
        sizes.append(len(message._buff))

    with looking_node(topic) as node:
        node.interested_in(topic.name, rospy.AnyMsg, delegate=count)
        if wait(lambda: times, seconds + FIRST_TIMEOUT):
            time.sleep(seconds)
    rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 0.0
    return Rate(rate, sum(sizes) / seconds, len(times))


def last(topic: Topic) -> Message:
    """Return the message of :attr:`Topic.last`."""
    with looking_node(topic) as node:
        return node.wait_for_message(topic.name, timeout=LAST_TIMEOUT)


def watch(topic: Topic, count: int | None, block: Block | None) -> None:
    """Run the block of :meth:`Topic.watch` on messages, or show them.

    :param count: the number of messages; None: until Ctrl-C, which ends the call in any case
    """
    show_message = block or _show_message
    messages: queue.Queue = queue.Queue(MAX_WAITING)

    def keep_message(message):
        with contextlib.suppress(queue.Full):
            messages.put_nowait(message)

    with looking_node(topic) as node, contextlib.suppress(KeyboardInterrupt):
        node.interested_in(topic.name, delegate=keep_message)
        for message in itertools.islice(iter(messages.get, None), count):
            show_message(message)


def _show_message(message):
    Transcript.show(f'{message_text(message)}\n---')
