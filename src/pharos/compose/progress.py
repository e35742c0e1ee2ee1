"""What a composition tells of itself while it starts, runs and ends."""
import threading
from typing import TYPE_CHECKING, List, Mapping, Optional, TextIO

from pharos.transcript import Transcript

if TYPE_CHECKING:
    from pharos.compose.kept_node import KeptNode

_CLEAR = '\r\033[K'  # what takes the line away that a terminal shows


class Progress:
    """Tells what goes wrong, by the :data:`Transcript`."""

    def apart(self, reasons: Mapping[str, List[str]]) -> None:
        """Nodes or programs, by the reason for it, start as processes of their own."""

    def starts(self, name: str, number: int, count: int) -> None:
        """A node, the so-manieth of so many, starts."""

    def hangs(self, name: str, seconds: float) -> None:
        """It has not started in that time, and the next one is started meanwhile."""

    def started(self, kept: 'KeptNode', seconds: float) -> None:
        """It has started, which took so long."""

    def all_begun(self, left: List[str]) -> None:
        """All have begun to start; the nodes of these names have not started yet."""
        if left:
            self.tell(
                f"{', '.join(left)}: started, but no node yet: rospy.init_node was not called"
            )

    def failed(self, kept: 'KeptNode', error: Exception) -> None:
        """It did not start."""
        where = f'{kept.launched.file}: ' if kept.launched.file else ''
        self.tell(f'{where}{_described(kept)} is not started: {error}')

    def ended(self, kept: 'KeptNode') -> None:
        """It has ended by itself."""
        self.tell(f'{kept.name} {kept.outcome}')

    def tell(self, text: str) -> None:
        """Tell that."""
        Transcript.show(text)


class PrintedProgress(Progress):
    """Prints all of it, a line each; on a terminal, of what starts only the last line stays.

    :param stream: where to
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._is_terminal = stream.isatty()
        self._lock = threading.Lock()
        self._line: Optional[str] = None  # that the terminal shows, to be drawn over
        self._place = ''

    def apart(self, reasons: Mapping[str, List[str]]) -> None:
        """See :class:`Progress`."""
        for reason, names in reasons.items():
            self.tell(f"run apart: {', '.join(names)} ({reason})")

    def starts(self, name: str, number: int, count: int) -> None:
        """See :class:`Progress`."""
        self._place = f'{number} of {count}'
        self._redraw(f'starting {self._place}: {name}')

    def hangs(self, name: str, seconds: float) -> None:
        """See :class:`Progress`."""
        self.tell(
            f'{name} has not started within {seconds:g} s: it has not called rospy.init_node yet;'
            ' the others go on'
        )

    def started(self, kept: 'KeptNode', seconds: float) -> None:
        """See :class:`Progress`."""
        if kept.has_ended_without_node:
            self.tell(f'{_described(kept)} has run, and never called rospy.init_node')
        elif not self._is_terminal or kept.starts > 1:
            self.tell(f'started {_described(kept)} in {seconds:.2f} s')

    def all_begun(self, left: List[str]) -> None:
        """See :class:`Progress`."""
        self._redraw(None)
        super().all_begun(left)

    def tell(self, text: str) -> None:
        """Print a line, above the one that is drawn over."""
        with self._lock:
            clear = _CLEAR if self._line else ''
            self._print(f'{clear}{text}\n{self._line or ""}')

    def _redraw(self, line: Optional[str]) -> None:
        with self._lock:
            if self._is_terminal:
                self._line = line
                self._print(_CLEAR + (line or ''))
            elif line:
                self._print(line + '\n')

    def _print(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except (OSError, ValueError):
            pass  # nobody reads it any more


def _described(kept: 'KeptNode') -> str:
    """The name of a node, and its program."""
    program = kept.launched.program
    return program if kept.name == program else f'{kept.name} ({program})'
