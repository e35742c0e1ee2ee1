"""Where what the programs of one process print goes to."""
import codecs
import io
import sys
import threading
from typing import IO, Any, Callable, Optional

from pharos.errors import PharosError

SCREEN = 'screen'  # as launch files say it


class _NamedLines(io.BufferedIOBase):
    """Lines each of which begins with the name of the node that printed it, as UTF-8.

    A line goes on when it is complete, or flushed. Whoever closes it, closes nothing else.

    :param stream: ``stream()`` is what it goes on to
    :param name: ``name()`` is the node's
    """

    def __init__(self, stream: Callable[[], IO[str]], name: Callable[[], str]) -> None:
        self._stream, self._name = stream, name
        self._lock = threading.Lock()
        self._decode = codecs.getincrementaldecoder('utf-8')('backslashreplace').decode
        self._begun = ''  # of a line that is not complete
        self._is_within = False  # whether the beginning of the line has gone on

    def writable(self) -> bool:
        """See :class:`io.IOBase`."""
        return True

    def write(self, data: Any) -> int:
        """See :class:`io.BufferedIOBase`."""
        with self._lock:
            *lines, self._begun = (self._begun + self._decode(bytes(data))).split('\n')
            for line in lines:
                self._pass_on(line + '\n')
        return len(data)

    def flush(self) -> None:
        """See :class:`io.IOBase`."""
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


class _Unclosed:
    """A stream of this process, whatever that is at the time; whoever closes it, closes nothing."""

    def __init__(self, stream: Callable[[], Any]) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream(), name)

    @property
    def buffer(self) -> '_Unclosed':
        """What takes bytes."""
        return _Unclosed(lambda: self._stream().buffer)

    def detach(self) -> '_Unclosed':
        """See :class:`io.TextIOBase`."""
        return self.buffer

    def close(self) -> None:
        """Nothing: others print there, too."""


def redirect(
    system: Any, output: Optional[str], name: Callable[[], str], is_again: bool
) -> Optional[IO[str]]:
    """Have what a program prints go where it is to; returns the file that was opened for it.

    :param system: the program's ``sys``
    :param output: 'screen', or the path of a file, or None: as this process prints
    :param is_again: whether the file goes on where it ended
    """
    file: Optional[IO[str]] = None
    stdout: Any = _Unclosed(lambda: sys.stdout)
    stderr: Any = _Unclosed(lambda: sys.stderr)
    if output is not None:
        stderr = _named(lambda: sys.stderr, name)
        if output == SCREEN:
            stdout = _named(lambda: sys.stdout, name)
        else:
            mode = 'a' if is_again else 'w'
            try:
                file = open(output, mode, 1, encoding='utf-8', errors='backslashreplace')
            except OSError as error:
                raise PharosError(
                    f'the output of {name()} cannot be written to {output!r} ({error}): give'
                    f" output='{SCREEN}', or the path of a file"
                ) from error
            stdout = file
    # under both names, as in a process: what nobody has any more closes itself
    system.stdout = system.__stdout__ = stdout
    system.stderr = system.__stderr__ = stderr
    return file


def _named(stream: Callable[[], IO[str]], name: Callable[[], str]) -> IO[str]:
    lines: Any = _NamedLines(stream, name)
    # not line by line, which would flush the beginning of a line, too
    return io.TextIOWrapper(lines, 'utf-8', 'backslashreplace', write_through=True)
