"""Failures of blocks: kept, counted, and run again."""
import threading
import time
import traceback

from pharos.blocks import block_name
from pharos.errors import PharosError

MAX_FAILURES = 100  # of a node; the oldest go
MAX_WITH_FRAMES = 5  # the newest ones keep their messages and frames


class Failure:
    """An exception that a block raised at one place: one of :attr:`Node.failures`.

    :ivar error: the newest exception
    :ivar block: the block that raised the exception; or a text: a topic, a program or its thread
    :ivar message: the message, request or value that the block was run on; None for a soul, and for
        all but the newest 5 failures
    :ivar channel: the channel of the message, or None
    :ivar count: how often this block raised such an exception at this place
    :ivar time: the time of the newest exception, in seconds as of ``time.time()``
    :ivar traceback: the traceback as text
    """

    count = 1

    def __init__(self, error, block, message=None, channel=None, retry=None):
        self.error = error
        self.block = block
        self.message = message
        self.channel = channel
        self.time = time.time()
        self.traceback = ''.join(
            traceback.format_exception(type(error), error, error.__traceback__)
        )
        self._retry = retry
        self._frames = error.__traceback__
        #: equal for failures of one kind, which share one entry
        self.place = block, type(error), traceback.extract_tb(self._frames, -1), channel

    def drop_frames(self) -> None:
        """Drop the message and the frames, which may be large."""
        self.message = None
        self._retry = None
        self._frames = None
        self.error.__traceback__ = None
        self.error.__context__ = None
        self.error.__cause__ = None

    def _check_kept(self, thing: object) -> None:
        if thing is None:
            raise PharosError(
                f'{self}: only the newest {MAX_WITH_FRAMES} of blocks can be run or shown'
            )

    def retry(self) -> None:
        """Run the block again, on the same message.

        If the channel or node has another delegate or soul now, that one runs. The block runs in
        this thread. A delegate waits for the node's other delegates first: they run one at a time.

        :raises PharosError: if the message is not kept any more, or came from no block
        :raises NodeStoppedError: if a delegate's node is stopped
        """
        self._check_kept(self._retry)
        self._retry(self.message)

    def debug(self) -> None:
        """Open the frame that raised the exception: in IPython's debugger, or else in pdb.

        :raises PharosError: if the frames are not kept any more
        """
        from pharos.live.debugging import open_debugger

        self._check_kept(self._frames)
        open_debugger(self._frames)

    def __repr__(self) -> str:
        times = f', {self.count} times' if self.count > 1 else ''
        error_type = type(self.error).__name__
        return f'<Failure of {block_name(self.block)}: {error_type}: {self.error}{times}>'


class Failures(list):
    """The failures of one run of a node, the newest last. For any thread."""

    total = 0  #: the number of all failures, also of those dropped since

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def keep(self, failure: Failure) -> None:
        """Add a failure; replace an older one of its kind, and add the counts."""
        with self._lock:
            self.total += 1
            for former in [each for each in self if each.place == failure.place]:
                self.remove(former)
                failure.count += former.count
            self.append(failure)
            for older in self[:-MAX_WITH_FRAMES]:
                older.drop_frames()
            del self[:-MAX_FAILURES]
