"""The nodes of this process: which there are, how one is stopped, and how they end with the
program."""
import atexit
import contextlib
import functools
import os
import sys
import threading
import time
from typing import TYPE_CHECKING, Any, Callable, Dict, Iterator, List, Optional, Set, Tuple

from pharos import signals
from pharos.blocks import name_of
from pharos.errors import NodeNameInUseError, NodeStoppedError, PharosError
from pharos.lookers import is_looker
from pharos.private_rospy import process_rospy
from pharos.private_rospy.condition import Condition
from pharos.private_rospy.lifetime import SIGNAL_LATENCY, Interruption, join, wait_for

if TYPE_CHECKING:
    from pharos.node import Node
    from pharos.run import Run

#: seconds from its beginning on that anybody waits for a stop() that another thread runs
STOP_LIMIT = 30.0
#: how many times all that run are stopped, where others start some in answer to that
STOP_ROUNDS = 5

changed = Condition()  # guards the life cycles of all nodes, and what follows
# (master, name) -> those that the master may know, in the order of their starts
_nodes: 'Dict[Tuple[Any, str], Node]' = {}
# node -> the identifier of the thread that runs its stop(), and the time.monotonic() until which
# others wait for that
_stops: 'Dict[Node, Tuple[int, float]]' = {}
# (node, identifier of the thread that is in its start()) -> the run that it has begun there
_starts: 'Dict[Tuple[Node, int], Optional[Run]]' = {}
_waiting: 'Dict[int, Node]' = {}  # identifier of a thread -> the node for whose stop it waits
_finalizer: Any = None  # what multiprocessing runs at the end of its processes
_others: List[Callable[[], Any]] = []  # they end what else was started: programs, masters
_starters: List[Callable[[], Any]] = []  # they have nodes started no more


def nodes() -> 'List[Node]':
    """The nodes that start, run or stop, in the order of their starts."""
    with changed:
        return list(_nodes.values())


def is_node(thing: Any) -> bool:
    """Whether it is a Node of this process.

    By what its class has, for :mod:`pharos.node` imports those that ask.
    """
    return hasattr(type(thing), 'latest_run')


# -- starts and stops


def claim(run: 'Run') -> 'Optional[Run]':
    """The run of a node starts, and the master is to know the node soon; returns its former run.

    :raises PharosError: if the node is running already
    :raises NodeNameInUseError: if another node of this process has its name at its master
    :raises NodeStoppedError: if this thread restarts the node, which another one has stopped
    """
    _end_with_multiprocessing()
    node = run.node
    with contextlib.suppress(TimeoutError):
        _wait_for_stop(node)  # for what an overriding stop() does last
    with changed:
        former = node.latest_run
        if former and former.restart and former.restart.is_cancelled_here():
            raise NodeStoppedError(f'{node.name} was stopped while it was restarted')
        _claim_name(node, node.name)
        if former is not None and not former.is_over:
            raise PharosError(
                f'{node.name} is {node.lifecycle.value} already: stop() it before you start it'
                ' again'
            )
        node.latest_run = run
        key = node, threading.get_ident()
        if key in _starts:
            _starts[key] = run
    return former


def rename(node: 'Node', name: str) -> None:
    """The node, of which the master does not know yet, is called so from now on.

    :raises NodeNameInUseError: if another node of this process has the name at its master
    :raises NodeStoppedError: if the node has been stopped meanwhile
    """
    with changed:
        if node.latest_run.is_ending:
            raise NodeStoppedError(f'{node.name} was stopped while it started')
        _claim_name(node, name)
        if name != node.name:
            discard(node)
        node.latest_run.rospy.rename(name)


def _claim_name(node: 'Node', name: str) -> None:
    other = _nodes.setdefault((node.master, name), node)
    if other is not node:
        took = other.latest_run.rospy.settings.origin_of_name if other.latest_run else ''
        raise NodeNameInUseError(
            f'the node name {name} is taken by a {other.lifecycle.value} node of this process{took}:'
            ' choose another name, or stop() that node first'
        )


def discard(node: 'Node') -> None:
    """The node has stopped, or did not come to run."""
    with changed:
        if _nodes.get((node.master, node.name)) is node:
            del _nodes[node.master, node.name]


def one_stop_at_a_time(method: Callable[..., Any]) -> Callable[..., Any]:
    """A ``stop`` method that runs once for each run of its node, whoever calls it in whatever
    thread.

    Who calls it meanwhile waits for its end, for up to STOP_LIMIT seconds, but for the node's own
    threads, which it may itself wait for. A signal does not cut it off where it runs in the main
    thread. When it has ended, the node is stopped, also where it has raised an exception.
    """

    @functools.wraps(method)
    def stop(node: 'Node', *args: Any, **kwargs: Any) -> Any:
        if _is_stopped_here(node):
            if type(node).stop is stop:
                return None  # it has called itself, by way of others perhaps
            return method(node, *args, **kwargs)  # super().stop()
        with signals.held():
            run = _begin_stop(node)
            if run is None:
                return None
            try:
                return method(node, *args, **kwargs)
            finally:
                try:
                    run.end()  # where it did not call super().stop(), or did not get there
                finally:
                    with changed:
                        del _stops[node]
                        changed.notify_all()

    return stop


@contextlib.contextmanager
def start_of(node: 'Node') -> 'Iterator[None]':
    """Within this, what this thread does with the node is for the run that it starts: not for a
    later one, where others have stopped that and started the node again."""
    key = node, threading.get_ident()
    is_outermost = key not in _starts
    _starts.setdefault(key, None)
    try:
        yield
    finally:
        if is_outermost:
            _starts.pop(key, None)


def is_in_start(node: Any) -> bool:
    """Whether this thread is in a :func:`start_of` the node."""
    return (node, threading.get_ident()) in _starts


def is_superseded(node: Any) -> bool:
    """Whether this thread is in a :func:`start_of` a run that is not the node's latest."""
    mine = _starts.get((node, threading.get_ident())) if _starts else None
    return mine is not None and mine is not node.latest_run


def stop(node: 'Node') -> None:
    """Stop a node where no code of the user's asked for it, who would get what an overriding stop()
    raises."""
    try:
        node.stop()
    except BaseException as error:
        node.errors.report(error, node.stop, f'{name_of(node.stop)} of {node.name}')


def _begin_stop(node: 'Node') -> 'Optional[Run]':
    """The run that this thread is to end; None where another one has done it, or there is nothing
    to end."""
    if is_superseded(node):
        return None
    if node.latest_run is not None:
        if node.latest_run.rospy.is_in_shutdown_hook():
            return None  # after the hooks, which are to run before all else, it is stopped
        _cancel_restart(node)
        node.latest_run.cancel_start()
    with changed:
        run = node.latest_run
        try:
            is_awaited = _wait_for_stop(node)
        except TimeoutError:
            return None
        if not node.is_running or is_awaited and node.latest_run is not run:
            return None
        _stops[node] = threading.get_ident(), time.monotonic() + STOP_LIMIT
        return node.latest_run


def _cancel_restart(node: 'Node') -> None:
    """Have the node stay stopped, if another thread restarts it."""
    with changed:
        run = node.latest_run
        if run.restart is None or run.is_ending and run.souls.is_run_here():
            return  # the restart itself ends the soul, whose last line this is
        run.restart.cancel()
        if run.is_over and run.restart.is_cancelled:
            discard(node)


def _wait_for_stop(node: 'Node') -> bool:
    """Wait until no other thread starts or stops the node; returns whether there was a stop().

    :raises TimeoutError: if it has not ended in time, or this thread is one that it waits for
    """
    me, is_awaited = threading.get_ident(), False
    with changed:
        while True:
            run = node.latest_run
            thread, deadline = _stops.get(node, (me, float('inf')))
            if thread == me and not (run and run.is_starting):
                return is_awaited
            is_awaited = is_awaited or thread != me
            if time.monotonic() >= deadline or run.is_own_thread() or _waits_for_me(node):
                raise TimeoutError
            _waiting[me] = node
            try:
                changed.wait(SIGNAL_LATENCY)
            finally:
                del _waiting[me]


def _is_stopped_here(node: 'Node') -> bool:
    thread, _ = _stops.get(node, (None, 0))
    return thread == threading.get_ident()


def _waits_for_me(node: 'Optional[Node]') -> bool:
    """Whether the thread that stops the node waits, perhaps by way of others, for the stop that
    this one runs."""
    while node in _stops:
        if _is_stopped_here(node):
            return True
        node = _waiting.get(_stops[node][0])
    return False


# -- all of them


def spin() -> None:
    """Block until every node of the process has stopped, or Ctrl-C, SIGTERM or SIGHUP, which stop
    them.

    At the prompt, Ctrl-C ends the line alone, with a KeyboardInterrupt, and the nodes go on. A node
    whose ``stop()`` does not end within 30 s is not waited for. In a soul or delegate, it ends with
    the node.
    """
    with signals.interruptible_wait():
        try:
            wait_until(lambda: not _has_nodes_to_wait_for())
        except KeyboardInterrupt:  # the host program has a handler of its own
            if signals.is_at_prompt():
                raise
            stop_all()


def wait_until(predicate: Callable[[], bool], timeout: Optional[float] = None) -> bool:
    """Wait until ``predicate()`` holds, which is looked at when the life cycle of a node has
    changed, or the node stops on whose behalf this thread runs.

    :param timeout: seconds, None: without limit
    :returns: False where the time was up before
    """
    mine = Interruption()
    return wait_for(changed, lambda: predicate() or mine.came, timeout)


def notify() -> None:
    """Have those who wait look again."""
    with changed:
        changed.notify_all()


def _has_nodes_to_wait_for() -> bool:
    now = time.monotonic()
    late = [node for node, (_, deadline) in _stops.items() if now >= deadline]
    return any(node not in late and not is_looker(node.name) for node in _not_stopped_here())


def _not_stopped_here() -> 'Set[Node]':
    """The nodes that run, or that another thread stops: one that has stopped may be in an
    overriding stop() still."""
    return {node for node in (*_nodes.values(), *_stops) if not _is_stopped_here(node)}


def stop_all() -> None:
    """Stop all nodes of the process, side by side, and those that their blocks start meanwhile.

    Returns when each has ended its ``stop()``, or after STOP_LIMIT seconds.
    """
    deadline = time.monotonic() + STOP_LIMIT
    known: 'Set[Tuple[Node, Run]]' = set()
    for _ in range(STOP_ROUNDS):
        for function in list(_starters):
            function()
        with changed:
            runs = {(node, node.latest_run) for node in _not_stopped_here()} - known
        known |= runs
        threads = [
            threading.Thread(target=stop, args=(node,), name=node.name + ' stop', daemon=True)
            for node, _ in runs
        ]
        for thread in threads:
            thread.start()
        if not threads or join(threads, deadline - time.monotonic()):
            return


def before_stop_all(function: Callable[[], Any]) -> None:
    """Run ``function()`` before all nodes are stopped, so that who starts nodes anew starts none."""
    _starters.append(function)


def not_before_stop_all(function: Callable[[], Any]) -> None:
    """Run it no more. Harmless when done twice."""
    with contextlib.suppress(ValueError):
        _starters.remove(function)


# -- the end of the program


def at_end(function: Callable[[], Any]) -> None:
    """Run ``function()`` when the program ends, after the nodes have stopped; the last that was
    given first."""
    _end_with_multiprocessing()
    _others.append(function)


def not_at_end(function: Callable[[], Any]) -> None:
    """Do not run it then: what it ends has ended."""
    with contextlib.suppress(ValueError):  # done already, by another thread perhaps
        _others.remove(function)


def _end_with_multiprocessing() -> None:
    """Have a process of multiprocessing end as others do: one that was forked runs nothing that
    atexit knows."""
    global _finalizer
    multiprocessing = sys.modules.get('multiprocessing')
    if _finalizer is None and multiprocessing and multiprocessing.parent_process():
        _finalizer = multiprocessing.util.Finalize(None, _end, exitpriority=0)


def _end() -> None:
    """The program ends, once: a signal that comes meanwhile asks for nothing more."""
    with signals.held(is_end=True), contextlib.ExitStack() as others:
        stop_all()
        for function in _others:
            # the last first, and each of them, whatever another one raises
            others.callback(function)
        _others.clear()


def _rospy_ended_by(number: int) -> None:
    """A signal has ended the rospy node that the program itself is; rospy passes on what we had
    taken on before."""
    if number not in signals.taken_on:
        stop_all()


def _forget() -> None:
    """In a process that was forked: the nodes are its parent's, as are the programs, and it must
    not end them."""
    global changed, _finalizer
    changed = Condition()
    _finalizer = None  # its parent's, which multiprocessing has dropped
    former = list(_nodes.values())
    for known in (_nodes, _stops, _starts, _waiting, _others, _starters):
        known.clear()  # type: ignore[attr-defined]
    for node in former:
        if node.latest_run is not None:  # another thread may just have begun its first one
            node.latest_run.abandon()


signals.serve(lambda: bool(_nodes or _others or _stops), stop_all)
process_rospy.on_signal(_rospy_ended_by)
atexit.register(_end)
os.register_at_fork(after_in_child=_forget)
