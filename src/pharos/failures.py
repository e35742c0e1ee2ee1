"""What blocks raised: kept, counted, told once, and run again."""
import collections
import collections.abc
import sys
import threading
import time
import traceback

import genpy

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

    :attr:`error` is the exception, :attr:`block` what raised it, :attr:`message` what the block was
    run on (a message, a service's request, a parameter's value; None for a soul), :attr:`channel`
    where that came from (None where it is no message), :attr:`count` how many times it came, and
    :attr:`time` when that was last, in seconds as of ``time.time()``; error and message are of that
    time. Failures are identical, and one, where block, channel, class and text of the exception,
    and the line that raised it, are the same.

    Of the newest 5 failures of a node, message and frames are kept; of older ones the text of the
    :attr:`traceback`.
    """

    def __init__(self, failures, block, where, channel, place, text):
        self.block, self.channel, self.text = block, channel, text
        self.error = self.message = self.time = None
        self.count = 0
        self._failures, self._where, self._place = failures, where, place
        self._frames = self._again = None
        self._had_message = False
        self._traceback = None  # the text of what was let go

    def _happened(self, error, message, again):
        if error is self.error:  # one raised again and again collects the frames of each time
            _cut(error.__traceback__, self._frames)
        self.error, self.message, self._frames = error, message, error.__traceback__
        self._again, self._traceback = again, None
        self._had_message = message is not None
        self.time = time.time()
        self.count += 1

    def _let_go(self):
        """Keep nothing large: no message, and of the frames the text."""
        if self._traceback is None:
            self._traceback = self.traceback
            self.message = self._frames = None
            attempt(lambda: _release(self.error))

    @property
    def is_whole(self):
        """Whether its message and frames are kept still."""
        return self._traceback is None

    @property
    def traceback(self):
        """The traceback, as text."""
        return _formatted(self.error, self._frames) if self.is_whole else self._traceback

    def retry(self):
        """Run the block again, as it is now, on the same message; returns whether it did not fail.

        A delegate, which may have been replaced since, runs when no other of its node does; other
        blocks run at once, all of them in this thread. What it raises is a failure like any other,
        and told in any case.

        :raises PharosError: if the message has been let go, or the block cannot be run again
        """
        if self._again is None:
            raise PharosError(f'{self._where} cannot be run again: do by hand what made it run')
        if not self.is_whole and self._had_message:
            raise PharosError(
                f'{self._where} cannot be run again: messages are kept of the newest '
                f'{WHOLE} failures of a node only; retry() one of those'
            )
        return self._failures._retry(self)

    def debug(self):
        """Look at the frames in which it was raised: ``pdb.post_mortem``.

        :raises PharosError: if they have been let go
        """
        if self._frames is None:
            raise PharosError(
                f'the frames of this failure of {self._where} are gone: they are kept '
                f'of the newest {WHOLE} failures of a node only; debug() one of those, '
                'or read its .traceback'
            )
        import pdb  # only here: it is slow to import

        pdb.post_mortem(self._frames)

    def __repr__(self):
        times = f', {self.count} times' if self.count > 1 else ''
        return f'<Failure of {self._where}: {type(self.error).__name__}: {self.text}{times}>'


class Errors(collections.abc.Sequence):
    """The exceptions of failures, the newest last.

    Who has seen to them may ``pop`` or ``clear`` them.
    """

    def __init__(self, failures):
        self._failures = failures

    def __getitem__(self, index):
        return [failure.error for failure in self._failures.all()][index]

    def __len__(self):
        return len(self._failures.all())

    def __iter__(self):
        return iter(self[:])

    def pop(self, index=-1):
        """Take one of them out, the newest by default, and return it."""
        failure = self._failures.all()[index]
        self._failures.forget(failure)
        return failure.error

    def clear(self):
        """Take all of them out."""
        for failure in self._failures.all():
            self._failures.forget(failure)

    def __repr__(self):
        return repr(self[:])


class Failures:
    """The failures of the blocks of one node, or of something else that runs blocks; for any
    thread.

    :param tell: called as ``tell(line, details)`` for those that are worth it; what it raises
        changes nothing
    """

    def __init__(self, tell):
        self._tell = tell
        # an RLock: what is freed, or shown as text, may run code of the user's
        self._lock = threading.RLock()
        self._kept = {}  # (place, text) -> Failure, the newest last
        self._first = None
        self._times = collections.Counter()  # place -> how many failures there were at it
        self._texts = collections.Counter()  # place -> of how many texts of them was told
        self._retrying = threading.local()  # .failed: whether what the thread runs again has
        self.count = 0  # of all failures, identical ones too
        self.errors = Errors(self)

    def all(self):
        """The failures that are kept, the newest last."""
        with self._lock:
            return list(self._kept.values())

    def forget(self, failure):
        """Somebody has seen to it."""
        with self._lock:
            self._kept.pop((failure._place, failure.text), None)
            del self._times[failure._place], self._texts[failure._place]
            if failure is self._first:
                self._first = None

    def report(self, error, block, where, channel=None, message=None, again=None):
        """Keep a failure of a block, and tell of it if it is new.

        Raises nothing but what a signal raises.

        :param where: how it is told, such as 'delegate on_pose of /node on /pose'
        :param again: ``again(message)`` runs the block as it is then, and reports what it raises
        """
        if is_from_signal(error):
            raise error
        attempt(lambda: self._report(error, block, where, channel, message, again))

    def _report(self, error, block, where, channel, message, again):
        text, frames = _brief(text_of(error)), error.__traceback__
        # The code tells a block from the one that it replaces, typed anew at the prompt perhaps,
        # but not two closures. Not the channel itself, which may be closed, and should not be kept
        # for being counted.
        place = where, attempt(lambda: code_of(block)), id(channel), type(error), _raised_at(frames)
        with self._lock:
            failure = self._kept.pop((place, text), None)
            is_new = failure is None
            if is_new:
                failure = Failure(self, block, where, channel, place, text)
            if self._first is None:
                self._first = failure
            self._kept[place, text] = failure
            failure._happened(error, message, again)
            self._make_room()
            self.count += 1
            times, is_told = self._count_at(place, is_new)
        if getattr(self._retrying, 'failed', None) is not None:
            self._retrying.failed = is_told = True
        raised = f'{where} raised {type(error).__name__}'
        if is_told:
            # what nobody raised has no traceback but its text, which is in the line
            has_more = frames or error.__cause__ or error.__context__
            self._tell(f'{raised}: {text}', _formatted(error, frames) if has_more else '')
        elif times >= 10 and str(times).strip('0') == '1':
            different = '' if failure.count == times else ', with different texts'
            self._tell(f'{raised}: {text}, {times} times by now{different}', '')

    def _count_at(self, place, is_new):
        """Count a failure; returns how many there were at its place, and whether it is to be
        told."""
        self._times[place] += 1
        is_told = is_new and self._texts[place] < TEXTS
        if is_told:
            self._texts[place] += 1
        if len(self._times) > PLACES:
            oldest = next(iter(self._times))
            del self._times[oldest], self._texts[oldest]
        return self._times[place], is_told

    def _make_room(self):
        """Let go what is large but of the newest; of too many, one of those that are most alike."""
        kept = list(self._kept.values())
        if len(kept) > WHOLE:
            kept[-WHOLE - 1]._let_go()
        if len(kept) > KEPT:
            kept.remove(self._first)
            crowded, _ = collections.Counter(failure._place for failure in kept).most_common(1)[0]
            oldest = next(failure for failure in kept if failure._place == crowded)
            del self._kept[crowded, oldest.text]

    def _retry(self, failure):
        before, self._retrying.failed = getattr(self._retrying, 'failed', None), False
        try:
            failure._again(failure.message)
            return not self._retrying.failed
        finally:
            self._retrying.failed = before


def _raised_at(frames):
    """Which line raised it: (file, number)."""
    raised_at = None
    for frame, line in traceback.walk_tb(frames):
        raised_at = frame.f_code.co_filename, line
    return raised_at


def _formatted(error, frames):
    """A traceback as text."""
    lines = attempt(lambda: traceback.format_exception(type(error), error, frames))
    if lines is None:  # its __str__, or that of its cause, raises what traceback does not expect
        lines = attempt(lambda: traceback.format_tb(frames), [])
    return _brief(''.join(lines), 10 * TEXT_LIMIT)


def _brief(text, limit=TEXT_LIMIT):
    """The text, without its middle where it is too long."""
    return text if len(text) <= limit else f'{text[:limit // 2]} ... {text[-limit // 2:]}'


def _cut(frames, before):
    """Take the frames of the times before out of a traceback."""
    while frames is not None and frames.tb_next is not before:
        frames = frames.tb_next
    if frames is not None:
        frames.tb_next = None


def _release(error):
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


def _small(value):
    """The value, or what it was where it is large."""
    if isinstance(value, genpy.Message):
        return f'<{value._type}>'
    size = sys.getsizeof(value, 0)
    return value if size <= LARGE else f'<{type(value).__name__} of {size} bytes>'
