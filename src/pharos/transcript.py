"""The Transcript: where blocks show things, as in Pharo."""
from __future__ import annotations

from typing import Any

from pharos.blocks import Block


class _Transcript:
    """The Transcript: shows lines, from any thread. The report: ``Transcript show: message``."""

    receiver: Any = None  # ``receiver(line)`` takes the lines; None: standard output does

    def show(self, *things) -> None:
        """Show things in one line, on standard output or to the receiver."""
        line = ' '.join(map(str, things))
        if self.receiver:
            self.receiver(line)
        else:
            print(f'{line}\n', end='', flush=True)  # in one piece: other threads print, too

    def on_show(self, receiver: Block | None) -> Block | None:
        """Have ``receiver(line)`` take the lines, and return the former receiver.

        :param receiver: None: standard output
        """
        former_receiver = self.receiver
        self.receiver = receiver
        return former_receiver


Transcript = _Transcript()
