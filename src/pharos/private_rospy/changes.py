"""Waiting for what the nodes of this process are connected to."""
import os

from pharos.private_rospy.condition import Condition
from pharos.private_rospy.lifetime import Interruption, wait_for

# notified whenever a publisher of this process gains or loses a connection, a subscription gains one or
# is refused or cannot have it, and whenever a node stops
_changed = Condition()


def notify():
    """Have those who wait look again."""
    with _changed:
        _changed.notify_all()


def wait_until(lifetime, predicate, timeout):
    """Wait until ``predicate()``, which speaks of connections of this process's nodes, holds.

    :param timeout: seconds, None: no limit
    :param lifetime: of the node with whose stop the wait ends
    """
    with Interruption(notify, lifetime) as stop:
        wait_for(_changed, lambda: stop.came or predicate(), timeout)


def _forget():
    """In a process that was forked, when another thread may have held the lock."""
    global _changed
    _changed = Condition()


os.register_at_fork(after_in_child=_forget)
