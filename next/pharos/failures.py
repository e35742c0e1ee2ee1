"""What blocks raised: kept, counted, told once, and run again."""
from __future__ import annotations

import sys
import threading
import time
import traceback
from typing import Any, Callable

from pharos.errors import PharosError

KEPT = 100  # failures of a node; the oldest go
WHOLE = 5  # of them, the newest, whose messages and frames are kept


class Failure:
    """What a block raised at one place, as often as it came: one of :attr:`Node.failures`.

    :ivar error: the exception, of the last time
    :ivar block: the block that raised it
    :ivar message: the message, request or value that the block was run on; None for a soul, and for
        all but the newest 5 failures
    :ivar channel: the channel that the message came from, or None
    :ivar count: how many times it came
    :ivar time: when it came last, in seconds as of ``time.time()``
    """

    def __init__(self, error, block, message, channel, again: Callable[[Any], Any] | None):
        self.error, self.block, self.message, self.channel = error, block, message, channel
        self.count, self.time, self._again = 1, time.time(), again
        self.traceback = ''.join(traceback.format_exception(error))
        self._frames = error.__traceback__
        last = [(frame.filename, frame.lineno) for frame in traceback.extract_tb(self._frames, -1)]
        #: is equal for failures of one kind
        self.place = (
            getattr(block, '__qualname__', id(block)),
            type(error),
            tuple(last),
            id(channel),
        )

    def let_go(self) -> None:
        """Keep neither message nor frames, which may be large."""
        self.message = self._again = self._frames = None
        self.error = self.error.with_traceback(None)
        self.error.__context__ = self.error.__cause__ = None

    def retry(self) -> None:
        """Run the block again, as it is now, on the same message, in the node's turn.

        :raises PharosError: if the message is not kept any more
        """
        if self._again is None:
            raise PharosError(f'{self} cannot be run again: only the newest {WHOLE} keep messages')
        self._again(self.message)

    def debug(self) -> None:
        """Look at the frame that raised it: in IPython's debugger if IPython is used, else in pdb.

        :raises PharosError: if the frames are not kept any more
        """
        if self._frames is None:
            raise PharosError(f'{self} has no frames: only the newest {WHOLE} keep them')
        if 'IPython' in sys.modules:
            from IPython.core.debugger import Pdb

            debugger = Pdb()
        else:
            import pdb

            debugger = pdb.Pdb()
        debugger.reset()
        debugger.interaction(None, self._frames)

    def __repr__(self) -> str:
        times = f', {self.count} times' if self.count > 1 else ''
        name = getattr(self.block, '__qualname__', self.block)
        return f'<Failure of {name}: {type(self.error).__name__}: {self.error}{times}>'


class FailureList(list):
    """Failures; shown as a table."""

    def __repr__(self) -> str:
        rows = [
            (
                f'{type(failure.error).__name__}: {failure.error}'[:60],
                str(getattr(failure.block, '__qualname__', failure.block))[:30],
                getattr(failure.channel, 'topic', ''),
                str(failure.count),
                time.strftime('%H:%M:%S', time.localtime(failure.time)),
            )
            for failure in self
        ]
        if not rows:
            return '[]'
        rows.insert(0, ('raised', 'by', 'on', 'times', 'last'))
        widths = [max(map(len, column)) for column in zip(*rows)]
        return '\n'.join('  '.join(map(str.ljust, row, widths)).rstrip() for row in rows)


class Failures:
    """The failures of one run of a node; for any thread."""

    def __init__(self, tell: Callable[[str, str], None]):
        self._tell, self._kept, self._lock = tell, FailureList(), threading.RLock()
        self.total = 0

    def report(self, error, block, where: str, message=None, channel=None, again=None) -> None:
        """Keep what a block raised, and tell it at the 1st, 10th, 100th time.

        :param where: the block and its node, in words
        """
        new = Failure(error, block, message, channel, again)
        with self._lock:
            self.total += 1
            known = next((each for each in self._kept if each.place == new.place), None)
            if known:
                self._kept.remove(known)
                new.count = known.count + 1
            self._kept.append(new)
            for failure in self._kept[:-WHOLE]:
                failure.let_go()
            del self._kept[:-KEPT]
        if str(new.count).strip('0') == '1':
            times = f' ({new.count} times)' if new.count > 1 else ''
            try:
                line = f'{where} raised {type(error).__name__}: {error}{times}'
                self._tell(line, new.traceback)
            except Exception:  # neither the log nor the Transcript can be written
                pass

    def all(self) -> FailureList:
        """Return the failures that are kept, the newest last."""
        with self._lock:
            return FailureList(self._kept)
