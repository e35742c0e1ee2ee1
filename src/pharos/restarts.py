"""Restarts: a stop and a start, and all that was is there again."""
import contextlib
import os
import threading
from typing import TYPE_CHECKING, Dict, Iterator

from pharos import node_registry
from pharos.errors import NodeStoppedError, PharosError
from pharos.private_rospy.lifetime import SIGNAL_LATENCY, on_nobodys_behalf

if TYPE_CHECKING:
    from pharos.node import Node

# node that is stopped to be started again, and keeps its name -> the identifier of the thread that
# does it; node_registry.changed guards it
_restarts: 'Dict[Node, int]' = {}


def restart(node: 'Node', forks_itself: bool) -> None:
    """What :meth:`Node.restart` does.

    :param forks_itself: whether a start() of its class's own forks the souls again that it forked
    """
    if node.is_running:
        node.master.call('getPid')
    with _turn_of(node) as is_due:
        if not is_due:
            return
        former, is_over = node.latest_run, threading.Event()
        node_registry.before_stop_all(is_over.set)
        try:
            node.stop()
            if is_over.is_set() or former is not None and not former.is_over:
                raise NodeStoppedError(f'another thread stops {node.name}, which restarts no more')
            with on_nobodys_behalf():  # a thread of the node's may wait again
                if node.latest_run is former:
                    node.start()
                if former is not None:
                    former.successor = node.latest_run
                    node.latest_run.souls.resume(former.souls, forks_itself)
            if is_over.is_set():
                node.stop()
        finally:
            node_registry.not_before_stop_all(is_over.set)
    if former is not None:
        former.souls.end()


def is_restarting(node: 'Node') -> bool:
    """Whether the node is stopped to be started again."""
    return node in _restarts


@contextlib.contextmanager
def _turn_of(node: 'Node') -> Iterator[bool]:
    """Within this, the node keeps its name while it is stopped and started, and is waited for by
    :func:`~pharos.spin`; yields False where another thread has just restarted it.

    :raises NodeStoppedError: if another thread does, which may wait for this one
    :raises PharosError: if it is this thread that restarts it
    """
    me, is_due = threading.get_ident(), True
    with node_registry.changed:
        if _restarts.get(node) == me:
            raise PharosError(f'{node.name} cannot be restarted by its own start() or stop()')
        while node in _restarts:
            if node.latest_run.is_own_thread():
                raise NodeStoppedError(f'another thread restarts {node.name}')
            node_registry.changed.wait(SIGNAL_LATENCY)
            is_due = not node.is_running
        if is_due:
            _restarts[node] = me
    try:
        yield is_due
    finally:
        with node_registry.changed:
            if is_due:
                del _restarts[node]
                if node.latest_run is None or node.latest_run.is_over:
                    node_registry.discard(node)
            node_registry.changed.notify_all()


os.register_at_fork(after_in_child=_restarts.clear)
