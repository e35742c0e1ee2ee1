"""Running this package's scripts and ROS's tools as processes, and waiting for what they print."""
import contextlib
import os
import pathlib
import queue
import signal
import subprocess
import threading
import time

import psutil
import rosgraph
from pharos.testing import TIMEOUT

ROOT = pathlib.Path(__file__).resolve().parent.parent
PROGRAMS = ROOT / 'test' / 'programs'


def script(name):
    """The path of a script of this package."""
    return str(ROOT / 'scripts' / name)


def environment(master_url, **variables):
    """The environment in which programs find this package and the master, but no display, and no
    size of the terminal in which the tests run."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if name not in ('DISPLAY', 'ROS_NAMESPACE', 'ROS_IP', 'LINES', 'COLUMNS')
    }
    return {
        **kept,
        'ROS_MASTER_URI': master_url,
        'ROS_HOSTNAME': '127.0.0.1',
        'PYTHONPATH': str(ROOT / 'src'),
        'PYTHONUNBUFFERED': '1',
        # Python 3.12 and later say so in the middle of what the child prints.
        'PYTHONWARNINGS': 'ignore:This process (pid:DeprecationWarning',
        **variables,
    }


def run(master_url, *command, cwd=None):
    """Run a program to its end; returns what it printed and its status
    (subprocess.CompletedProcess)."""
    return subprocess.run(
        command,
        cwd=cwd,
        env=environment(master_url),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        timeout=2 * TIMEOUT,
        check=False,
    )


def forget_parameters(master_url):
    """Delete all parameters: a node's outlive it on the master, and would be those of the next one
    of its name."""
    server = rosgraph.Master('/test', master_uri=master_url)
    for name in server.getParamNames():
        server.deleteParam(name)


class Program:
    """A program that goes on running; `with` ends it as Ctrl-C does and waits for its end."""

    def __init__(self, master_url, *command, cwd=None, **variables):
        self.printed = []
        self._lines = queue.SimpleQueue()
        self.process = subprocess.Popen(
            command,
            cwd=cwd,
            env=environment(master_url, **variables),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        for line in self.process.stdout:
            self._lines.put(line)
        self._lines.put(None)

    def wait_for(self, text):
        """The next line with that text."""
        deadline = time.monotonic() + TIMEOUT
        while True:
            line = self._next_line(deadline)
            assert line is not None, f'{text!r} was not printed: {"".join(self.printed[-20:])}'
            if text in line:
                return line

    def read_to_the_end(self):
        """All that was printed, once the program has ended."""
        while self._next_line(time.monotonic() + TIMEOUT) is not None:
            pass
        return ''.join(self.printed)

    def _next_line(self, deadline):
        """The next line, or None at the end of the output or after the deadline."""
        try:
            line = self._lines.get(timeout=max(0.0, deadline - time.monotonic()))
        except queue.Empty:
            return None
        self.printed.append(line or '')
        return line

    def end(self, with_signal=signal.SIGINT):
        """Send the signal, wait for the end; returns the status."""
        if self.process.poll() is None:
            self.process.send_signal(with_signal)
        try:
            return self.process.wait(TIMEOUT)
        finally:
            self.process.kill()
            self._reader.join(TIMEOUT)
            # to close what another thread reads would wait for that, for ever
            holders = self._kill_holders() if self._reader.is_alive() else None
            self._reader.join(TIMEOUT)
            self.process.stdout.close()
            assert (
                holders is None
            ), f'the program ended, but what it printed on was open in {holders}'

    def _kill_holders(self):
        """Kill the others that have what this program prints on; returns their command lines."""
        pipe = os.readlink(f'/proc/self/fd/{self.process.stdout.fileno()}')
        holders = []
        for process in psutil.process_iter():
            with contextlib.suppress(OSError, psutil.Error):
                folder = f'/proc/{process.pid}/fd'
                files = {os.readlink(f'{folder}/{number}') for number in os.listdir(folder)}
                if pipe in files and process.pid != os.getpid():
                    holders.append(process.cmdline())
                    process.kill()
        return holders

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.end()
