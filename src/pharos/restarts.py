"""Restarts: a stop and a start, and all that was is there again."""
import contextlib
import os
import threading
from typing import TYPE_CHECKING, Dict, Iterator, Optional

from pharos import node_registry, signals
from pharos.errors import NodeStoppedError, PharosError
from pharos.private_rospy.lifetime import SIGNAL_LATENCY, on_nobodys_behalf

if TYPE_CHECKING:
    from pharos.node import Node


class Restart:
    """A restart that this thread does."""

    def __init__(self) -> None:
        self.thread = threading.get_ident()
        self.is_cancelled = False  # whether another thread has the node stay stopped

    def cancel(self) -> None:
        """Have the node stay stopped, unless it is the restart itself that stops it."""
        self.is_cancelled = self.is_cancelled or self.thread != threading.get_ident()

    def cancel_for_all(self) -> None:
        """Have the node stay stopped, for all nodes are stopped."""
        self.is_cancelled = True

    def is_cancelled_here(self) -> bool:
        """Whether it is, and this thread does it."""
        return self.is_cancelled and self.thread == threading.get_ident()


# node that is stopped to be started again, and keeps its name -> its restart;
# node_registry.changed guards it
_restarts: 'Dict[Node, Restart]' = {}


def restart(node: 'Node', forks_itself: bool) -> None:
    """What :meth:`Node.restart` does.

    :param forks_itself: whether a start() of its class's own forks the souls again that it forked
    """
    if node.is_running:
        node.master.call('getPid')
    # torn up by Ctrl-C half way, it would leave a node that is stopped
    with signals.held(), _turn_of(node) as mine:
        if mine is None:
            return
        former = node.latest_run
        node_registry.before_stop_all(mine.cancel_for_all)
        try:
            node.stop()
            if mine.is_cancelled or former is not None and not former.is_over:
                raise NodeStoppedError(f'another thread stops {node.name}, which restarts no more')
            with on_nobodys_behalf():  # a thread of the node's may wait again
                if node.latest_run is former:
                    node.start()
                if former is not None:
                    former.successor = node.latest_run
                    node.latest_run.souls.resume(former.souls, forks_itself)
            if mine.is_cancelled:  # when it had been started
                node.stop()
        finally:
            node_registry.not_before_stop_all(mine.cancel_for_all)
    if former is not None:
        former.souls.end()


def is_restarting(node: 'Node') -> bool:
    """Whether the node is stopped to be started again."""
    return node in _restarts and not _restarts[node].is_cancelled


@contextlib.contextmanager
def _turn_of(node: 'Node') -> Iterator[Optional[Restart]]:
    """Within this, the node keeps its name while it is stopped and started, and is waited for by
    :func:`~pharos.spin`; yields None where another thread has just restarted it.

    :raises NodeStoppedError: if another thread does, which may wait for this one
    :raises PharosError: if it is this thread that restarts it
    """
    mine, is_due = Restart(), True
    with node_registry.changed:
        if node in _restarts and _restarts[node].thread == mine.thread:
            raise PharosError(f'{node.name} cannot be restarted by its own start() or stop()')
        while node in _restarts:
            if node.latest_run.is_own_thread():
                raise NodeStoppedError(f'another thread restarts {node.name}')
            node_registry.changed.wait(SIGNAL_LATENCY)
            is_due = not node.is_running
        run = node.latest_run
        if is_due:
            _restarts[node] = mine
            if run is not None:
                run.restart = mine
    try:
        yield mine if is_due else None
    finally:
        with node_registry.changed:
            if is_due:
                del _restarts[node]
                if run is not None:
                    run.restart = None
                if node.latest_run is None or node.latest_run.is_over:
                    node_registry.discard(node)
            node_registry.changed.notify_all()


os.register_at_fork(after_in_child=_restarts.clear)
