"""Stand-ins for functions of Python and of this package, for the time of a simulation.

Python's modules threading and time get other functions. All locks made then are a Lock of this
module; Python's events, conditions, semaphores and queues are made of locks.
"""
from __future__ import annotations

import datetime
import functools
import math
import os
import queue
import random
import select
import selectors
import shlex
import sys
import threading
import time
from _thread import allocate_lock
from typing import Any


from pharos.compose import composition
from pharos.compose.script_run import ScriptRun
from pharos.errors import PharosError
from pharos.intraprocess.copier import copy_of
from pharos.intraprocess.links import runs
from pharos.live import service_client
from pharos.private_rospy import run
from pharos.private_rospy.loader import Shim
from pharos.private_rospy.patches import patch

CLOCKS = 'time', 'perf_counter', 'monotonic', 'time_ns', 'perf_counter_ns', 'monotonic_ns'
#: looks of these modules at a clock take no time: they come more or less often, as they wait for servers
FREE_LOOKS = 'logging', 'pharos.', 'threading', 'queue', 'subprocess', 'asyncio.'
START_DELAY = 30  # times the jitter: so much does a seed delay a program's start at most
CHILD_LIMIT = 1.5  # seconds that a child may compute while the time stands still
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
_monotonic = time.monotonic
_start = threading.Thread.start
_join = threading.Thread.join
_is_alive = threading.Thread.is_alive
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

    :ivar holder: the member that has taken the lock, or None
    """

    holder: Any = None

    def __init__(self):
        self._lock = allocate_lock()
        self.locked = self._lock.locked

    def acquire(self, blocking=True, timeout=-1):
        simulation = _simulation
        end = math.inf
        if simulation and timeout >= 0:
            end = simulation.time_after(timeout)
        while not self._lock.acquire(False):
            if blocking and takes_part() and self.holder:
                if simulation.nanoseconds >= end:
                    return False
                simulation.wait(end, lock=self)
            elif self._lock.acquire(blocking, timeout):
                break
            else:
                return False
        self.holder = local.thread if takes_part() else None
        return True

    def release(self):
        self.holder = None
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
    try:
        if module.startswith(SERVERS):
            _start(thread)
        else:
            _simulation.prepare(thread)
            thread.run = functools.partial(_simulation.run_thread, thread, thread.run)
            _start(thread)
            _simulation.add_wait(thread, _simulation.nanoseconds)
    finally:  # Ctrl-C may come meanwhile
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


class _NoMethod:
    """Calls a function with arguments, as functools.partial does; no method of a class that has it.

    logging has ``time.localtime`` in a class. (Python 3.14 makes a method of a partial.)
    """

    def __init__(self, function, *arguments):
        self._function = function
        self._arguments = arguments

    def __call__(self, *arguments):
        return self._function(*self._arguments, *arguments)


def _read_clock(clock, name):
    """Return the time: virtual to threads that take part, that of a clock to others."""
    if not takes_part():
        return clock()
    if not sys._getframe(2).f_globals.get('__name__', '').startswith(FREE_LOOKS):
        _simulation.look()
    return _simulation.nanoseconds if name.endswith('_ns') else _simulation.now


def _now():
    """Look at the clock for a program."""
    if takes_part():
        _simulation.look()
    return time.time()


def _split_time(function, seconds=None):
    """Stand in for ``time.localtime`` and functions like that: without an argument, it is now."""
    return function(_now() if seconds is None else seconds)


def _format_time(text, moment=None, function=time.strftime):
    """Stand in for ``time.strftime``."""
    return function(text, moment or time.localtime())


class _RealInstances(type):
    """The class of stand-ins for classes: their instances are those of the real class."""

    def _real(cls):
        return cls.__base__ if cls.__module__ == __name__ else cls

    def __instancecheck__(cls, instance):
        return type.__instancecheck__(cls._real(), instance)

    def __subclasscheck__(cls, subclass):
        return type.__subclasscheck__(cls._real(), subclass)

    def __call__(cls, *args, **kwargs):
        return type.__call__(cls._real(), *args, **kwargs)


class VirtualDatetime(datetime.datetime, metaclass=_RealInstances):
    """Stand in for ``datetime.datetime``, which reads a clock in C."""

    @classmethod
    def now(cls, tz=None):
        return cls.fromtimestamp(_now(), tz)

    @classmethod
    def utcnow(cls):
        return cls.fromtimestamp(_now(), datetime.timezone.utc).replace(tzinfo=None)


class VirtualDate(datetime.date, metaclass=_RealInstances):
    """Stand in for ``datetime.date``, which reads a clock in C."""

    @classmethod
    def today(cls):
        return cls.fromtimestamp(_now())


def substitutes(this_run, original=run.Run.substitutes):
    """Stand in for ``Run.substitutes``: what programs import has the virtual time, too."""
    module = Shim(datetime, datetime=VirtualDatetime, date=VirtualDate)
    return {**original(this_run), 'datetime': module}


def urandom(size, original=os.urandom):
    """Stand in for ``os.urandom``: random bytes by the seed of the simulation."""
    if not takes_part():
        return original(size)
    return _simulation.random.getrandbits(8 * size).to_bytes(size, 'little')


def seed(generator, number=None, version=2, original=random.Random.seed):
    """Stand in for ``Random.seed``: without a number, the seed of the simulation gives one."""
    if number is None and takes_part():
        number = _simulation.random.random()
    original(generator, number, version)


class _Files:
    """Files that a thread waits for, in the place of a Lock: locked until ``look()`` finds some ready."""

    def __init__(self, look):
        self.look = look

    def locked(self):
        try:
            return not any(self.look())
        except (OSError, ValueError):  # one is closed: the thread that waits gets the error
            return False


def wait_for_files(wait, timeout):
    """Wait in virtual time, and return ``wait(0)``; other threads wait as usual: ``wait(timeout)``.

    :param wait: waits for so many seconds, and returns lists that are not empty if files are ready
    """
    if not takes_part():
        return wait(timeout)
    files = _Files(functools.partial(wait, 0))
    if timeout <= 0:
        _simulation.look()
    elif files.locked():
        _simulation.wait(_simulation.time_after(timeout), lock=files)
    return wait(0)


def select_files(reads, writes, errors, timeout=None, original=select.select):
    """Stand in for ``select.select``. Without a limit, it may wait for a child: that takes no time."""
    wait = functools.partial(original, reads, writes, errors)
    return wait() if timeout is None else wait_for_files(wait, timeout)


def select_for_loop(selector, timeout=None, original=selectors.EpollSelector.select):
    """Stand in for the ``select`` of the selectors of asyncio."""
    if timeout is None and takes_part():
        timeout = math.inf
    return wait_for_files(functools.partial(original, selector), timeout)


def make_poll(original=select.poll):
    """Stand in for ``select.poll``."""
    poll = original()

    def wait(timeout=None):
        if timeout is None or timeout < 0:
            return poll.poll()
        return wait_for_files(lambda seconds: poll.poll(seconds * 1000), timeout / 1000)

    return Shim(poll, poll=wait)


@patch('subprocess', 'Popen.poll')
def poll_child(original, run, child):
    """Python only looks. In virtual time, this lets the child end, for CHILD_LIMIT: that takes no time."""
    end = _monotonic() + CHILD_LIMIT
    while takes_part() and not hasattr(child, 'is_slow') and original(child) is None:
        if _monotonic() > end:
            child.is_slow = True
            _simulation.lost.append(f'{local.thread.name} with its child {child.args}')
        _sleep(1e-6)
    return original(child)


def init_node(this_run, *args, original=ScriptRun.init_node, **options):
    """Stand in for ``ScriptRun.init_node``: with a seed, the program goes on later, as processes do."""
    original(this_run, *args, **options)
    if takes_part() and _simulation.seed_number:
        time.sleep(_simulation.random.uniform(0, START_DELAY * _simulation.jitter))


def compose(master, package, file, args, *options, original=composition.compose):
    """Stand in for ``composition.compose``: a failed test names the launch file with its arguments."""
    words = [package, str(file)] if package else [str(file)]
    words += [f'{name}:={value}' for name, value in args.items()]
    _simulation.launch_file = shlex.join(words)
    return original(master, package, file, args, *options)


def fork(original=os.fork):
    """Stand in for ``os.fork``: the child would wait for a turn that never comes."""
    if takes_part():
        raise PharosError(
            'os.fork() has no virtual time, nor has multiprocessing: use subprocess, or'
            " multiprocessing.get_context('spawn')"
        )
    return original()


@patch('rospy.rostime', 'get_rostime')
def get_rostime(original, run):
    """rospy makes the time from a float, which is not exact. Virtual time has whole nanoseconds."""
    if not _simulation:
        return original()
    _now()  # a look takes some time
    return run.modules.by_name['rospy.rostime'].Time(0, _simulation.nanoseconds)


@patch('rospy.core', 'is_shutdown')
def is_shutdown(original, run):
    """Loops that wait for a transform or a flag may ask this alone, and never look at a clock."""
    if takes_part():
        _simulation.ask()
    return original()


@patch('rospy.impl.simtime', '_is_use_simtime')
def is_use_simtime(original, run):
    """rospy waits for /clock if /use_sim_time is set. Virtual time needs no /clock."""
    return not _simulation and original()


@patch('rospy.topics', '_PublisherImpl.publish')
def publish(original, run, publisher, message, *options, **more):
    """rospy only sends. This also records what a node publishes, if the simulation shall."""
    original(publisher, message, *options, **more)
    if _simulation:
        _simulation.last_messages[publisher.name] = copy_of(message)
        if run.name != PLAYER and publisher.name != '/rosout':
            _simulation.record_message(publisher, message)


def sleep(seconds):
    """Stand in for ``time.sleep``; a module may keep the function for a later simulation."""
    if takes_part():
        # sleep(0) takes some time, too, or it would stop the time
        _simulation.wait(_simulation.time_after(max(seconds, 1e-4)))
    else:
        _sleep(seconds)


def _refuse_part(composition, entries, *rest):
    raise PharosError(
        f'{", ".join(entry.name for entry in entries)}: has a process of its own, which knows no virtual'
        ' time; leave it out by only= or --only; if it has a window alone, name it in here= or --here'
    )


def changes():
    """Return what a simulation changes: modules and classes -> names -> stand-ins."""
    clocks = {name: _NoMethod(_read_clock, getattr(time, name), name) for name in CLOCKS}
    splits = {
        name: _NoMethod(_split_time, getattr(time, name))
        for name in ('localtime', 'gmtime', 'ctime')
    }
    monotonic = clocks['monotonic']
    return {
        time: {**clocks, **splits, 'strftime': _format_time, 'sleep': sleep},
        os: {'fork': fork, 'urandom': urandom},
        select: {'select': select_files, 'poll': make_poll},
        selectors.EpollSelector: {'select': select_for_loop},
        random: {'_urandom': urandom, 'seed': functools.partial(seed, random._inst)},  # type: ignore
        random.Random: {'seed': seed},
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
        run.Run: {'read_parameters': read_all_parameters, 'substitutes': substitutes},
        service_client: {'ignores_timeout': True},
        # all programs run here
        composition: {
            'compose': compose,
            'environment_of': lambda pairs: (),
            'needs_group': lambda path: '',
        },
        ScriptRun: {'init_node': init_node},
        composition.Composition: {'_start_part': _refuse_part},
    }
