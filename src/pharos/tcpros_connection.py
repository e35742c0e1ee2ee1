"""A TCPROS connection of our own, with a time limit.

rospy's ServiceProxy has none and asks the environment's master, and nothing in ROS's Python asks a publisher for its
message definition, so the exchange is ours; the handshake is rosgraph's.
"""
import io
import socket
import struct
import time

import rosgraph.network

_LIMIT = 1 << 30    # bytes of a response; a length beyond is a broken stream


class TcprosConnection:
    """A connection that is shaken hands on: :attr:`header` is the peer's answer, with 'error' where it refuses.

    :param address: (host, port)
    :param header: ours
    :param deadline: by ``time.monotonic()``, for each ``recv``; None: no limit
    :raises OSError, rosgraph.network.ROSHandshakeException: if there is no answer (socket.timeout: not in time)
    """

    def __init__(self, address, header, deadline):
        self._deadline = deadline
        self._socket = socket.create_connection(address, self._left())
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            rosgraph.network.write_ros_handshake_header(self._socket, header)
            rest = io.BytesIO()
            self.header = rosgraph.network.read_ros_handshake_header(self, rest, 4096)
            self._received = bytearray(rest.getvalue())
        except BaseException:
            self.close()
            raise

    def recv(self, size):
        """As a socket's, within the deadline; the handshake reads through this, too."""
        self._socket.settimeout(self._left())
        return self._socket.recv(size)

    def exchange(self, request, deadline):
        """Send a serialized request to a service; returns ``(ok, serialized response or error text)``."""
        self._deadline = deadline
        self._socket.settimeout(self._left())
        self._socket.sendall(struct.pack('<I', len(request)) + request)
        ok, length = struct.unpack('<BI', self._read(5))
        if length > _LIMIT:
            raise ConnectionError('a response of %d bytes was announced' % length)
        return ok, self._read(length)

    def _read(self, size):
        while len(self._received) < size:
            data = self.recv(min(1 << 20, max(4096, size - len(self._received))))
            if not data:
                raise ConnectionError('closed after %d of %d bytes' % (len(self._received), size))
            self._received += data
        result = bytes(self._received[:size])
        del self._received[:size]
        return result

    def is_alive(self):
        """Whether the peer has not closed an idle connection."""
        self._socket.setblocking(False)
        try:
            self._socket.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            return True
        except OSError:
            pass
        return False    # closed, or it says something unasked

    def close(self):
        self._socket.close()

    def _left(self):
        if self._deadline is None:
            return None
        left = self._deadline - time.monotonic()
        if left <= 0:
            raise socket.timeout('time is up')
        return left
