"""What of a composition runs apart, in processes of its own."""
import contextlib
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
from typing import TYPE_CHECKING, Any, Iterator, List, Tuple

import rosgraph.names

from pharos import node_registry
from pharos.compose import apart_program
from pharos.errors import PharosError
from pharos.external_node import ExternalNode
from pharos.ros_process import RosProcess
from pharos.transcript import Transcript

if TYPE_CHECKING:
    from pharos.compose.composition import Composition

END_TIMEOUT = 5.0  # seconds that roslaunch may take to end its nodes in its own manner


class Apart:
    """A process, which runs from now on.

    :param names: what runs in it
    """

    def __init__(self, composition: 'Composition', names: List[str], command: List[str]) -> None:
        self.names = names
        shows_colors = sys.stdout is not None and sys.stdout.isatty()
        self.process = RosProcess(command, composition.master, Transcript.show, shows_colors)
        self._composition = composition
        threading.Thread(target=self._wait, name='nodes apart', daemon=True).start()

    def _wait(self) -> None:
        self._ended(self.process.wait())
        node_registry.notify()

    def _ended(self, status: int) -> None:
        """Called when it has ended, in a thread of its own."""

    @property
    def is_over(self) -> bool:
        """Whether it has ended."""
        return self.process.poll() is not None

    def outcomes(self) -> Iterator[Tuple[str, str]]:
        """What has become of each that runs in it, in a few words: ``(name, outcome)``."""
        outcome = self._outcome(self.process.poll())
        for name in self.names:
            yield name, outcome

    def _outcome(self, status: Any) -> str:
        return 'runs apart' if status is None else f'ran apart, and ended with {status}'

    def stop(self) -> None:
        """End it, as every RosProcess."""
        self.process.terminate()


class ApartNodes(Apart):
    """The nodes of a launch file, which roslaunch runs.

    :param config: roslaunch's configuration of them
    """

    def __init__(self, composition: 'Composition', config: Any) -> None:
        names = [rosgraph.names.ns_join(node.namespace, node.name) for node in config.nodes]
        with tempfile.NamedTemporaryFile('wb', suffix='.launch', delete=False) as file:
            pickle.dump(config, file)
        # as a file and not as a module: PYTHONPATH is for the nodes as it is
        command = [sys.executable, apart_program.__file__, file.name, str(os.getpid())]
        super().__init__(composition, names, command)

    def _ended(self, status: int) -> None:
        """Tell why roslaunch has ended."""
        names = ', '.join(self.names)
        if status == apart_program.REQUIRED_ENDED:
            self._composition.end_because(f'a required one of {names}, which run apart, has ended')
        elif status and not self._composition.is_ending:
            left = '' if status > 0 else ' and its nodes are asked to end'
            self._composition.progress.tell(
                f'roslaunch, which runs {names} apart, has ended with {status}:'
                f' the others go on{left}'
            )
            if status < 0:  # killed, it has not ended them
                self._shut_down()

    def _shut_down(self) -> None:
        """Ask them to end, as rosnode kill does."""
        for name in self.names:
            with contextlib.suppress(PharosError):  # it is none, or is gone
                ExternalNode(self._composition.master, name).shutdown()

    def _outcome(self, status: Any) -> str:
        if status is None:
            return 'runs apart, by roslaunch'
        if status < 0:
            return 'ran apart: asked to end, as roslaunch was killed'
        return f'ran apart, by roslaunch, which ended with {status}'

    def stop(self) -> None:
        """End roslaunch as Ctrl-C does, which ends its nodes in order, and else as every
        RosProcess."""
        if not self.is_over:
            os.kill(self.process.pid, signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(END_TIMEOUT)
        super().stop()
