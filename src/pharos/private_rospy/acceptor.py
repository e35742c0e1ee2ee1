"""How the clients of a server come in: none is waited for, and none is trusted to say what it ought
to."""
import collections
import contextlib
import errno
import threading
import time

from pharos.private_rospy.lifetime import keep_alive, shutdown_socket

# connections waiting to be accepted; of a rush, those beyond would try again a second later
BACKLOG = 1024
# seconds until the next attempt to accept a client where there are no descriptors left
PAUSE = 0.05
LONG = 86400.0  # seconds; some time limit
TEXT_LIMIT = 300  # characters of a client's in a line of the log
_EXHAUSTED = errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM
_SHUT = errno.EINVAL, errno.EBADF


class Limits:
    """What the clients of a node's servers may take; set on an instance, it holds for that node."""

    clients = 128  #: of one server, that have something to say before they are served
    grace = 0.25  #: seconds that each of them has in any case
    handshake_timeout = 5.0  #: seconds for a whole TCPROS handshake, however slowly it comes
    #: seconds until an XML-RPC request has come, however slowly
    request_timeout = 30.0
    #: seconds from one XML-RPC answer until the next request has begun; each client that stays is a
    #: descriptor and a thread
    idle_timeout = 1.0
    #: lines about the clients of one server that the log takes in a period; the rest is counted
    rejection_lines = 100
    rejection_period = 10.0  #: seconds


class Acceptor:
    """Lets the clients of one server in, each into a thread of its own.

    A client that is to say something before it is served, whether it shakes hands or makes a
    request, is in its *handshake*. Where too many are, the one whose handshake began first is
    closed: silent clients keep nobody from coming in, and are told from those that come in a rush
    by their age.

    :param kind: of the clients, for the log and the names of threads
    :param node: the :class:`~.instance.PrivateRospy` whose server it is
    """

    def __init__(self, kind, node):
        self._kind, self._node = kind, node
        self._changed = threading.Condition()  # guards all below; notified when a handshake ends
        self._handshakes = {}  # socket -> since when; the longest first
        self._is_crowded = False  # and the log says so
        self._limits = node.limits
        # when the last were logged
        self._rejections = collections.deque(maxlen=node.limits.rejection_lines)
        self._not_logged = 0  # since then

    def accept(self, listener, serve):
        """Accept clients until the listener is shut; ``serve(socket, address)`` runs for each.

        Whatever it raises closes the client, and is logged as the reason.

        :param listener: a socket that listens already: one that is shut before this runs would
            listen again
        """
        # With a time limit Python waits before it calls accept, which holds the number of the next
        # descriptor for as long as it waits itself: of a thousand, two for each node.
        with contextlib.suppress(OSError):  # it is closed already
            listener.settimeout(LONG)
        while True:
            self._make_room(wait=True)
            try:
                sock, address = listener.accept()
            except OSError as error:
                if error.errno in _SHUT:
                    return
                if error.errno in _EXHAUSTED:
                    self._close_longest(error.strerror)
                    self._node.ended.wait(PAUSE)
                continue  # else the client went before it was let in
            # rospy waits for ever for a service's client, or in vain for a subscriber's leaving
            keep_alive(sock)
            self._node.lifetime.track_socket(sock)
            self.start_handshake(sock)
            try:
                self._node.start_thread(self._serve, (sock, address, serve), self._kind)
            except RuntimeError as error:  # the system gives no more threads
                self.finish_handshake(sock)
                sock.close()
                self._log_crowd(error)

    def _serve(self, sock, address, serve):
        try:
            serve(sock, address)
        except Exception as error:
            sock.close()
            self.reject(sock, address, error)
        finally:
            self.finish_handshake(sock)

    def start_handshake(self, sock):
        """The client is to say something now."""
        with self._changed:
            self._handshakes[sock] = time.monotonic()
        self._make_room(wait=False)

    def finish_handshake(self, sock):
        """It has said it; returns whether it was to, and was not closed for others meanwhile."""
        with self._changed:
            since = self._handshakes.pop(sock, None)
            if len(self._handshakes) < self._limits.clients // 2:
                self._is_crowded = False
            self._changed.notify_all()
            return since is not None

    def reject(self, sock, address, why):
        """Log why a client's handshake failed; what happens to it later is its own affair."""
        if self.finish_handshake(sock):
            self.log_rejection(address, why)

    def log_rejection(self, address, why):
        """Log what is wrong with a client, unless so many others are wrong that it would fill the
        log."""
        if self._node.ended.is_set():
            return
        now, logged = time.monotonic(), self._rejections
        with self._changed:
            is_full = len(logged) == logged.maxlen
            if is_full and now - logged[0] < self._limits.rejection_period:
                self._not_logged += 1
                return
            logged.append(now)
            not_logged, self._not_logged = self._not_logged, 0
        more = f' (and {not_logged} more before, too many for the log)' if not_logged else ''
        host, port, *_ = address
        self._node.warn(f'{self._kind} client {host}:{port} refused: {brief(why)}{more}')

    def _make_room(self, wait):
        limits = self._limits
        while True:
            with self._changed:
                if len(self._handshakes) < limits.clients:
                    return
                left = limits.grace - (time.monotonic() - next(iter(self._handshakes.values())))
                if left > 0 and not wait:
                    return
                if left > 0:
                    self._changed.wait(left)
                    continue
            self._close_longest(f'{limits.clients} {self._kind} clients say nothing')

    def _close_longest(self, why):
        with self._changed:
            for longest in self._handshakes:
                del self._handshakes[longest]
                shutdown_socket(longest)  # its thread wakes
                break
        self._log_crowd(why)

    def _log_crowd(self, why):
        is_logged, self._is_crowded = self._is_crowded, True
        if not is_logged and not self._node.ended.is_set():
            self._node.warn(
                f'{why}: those that said nothing for longest are closed, to let others in'
            )


def brief(text, limit=TEXT_LIMIT):
    """What came from elsewhere, fit for one line of the log: not too long, control characters as
    escapes."""
    text = str(text)
    shown = ''.join(char if char.isprintable() else repr(char)[1:-1] for char in text[:limit])
    return shown + ('...' if len(text) > limit else '')
