"""Watches a master: what comes and goes there, and whether it has forgotten the nodes of this
process.

A ROS master tells a node only of the publishers of its topics, and a restarted one has forgotten
every node. Asking it getSystemState once a second costs 2 to 4 ms, and shows both.
"""
import os
import threading
import time

from pharos.blocks import name_of
from pharos.errors import MasterUnreachableError, NodeStoppedError
from pharos.failures import Failures
from pharos.private_rospy.lifetime import SIGNAL_LATENCY, Interruption
from pharos.transcript import Transcript

PERIOD = 1.0  # seconds between two looks at the master
IMPATIENT = 0.1  # seconds between them while somebody waits for a node
_watchers = {}  # Master -> its Watcher
_lock = threading.Lock()


def watcher_of(master):
    """The one :class:`Watcher` of this process for a master."""
    with _lock:
        if master not in _watchers:
            _watchers[master] = Watcher(master)
        return _watchers[master]


class Watcher:
    """Watches one master, in a thread that is there while there are nodes of this process or
    listeners."""

    def __init__(self, master):
        self._master = master
        self._changed = threading.Condition()  # guards all below
        self._listeners = []
        self._waiting = 0  # how many wait for a node
        self._looks = 0  # how many looks have begun
        # the graph at the last look that was answered, and which one it was
        self._seen = (frozenset(), 0)
        self._thread = None
        self.reachable_since = None  # by time.time(); None while the master does not answer
        self._is_away = False  # whether it did not answer the last look

    def check(self):
        """Somebody came to watch for, or went: see to it that the thread is there just as long as
        it is needed."""
        with self._changed:
            needed = self._is_needed()
            if needed and self._thread is None:
                if self._master.local_nodes():
                    self.reachable_since = time.time()  # one has just registered
                self._thread = threading.Thread(
                    target=self._run, name=f'watcher of {self._master.url}', daemon=True
                )
                self._thread.start()
            elif self._waiting or not needed:
                self._changed.notify_all()

    def listen(self, block):
        """Have ``block(kind, name, is_there)`` called for each node, topic and service that comes
        or goes from now on.

        Returns a function that ends it.
        """
        try:
            listener = _Listener(block, _graph(self._master.system_state()))
        except MasterUnreachableError:
            listener = _Listener(block, frozenset())
        with self._changed:
            self._listeners.append(listener)
        self.check()

        def end():
            listener.ended = True
            with self._changed:
                self._listeners = [other for other in self._listeners if other is not listener]
            self.check()

        return end

    def wait_for_node(self, name, timeout):
        """Wait until a node of that name is there, and returns it; None if it does not come in
        time.

        :raises NodeStoppedError: if the node on whose behalf this thread waits stops meanwhile
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        with self._changed:
            self._waiting += 1
            begun = self._looks  # these may have seen a node that has gone since
        self.check()
        try:
            node = None
            with Interruption(self._notify) as stop:
                while node is None:
                    begun = self._wait_until_seen(name, begun, deadline, stop)
                    if begun is None:
                        return None
                    node = self._master.live_node(name)
            return node
        finally:
            with self._changed:
                self._waiting -= 1
            self.check()

    def _wait_until_seen(self, name, begun, deadline, stop):
        """Wait for a later look than ``begun`` that sees the node; returns which one it is, None at
        the deadline."""
        with self._changed:
            while self._seen[1] <= begun or ('node', name) not in self._seen[0]:
                if stop.came:
                    raise NodeStoppedError(f'the node that waited for {name} stops')
                left = SIGNAL_LATENCY if deadline is None else deadline - time.monotonic()
                if left <= 0:
                    return None
                self._changed.wait(min(left, SIGNAL_LATENCY))
            return self._seen[1]

    def _notify(self):
        with self._changed:
            self._changed.notify_all()

    def _is_needed(self):
        return bool(self._listeners or self._waiting or self._master.local_nodes())

    def _run(self):
        # who waits wants to know what is there now; nodes have only just registered
        looked = not self._waiting
        while True:
            with self._changed:
                if looked:
                    self._changed.wait(IMPATIENT if self._waiting else PERIOD)
                looked = True
                if not self._is_needed():
                    self._thread = self.reachable_since = None
                    return
                self._looks += 1
                # those who come meanwhile know more than it sees
                look, listeners = (self._looks, self._listeners[:])
            graph = self._look()
            if graph is None:
                continue
            with self._changed:
                self._seen = graph, look
                self._changed.notify_all()
            for listener in listeners:
                listener.tell(graph)

    def _look(self):
        """The graph as a set of (kind, name), None if the master does not answer; and repairs
        registrations."""
        # asked for first: the state may lack one that starts meanwhile
        nodes = [node for node in self._master.local_nodes() if node.is_running]
        try:
            state = self._master.system_state()
        except MasterUnreachableError:
            self.reachable_since, self._is_away = None, True
            return None
        was_away, self._is_away = self._is_away, False
        if self.reachable_since is None:
            self.reachable_since = time.time()
        for node in nodes:
            try:
                node.latest_run.rospy.repair(state, was_away)
            except Exception as error:  # the watch over the other nodes goes on
                node.latest_run.report(error, node.latest_run.rospy.repair, 'registration')
        return _graph(state)


def _forget():
    """In a process that was forked, to which no other thread has come along."""
    global _lock
    _lock = threading.Lock()
    _watchers.clear()


os.register_at_fork(after_in_child=_forget)


class _Listener:
    """A block that is told of changes, and what it knows."""

    def __init__(self, block, graph):
        self._block, self._known = block, graph
        self._failures = Failures(lambda line, details: Transcript.show(line))
        self.ended = False

    def tell(self, graph):
        """Run the block for each difference between the graph and what it knows."""
        before, self._known = self._known, graph
        for kind, name in sorted(before ^ graph):
            if self.ended:
                return
            try:
                self._block(kind, name, (kind, name) in graph)
            except BaseException as error:  # the other listeners and the watch over our nodes go on
                where = f'block {name_of(self._block)} for changes'
                self._failures.report(error, self._block, where)


def _graph(state):
    """What there is, as a set of (kind, name)."""
    publishers, subscribers, services = state
    nodes = {name for kind in state for users in kind.values() for name in users}
    return frozenset(
        {('node', name) for name in nodes}
        | {('topic', name) for name in (*publishers, *subscribers)}
        | {('service', name) for name in services}
    )
