"""The Transcript: where blocks show things."""
import os
import sys
import threading
from typing import Any, Callable, Optional

from pharos.blocks import attempt, check_block, name_of, text_of
from pharos.signals import is_from_signal

Receiver = Optional[Callable[[str], Any]]


class _Transcript:
    """Shows things a line each, from any thread, on standard output or wherever ``on_show()``
    says.

    The report (listing 3.3)::

        Transcript show: message value asString
        Transcript.show(message)
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()  # an RLock: what receives a line may show something itself
        self._receiver: Receiver = None
        self._is_failing = False  # whether the receiver has raised something

    def show(self, *things: Any) -> None:
        """Show one line: ``things`` as text, separated by blanks. Raises nothing.

        Where the receiver of :meth:`on_show` raises something, the line goes to standard output,
        the first one with a word about it. A line that cannot be written there either, to a closed
        pipe for example, is lost.
        """
        text = ' '.join(map(text_of, things))
        with self._lock:
            receiver = self._receiver
            if receiver is None or not self._is_taken(text, receiver):
                attempt(lambda: _print(text))

    def _is_taken(self, text: str, receiver: Callable[[str], Any]) -> bool:
        """Have the receiver take the line; returns whether it did."""
        try:
            receiver(text)
            return True
        except BaseException as error:
            if is_from_signal(error):
                raise
            if not self._is_failing:
                self._is_failing = True
                why = (
                    f'the receiver {name_of(receiver)} of the Transcript raised '
                    f'{type(error).__name__}: {text_of(error)}: what it does not take is shown here'
                )
                attempt(lambda: _print(why))
            return False

    def _forget(self) -> None:
        """In a process that was forked, when another thread may have been showing a line."""
        self._lock = threading.RLock()

    def on_show(self, receiver: Receiver) -> Receiver:
        """Send lines to ``receiver(text)`` from now on; ``None`` means standard output again.

        Returns the receiver so far, so that it can be put back.
        """
        check_block(receiver, 'receiver', ('text',))
        with self._lock:
            before, self._receiver = self._receiver, receiver
            self._is_failing = False
        return before

    @property
    def is_where_errors_are(self) -> bool:
        """Whether what it shows comes where standard error goes: to the same terminal or file."""
        return self._receiver is None and bool(attempt(_is_one_output))

    def __repr__(self) -> str:
        return f"<Transcript to {'standard output' if self._receiver is None else self._receiver}>"


def _is_one_output() -> bool:
    if sys.stdout is sys.stderr:
        return True
    out, err = (os.fstat(stream.fileno()) for stream in (sys.stdout, sys.stderr))
    return os.path.samestat(out, err)


def _print(line: str) -> None:
    text = f'{line}\n'  # in one piece: what other threads print does not come into the line
    try:
        print(text, end='', flush=True)
    except UnicodeEncodeError:  # as on a terminal that knows ASCII only
        encoding = sys.stdout.encoding
        print(text.encode(encoding, 'backslashreplace').decode(encoding), end='', flush=True)


Transcript = _Transcript()
os.register_at_fork(after_in_child=Transcript._forget)
