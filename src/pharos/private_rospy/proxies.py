"""XML-RPC proxies with a time limit: the standard library's wait for ever for a peer that does not
answer."""
import http.client
import socket
import xmlrpc.client
from typing import Any

import rosgraph

from pharos.private_rospy.deadlines import deadline_in, seconds_left
from pharos.private_rospy.lifetime import Interruption, shutdown_socket

TIMEOUT = 10.0  # seconds for one call, where nothing else is said


class _Limits:
    """When the calls of a proxy are to end.

    Its transport and what that holds share them: if they knew each other, their sockets would stay
    open until Python's collector of cycles comes by.
    """

    deadline = 0.0  # of the present call, by time.monotonic()
    is_shut = False  # whether none is to go on

    def left(self):
        """The seconds left for the present call; an OSError if there are none, or no call is to go
        on."""
        if self.is_shut:
            raise ConnectionAbortedError('it is not waited for any more')
        return seconds_left(self.deadline)


class _Transport(xmlrpc.client.Transport):
    """Ends each call by a deadline, however slowly its answer comes."""

    def __init__(self, timeout):
        super().__init__()
        self._timeout = timeout
        self._limits = _Limits()

    def request(self, *args, **options):
        self._limits.deadline = deadline_in(self._timeout)
        return super().request(*args, **options)

    def make_connection(self, host):
        if not self._connection or self._connection[0] != host:
            address, self._extra_headers, _ = self.get_host_info(host)
            self._connection = host, _Connection(address, self._limits)
        return self._connection[1]

    def shut(self):
        """End the call under way in another thread; it raises an OSError."""
        self._limits.is_shut = True
        connection = self._connection[1]
        sock = connection.sock if connection else None
        if sock is not None:
            shutdown_socket(sock)


class _Connection(http.client.HTTPConnection):
    def __init__(self, address, limits):
        super().__init__(address)
        self._limits = limits

    def connect(self):
        self.timeout = self._limits.left()
        super().connect()
        self.sock = _Socket(fileno=self.sock.detach())
        self.sock.limits = self._limits
        self._limits.left()  # shut() may have come before there was a socket


class _Socket(socket.socket):
    """The standard library's has a limit for each part of an answer."""

    def sendall(self, *args):
        self.settimeout(self.limits.left())
        return super().sendall(*args)

    def recv_into(self, *args):
        self.settimeout(self.limits.left())
        return super().recv_into(*args)


class ServerProxy(xmlrpc.client.ServerProxy):
    """``xmlrpc.client.ServerProxy`` whose calls raise an OSError after ``timeout`` seconds."""

    def __init__(self, uri: str, timeout: float = TIMEOUT, **options: Any) -> None:
        super().__init__(uri, transport=_Transport(timeout), **options)


def interruption(proxy: ServerProxy) -> Interruption:
    """Within this, calls end with the node on whose behalf this thread runs.

    For questions alone: of what is to change something, nobody would know whether it has.
    """
    transport: Any = proxy('transport')
    return Interruption(transport.shut)


def master_api(url: str, caller_id: str = '/pharos', timeout: float = TIMEOUT) -> rosgraph.Master:
    """rosgraph's own API of the master at ``url``, with a time limit of ``timeout`` seconds a
    call."""
    api = rosgraph.Master(caller_id, master_uri=url)
    api.handle = ServerProxy(url, timeout)
    return api
