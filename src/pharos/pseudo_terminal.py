"""Pseudo-terminals: what a program takes for the terminal that it runs in, and a program drives."""
import codecs
import contextlib
import errno
import io
import os
import re
import select
import termios
import threading
from typing import Iterator, Tuple

from pharos.errors import PharosError

LINE_LIMIT = 4095  # bytes of a line that Linux takes where the program reads line by line
_COLORS = re.compile('\x1b\\[[0-9;]*m')


class PseudoTerminal:
    """A terminal that shows what a program prints as it is printed, and nothing else: no echo of what
    is typed, and lines that end as the program ends them."""

    def __init__(self) -> None:
        try:
            #: the program's side, which is to be closed here when it has it
            self._master, self.slave = os.openpty()
        except OSError as error:
            raise PharosError(
                f'there is no terminal for the program ({error}): end other programs, or see whether'
                ' /dev/pts is mounted'
            ) from error
        os.set_blocking(self._master, False)  # a write would not hear of the end of the program
        mode = termios.tcgetattr(self.slave)
        mode[1] &= ~termios.OPOST
        mode[3] &= ~(termios.ECHO | termios.ECHONL)
        termios.tcsetattr(self.slave, termios.TCSANOW, mode)
        self._writing = threading.Lock()
        self._is_closed = False

    def lines(self) -> Iterator[Tuple[str, bool]]:
        """What the program prints, until nobody has the terminal any more: ``(text, is_whole)`` for
        each line, and for the beginnings of those that are not complete yet."""
        decoder = io.IncrementalNewlineDecoder(
            codecs.getincrementaldecoder('utf-8')('replace'), translate=True
        )
        begun = ''
        while True:
            data = self._read()
            *whole, begun = (begun + decoder.decode(data, final=not data)).split('\n')
            for line in whole:
                yield line, True
            if begun:
                yield begun, not data
            if not data:
                return

    def _read(self) -> bytes:
        while True:
            self._wait(select.POLLIN)
            try:
                return os.read(self._master, 1 << 16)
            except BlockingIOError:
                continue
            except OSError as error:
                if error.errno != errno.EIO:  # which is how the end is told
                    raise
                return b''

    def _wait(self, event: int) -> bool:
        """Wait until it can be read or written; returns whether anybody has the other side still."""
        poll = select.poll()
        poll.register(self._master, event)
        return not any(events & select.POLLHUP for _, events in poll.poll())

    def write(self, text: str) -> None:
        """Type the text; waits where the program does not read.

        :raises ValueError: if a line is longer than the program can read
        :raises OSError: if nobody reads it any more
        """
        data = text.encode()
        with self._writing:
            if self._is_closed:
                raise _nobody_reads()
            reads_lines = termios.tcgetattr(self._master)[3] & termios.ICANON
            if reads_lines and any(len(line) > LINE_LIMIT for line in data.split(b'\n')):
                raise ValueError(
                    f'a line of more than {LINE_LIMIT} bytes is cut off by the terminal of a program'
                    ' that reads lines: send shorter ones'
                )
            while data:
                if not self._wait(select.POLLOUT):
                    raise _nobody_reads()
                with contextlib.suppress(BlockingIOError):
                    data = data[os.write(self._master, data) :]

    def close(self) -> None:
        """Close it, when nobody has it any more."""
        with self._writing:
            self._is_closed = True
            os.close(self._master)


def without_colors(text: str) -> str:
    """The text as it is where there is no terminal."""
    return _COLORS.sub('', text)


def _nobody_reads() -> OSError:
    return OSError(errno.EIO, 'nobody has the other side of the terminal')
