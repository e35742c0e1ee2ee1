"""Stand-ins for functions of Python and of this package, for the time of a simulation.

Python's modules threading and time get other functions. All locks made then are a Lock of this
module; Python's events, conditions, semaphores and queues are made of locks.
"""
from __future__ import annotations

import functools
import math
import queue
import sys
import threading
import time
from _thread import allocate_lock
from typing import Any

from genpy import Time

from pharos import service
from pharos.compose import composition
from pharos.errors import PharosError
from pharos.intraprocess import callback_queues
from pharos.intraprocess.links import runs
from pharos.private_rospy import run, tcpros
from pharos.private_rospy.patches import patch
from pharos.shared_memory import sending

#: clock -> nanoseconds that a look takes: programs divide by the time since their last look; our own
#: waits for servers look at monotonic, more or less often
READ_TIMES = {'time': 1000, 'perf_counter': 1000, 'monotonic': 0}
PLAYER = '/bag_player'  # the node that plays bags
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


local = _Local()


def set_current(simulation):
    """Begin a simulation, or end it: None."""
    global _simulation
    _simulation = simulation


def takes_part():
    """True if this thread takes part in the simulation that goes on."""
    thread = local.thread
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
    starter = local.thread
    # while it takes part, the starter would give its turn away when _start() waits for the new thread
    local.thread = None
    if module.startswith(SERVERS):
        _start(thread)
    else:
        _simulation.prepare(thread)
        thread.run = functools.partial(_simulation.run_thread, thread, thread.run)
        _start(thread)
        _simulation.add_wait(thread, _simulation.nanoseconds)
    local.thread = starter


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


def sleep(seconds):
    """Stand in for ``time.sleep``; a module may keep the function for a later simulation."""
    if takes_part():
        # sleep(0) takes some time, too, or it would stop the time
        _simulation.wait(_simulation.time_after(max(seconds, 1e-4)))
    else:
        _sleep(seconds)


def _time(clock, read_time):
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


def changes():
    """Return what a simulation changes: modules and classes -> names -> stand-ins."""
    clocks = {
        name: functools.partial(_time, getattr(time, name), read_time)
        for name, read_time in READ_TIMES.items()
    }
    monotonic = clocks['monotonic']
    return {
        time: {**clocks, 'sleep': sleep},
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
        service: {'ignores_timeout': True},
        # all programs run here
        composition: {
            'environment_of': lambda pairs: (),
            'sets_environment': lambda path: '',
        },
        composition.Composition: {'_start_part': _refuse_part},
    }
