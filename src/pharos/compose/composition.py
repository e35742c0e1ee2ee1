"""Compositions: launch files whose Python nodes run in this process."""
from __future__ import annotations

import collections
import contextlib
import faulthandler
import os
import pickle
import re
import signal
import socket
import sys
import tempfile
import threading
import time
from typing import TYPE_CHECKING, Any, Iterator

import rosgraph
import roslaunch.core
import rosnode
import rospkg
from rosgraph.names import get_ros_namespace, ns_join

from pharos import signals
from pharos.compose import control, roslaunch_parent
from pharos.compose.child_process import RosProcess, find_program
from pharos.compose.launch_file import Entry, LaunchFile
from pharos.compose.script import ScriptNode, name_of_file, wait_for_end
from pharos.compose.sources import (
    environment_of,
    needs_process,
    needs_group,
    source_of,
    why_not_this_python,
)
from pharos.errors import PharosError
from pharos.live.external_node import ExternalNode
from pharos.private_rospy.run import Lifecycle, Settings, join
from pharos.private_rospy.tcpros import shutdown_socket
from pharos.transcript import Transcript, attempt
from pharos.waiting import wait

if TYPE_CHECKING:
    from pharos.master import Master

#: seconds until the next node starts side by side with one that has not registered yet
HEAD_START = 0.1
SLOW_END = 2.0  # seconds; the Transcript names what takes longer to end
INIT_LIMIT = 2.0  # seconds that a launch waits until all nodes have registered
TERMINATE_LIMIT = 40.0  # seconds: 20 after the SIGINT, since roslaunch gives its nodes 17
#: variables that a process reads when it starts, or a library when it is loaded
AT_START = re.compile('LD_|PYTHON|OMP_|MKL_|OPENBLAS_|CUDA_')
POLL_PERIOD = 0.02  # seconds between two looks at the nodes that have ended
#: seconds; with Python's default of 5 ms, nodes wait ten times as long beside a node that computes
SWITCH_INTERVAL = 0.3e-3


def compose(master: Master, *options: Any) -> Composition:
    """Do the work of :meth:`Master.compose`; the options are those of LaunchFile."""
    launch_file = LaunchFile(master.url, *options)
    composition = Composition(master)
    composition.launch(launch_file)
    return composition


class Composition:
    """Programs that run in this process, unmodified, and the rest of their launch file.

    :meth:`Master.compose` makes a composition. The end of its ``with`` block ends the composition.

    :param owns_process: True: nothing but the composition runs in this process
    :ivar nodes: the ScriptNodes of this process, in the order of the launch file
    :ivar stopping: an Event, set when the end has begun
    """

    reloads = False  # True: what is saved takes effect, also in groups

    def __init__(self, master: Master, owns_process: bool = False) -> None:
        self.master = master
        self.owns_process = owns_process
        self.nodes: list[ScriptNode] = []
        self.stopping = threading.Event()
        self._parts: list[_Part] = []  # processes of groups, of roslaunch, and of single programs
        self._roslaunch_part: _Part | None = None
        self._end_times: dict[ScriptNode, float] = {}  # as of time.monotonic()
        self._stopped_nodes: set[ScriptNode] = set()  # by control(); they do not respawn
        self._listener: socket.socket | None = None  # of control()
        self.environment = dict(os.environ)  # of the parts, and of this process after the end
        self._own_variables: dict[str, str] = {}  # that this process has for its nodes
        self._watcher = threading.Thread(target=self._watch, name='composition', daemon=True)
        self._has_started = False  # True if one node was started
        self._has_failed = False  # True if a required node has ended, or a process by a signal
        if owns_process:
            faulthandler.enable(all_threads=False)  # a crash in C says where in Python it was
            sys.setswitchinterval(SWITCH_INTERVAL)

    def launch(self, launch_file: LaunchFile) -> None:
        """Set the parameters of a launch file, and start its nodes.

        The Transcript shows why a node does not start, or runs in another process.

        :param launch_file: a LaunchFile, which has read the file
        :raises PharosError: if the master does not answer, or refuses a parameter
        """
        run_id = self.master.parameters.setdefault('/run_id', roslaunch.core.generate_run_id())
        launch_file.set_parameters(run_id)
        for text in launch_file.config.config_errors:
            Transcript.show(text)
        if launch_file.entries_apart:
            command = [sys.executable, roslaunch_parent.__file__]
            self._roslaunch_part = self._start_part(
                launch_file.entries_apart, command, launch_file.config_of
            )
        log_folder = os.path.join(rospkg.get_log_dir(), run_id)
        os.makedirs(log_folder, exist_ok=True)
        Transcript.show(f'ROS master {self.master.url}, logs in {log_folder}')
        entries = []
        for number, entry in enumerate(launch_file.entries, 1):
            # as roslaunch names logs
            log = f'{log_folder}/{entry.name[1:].replace("/", "-")}-{number}'
            entries.append(entry._replace(args=[*entry.args, f'__log:={log}.log'], log=log))
        self._start_groups(entries)

    def run_scripts(
        self, programs: list[str], arguments: list[str], programs_here: list[str]
    ) -> None:
        """Run programs without a launch file; the Transcript shows why a program does not start.

        :param programs: texts: PACKAGE/EXECUTABLE, or a path
        :param arguments: for each program, such as '_rate:=5'
        :param programs_here: those of them that run in this process even if they show windows
        """
        Transcript.show(f'ROS master {self.master.url}, logs in {rospkg.get_log_dir()}')
        entries: list[Entry] = []
        for text in programs:
            with self._show_failure(text):
                entries += self._script_entries(text, arguments, text in programs_here)
        self._start_groups(entries)

    def _script_entries(self, text: str, arguments: list[str], is_here: bool) -> list[Entry]:
        """Return a list with the entry of a program; start a plain process if it needs one."""
        path = text
        if not os.path.isfile(text):
            package, _, executable = text.partition('/')
            if not executable:
                raise PharosError(f'there is no file {text} here: give a path, or PACKAGE/PROGRAM')
            path = find_program(package, executable)
        path = os.path.abspath(path)
        name = ns_join(get_ros_namespace(argv=arguments), name_of_file(path))
        # a node without a name: that of the program holds
        roslaunch_node = roslaunch.core.Node('pharos', 'program', output='screen')
        entry = Entry(name, source_of(path), arguments, roslaunch_node, is_here=is_here)
        command = [path]
        reason = why_not_this_python(path, needs_first_line=False)
        if not reason and not is_here:
            reason = needs_process(path)
            command = [sys.executable, path]
        if reason:
            Transcript.show(f'{text} runs as a plain process: {reason}')
            self._start_part([entry], [*command, *arguments])
            return []
        return [entry]

    def _start_groups(self, entries: list[Entry]) -> None:
        """Start the groups, then the nodes of this process.

        Nodes with one environment share a process: code in C and shared modules see its variables. This
        process gets the environment that most nodes have.
        """
        groups = collections.defaultdict(list)  # (name of the group, environment) -> entries
        own_entries = []
        is_alone = self.owns_process and len(entries) == 1
        for entry in entries:
            if entry.is_here:
                own_entries.append(entry)
                continue
            reason = entry.group
            environment: tuple = ()
            if not reason:
                environment = environment_of(entry.roslaunch_node.env_args)
                code = '' if is_alone else needs_group(entry.path)
                reason = code and f'a group of its own: {entry.name} has {code!r}'
            groups[reason, environment].append(entry)
        own_keys = [
            key for key in groups if not key[0] and not any(map(AT_START.match, dict(key[1])))
        ]
        if own_keys:
            # of two as large, this process gets the empty one
            key = max(own_keys, key=lambda key: (len(groups[key]), not key[1]))
            own_entries += groups.pop(key)
            self._own_variables = dict(key[1])
            os.environ.update(key[1])
        for (reason, environment), group_entries in groups.items():
            variables = ', '.join(map('='.join, environment)) or 'no variables'
            for entry in group_entries:
                why = reason or f'a group of its own: its environment has {variables}'
                Transcript.show(f'{entry.name} runs in {why}')
            self._start_group(group_entries, environment)
        self.start_entries(own_entries)

    def _start_group(self, entries: list[Entry], environment: tuple) -> None:
        own_path = dict(environment).get('PYTHONPATH', '')
        folders = [own_path, *sys.path]
        command = [
            'env',
            *map('='.join, environment),
            f'PYTHONPATH={os.pathsep.join(folder for folder in folders if folder)}',
            f'PHAROS_SHARED_MEMORY={int(self.master.shared_memory)}',
            f'PHAROS_SHARE_CONNECTIONS={int(self.master.share_connections)}',
            f'PHAROS_RELOAD={int(self.reloads)}',
            sys.executable,
            '-m',
            'pharos.compose.group',
        ]
        self._start_part(entries, command, list)

    def start_entries(self, entries: list[Entry]) -> None:
        """Start nodes in this process, side by side, in the order of the launch file."""
        for entry in entries:
            with self._show_failure(entry.name):
                self._start(entry, self.owns_process and len(entries) == 1)
        self._listener = control.listen(self)
        self._watcher.start()
        wait(lambda: all(map(_has_begun, self.nodes)), INIT_LIMIT)

    def _start_part(self, *arguments: Any) -> _Part:
        part = _Part(self, *arguments)
        part.start()
        self._has_started = True
        self._parts.append(part)
        return part

    @contextlib.contextmanager
    def _show_failure(self, name: str) -> Iterator[None]:
        """Show a PharosError of a start in the Transcript, and go on: the other programs start."""
        try:
            yield
        except PharosError as error:
            Transcript.show(f'{name} cannot run: {error}')

    def _start(self, entry: Entry, owns_process: bool) -> None:
        """Start a program as a node of this process.

        :raises PharosError: if the program failed before ``init_node``
        """
        node = ScriptNode.__new__(ScriptNode)
        node._configure(Settings(entry.name, self.master, None, (0, 0), ()), None, None)
        roslaunch_node = entry.roslaunch_node
        ScriptNode.__init__(node, entry.path, entry.args, None, roslaunch_node.env_args)
        node.init_timeout = HEAD_START
        node.owns_process = owns_process
        node.roslaunch_node = roslaunch_node
        if roslaunch_node.output != 'screen':
            node.output_file = f'{entry.log}-stdout.log'
        self.nodes.append(node)
        Transcript.show(f'{entry.name} starts')
        node._start_held()
        self._has_started = True

    @property
    def process(self) -> RosProcess | None:
        """The process in which roslaunch runs the other nodes, or None."""
        return self._roslaunch_part.process if self._roslaunch_part else None

    @property
    def is_over(self) -> bool:
        """True if all started nodes and processes have ended, and no node respawns."""
        if self._stopped_nodes:
            return False
        for node in self.nodes:
            if node.roslaunch_node.respawn or node.lifecycle is not Lifecycle.STOPPED:
                return False
        return all(part.is_over for part in self._parts)

    def _watch(self) -> None:
        """Show ends, start again nodes that respawn, and end all if a required node has ended."""
        while not (attempt(lambda: self.is_over) or self.stopping.wait(POLL_PERIOD)):
            attempt(self._look)
        attempt(self._look)

    def _look(self) -> None:
        for node in self.nodes:
            if self.stopping.is_set():
                return
            if node.lifecycle is Lifecycle.STOPPED and node not in self._stopped_nodes:
                attempt(self._look_at_ended, node)
        for part in self._parts:
            if not self.stopping.is_set():
                attempt(self._look_at_part, part)

    def _look_at_part(self, part: _Part) -> None:
        """Tell of a process that a signal has ended, and start again its nodes that respawn.

        roslaunch and groups end with a required node.
        """
        code = part.process.poll()
        if code is None or part.is_over:
            return
        names = part.names
        has_required = any(entry.roslaunch_node.required for entry in part.entries)
        if code < 0:
            self._has_failed = True
            Transcript.show(f'{names}: {signal.Signals(-code).name} has ended their process')
            part.forget_nodes()
        if has_required:
            self._end(f'one of {names}')
        if code < 0 and part.entries:
            self._respawn_part(part)
        else:
            part.is_over = True

    def _respawn_part(self, part: _Part) -> None:
        self.stopping.wait(max(float(each.roslaunch_node.respawn_delay) for each in part.entries))
        if not self.stopping.is_set():
            Transcript.show(f'{part.names}: back in a new process')
            part.start()
            if self.stopping.is_set():  # stop() may have looked before the start
                part.process.terminate(TERMINATE_LIMIT)

    def _look_at_ended(self, node: ScriptNode) -> None:
        name = node._settings.name
        now = time.monotonic()
        if node not in self._end_times:
            self._end_times[node] = now
            Transcript.show(f'{name} has ended, with exit code {node.exit_code}')
        roslaunch_node = node.roslaunch_node
        if roslaunch_node.required:
            self._end(name)
        elif roslaunch_node.respawn:
            if now - self._end_times[node] >= float(roslaunch_node.respawn_delay):
                self._respawn(node, name)

    def _respawn(self, node: ScriptNode, name: str) -> None:
        with self._show_failure(name):
            Transcript.show(f'{name} comes back')
            del self._end_times[node]
            node._start_held()
        if self.stopping.is_set():  # stop() may have looked before the start
            node._stop_safely()

    def control(self, node: ScriptNode, action: str) -> str:
        """Restart, stop or start a node, or reload its program; a required one may stop, too.

        :returns: the node's name, or the answer of the reload
        :raises PharosError: if the node does not start, or its program cannot be read
        """
        if action == 'reload':
            return node.reload()
        if action == 'restart':
            node._current_run.check_readable()  # else the node runs on
        Transcript.show(f'{node._settings.name}: {action}')
        self._stopped_nodes.add(node)
        if action != 'start':
            node._stop_safely()
        if action != 'stop':
            if not node.is_running:
                node._start_held()
            self._end_times.pop(node, None)
            self._stopped_nodes.discard(node)
        return node._settings.name

    def _end(self, name: str) -> None:
        if not self.stopping.is_set():
            Transcript.show(f'{name}, which is required, has ended: all others end')
            self._has_failed = True
            self.stop()

    def wait(self, timeout: float | None = None) -> int:
        """Wait until all nodes have ended, or Ctrl-C, and stop the composition.

        :param timeout: seconds, None: without limit
        :returns: 0; 1 if a required node has ended, a signal has ended a process, or no node has
            started; the status of the program if there is but one, without a launch file
        :raises TimeoutError: if not all nodes have ended in time
        """
        wait_for_end(
            lambda: self.is_over or self.stopping.is_set() or signals.is_ending(),
            timeout,
            'the composition',
        )
        is_over = self.is_over
        if is_over:
            self._watcher.join()  # the watcher shows all ends before this returns
        self.stop()
        if self._has_failed or not self._has_started:
            return 1
        if is_over and len(self.nodes) == 1 and not self.nodes[0].roslaunch_node.name:
            return self.nodes[0].exit_code or 0
        return 0

    def stop(self) -> None:
        """End all nodes, also those in processes of their own, and wait for their ends.

        The Transcript names what does not end within SLOW_END.
        """
        self.stopping.set()
        if self._listener:
            shutdown_socket(self._listener)
        threads = {}
        for node in self.nodes:
            threads[threading.Thread(target=node._stop_safely)] = node._settings.name
        for part in self._parts:
            terminate = part.process.terminate
            threads[threading.Thread(target=terminate, args=[TERMINATE_LIMIT])] = part.names
        for thread in threads:
            thread.start()
        late_threads = join(threads, SLOW_END)
        if late_threads:
            names = ', '.join(threads[thread] for thread in late_threads)
            Transcript.show(f'the end waits for {names}; a further Ctrl-C ends all at once')
        for thread in late_threads:
            thread.join()
        for name in self._own_variables:
            os.environ.pop(name, None)
            if name in self.environment:
                os.environ[name] = self.environment[name]
        self._own_variables = {}  # a second stop() does nothing

    def __enter__(self) -> Composition:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()


class _Part:
    """A process of a composition, with the nodes that it runs.

    :param entries: an :class:`Entry` for each node
    :param command: the command of the process
    :param parcel_of: ``parcel_of(entries)`` is pickled for a program of this package, which gets
        the file with that, and the number of this process
    :ivar is_over: True if the process has ended, that was told, and no node respawns
    """

    def __init__(
        self,
        composition: Composition,
        entries: list[Entry],
        command: list[str],
        parcel_of: Any = None,
    ) -> None:
        self.entries = entries
        self._composition = composition
        self._master = composition.master
        self._command = command
        self._parcel_of = parcel_of
        self.is_over = False

    def start(self) -> None:
        """Start the process with the nodes in ``entries``."""
        command = self._command
        if self._parcel_of:
            with tempfile.NamedTemporaryFile(delete=False) as file:  # the process deletes the file
                pickle.dump(self._parcel_of(self.entries), file)
            # the process takes no SIGINT until it says so: an import may lose the signal
            command = ['env', '--block-signal=INT', *command, file.name, str(os.getpid())]
        self.process = RosProcess(
            command, self._master.url, Transcript.show, self._composition.environment, stdin=None
        )

    @property
    def names(self) -> str:
        """The names of the nodes, as text."""
        return ', '.join(entry.name for entry in self.entries)

    def forget_nodes(self) -> None:
        """Unregister the nodes after a crash of the process; keep the entries that respawn.

        The nodes of roslaunch go on without it: end them.
        """
        for entry in self.entries:
            with contextlib.suppress(PharosError):
                ExternalNode(self._master, entry.name).shutdown()
        names = [entry.name for entry in self.entries]
        with contextlib.suppress(OSError, rosgraph.MasterException):
            rosnode.cleanup_master_blacklist(rosgraph.Master('/pharos', self._master.url), names)
        self.entries = [entry for entry in self.entries if entry.roslaunch_node.respawn]


def leave(status: int) -> int:
    """Return an exit status; end this process at once if a thread goes on that is not a daemon.

    Such a thread of a library, as of socketserver, would go on for ever.
    """
    if sum(not thread.daemon for thread in threading.enumerate()) > 1:
        sys.stdout.flush()
        os._exit(status)
    return status


def _has_begun(node: ScriptNode) -> bool:
    """True if a program has registered its node, or has ended."""
    return not node.is_running or node._current_run.is_known
