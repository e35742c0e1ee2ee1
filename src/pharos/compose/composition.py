"""Compositions: launch files whose Python nodes run in this process."""
import contextlib
import os
import pickle
import sys
import tempfile
import threading

import roslaunch.core

from pharos import program
from pharos.compose import apart_program
from pharos.compose.launch_file import LaunchFile
from pharos.compose.script import ScriptNode, wait_for_end
from pharos.errors import PharosError
from pharos.node import Lifecycle
from pharos.ros_process import RosProcess
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
        self.master, self.process = master, None
        self.nodes: list[ScriptNode] = []
        self._ending, self._status, self._required = threading.Event(), 0, False

    def launch(self, file):
        """Set the parameters of a launch file, and start its nodes.

        :raises PharosError: if the master does not answer, or refuses a parameter
        """
        run_id = self.master.parameters.setdefault('/run_id', roslaunch.core.generate_run_id())
        file.set_parameters(run_id)
        for text in file.config.config_errors:
            Transcript.show(text)
        if file.apart:
            with tempfile.NamedTemporaryFile('wb', suffix='.launch', delete=False) as pickled:
                pickle.dump(file.config_apart(), pickled)
            command = [sys.executable, apart_program.__file__, pickled.name, str(os.getpid())]
            self._required = any(node.required for node in file.apart)
            self.process = RosProcess(command, self.master.url, Transcript.show)
        for name, *program_and_node in file.here:
            with self.telling(name):
                self.start(name, *program_and_node)
        threading.Thread(target=self._watch, name='composition', daemon=True).start()

    @contextlib.contextmanager
    def telling(self, name):
        """Show why a program is not started, and go on with the others."""
        try:
            yield
        except PharosError as error:
            self._status = 1
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
        node.start()
        self._status = 0
        return node

    @property
    def is_over(self):
        """True if all that it started has ended."""
        goes_on = [
            node.lifecycle is not Lifecycle.STOPPED or (node.launched and node.launched.respawn)
            for node in self.nodes
        ]
        return not any(goes_on) and (self.process is None or self.process.poll() is not None)

    def _watch(self):
        """Start again what respawns, and end all if a required node has ended."""
        while not self._ending.wait(POLL) and not self.is_over:
            self.look()
        self.look()

    def look(self):
        """Look once what has ended."""
        for node in [node for node in self.nodes if node.lifecycle is Lifecycle.STOPPED]:
            launched = node.launched
            if self._ending.is_set() or not launched:
                return
            if launched.required:
                return self._end(node.name)
            if launched.respawn and not self._ending.wait(float(launched.respawn_delay)):
                with self.telling(node.name):
                    node.start()
                if self._ending.is_set():  # since it looked
                    node.end_now()
        if self._required and self.process.poll() is not None:  # all of it has ended
            self._end('a node in a process of its own')

    def _end(self, name):
        if not self._ending.is_set():
            Transcript.show(f'{name}, which is required, has ended: all others end')
            self._status = 1
            self.stop()

    def wait(self, timeout: float | None = None) -> int:
        """Wait until all nodes have ended; returns 0, or 1 if a required one has, or none started.

        :param timeout: seconds, None: without limit
        :raises TimeoutError: if they have not in that time
        """
        wait_for_end(self._is_to_end, timeout, 'the composition')
        self.look()
        self.stop()
        return self._status

    def _is_to_end(self):
        return self.is_over or self._ending.is_set() or program.signalled

    def stop(self) -> None:
        """End all nodes, those apart, too."""
        self._ending.set()
        threads = [threading.Thread(target=node.end_now) for node in self.nodes]
        for thread in threads:
            thread.start()
        if self.process:
            self.process.terminate(APART_PATIENCE)
        for thread in threads:
            thread.join()

    def __enter__(self) -> 'Composition':
        return self

    def __exit__(self, *error):
        self.stop()


def compose(master, package, file, *, only=(), apart=(), share_connections=False, **args):
    """Do what :meth:`Master.compose` does."""
    launch_file = LaunchFile(master.url, package, file, args, only, apart)
    share_connections = share_connections or master.share_connections
    composition = Composition(type(master)(master.url, share_connections))
    composition.launch(launch_file)
    return composition
