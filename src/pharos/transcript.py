"""The Transcript: where blocks show things, as in Pharo."""
from __future__ import annotations

import time
import traceback
from contextlib import suppress
from typing import Any, Callable

from pharos.blocks import Block

ERROR_PAUSE = 0.02  # seconds after a look that has failed
_shown_keys: set[Any] = set()  # of show_once()


class _Transcript:
    """The Transcript: shows lines, from any thread. The report: ``Transcript show: message``."""

    receiver: Any = None  # ``receiver(line)`` takes the lines; None: standard output does

    def show(self, *things: object) -> None:
        """Show things in one line, on standard output or to the receiver."""
        line = ' '.join(map(str, things))
        if self.receiver:
            self.receiver(line)
        else:
            with suppress(OSError, ValueError):  # its reader has gone, or its disk is full
                print(f'{line}\n', end='', flush=True)  # in one piece: other threads print, too

    def on_show(self, receiver: Block | None) -> Block | None:
        """Have ``receiver(line)`` take the lines, and return the former receiver.

        :param receiver: None: standard output
        """
        former_receiver = self.receiver
        self.receiver = receiver
        return former_receiver


Transcript = _Transcript()


def attempt(function: Callable, *arguments: Any) -> Any:
    """Call a function, and return its value; show an exception of any kind, once, and return None.

    Threads that look again and again call this: one failed look must not end the looks.
    """
    try:
        return function(*arguments)
    except BaseException as error:
        tell_once(error)
        time.sleep(ERROR_PAUSE)
    return None


def tell_once(error: BaseException) -> None:
    """Show an exception in the Transcript, unless one of its class came from its line before."""
    *_, frame = traceback.extract_tb(error.__traceback__)
    text = f'{frame.filename}:{frame.lineno}: {error!r}; it is tried again'
    with suppress(Exception):  # of the Transcript's receiver
        show_once((frame.filename, frame.lineno, type(error)), text)


def show_once(key: Any, text: str) -> None:
    """Show a text in the Transcript, unless one with an equal key was shown before."""
    if key not in _shown_keys:
        _shown_keys.add(key)
        Transcript.show(text)
