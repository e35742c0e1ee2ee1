"""The nodes of this process, and their ends: by spin(), by signals, at the exit, in a fork."""
from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
import time
from time import monotonic  # by name: real, also in a simulation

import rospy

SAME_SIGNAL = 1.0  # seconds; people press Ctrl-C twice, and `timeout -s INT` sends two signals
_SPIN_PERIOD = 0.01  # seconds

#: the nodes of this process that have started; during a restart() a node stands here once more
started_nodes = []
#: the names of nodes that a required soul has ended
lost_names = set()

#: identifiers of threads whose handlers of a signal run in another thread: what they publish meanwhile
#: is dropped, since their process would stand still. (Only compose runs handlers in another thread.)
silenced_threads: set[int | None] = set()

#: the time of the first signal that ends the program, as of time.monotonic()
_signal_time: float | None = None
_is_exiting = False


def own_nodes():
    """Return the nodes of this process that start, run, stop or restart."""
    return [*dict.fromkeys(started_nodes)]


def live_nodes():
    """Return the nodes of this process that start or run."""
    return [node for node in own_nodes() if not node._current_run.stopping.is_set()]


class QuietWait(contextlib.AbstractContextManager):
    """Ends the wait in a ``with`` without an exception if a node stops or a signal stops all nodes.

    Other KeyboardInterrupts and SystemExits go on. (contextlib.contextmanager would raise a
    RuntimeError for a signal that comes before its ``yield``.) Who waits then looks for the stop:
    sleep() and every() at the run's ``stopping``; spin() stops all nodes.
    """

    def __exit__(
        self, error_class: type | None, error: BaseException | None, trace: object
    ) -> bool:
        if isinstance(error, (KeyboardInterrupt, SystemExit)):
            return is_ending()
        return isinstance(error, rospy.ROSInterruptException)


def stop_all() -> None:
    """Stop every node of this process, side by side, also if the stop() of a class raises an exception."""
    for thread in _start_stops():
        thread.join()


def _start_stops() -> list[threading.Thread]:
    """Begin to stop every node of this process, each in a thread, and return the threads."""
    threads = []
    for node in own_nodes():
        thread = threading.Thread(target=node._stop_safely, name='pharos end')
        try:
            thread.start()
        except RuntimeError:  # no thread is left, or the interpreter ends: one after another
            node._stop_safely()
        else:
            threads.append(thread)
    return threads


def spin() -> None:
    """Wait until every node of this process has stopped. Ctrl-C, SIGTERM and SIGHUP stop them.

    :raises SystemExit: with status 1, if a required soul has ended: that stops all nodes
    """
    handle_signals()
    for node in live_nodes():
        if node.soul and not node._has_run_soul:
            node.log('nobody runs the soul of this node: write node.fork()', 'warning')
    # QuietWait() lets a KeyboardInterrupt of the program's own handler through
    with contextlib.suppress(KeyboardInterrupt), QuietWait():
        # a program may have called rospy.init_node(): then a signal is rospy's
        while own_nodes() and not (lost_names or rospy.core.is_shutdown_requested()):
            time.sleep(_SPIN_PERIOD)
    stop_all()
    if lost_names:
        sys.exit(1)


def handle_signals() -> None:
    """Have SIGINT, SIGTERM and SIGHUP stop the nodes and end the program.

    Do nothing outside the main thread, and for a signal that the program handles. An interactive
    session keeps its SIGINT.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    defaults = signal.default_int_handler, signal.SIG_DFL, signal.SIG_IGN
    is_interactive = hasattr(sys, 'ps1')
    # a shell gives SIG_IGN to background programs; kill -INT shall stop the nodes all the same
    if signal.getsignal(signal.SIGINT) in defaults and not is_interactive:
        signal.signal(signal.SIGINT, _handle_signal)
    for number in signal.SIGTERM, signal.SIGHUP:
        if signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, _handle_signal)


def is_ending() -> bool:
    """True if a signal that ends the program has come."""
    return _signal_time is not None


def may_be_signal() -> bool:
    """True if an exception of this thread may come from a signal."""
    if threading.current_thread() is not threading.main_thread():
        return False  # signals come in the main thread
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        return True  # Python's own handler raises at any time
    return is_ending()  # ours raises, and sets this


def _handle_signal(number: int, frame: object) -> None:
    """Stop all nodes in another thread, and raise KeyboardInterrupt or SystemExit here.

    A second signal that comes more than SAME_SIGNAL later ends the process at once.
    """
    global _signal_time
    if _signal_time is not None:
        if monotonic() - _signal_time > SAME_SIGNAL:  # pragma: no cover: it ends the process
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)  # ends the program at once
        return
    _signal_time = monotonic()
    if _is_exiting:  # _stop_at_exit() stops the nodes already
        return
    _start_stops()
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise SystemExit(128 + number)


def _stop_at_exit() -> None:
    global _is_exiting
    _is_exiting = True
    stop_all()


def _forget_nodes() -> None:
    """Forget all nodes in a forked child: they run in the parent."""
    for node in own_nodes():
        node._current_run.mark_stopped()
    started_nodes.clear()


atexit.register(_stop_at_exit)
os.register_at_fork(after_in_child=_forget_nodes)
