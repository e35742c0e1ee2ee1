"""Failures of blocks: kept, counted, and run again."""
import importlib
import sys
import threading
import time
import traceback

from pharos.blocks import name_of
from pharos.errors import PharosError

KEPT = 100  # failures of a node; the oldest go
WHOLE = 5  # of them, the newest, whose messages and frames are kept


class Failure:
    """An exception that a block raised at one place: one of :attr:`Node.failures`.

    :ivar error: the exception, of the last time
    :ivar block: the block that raised it
    :ivar message: the message, request or value that the block was run on; None for a soul, and for
        all but the newest 5 failures
    :ivar channel: the channel that the message came from, or None
    :ivar count: how many times it came
    :ivar time: when it came last, in seconds as of ``time.time()``
    :ivar traceback: the traceback as text
    """

    count = 1

    def __init__(self, error, block, message, channel, again):
        self.error, self.block, self.message, self.channel = error, block, message, channel
        self.time, self._again = time.time(), again
        self.traceback = ''.join(traceback.format_exception(error))
        self._frames = error.__traceback__
        #: is equal for failures of one kind
        self.place = block, type(error), traceback.extract_tb(self._frames, -1), channel

    def let_go(self):
        """Keep neither message nor frames, which may be large."""
        self.message = self._again = self._frames = None
        self.error.__traceback__ = self.error.__context__ = self.error.__cause__ = None

    def _check(self, kept):
        if kept is None:
            raise PharosError(f'{self}: only the newest {WHOLE} of blocks can be run or shown')

    def retry(self) -> None:
        """Run the block again, as it is now, on the same message, in the node's turn.

        :raises PharosError: if the message is not kept any more
        """
        self._check(self._again)
        self._again(self.message)

    def debug(self) -> None:
        """Look at the frame that raised it: in IPython's debugger if IPython is used, else in pdb.

        :raises PharosError: if the frames are not kept any more
        """
        self._check(self._frames)
        module = 'IPython.core.debugger' if 'IPython' in sys.modules else 'pdb'
        debugger = importlib.import_module(module).Pdb()
        debugger.reset()
        debugger.interaction(None, self._frames)

    def __repr__(self):
        times = f', {self.count} times' if self.count > 1 else ''
        return (
            f'<Failure of {name_of(self.block)}: {type(self.error).__name__}: {self.error}{times}>'
        )


class Failures(list):
    """The failures of one run of a node, the newest last; shown as a table. For any thread."""

    total = 0  #: how often blocks failed

    def __init__(self):
        self._lock = threading.RLock()

    def keep(self, new):
        """Add a failure, and count it if there was one of its kind."""
        with self._lock:
            self.total += 1
            for known in [each for each in self if each.place == new.place]:
                self.remove(known)
                new.count += known.count
            self.append(new)
            for failure in self[:-WHOLE]:
                failure.let_go()
            del self[:-KEPT]

    def __repr__(self):
        rows = [
            f'{f"{type(each.error).__name__}: {each.error}":60.60}  {name_of(each.block):30.30}'
            f'  {getattr(each.channel, "topic", ""):20.20}  {each.count:5}'
            f'  {time.strftime("%H:%M:%S", time.localtime(each.time))}'
            for each in self
        ]
        table = '\n'.join([f'{"raised":60}  {"by":30}  {"on":20}  times  last', *rows])
        return table if self else '[]'
