"""The memory of nodes that have stopped."""
import gc
import os
import threading

# A stopped node's rospy is a web of cycles of 0.7 MB, which only the collector frees. It looks at
# the running nodes, too, so it runs after as many stops as there are nodes left, and at least so
# many:
COLLECT_EVERY = 20

_lock = threading.Lock()
_runs_ended = 0  # since the collector ran


def collect(nodes_left: int) -> None:
    """One more run has ended: free what such leave in memory, now and then."""
    global _runs_ended
    with _lock:
        _runs_ended += 1
        due = _runs_ended >= max(COLLECT_EVERY, nodes_left)
        if due:
            _runs_ended = 0
    if due:
        gc.collect()


def _forget() -> None:
    """In a process that was forked, when another thread may have held the lock."""
    global _lock
    _lock = threading.Lock()


os.register_at_fork(after_in_child=_forget)
