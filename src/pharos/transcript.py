"""The Transcript: where blocks show things, as in Pharo."""
from __future__ import annotations

import threading
from typing import Any, Callable


class _Transcript:
    """Shows things, a line each, from any thread. The report: ``Transcript show: message``."""

    _lock = threading.RLock()
    _receiver: Callable[[str], Any] | None = None

    def show(self, *things: Any) -> None:
        """Show one line on standard output, or to the receiver."""
        line = ' '.join(map(str, things))
        with self._lock:
            if self._receiver:
                self._receiver(line)
            else:
                print(line, flush=True)

    def on_show(self, receiver: Callable[[str], Any] | None) -> Callable[[str], Any] | None:
        """Have ``receiver(line)`` take the lines, None: standard output; returns the former one."""
        with self._lock:
            former, self._receiver = self._receiver, receiver
        return former


Transcript = _Transcript()
