"""A condition whose lock nobody leaves taken."""
import threading
from _thread import RLock  # type: ignore[attr-defined]


class Condition(RLock):
    """As ``threading.Condition()``; but taking it is not Python's code, in which a handler of signals
    may raise when the lock is taken already, and nobody would release it."""

    def __init__(self) -> None:
        condition = threading.Condition(self)
        self.wait, self.wait_for = condition.wait, condition.wait_for
        self.notify_all = condition.notify_all
