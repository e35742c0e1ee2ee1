"""ROS programs run as processes of their own, and ended as rosrun and roslaunch do."""
import collections
import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.parse
import xmlrpc.client
from typing import (
    TYPE_CHECKING,
    Any,
    Deque,
    Dict,
    List,
    Mapping,
    Optional,
    Sequence,
    Set,
)

import psutil
import rosgraph.network

from pharos import node_registry
from pharos.blocks import Block, check_block, name_of
from pharos.errors import PharosError
from pharos.failures import Failures
from pharos.program_arguments import (
    arguments_of,
    parameter_arguments,
    parameters_of,
    set_parameters,
)
from pharos.program_files import AnyPath, find, find_launch_file
from pharos.private_rospy.deadlines import time_limit
from pharos.private_rospy.proxies import ServerProxy
from pharos.private_rospy.registration import COMMUNICATION_ERRORS, unregister_all
from pharos.pseudo_terminal import PseudoTerminal, without_colors
from pharos.seconds import check_limit, check_seconds
from pharos.transcript import Transcript

if TYPE_CHECKING:
    from pharos.master import Master

# For those programs that it starts with pipes of their own
LINE_BY_LINE = {'PYTHONUNBUFFERED': '1', 'ROSCONSOLE_STDOUT_LINE_BUFFERED': '1'}

KILL_TIMEOUT = 1.0  # seconds that processes may take to end when they are killed
ANSWER_TIMEOUT = 1.0  # seconds that the master or a node may take to answer


class RosProcess:
    """A running ROS program; made by :meth:`Master.run` or :meth:`Master.launch`. Ends with its
    ``with`` block.

    What the program has started ends with it.

    :ivar command: the program and its arguments
    """

    def __init__(
        self,
        command: List[str],
        master: 'Master',
        on_line: Optional[Block] = None,
        in_colors: bool = False,
    ) -> None:
        """:param in_colors: whether lines keep the colours that they have on a terminal"""
        self.command = command
        self._on_line = check_block(on_line, 'block on_line', ('text',))
        self._in_colors = in_colors
        self._failures = Failures(lambda line, details: Transcript.show(line))
        self._lines: Deque[str] = collections.deque(maxlen=10000)
        self._begun: List[str] = []  # the beginning of a line that is not complete yet
        # What a program prints to a terminal comes at once, and there are keys to be read from one.
        self._terminal = PseudoTerminal()
        # a session of its own, so that what it starts ends with it, and Ctrl-C is the program's to
        # handle
        try:
            self._process = subprocess.Popen(
                command,
                env={**LINE_BY_LINE, **os.environ, 'TERM': 'dumb', 'ROS_MASTER_URI': master.url},
                stdin=self._terminal.slave,
                stdout=self._terminal.slave,
                stderr=self._terminal.slave,
                start_new_session=True,
            )
        except BaseException as error:
            self._terminal.close()
            if not isinstance(error, OSError):
                raise
            raise PharosError(
                f'{command[0]} cannot be started ({error}): is it a program, may you run it, and'
                ' does its first line name an interpreter that is there, as #!/usr/bin/python3?'
            ) from error
        finally:
            os.close(self._terminal.slave)
        self._nodes = _Nodes(master)
        node_registry.at_end(self.terminate)
        self._reader = threading.Thread(
            target=self._read, name=f'output of {command[0]}', daemon=True
        )
        self._reader.start()

    def _read(self) -> None:
        for text, is_whole in self._terminal.lines():
            text = text if self._in_colors else without_colors(text)
            self._begun = [] if is_whole else [text]
            if is_whole:
                self._lines.append(text)
                if self._on_line is not None:
                    self._show(text)
        self._terminal.close()
        self._process.wait()
        # what it left behind; not later, when its number may be another's
        self._signal(signal.SIGKILL)
        node_registry.not_at_end(self.terminate)

    def send(self, text: str) -> None:
        """Type the text, at the terminal that the program has for its standard input.

        ``send('go\\n')`` is a line, for a program that reads lines, which ``'\\x04'`` (Ctrl-D) ends;
        ``send('w')`` is a key, for one that reads keys: send it when the program has set its
        terminal so, for it discards what came before. No character is a signal, as Ctrl-C is at
        other terminals: :meth:`terminate` ends the program. It waits where the program does not
        read.

        :raises TypeError: if it is no text
        :raises ValueError: if a line is longer than the terminal takes, 4095 bytes
        :raises PharosError: if the program has ended
        """
        if not isinstance(text, str):
            raise TypeError(f'what is sent to a program is a text, not {text!r}')
        try:
            self._terminal.write(text)
        except OSError as error:
            raise PharosError(
                f'{self.command[0]} has ended, and reads nothing any more: run it again'
            ) from error

    def _show(self, line: str) -> None:
        try:
            self._on_line(line)
        except BaseException as error:  # the program's output goes on
            where = f'block {name_of(self._on_line)} for the output of {self.command[0]}'
            self._failures.report(error, self._on_line, where, message=line)

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def output(self) -> str:
        """What it has printed so far, standard output and errors together; the last 10,000 lines."""
        return '\n'.join([*self._lines, *self._begun])

    def poll(self) -> Optional[int]:
        """Its exit status, None while it runs."""
        return self._process.poll()

    def wait(self, timeout: Optional[float] = None) -> int:
        """Wait until it ends; returns its exit status.

        :param timeout: seconds, None: no limit
        :raises subprocess.TimeoutExpired: after ``timeout`` seconds
        """
        status = self._process.wait(check_limit('timeout', timeout))
        if self._reader is not threading.current_thread():  # which runs on_line
            self._reader.join(1.0)
        return status

    def terminate(self, timeout: float = 5.0) -> int:
        """Ask it, and what it has started, to end, and end them after ``timeout`` seconds; returns
        its exit status.

        The nodes in it are asked through ROS, for where roscpp has no handler, a node ends at a
        signal without unregistering; then the program is asked as by Ctrl-C, and then by SIGTERM.
        What is still registered of the nodes afterwards goes, if the master answers. Done at the end
        of this program, too, also where Ctrl-C has cut it off.
        """
        timeout = check_seconds('timeout', timeout)
        if self.poll() is None:
            started, until = self._look(), time.monotonic() + timeout
            with time_limit(timeout / 3):
                has_nodes = self._nodes.shut_down()
            if not (has_nodes and self._ends_within((until - time.monotonic()) / 3)):
                for number, share in (signal.SIGINT, 2), (signal.SIGTERM, 1):
                    started |= self._look()  # roslaunch may have started some again
                    self._signal(number)
                    if self._ends_within((until - time.monotonic()) / share):
                        break
            for process in started:
                with contextlib.suppress(psutil.Error):  # it has ended
                    process.kill()
            psutil.wait_procs(started, KILL_TIMEOUT)
        if self._reader.is_alive():  # else it has done so
            self._signal(signal.SIGKILL)
        status = self.wait()
        with time_limit(ANSWER_TIMEOUT):
            self._nodes.clear()
        node_registry.not_at_end(self.terminate)
        return status

    def _ends_within(self, seconds: float) -> bool:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
        return self.poll() is not None

    def _look(self) -> Set[psutil.Process]:
        """See where the nodes are; returns what the program has started. roslaunch gives each a
        session of its own."""
        try:
            program = psutil.Process(self.pid)
            started = program.children(recursive=True)
        except psutil.NoSuchProcess:
            return set()
        self._nodes.look([program, *started])
        return set(started)

    def _signal(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):  # all of them have ended
            os.killpg(self.pid, number)

    def __enter__(self) -> 'RosProcess':
        return self

    def __exit__(self, *error: object) -> None:
        self.terminate()

    def __repr__(self) -> str:
        status = self.poll()
        state = f'pid {self.pid}' if status is None else f'ended with {status}'
        return f"<RosProcess {' '.join(self.command)}, {state}>"


class _Nodes:
    """The nodes at one master that run in given processes, known by the ports on which these listen.

    Not those of which ``getPid`` says so: on another host, the number is another process's.
    """

    def __init__(self, master: 'Master') -> None:
        self._master = master
        self._ports: Set[int] = set()

    def look(self, processes: List[psutil.Process]) -> None:
        """See on which ports the processes listen, which cannot be seen of one that has ended."""
        for process in processes:
            with contextlib.suppress(psutil.Error):  # it has ended, or is another user's
                # psutil 6 calls it otherwise
                connections = getattr(process, 'net_connections', None) or process.connections
                self._ports.update(
                    connection.laddr.port
                    for connection in connections('tcp')
                    if connection.status == psutil.CONN_LISTEN
                )

    def shut_down(self) -> bool:
        """Ask the nodes to end, as ``rosnode kill`` does; returns whether there are any."""
        found = self._registered()
        for uri in found.values():
            # some end before their answer is through
            with contextlib.suppress(*COMMUNICATION_ERRORS):
                ServerProxy(uri, ANSWER_TIMEOUT).shutdown('/pharos', 'its program is to end')
        return bool(found)

    def clear(self) -> None:
        """Unregister those that are dead, as ``rosnode cleanup`` does, which asks at a terminal
        whether to, and the master of the environment."""
        for name, uri in self._registered().items():
            with contextlib.suppress(rosgraph.MasterException, *COMMUNICATION_ERRORS):
                try:
                    ServerProxy(uri, ANSWER_TIMEOUT).getPid('/pharos')
                except ConnectionRefusedError:
                    unregister_all(self._master.api(name, ANSWER_TIMEOUT), name, uri)

    def _registered(self) -> Dict[str, str]:
        """``{name: URI}`` of the nodes at the ports that were seen."""
        if not self._ports:
            return {}
        try:
            api = self._master.api(timeout=ANSWER_TIMEOUT)
            names = sorted(
                {name for kind in api.getSystemState() for _, users in kind for name in users}
            )
            calls = xmlrpc.client.MultiCall(api.handle)
            for name in names:
                calls.lookupNode('/pharos', name)
            answers: Any = calls()
            uris = [uri for _, _, uri in answers]
        except (rosgraph.MasterException, *COMMUNICATION_ERRORS):
            return {}  # there is no master to clear anything away from
        return {name: uri for name, uri in zip(names, uris) if uri and self._is_ours(uri)}

    def _is_ours(self, uri: str) -> bool:
        address = urllib.parse.urlsplit(uri)
        try:
            port = address.port
        except ValueError:  # the master takes any number from anybody
            return False
        return port in self._ports and rosgraph.network.is_local_address(address.hostname)


def run(
    master: 'Master',
    package: str,
    executable: str,
    args: Sequence[object],
    name: Optional[str],
    remap: Optional[Mapping[str, str]],
    params: Optional[Mapping[str, object]],
    on_line: Optional[Block] = None,
) -> RosProcess:
    """Start a program as ``rosrun`` would, at the master given; see :meth:`Master.run`."""
    arguments, parameters = arguments_of(args, name, remap), parameters_of(params)
    path = find(package, executable)[0]
    if name is None:
        arguments += parameter_arguments(path, parameters)
    else:
        set_parameters(master, name, remap, parameters)
    return RosProcess([path, *arguments], master, on_line)


def launch(
    master: 'Master',
    package: Optional[AnyPath],
    file: Optional[AnyPath],
    args: Dict[str, object],
    on_line: Optional[Block] = None,
) -> RosProcess:
    """Start a launch file as ``roslaunch`` would, at the master given.

    A process of its own, although roslaunch has a Python API: that works in the main thread alone,
    and sets the logging and the signal handlers of the program that calls it.

    :raises UnknownNodeError: if there is no such package or launch file
    """
    path = find_launch_file(package, file)
    roslaunch = [sys.executable, '-c', 'import roslaunch; roslaunch.main()', '--skip-log-check']
    if None in args.values():
        raise TypeError(f'the arguments of a launch file are texts or numbers, not None: {args}')
    arguments = [f'{name}:={value}' for name, value in args.items()]
    return RosProcess([*roslaunch, path, *arguments], master, on_line)
