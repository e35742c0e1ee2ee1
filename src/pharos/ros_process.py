"""Programs of ROS as children of this process."""
import atexit
import collections
import contextlib
import os
import re
import shutil
import signal
import subprocess
import threading
import tty

import psutil
import roslib.packages
import rospkg
from catkin.find_in_workspaces import find_in_workspaces

from pharos.errors import PharosError, UnknownNodeError

KEPT_LINES = 10_000
_COLOURS = re.compile(r'\x1b\[[0-9;]*[A-Za-z]|\x1b\]0;[^\x07]*\x07')


class RosProcess:
    """A running program; made by :meth:`Master.run` and :meth:`Master.launch`.

    It has a terminal of its own, so that what it prints comes at once.

    :param on_line: ``on_line(text)`` is called for each line that it prints, in another thread
    :ivar command: the program and its arguments
    :ivar pid: the number of its process
    """

    def __init__(self, command, master_url, on_line=None):
        self.command, self._on_line = command, on_line
        self._lines = collections.deque(maxlen=KEPT_LINES)
        terminal, slave = os.openpty()
        tty.setraw(slave)
        self._terminal = open(terminal, errors='replace')
        environ = {**os.environ, 'ROS_MASTER_URI': master_url, 'TERM': 'dumb'}
        try:
            self._process = subprocess.Popen(
                command,
                stdin=slave,
                stdout=slave,
                stderr=slave,
                env=environ,
                start_new_session=True,
            )
        except OSError as error:
            self._terminal.close()
            raise PharosError(f'{command[0]} cannot be started: {error}') from None
        finally:
            os.close(slave)
        self.pid = self._process.pid
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        atexit.register(self.terminate)

    def _read(self):
        with contextlib.suppress(OSError), self._terminal:
            for line in self._terminal:  # until the program has closed it
                text = _COLOURS.sub('', line.rstrip('\n'))
                self._lines.append(text)
                if self._on_line:
                    self._on_line(text)

    @property
    def output(self) -> str:
        """The last 10,000 lines that it has printed."""
        return '\n'.join(self._lines)

    def send(self, text: str) -> None:
        """Type a text at its terminal: a line ends with ``'\\n'``.

        :raises PharosError: if it has ended
        """
        try:
            os.write(self._terminal.fileno(), text.encode())
        except (OSError, ValueError):
            raise PharosError(f'{self.command[0]} has ended, and reads nothing') from None

    def poll(self) -> int | None:
        """Return its exit code, None while it runs."""
        return self._process.poll()

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end, and return its exit code.

        :raises subprocess.TimeoutExpired: after ``timeout`` seconds
        """
        code = self._process.wait(timeout)
        if self._reader is not threading.current_thread():
            self._reader.join(1)
        return code

    def terminate(self, timeout: float = 5.0) -> int:
        """End it and what it has started, as Ctrl-C does, after ``timeout`` seconds by force.

        :returns: its exit code
        """
        atexit.unregister(self.terminate)
        started = psutil.Process(self.pid).children(recursive=True) if self.poll() is None else []
        for number in signal.SIGINT, signal.SIGTERM, signal.SIGKILL:
            with contextlib.suppress(ProcessLookupError, subprocess.TimeoutExpired):
                os.killpg(self.pid, number)
                self._process.wait(timeout / 2)
        for process in started:
            with contextlib.suppress(psutil.Error):
                process.kill()
        return self.wait()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.terminate()

    def __repr__(self):
        code = self.poll()
        state = f'pid {self.pid}' if code is None else f'ended with {code}'
        return f'<RosProcess {" ".join(self.command)}, {state}>'


def find_program(package, executable):
    """Return the path of a program, as rosrun finds it.

    :raises UnknownNodeError: if there is none
    """
    try:
        paths = roslib.packages.find_node(package, executable)
    except rospkg.ResourceNotFound:  # some of Debian's have no package.xml
        folders = find_in_workspaces(['libexec'], project=package)
        paths = list(filter(None, (shutil.which(executable, path=folder) for folder in folders)))
    if not paths:
        raise UnknownNodeError(
            f'{package} has no program {executable!r}: is it installed, executable, and the'
            ' workspace sourced?'
        )
    return paths[0]


def find_launch_file(package, file):
    """Return the path of a launch file, as roslaunch finds it; without a package, it is the path.

    :raises UnknownNodeError: if there is none
    """
    from roslaunch import RLException, rlutil

    try:
        return rlutil.resolve_launch_arguments([package, str(file)] if package else [str(file)])[0]
    except RLException as error:
        raise UnknownNodeError(f'there is no launch file {file!r}: {error}') from None
