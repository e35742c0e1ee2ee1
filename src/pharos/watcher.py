"""Watches a master: what comes and goes there, and whether it has forgotten the nodes of this process.

A ROS master tells a node only of the publishers of its topics, and a restarted one has forgotten every node. Asking it
getSystemState once a second costs 2 to 4 ms, and shows both.
"""
import threading
import time

from pharos.errors import MasterUnreachableError

PERIOD = 1.0        # seconds between two looks at the master
IMPATIENT = 0.1     # seconds between them while somebody waits for a node
_watchers = {}      # master URL -> its Watcher
_lock = threading.Lock()


def watcher_of(master):
    """The one :class:`Watcher` of this process for a master."""
    with _lock:
        if master.url not in _watchers:
            _watchers[master.url] = Watcher(master)
        return _watchers[master.url]


class Watcher:
    """Watches one master, in a thread that is there while there are nodes of this process or listeners."""

    def __init__(self, master):
        self._master = master
        self._changed = threading.Condition()    # guards all below
        self._listeners = []
        self._waiting = 0                        # how many wait for a node
        self._seen = None                        # the graph at the last look: a set of (kind, name)
        self._thread = None
        self.reachable_since = None              # by time.time(); None while the master does not answer

    def check(self):
        """Somebody came to watch for, or went: see to it that the thread is there just as long as it is needed."""
        with self._changed:
            needed = self._is_needed()
            if needed and self._thread is None:
                self._thread = threading.Thread(target=self._run, name='watcher of %s' % self._master.url, daemon=True)
                self._thread.start()
            elif self._waiting or not needed:
                self._changed.notify_all()

    def listen(self, block):
        """Have ``block(kind, name, is_there)`` called for each node, topic and service that comes or goes."""
        with self._changed:
            self._listeners.append(block)
        self.check()

    def unlisten(self, block):
        with self._changed:
            if block in self._listeners:
                self._listeners.remove(block)
        self.check()

    def wait_for_node(self, name, timeout):
        """Wait until a node of that name is there; returns whether it is."""
        deadline = None if timeout is None else time.monotonic() + timeout
        with self._changed:
            self._waiting += 1
        self.check()
        try:
            with self._changed:
                while ('node', name) not in (self._seen or ()):
                    left = None if deadline is None else deadline - time.monotonic()
                    if left is not None and left <= 0:
                        return False
                    self._changed.wait(left)
                return True
        finally:
            with self._changed:
                self._waiting -= 1

    def _is_needed(self):
        return bool(self._listeners or self._waiting or self._master.own_nodes())

    def _run(self):
        # who listens or waits wants to know what is there now; nodes have only just registered
        looked = not (self._listeners or self._waiting)
        while True:
            with self._changed:
                if looked:
                    self._changed.wait(IMPATIENT if self._waiting else PERIOD)
                looked = True
                if not self._is_needed():
                    self._thread = self._seen = self.reachable_since = None
                    return
            graph = self._look()
            if graph is None:
                continue
            with self._changed:
                before, self._seen = self._seen, graph
                listeners = list(self._listeners) if before is not None else ()
                self._changed.notify_all()
            for listener in listeners:
                for kind, name in sorted(before ^ graph):
                    listener(kind, name, (kind, name) in graph)

    def _look(self):
        """The graph as a set of (kind, name), None if the master does not answer; and repairs registrations."""
        try:
            state = self._master.system_state()
        except MasterUnreachableError:
            self.reachable_since = None
            return None
        if self.reachable_since is None:
            self.reachable_since = time.time()
        for node in self._master.own_nodes():
            node._rospy.repair(state)
        publishers, subscribers, services = state
        nodes = {node for kind in state for names in kind.values() for node in names}
        return ({('node', name) for name in nodes} | {('topic', name) for name in (*publishers, *subscribers)}
                | {('service', name) for name in services})
