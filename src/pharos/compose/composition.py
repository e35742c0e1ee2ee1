"""Compositions: launch files whose Python nodes run in this process."""
import contextlib
import os
import pickle
import sys
import tempfile
import threading
import time

import roslaunch.core
import rospkg

from pharos import program
from pharos.compose import apart_program
from pharos.compose.launch_file import LaunchFile
from pharos.compose.script import ScriptNode, load, needs_main_thread, wait_for_end
from pharos.errors import PharosError
from pharos.master import Master
from pharos.node import Lifecycle
from pharos.ros_process import RosProcess, find_program
from pharos.transcript import Transcript

PATIENCE = 2.0  # seconds that a node may take to start before the next one does
APART_PATIENCE = 40.0  # seconds: half of it for roslaunch, which gives each node 17
POLL = 0.02  # seconds between two looks at what has ended


class Composition:
    """Programs that run in this process, unmodified, and the rest of their launch file.

    Made by :meth:`Master.compose`; ends with its ``with`` block.

    :ivar nodes: the ScriptNodes of this process, in the order of the launch file
    :ivar process: the RosProcess in which roslaunch runs the others, or None
    """

    def __init__(self, master):
        self.master = master
        self.process = None
        self.nodes: list[ScriptNode] = []
        self._processes: list[RosProcess] = []  # of scripts that need one each
        self._ended: dict[ScriptNode, float] = {}  # since when, as time.monotonic()
        self._ending = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name='composition', daemon=True)
        self._is_required = False  # True if a required node runs apart
        self._has_started = False  # True if one node was started
        self._has_lost = False  # True if a required node has ended

    def launch(self, file):
        """Set the parameters of a launch file, and start its nodes.

        :raises PharosError: if the master does not answer, or refuses a parameter
        """
        run_id = self.master.parameters.setdefault('/run_id', roslaunch.core.generate_run_id())
        file.set_parameters(run_id)
        for text in file.config.config_errors:
            Transcript.show(text)
        for name, reason in file.reasons.items():
            Transcript.show(f'{name} runs in a process of its own: {reason}')
        if file.apart:
            with tempfile.NamedTemporaryFile('wb', suffix='.launch', delete=False) as pickled:
                pickle.dump(file.config_apart(), pickled)
            command = [sys.executable, apart_program.__file__, pickled.name, str(os.getpid())]
            self._is_required = any(node.required for node in file.apart)
            self._has_started = True
            self.process = RosProcess(command, self.master.url, Transcript.show)
        logs = os.path.join(rospkg.get_log_dir(), run_id)
        for number, (name, path, args, launched) in enumerate(file.here, 1):
            log = f'{name[1:].replace("/", "-")}-{number}.log'  # as roslaunch names it
            with self.telling(name):
                self.start(name, path, [*args, f'__log:={logs}/{log}'], launched)
        self._watcher.start()

    def run_scripts(self, texts, here):
        """Run programs; why one does not start is shown."""
        for text in texts:
            with self.telling(text):
                self._run_script(text, text in here)
        self._watcher.start()

    def _run_script(self, text, is_here):
        """Run a program given as PACKAGE/EXECUTABLE or by its path, in a process if it needs one."""
        package, _, executable = text.partition('/')
        path = text
        if not os.path.isfile(text):
            path = find_program(package, executable)
        reason = '' if is_here else needs_main_thread(path)
        if not reason:
            Transcript.show(f'{text} starts')
            self.nodes.append(load(self.master, path, here=True))
            self._has_started = True
            return
        Transcript.show(f'{text} runs in a process of its own: {reason}')
        self._has_started = True
        command = [sys.executable, os.path.abspath(path)]
        self._processes.append(RosProcess(command, self.master.url, Transcript.show))

    @contextlib.contextmanager
    def telling(self, name):
        """Show why a program is not started, and go on with the others."""
        try:
            yield
        except PharosError as error:
            Transcript.show(f'{name} is not started: {error}')

    def start(self, name, path, args, launched=None):
        """Start a program as the node of that name, and return it.

        :param launched: roslaunch's node, if it is of a launch file
        """
        node = ScriptNode.__new__(ScriptNode)
        node._configure(self.master, name, None, None, None, (0, 0), ())
        node.__init__(path, args, None, launched.env_args if launched else ())
        node.init_timeout, node.launched = PATIENCE, launched
        self.nodes.append(node)
        Transcript.show(f'{name} starts')
        node._begin()
        self._has_started = True
        return node

    @property
    def is_over(self):
        """True if all that it started has ended."""
        for node in self.nodes:
            respawns = node.launched and node.launched.respawn
            if respawns or node._lifecycle is not Lifecycle.STOPPED:
                return False
        return not any(process.poll() is None for process in self._all_processes())

    def _all_processes(self):
        return [*self._processes, self.process] if self.process else self._processes

    def _watch(self):
        """Start again what respawns, and end all if a required node has ended."""
        while not self._ending.wait(POLL) and not self.is_over:
            self._look()
        self._look()

    def _look(self):
        for node in self.nodes:
            if self._ending.is_set():
                return
            if node._lifecycle is Lifecycle.STOPPED:
                self._look_at_ended(node)
        if self._is_required and self.process.poll() is not None:  # all of it has ended
            self._end('a node in a process of its own')

    def _look_at_ended(self, node):
        now = time.monotonic()
        if node not in self._ended:
            self._ended[node] = now
            Transcript.show(f'{node._name} has ended, with exit code {node.exit_code}')
        launched = node.launched
        if not launched:
            return
        if launched.required:
            self._end(node._name)
        elif launched.respawn and now - self._ended[node] >= float(launched.respawn_delay):
            with self.telling(node._name):
                Transcript.show(f'{node._name} comes back')
                del self._ended[node]
                node._begin()
            if self._ending.is_set():  # since it looked
                node._end_now()

    def _end(self, name):
        if not self._ending.is_set():
            Transcript.show(f'{name}, which is required, has ended: all others end')
            self._has_lost = True
            self.stop()

    def wait(self, timeout: float | None = None) -> int:
        """Wait until all nodes have ended; returns 0, or 1 if a required one has, or none started.

        :param timeout: seconds, None: without limit
        :raises TimeoutError: if they have not in that time
        """
        wait_for_end(self._is_to_end, timeout, 'the composition')
        if self.is_over:
            self._watcher.join()  # it has seen all
        self.stop()
        return 1 if self._has_lost or not self._has_started else 0

    def _is_to_end(self):
        return self.is_over or self._ending.is_set() or program.signalled

    def stop(self) -> None:
        """End all nodes, those apart, too."""
        self._ending.set()
        threads = [threading.Thread(target=node._end_now) for node in self.nodes]
        for thread in threads:
            thread.start()
        for process in self._all_processes():
            process.terminate(APART_PATIENCE)
        for thread in threads:
            thread.join()

    def __enter__(self) -> 'Composition':
        return self

    def __exit__(self, *error):
        self.stop()


def compose(master, package, file, *, only=(), apart=(), here=(), share_connections=False, **args):
    """Do what :meth:`Master.compose` does."""
    launch_file = LaunchFile(master.url, package, file, args, only, apart, here)
    share_connections = share_connections or master.share_connections
    composition = Composition(Master(master.url, share_connections))
    composition.launch(launch_file)
    return composition
