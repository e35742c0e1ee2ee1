"""Receive from a topic for a while. Each function starts a node of its own, and stops the node."""
from __future__ import annotations

import contextlib
import itertools
import queue
import time
from typing import TYPE_CHECKING, Any, Iterator, NamedTuple

import rosgraph.names
import rospy
from genpy import Message

from pharos.blocks import Block
from pharos.errors import UnknownTopicError
from pharos.live.text_format import message_text, short_number
from pharos.node import BlockNode
from pharos.transcript import Transcript

if TYPE_CHECKING:
    from pharos.topic import Topic

LAST_TIMEOUT = 3.0  # seconds that Topic.last waits
FIRST_TIMEOUT = 1.0  # seconds that a measurement waits for the first message
MAX_ARRIVALS = 1000  # messages that wait; further ones are dropped


class Rate(NamedTuple):
    """The rate and the size of the messages of a topic, as measured for a while."""

    topic: str
    rate: float  # messages in one second
    bandwidth: float  # bytes in one second
    window: int  # messages that were counted

    def __repr__(self):
        bandwidth = f'{short_number(self.bandwidth)}B/s'
        return f'{self.rate:.4g} Hz, {bandwidth}, {self.window} messages'


@contextlib.contextmanager
def arrival_queue(topic: Topic, typed_as: Any = None) -> Iterator[queue.Queue]:
    """Receive from a topic into a queue of pairs: time.monotonic() at the arrival, and message.

    :raises UnknownTopicError: if nobody publishes on the topic
    """
    if not topic.publishers:
        raise UnknownTopicError(f'nobody publishes on {topic.name}: see master.topics()')
    arrivals: queue.Queue = queue.Queue(MAX_ARRIVALS)

    def keep_message(message):
        with contextlib.suppress(queue.Full):
            arrivals.put_nowait((time.monotonic(), message))

    name = rosgraph.names.anonymous_name('pharos_looks')
    with topic.master.create(BlockNode, named=name) as node:
        node.interested_in(topic.name, typed_as, delegate=keep_message)
        yield arrivals


def _collect_arrivals(arrivals, seconds):
    """Return the arrivals of some seconds, which begin with the first one."""
    arrival_list: list[Any] = []
    deadline = time.monotonic() + seconds + FIRST_TIMEOUT
    with contextlib.suppress(queue.Empty):
        while time.monotonic() < deadline:
            arrival = arrivals.get(timeout=max(0.0, deadline - time.monotonic()))
            if not arrival_list:
                deadline = arrival[0] + seconds
            arrival_list.append(arrival)
    return arrival_list


def measure(topic: Topic, seconds: float) -> Rate:
    """Measure the rate of a topic for :meth:`Topic.hz`."""
    with arrival_queue(topic, rospy.AnyMsg) as arrivals:
        arrival_list = _collect_arrivals(arrivals, seconds)
    times = [time for time, _ in arrival_list]
    byte_count = sum(len(message._buff) for _, message in arrival_list)
    rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 0.0
    return Rate(topic.name, rate, byte_count / seconds, len(arrival_list))


def last(topic: Topic) -> Message:
    """Return the message of :attr:`Topic.last`.

    :raises TimeoutError: if no message arrives within 3 s
    """
    with arrival_queue(topic) as arrivals, contextlib.suppress(queue.Empty):
        return arrivals.get(timeout=LAST_TIMEOUT)[1]
    raise TimeoutError(f'no message came on {topic.name} within {LAST_TIMEOUT:g} s')


def watch(topic: Topic, count: int | None, block: Block | None) -> None:
    """Run the block of :meth:`Topic.watch` on messages, or show them.

    :param count: the number of messages; None: until Ctrl-C, which ends the call in any case
    """
    show_message = block or _show_message
    numbers = itertools.count() if count is None else range(count)
    with arrival_queue(topic) as arrivals, contextlib.suppress(KeyboardInterrupt):
        for _ in numbers:
            show_message(arrivals.get()[1])


def _show_message(message):
    Transcript.show(f'{message_text(message)}\n---')
