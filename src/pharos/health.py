"""How a node is doing: see :meth:`Node.health`."""
import collections
import time
from typing import Dict, NamedTuple, Optional

import rosgraph

from pharos.errors import MasterUnreachableError
from pharos.watcher import watcher_of


class Health(NamedTuple):
    """What can be said of a node at a glance; as a string, in one line."""

    registered: Optional[bool]          # whether the master has it at its URI; None: the master does not answer
    reachable_since: Optional[float]    # since when the master answers, in seconds as of time.time(); None: it does not
    connections: Dict[str, int]         # transport -> how many the node's channels have
    dropped: int                        # messages that its input channels have dropped
    errors: int                         # times that its blocks failed; node.errors has identical ones once
    threads: int                        # of the node
    refused: int = 0                    # publishers that its channels cannot hear, for they publish another type

    def __str__(self):
        return ', '.join([
            *([] if self.registered is None else ['registered' if self.registered else 'not registered']),
            *self._of_master(),
            *('%d %s' % (count, transport) for transport, count in sorted(self.connections.items())),
            *(['%d refused' % self.refused] if self.refused else []), '%d dropped' % self.dropped, '%d errors' % self.errors, '%d threads' % self.threads])

    def _of_master(self):
        """What to say of the master, if anything is known."""
        if self.reachable_since:
            yield 'master reachable since ' + time.strftime('%H:%M:%S', time.localtime(self.reachable_since))
        elif self.registered is None:    # else it has just answered
            yield 'master away'


def health_of(node, ask):
    """The :class:`Health` of a node; ``ask``: the master too, which may take its time, else ``registered`` is None."""
    connections = collections.Counter(transport for channel in node.channels for _, transport in channel.connections)
    reachable_since = watcher_of(node.master).reachable_since if node.is_running else None
    return Health(_is_registered(node) if ask else None, reachable_since,
                  dict(connections), sum(getattr(channel, 'dropped', 0) for channel in node.channels), node._failures.count,
                  node._rospy.thread_count if node._rospy else 0, node._rospy.refusals.count() if node.is_running else 0)


def _is_registered(node):
    try:
        with node.master._reached():
            return node.uri is not None and node.master._api().lookupNode(node.name) == node.uri
    except rosgraph.MasterError:
        return False
    except MasterUnreachableError:
        return None
