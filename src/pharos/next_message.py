"""The next message on a topic, for a thread that waits for it: :meth:`Node.wait_for_message
<pharos.Node.wait_for_message>`."""
import collections
import time
from typing import TYPE_CHECKING, Any, Callable, Deque, Dict, NoReturn, Optional

import genpy

from pharos import signals
from pharos.blocks import attempt, check_block
from pharos.channel import InputChannel
from pharos.errors import NodeStoppedError, PharosError
from pharos.intraprocess.dispatcher import Dispatcher
from pharos.intraprocess.inbox import Inbox
from pharos.private_rospy.condition import Condition
from pharos.private_rospy.lifetime import Interruption, wait_for
from pharos.seconds import check_limit
from pharos.topic import QUEUE_SIZE, Topic, TypedAs

if TYPE_CHECKING:
    from pharos.node import Node
    from pharos.run import Run


def next_message(
    node: 'Node',
    topic: Topic,
    typed_as: TypedAs,
    timeout: Optional[float],
    where: Optional[Callable[[Any], Any]],
) -> genpy.Message:
    """See :meth:`Node.wait_for_message <pharos.Node.wait_for_message>`."""
    check_block(where, 'where', ('message',))
    timeout = check_limit('timeout', timeout)
    deadline = None if timeout is None else time.monotonic() + timeout
    wait = 0.0 if timeout is None else max(0.0, timeout)
    rospy = node.current_run.rospy
    if rospy.connections.is_read_here(topic.name):
        raise PharosError(
            f'this delegate runs in the thread that brings what comes on {topic.name}, and no other'
            ' message would: have a soul wait for it, or fork() what waits'
        )
    with Interruption(lifetime=rospy.lifetime):  # it begins here, and not with the first message
        channel = topic.open_input(NextMessages, node, typed_as, wait)
        try:
            while True:
                message = channel.take(deadline, rospy)
                if message is None:
                    _tell_late(channel, topic, timeout)
                if where is None or where(message):
                    return message
        finally:
            channel.close()


def _tell_late(channel: 'NextMessages', topic: Topic, timeout: Optional[float]) -> NoReturn:
    publishers = attempt(lambda: topic.publishers, [])
    held = f', and where() held for none of {channel.received}' if channel.received else ''
    refused = f', as another type than {channel.type}' if channel.refused else ''
    raise TimeoutError(
        f'no message came in time ({timeout:g} s) on {topic.name}{held}: it is published by'
        f' {", ".join(publishers) or "nobody"}{refused}'
    )


class NextMessages(InputChannel):
    """The end at which one thread takes the messages itself.

    No delegate runs, and the node's dispatcher has nothing to do with it: so a delegate of the node
    may wait for a message, too.
    """

    def __init__(self, node: 'Node', topic: str, message_class: Any) -> None:
        # nobody starts its thread: it holds the inboxes that have messages, in their order
        self._waiting = Dispatcher(lambda target, name: None)
        self._changed = Condition()  # notified when there are some
        self._taken: Deque[genpy.Message] = collections.deque()
        super().__init__(node, topic, message_class, queue_size=QUEUE_SIZE)

    def open(self, run: 'Run') -> None:
        self._subscribe(run, _WaitingInbox(self, self._waiting))

    def _unregister(self, endpoint: Any) -> None:
        self._rospy.connections.unsubscribe(self, endpoint)

    def open_inbox(self, thaw: Callable[[Any], Any], header: Dict[str, str]) -> Inbox:
        return _WaitingInbox(self, self._waiting, thaw, header)

    def take(self, deadline: Optional[float], rospy: Any) -> Optional[genpy.Message]:
        """The next message; None where none comes until the deadline, by ``time.monotonic()``.

        :param rospy: that of the run in which the wait began
        :raises NodeStoppedError: if the node stops, or the one on whose behalf this thread runs
        """
        scheduled = self._waiting.scheduled
        while not self._taken:
            timeout = None if deadline is None else deadline - time.monotonic()
            with signals.interruptible_wait(), Interruption(self.notify, rospy.lifetime) as stop:
                is_in_time = wait_for(
                    self._changed,
                    lambda: bool(scheduled) or stop.came or rospy.ended.is_set(),
                    timeout,
                )
            if scheduled:
                # takes nothing where the publisher has just dropped it for a newer one
                scheduled.popleft().run_next()
            elif is_in_time:
                is_own = rospy.ended.is_set()
                who = self.node.name if is_own else 'the node in whose block this is'
                raise NodeStoppedError(
                    f'{who} stops, and the wait for a message on {self.topic} with it'
                )
            else:
                return None
        return self._taken.popleft()

    def notify(self) -> None:
        """Have the thread that waits look again."""
        with self._changed:
            self._changed.notify_all()

    def deliver(self, message: genpy.Message, header: Optional[Dict[str, str]]) -> None:
        """Take a message, in the thread that waits."""
        self.received += 1
        if header is not None:
            message._connection_header = header
        self._taken.append(message)

    def report(self, error: BaseException) -> None:
        """Tell the thread that waits, in which this is."""
        raise error


class _WaitingInbox(Inbox):
    """What comes from one node of this process, or through sockets."""

    __slots__ = ()

    def put(self, value: Any, size: int = 0) -> None:
        super().put(value, size)
        receiver: Any = self.receiver
        receiver.notify()
