"""Compositions: launch files whose Python nodes run in this process."""
import copy
import dataclasses
import os
import sys
import threading
import time
from typing import TYPE_CHECKING, Collection, Dict, Iterator, List, Optional, Tuple, Union

import roslaunch.core
import rospkg

from pharos import node_registry, signals
from pharos.blocks import check_flag
from pharos.compose.apart import Apart, ApartNodes
from pharos.compose.kept_node import KeptNode
from pharos.compose.launch_file import LaunchedNode, LaunchFile, Problem
from pharos.compose.output import SCREEN
from pharos.compose.programs import MAKES_NODES
from pharos.compose.progress import Progress
from pharos.compose.script import ScriptNode
from pharos.counts import counted
from pharos.program_files import AnyPath
from pharos.ros_process import RosProcess

if TYPE_CHECKING:
    from pharos.master import Master

PATIENCE = 2.0  # seconds that a node may take to start before the next one does


class Composition:
    """Programs of Python that run in this process, unmodified, and the rest of their launch file;
    made by :meth:`Master.compose`. Ends with its ``with`` block.

    :param master: the :class:`Master` of its nodes
    :param progress: what tells of them
    """

    def __init__(self, master: 'Master', progress: Optional[Progress] = None) -> None:
        self.master = master
        self.progress = progress or Progress()
        #: why it has ended by itself, before all of its nodes had
        self.reason: Optional[str] = None
        #: whether it ends, or has ended
        self.is_ending = False
        #: why nodes of it were not even tried to start
        self.problems: List[Problem] = []
        #: what was started in this process, whether it has come to be a node or not; replaced when
        #: it changes
        self.kept: List[KeptNode] = []
        self._apart: List[Apart] = []
        self._stopping = threading.RLock()
        node_registry.before_stop_all(self._begin_end)

    @property
    def nodes(self) -> List[ScriptNode]:
        """The nodes of this process, in the order of the launch file."""
        return [kept.node for kept in self.kept if kept.node is not None]

    @property
    def process(self) -> Optional[RosProcess]:
        """The process in which roslaunch runs the nodes apart; None: there are none."""
        return self._apart[0].process if self._apart else None

    # -- start

    def launch(self, file: LaunchFile) -> None:
        """Set the parameters of a launch file, and start its nodes.

        :raises MasterUnreachableError: if the master does not answer
        :raises PharosError: if it refuses a parameter
        """
        run_id = self._run_id()
        file.set_parameters(run_id)
        for text in file.config.config_errors:
            self.progress.tell(str(text))
        for problem in file.problems:
            self.refuse(problem)
        for problem in file.problems:
            if problem.ends_all:
                return self.end_because(f'{problem.name}, which is required, cannot be started')
        if file.apart:
            self.progress.apart(file.reasons)
            self._apart.append(ApartNodes(self, file.config_apart()))
        logs = os.path.join(rospkg.get_log_dir(env=os.environ), run_id)
        for folder in logs, rospkg.get_ros_home():  # roslaunch makes them, too
            os.makedirs(folder, exist_ok=True)
        self.start(
            [_with_log(launched, logs, number) for number, launched in enumerate(file.here, 1)]
        )

    def refuse(self, problem: Problem) -> None:
        """Keep and tell why a node cannot be started; the others go on."""
        self.problems.append(problem)
        self.progress.tell(str(problem))

    def start(self, nodes: List[LaunchedNode]) -> List[KeptNode]:
        """Start nodes, one after the other; one that takes long does not keep the next from it."""
        started = [KeptNode(self, launched) for launched in nodes]
        with node_registry.changed:
            self.kept = [*self.kept, *started]
        for number, kept in enumerate(started, 1):
            if self.is_ending:
                kept.is_over = True
                kept.settled.set()
                continue
            self.progress.starts(kept.name, number, len(started))
            kept.start()
            if not kept.settled.wait(PATIENCE):
                self.progress.hangs(kept.name, PATIENCE)
        self.progress.all_begun([kept.name for kept in started if not kept.settled.is_set()])
        return started

    def run_apart(self, launched: LaunchedNode) -> None:
        """Run a program that makes its nodes itself in a process of its own."""
        self.progress.apart({MAKES_NODES: [launched.program]})
        command = [sys.executable, launched.path, *launched.args]
        self._apart.append(Apart(self, [launched.program], command))

    def _run_id(self) -> str:
        """The identifier that all launches at a master have in common, and their folder of logs."""
        parameters = self.master.parameters
        if '/run_id' not in parameters:
            parameters['/run_id'] = roslaunch.core.generate_run_id()
        return str(parameters['/run_id'])

    # -- end

    @property
    def is_over(self) -> bool:
        """Whether all that it has started has ended."""
        return all(started.is_over for started in self._started)

    @property
    def _started(self) -> List[Union[KeptNode, Apart]]:
        return [*self.kept, *self._apart]

    def outcomes(self) -> Iterator[Tuple[str, str]]:
        """What has become of each node, in a few words: ``(name, outcome)``."""
        for kept in self.kept:
            yield kept.name, kept.outcome
        for apart in self._apart:
            yield from apart.outcomes()
        for problem in self.problems:
            yield problem.name, 'did not start'

    def wait(self, timeout: Optional[float] = None) -> int:
        """Wait until all nodes have ended, of themselves or by a signal; returns 0, or 1 where a
        required one has, or none of them could be started.

        :param timeout: seconds, None: without limit
        :raises TimeoutError: if they have not in that time
        """
        with signals.interruptible_wait():
            if not node_registry.wait_until(lambda: self.is_over or self.is_ending, timeout):
                names = [kept.name for kept in self.kept if not kept.is_over]
                for apart in self._apart:
                    names += [] if apart.is_over else apart.names
                left = ', '.join(names)
                raise TimeoutError(f'not ended within {timeout:g} s: {left}; stop() ends all')
        self.stop()
        has_failed = [kept.problem is not None for kept in self.kept]
        is_nothing_started = all(has_failed) and not self._apart
        is_failure = is_nothing_started and bool(has_failed or self.problems)
        return 1 if is_failure or self.reason is not None else 0

    def end_because(self, reason: str) -> None:
        """End all of it, in a thread of its own, for a reason that is told."""
        with node_registry.changed:
            if self.is_ending:
                return
            self.reason = reason
            self._begin_end()
        self.progress.tell(f'{reason}: all others end')
        threading.Thread(target=self.stop, name='end of a composition', daemon=True).start()

    def _begin_end(self) -> None:
        """Start nothing any more."""
        with node_registry.changed:
            self.is_ending = True
            for kept in self.kept:
                kept.begin_end()
        node_registry.notify()

    def stop(self) -> None:
        """End all nodes, those apart too, side by side. Harmless when done twice."""
        self._begin_end()
        with signals.held(), self._stopping:
            threads = [threading.Thread(target=each.stop, daemon=True) for each in self._started]
            for thread in threads:
                thread.start()
            deadline = time.monotonic() + node_registry.STOP_LIMIT
            for thread in threads:
                thread.join(max(0.0, deadline - time.monotonic()))
            node_registry.not_before_stop_all(self._begin_end)

    def __enter__(self) -> 'Composition':
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    def __repr__(self) -> str:
        apart = '' if self.process is None else f', {self.process!r} apart'
        nodes = counted(len(self.kept), 'node')
        return f'<Composition of {nodes} at {self.master.url}{apart}>'


def _with_log(launched: LaunchedNode, folder: str, number: int) -> LaunchedNode:
    """The same, with the log files that roslaunch would give it."""
    name = launched.name[1:].replace('/', '-')
    log = os.path.join(folder, f'{name}-{number}.log')
    output = launched.output
    if output != SCREEN:
        output = os.path.join(folder, f'{name}-{number}-stdout.log')
    return dataclasses.replace(launched, args=[*launched.args, f'__log:={log}'], output=output)


def compose(
    master: 'Master',
    package: Optional[AnyPath],
    file: Optional[AnyPath],
    only: Collection[str],
    apart: Collection[str],
    share_connections: bool,
    args: Dict[str, object],
    progress: Optional[Progress] = None,
) -> Composition:
    """What :meth:`Master.compose` does."""
    if check_flag('share_connections', share_connections):
        master = copy.copy(master)
        master.share_connections = True
    launch_file = LaunchFile(master.url, package, file, args, only, apart)
    composition = Composition(master, progress)
    try:
        composition.launch(launch_file)
    except BaseException:
        composition.stop()
        raise
    return composition
