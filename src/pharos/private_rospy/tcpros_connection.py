"""A TCPROS connection of our own, with a time limit.

rospy's ServiceProxy has none and asks the environment's master, and nothing in ROS's Python asks a
publisher for its message definition, so the exchange is ours; the coding of the handshake is
rosgraph's.
"""
import io
import socket
import struct

import rosgraph.network

from pharos.private_rospy.deadlines import DeadlineReader, deadline_in, seconds_left
from pharos.private_rospy.lifetime import Interruption, keep_alive, shutdown_socket
from pharos.private_rospy.proxies import ServerProxy
from pharos.private_rospy.registration import COMMUNICATION_ERRORS

TIMEOUT = 2.0  # seconds that one publisher may take to say what it publishes
# No node's name: a publisher closes an earlier connection of the same name.
CALLER_ID = '/pharos_types'
_HEADER_LIMIT = 1 << 22  # bytes of a connection header; it holds a message definition
_LIMIT = 1 << 30  # bytes of a response; a length beyond is a broken stream


class NoMessageError(ConnectionError):
    """What comes is none, so that nothing after it can be read."""


class TcprosConnection:
    """A connection that is shaken hands on: :attr:`header` is the peer's answer, with 'error' where
    it refuses.

    :param address: (host, port)
    :param header: ours, kept as :attr:`sent`
    :param deadline: by ``time.monotonic()``, for the whole handshake; None: no limit
    :param buffer_size: bytes that are read from the socket at once
    :raises OSError: if there is no answer, or none that can be read (socket.timeout: not in time)
    """

    def __init__(self, address, header, deadline, buffer_size=io.DEFAULT_BUFFER_SIZE):
        self.sent = header
        self._socket = socket.create_connection(address, seconds_left(deadline))
        self._file = io.BufferedReader(DeadlineReader(self._socket, deadline), buffer_size)
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            # an answer may take any time, while its host is there
            keep_alive(self._socket, while_sending=True)
            with Interruption(lambda: shutdown_socket(self._socket)):
                rosgraph.network.write_ros_handshake_header(self._socket, header)
                size = self._read(4)
                answer = self._read_sized(size, _HEADER_LIMIT)
            self.header = rosgraph.network.decode_ros_handshake_header(size + answer)
        except (rosgraph.network.ROSHandshakeException, struct.error, UnicodeError) as error:
            self.close()
            raise ConnectionError(f'no connection header: {error}') from error
        except BaseException:
            self.close()
            raise

    def exchange(self, request, deadline):
        """Send a serialized request to a service; returns ``(ok, serialized response or error
        text)``."""
        self._file.raw.deadline = deadline
        with Interruption(lambda: shutdown_socket(self._socket)):
            self._socket.settimeout(seconds_left(deadline))
            self._socket.sendall(struct.pack('<I', len(request)) + request)
            ok = self._read(1) != b'\0'
            return ok, self._read_sized(self._read(4), _LIMIT)

    def read_message(self):
        """The next message of a topic, serialized; waits for it without limit."""
        self._file.raw.deadline = None
        return self._read_sized(self._read(4), _LIMIT)

    def _read_sized(self, size, limit):
        (size,) = struct.unpack('<I', size)
        if size > limit:
            raise NoMessageError(f'{size} bytes were announced; the limit is {limit}')
        return self._read(size)

    def _read(self, size):
        try:
            data = self._file.read(size)
        except TimeoutError as error:
            if error.errno is None:  # our time limit
                raise
            raise ConnectionError(f'its host has gone: {error.strerror}') from error
        if len(data) < size:
            raise ConnectionError(f'closed after {len(data)} of {size} bytes')
        return data

    def is_alive(self):
        """Whether the peer has not closed an idle connection."""
        self._socket.setblocking(False)
        try:
            self._socket.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            return True
        except OSError:
            pass
        return False  # closed, or it says something unasked

    def shut_down(self):
        """Have the thread end that waits for what comes."""
        shutdown_socket(self._socket)

    def close(self):
        """Close it."""
        self._socket.close()


def ask_publisher(uri, topic):
    """The connection header of the publisher at that URI; an empty one where it does not answer as
    agreed."""
    deadline = deadline_in(TIMEOUT)
    try:
        code, _, protocol = ServerProxy(uri, TIMEOUT).requestTopic(CALLER_ID, topic, [['TCPROS']])
        if code != 1:
            return {}
        _, host, port = protocol
        return publisher_header((host, port), topic, deadline)
    except (*COMMUNICATION_ERRORS, TypeError, ValueError, OverflowError):
        return {}


def publisher_header(address, topic, deadline):
    """The connection header of a publisher, as a subscriber of any type gets it; 'error' is in it
    where it refuses.

    :param address: (host, port)
    :param deadline: by ``time.monotonic()``
    :raises OSError: if there is no answer
    """
    connection = TcprosConnection(
        address,
        {'topic': topic, 'callerid': CALLER_ID, 'md5sum': '*', 'type': '*', 'tcp_nodelay': '0'},
        deadline,
    )
    connection.close()
    return connection.header
