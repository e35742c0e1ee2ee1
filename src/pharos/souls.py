"""Souls: what nodes do by themselves."""
import contextlib
import threading
from typing import TYPE_CHECKING, Any, Callable, Iterator, List, Optional

from pharos import node_registry, signals
from pharos.attributes import NodeAttributes
from pharos.blocks import Block, BlockOf, check_soul, name_of, text_of
from pharos.errors import NodeStoppedError, PharosError
from pharos.lifecycle import Lifecycle
from pharos.private_rospy.process_rospy import rospy
from pharos.seconds import check_seconds
from pharos.wrong_guesses import tells_keywords

if TYPE_CHECKING:
    from pharos.run import Run


class Soul:
    """A soul that was forked, in its thread."""

    def __init__(self, block: Optional[BlockOf], name: str, maker: Any) -> None:
        self.block = block  # None: the node's own soul, whatever that is when it begins
        self.name = name
        self.maker = maker  # START, the Soul in whose thread it was forked, or None
        self.is_asked = False  # whether it is to begin anew
        self.is_dropped = False  # whether it is to end, for its maker begins anew, and forks again
        self.begins_anew = False  # whether its loop has ended for one of these
        self.loops = 0  # how deep it is in loops over every()

    @property
    def is_due(self) -> bool:
        """Whether its loop is to end: not yet where its maker is about to begin anew, which ends it
        then."""
        maker = self.maker
        is_makers = isinstance(maker, Soul) and maker.is_asked and maker.loops > 0
        return self.is_dropped or self.is_asked and not is_makers

    def block_of(self, node: NodeAttributes) -> Optional[Block]:
        """What it runs when it begins now; None: nothing."""
        return node.soul if self.block is None else self.block.now


#: the maker of souls that the ``start()`` of the node's class forks
START = 'start'
FORK = 'fork() it'  # what to do where none runs


class Souls:
    """The souls of one run of a node."""

    def __init__(self, run: 'Run') -> None:
        self._run = run
        #: those that are forked and have not ended; after the stop, those that it has ended
        self.forked: List[Soul] = []
        self._here = threading.local()  # .soul: the one whose thread this is
        self._what_to_do = FORK
        self._threads: List[int] = []  # identifiers of threads, once for each soul they run

    def execute(self) -> Any:
        """Run the node's soul in this thread; an exception in it is reported and ends nothing
        else."""
        return self.run(Soul(None, '', None))

    def _checked(self, soul: Soul) -> Callable[..., Any]:
        """What it runs.

        :raises PharosError: if there is none
        """
        node = self._run.node
        block = check_soul(soul.block_of(node))
        if block is None:
            raise PharosError(
                f'{node.name} has no soul to run: give it one with soul= or node.soul ='
            )
        return block

    def _execute(self, soul: Soul, block: Callable[..., Any]) -> Any:
        self._threads.append(threading.get_ident())
        try:
            with self._run.rospy.lifetime.interrupts_waits():
                return block(self._run.node)
        except BaseException as error:
            node = self._run.node
            told = f'soul {name_of(block)} raised {type(error).__name__}: {text_of(error)}'
            way = 'restart() the node, which forks it' if soul.maker is START else FORK
            self._what_to_do = f'{told}, as node.failures tells, and has ended: {way} again'

            def again(nothing: Any) -> None:
                node.current_run.souls.run(soul)

            self._run.report(error, block, 'soul', again=again)
            return None
        finally:
            self._threads.remove(threading.get_ident())

    def run(self, soul: Soul) -> Any:
        """Run a soul, as it is now, in this thread."""
        return self._execute(soul, self._checked(soul))

    @tells_keywords
    def fork(self, block: Optional[Block], name: str) -> threading.Thread:
        """Run the node's soul, or ``block``, in a thread of its own, and return the thread."""
        node = self._run.node
        maker = START if node_registry.is_in_start(node) else getattr(self._here, 'soul', None)
        soul = Soul(None if block is None else BlockOf(node, block, is_soul=True), name, maker)
        first = self._checked(soul)
        self._what_to_do = FORK
        self.forked.append(soul)
        return self._run.fork(lambda: self._run_forked(soul, first), name)

    def _run_forked(self, soul: Soul, block: Optional[Block]) -> None:
        self._here.soul = soul
        while block is not None:
            self._execute(soul, block)
            block = None
            if soul.begins_anew and (soul.is_dropped or soul.block_of(self._run.node)):
                self._end_forked_by(soul)
                soul.is_asked = soul.begins_anew = False
                if self._run.lifecycle is Lifecycle.RUNNING and not soul.is_dropped:
                    block = soul.block_of(self._run.node)
        if self._run.lifecycle is Lifecycle.RUNNING:
            self.forked.remove(soul)
            node_registry.notify()  # its maker may wait for that

    def _end_forked_by(self, maker: Soul) -> None:
        """End what a soul has forked, which will fork that again, and wait for those that loop."""
        makers, children = {maker}, []
        for soul in list(self.forked):  # those that another one has forked come after it
            if soul.maker in makers:
                soul.is_dropped = True
                makers.add(soul)
                children.append(soul)
        node_registry.wait_until(
            lambda: self._run.lifecycle is not Lifecycle.RUNNING
            or not any(
                soul in self.forked and (soul.loops > 0 or soul.begins_anew) for soul in children
            )
        )

    def renew(self) -> None:
        """Have those that are forked begin anew.

        :raises PharosError: if there are none
        """
        forked = list(self.forked)
        if not forked:
            raise PharosError(
                f'no soul of {self._run.node.name} runs in a thread of its own: {self._what_to_do}'
            )
        for soul in forked:
            soul.is_asked = True

    def resume(self, former: 'Souls', starts_some: bool) -> None:
        """Fork again what was forked in a former run of the node, and what its stop has ended.

        :param starts_some: whether the start has forked those that it forks already
        """
        for soul in former.forked:
            is_back = soul.maker is START and starts_some or soul.maker in former.forked
            if not is_back and soul.block_of(self._run.node) is not None:
                self.fork(None if soul.block is None else soul.block.now, soul.name)

    def turns(self, rate: Any) -> Iterator[int]:
        """What :meth:`Node.every` returns, by a Rate of rospy's."""
        soul = getattr(self._here, 'soul', None) or Soul(None, '', None)
        soul.loops += 1
        turn = 0
        try:
            while self._run.lifecycle is Lifecycle.RUNNING:
                if soul.is_due:
                    soul.begins_anew = True
                    return
                yield turn
                turn += 1
                if self._run.lifecycle is not Lifecycle.RUNNING:
                    return
                with signals.interruptible_wait():
                    with contextlib.suppress(rospy.ROSInterruptException):
                        rate.sleep()
        finally:
            soul.loops -= 1

    def end(self) -> None:
        """End the soul that runs in this thread, if one does and the node stops."""
        is_running = self._run.lifecycle is Lifecycle.RUNNING
        if not is_running and self.is_run_here():
            raise NodeStoppedError(f'{self._run.node.name} stops, and this soul with it')

    def is_run_here(self) -> bool:
        """Whether this thread runs a soul of the run."""
        return threading.get_ident() in self._threads


class NodeWithSouls(NodeAttributes, is_base=True):
    """The part of a Node that is about souls."""

    def execute(self) -> Any:
        """Run the soul once, in the calling thread, and return its value.

        The report (listing 3.7): ``node execute``. An exception in the soul is reported (see
        :attr:`errors`) and ends only this run, which then returns None.
        """
        return self.current_run.souls.execute()

    def fork(self, block: Optional[Block] = None, name: Optional[str] = None) -> threading.Thread:
        """Run the soul, or ``block(node)``, in a thread of its own, and return the thread.

        The report (listing 3.8): ``[node execute] fork``. :meth:`stop` ends it at its next
        :meth:`sleep` or turn of :meth:`every`.
        """
        return self.current_run.souls.fork(block, name or 'soul')

    def renew(self) -> None:
        """Have the souls that were forked begin anew at their next turn of :meth:`every`: that loop
        ends there, and when what follows it has run, the soul runs from its first line, in the same
        thread.

        A soul that loops goes on as it was written when it began; this has it go on as it is now,
        when :attr:`soul` was replaced, or its code edited and reloaded::

            driver.soul = lambda me: [me.send_to('/cmd_vel', angular=-1.0) for _ in me.every(1)]
            driver.renew()

        A soul that was forked as a ``block`` begins with that block again, and one whose node has no
        soul any more ends. Without :meth:`every` a soul does not begin anew. One that another soul
        has forked ends when that begins anew, which waits for it, and forks it again.

        :raises PharosError: if no soul runs in a thread of its own: it has ended, or failed, and is
            to be forked again
        :raises NodeStoppedError: if the node is not started
        """
        self.current_run.souls.renew()

    @tells_keywords
    def sleep(self, seconds: float) -> None:
        """Wait for ``seconds`` of ROS time, or until the node stops; a soul is ended by that. A
        jump back in simulated time, as when a bag is played again, ends the wait alone.

        The report: ``(Delay forSeconds: 1) wait``.
        """
        seconds = check_seconds('a sleep', seconds)
        run = self.current_run
        run.souls.end()
        with signals.interruptible_wait(), contextlib.suppress(rospy.ROSInterruptException):
            run.rospy.module.sleep(seconds)
        run.souls.end()

    @tells_keywords
    def every(self, seconds: float) -> Iterator[int]:
        """An iterator that turns at once and then every ``seconds`` of ROS time, without drift,
        until the node stops, or its soul begins anew (see :meth:`renew`). It counts its turns, from
        0 on.

        A turn that takes longer than ``seconds`` delays the next, which then comes at once, as it
        does after a jump back in simulated time.
        """
        seconds = check_seconds('a period', seconds, above=0)
        run = self.current_run
        return run.souls.turns(run.rospy.module.Rate(1.0 / seconds, reset=True))
