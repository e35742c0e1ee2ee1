"""Virtual time: the nodes of this process run as fast as the processor allows, in one order each time.

One thread has the turn. A thread gives the turn back when it sleeps, waits or ends. Then the thread
whose wait ends first gets the turn, and the time jumps to that end. The threads of servers take no
part: they wait as usual, and answer the thread that has the turn.
"""
from __future__ import annotations

import contextlib
import itertools
import math
import os
import random
import sys
import tempfile
import threading
import time
import traceback
from _queue import Empty, SimpleQueue  # in C: real ones, also in a simulation
from _thread import allocate_lock
from typing import Any, Callable, Iterator
from unittest import mock

import numpy
import rosbag
from genpy import Time

from pharos.errors import PharosError
from pharos.node import BlockNode
from pharos.private_rospy import xmlrpc
from pharos.simulation import stand_ins
from pharos.simulation.stand_ins import PLAYER, local
from pharos.waiting import wait

#: nanoseconds that a look at a clock takes: programs divide by the time since their last look. Those of
#: stand_ins.FREE_LOOKS take none
LOOK = 1000
#: nanoseconds of looks after which a thread gives its turn back: it waits by looks
LOOKS_LIMIT = 1_000_000
FREE_ASKS = 10  # in a turn: a loop that asks for the end and sleeps keeps its rate
LONGEST_LOOK = 64_000  # nanoseconds: the looks of a thread that waits by looks become longer
#: modules with a wait that keeps the turn: the master may take long beside load, and its calls have a
#: limit of their own; at the prompt of a debugger, all stands still
KEEP_TURN = xmlrpc.__name__, 'bdb'
#: seconds between two messages of a bag: in a longer one, nodes would compute for hours
MAX_GAP = 86400
JITTER = 0.03  # seconds
LAST = math.inf  # the order of a wait that ends after all others that end at the same time


class Simulation:
    """Virtual time, in a ``with``, for this thread and for all nodes that the process starts there.

    :ivar nanoseconds: the ROS time
    :ivar begin: the ROS time at the begin, in nanoseconds
    :ivar lost: the names of threads that waited for something else than time and threads, or computed
        without end, and so lost the turn, or had a slow child: what follows may come in another order
        another time
    :ivar record: None, or the bag that gets what the nodes publish
    """

    allows_waits = False
    record: Any = None
    launch_file = bag = ''
    _looks = 0  # at the thread with the turn, since it got the turn
    _idle_looks = 0  # the last ones, at which it slept
    _asks = 0  # by that thread, whether it shall end
    _cpu_time = 0.0
    on_turn: Any = None  # None, or called in each thread but the owner that gets the turn
    _on_wait: Any = None  # None, or called in each thread that gives it back
    _error: Any = None  # of the record
    _turn_begin = 0  # when the thread with the turn got it

    def __init__(self, master):
        self.master = master
        self.nanoseconds = 1_000_000_000_000_000_000  # a time with as many digits as those of today
        self.begin = self.nanoseconds
        self.lost: list[str] = []
        self._owner: Any = threading.current_thread()
        self._holder: Any = self._owner  # the thread with the turn
        self._lock = allocate_lock()  # held while the turn changes
        self.last_messages: dict[str, Any] = {}  # topic -> message
        # thread -> its wait: (end, order, what it waits for, or None)
        self._waits: dict[Any, Any] = {}
        self._orders = itertools.count()
        self._stack = contextlib.ExitStack()
        self.seed(0)

    def seed(self, number: int, jitter: float = JITTER) -> None:
        """Have each sleep, start of a thread and wait with a limit last a little longer, by chance.

        Programs get other random numbers. They start later, too, by up to 30 times the longest delay of
        a sleep.

        :param number: 0: each sleep ends when due; of those due at one time, the first to begin is first
        :param jitter: the longest delay of a sleep, in seconds; each size is as probable as ten times it
        """
        self.seed_number = number
        self.jitter = jitter
        self.random = random.Random(number)
        random.seed(number)
        numpy.random.seed(number)

    @property
    def now(self) -> float:
        """The ROS time, in seconds."""
        return self.nanoseconds / 1e9

    def allow_waits(self) -> None:
        """Let threads wait for something else than time and threads."""
        self.allows_waits = True

    @contextlib.contextmanager
    def expect(self, bag: str, tolerance: float = 0.0) -> Iterator[None]:
        """Compare what the nodes publish in this ``with`` with a recording; make one if there is none.

        :param tolerance: numbers may differ by so much, and times by so many seconds
        :raises AssertionError: with the first difference of each topic; or that the recording is new
        """
        from pharos.simulation.comparing import differences

        is_new = not os.path.exists(bag)
        with tempfile.TemporaryDirectory() as folder:
            actual = bag if is_new else f'{folder}/actual.bag'
            self.record_to(actual)
            try:
                yield
            finally:
                self.close_record()
            lines = differences(bag, actual, self.begin / 1e9, tolerance, self.seconds)
        if is_new:
            lines = [f'{bag} was not there: it is recorded now']
        if lines:
            raise AssertionError('\n'.join(lines))

    def record_to(self, path: str) -> None:
        """Write what the nodes publish to a new bag, until :meth:`close_record`.

        :raises PharosError: if the file cannot be made
        """
        with _named(path):
            self.record = rosbag.Bag(path, 'w')

    def close_record(self) -> None:
        """End the bag of :meth:`record_to`.

        :raises PharosError: if the file cannot be written
        """
        bag, self.record = self.record, None
        if bag:
            with _named(bag.filename):
                bag.close()

    def record_message(self, publisher, message):
        """Write a message to the bag, if there is one; end the run if that cannot be written.

        Of each topic, the bag has the connection header of its first publisher.
        """
        if self.record:
            publisher.make_header()
            stamp = Time(0, self.nanoseconds)
            try:
                with _named(self.record.filename):
                    self.record.write(
                        publisher.name, message, stamp, connection_header=publisher.header
                    )
            except PharosError as error:
                self.fail(error)

    def run(self, seconds: float) -> None:
        """Let so many seconds of ROS time go by, from now on; what is due at their end happens, too."""
        self.wait(self.time_after(seconds), LAST)

    @property
    def seconds(self) -> float:
        """The time since the begin, in seconds."""
        return (self.nanoseconds - self.begin) / 1e9

    def command(self) -> str:
        """Return the command that goes to this second of the launch file, '' without one."""
        if not self.launch_file:
            return ''
        options = f'{self.bag}--seed {self.seed_number} --at {self.seconds:.3f}'
        return f'rosrun pharos compose {options} {self.launch_file}'

    def at(self, seconds: float) -> None:
        """Go on to that time, in seconds since the begin, as ``compose --for`` and ``--at`` do.

        :raises ValueError: if it has passed
        """
        if seconds < self.seconds:
            raise ValueError(f'{seconds} s have passed: it is {self.seconds:.3f} s')
        self.wait(self.begin + round(seconds * 10**9), LAST)

    def run_to(self, predicate: Callable[[], Any], limit: float) -> bool:
        """Let the time go on to the first moment at which ``predicate()`` is true, for the prompt.

        :param predicate: called in all threads, whenever one gives its turn back
        :param limit: seconds
        :returns: False if it does not become true
        """
        results: list[Any] = [predicate()]

        def look():
            try:
                results.append(predicate())
            except Exception as error:
                results.append(error)
            if results[-1]:
                self._on_wait = None
                self.wake()

        if not results[0]:
            self._on_wait = look
            self.run(limit)
            self._on_wait = None
        if isinstance(results[-1], Exception):
            raise results[-1]
        return bool(results[-1])

    def run_until(self, predicate: Callable[[], Any], limit: float) -> Any:
        """Let the time go on until ``predicate()`` is true, for ``limit`` seconds at most.

        :returns: the last value of ``predicate()``, which is called at once, after 2 ms, 2.4 ms, and so on up to every
            20 ms (with a seed, a jitter later), in turn with the other threads
        """
        return wait(predicate, limit)

    def play(self, bag: str, topics: list[str] | None = None) -> None:
        """Publish the messages of a bag, each when all before it is done; return at its end.

        The time jumps to one second before the begin of the bag. If the begin has passed, the bag is
        played from now on; the stamps in its messages stay.

        :raises PharosError: if the bag has no message of one of these topics, is damaged, or has a gap of
            more than a day
        """
        self.bag = f'--bag {bag} '
        with open_bag(bag) as file, self.master.create(BlockNode, PLAYER) as player:
            if not all(map(file.get_message_count, topics or [None])):  # type: ignore
                raise PharosError(f'{bag} has no messages of one of {topics}: see rosbag info')
            player.connect_timeout = 0  # a wait for a socket would take another time in each run
            start = round(file.get_start_time() * 10**9)
            delay = max(0, self.nanoseconds - start)
            self.nanoseconds = max(self.nanoseconds, start - 10**9)
            channels = {}
            for topic, message, stamp, header in _read(bag, file, topics):
                self.wait(stamp.to_nsec() + delay, LAST)
                key = topic, header.get('callerid')  # several nodes may latch a message each
                if key not in channels:
                    channels[key] = player.output_channel(
                        topic, type(message), header.get('latching') == b'1'
                    )
                channels[key].send(message)
            self.run(0)

    def deadlocks(self) -> list[str]:
        """Return the threads that wait for each other's locks for ever: the name of each, its file and line.

        One that waits for the lock of an ended thread is among them. Events and queues do not count.
        """
        locks = {}
        for thread, (end, _, lock) in list(self._waits.items()):
            if end == math.inf and getattr(lock, 'holder', None) and _place_of(thread):
                locks[thread] = lock
        for _ in tuple(locks):  # in each round, those go whose lock may become free
            locks = {
                thread: lock
                for thread, lock in locks.items()
                if lock.holder in locks or lock.holder.has_ended
            }
        return [f'{thread.name} at {_place_of(thread)}' for thread in locks]

    # -- the turn

    def time_after(self, seconds):
        """Return the time in so many seconds, in nanoseconds."""
        return seconds if seconds == math.inf else self.nanoseconds + round(seconds * 10**9)

    def wait(self, end, order=None, lock=None):
        """Give the turn back, and wait until this thread gets the turn again.

        :param end: the time when the wait ends, in nanoseconds
        :param lock: a Lock or files; the wait ends when ``lock.locked()`` is false
        """
        thread = local.thread
        if self._on_wait:
            self._on_wait()
        self.add_wait(thread, end, order, lock)
        # seconds between two looks for a thread that keeps the turn; the owner alone looks
        period = 0.5 if thread is self._owner else None
        while True:
            try:
                thread.turns.get(timeout=period)
                break
            except Empty:
                self._look()
        if self._error and thread is self._owner:
            raise self._error
        if self.on_turn and thread is not self._owner:
            self.on_turn()

    def fail(self, error):
        """End the run: have the wait of the owner raise an error, at once."""
        self.record = None  # not closed: rosbag of Debian 11 would write to a full disk for ever
        self._error = error
        self.wake()

    def wake(self):
        """End the wait of the owner now: it gets the next turn."""
        with self._lock:
            if self._owner in self._waits:
                self._waits[self._owner] = self.nanoseconds, -1, None

    def add_wait(self, thread, end, order=None, lock=None):
        """Have a thread wait, as :meth:`wait` says; if it had the turn, the first in line gets the turn."""
        if order is None:
            thread.look = LOOK
            order = next(self._orders)
            if self.seed_number:
                end += round(10 ** self.random.uniform(3, 9 + math.log10(max(self.jitter, 1e-6))))
        with self._lock:
            self._waits[thread] = end, order, lock
            if self._holder in (thread, None):
                self._give_turn()

    def give_free_turn(self):
        """If nobody has the turn, give it: a thread that takes no part has released a lock."""
        with self._lock:
            if not self._holder:
                self._give_turn()

    def _give_turn(self):
        """Give the turn to the thread whose wait ends first, or to nobody."""
        self._holder = None
        waits = []
        for thread, (end, order, lock) in self._waits.items():
            if lock and not lock.locked():
                end = self.nanoseconds
            if end < math.inf:
                waits.append((end, order, thread))
        if waits:
            end, _, thread = min(waits)
            del self._waits[thread]
            self.nanoseconds = max(self.nanoseconds, end)
            self._holder = thread
            self._looks = self._idle_looks = self._asks = 0
            self._turn_begin = self.nanoseconds
            thread.turns.put(None)

    def look(self):
        """Have a look at a clock take some time."""
        thread = local.thread
        self.nanoseconds += thread.look
        if self.nanoseconds > self._turn_begin + LOOKS_LIMIT:
            thread.look = min(2 * thread.look, LONGEST_LOOK)
            self.wait(self.nanoseconds, next(self._orders))

    def ask(self):
        """Have a question for the end take some time, unless it is one of the first of a turn."""
        self._asks += 1
        if self._asks > FREE_ASKS:
            self.look()

    def prepare(self, thread):
        """Give a thread its attributes: the turn comes by a queue.

        ``look`` is the number of nanoseconds that its next look at a clock takes.
        """
        thread.simulation = self
        thread.look = LOOK
        thread.has_ended = False
        thread.turns = SimpleQueue()

    def run_thread(self, thread, block):
        """Run the block of a thread, once the thread has the turn."""
        local.thread = thread
        thread.turns.get()
        try:
            if self.on_turn:
                self.on_turn()
            block()
        finally:
            if self._on_wait:
                self._on_wait()
            thread.has_ended = True
            local.thread = None
            with self._lock:
                if self._holder is thread:  # else it has lost the turn
                    self._give_turn()

    def _look(self):
        """Take the turn from a thread that waits for something else, or computes without end."""
        cpu_time = time.process_time()
        is_idle = cpu_time < self._cpu_time + 0.01  # seconds of all threads since the last look
        self._cpu_time = cpu_time
        with self._lock:
            thread = self._holder
            self._looks += 1
            # beside load, a process may get no processor for the time of some looks
            self._idle_looks = self._idle_looks + 1 if is_idle and _others_sleep() else 0
            is_over = self._idle_looks >= 3 or self._looks >= 120
            deadlocks = self.deadlocks()
            if not thread and deadlocks and is_over:
                self._holder = self._owner
                del self._waits[self._owner]
                raise PharosError(f'threads wait for a lock for ever: {deadlocks}')
            if not is_over or thread in (None, self._owner):
                return
            frames = traceback.walk_stack(sys._current_frames()[thread.ident])
            if any(frame.f_globals.get('__name__') in KEEP_TURN for frame, _ in frames):
                return
            self.lost.append(thread.name)
            self._give_turn()

    # -- the change of this process

    def resume(self):
        """Make this process one of virtual time."""
        for owner, values in stand_ins.changes().items():
            self._stack.enter_context(mock.patch.multiple(owner, **values))
        stand_ins.set_current(self)

    def pause(self):
        """Give this process its own functions back, while all threads that take part stand still."""
        stand_ins.set_current(None)
        self._stack.close()

    def __enter__(self):
        self.prepare(self._owner)
        local.thread = self._owner
        self.resume()
        return self

    def __exit__(self, *error):
        self.pause()
        for thread in self._waits:
            thread.turns.put(None)


@contextlib.contextmanager
def _named(path):
    """Name the file in an error of the system."""
    try:
        yield
    except OSError as error:  # such as a full disk
        raise PharosError(f'{path} cannot be written: {error}') from error


def open_bag(path):
    """Open a bag to read it.

    :raises PharosError: if the file is not there, or is not a bag
    """
    try:
        return rosbag.Bag(path)
    except (OSError, rosbag.ROSBagException) as error:
        raise PharosError(f'{path} cannot be played: {error}; see ls and rosbag info') from error


def _read(path, bag, topics):
    """Yield the messages of a bag, as rosbag does."""
    last = math.inf
    try:
        for item in bag.read_messages(topics, return_connection_header=True):
            gap = item.timestamp.to_sec() - last
            if gap > MAX_GAP:
                raise PharosError(
                    f'{path} has a gap of {gap / 86400:.0f} days after {last} s: cut it by rosbag filter'
                )
            last = item.timestamp.to_sec()
            yield item
    except (OSError, EOFError, ValueError, rosbag.ROSBagException) as error:
        raise PharosError(f'{path} is damaged after {last} s: {error}; see rosbag check') from error


def _others_sleep():
    """False if another thread of this process waits for the processor or a disk, perhaps a server's."""
    states = set()
    for thread_id in set(os.listdir('/proc/self/task')) - {str(threading.get_native_id())}:
        with contextlib.suppress(OSError):  # it has ended
            with open(f'/proc/self/task/{thread_id}/stat') as file:
                states.add(file.read().rpartition(')')[2].split()[0])
    return states.isdisjoint('RD')


def _place_of(thread):
    """Return the file and line at which a thread waits for a lock; '' if it waits for an event or a queue."""
    for frame, line in traceback.walk_stack(sys._current_frames()[thread.ident]):
        module = frame.f_globals.get('__name__', '')
        if module == 'threading' and frame.f_code.co_name == 'wait':
            return ''
        if module.startswith('pharos.') and not module.startswith('pharos.simulation'):
            return ''
        if not module.startswith(('threading', 'pharos.')):
            return f'{frame.f_code.co_filename}:{line}'
    return ''
