"""Watches a master: what comes and goes there, and whether it has forgotten the nodes of this
process.

A ROS master tells a node only of the publishers of its topics, and a restarted one has forgotten
every node. Asking it getSystemState once a second costs 2 to 4 ms, and shows both.
"""
import os
import threading
import time
from typing import TYPE_CHECKING, Any, Callable, Dict, FrozenSet, List, Optional, Tuple

from pharos.blocks import name_of
from pharos.errors import MasterUnreachableError
from pharos.failures import Failures
from pharos.private_rospy import threads
from pharos.private_rospy.condition import Condition
from pharos.transcript import Transcript

if TYPE_CHECKING:
    from pharos.master import Master

PERIOD = 1.0  # seconds between two looks at the master
Graph = FrozenSet[Tuple[str, str]]  # what there is, as (kind, name)
_watchers: 'Dict[Master, Watcher]' = {}
_lock = threading.Lock()


def watcher_of(master: 'Master') -> 'Watcher':
    """The one :class:`Watcher` of this process for a master."""
    with _lock:
        if master not in _watchers:
            _watchers[master] = Watcher(master)
        return _watchers[master]


class Watcher:
    """Watches one master, in a thread that is there while there are nodes of this process or
    listeners.

    :attr:`reachable_since` is by ``time.time()``; None while the master does not answer.
    """

    def __init__(self, master: 'Master') -> None:
        self._master = master
        self._changed = Condition()  # guards the two below
        self._listeners: List[Callable[[Graph], None]] = []  # replaced when it changes
        self._thread: Optional[threading.Thread] = None
        self.reachable_since: Optional[float] = None
        self._is_away = False  # whether the master did not answer the last look

    def check(self) -> None:
        """Somebody came to watch for, or went: see to it that the thread is there just as long as
        it is needed."""
        with self._changed:
            if not self._is_needed():
                self._changed.notify_all()
            elif self._thread is None:
                if self._master.local_nodes():
                    self.reachable_since = time.time()  # one has just registered
                name = f'watcher of {self._master.url}'
                thread = threading.Thread(target=self._run, name=name, daemon=True)
                threads.start(thread.start, f'the {name}')
                self._thread = thread

    def listen(self, block: Callable[[str, str, bool], Any]) -> Callable[[], None]:
        """Have ``block(kind, name, is_there)`` called for each node, topic and service that comes
        or goes from now on, in the thread of the watcher.

        Returns a function that ends it.
        """
        failures = Failures(lambda line, details: Transcript.show(line))
        try:
            known = _graph(self._master.system_state())
        except MasterUnreachableError:
            known = frozenset()

        def tell(graph: Graph) -> None:
            nonlocal known
            before, known = known, graph
            for kind, name in sorted(before ^ graph):
                if tell not in self._listeners:
                    return
                try:
                    block(kind, name, (kind, name) in graph)
                except BaseException as error:  # the watch goes on
                    failures.report(error, block, f'block {name_of(block)} for changes')

        def end() -> None:
            with self._changed:
                self._listeners = [other for other in self._listeners if other is not tell]
            self.check()

        with self._changed:
            self._listeners = [*self._listeners, tell]
        self.check()
        return end

    def _is_needed(self) -> bool:
        return bool(self._listeners or self._master.local_nodes())

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait(PERIOD)
                if not self._is_needed():
                    self._thread = self.reachable_since = None
                    return
                listeners = self._listeners  # those who come meanwhile know more than it sees
            graph = self._look()
            if graph is not None:
                for tell in listeners:
                    tell(graph)

    def _look(self) -> Optional[Graph]:
        """The graph, None if the master does not answer; and repairs registrations."""
        # asked for first: the state may lack one that starts meanwhile
        nodes = [node for node in self._master.local_nodes() if node.is_running]
        # a program runs before it is registered
        runs = [node.latest_run for node in nodes if node.latest_run.rospy.is_registered]
        try:
            state = self._master.system_state()
        except MasterUnreachableError:
            self.reachable_since, self._is_away = None, True
            return None
        was_away, self._is_away = self._is_away, False
        if self.reachable_since is None:
            self.reachable_since = time.time()
        for run in runs:
            try:
                run.rospy.repair(state, was_away)
            except Exception as error:  # the watch over the other nodes goes on
                run.report(error, run.rospy.repair, 'registration')
        return _graph(state)


def _forget() -> None:
    """In a process that was forked, to which no other thread has come along."""
    global _lock
    _lock = threading.Lock()
    _watchers.clear()


os.register_at_fork(after_in_child=_forget)


def _graph(state: Any) -> Graph:
    publishers, subscribers, services = state
    nodes = {name for kind in state for users in kind.values() for name in users}
    names = ('node', nodes), ('topic', {*publishers, *subscribers}), ('service', services)
    return frozenset((kind, name) for kind, there in names for name in there)
