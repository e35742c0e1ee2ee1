"""Subscribers that have left: one thread of the process looks for them, which rospy has one of each
node for."""
import os
import threading
from typing import Any, Optional

from pharos.private_rospy.condition import Condition
from pharos.private_rospy.threads import NoThreadError, start

PERIOD = 0.5  # seconds between two looks, as rospy's
_changed = Condition()  # guards the two below; notified when the last node has gone
_nodes: Any = {}  # PrivateRospy -> the thread that removes those who left it, None: none did yet
_thread: Optional[threading.Thread] = None


def watch(node: Any) -> None:
    """Look for those who leave the PrivateRospy, from now on.

    :raises NoThreadError: if there is no thread for that
    """
    global _thread
    with _changed:
        _nodes[node] = None
        if _thread is None:
            thread = threading.Thread(target=_run, name='departures', daemon=True)
            start(thread.start, 'departures')
            _thread = thread


def ignore(node: Any) -> None:
    """Look no more."""
    with _changed:
        _nodes.pop(node, None)
        if not _nodes:
            _changed.notify_all()


def _run() -> None:
    global _thread
    while True:
        with _changed:
            if _nodes:
                _changed.wait(PERIOD)
            if not _nodes:
                _thread = None
                return
            nodes = list(_nodes.items())
        for node, removing in nodes:
            if not (removing and removing.is_alive()) and _has_departures(node):
                _remove(node)


def _has_departures(node: Any) -> bool:
    """Whether a socket of the node's topics says so; takes no lock that the master may hold up."""
    topics = (*list(node.topics.pubs.values()), *list(node.topics.subs.values()))
    return any(any(True for _ in topic.connection_poll.error_iter()) for topic in topics)


def _remove(node: Any) -> None:
    try:
        removing = node.start_thread(node.topics.check_all, name='departures')
    except NoThreadError:
        return  # next time
    with _changed:
        if node in _nodes:
            _nodes[node] = removing


def _forget() -> None:
    """In a process that was forked."""
    global _changed, _thread
    _changed, _thread = Condition(), None
    _nodes.clear()


os.register_at_fork(after_in_child=_forget)
