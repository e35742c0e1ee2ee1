"""The Transcript: where blocks show things, as in Pharo."""
from typing import Any

from pharos.blocks import Block


class _Transcript:
    """Shows things, a line each, from any thread. The report: ``Transcript show: message``."""

    _receiver: Any = None

    def show(self, *things) -> None:
        """Show one line on standard output, or to the receiver."""
        line = ' '.join(map(str, things))
        if self._receiver:
            self._receiver(line)
        else:
            print(f'{line}\n', end='', flush=True)  # in one piece

    def on_show(self, receiver: Block | None) -> Block | None:
        """Have ``receiver(line)`` take the lines, None: standard output; returns the former one."""
        former_receiver = self._receiver
        self._receiver = receiver
        return former_receiver


Transcript = _Transcript()
