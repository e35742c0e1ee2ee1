"""Programs in a real terminal, which are typed to and looked at: a window of tmux's."""
import os
import pathlib
import re
import shlex
import shutil
import subprocess
import tempfile

import psutil

from pharos.testing import TIMEOUT, until
from programs import environment

HISTORY = '10000'  # lines that are kept of what has scrolled away
#: a shell that runs a program and notes its status; tmux 3.3 sometimes has none to tell
RUN = 'trap : INT HUP; "$@"; echo $? > "$0"'


class Terminal:
    """A program in a terminal of its own; ``with`` ends both.

    :param variables: of its environment, beside those of :func:`programs.environment`
    """

    def __init__(self, master_url, *command, width=100, height=40, cwd=None, **variables):
        self._folder = tempfile.mkdtemp(prefix='pharos-terminal-')
        self._socket = os.path.join(self._folder, 'socket')
        given = environment(master_url, IPYTHONDIR=self._folder, LC_ALL='C.UTF-8', **variables)
        settings = [f'{name}={value}' for name, value in given.items() if name != 'TERM']
        self._tmux('-f', '/dev/null', 'new-session', '-d', f'-x{width}', f'-y{height}', 'cat')
        self._tmux('set-option', '-g', 'history-limit', HISTORY)
        self._tmux('set-option', '-g', 'remain-on-exit', 'on')
        where = ('-c', str(cwd)) if cwd else ()
        self._status = pathlib.Path(self._folder, 'status')
        # readline, in the tests' own process, notes the size of their terminal in the environment
        line = shlex.join(
            ['env', '-u', 'LINES', '-u', 'COLUMNS', *settings, 'sh', '-c', RUN, str(self._status)]
        )
        line = f'{line} {shlex.join(map(str, command))}'
        self._tmux('new-window', '-k', '-t', ':0', *where, line)

    def _tmux(self, *arguments):
        return subprocess.run(
            ['tmux', '-S', self._socket, *arguments],
            stdout=subprocess.PIPE,
            text=True,
            timeout=TIMEOUT,
            check=True,
        ).stdout

    def type(self, text):
        """Type it, without a return at its end."""
        self._tmux('send-keys', '-l', text)

    def paste(self, text):
        """Paste it, as a whole where the program knows of that, and without a return."""
        self._tmux('set-buffer', '--', text)
        self._tmux('paste-buffer', '-p')

    def press(self, *keys):
        """Press keys by tmux's names: 'Enter', 'Tab', 'C-c'."""
        self._tmux('send-keys', *keys)

    def enter(self, *lines):
        """Type lines, each with a return at its end."""
        for line in lines:
            self.type(line)
            self.press('Enter')

    @property
    def text(self):
        """All that it shows, with what has scrolled away; lines that were too wide are whole."""
        return self._tmux('capture-pane', '-p', '-J', '-S', '-').rstrip()

    def wait_for(self, pattern):
        """Wait until it shows that regular expression, whose ^ and $ are those of lines; returns
        the match."""
        try:
            return until(lambda: re.search(pattern, self.text, re.MULTILINE))
        except TimeoutError:
            raise AssertionError(f'{pattern!r} is not there:\n{self.text}') from None

    @property
    def pid(self):
        """The process id of the program, while it runs."""
        shell = psutil.Process(int(self._tmux('display-message', '-p', '#{pane_pid}')))
        return shell.children()[0].pid

    @property
    def status(self):
        """The exit status of the program; None while it runs."""
        text = self._status.read_text() if self._status.exists() else ''
        return int(text) if text else None

    def wait(self):
        """Wait until the program has ended; returns its exit status."""
        until(lambda: self.status is not None)
        return self.status

    def close(self):
        """End the program, and the terminal."""
        self._tmux('kill-server')
        # what ended with it may be writing still
        shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()
