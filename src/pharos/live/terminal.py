"""A terminal of which a program has the whole screen: its keys, its signals, and its return."""
import contextlib
import os
import select
import signal
import sys
import termios
import tty
from typing import Any, Dict, Iterator, List, Optional

ESCAPE = '\x1b'
#: what terminals send for keys that have no character
_SEQUENCES = {
    '[A': 'up',
    'OA': 'up',
    '[B': 'down',
    'OB': 'down',
    '[5~': 'page up',
    '[6~': 'page down',
    '[H': 'home',
    '[F': 'end',
}
_REST = 0.05  # seconds in which the rest of a sequence comes, also over ssh
_ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP)


def is_interactive() -> bool:
    """Whether there is a terminal to draw on, and keys to read."""
    return sys.stdin.isatty() and sys.stdout.isatty() and os.environ.get('TERM') != 'dumb'


class Terminal:
    """Reads keys one by one, and hears of signals; within its ``with`` block, in the main thread,
    which may be entered again.

    However that block ends, the terminal is as it was.
    """

    def __init__(self) -> None:
        #: the signal that asks for the end; SIGTSTP, which Ctrl-Z is, for a pause
        self.ended_by: Optional[signal.Signals] = None
        self._keys = sys.stdin.fileno()
        self._woken, self._wake = os.pipe()
        os.set_blocking(self._wake, False)
        self._before: List[Any] = []
        self._handlers: Dict[signal.Signals, Any] = {}

    def __enter__(self) -> 'Terminal':
        self.ended_by = None
        self._before = termios.tcgetattr(self._keys)
        for number in (*_ENDS, signal.SIGWINCH):
            self._handlers[number] = signal.signal(number, self._on_signal)
        tty.setcbreak(self._keys)
        return self

    def __exit__(self, *error: object) -> None:
        with contextlib.suppress(termios.error):  # it is gone
            termios.tcsetattr(self._keys, termios.TCSADRAIN, self._before)
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def close(self) -> None:
        """Nobody wakes it any more."""
        os.close(self._woken)
        os.close(self._wake)

    def _on_signal(self, number: int, frame: Any) -> None:
        if number in _ENDS:
            self.ended_by = signal.Signals(number)
        self.wake()

    def wake(self) -> None:
        """Have :meth:`keys` return; in any thread."""
        with contextlib.suppress(BlockingIOError):  # it has been told often enough
            os.write(self._wake, b'.')

    def keys(self) -> List[str]:
        """Wait for keys, a change of the size, a signal or :meth:`wake`; returns the keys, of which
        there may be none. The end of the input is a signal to end."""
        ready, _, _ = select.select([self._keys, self._woken], [], [])
        if self._woken in ready:
            os.read(self._woken, 1024)
        if self._keys not in ready:
            return []
        typed = self._read()
        if not typed:
            self.ended_by = signal.SIGHUP
        while typed.endswith((ESCAPE, ESCAPE + '[', ESCAPE + 'O')):
            if not select.select([self._keys], [], [], _REST)[0]:
                break
            typed += self._read()
        return list(_parse(typed))

    def _read(self) -> str:
        try:
            return os.read(self._keys, 1024).decode(errors='replace')
        except OSError:  # the terminal is gone
            return ''


def _parse(typed: str) -> Iterator[str]:
    while typed:
        if typed[0] == ESCAPE:
            for sequence, key in _SEQUENCES.items():
                if typed.startswith(sequence, 1):
                    yield key
                    typed = typed[1 + len(sequence) :]
                    break
            else:
                yield 'escape'
                typed = _after_unknown_sequence(typed)
        else:
            yield {'\r': '\n', '\x08': '\x7f'}.get(typed[0], typed[0])
            typed = typed[1:]


def _after_unknown_sequence(typed: str) -> str:
    if typed[1:2] not in ('[', 'O'):
        return typed[1:]
    rest = typed[2:].lstrip('0123456789;')
    return rest[1:]
