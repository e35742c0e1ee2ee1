"""Look at a topic for a while; each look has a node of its own, which stops at its end."""
import contextlib
import operator
import queue
import statistics
import time
from typing import NamedTuple

import rosgraph.names
import rospy

from pharos.errors import UnknownTopicError
from pharos.live.words import number, text_of
from pharos.node import BlockNode
from pharos.transcript import Transcript

LAST_TIMEOUT = 3.0  # seconds that Topic.last waits
FIRST_TIMEOUT = 1.0  # seconds that a measurement waits for the first message


class Rate(NamedTuple):
    """How often messages came, and how many bytes they had."""

    topic: str
    rate: float  # messages a second
    bandwidth: float  # bytes a second
    window: int  # messages that came
    min: float  # seconds from one to the next
    max: float
    std_dev: float

    def __repr__(self):
        apart = f'{self.min:.3g} to {self.max:.3g} s apart, std dev {self.std_dev:.3g} s'
        return f'{self.rate:.4g} Hz ({apart}), {number(self.bandwidth)}B/s, {self.window} messages'


@contextlib.contextmanager
def looking(topic, typed_as=None):
    """Return a queue of what comes on a topic: ``(when, message)``.

    :raises UnknownTopicError: if nobody publishes on it
    """
    if not topic.publishers:
        raise UnknownTopicError(f'nobody publishes on {topic.name}: see master.topics()')
    came: queue.Queue = queue.Queue(1000)

    def keep(message):
        with contextlib.suppress(queue.Full):
            came.put_nowait((time.monotonic(), message))

    name = rosgraph.names.anonymous_name('pharos_looks')
    with topic.master.create(BlockNode, named=name) as node:
        node.interested_in(topic.name, typed_as, delegate=keep)
        yield came


def _come(came, seconds, wait=0.0):
    """Yield what comes within some seconds, as of the first that comes if it may be waited for."""
    end = time.monotonic() + seconds + wait
    with contextlib.suppress(queue.Empty):
        while time.monotonic() < end:
            found = came.get(timeout=max(0.0, end - time.monotonic()))
            end, wait = (found[0] + seconds, 0) if wait else (end, 0)
            yield found


def measure(topic, seconds):
    """Do what :meth:`Topic.hz` does."""
    with looking(topic, rospy.AnyMsg) as came:
        found = list(_come(came, seconds, FIRST_TIMEOUT))
    gaps = [after[0] - before[0] for before, after in zip(found, found[1:])]
    return Rate(
        topic.name,
        len(gaps) / sum(gaps) if gaps else 0.0,
        sum(len(message._buff) for _, message in found) / seconds,
        len(found),
        min(gaps, default=0.0),
        max(gaps, default=0.0),
        statistics.pstdev(gaps) if gaps else 0.0,
    )


def last(topic):
    """Do what :attr:`Topic.last` does."""
    with looking(topic) as came:
        for _, message in _come(came, LAST_TIMEOUT):
            return message
    raise TimeoutError(f'no message came on {topic.name} within {LAST_TIMEOUT:g} s')


def watch(topic, count, block):
    """Do what :meth:`Topic.watch` does."""
    show = block or (lambda message: Transcript.show(f'{text_of(message)}\n---'))
    with looking(topic) as came, contextlib.suppress(KeyboardInterrupt):
        while count is None or count > 0:
            show(came.get()[1])
            count = None if count is None else count - 1


def plot(topic, fields, seconds):
    """Do what :meth:`Topic.plot` does."""
    from matplotlib.figure import Figure

    with looking(topic) as came:
        rows = list(_come(came, seconds, FIRST_TIMEOUT))
    figure = Figure(figsize=(8, 4), layout='constrained')
    axes = figure.add_subplot(title=topic.name, xlabel='seconds')
    times = [when - rows[0][0] for when, _ in rows]
    for field in fields:
        axes.plot(times, [operator.attrgetter(field)(each) for _, each in rows], label=field)
    axes.legend()
    return figure
