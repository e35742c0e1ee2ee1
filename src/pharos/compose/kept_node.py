"""Nodes that are kept running as a launch file says."""
import threading
import time
from typing import TYPE_CHECKING, Optional

from pharos import attributes, node_registry
from pharos.compose.launch_file import LaunchedNode
from pharos.compose.script import ScriptNode, ScriptRun
from pharos.starts import start_made

if TYPE_CHECKING:
    from pharos.compose.composition import Composition

RETRY = 1.0  # seconds at least from a start that failed to the next one
POLL = 0.1  # seconds between two looks whether one that is to stop has just started
_OF_SCRIPT = 'path', 'args', 'env', 'takes_own_name', 'private_name', 'cwd', 'output'


class KeptNode:
    """A script that is started, waited for, and started again where that is asked for, in a thread
    of its own, until the composition ends.
    """

    def __init__(self, composition: 'Composition', launched: LaunchedNode) -> None:
        self.launched = launched
        #: the node, once it is made
        self.node: Optional[ScriptNode] = None
        #: what kept it from starting, the last time
        self.problem: Optional[Exception] = None
        #: how often it was started
        self.starts = 0
        #: set when its first start has come to an end, well or not
        self.settled = threading.Event()
        #: whether it runs no more, and is not started again
        self.is_over = False
        self._was_started = self._has_ended_itself = False
        self._composition = composition
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f'{self.name} kept', daemon=True)

    @property
    def name(self) -> str:
        """The name that it was given, or has; its program, where that is to name it."""
        is_node = self._was_started and not self.has_ended_without_node
        if is_node and self.node is not None:
            return self.node.name
        return self.launched.program if self.launched.takes_own_name else self.launched.name

    @property
    def has_ended_without_node(self) -> bool:
        """Whether it has ended, and was no node."""
        run = self.node and self.node.latest_run
        return isinstance(run, ScriptRun) and run.has_ended and not run.is_registered

    def start(self) -> None:
        """Start it, and keep it running; see :attr:`settled`."""
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._ending.is_set():
                self._run_once()
                if self.launched.respawn_delay is None:
                    break
                # what cannot start is not tried again and again at once
                least = 0.0 if self.problem is None else RETRY
                self._ending.wait(max(self.launched.respawn_delay, least))
        finally:
            self.settled.set()
            self.is_over = True
            node_registry.notify()

    def _run_once(self) -> None:
        """Start it, and wait for its end."""
        begun = time.monotonic()
        self.starts += 1
        try:
            self._start()
            self.problem, self._was_started = None, True
        except Exception as error:
            if self._ending.is_set():
                return  # it was stopped while it started
            self.problem = error
        finally:
            self.settled.set()
        progress = self._composition.progress
        if self.problem is not None:
            progress.failed(self, self.problem)
            if self.launched.is_required:
                self._composition.end_because(f'{self.name}, which is required, did not start')
        else:
            assert self.node
            if not self._ending.is_set():
                progress.started(self, time.monotonic() - begun)
            self.node.wait()
            self._has_ended_itself = not self._ending.is_set()
            if self._has_ended_itself:
                progress.ended(self)
                if self.launched.is_required:
                    self._composition.end_because(f'{self.name}, which is required, has ended')

    def _start(self) -> None:
        launched = self.launched
        if self.node is None:
            self.node = attributes.make(
                ScriptNode,
                self._composition.master,
                launched.name,
                soul=None,
                delegate=None,
                args=(),
                kwargs={name: getattr(launched, name) for name in _OF_SCRIPT},
            )
        start_made(self.node)

    def begin_end(self) -> None:
        """Start it no more."""
        self._ending.set()

    def stop(self) -> None:
        """Stop it, also where it only is about to start."""
        self.begin_end()
        deadline = time.monotonic() + node_registry.STOP_LIMIT
        while self._thread.is_alive() and time.monotonic() < deadline:
            if self.node is not None:
                node_registry.stop(self.node)
            self._thread.join(POLL)

    @property
    def outcome(self) -> str:
        """What has become of it, in a few words."""
        again = f', started {self.starts} times' if self.starts > 1 else ''
        if self.problem is not None:
            return f'did not start{again}'
        if self.node is None:
            return 'was not started'
        if not self.is_over and self.node.is_running:
            return f'runs{again}'
        code = self.node.exit_code
        if code is None or not code and not self._has_ended_itself:
            return f'stopped{again}'
        return f'ended with exit code {code}{again}'
