"""A terminal of which a program has the whole screen: its keys, its signals, and its return."""
import codecs
import contextlib
import os
import re
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
    'OH': 'home',
    '[1~': 'home',
    '[7~': 'home',
    '[F': 'end',
    'OF': 'end',
    '[4~': 'end',
    '[8~': 'end',
}
#: a sequence, of which the last character may not have come yet; the second '[' is the console's
_SEQUENCE = re.compile(r'\x1b(?P<rest>\[\[?[0-?]*[ -/]*[@-~]?|O[0-9;]*[@-~]?)')
_BEGUN = re.compile(r'\x1b(\[\[?[0-?]*[ -/]*|O[0-9;]*)?\Z')
_REST = 0.05  # seconds in which the rest of a sequence comes, also over ssh
_ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP)


def is_interactive() -> bool:
    """Whether there is a terminal to draw on, and keys to read."""
    ends = sys.stdin, sys.stdout  # None where they are closed
    can_draw = os.environ.get('TERM', '').lower() not in ('dumb', 'unknown')
    return can_draw and all(end is not None and end.isatty() for end in ends)


class Terminal:
    """Reads keys one by one, and hears of signals; within its ``with`` block, in the main thread,
    which may be entered again.

    However that block ends, the terminal is as it was.
    """

    def __init__(self) -> None:
        #: the signal that asks for the end; SIGTSTP, which Ctrl-Z is, for a pause
        self.ended_by: Optional[signal.Signals] = None
        self._keys = sys.stdin.fileno()
        self._decode = codecs.getincrementaldecoder('utf-8')('replace').decode
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
        while self.ended_by is None and _BEGUN.search(typed):
            if not select.select([self._keys], [], [], _REST)[0]:
                break
            typed += self._read()
        return list(_parse(typed))

    def _read(self) -> str:
        """What is there, but for half a character; where nothing is left to come, that is a signal
        to end."""
        try:
            typed = os.read(self._keys, 1024)
        except OSError:  # the terminal is gone
            typed = b''
        if not typed:
            self.ended_by = signal.SIGHUP
        return self._decode(typed)


def _parse(typed: str) -> Iterator[str]:
    """The keys; those of which nobody here has heard are none."""
    while typed:
        sequence = _SEQUENCE.match(typed)
        if sequence:
            key = _SEQUENCES.get(sequence['rest'])
            if key is not None:
                yield key
        else:
            yield {ESCAPE: 'escape', '\r': '\n', '\x08': '\x7f'}.get(typed[0], typed[0])
        typed = typed[sequence.end() if sequence else 1 :]
