"""Where what the programs of one process print goes to."""
import codecs
import io
import sys
import threading
from typing import IO, Any, Callable, Optional, TextIO

SCREEN = 'screen'  # as launch files say it


class _Bytes(io.BufferedIOBase):
    """Takes the bytes of lines; whoever closes it, closes nothing else."""

    def __init__(self, lines: 'NamedLines') -> None:
        self._lines = lines
        self._decoder = codecs.getincrementaldecoder('utf-8')('backslashreplace')

    def writable(self) -> bool:
        """See :class:`io.IOBase`."""
        return True

    def write(self, data: Any) -> int:
        """See :class:`io.BufferedIOBase`."""
        self._lines.write(self._decoder.decode(bytes(data)))
        return len(data)

    def flush(self) -> None:
        """See :class:`io.IOBase`."""
        self._lines.flush()

    def isatty(self) -> bool:
        """See :class:`io.IOBase`."""
        return self._lines.isatty()

    def fileno(self) -> int:
        """See :class:`io.IOBase`."""
        return self._lines.fileno()


class NamedLines(io.TextIOBase):
    """A stream each of whose lines begins with the name of the node that printed it.

    A line goes on when it is complete, or flushed.

    :param stream: ``stream()`` is what it goes on to
    :param name: ``name()`` is the node's
    """

    def __init__(self, stream: Callable[[], TextIO], name: Callable[[], str]) -> None:
        self._stream, self._name = stream, name
        self._lock = threading.Lock()
        self._begun = ''  # of a line that is not complete
        self._is_within = False  # whether the beginning of the line has gone on
        #: what takes bytes, as UTF-8
        self.buffer = _Bytes(self)

    def write(self, text: str) -> int:
        """See :class:`io.TextIOBase`."""
        with self._lock:
            *lines, self._begun = (self._begun + text).split('\n')
            for line in lines:
                self._pass_on(line + '\n')
        return len(text)

    def flush(self) -> None:
        """See :class:`io.TextIOBase`."""
        with self._lock:
            if self._begun:
                self._pass_on(self._begun)
                self._begun = ''

    def _pass_on(self, text: str) -> None:
        stream = self._stream()
        stream.write(text if self._is_within else f'[{self._name()}] {text}')
        stream.flush()
        self._is_within = not text.endswith('\n')

    def isatty(self) -> bool:
        """Whether it ends on a terminal."""
        return self._stream().isatty()

    def fileno(self) -> int:
        """What child processes write to; their lines have no name."""
        return self._stream().fileno()

    def reconfigure(self, **options: Any) -> None:
        """Nothing: its lines go on at once, and text as the process prints it."""

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """See :class:`io.TextIOBase`."""
        return self._stream().encoding


def redirect(
    system: Any, output: Optional[str], name: Callable[[], str], is_again: bool
) -> Optional[IO[str]]:
    """Have what a program prints go where it is to; returns the file that was opened for it.

    :param system: the program's ``sys``
    :param output: 'screen', or the path of a file, or None: as this process prints
    :param is_again: whether the file goes on where it ended
    """
    if output is None:
        return None
    file: Optional[IO[str]] = None
    if output == SCREEN:
        system.stdout = NamedLines(lambda: sys.stdout, name)
    else:
        mode = 'a' if is_again else 'w'
        file = open(output, mode, buffering=1, encoding='utf-8', errors='backslashreplace')
        system.stdout = file
    system.stderr = NamedLines(lambda: sys.stderr, name)
    return file
