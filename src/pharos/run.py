"""One run of a node: all that a start makes, and its stop ends."""
import contextlib
import functools
import threading
import weakref
from typing import TYPE_CHECKING, Any, Callable, List, Optional, Tuple

from pharos import memory, messages, node_registry, signals
from pharos.blocks import attempt, name_of
from pharos.errors import MessageTypeError, NodeStoppedError
from pharos.external_node import ExternalNode
from pharos.health import told
from pharos.intraprocess import common_thread
from pharos.intraprocess.dispatcher import Dispatcher
from pharos.lifecycle import Lifecycle
from pharos.openings import Openings
from pharos.private_rospy import changes, descriptors
from pharos.private_rospy.instance import PrivateRospy
from pharos.private_rospy.lifetime import JOIN_TIMEOUT, listed
from pharos.private_rospy.names import Resolved, check_name
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.settings import Settings
from pharos.restarts import Restart, is_restarting
from pharos.seconds import check_seconds
from pharos.souls import Souls
from pharos.transcript import Transcript
from pharos.watcher import watcher_of

if TYPE_CHECKING:
    from pharos.node import Node


class Run(Openings):
    """One run of a node, from a start to its stop; it is thrown away at the next start.

    :attr:`rospy` is the node's :class:`~pharos.private_rospy.instance.PrivateRospy`,
    :attr:`dispatcher` runs its delegates.
    """

    #: what to say of souls that are left behind
    left_behind = 'A soul ends by itself if it waits with node.sleep() or loops over node.every()'

    #: whether a thread that runs other nodes, too, may run its delegates
    may_run_elsewhere = True

    def __init__(self, node: 'Node', settings: Settings) -> None:
        super().__init__(node)
        self.lifecycle = Lifecycle.STARTING
        self._settings = settings
        self._starter: Optional[int] = threading.get_ident()  # the thread that starts the node
        self._is_cancelled = False  # whether a stop() came while the node started
        self._forked: 'weakref.WeakSet[threading.Thread]' = weakref.WeakSet()  # they run souls
        self._ignoring: List[threading.Thread] = []  # those of them that went on after the stop
        self.souls = Souls(self)
        #: the one that began when :meth:`Node.restart` had ended this one
        self.successor: Optional[Run] = None
        #: the restart that ends this one
        self.restart: Optional[Restart] = None
        descriptors.check_left(descriptors.STARTING, f'{settings.name} cannot start')
        self.rospy = PrivateRospy(settings, self._stop_for_ros, lambda: node.allow_remote_shutdown)
        limits = self.rospy.limits
        limits.handshake_timeout = limits.request_timeout = node.client_timeout
        on_behalf = self.rospy.lifetime.run_on_behalf if self.may_run_elsewhere else None
        self.dispatcher = Dispatcher(self.rospy.start_thread, on_behalf=on_behalf)
        self.rospy.on_received = self.dispatcher.run
        self.rospy.on_failure = self._hook_failed
        self.rospy.refusals.on_refused = self._report_refusal
        self.rospy.tell_health = lambda: told(node)

    # -- start and stop

    def start(self, reopens: bool) -> None:
        """Register the node with the master, and open again what its former run had.

        Where it cannot be registered, it is as it was, in its former run. Where something cannot be
        opened, the run ends, and the next one opens all of it.

        :param reopens: whether there is anything to open again
        :raises NodeStoppedError: if the node was stopped meanwhile
        """
        former: Optional[Run] = None
        try:
            with signals.held():
                former = node_registry.claim(self)
                self.rospy.start(self.node.connect_timeout)
                if former and reopens:
                    self.opened = list(former.opened)
                    self._to_reopen = list(former.opened)
                    self.rospy.parameters.restore_from_previous_run(former.rospy.parameters)
                elif former:
                    self._former_opened = list(former.opened)
                with node_registry.changed:
                    self._check_not_stopped()
                    self._become(Lifecycle.RUNNING)
                # the same ports next time, also where any free one was asked for
                self._settings.tcp_port = self.rospy.tcp_port
                self._settings.xmlrpc_port = self.rospy.xmlrpc_port
            watcher_of(self.node.master).check()
            for opened in self.opened:
                self._check_not_stopped()
                self.reopen(opened)
            with self.node.master.reached():
                self.rospy.parameters.renew()
        except BaseException as error:
            if self.node.latest_run is not self:
                raise  # it could not be claimed
            is_stopped = self._is_cancelled or self.is_ending
            if self.is_starting:
                self.rospy.finish_stop(0)
                self.node.latest_run = former  # type: ignore[assignment]
                self._become(Lifecycle.STOPPED)
            self.end()
            if is_stopped and isinstance(error, Exception):
                raise NodeStoppedError(f'{self.node.name} was stopped while it started') from error
            raise

    def _check_not_stopped(self) -> None:
        if self._is_cancelled or self.is_ending:
            raise NodeStoppedError(f'another thread has stopped {self.node.name}, which started')

    def cancel_start(self) -> None:
        """Have the start end, where the node is starting: its caller gets a NodeStoppedError."""
        with node_registry.changed:
            if not self.is_starting:
                return
            self._is_cancelled = True
        self.rospy.begin_stop()

    def end(self) -> None:
        """End all that the run has, unless it ends already."""
        with node_registry.changed:
            if self.lifecycle is not Lifecycle.RUNNING:
                return
            self._become(Lifecycle.STOPPING)
        try:
            with contextlib.ExitStack() as ends:  # each of them, whatever another one raises
                for end, *limit in reversed(self._ends()):
                    ends.callback(end, *limit)
        finally:
            self._become(Lifecycle.STOPPED)
            if not node_registry.nodes():
                common_thread.end()
            memory.collect(len(node_registry.nodes()))
            watcher_of(self.node.master).check()

    def _ends(self) -> List[Tuple[Any, ...]]:
        """What a stop ends, in this order: (how, the seconds that it may take, if it takes any)."""
        timeout = attempt(lambda: check_seconds('stop_timeout', self.node.stop_timeout), 0.0)
        return [
            (self.rospy.begin_stop,),  # what waits
            (self._end_souls, timeout),
            (self.dispatcher.close,),
            # In this order: the hooks of on_shutdown run, the node leaves the local ones, messages
            # under way are flushed, all is unregistered (watched parameters, too), links and topics
            # close, then services, servers, XML-RPC proxies and sockets; threads are joined, and
            # handlers of the log closed.
            (self._end_rospy, timeout),
            (self._close_opened,),
        ]

    def _end_souls(self, timeout: float) -> None:
        """Wait for the souls, but this thread's."""
        threads = [
            thread for thread in listed(self._forked) if thread is not threading.current_thread()
        ]
        self.rospy.lifetime.await_end(threads, timeout)
        self._ignoring = [thread for thread in threads if thread.is_alive()]
        if self._ignoring:
            self.node.log(
                f"left behind, for it did not end within {timeout:g} s of the stop:"
                f" {', '.join(thread.name for thread in self._ignoring)}. {self.left_behind}",
                level='warning',
            )

    def _end_rospy(self, timeout: float) -> None:
        left = self.rospy.finish_stop(timeout, self._ignoring)
        if left:
            Transcript.show(
                f"{self.node.name} left behind threads that did not end: {', '.join(left)}"
            )
        else:  # a delegate may run inline, in another node's thread
            self.dispatcher.wait_for_delegate(JOIN_TIMEOUT)

    def _close_opened(self) -> None:
        self.close_opened()
        changes.notify()  # for sends that began when the stop had, and wait for subscribers

    def abandon(self) -> None:
        """This is a process that was forked: the node runs in its parent, and here it is
        stopped."""
        self.lifecycle = Lifecycle.STOPPED
        self.close_opened()
        self.opened = []

    def _become(self, lifecycle: Lifecycle) -> None:
        with node_registry.changed:
            self.lifecycle = lifecycle
            self._starter = None
            if lifecycle is Lifecycle.STOPPED and not is_restarting(self.node):
                node_registry.discard(self.node)
            node_registry.changed.notify_all()

    @property
    def is_starting(self) -> bool:
        """Whether the node is not registered yet."""
        return self.lifecycle is Lifecycle.STARTING

    @property
    def is_ending(self) -> bool:
        """Whether its stop has begun."""
        return self.lifecycle in (Lifecycle.STOPPING, Lifecycle.STOPPED)

    @property
    def is_over(self) -> bool:
        """Whether it has ended."""
        return self.lifecycle is Lifecycle.STOPPED

    def is_own_thread(self) -> bool:
        """Whether a stop() of the node may have to wait for this thread."""
        if self.is_starting:
            return self._starter == threading.get_ident()
        is_nodes = threading.current_thread() in self.rospy.lifetime.threads
        return is_nodes or self.dispatcher.is_run_here()

    def _stop_for_ros(self, reason: str) -> None:
        attempt(lambda: self.node.log(f'stops: {reason}'))
        node_registry.stop(self.node)

    # -- what it knows by name

    @property
    def parameters(self) -> List[Any]:
        """The parameters whose changes are watched."""
        return [listener.__self__ for listener in self.rospy.parameters.listeners]

    def resolve(self, name: str, what: str) -> str:
        """A name as the node means it, in its namespace and remapped, in full.

        :param what: what it is the name of, such as 'topic'
        :raises ValueError: if it cannot be a name
        """
        try:
            check_name(name, what, private=True)
        except ValueError:
            if not self.node.master.has(name, what):
                raise
            return name  # which other nodes have given to what is there
        # where rospy takes what follows for a global name (ros_comm #3044)
        name = '~' + name[2:] if name.startswith('~/') else name
        return check_name(self.rospy.module.resolve_name(name), what)

    def resolve_peer(self, peer: Any) -> Resolved:
        """The full name of a node that messages come from or go to.

        :param peer: a name, Node or ExternalNode
        :raises ValueError: if it is none of these, or of another master
        """
        if isinstance(peer, ExternalNode) or node_registry.is_node(peer):
            if peer.master != self.node.master:
                raise ValueError(
                    f'{peer} is at another master than {self.node.name}, and nothing goes from one'
                    ' to the other'
                )
            return Resolved(peer.name)
        if isinstance(peer, Resolved):
            return peer
        if not isinstance(peer, str):
            raise ValueError(f'from_= and to= are a node or its name, not {peer!r}')
        return Resolved(self.resolve(peer, 'node'))

    def fork(self, run: Callable[[], Any], name: str) -> threading.Thread:
        """Call ``run()`` in a thread of its own, which the stop waits for as for a soul's; returns
        the thread."""
        thread: threading.Thread = self.rospy.start_thread(run, name=name)
        self._forked.add(thread)
        return thread

    # -- what goes wrong

    def report(
        self,
        error: BaseException,
        block: Any,
        what: str,
        channel: Any = None,
        message: Any = None,
        again: Optional[Callable[[Any], Any]] = None,
    ) -> None:
        """Keep and tell what a block raised, which ends nothing but that run of it.

        See :meth:`Failures.report`.
        """
        if self.lifecycle is not Lifecycle.RUNNING and isinstance(
            error, (NodeStoppedError, rospy.ROSInterruptException)
        ):
            return  # that is how the stop of a node ends its souls
        attempt(lambda: messages.add_fields(error, message))
        where = f'{what} {name_of(block)} of {self.node.name}'
        if channel is not None:
            where += f' on {channel.topic}'
            again = channel.run_again
        elif again is not None:
            again = functools.partial(_again_where_running, self.node, again)
        self.node.errors.report(error, block, where, channel, message, again)

    def _hook_failed(self, error: BaseException, what: str = 'a hook of on_shutdown') -> None:
        self.node.errors.report(error, None, f'{what} of {self.node.name}')

    def _report_refusal(self, refusal: Any) -> None:
        """Keep and tell, once, that a publisher's messages do not come, for they are of another
        type."""
        name = self.node.name
        error = MessageTypeError(
            messages.explain_refusal(
                name, refusal.topic, refusal.wanted, refusal.publisher, refusal.offered
            )
        )
        where = f'connection of {name} to {refusal.publisher} for {refusal.topic}'
        self.node.errors.report(error, None, where)


def _again_where_running(node: 'Node', again: Callable[[Any], Any], message: Any) -> None:
    node.current_run  # raises where it is stopped
    again(message)
