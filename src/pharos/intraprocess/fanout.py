"""The way of a message from a publisher to all who are interested."""
import time
from typing import (
    Any,
    Callable,
    ContextManager,
    Dict,
    Iterable,
    List,
    NoReturn,
    Optional,
    Protocol,
    Tuple,
    Type,
)

import genpy

from pharos.intraprocess import common_thread, sharing
from pharos.intraprocess.copier import Frozen, copier_for
from pharos.intraprocess.dispatcher import BURST_INTERVAL, Dispatcher
from pharos.intraprocess.inbox import Inbox
from pharos.intraprocess.link import links_of

_clock = time.perf_counter


class ClosedError(Exception):
    """The topic is published on no more."""


class Connection(Protocol):
    """A connection to one subscriber, in this process or elsewhere.

    One to a node of this process has the attribute ``link``, a :class:`~.link.Link`.
    """

    endpoint_id: str  # the subscriber's name


class Sockets(Protocol):
    """How messages get to subscribers of other processes."""

    def serialize(self, message: genpy.Message, seq: int) -> bytes:
        """The message as it is written into a socket; raises what does not serialize."""

    def write(self, data: bytes, connections: Iterable[Connection]) -> None:
        """Write it into the sockets of these connections; raises nothing."""


class Latch:
    """What one channel sent last, for those who come late; it outlives the run of the node.

    What went to one node alone is for that node alone: for it, the last message is another one than
    for all others.
    """

    def __init__(self) -> None:
        self.is_closed = False  # whether the channel is
        self._to_all: Tuple[Frozen, ...] = ()  # the message, if there is one
        self._to_one: Dict[str, Tuple[Frozen, ...]] = {}  # by node name, where that is newer

    def keep(self, frozen: Frozen, receiver: Optional[str]) -> None:
        """Keep a message that was sent to the node of that name, None: to all."""
        if receiver is None:
            self._to_all, self._to_one = (frozen,), {}
        else:
            self._to_one[receiver] = (frozen,)

    def of(self, receiver: str) -> Tuple[Frozen, ...]:
        """What a node of that name is to get when it connects."""
        return self._to_one.get(receiver, self._to_all)


# Some connections, by how a message goes to them: inboxes in this process; other connections; the
# dispatchers whose threads run what is put into the inboxes, and those whose inboxes the publisher's
# thread runs; and the mark of messages that receivers share. A plain tuple is unpacked faster than
# a NamedTuple.
_Ways = Tuple[
    List[Inbox], List[Connection], List[Dispatcher], List[Dispatcher], Optional[sharing.Mark]
]


class Fanout:
    """Where the messages of one node on one topic go, in this process and elsewhere, and what is
    latched.

    Any thread may publish: ``lock`` is held meanwhile, but not while delegates run inline.

    :param lock: the publisher's, reentrant
    :param sockets: None: there are no subscribers elsewhere
    :param freeze: ``freeze(message)`` makes of a message that comes from elsewhere what is kept of it;
        None: they are of this process, and ``header.seq`` is to be filled in
    """

    # Slots keep what each message needs close together in memory: a message that comes after a pause
    # then waits for fewer of the processor's cache lines.
    __slots__ = (
        '_lock',
        'is_closed',
        'seq',
        '_has_header',
        '_freeze',
        '_size',
        '_ways',
        '_last_wake',
        '_thaw',
        '_sockets',
        '_latches',
        'connections',
    )

    def __init__(
        self,
        message_class: Type[genpy.Message],
        lock: ContextManager[Any],
        sockets: Optional[Sockets],
        freeze: Optional[Callable[[Any], Frozen]] = None,
    ) -> None:
        self._lock = lock
        self._sockets: Any = sockets
        self.is_closed = False
        self.seq = 0  #: the number of the last message
        self._has_header = freeze is None and getattr(message_class, '_has_header', False)
        self._freeze, self._thaw, self._size = copier_for(message_class)[:3]
        self._freeze = freeze or self._freeze
        self._latches: Dict[Latch, None] = {}  # of channels, in the order in which they first sent
        self._last_wake = 0.0  # when the last message woke a dispatcher
        self.set_connections(())

    def set_connections(self, connections: Iterable[Connection]) -> None:
        """Send to these connections from now on."""
        #: those through which a message goes that is published from now on
        self.connections = tuple(connections)
        # at once: somebody may be publishing
        self._ways = _ways_of(self.connections)

    def publish(
        self,
        message: genpy.Message,
        latch: Optional[Latch] = None,
        to: Optional[str] = None,
        connection: Optional[Connection] = None,
        runs_inline: bool = True,
    ) -> bool:
        """Send a message to all; returns whether there is anybody.

        :param latch: is to keep the message
        :param to: name of the only node that is to get it, None: all
        :param connection: the only connection through which it is to go, None: all
        :param runs_inline: False where the caller holds the lock, and calls :meth:`run` when it
            has released it
        :raises ClosedError: after :meth:`close`
        :raises Exception: what ``message.serialize()`` raises
        """
        with self._lock:
            if self.is_closed:
                raise ClosedError('publish() to a closed topic')
            inboxes, remote, dispatchers, inline, mark = self._ways
            if to is not None or connection is not None:
                inboxes, remote, dispatchers, inline, mark = self._select(to, connection)
            if not (inboxes or remote or latch):
                return False
            self.seq += 1
            message = self._numbered(message) if self._has_header else message
            frozen = self._freeze(message) if inboxes or latch else b''
            data = self._sockets.serialize(message, self.seq) if remote else b''
            if latch:
                self._keep(latch, frozen, connection.endpoint_id if connection else to)
            if inboxes:
                size = self._size_of(message, frozen) if self._size else 0
                message = mark.put_on(message) if mark else message
                for inbox in inboxes:
                    inbox.put(message if inbox.shared else frozen, size)
            for dispatcher in dispatchers:
                if dispatcher.idle:
                    self._wake(dispatchers)
                    break
            if remote:
                self._sockets.write(data, remote)
        for dispatcher in inline if runs_inline else ():
            dispatcher.run()
        return True

    def _keep(self, latch: Latch, frozen: Frozen, receiver: Optional[str]) -> None:
        latch.keep(frozen, receiver)
        self._latches[latch] = None
        if latch.is_closed:  # while this message was under way
            self.forget(latch)

    def _size_of(self, message: Any, frozen: Frozen) -> int:
        assert self._size
        return len(frozen) if type(frozen) is bytes else self._size(message)

    def _numbered(self, message: Any) -> Any:
        """The message with the next ``header.seq``, as rospy numbers messages."""
        if message._md5sum == '*':  # AnyMsg has no header
            return message
        if sharing.Mark.is_used and sharing.is_held(message.header):
            message = sharing.with_own_header(message)
        header = message.header
        header.seq = self.seq
        if header.frame_id is None:
            header.frame_id = '0'
        return message

    def _wake(self, dispatchers: List[Dispatcher]) -> None:
        """Wake those that are idle, and let them have the interpreter, but not within a burst."""
        last, self._last_wake = self._last_wake, _clock()
        yields = self._last_wake - last > BURST_INTERVAL
        common = common_thread.take(dispatchers) if yields and len(dispatchers) > 1 else None
        woken: Optional[Dispatcher] = None
        for dispatcher in dispatchers:
            if dispatcher.idle:
                dispatcher.wake()
                if dispatcher.is_yielded_to:
                    woken = dispatcher
        woken = common or woken
        if yields and woken is not None:
            woken.yield_gil()

    def run(self) -> None:
        """Run the delegates that are inline, without the lock, which others may wait for."""
        _, _, _, inline, _ = self._ways
        for dispatcher in inline:
            dispatcher.run()

    def reaches(self, name: str) -> bool:
        """Whether the node of that name gets what is sent to it alone."""
        return any(self._select(name, None)[:2])

    def _select(self, name: Optional[str], connection: Optional[Connection]) -> _Ways:
        """The ways to one node, or through one connection."""
        if connection is not None:
            return _ways_of([connection])
        return _ways_of([each for each in self.connections if each.endpoint_id == name])

    def send_latched(
        self, connection: Connection, inboxes: Optional[Iterable[Inbox]] = None
    ) -> None:
        """Send what is latched through a new connection, or into new inboxes of one.

        :meth:`run` is to be called afterwards, without the lock.
        """
        if self._latches:
            with self._lock:
                for latch in tuple(self._latches):  # a channel may close meanwhile
                    for frozen in latch.of(connection.endpoint_id):
                        self._send_again(frozen, connection, inboxes)

    def resume(self, latch: Latch) -> None:
        """A channel opens again: who has connected by now gets what it latched before, too.

        :meth:`run` is to be called afterwards, without the lock.
        """
        with self._lock:
            latch.is_closed = False
            self._latches[latch] = None
            for connection in self.connections:
                for frozen in latch.of(connection.endpoint_id):
                    self._send_again(frozen, connection)

    def _send_again(
        self, frozen: Frozen, connection: Connection, inboxes: Optional[Iterable[Inbox]] = None
    ) -> None:
        message = self._thaw(frozen)
        link = getattr(connection, 'link', None)
        if link is None:
            seq = message.header.seq if self._has_header else 0
            self._sockets.write(self._sockets.serialize(message, seq), [connection])
            return
        size = self._size(message) if self._size else 0
        for inbox in link.inboxes.values() if inboxes is None else inboxes:
            if inbox.shared:
                inbox.put(sharing.Mark(link.header).put_on(self._thaw(frozen)), size)
            else:
                inbox.put(frozen, size)
            if not inbox.inline and inbox.dispatcher.idle:
                inbox.dispatcher.wake()

    def forget(self, latch: Optional[Latch]) -> None:
        """A channel closes, and what it latched goes with it.

        It waits for no message that is under way, whose receiver may take none.
        """
        if latch is not None:
            latch.is_closed = True
            self._latches.pop(latch, None)

    def close(self) -> None:
        """Nothing is sent any more."""
        self.is_closed = True
        self.set_connections(())


class ClosedFanout:
    """What a channel that is closed has instead of a fan-out."""

    connections: Tuple[Connection, ...] = ()

    @staticmethod
    def publish(*arguments: Any) -> NoReturn:
        """Raise ClosedError."""
        raise ClosedError('publish() through a closed channel')


def _ways_of(connections: Iterable[Connection]) -> _Ways:
    links = links_of(connections)
    inboxes = [inbox for link in links for inbox in link.inboxes.values()]
    return (
        inboxes,
        [connection for connection in connections if not hasattr(connection, 'link')],
        list({inbox.dispatcher for inbox in inboxes if not inbox.inline}),
        list({inbox.dispatcher for inbox in inboxes if inbox.inline}),
        sharing.Mark(links[0].header) if any(inbox.shared for inbox in inboxes) else None,
    )
