"""Programs of ROS as children of this process."""
from __future__ import annotations

import atexit
import collections
import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import tty
from typing import Any

import psutil
import roslib.packages
import rospkg
from catkin.find_in_workspaces import find_in_workspaces

from pharos.errors import PharosError, PortInUseError, UnknownNodeError

_TERMINAL_CODES = re.compile(r'\x1b\[[0-9;]*[A-Za-z]|\x1b\]0;[^\x07]*\x07')
MAX_LINES = 10_000  # of output that are kept


class RosProcess(subprocess.Popen):
    """A running program; made by :meth:`Master.run` and :meth:`Master.launch`.

    The program has a terminal of its own, so that its lines come at once. ``pid`` and ``poll()``
    are those of ``subprocess.Popen``. The end of a ``with`` block or of this process ends the
    program.

    :param on_line: ``on_line(text)`` is called for each printed line, in another thread
    :param environment: the environment variables, but for ROS_MASTER_URI and TERM; None: this process's
    :param options: of ``subprocess.Popen``; ``stdin=None``: the keyboard of this process
    """

    def __init__(
        self,
        command: list[str],
        master_url: str,
        on_line: Any = None,
        environment: dict[str, str] | None = None,
        **options: Any,
    ) -> None:
        self._lines: collections.deque[str] = collections.deque(maxlen=MAX_LINES)
        self._on_line = on_line
        terminal, child_terminal = os.openpty()
        tty.setraw(child_terminal)
        self._terminal = open(terminal, errors='replace')
        environ = {**(environment or os.environ), 'ROS_MASTER_URI': master_url, 'TERM': 'dumb'}
        try:
            super().__init__(  # type: ignore[call-overload]
                command,
                env=environ,
                start_new_session=True,
                stdout=child_terminal,
                stderr=child_terminal,
                **{'stdin': child_terminal, **options},
            )
        finally:
            os.close(child_terminal)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        atexit.register(self.terminate)

    def _read(self) -> None:
        with contextlib.suppress(OSError), self._terminal:
            for line in self._terminal:  # until the program has closed it
                text = _TERMINAL_CODES.sub('', line.rstrip('\n'))
                self._lines.append(text)
                if self._on_line:
                    self._on_line(text)

    @property
    def output(self) -> str:
        """The last 10,000 lines that the program has printed."""
        return '\n'.join(self._lines)

    def send(self, text: str) -> None:
        """Type a text at the program's terminal: a line ends with ``'\\n'``.

        :raises PharosError: if the program has ended
        """
        try:
            os.write(self._terminal.fileno(), text.encode())
        except (OSError, ValueError):
            raise PharosError(f'{self!r} has ended, and reads nothing') from None

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the program's end, and return its exit code.

        :raises subprocess.TimeoutExpired: after ``timeout`` seconds
        """
        code = super().wait(timeout)
        if self._reader is not threading.current_thread():
            self._reader.join(1)
        return code

    def terminate(self, timeout: float = 5.0) -> int:  # type: ignore[override]
        """End the program and its children.

        Send SIGINT, as Ctrl-C does, and wait for half of the timeout; then SIGTERM, and wait as
        long; then SIGKILL. Once the program has ended, its children get the next signal at once.

        :param timeout: seconds
        :returns: the program's exit code
        """
        atexit.unregister(self.terminate)
        descendants = descendants_of(self)
        # to the group: the program's children may live on without the program
        for number in signal.SIGINT, signal.SIGTERM, signal.SIGKILL:
            with contextlib.suppress(ProcessLookupError, subprocess.TimeoutExpired):
                os.killpg(self.pid, number)
                super().wait(timeout / 2)
        for process in descendants:
            with contextlib.suppress(psutil.Error):
                process.kill()
        return self.wait()

    def __exit__(self, *error: object) -> None:
        self.terminate()


def start_master(port: int) -> tuple[str, subprocess.Popen[str]]:
    """Start the master of :meth:`Master.embedded`, and return its URL and its subprocess.Popen."""
    environ = dict(os.environ)
    environ['PYTHONPATH'] = os.pathsep.join(folder for folder in sys.path if folder)
    # rospy prefers ROS_HOSTNAME to ROS_IP
    address = environ.pop('ROS_IP', '127.0.0.1')
    environ.setdefault('ROS_HOSTNAME', address)
    process = subprocess.Popen(
        [sys.executable, '-m', 'pharos.commands.embedded_master', str(port)],
        env=environ,
        start_new_session=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    url = process.stdout.readline().strip()  # type: ignore
    if not url:
        process.communicate()
        raise PortInUseError(
            f'no master starts at port {port}: choose another one, or 0 for any free one'
        )
    return url, process


def run_program(url: str, package: str, executable: str, args: tuple) -> RosProcess:
    """Do the work of :meth:`Master.run`."""
    path = find_program(package, executable)
    return RosProcess([path, *map(str, args)], url)


def run_launch_file(url: str, package: str | None, file: str, args: dict) -> RosProcess:
    """Do the work of :meth:`Master.launch`."""
    path = find_launch_file(package, file)
    arguments = [f'{name}:={value}' for name, value in args.items()]
    return RosProcess(['roslaunch', '--skip-log-check', path, *arguments], url)


def descendants_of(process: subprocess.Popen) -> list[psutil.Process]:
    """Return the children of a subprocess.Popen, and their children, as psutil's processes."""
    if process.poll() is not None:
        return []
    return psutil.Process(process.pid).children(recursive=True)


def interrupt(process: subprocess.Popen) -> None:
    """Send SIGINT to a subprocess.Popen and its descendants, as Ctrl-C in a terminal does."""
    for each in [process, *descendants_of(process)]:
        with contextlib.suppress(psutil.Error):
            each.send_signal(signal.SIGINT)


def find_program(package: str, executable: str) -> str:
    """Return the path of a program, found as rosrun does.

    :raises UnknownNodeError: if the package has no such program
    """
    try:
        paths = roslib.packages.find_node(package, executable)
    except rospkg.ResourceNotFound:  # some of Debian's packages have no package.xml
        folders = find_in_workspaces(['libexec'], project=package)
        if not folders:
            raise no_package(package) from None
        found_paths = [shutil.which(executable, path=folder) for folder in folders]
        paths = [path for path in found_paths if path]
    if not paths:
        raise UnknownNodeError(
            f'{package} has no program {executable!r}: is it installed, executable, and the'
            ' workspace sourced?'
        )
    return paths[0]


def find_launch_file(package: str | None, file: str) -> str:
    """Return the path of a launch file, found as roslaunch does.

    :param package: None: ``file`` is a path
    :raises UnknownNodeError: if there is no such file
    """
    from roslaunch import RLException, rlutil

    arguments = [package, str(file)] if package else [str(file)]
    try:
        return rlutil.resolve_launch_arguments(arguments)[0]
    except RLException as error:
        if package and package not in rospkg.RosPack().list():
            raise no_package(package) from None
        raise UnknownNodeError(f'there is no launch file {file!r}: {error}') from None


def no_package(name: str) -> UnknownNodeError:
    """Return the error of an unknown package."""
    return UnknownNodeError(f'no package {name!r}: is the workspace sourced?')
