"""By when what a thread waits for is to have come."""
import contextlib
import io
import math
import socket
import threading
import time
from typing import Any, Iterator, Optional

# seconds beyond a time limit, to tell a master that does not answer from what did not come
MARGIN = 0.5


class _ThreadLimit(threading.local):
    deadline = math.inf  # by which all calls of this thread are to end, by time.monotonic()


_limits = _ThreadLimit()


@contextlib.contextmanager
def time_limit(seconds: Optional[float]) -> Iterator[None]:
    """Within this, all calls of this thread end by then, together: no user's code is to run in it.

    :param seconds: None: no limit
    """
    before = _limits.deadline
    if seconds is not None:
        _limits.deadline = deadline_in(max(0.0, seconds))
    try:
        yield
    finally:
        _limits.deadline = before


def deadline_in(seconds: float) -> float:
    """The time, by ``time.monotonic()``, in so many seconds, or when the :func:`time_limit` of this
    thread is over."""
    return min(time.monotonic() + seconds, _limits.deadline)


def is_time_up() -> bool:
    """Whether the :func:`time_limit` of this thread is over."""
    return time.monotonic() >= _limits.deadline


def seconds_left(deadline: Optional[float]) -> Optional[float]:
    """The seconds until that time, by ``time.monotonic()``; None: no limit.

    :raises socket.timeout: if it is over
    """
    if deadline is None:
        return None
    left = deadline - time.monotonic()
    if left <= 0:
        raise socket.timeout('timed out')
    return left


class DeadlineReader(io.RawIOBase):
    """What a peer sends, until :attr:`deadline`, however slowly it comes.

    :raises socket.timeout: when that is over
    """

    def __init__(self, sock: socket.socket, deadline: Optional[float] = None) -> None:
        super().__init__()
        self._socket = sock
        self.deadline = deadline  # by time.monotonic(); None: no limit

    def readable(self) -> bool:
        """As of :mod:`io`."""
        return True

    def readinto(self, buffer: Any) -> int:
        """As of :mod:`io`."""
        self._socket.settimeout(seconds_left(self.deadline))
        return self._socket.recv_into(buffer)
