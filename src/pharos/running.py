"""The running nodes of this process, and how they end with it."""
import atexit
import contextlib
import gc
import signal
import threading
import time

from pharos.private_rospy.lifetime import SIGNAL_LATENCY

# A stopped node's rospy is a web of cycles of 0.7 MB, which only the collector frees. It looks at the running nodes,
# too, so it runs after as many stops as there are nodes left, and at least so many:
COLLECT_EVERY = 20
_stops = 0     # since it ran
_nodes = {}    # a dict, for its order
_none_left = threading.Condition()
_deferred = None    # the signals that came while the main thread started a node; None: it starts none
_raised = None    # the last exception by which a signal ends the main thread, and with it the program
_waiting = 0   # how deep the main thread is in a wait of ours, which ends with the nodes


def is_from_signal(error):
    """Whether a signal ends the program with this exception, and not what a block raised by itself."""
    return error is _raised


def add(node):
    """The node runs from now on."""
    with _none_left:
        _nodes[node] = None


def discard(node):
    """The node has stopped."""
    global _stops
    with _none_left:
        _nodes.pop(node, None)
        if not _nodes:
            _none_left.notify_all()
        _stops += 1
        collect = _stops >= max(COLLECT_EVERY, len(_nodes))
        if collect:
            _stops = 0
    if collect:
        gc.collect()


def nodes():
    """The running nodes, in the order of their starts."""
    with _none_left:
        return list(_nodes)


def spin():
    """Block until every node of the process has stopped, or Ctrl-C or SIGTERM, which stops them."""
    with waiting():
        try:
            with _none_left:
                while _nodes:
                    _none_left.wait(SIGNAL_LATENCY)
        except KeyboardInterrupt:    # the host program has a handler of its own
            stop_all()


def stop_all():
    """Stop all nodes of the process, side by side."""
    threads = [threading.Thread(target=node.stop, name=node.name + ' stop', daemon=True) for node in nodes()]
    for thread in threads:
        thread.start()
    join(threads, 10.0)


def join(threads, timeout):
    """Wait until the threads have ended, for up to ``timeout`` seconds in all."""
    deadline = time.monotonic() + timeout
    for thread in threads:
        thread.join(max(0.0, deadline - time.monotonic()))


@contextlib.contextmanager
def waiting():
    """Within this, a signal raises nothing in the main thread: the wait ends because the nodes stop."""
    global _waiting
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _waiting += 1
    try:
        yield
    finally:
        _waiting -= 1


@contextlib.contextmanager
def signals_deferred():
    """Within this, signals wait: a start that is torn up half way leaves registrations behind.

    From the first time on, Ctrl-C and SIGTERM stop the nodes, where the host program does nothing itself.
    """
    global _deferred
    if threading.current_thread() is not threading.main_thread() or _deferred is not None:
        yield
        return
    for number, default in (signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL):
        if signal.getsignal(number) is default:
            signal.signal(number, _on_signal)
    _deferred = []
    try:
        yield
    finally:
        came, _deferred = _deferred, None
        if came:
            _on_signal(came[0], None)


def _on_signal(number, frame):
    global _raised
    if _deferred is not None:
        _deferred.append(number)
        return
    stop = threading.Thread(target=stop_all, name='stop on signal', daemon=True)
    stop.start()    # not here: the main thread may hold any lock just now
    if not _waiting:
        # the status is the shell's for a process that SIGTERM ended
        _raised = KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)
        raise _raised


atexit.register(stop_all)
