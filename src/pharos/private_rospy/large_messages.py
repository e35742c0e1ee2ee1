"""How a subscription reads messages that are larger than what it reads from its socket at once.

rospy puts the parts together in a buffer that grows to the message's size, copies it out of there,
and shrinks the buffer; that takes as long as all else. Here it comes in one piece.
"""
import socket

from pharos.private_rospy.process_rospy import rospy

# bytes that are asked for at once, however many were announced
PIECE = 1 << 26


class LargeMessages:
    """Those of one connection.

    :param buff_size: bytes that it reads at once
    """

    def __init__(self, buff_size):
        self.buff_size = buff_size
        self._bytes = 0  # that were read here, and not counted by the connection yet

    def read(self, buffer, size, sock):
        """The serialized message, whose length and perhaps beginning is in the buffer, which is
        empty then.

        :raises TransportTerminated: if the publisher leaves
        """
        beginning = buffer.getvalue()[4 : buffer.tell()]
        buffer.seek(0)
        buffer.truncate()
        come = len(beginning)
        pieces = [beginning] if beginning else []  # one piece alone is not copied by join
        while come < size:
            pieces.append(self._receive(sock, min(size - come, PIECE)))
            come += len(pieces[-1])
        return b''.join(pieces)

    def _receive(self, sock, size):
        try:
            piece = sock.recv(size, socket.MSG_WAITALL)
        except OSError as error:
            raise rospy.exceptions.TransportTerminated(f'cannot receive: {error}') from error
        if not piece:
            raise rospy.exceptions.TransportTerminated('the publisher closed it within a message')
        self._bytes += len(piece)
        return piece

    def counted(self):
        """How many bytes were read here since this was last asked."""
        number, self._bytes = self._bytes, 0
        return number
