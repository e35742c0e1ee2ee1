"""Compositions: launch files whose Python nodes run in this process."""
from __future__ import annotations

import collections
import contextlib
import os
import pickle
import socket
import sys
import tempfile
import threading
import time

import roslaunch.core
import rospkg

from pharos import signals
from pharos.compose.child_process import RosProcess, find_program
from pharos.compose import control, roslaunch_parent
from pharos.compose.launch_file import Group
from pharos.compose.script import ScriptNode, wait_for_end
from pharos.compose.sources import compile_program, needs_main_thread
from pharos.errors import PharosError
from pharos.private_rospy.run import Lifecycle, Settings
from pharos.private_rospy.tcpros import shutdown_socket
from pharos.transcript import Transcript
from pharos.waiting import wait

#: seconds until the next node starts side by side with one that has not registered yet
HEAD_START = 0.1
INIT_LIMIT = 2.0  # seconds that a launch waits until all nodes have registered
TERMINATE_LIMIT = 40.0  # seconds: 20 after the SIGINT, since roslaunch gives its nodes 17
POLL_PERIOD = 0.02  # seconds between two looks at the nodes that have ended
#: seconds; with Python's default of 5 ms, nodes wait ten times as long beside a node that computes
SWITCH_INTERVAL = 0.3e-3


class Composition:
    """Programs that run in this process, unmodified, and the rest of their launch file.

    :meth:`Master.compose` makes a composition. The end of its ``with`` block ends the composition.

    :ivar nodes: the ScriptNodes of this process, in the order of the launch file
    :ivar process: the RosProcess in which roslaunch runs the others, or None
    """

    def __init__(self, master):
        self.master = master
        self.process: RosProcess | None = None
        self.nodes: list[ScriptNode] = []
        self._processes: list[RosProcess] = []  # of groups, and of scripts that need one each
        self._required_processes: list[RosProcess] = []  # those with a required node
        self._end_times: dict[ScriptNode, float] = {}  # as of time.monotonic()
        self._stopped_nodes: set[ScriptNode] = set()  # by control(); they do not respawn
        self._stopping = threading.Event()
        self._listener: socket.socket | None = None  # of control()
        self._watcher = threading.Thread(target=self._watch, name='composition', daemon=True)
        self._has_started = False  # True if one node was started
        self._has_lost_required = False

    def launch(self, launch_file):
        """Set the parameters of a launch file, and start its nodes.

        The Transcript shows why a node does not start, or runs in a process of its own.

        :param launch_file: the :class:`LaunchFile`
        :raises PharosError: if the master does not answer, or refuses a parameter
        """
        run_id = self.master.parameters.setdefault('/run_id', roslaunch.core.generate_run_id())
        launch_file.set_parameters(run_id)
        for text in launch_file.config.config_errors:
            Transcript.show(text)
        for name, reason in launch_file.reasons.items():
            Transcript.show(f'{name} runs in a process of its own: {reason}')
        if launch_file.nodes_apart:
            self._start_roslaunch(launch_file)
        log_folder = os.path.join(rospkg.get_log_dir(), run_id)
        groups = collections.defaultdict(list)
        for number, entry in enumerate(launch_file.entries, 1):
            log_name = f'{entry.name[1:].replace("/", "-")}-{number}.log'  # as roslaunch names logs
            arguments = [*entry.args, f'__log:={log_folder}/{log_name}']
            groups[entry.group].append(entry._replace(args=arguments))
            if entry.group not in ('', entry.name):
                Transcript.show(f'{entry.name} runs in the group {entry.group}')
        own_entries = groups.pop('', [])
        for entries in groups.values():
            self._start_group(entries)
        self.start_entries(own_entries)

    def start_entries(self, entries):
        """Start the nodes of this process, in the order of the launch file."""
        for entry in entries:
            with self._show_failure(entry.name):
                self.start(entry.name, entry.path, entry.args, entry.roslaunch_node)
        self._begin_watch()
        wait(lambda: all(map(_has_begun, self.nodes)), INIT_LIMIT)

    def _begin_watch(self):
        self._listener = control.listen(self)
        self._watcher.start()

    def _start_group(self, entries):
        """Start nodes in a process of this package."""
        master = self.master
        group = Group(entries, master.url, master.share_connections, master.shared_memory)
        search_path = os.pathsep.join(folder for folder in sys.path if folder)
        module = 'pharos.compose.group'
        command = ['env', f'PYTHONPATH={search_path}', sys.executable, '-m', module]
        process = self._start_process(command, group)
        self._processes.append(process)
        if any(entry.roslaunch_node.required for entry in entries):
            self._required_processes.append(process)

    def _start_process(self, command, data):
        """Start a program of this package; it gets a file with pickled data, and our number."""
        with tempfile.NamedTemporaryFile('wb', delete=False) as file:
            pickle.dump(data, file)
        self._has_started = True
        command = [*command, file.name, str(os.getpid())]
        return RosProcess(command, self.master.url, Transcript.show)

    def _start_roslaunch(self, launch_file):
        """Start the nodes apart in a process of roslaunch."""
        command = [sys.executable, roslaunch_parent.__file__]
        process = self._start_process(command, launch_file.config_apart())
        self.process = process
        if any(node.required for node in launch_file.nodes_apart):
            self._required_processes.append(process)

    def run_scripts(self, programs, programs_here):
        """Run programs without a launch file; the Transcript shows why a program does not start.

        :param programs: texts: PACKAGE/EXECUTABLE, or a path
        :param programs_here: those of them that run in this process even if they show windows
        """
        for text in programs:
            with self._show_failure(text):
                self._run_script(text, text in programs_here)
        self._begin_watch()

    def _run_script(self, text, may_show_windows):
        path = text
        if not os.path.isfile(text):
            package, _, executable = text.partition('/')
            if not executable:
                raise PharosError(f'there is no file {text} here: give a path, or PACKAGE/PROGRAM')
            path = find_program(package, executable)
        reason = '' if may_show_windows else needs_main_thread(path)
        if reason:
            Transcript.show(f'{text} runs in a process of its own: {reason}')
            self._has_started = True
            command = [sys.executable, os.path.abspath(path)]
            self._processes.append(RosProcess(command, self.master.url, Transcript.show))
        else:
            Transcript.show(f'{text} starts')
            self.nodes.append(self.master.load(path, here=True))
            self._has_started = True

    @contextlib.contextmanager
    def _show_failure(self, name):
        """Show a PharosError of a start in the Transcript, and go on: the other programs start."""
        try:
            yield
        except PharosError as error:
            Transcript.show(f'{name} is not started: {error}')

    def start(self, name, path, arguments, roslaunch_node=None, init_timeout=HEAD_START):
        """Start a program as the node of that name, and return the node.

        :param path: the file of the program
        :param arguments: the arguments of the program, with ROS's
        :param roslaunch_node: roslaunch's Node, if the program comes from a launch file
        :raises PharosError: if the program failed before ``init_node``
        """
        node = ScriptNode.__new__(ScriptNode)
        node._configure(Settings(name, self.master, None, (0, 0), ()), None, None)
        ScriptNode.__init__(
            node, path, arguments, None, roslaunch_node.env_args if roslaunch_node else ()
        )
        node.init_timeout = init_timeout
        node.roslaunch_node = roslaunch_node
        self.nodes.append(node)
        Transcript.show(f'{name} starts')
        node._start_held()
        self._has_started = True
        return node

    @property
    def is_over(self) -> bool:
        """True if all started nodes and processes have ended, and no node respawns."""
        if self._stopped_nodes:
            return False
        for node in self.nodes:
            respawns = node.roslaunch_node and node.roslaunch_node.respawn
            if respawns or node.lifecycle is not Lifecycle.STOPPED:
                return False
        return all(process.poll() is not None for process in self._all_processes())

    def _all_processes(self):
        return [*self._processes, self.process] if self.process else self._processes

    def _watch(self):
        """Show ends, start again nodes that respawn, and end all if a required node has ended."""
        while not self.is_over:
            is_stopping = self._stopping.wait(POLL_PERIOD)
            if is_stopping:
                break
            self._look()
        self._look()

    def _look(self):
        for node in self.nodes:
            if self._stopping.is_set():
                return
            if node.lifecycle is Lifecycle.STOPPED and node not in self._stopped_nodes:
                self._look_at_ended(node)
        for process in self._required_processes:
            if process.poll() is not None:  # roslaunch or a group ends with its required node
                self._end('a node in another process')

    def _look_at_ended(self, node):
        name = node._settings.name
        now = time.monotonic()
        if node not in self._end_times:
            self._end_times[node] = now
            Transcript.show(f'{name} has ended, with exit code {node.exit_code}')
        roslaunch_node = node.roslaunch_node
        if not roslaunch_node:
            return
        if roslaunch_node.required:
            self._end(name)
        elif roslaunch_node.respawn:
            if now - self._end_times[node] >= float(roslaunch_node.respawn_delay):
                self._respawn(node, name)

    def _respawn(self, node, name):
        with self._show_failure(name):
            Transcript.show(f'{name} comes back')
            del self._end_times[node]
            node._start_held()
        if self._stopping.is_set():  # stop() may have looked before the start
            node._stop_safely()

    def control(self, node, action):
        """Restart, stop or start a node; a required one may stop, too.

        :raises PharosError: if the node does not start
        """
        if action == 'restart':
            compile_program(node.path)  # the node runs on if its new program cannot be read
        Transcript.show(f'{node._settings.name}: {action}')
        self._stopped_nodes.add(node)
        if action != 'start':
            node._stop_safely()
        if action != 'stop':
            if not node.is_running:
                node._start_held()
            self._end_times.pop(node, None)
            self._stopped_nodes.discard(node)

    def _end(self, name):
        if not self._stopping.is_set():
            Transcript.show(f'{name}, which is required, has ended: all others end')
            self._has_lost_required = True
            self.stop()

    def wait(self, timeout: float | None = None) -> int:
        """Wait until all nodes have ended, or Ctrl-C, and stop the composition.

        :param timeout: seconds, None: without limit
        :returns: 0; or 1 if a required node has ended, or no node has started
        :raises TimeoutError: if not all nodes have ended in time
        """
        wait_for_end(self._must_end, timeout, 'the composition')
        if self.is_over:
            self._watcher.join()  # the watcher shows all ends before this returns
        self.stop()
        return 1 if self._has_lost_required or not self._has_started else 0

    def _must_end(self):
        return self.is_over or self._stopping.is_set() or signals.is_ending()

    def stop(self) -> None:
        """End all nodes, also those in processes of their own, and wait for their ends."""
        self._stopping.set()
        if self._listener:
            shutdown_socket(self._listener)
        threads = [threading.Thread(target=node._stop_safely) for node in self.nodes]
        for process in self._all_processes():
            threads.append(threading.Thread(target=process.terminate, args=[TERMINATE_LIMIT]))
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def __enter__(self) -> Composition:
        return self

    def __exit__(self, *error):
        self.stop()


def _has_begun(node):
    """True if a program has registered its node, or has ended."""
    return not node.is_running or node._current_run.is_known
