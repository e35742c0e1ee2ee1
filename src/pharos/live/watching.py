"""Looks at a topic for a while: :meth:`Topic.hz <pharos.Topic.hz>`, ``bw``, ``last`` and ``watch``.

Each look has a node of its own, under a name of its own, which is stopped at its end: the nodes of
the program stay as they are, and there may be none.
"""
import dataclasses
import itertools
import statistics
import threading
from typing import Any, Callable, Iterator, Optional

import genpy
import rosgraph

from pharos.blocks import check_block
from pharos.counts import counted
from pharos.errors import NodeStoppedError, UnknownTopicError, suggest
from pharos.live.figures import number_text, rate_text, size_text
from pharos.live.message_text import text_of_message
from pharos.lookers import LOOKER
from pharos.master import Master
from pharos.node import BlockNode
from pharos.probe import Listener, Look, Probe, wait_for_publishers
from pharos.seconds import LONGEST, check_seconds
from pharos.topic import Topic
from pharos.transcript import Transcript

LAST_TIMEOUT = 3.0  # seconds that Topic.last waits for a message
_numbers = itertools.count(1)


@dataclasses.dataclass(frozen=True)
class Rate:
    """How often messages came: what ``rostopic hz`` tells. As a number, that of messages a second.

    The last three are seconds from one message to the next, and 0 where there were not two.
    """

    topic: str
    rate: float  #: messages a second; 0 where there were not two, which it takes to tell
    window: int  #: messages that came
    seconds: float  #: for which they were counted, of wall time
    is_time_simulated: bool  #: whether the time of the nodes is another one
    min: float
    max: float
    std_dev: float

    def __float__(self) -> float:
        return self.rate

    def __repr__(self) -> str:
        found = rate_text(self.rate)
        if self.rate:
            found += f' ({number_text(self.min)} to {number_text(self.max)} s apart'
            found += f', std dev {number_text(self.std_dev)} s)'
        return f'{found}, {_basis(self)}'


@dataclasses.dataclass(frozen=True)
class Bandwidth:
    """How many bytes messages had: what ``rostopic bw`` tells. As a number, bytes a second."""

    topic: str
    rate: float  #: bytes a second, as TCPROS has them
    window: int  #: messages that came
    seconds: float  #: for which they were counted, of wall time
    is_time_simulated: bool  #: whether the time of the nodes is another one
    mean: float  #: bytes of a message
    min: int
    max: int

    def __float__(self) -> float:
        return self.rate

    def __repr__(self) -> str:
        found = f'{size_text(self.rate)}/s'
        if self.window:
            found += f' ({size_text(self.mean)} each'
            if self.min != self.max:
                found += f', {size_text(self.min)} to {size_text(self.max)}'
            found += ')'
        return f'{found}, {_basis(self)}'


def hz(topic: Topic, seconds: float) -> Rate:
    """See :meth:`Topic.hz <pharos.Topic.hz>`."""
    probe = _measure(topic, seconds, weighs=False)
    times = sorted(probe.times)  # several publishers' threads add to them
    gaps = [after - before for before, after in zip(times, times[1:])]
    return Rate(
        topic=topic.name,
        rate=len(gaps) / sum(gaps) if gaps else 0.0,
        window=len(times),
        seconds=seconds,
        is_time_simulated=_is_time_simulated(topic.master),
        min=min(gaps, default=0.0),
        max=max(gaps, default=0.0),
        std_dev=statistics.pstdev(gaps) if gaps else 0.0,
    )


def bw(topic: Topic, seconds: float) -> Bandwidth:
    """See :meth:`Topic.bw <pharos.Topic.bw>`."""
    probe = _measure(topic, seconds, weighs=True)
    window, sizes = len(probe.times), list(probe.sizes)
    mean = statistics.fmean(sizes) if sizes else 0.0
    return Bandwidth(
        topic=topic.name,
        rate=mean * window / seconds,
        window=window,
        seconds=seconds,
        is_time_simulated=_is_time_simulated(topic.master),
        mean=mean,
        min=min(sizes, default=0),
        max=max(sizes, default=0),
    )


def last(topic: Topic, timeout: float = LAST_TIMEOUT) -> genpy.Message:
    """See :attr:`Topic.last <pharos.Topic.last>`.

    :param timeout: seconds in which a message is to come
    """
    for message in messages_of(topic, 1, check_seconds('timeout', timeout)):
        return message
    raise nothing_came(topic, timeout)


def nothing_came(topic: Topic, seconds: float) -> TimeoutError:
    """The error of who has looked at a topic for so many seconds in vain."""
    return TimeoutError(
        f'no message came on {topic.name} within {seconds:g} s: it is published by'
        f" {', '.join(topic.publishers) or 'nobody'}"
    )


def watch(
    topic: Topic, count: Optional[int], block: Optional[Callable[[genpy.Message], Any]]
) -> None:
    """See :meth:`Topic.watch <pharos.Topic.watch>`."""
    show = _show if block is None else check_block(block, 'block', ('message',))
    try:
        for message in _until_stopped(messages_of(topic, count)):
            show(message)
    except KeyboardInterrupt:  # at a prompt, it ends this line alone
        pass


def _until_stopped(messages: Iterator[genpy.Message]) -> Iterator[genpy.Message]:
    """The messages; in the main thread, they end where a signal has stopped all nodes."""
    try:
        yield from messages
    except NodeStoppedError:
        if threading.current_thread() is not threading.main_thread():
            raise


def messages_of(
    topic: Topic, count: Optional[int] = None, timeout: float = LONGEST
) -> Iterator[genpy.Message]:
    """The next messages on a topic, in the thread that asks for them.

    :param count: how many, None: without end
    :param timeout: seconds that each may take; the iterator ends where one does not come in time
    :raises UnknownTopicError: if nobody publishes on the topic
    """
    if count is not None and (type(count) is not int or count < 1):
        raise ValueError(f'count is a number of messages, 1 or more, or None, not {count!r}')
    _check_published(topic)
    look, listener = Look(), Listener()
    with create_looker(topic.master) as looker:
        looker.interested_in(topic.name, delegate=listener)
        for _ in itertools.count() if count is None else range(count):
            if not look.wait(looker, lambda: listener.messages, timeout):
                return
            yield listener.messages.popleft()


def create_looker(master: Master) -> BlockNode:
    """A node for one look, under a name that no other has."""
    name = rosgraph.names.anonymous_name(LOOKER)
    return master.create(BlockNode, named=f'{name}_{next(_numbers)}')


def _measure(topic: Topic, seconds: float, weighs: bool) -> Probe:
    """What a probe has found in so many seconds, from when the publishers were connected."""
    seconds, look = check_seconds('seconds', seconds, above=0), Look()
    _check_published(topic)
    with create_looker(topic.master) as looker:
        probe = Probe(looker, topic.name, weighs)
        wait_for_publishers(looker, topic.name, looker.connect_timeout)
        probe.restart()
        look.wait_out(looker, seconds)
        probe.close()
    return probe


def _check_published(topic: Topic) -> None:
    publishers, subscribers, _ = topic.master.system_state()
    if publishers.get(topic.name):
        return
    heard = subscribers.get(topic.name)
    hint = suggest(topic.name, publishers) or ': start a node that does first'
    raise UnknownTopicError(
        f'nobody publishes on {topic.name}'
        + (f", heard by {', '.join(heard)}" if heard else f' at {topic.master.url}')
        + hint
    )


def _is_time_simulated(master: Master) -> bool:
    return bool(master.parameters.get('/use_sim_time', False))


def _show(message: genpy.Message) -> None:
    Transcript.show(f'{text_of_message(message)}\n---')


def _basis(result: Any) -> str:
    """How many messages a Rate or Bandwidth is of, and what to keep in mind of that."""
    count = counted(result.window, 'message') if result.window else 'no messages'
    words = [count, f'in {number_text(result.seconds)} s']
    if result.is_time_simulated:
        words.append('of wall time, though time is simulated')
    return ' '.join(words)
