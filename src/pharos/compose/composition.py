"""Compositions: launch files whose Python nodes run in this process."""
import dataclasses
import os
import threading
import time
from typing import TYPE_CHECKING, Any, Collection, Dict, Iterator, List, Optional, Tuple

import roslaunch.core
import rospkg

from pharos import node_registry, signals
from pharos.compose import rest, rest_program
from pharos.compose.kept_node import KeptNode
from pharos.compose.launch_file import LaunchedNode, LaunchFile, Problem
from pharos.compose.output import SCREEN
from pharos.compose.progress import Progress
from pharos.compose.script import ScriptNode
from pharos.errors import PharosError
from pharos.ros_process import RosProcess

if TYPE_CHECKING:
    from pharos.master import Master

PATIENCE = 2.0  # seconds that a node may take to start before the next one does
POLL = 0.1  # seconds between two looks whether something has ended, for want of an event


class Composition:
    """Programs of Python that run in this process, unmodified, and the rest of their launch file;
    made by :meth:`Master.compose`. Ends with its ``with`` block.

    :param master: the :class:`Master` of its nodes
    :param progress: what tells of them
    """

    def __init__(self, master: 'Master', progress: Optional[Progress] = None) -> None:
        self.master = master
        self.progress = progress or Progress()
        #: the process in which roslaunch runs the rest; None: there is none
        self.process: Optional[RosProcess] = None
        #: the names of the nodes in it
        self.apart: List[str] = []
        #: why it has ended by itself, before all of its nodes had
        self.reason: Optional[str] = None
        #: whether it ends, or has ended
        self.is_ending = False
        #: why nodes of it were not even tried to start
        self.problems: List[Problem] = []
        self._kept: List[KeptNode] = []
        self._changed = threading.Condition()  # guards what is above
        self._stopping = threading.RLock()
        node_registry.before_stop_all(self._begin_end)

    @property
    def nodes(self) -> List[ScriptNode]:
        """The nodes of this process, in the order of the launch file."""
        return [kept.node for kept in self._kept if kept.node is not None]

    @property
    def kept(self) -> List[KeptNode]:
        """What was started in this process, whether it has come to be a node or not."""
        return list(self._kept)

    # -- start

    def launch(self, file: LaunchFile) -> None:
        """Set the parameters of a launch file, and start its nodes.

        :raises MasterUnreachableError: if the master does not answer
        :raises PharosError: if it refuses a parameter
        """
        run_id = rest.run_id_of(self.master)
        try:
            rest.ParameterSetter(run_id, file.config).set_all()
        except roslaunch.core.RLException as error:
            raise PharosError(f'{file.path}: {error}') from error
        for text in file.config.config_errors:
            self.progress.tell(str(text))
        for problem in file.problems:
            self.refuse(problem)
        for problem in file.problems:
            if problem.ends_all:
                return self.end_because(f'{problem.name}, which is required, cannot be started')
        if file.apart:
            self._launch_rest(file.rest())
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
        with self._changed:
            self._kept += started
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

    def _launch_rest(self, config: Any) -> None:
        self.process = process = rest.start_rest(self.master, config)
        self.apart = rest.names_of(config)
        names = ', '.join(self.apart)

        def wait() -> None:
            status = process.wait()
            if status == rest_program.REQUIRED_ENDED:
                self.end_because(f'a required one of {names}, which run apart, has ended')
            elif status and not self.is_ending:
                left = '' if status > 0 else ' and its nodes are asked to end'
                self.progress.tell(
                    f'roslaunch, which runs {names} apart, has ended with {status}:'
                    f' the others go on{left}'
                )
                if status < 0:  # killed, it has not ended them
                    rest.shut_down(self.master, self.apart)
            self.changed()

        threading.Thread(target=wait, name=f'{names} apart', daemon=True).start()

    # -- end

    def changed(self) -> None:
        """Something of it has ended."""
        with self._changed:
            self._changed.notify_all()

    @property
    def is_over(self) -> bool:
        """Whether all that it has started has ended."""
        is_rest_over = self.process is None or self.process.poll() is not None
        return is_rest_over and all(kept.is_over for kept in self._kept)

    def outcomes(self) -> Iterator[Tuple[str, str]]:
        """What has become of each node, in a few words: ``(name, outcome)``."""
        for kept in self._kept:
            yield kept.name, kept.outcome
        is_killed = self.process is not None and (self.process.poll() or 0) < 0
        by = 'asked to end, as roslaunch was killed' if is_killed else 'ended by roslaunch'
        for name in self.apart:
            yield name, f'in a process of its own, {by}'
        for problem in self.problems:
            yield problem.name, 'did not start'

    def wait(self, timeout: Optional[float] = None) -> int:
        """Wait until all nodes have ended, of themselves or by a signal; returns 0, or 1 where a
        required one has, or none of them could be started.

        :param timeout: seconds, None: without limit
        :raises TimeoutError: if they have not in that time
        """
        deadline = float('inf') if timeout is None else time.monotonic() + timeout
        with signals.interruptible_wait(), self._changed:
            while not (self.is_over or self.is_ending):
                if time.monotonic() >= deadline:
                    left = ', '.join(kept.name for kept in self._kept if not kept.is_over)
                    raise TimeoutError(f'{left} have not ended within {timeout:g} s: stop() them')
                self._changed.wait(POLL)
        self.stop()
        failed = [*self.problems, *(kept for kept in self._kept if kept.problem is not None)]
        has_any = len(failed) < len(self._kept) + len(self.apart) + len(self.problems)
        return 0 if self.reason is None and (has_any or not failed) else 1

    def end_because(self, reason: str) -> None:
        """End all of it, in a thread of its own, for a reason that is told."""
        with self._changed:
            if self.is_ending:
                return
            self.reason = reason
            self._begin_end()
        self.progress.tell(f'{reason}: all others end')
        threading.Thread(target=self.stop, name='end of a composition', daemon=True).start()

    def _begin_end(self) -> None:
        """Start nothing any more."""
        with self._changed:
            self.is_ending = True
            for kept in self._kept:
                kept.begin_end()
            self._changed.notify_all()

    def stop(self) -> None:
        """End all nodes, those apart too, side by side. Harmless when done twice."""
        self._begin_end()
        with signals.held(), self._stopping:
            ends = [kept.stop for kept in reversed(self._kept)]
            if self.process is not None:
                process = self.process
                ends.append(lambda: rest.stop_rest(process))
            threads = [threading.Thread(target=end, daemon=True) for end in ends]
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
        return f'<Composition of {len(self._kept)} nodes at {self.master.url}{apart}>'


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
    package: Optional[str],
    file: str,
    only: Collection[str],
    apart: Collection[str],
    share_connections: bool,
    args: Dict[str, object],
    progress: Optional[Progress] = None,
) -> Composition:
    """What :meth:`Master.compose` does."""
    if share_connections:
        raise PharosError(
            'share_connections is to come: each node of this process has its own connections to'
            ' publishers elsewhere. Leave it out'
        )
    launch_file = LaunchFile(master.url, package, file, args, only, apart)
    composition = Composition(master, progress)
    try:
        composition.launch(launch_file)
    except BaseException:
        composition.stop()
        raise
    return composition
