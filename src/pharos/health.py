"""How a node is doing: see :meth:`Node.health`."""
import collections
import time
from typing import TYPE_CHECKING, Any, Counter, Dict, Iterator, NamedTuple, Optional

import rosgraph

from pharos.counts import counted
from pharos.errors import MasterUnreachableError
from pharos.watcher import watcher_of

if TYPE_CHECKING:
    from pharos.node import Node

LARGEST = 2**31 - 1  # number that XML-RPC has


class Health(NamedTuple):
    """What can be said of a node at a glance; as a string, in one line."""

    #: whether the master has it at its URI; None: the master does not answer
    registered: Optional[bool]
    #: since when the master answers, in seconds as of time.time(); None: it does not
    reachable_since: Optional[float]
    connections: Dict[str, int]  #: transport -> how many the node's channels have
    dropped: int  #: messages that its input channels have dropped
    errors: int  #: times that its blocks failed; node.errors has identical ones once
    threads: int  #: of the node
    refused: int = 0  #: publishers that its channels cannot hear, for they publish another type

    def __str__(self) -> str:
        return ', '.join(self._parts())

    def _parts(self) -> Iterator[str]:
        """What is to be said, one thing after the other."""
        if self.registered is not None:
            yield 'registered' if self.registered else 'not registered'
        if self.reachable_since:
            yield 'master reachable since ' + time.strftime(
                '%H:%M:%S', time.localtime(self.reachable_since)
            )
        elif self.registered is None:  # else it has just answered
            yield 'master away'
        for transport, count in sorted(self.connections.items()):
            yield f'{count} {transport}'
        if self.refused:
            yield f'{self.refused} refused'
        yield f'{self.dropped} dropped'
        yield counted(self.errors, 'error')
        yield counted(self.threads, 'thread')


def health_of(node: 'Node', ask: bool) -> Health:
    """The :class:`Health` of a node; ``ask``: the master too, which may take its time, else
    ``registered`` is None."""
    channels, is_running = node.channels, node.is_running
    transports = (transport for channel in channels for _, transport in channel.connections)
    return Health(
        registered=_is_registered(node) if ask else None,
        reachable_since=watcher_of(node.master).reachable_since if is_running else None,
        connections=dict(collections.Counter(transports)),
        dropped=sum(getattr(channel, 'dropped', 0) for channel in channels),
        errors=node.errors.total,
        threads=node.latest_run.rospy.thread_count if node.latest_run else 0,
        refused=node.latest_run.rospy.refusals.count() if is_running else 0,
    )


def _is_registered(node: 'Node') -> Optional[bool]:
    try:
        return node.uri is not None and node.master.call('lookupNode', node.name) == node.uri
    except rosgraph.MasterError:
        return False
    except MasterUnreachableError:
        return None


def told(node: 'Node') -> Dict[str, Any]:
    """What a node tells other processes: its ``class``, how many ``threads``, ``souls`` and
    ``failures`` it has, and how many messages its channels have ``dropped``, by topic.

    It is counted in any case, and put together when somebody asks.
    """
    dropped: Counter[str] = collections.Counter()
    for channel in node.channels:
        dropped[channel.topic] += getattr(channel, 'dropped', 0)
    run = node.latest_run
    return {
        'class': type(node).__name__,
        'threads': run.rospy.thread_count,
        'souls': len(run.souls.forked),
        'failures': min(node.errors.total, LARGEST),
        'dropped': {topic: min(count, LARGEST) for topic, count in dropped.items() if count},
    }
