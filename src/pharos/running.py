"""The nodes of this process, and how they end with it."""
import atexit
import contextlib
import gc
import os
import sys
import threading
import time

from pharos import signals, stopping
from pharos.errors import NodeNameInUseError
from pharos.private_rospy import process_rospy
from pharos.private_rospy.lifetime import SIGNAL_LATENCY

# A stopped node's rospy is a web of cycles of 0.7 MB, which only the collector frees. It looks at
# the running nodes, too, so it runs after as many stops as there are nodes left, and at least so
# many:
COLLECT_EVERY = 20
_stops = 0  # since it ran
_nodes = {}  # (master, name) -> Node: those that the master may know, in the order of their starts
_finalizer = None  # what multiprocessing runs at the end of its processes
_others = []  # functions that end what else the program has started: programs, masters


def claim(node):
    """The node starts, and the master is to know it soon.

    :raises NodeNameInUseError: if another node of this process has its name at its master
    """
    _end_with_multiprocessing()
    with stopping.changed:
        other = _nodes.setdefault((node.master, node.name), node)
    if other is not node:
        raise NodeNameInUseError(
            f'the node name {node.name} is taken by a {other.lifecycle.value} node of this process:'
            ' choose another name, or stop() that node first'
        )


def discard(node):
    """The node has stopped, or did not come to run."""
    with stopping.changed:
        if _nodes.get((node.master, node.name)) is node:
            del _nodes[node.master, node.name]
        stopping.changed.notify_all()


def collect():
    """One more node has stopped: free what such leave in memory, now and then."""
    global _stops
    with stopping.changed:
        _stops += 1
        due = _stops >= max(COLLECT_EVERY, len(_nodes))
        if due:
            _stops = 0
    if due:
        gc.collect()


def nodes():
    """The nodes that start, run or stop, in the order of their starts."""
    with stopping.changed:
        return list(_nodes.values())


def at_end(function):
    """Run ``function()`` when the program ends, after the nodes have stopped; the last that was
    given first."""
    _end_with_multiprocessing()
    _others.append(function)


def not_at_end(function):
    """Do not run it then: what it ends has ended."""
    with contextlib.suppress(ValueError):  # done already, by another thread perhaps
        _others.remove(function)


def spin():
    """Block until every node of the process has stopped, or Ctrl-C, SIGTERM or SIGHUP, which stop
    them."""
    with signals.waiting():
        try:
            _wait_until(
                lambda: all(map(stopping.has_failed, nodes())) and not stopping.is_awaited()
            )
        except KeyboardInterrupt:  # the host program has a handler of its own
            stop_all()


def stop_all():
    """Stop all nodes of the process, side by side.

    Returns when each has ended its ``stop()``, or after ``stopping.LIMIT`` seconds.
    """
    deadline = time.monotonic() + stopping.LIMIT
    threads = [
        threading.Thread(target=node._stop_for_others, name=node.name + ' stop', daemon=True)
        for node in nodes()
    ]
    for thread in threads:
        thread.start()
    join(threads, stopping.LIMIT)
    _wait_until(lambda: not stopping.is_awaited(), deadline)


def _wait_until(predicate, deadline=None):
    with stopping.changed:
        while not predicate():
            left = SIGNAL_LATENCY if deadline is None else deadline - time.monotonic()
            if left <= 0:
                return
            stopping.changed.wait(min(left, SIGNAL_LATENCY))


def join(threads, timeout):
    """Wait until the threads have ended, for up to ``timeout`` seconds in all."""
    deadline = time.monotonic() + timeout
    for thread in threads:
        thread.join(max(0.0, deadline - time.monotonic()))


def _end_with_multiprocessing():
    """Have a process of multiprocessing end as others do: one that was forked runs nothing that
    atexit knows."""
    global _finalizer
    multiprocessing = sys.modules.get('multiprocessing')
    if _finalizer is None and multiprocessing and multiprocessing.parent_process():
        _finalizer = multiprocessing.util.Finalize(None, _end, exitpriority=0)


def _end():
    """The program ends, once: a signal that comes meanwhile asks for nothing more."""
    with signals.held(stopping.LIMIT, is_end=True), contextlib.ExitStack() as others:
        stop_all()
        for function in _others:
            # the last first, and each of them, whatever another one raises
            others.callback(function)
        _others.clear()


def _rospy_ended_by(number):
    """A signal has ended the rospy node that the program itself is; rospy passes on what we had
    taken on before."""
    if not signals.is_taken_on(number):
        stop_all()


def _forget():
    """In a process that was forked: the nodes are its parent's, as are the programs, and it must
    not end them."""
    global _finalizer
    _finalizer = None  # its parent's, which multiprocessing has dropped
    former = list(_nodes.values())
    _nodes.clear()
    _others.clear()
    for node in former:
        node._is_anothers()


signals.serve(lambda: bool(_nodes or _others or stopping.is_under_way()), stop_all)
process_rospy.on_signal(_rospy_ended_by)
atexit.register(_end)
os.register_at_fork(after_in_child=_forget)
