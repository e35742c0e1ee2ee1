"""One stop() of a node at a time: whoever asks for it, it runs once, to its end, and the others
wait for that."""
import functools
import os
import threading
import time

from pharos import signals
from pharos.private_rospy.lifetime import SIGNAL_LATENCY

LIMIT = (
    30.0  #: seconds from its beginning on that anybody waits for a stop() that another thread runs
)

changed = threading.Condition()  # guards the life cycles of all nodes, and what follows
_stops = {}  # node -> the _Stop under way
_waiting = {}  # thread -> the node for whose stop it waits


class _Stop:
    """A stop() under way."""

    def __init__(self, run):
        self.run = run  # the run of the node that it ends
        self.thread = threading.get_ident()
        self.deadline = time.monotonic() + LIMIT
        self._methods = []  # those that are active: an overriding one calls that of its superclass

    def call(self, method, node, args, kwargs):
        """Run one of them, unless it is active already: then it has called itself, by way of others
        perhaps."""
        if method in self._methods:
            return None
        self._methods.append(method)
        try:
            return method(node, *args, **kwargs)
        finally:
            self._methods.remove(method)


def once(method):
    """A ``stop`` method that runs once for each run of its node, whoever calls it in whatever
    thread.

    Who calls it meanwhile waits for its end, for up to LIMIT seconds, but for the node's own
    threads, which it may itself wait for. A signal does not cut it off where it runs in the main
    thread. When it has ended, the node is stopped, also where it has raised an exception.
    """

    @functools.wraps(method)
    def stop(node, *args, **kwargs):
        under_way = _stops.get(node)
        if under_way is not None and under_way.thread == threading.get_ident():
            return under_way.call(method, node, args, kwargs)  # super().stop()
        with signals.held(LIMIT):
            mine = _begin(node)
            if mine is None:
                return None
            try:
                return mine.call(method, node, args, kwargs)
            finally:
                _end(node, mine)

    stop.once = stop
    return stop


def is_once(method):
    """Whether :func:`once` made the method."""
    # what wraps it may have a copy of its attributes
    return getattr(method, 'once', None) is method


def is_under_way():
    """Whether a stop() runs."""
    return bool(_stops)


def is_awaited():
    """Whether there is a stop() that this thread is to wait for."""
    return any(
        stop.thread != threading.get_ident() and time.monotonic() < stop.deadline
        for stop in tuple(_stops.values())
    )


def has_failed(node):
    """Whether the node's stop() has not ended in time."""
    return node in _stops and time.monotonic() >= _stops[node].deadline


def wait_for_end(node):
    """Wait until another thread's stop() of the node, if there is one, has ended; returns whether
    there was one.

    :raises TimeoutError: if it has not ended in time, or this thread is one that it waits for
    """
    me, awaited = threading.get_ident(), False
    with changed:
        while node in _stops and _stops[node].thread != me or node._is_starting():
            left = _stops[node].deadline - time.monotonic() if node in _stops else SIGNAL_LATENCY
            if left <= 0 or node._is_own_thread() or _waits_for_me(node):
                raise TimeoutError
            awaited = awaited or node in _stops
            _waiting[me] = node
            try:
                changed.wait(min(left, SIGNAL_LATENCY))
            finally:
                del _waiting[me]
    return awaited


def _begin(node):
    """The stop that this thread is to run; None where another one has done it, or there is nothing
    to stop."""
    node._end_start()
    with changed:
        run = node._rospy
        try:
            awaited = wait_for_end(node)
        except TimeoutError:
            return None
        if not node.is_running or awaited and node._rospy is not run:
            return None
        stop = _stops[node] = _Stop(node._rospy)
        return stop


def _end(node, stop):
    try:
        if node.is_running and node._rospy is stop.run:
            node._stop_run()  # it did not call super().stop(), or did not get there
    finally:
        with changed:
            del _stops[node]
            changed.notify_all()


def _waits_for_me(node):
    """Whether the thread that stops the node waits, perhaps by way of others, for the stop that
    this one runs."""
    while node in _stops:
        thread = _stops[node].thread
        if thread == threading.get_ident():
            return True
        node = _waiting.get(thread)
    return False


def _forget():
    """In a process that was forked: nothing of this is its own."""
    global changed
    changed = threading.Condition()
    _stops.clear()
    _waiting.clear()


os.register_at_fork(after_in_child=_forget)
