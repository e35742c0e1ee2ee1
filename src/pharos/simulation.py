"""Virtual time: the nodes of this process run as fast as the processor allows, in one order each time.

One thread has the turn. A thread gives the turn back when it sleeps, waits or ends. Then the thread
whose wait ends first gets the turn, and the time jumps to that end. The threads of servers take no
part: they wait as usual, and answer the thread that has the turn.

For the time of a simulation, Python's modules threading and time get other functions. All locks made
then are a Lock of this module; Python's events, conditions, semaphores and queues are made of locks.
"""
from __future__ import annotations

import contextlib
import functools
import itertools
import math
import queue
import random
import sys
import threading
import time
import traceback
from _queue import Empty, SimpleQueue  # in C: real ones, also in a simulation
from _thread import allocate_lock
from typing import Any, Callable
from unittest import mock

import numpy
import rosbag
from genpy import Time

from pharos.compose import composition
from pharos.errors import PharosError
from pharos.intraprocess import callback_queues
from pharos.intraprocess.links import runs
from pharos.live import service_client
from pharos.node import BlockNode
from pharos.private_rospy import run, tcpros, xmlrpc
from pharos.private_rospy.patches import patch
from pharos.shared_memory import sending
from pharos.waiting import wait

#: clock -> nanoseconds that a look takes: programs divide by the time since their last look; our own
#: waits for servers look at monotonic, more or less often
READ_TIMES = {'time': 1000, 'perf_counter': 1000, 'monotonic': 0}
PLAYER = '/bag_player'  # the node that plays bags
LAST = math.inf  # the order of a wait that ends after all others that end at the same time
#: the functions of servers' threads are in these modules
SERVERS = (
    'rospy.impl',
    'rosgraph',
    'socketserver',
    'pharos.private_rospy',
    'pharos.shared_memory',
    'pharos.compose.child_process',
    'pharos.compose.control',
)

_sleep = time.sleep
_start = threading.Thread.start
_join = threading.Thread.join
_is_alive = threading.Thread.is_alive
_let_servers_run = functools.partial(_sleep, 1e-6)
_simulation: Any = None  # the Simulation that goes on, or None


class _Local(threading.local):
    thread: Any = None  # the Thread, if it has taken part in a simulation


_local = _Local()


def takes_part():
    """True if this thread takes part in the simulation that goes on."""
    thread = _local.thread
    return thread and thread.simulation is _simulation


class Lock:
    """A lock. A thread that takes part waits for others that do in virtual time.

    If a server holds the lock, the thread keeps its turn: servers hold locks briefly. "Member" is short for
    a thread that takes part: only such a thread keeps a lock while it waits for the time. A release gives
    no turn away, unless a thread that takes no part releases while nobody has the turn.
    """

    def __init__(self):
        self._lock = allocate_lock()
        self.locked = self._lock.locked
        self._is_held_by_member = False

    def acquire(self, blocking=True, timeout=-1):
        simulation = _simulation
        end = math.inf
        if simulation and timeout >= 0:
            end = simulation.time_after(timeout)
        while not self._lock.acquire(False):
            if blocking and takes_part() and self._is_held_by_member:
                if simulation.nanoseconds >= end:
                    return False
                simulation.wait(end, lock=self)
            elif self._lock.acquire(blocking, timeout):
                break
            else:
                return False
        self._is_held_by_member = takes_part()
        return True

    def release(self):
        self._is_held_by_member = False
        self._lock.release()
        if _simulation and not takes_part():
            _simulation.give_free_turn()

    def __enter__(self):
        self.acquire()

    def __exit__(self, *error):
        self.release()

    _at_fork_reinit = __init__


def start_thread(thread):
    """Stand in for ``Thread.start``: the thread takes part, unless it is a server's."""
    block = thread._target or type(thread).run
    module = str(getattr(block, 'func', block).__module__)
    starter = _local.thread
    # while it takes part, the starter would give its turn away when _start() waits for the new thread
    _local.thread = None
    if module.startswith(SERVERS):
        _start(thread)
    else:
        _simulation.prepare(thread)
        thread.run = functools.partial(_simulation.run_thread, thread, thread.run)
        _start(thread)
        _simulation.add_wait(thread, _simulation.nanoseconds)
    _local.thread = starter


def join_thread(thread, timeout=None):
    """Stand in for ``Thread.join``: wait in virtual time, as the module time now does."""
    deadline = math.inf if timeout is None else time.monotonic() + timeout
    while not getattr(thread, 'has_ended', True):
        if time.monotonic() >= deadline:
            return
        time.sleep(0.01)
    _join(thread, timeout)


def is_alive(thread):
    """Stand in for ``Thread.is_alive``: a thread that has given its last turn away is not alive."""
    return not getattr(thread, 'has_ended', not _is_alive(thread))


def read_all_parameters(changed_run, key, read_parameters=run.Run.read_parameters):
    """Stand in for ``Run.read_parameters``: have the parameters of all nodes read.

    The master would tell the other nodes at no fixed time.
    """
    for each in list(runs.values()):
        read_parameters(each, key)


@patch('rospy.rostime', 'get_rostime')
def get_rostime(original, run):
    """rospy makes the time from a float, which is not exact. Virtual time has whole nanoseconds."""
    if not _simulation:
        return original()
    time.time()  # this look at the clock takes some time
    return run.modules.by_name['rospy.rostime'].Time(0, _simulation.nanoseconds)


@patch('rospy.impl.simtime', '_is_use_simtime')
def is_use_simtime(original, run):
    """rospy waits for /clock if /use_sim_time is set. Virtual time needs no /clock."""
    return not _simulation and original()


@patch('rospy.topics', '_PublisherImpl.publish')
def publish(original, run, publisher, message, *options, **more):
    """rospy only sends. This also records what a node sends, if the simulation shall."""
    original(publisher, message, *options, **more)
    record = _simulation and _simulation.record
    if record and run.name != PLAYER and publisher.name != '/rosout':
        record(publisher.name, message, Time(0, _simulation.nanoseconds))


class Simulation:
    """Virtual time, in a ``with``, for this thread and for all nodes that the process starts there.

    :ivar nanoseconds: the ROS time
    :ivar lost: the names of threads that waited for something else than time and threads, or computed
        without end, and so lost the turn: what follows may come in another order another time
    :ivar record: None, or ``record(topic, message, time)``, called with what the nodes publish
    """

    allows_waits = False
    record: Any = None
    _looks = 0  # at the thread with the turn, since it got the turn
    _cpu_time = 0.0

    def __init__(self, master):
        self.master = master
        self.nanoseconds = 1_000_000_000_000_000_000  # a time with as many digits as those of today
        self.lost: list[str] = []
        self._owner: Any = threading.current_thread()
        self._holder: Any = self._owner  # the thread with the turn
        self._lock = allocate_lock()  # held while the turn changes
        self._waits: dict[Any, Any] = {}  # thread -> its wait: (end, order, Lock or None)
        self._orders = itertools.count()
        self._stack = contextlib.ExitStack()
        self.seed(0)

    def seed(self, number: int) -> None:
        """Have each sleep last a little longer, by chance, and programs get other random numbers.

        :param number: 0: each sleep ends when due; of those due at one time, the first to begin is first
        """
        self.seed_number = number
        self._random = random.Random(number)
        random.seed(number)
        numpy.random.seed(number)

    @property
    def now(self) -> float:
        """The ROS time, in seconds."""
        return self.nanoseconds / 1e9

    def allow_waits(self) -> None:
        """Let threads wait for something else than time and threads."""
        self.allows_waits = True

    def run(self, seconds: float) -> None:
        """Let so many seconds of ROS time go by."""
        self.wait(self.time_after(seconds), LAST)

    def run_until(self, predicate: Callable[[], Any], limit: float) -> Any:
        """Let the time go on until ``predicate()`` is true, for ``limit`` seconds at most.

        :returns: the last value of ``predicate()``, which is called every 20 ms at least, in turn with
            the other threads
        """
        return wait(predicate, limit)

    def play(self, bag: str, topics: list[str] | None = None) -> None:
        """Publish the messages of a bag, each when all before it is done; return at its end.

        The time jumps to one second before the begin of the bag. If that has passed, the bag is played
        from now on; the stamps in its messages stay.

        :raises PharosError: if the bag has no message of one of these topics
        """
        with rosbag.Bag(bag) as file, self.master.create(BlockNode, PLAYER) as player:
            if not all(map(file.get_message_count, topics or [None])):  # type: ignore
                raise PharosError(f'{bag} has no messages of one of {topics}: see rosbag info')
            player.connect_timeout = 0  # a wait for a socket would take another time in each run
            start = round(file.get_start_time() * 10**9)
            delay = max(0, self.nanoseconds - start)
            self.nanoseconds = max(self.nanoseconds, start - 10**9)
            channels = {}
            for topic, message, stamp, header in file.read_messages(
                topics, return_connection_header=True
            ):
                self.wait(stamp.to_nsec() + delay, LAST)
                key = topic, header.get('callerid')  # several nodes may latch a message each
                if key not in channels:
                    channels[key] = player.output_channel(
                        topic, type(message), header.get('latching') == b'1'
                    )
                channels[key].send(message)
            self.run(0)

    # -- the turn

    def time_after(self, seconds):
        """Return the time in so many seconds, in nanoseconds."""
        return self.nanoseconds + round(seconds * 10**9)

    def wait(self, end, order=None, lock=None):
        """Give the turn back, and wait until this thread gets the turn again.

        :param end: the time when the wait ends, in nanoseconds
        :param lock: a Lock; the wait ends when the lock is free
        """
        thread = _local.thread
        self.add_wait(thread, end, order, lock)
        # seconds between two looks for a thread that keeps the turn; the owner alone looks
        period = 0.5 if thread is self._owner else None
        while True:
            try:
                return thread.turns.get(timeout=period)
            except Empty:
                self._look()

    def add_wait(self, thread, end, order=None, lock=None):
        """Have a thread wait, as :meth:`wait` says; if it has the turn, another thread gets it."""
        if order is None:
            order = next(self._orders)
            if self.seed_number:
                end += self._random.randrange(10**6)  # up to 1 ms
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
            self._looks = 0
            thread.turns.put(None)

    def prepare(self, thread):
        """Give a thread its attributes: the turn comes by a queue."""
        thread.simulation = self
        thread.has_ended = False
        thread.turns = SimpleQueue()

    def run_thread(self, thread, block):
        """Run the block of a thread, once the thread has the turn."""
        _local.thread = thread
        thread.turns.get()
        try:
            block()
        finally:
            thread.has_ended = True
            _local.thread = None
            with self._lock:
                if self._holder is thread:  # else it has lost the turn
                    self._give_turn()

    def sleep(self, seconds):
        """Stand in for ``time.sleep``; a module may keep the function for a later simulation."""
        if takes_part():
            # sleep(0) takes some time, too, or it would stop the time
            _simulation.wait(_simulation.time_after(max(seconds, 1e-4)))
        else:
            _sleep(seconds)

    def _look(self):
        """Take the turn from a thread that waits for something else, or computes without end.

        A thread in a call of XML-RPC keeps the turn: the master may take long beside load, and the call
        has a limit of its own.
        """
        cpu_time = time.process_time()
        is_idle = cpu_time < self._cpu_time + 0.01  # seconds of all threads since the last look
        self._cpu_time = cpu_time
        with self._lock:
            self._looks += 1
            thread = self._holder
            # three: beside load, a process may get no processor for the time of one look
            limit = 3 if is_idle else 120
            if self._looks < limit or thread in (None, self._owner):
                return
            frames = traceback.walk_stack(sys._current_frames()[thread.ident])
            if any(frame.f_code.co_filename == xmlrpc.__file__ for frame, _ in frames):
                return
            self.lost.append(thread.name)
            self._give_turn()

    # -- the change of this process

    def __enter__(self):
        global _simulation
        clocks = {
            name: functools.partial(self._time, getattr(time, name), read_time)
            for name, read_time in READ_TIMES.items()
        }
        monotonic = clocks['monotonic']
        changes: dict[Any, dict[str, Any]] = {
            time: {**clocks, 'sleep': self.sleep},
            threading: {
                'Lock': Lock,
                '_allocate_lock': Lock,
                '_CRLock': None,  # then threading makes its RLocks in Python, of Locks
                '_time': monotonic,
            },
            threading.Thread: {
                'start': start_thread,
                'join': join_thread,
                'is_alive': is_alive,
            },
            queue: {'SimpleQueue': queue._PySimpleQueue, 'time': monotonic},  # type: ignore
            callback_queues: {
                'allocate_lock': Lock,
                'perf_counter': monotonic,
                '_no_yield_before': 0.0,  # a virtual time is too late for the real clock
            },
            run: {'monotonic': monotonic},
            run.Run: {'read_parameters': read_all_parameters},
            # senders' threads are real ones
            sending: {'let_others_run': _let_servers_run},
            tcpros: {'let_others_run': _let_servers_run},
            service_client: {'ignores_timeout': True},
            # all programs run here
            composition: {
                'environment_of': lambda pairs: (),
                'sets_environment': lambda path: '',
            },
            composition.Composition: {'_start_part': _refuse_part},
        }
        for owner, values in changes.items():
            self._stack.enter_context(mock.patch.multiple(owner, **values))
        self.prepare(self._owner)
        _local.thread = self._owner
        _simulation = self
        return self

    def __exit__(self, *error):
        global _simulation
        _simulation = None
        self._stack.close()
        for thread in self._waits:
            thread.turns.put(None)

    def _time(self, clock, read_time):
        """Return the time in seconds: virtual to threads that take part, that of a clock to others."""
        if not takes_part():
            return clock()
        # rospy logs how it connects to other processes, more or less each time
        if sys._getframe(1).f_globals['__name__'] != 'logging':
            _simulation.nanoseconds += read_time
        return _simulation.now


def _refuse_part(composition, entries, *rest):
    raise PharosError(
        f'{", ".join(entry.name for entry in entries)}: has a process of its own, which knows no virtual'
        ' time; leave it out by only= or --only; if it has a window alone, name it in here= or --here'
    )
