"""How a subscription reads messages that are larger than what it reads from its socket at once.

rospy puts the parts together in a buffer that grows to the message's size, copies it out of there,
and shrinks the buffer; the next message has the system give, and clear, the same memory once more,
which takes longer than all else. Here it comes into memory that stays.
"""
import mmap
import socket

from pharos.private_rospy.process_rospy import rospy

# bytes that are read at once where the memory is new, however many were announced
PIECE = 1 << 26


class LargeMessages:
    """Those of one connection.

    :param buff_size: bytes that it reads at once
    """

    def __init__(self, buff_size):
        self.buff_size = buff_size
        self.bytes = 0  # that were read here, and not counted by the connection yet
        self._size = 0  # of the last one
        self._memory = None  # for those that have that size, as images do

    def read(self, buffer, size, sock):
        """The serialized message, whose length and perhaps beginning is in the buffer, which is
        empty then.

        :returns: bytes, or memory whose slices are bytes, until the next call
        :raises TransportTerminated: if the publisher leaves
        """
        beginning = buffer.getvalue()[4 : buffer.tell()]
        buffer.seek(0)
        buffer.truncate()
        try:
            return self._read(beginning, size, sock)
        except OSError as error:
            raise rospy.exceptions.TransportTerminated(f'cannot receive: {error}') from error

    def _read(self, beginning, size, sock):
        if size != self._size:
            self._size, self._memory = size, None
            return self._read_pieces(beginning, size, sock)
        if self._memory is None:
            self._memory = mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        come = len(beginning)
        with memoryview(self._memory) as view:
            view[:come] = beginning
            while come < size:
                come += self._count(sock.recv_into(view[come:], 0, socket.MSG_WAITALL))
        return self._memory

    def _read_pieces(self, beginning, size, sock):
        come = len(beginning)
        pieces = [beginning] if beginning else []  # one piece alone is not copied by join
        while come < size:
            pieces.append(sock.recv(min(size - come, PIECE), socket.MSG_WAITALL))
            come += self._count(len(pieces[-1]))
        return b''.join(pieces)

    def _count(self, number):
        if not number:
            raise rospy.exceptions.TransportTerminated('the publisher closed it within a message')
        self.bytes += number
        return number

    def counted(self):
        """How many bytes were read here since this was last asked."""
        number, self.bytes = self.bytes, 0
        return number
