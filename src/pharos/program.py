"""The program that has nodes: its signals, its end, its forks, and waiting on behalf of a node."""
import atexit
import contextlib
import os
import signal
import sys
import threading
import time

import rospy

from pharos.errors import PharosError
from pharos.intraprocess import workers
from pharos.private_rospy.transport import runs


class _Here(threading.local):
    node = None  #: on whose behalf this thread runs


here = _Here()
#: the nodes of this process that run or restart
nodes = []
SAME_SIGNAL = 1.0  # seconds; people press Ctrl-C twice, and `timeout -s INT` sends two signals

signalled = False  # after a signal that ends the program
_first_signal = 0.0  # when it came, as time.monotonic()
_exiting = False  # at its end


def wait(predicate, timeout=None, node=None):
    """Wait until ``predicate()`` is true.

    :param timeout: seconds; None: without limit
    :param node: its stop ends the wait, too; default: the node on whose behalf this thread runs
    :returns: the last value of ``predicate()``, false if the wait ended otherwise
    """
    end = float('inf') if timeout is None else time.monotonic() + timeout
    node, pause = node or here.node, 0.002
    sleep = node._run.stopping.wait if node else time.sleep
    while not (value := predicate()) and time.monotonic() < end and not sleep(pause):
        pause = min(pause * 1.2, 0.02)
    return value


def wait_for(find, timeout, node=None):
    """Return ``find()``, tried again while it raises errors of ours."""

    def attempt():
        with contextlib.suppress(PharosError):
            return find()

    return wait(attempt, timeout, node) or find()


@contextlib.contextmanager
def quiet_wait():
    """End without an exception at the stop of a node, and at a signal of ours, which stops all."""
    try:
        with contextlib.suppress(rospy.ROSInterruptException):
            yield
    except (KeyboardInterrupt, SystemExit):
        if not signalled:
            raise


def stop_all():
    """Stop every node of this process, whatever the stop() of a class of its own raises."""
    for node in nodes[:]:
        node._end_now()


def spin() -> None:
    """Block until every node of this process has stopped. Ctrl-C, SIGTERM and SIGHUP stop them."""
    handle_signals()
    with contextlib.suppress(KeyboardInterrupt), quiet_wait():
        while nodes and not rospy.is_shutdown():  # that of the process, which its own signal ended
            time.sleep(0.01)
    stop_all()


def handle_signals():
    """Have signals stop the nodes and end the program, unless somebody else handles them."""
    if threading.current_thread() is not threading.main_thread():
        return
    interrupts = signal.default_int_handler, signal.SIG_DFL, signal.SIG_IGN
    if signal.getsignal(signal.SIGINT) in interrupts and not hasattr(sys, 'ps1'):
        signal.signal(signal.SIGINT, _end)
    for number in signal.SIGTERM, signal.SIGHUP:
        if signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, _end)


def is_signalled():
    """True if an exception of this thread may come from a signal."""
    by_python = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    is_main = threading.current_thread() is threading.main_thread()
    return is_main and (signalled or by_python)


def _end(number, frame):
    global signalled, _first_signal
    if signalled:
        if time.monotonic() - _first_signal > SAME_SIGNAL:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)  # ends the program at once
        return
    signalled = True
    _first_signal = time.monotonic()
    if _exiting:  # _exit() stops the nodes already
        return
    threading.Thread(target=stop_all, name='pharos end').start()
    raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)


def _exit():
    global _exiting
    _exiting = True
    stop_all()


def _forget():
    """Have no nodes in a forked child."""
    for node in nodes:
        node._abandon()
    nodes.clear()
    runs.clear()
    workers.forget()


atexit.register(_exit)
os.register_at_fork(after_in_child=_forget)
