"""ROS programs run as processes of their own."""
import collections
import contextlib
import glob
import os
import select
import signal
import subprocess
import sys
import threading

from pharos import node_registry
from pharos.blocks import check_block, name_of
from pharos.errors import UnknownNodeError
from pharos.failures import Failures
from pharos.process_nodes import ProcessNodes
from pharos.transcript import Transcript

# What they print is wanted line by line, as on a terminal, and not in blocks of 4 KiB
LINE_BY_LINE = {'PYTHONUNBUFFERED': '1', 'ROSCONSOLE_STDOUT_LINE_BUFFERED': '1'}

KILL_TIMEOUT = 1.0  # seconds that a process may take to end when it is killed


class RosProcess:
    """A running ROS program; made by :meth:`Master.run` or :meth:`Master.launch`. Ends with its
    ``with`` block.

    What the program has started ends with it.
    """

    def __init__(self, command, master_url, on_line=None):
        self.command = command
        self._on_line = check_block(on_line, 'on_line', ('text',))
        self._failures = Failures(lambda line, details: Transcript.show(line))
        self._lines = collections.deque(maxlen=10000)
        environ = {**LINE_BY_LINE, **os.environ, 'ROS_MASTER_URI': master_url}
        # a session of its own, so that what it starts ends with it, and Ctrl-C is the program's to
        # handle
        self._process = subprocess.Popen(
            command,
            env=environ,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors='replace',
            start_new_session=True,
        )
        self._nodes = ProcessNodes(master_url)
        node_registry.at_end(self.terminate)
        self._reader = threading.Thread(
            target=self._read, name=f'output of {command[0]}', daemon=True
        )
        self._reader.start()

    def _read(self):
        with self._process.stdout as output:
            for line in output:
                line = line.rstrip('\n')
                self._lines.append(line)
                if self._on_line is not None:
                    self._show(line)
        self._process.wait()
        # what it left behind; not later, when its number may be another's
        self._signal(signal.SIGKILL)
        node_registry.not_at_end(self.terminate)

    def _show(self, line):
        try:
            self._on_line(line)
        except BaseException as error:  # the program's output goes on
            where = f'block {name_of(self._on_line)} for the output of {self.command[0]}'
            self._failures.report(error, self._on_line, where, message=line)

    @property
    def pid(self):
        """Its process id."""
        return self._process.pid

    @property
    def output(self):
        """What it has printed so far, standard output and errors together."""
        return '\n'.join(self._lines)

    def poll(self):
        """Its exit status, None while it runs."""
        return self._process.poll()

    def wait(self, timeout=None):
        """Wait until it ends; returns its exit status.

        :raises subprocess.TimeoutExpired: after ``timeout`` seconds
        """
        status = self._process.wait(timeout)
        if self._reader is not threading.current_thread():  # which runs on_line
            self._reader.join(1.0)
        return status

    def terminate(self, timeout=5.0):
        """Ask it, and what it has started, to end, and end them after ``timeout`` seconds; returns
        its exit status.

        The nodes in it are asked through ROS, for where roscpp has no handler, a node ends at a
        signal without unregistering; then the program is asked as by Ctrl-C, and then by SIGTERM.
        What is still registered of the nodes afterwards goes. Done at the end of this program, too,
        also where Ctrl-C has cut it off.
        """
        if self.poll() is None:
            numbers = [signal.SIGINT, signal.SIGTERM]
            started = self._look()
            if self._nodes.shut_down():
                numbers.insert(0, None)
            for number in numbers:
                if number is not None:
                    started += self._look()  # roslaunch may have started some again
                    self._signal(number)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(timeout / len(numbers))
                    break
            for process in started:
                with process:
                    process.kill()
        if self._reader.is_alive():  # else it has done so
            self._signal(signal.SIGKILL)
        status = self.wait()
        self._nodes.clear()
        node_registry.not_at_end(self.terminate)
        return status

    def _look(self):
        """See where the nodes are; returns what the program has started. roslaunch gives each a
        session of its own."""
        started = _descendants(self.pid)
        self._nodes.look([self.pid, *(process.pid for process in started)])
        return started

    def _signal(self, number):
        try:
            os.killpg(self.pid, number)
        except ProcessLookupError:
            pass  # all of them have ended

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.terminate()

    def __repr__(self):
        return '<RosProcess %s, %s>' % (
            ' '.join(self.command),
            'pid %d' % self.pid if self.poll() is None else 'ended with %d' % self.poll(),
        )


def run(master_url, package, executable, args, on_line=None):
    """Start a program as ``rosrun`` would, at the master given.

    :raises UnknownNodeError: if there is no such package or program
    """
    paths = _find(package, executable)
    if not paths:
        raise UnknownNodeError(
            f'the ROS package {package} has no program {executable!r}: see what it has with rosrun'
            f' {package} <Tab>'
        )
    return RosProcess([paths[0], *args], master_url, on_line)


def _find(package, executable):
    """The paths of a program, as rosrun looks it up."""
    import roslib.packages  # only here: they are slow to import
    import rospkg
    from catkin.find_in_workspaces import find_in_workspaces

    try:
        return roslib.packages.find_node(package, executable)
    except rospkg.ResourceNotFound:
        # Debian's topic_tools and others have no package.xml, but catkin knows their folder
        folders = find_in_workspaces(['libexec'], project=package)
        if not folders:
            raise UnknownNodeError(
                f'no ROS package {package!r} on ROS_PACKAGE_PATH: install it, or source its'
                ' workspace\'s setup.bash'
            ) from None
        paths = [os.path.join(folder, executable) for folder in folders]
        return [path for path in paths if os.access(path, os.X_OK)]


def launch(master_url, package, file, args, on_line=None):
    """Start a launch file as ``roslaunch`` would, at the master given.

    A process of its own, although roslaunch has a Python API: that works in the main thread alone,
    and sets the logging and the signal handlers of the program that calls it.

    :raises UnknownNodeError: if there is no such package or launch file
    """
    import roslib.packages
    import rospkg

    try:
        found = roslib.packages.find_resource(package, file)
    except rospkg.ResourceNotFound:
        raise UnknownNodeError(
            f'no ROS package {package!r} on ROS_PACKAGE_PATH: install it, or source its'
            ' workspace\'s setup.bash'
        ) from None
    if not found:
        raise UnknownNodeError(
            f'the ROS package {package} has no launch file {file!r}: is it spelt so, and installed?'
        )
    command = [
        sys.executable,
        '-c',
        'import roslaunch; roslaunch.main()',
        '--skip-log-check',
        found[0],
    ]
    return RosProcess([*command, *('%s:=%s' % arg for arg in args.items())], master_url, on_line)


class _Started:
    """A process that a program has started, held by a descriptor: its number may be another's
    later."""

    def __init__(self, pid):
        self.pid = pid
        self._descriptor = os.pidfd_open(pid)

    def kill(self):
        """End it, if it has not ended."""
        try:
            signal.pidfd_send_signal(self._descriptor, signal.SIGKILL)
        except ProcessLookupError:
            pass
        end = select.poll()
        end.register(self._descriptor, select.POLLIN)
        end.poll(1000 * KILL_TIMEOUT)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        os.close(self._descriptor)


def _descendants(pid):
    """What the process has started, and those in turn, as :class:`_Started`."""
    children = collections.defaultdict(list)
    for stat in glob.glob('/proc/[0-9]*/stat'):
        with contextlib.suppress(OSError), open(stat) as file:  # it may end meanwhile
            number, _, rest = file.read().partition(' (')
            children[int(rest.rpartition(') ')[2].split()[1])].append(int(number))
    found, left = [], [pid]
    while left:
        started = children[left.pop()]
        left += started
        for child in started:
            with contextlib.suppress(OSError):
                found.append(_Started(child))
    return found
