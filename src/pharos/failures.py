"""What blocks raised: kept, counted, told once, and run again."""
import collections
import numbers
import sys
import threading
import time
import traceback
from types import TracebackType
from typing import Any, Callable, Counter, Dict, List, Optional, Sequence, Tuple

import genpy

from pharos import on_demand
from pharos.blocks import attempt, text_of
from pharos.errors import PharosError
from pharos.signals import code_of, is_from_signal

KEPT = 100  # failures of a node; the oldest go, but for the first, which may be the cause
WHOLE = 5  # of them, the newest, whose messages and frames are kept
TEXTS = 3  # texts of failures at one place that are told; then the 10th, 100th ... there
PLACES = 1000  # at which failures are counted
TEXT_LIMIT = 2000  # characters of the text of an exception
LARGE = 10000  # bytes of a thing that an exception without its frames may hold on to


class Failure:
    """A failure of a block, as often as it came: one of :attr:`Node.failures`.

    Failures are identical, and one, where block, channel, class and text of the exception, and the
    line that raised it, are the same. Of the newest 5 failures of a node, message and frames are
    kept; of older ones the text of the :attr:`traceback`.

    :ivar error: the exception, of the last time
    :ivar block: what raised it
    :ivar message: what the block was run on, the last time: a message, a service's request, a
        parameter's value; None for a soul
    :ivar channel: the channel that it came from; None where it is no message
    :ivar count: how many times it came
    :ivar time: when that was last, in seconds as of ``time.time()``
    :ivar where: the block and its node, in words
    :ivar text: the text of the exception, cut where it is long
    :ivar kept_by: the node's :attr:`~Node.errors`
    """

    def __init__(
        self,
        error: BaseException,
        block: Any,
        where: str,
        channel: Any = None,
        message: Any = None,
        again: Optional[Callable[[Any], Any]] = None,
    ) -> None:
        self.error, self.block, self.channel, self.message = error, block, channel, message
        self.where, self.text = where, _brief(text_of(error))
        self.count, self.time = 1, time.time()
        self.kept_by: Any = None  # the Failures
        self._again = again
        self._frames = error.__traceback__
        self._traceback: Optional[str] = None  # the text of the frames that were let go

    def place(self) -> Any:
        """What is the same of failures at one place, which differ in the text alone."""
        lines = [
            (frame.f_code.co_filename, line) for frame, line in traceback.walk_tb(self._frames)
        ]
        # The code tells a block from the one that it replaces, typed anew at the prompt perhaps,
        # but not two closures. Not the channel itself, which may be closed, and should not be kept
        # for being counted.
        code = attempt(lambda: code_of(self.block))
        return self.where, code, id(self.channel), type(self.error), tuple(lines[-1:])

    def happened_again(self, last: 'Failure') -> None:
        """It came once more: ``last`` is that time."""
        if last.error is self.error:
            _cut(last._frames, self._frames)
        vars(self).update(vars(last), count=self.count + 1)

    def let_go(self) -> None:
        """Keep nothing large: no message, and of the frames the text."""
        if self.is_whole:
            self._traceback = self.traceback
            if self.message is not None:
                self.message = self._again = None
            self._frames = None
            attempt(lambda: _release(self.error))

    @property
    def is_whole(self) -> bool:
        """Whether its message and frames are kept still."""
        return self._traceback is None

    @property
    def traceback(self) -> str:
        """The traceback, as text; empty where nobody raised the exception."""
        if self._traceback is not None:
            return self._traceback
        error, frames = self.error, self._frames
        lines = attempt(lambda: traceback.format_exception(type(error), error, frames))
        if lines is None:
            # its __str__, or that of its cause, raises what traceback does not expect
            lines = attempt(lambda: traceback.format_tb(frames), [])
        return _brief(''.join(lines), 10 * TEXT_LIMIT)

    def retry(self) -> bool:
        """Run the block again, as it is now, on the same message; returns whether it did not fail.

        A delegate, which may have been replaced since, runs when no other of its node does; other
        blocks run at once, all of them in this thread. What it raises is a failure like any other,
        and told in any case.

        A soul that loops does so here, too: :meth:`Node.fork` it again where it is not to.

        :raises PharosError: if the message has been let go, or the block cannot be run again; or if
            this waits in a delegate of another node, and one of this node's waits for that delegate
        :raises NodeStoppedError: if the node is not running, or stops while this waits for its turn
        """
        if self._again is None:
            raise PharosError(
                f'{self.where} cannot be run again: messages are kept of the newest {WHOLE}'
                ' failures of a node only, and what is no block of a node has none: retry() one of'
                ' those, or do by hand what made it run'
            )
        retrying = self.kept_by.retrying
        before, retrying.failed = getattr(retrying, 'failed', None), False
        try:
            self._again(self.message)
            return not retrying.failed
        finally:
            retrying.failed = before

    def debug(self) -> None:
        """Look into the frame in which it was raised, by IPython's debugger in its shells, else by
        pdb, until that is left by ``q``. Nodes go on meanwhile, this one too.

        :raises PharosError: if nobody raised it, or the frames have been let go
        """
        if self.is_whole and self._frames is None:
            raise PharosError(f'{self.where} failed, and nobody raised that: it has no frames')
        if self._frames is None:
            raise PharosError(
                f'the frames of this failure of {self.where} are gone: they are kept of the'
                f' newest {WHOLE} failures of a node only; debug() one of those, or read its'
                ' .traceback'
            )
        on_demand.module('live.debugger').look_at(self._frames)

    def __repr__(self) -> str:
        times = f', {self.count} times' if self.count > 1 else ''
        return f'<Failure of {self.where}: {type(self.error).__name__}: {self.text}{times}>'


class FailureList(List[Failure]):
    """Failures, which a prompt and a notebook show as a table."""

    def __repr__(self) -> str:
        return str(_tables().as_text(self))

    def _repr_html_(self) -> str:
        return str(_tables().as_html(self))


def _tables() -> Any:
    return on_demand.module('live.failure_table')


class Failures(Sequence[BaseException]):
    """What the blocks of one node raised, or those of something else that runs blocks; for any
    thread.

    It is the sequence of the exceptions, the newest last. Who has seen to them may ``pop`` or
    ``clear`` them.

    :ivar total: how many failures there were, identical ones and those taken out too
    :param tell: called as ``tell(line, details)`` for those that are worth it; what it raises
        changes nothing
    """

    def __init__(self, tell: Callable[[str, str], Any]) -> None:
        self._tell = tell
        # an RLock: what is freed, or shown as text, may run code of the user's
        self._lock = threading.RLock()
        # (place, text) -> what failed there, the newest last
        self._kept: Dict[Tuple[Any, str], Failure] = {}
        self._first: Any = None  # the key of the first
        self._times: Counter[Any] = collections.Counter()  # place -> failures at it
        self._texts: Counter[Any] = collections.Counter()  # place -> texts of them that were told
        self.retrying = threading.local()  # .failed: whether what the thread runs again has
        self.total = 0

    def __getitem__(self, index: Any) -> Any:
        return [failure.error for failure in self.all()][index]

    def __len__(self) -> int:
        return len(self._kept)

    def __repr__(self) -> str:
        return repr(self[:])

    def all(self) -> 'FailureList':
        """The failures that are kept, the newest last."""
        with self._lock:
            return FailureList(self._kept.values())

    def pop(self, index: int = -1) -> BaseException:
        """Take an exception out, the newest by default, and return it: it was seen to."""
        with self._lock:
            key = list(self._kept)[index]
            del self._times[key[0]], self._texts[key[0]]
            if key == self._first:
                self._first = None
            return self._kept.pop(key).error

    def clear(self) -> None:
        """Take all of them out."""
        with self._lock:
            while self._kept:
                self.pop()

    def report(
        self, error: BaseException, block: Any, where: str, *details: Any, **more: Any
    ) -> None:
        """Keep a failure of a block, and tell of it if it is new.

        Raises nothing but what a signal raises.

        :param where: how it is told, such as 'delegate on_pose of /node on /pose'
        :param channel: where the message came from
        :param message: what the block was run on
        :param again: ``again(message)`` runs the block as it is then, and reports what it raises
        """
        if is_from_signal(error):
            raise error
        attempt(lambda: self._keep(Failure(error, block, where, *details, **more)))

    def _keep(self, failure: Failure) -> None:
        place, text = key = failure.place(), failure.text
        failure.kept_by = self
        with self._lock:
            known = self._kept.pop(key, None)
            is_told = known is None and self._texts[place] < TEXTS
            if known is not None:
                known.happened_again(failure)
            self._kept[key] = known or failure
            self._times[place] += 1
            self._texts[place] += is_told
            times, count = self._times[place], self._kept[key].count
            self._make_room()
            self.total += 1
        if getattr(self.retrying, 'failed', None) is not None:
            self.retrying.failed = is_told = True
        error = failure.error
        raised = f'{failure.where} raised {type(error).__name__}: {text}'
        if is_told:
            # what nobody raised has no traceback but its text, which is in the line
            has_more = error.__traceback__ or error.__cause__ or error.__context__
            self._tell(raised, failure.traceback if has_more else '')
        elif times >= 10 and str(times).strip('0') == '1':
            different = '' if count == times else ', with different texts'
            self._tell(f'{raised}, {times} times by now{different}', '')

    def _make_room(self) -> None:
        """Let go what is large but of the newest; of too many, one of those that are most alike."""
        keys = list(self._kept)
        self._first = self._first or keys[0]
        if len(keys) > WHOLE:
            self._kept[keys[-WHOLE - 1]].let_go()
        if len(keys) > KEPT:
            keys.remove(self._first)
            (crowded, _), *_ = collections.Counter(place for place, _ in keys).most_common(1)
            del self._kept[next(key for key in keys if key[0] == crowded)]
        if len(self._times) > PLACES:
            oldest = next(iter(self._times))
            del self._times[oldest], self._texts[oldest]


def _brief(text: str, limit: int = TEXT_LIMIT) -> str:
    """The text, without its middle where it is too long."""
    return text if len(text) <= limit else f'{text[:limit // 2]} ... {text[-limit // 2:]}'


def _cut(frames: Optional[TracebackType], before: Optional[TracebackType]) -> None:
    """Take the frames of the times before out of the traceback of an exception that is raised again
    and again: it collects them."""
    while frames is not None and frames.tb_next is not before:
        frames = frames.tb_next
    if frames is not None:
        frames.tb_next = None


def _release(error: BaseException) -> None:
    """Have an exception hold on to nothing large: frames, causes, and what it was made of."""
    set_attribute = BaseException.__setattr__  # that of its class may refuse
    for name in '__traceback__', '__cause__', '__context__':
        set_attribute(error, name, None)
    set_attribute(error, 'args', tuple(map(_small, error.args)))
    for name, value in list(vars(error).items()):
        set_attribute(error, name, _small(value))
    for inner in getattr(error, 'exceptions', ()):  # of an ExceptionGroup
        _release(inner)
    if isinstance(error, (UnicodeEncodeError, UnicodeDecodeError)):
        if _small(error.object) is not error.object:
            error.object = error.object[:0]


def _small(value: Any) -> Any:
    """The value where it can hold nothing large, else what it was."""
    size = sys.getsizeof(value, 0)
    if size <= LARGE:
        if isinstance(value, (str, bytes, numbers.Number, type(None))):
            return value
        if type(value) is tuple:
            return tuple(map(_small, value))
        if isinstance(value, genpy.Message):
            return f'<{value._type}>'
    return f'<{type(value).__name__} of {size} bytes>'
