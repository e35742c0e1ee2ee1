"""Send messages to the readers of a publisher that are processes of this package on this host.

A small message is one packet of a socket. A large one lies in a file in memory; a packet announces
it. The first such packet has the file's descriptor, and the reader maps the file. The reader copies
the message at once, and says so by a receipt of one byte: then the file is free for another message.
"""
from __future__ import annotations

import array
import copy
import functools
import mmap
import os
import select
import socket
import struct
import threading
from time import monotonic  # by name: real, also in a simulation
from typing import NamedTuple

import genpy

from pharos.intraprocess.copier import serialize
from pharos.intraprocess.inboxes import BoundedQueue
from pharos.intraprocess.links import LocalTransport
from pharos.private_rospy.tcpros import send_while_waiting, shutdown_socket
from pharos.waiting import let_senders_run

MAX_PACKET = 1 << 16  # bytes of a message, or a part of one, that the socket takes itself
MAX_FILES = 4  # of a publisher; beyond that, the slowest readers lose messages
MAX_EXCESS = 10  # a file more than so many times as large as a message does not take it
#: position of the file, or NO_FILE; slot of the field in it, or WHOLE; its bytes; dropped messages;
#: the time of sending, as of time.monotonic(), which is the same for all processes of a host
PACKET = struct.Struct('<bBQId')
NO_FILE = -1
WHOLE = 255


class MemoryFile:
    """A file in memory for one message; the kernel frees it with the last process that has it."""

    def __init__(self, position: int, size: int) -> None:
        self.position = position
        self.capacity = size + size // 4  # messages grow
        # those that announce it later, or have no receipt yet
        self.senders: set[MemorySender] = set()
        self.descriptor = os.memfd_create('pharos')
        try:
            os.ftruncate(self.descriptor, self.capacity)
            self.map = mmap.mmap(self.descriptor, self.capacity)
        except OSError:
            os.close(self.descriptor)
            raise

    def close(self) -> None:
        self.map.close()
        os.close(self.descriptor)


class MessageMemory:
    """The files of a publisher: four, or more once as many readers each read another one at a time."""

    def __init__(self, run) -> None:
        self.run = run
        self.lock = threading.Lock()  # of the files, and of the queues of all senders
        self._files: list[MemoryFile] = []

    def sort(self, connections: list) -> tuple[list[MemorySender], list]:
        """Return the connections that share memory, and the others."""
        senders = [each for each in connections if isinstance(each, MemorySender)]
        return senders, [each for each in connections if each not in senders]

    def split(self, message: genpy.Message) -> tuple[int, bytes | memoryview, bytes]:
        """Return the slot of a large field and its bytes, or WHOLE and the message, and the rest."""
        for slot in _byte_fields(type(message)):  # type: ignore[arg-type]
            name = message.__slots__[slot]
            value = _view(getattr(message, name))
            if len(value) > MAX_PACKET:
                others = copy.copy(message)
                setattr(others, name, b'')
                rest = serialize(others)
                if len(rest) <= MAX_PACKET:
                    return slot, value, rest
        return WHOLE, serialize(message), b''

    def write(
        self, parts: tuple[int, bytes | memoryview, bytes], senders: list[MemorySender]
    ) -> None:
        """Send a message by the connections that share memory.

        If that fails half way, the connections close, and the readers connect anew. If no memory
        file could be had, they get TCPROS.
        """
        is_complete = False
        try:
            with self.lock:
                self._put(parts, senders)
            is_complete = True
        except OSError as error:
            self.run.lacks_memory = True
            name = senders[0].name
            self.run.troubles.add(f'{name}: sends by TCPROS, since memory lacks a file: {error}')
        finally:
            for sender in senders:
                if not is_complete:  # a signal's handler may have raised between any two lines
                    sender.give_up()
                sender.close_if_broken()
        if any(sender.is_sending for sender in senders):
            let_senders_run()

    def _put(
        self, parts: tuple[int, bytes | memoryview, bytes], senders: list[MemorySender]
    ) -> None:
        slot, value, rest = parts
        size = len(value)
        for sender in senders:
            sender.take_receipts()
        if size > MAX_PACKET:
            file = self._free_file(size)
            file.map[:size] = value
            entry = Entry(file, slot, size, rest, monotonic())
        else:
            entry = Entry(None, WHOLE, 0, value, monotonic())
        for sender in senders:
            sender.put(entry)

    def _free_file(self, size: int) -> MemoryFile:
        """Return a file that no reader needs, with room for so many bytes.

        If there is none, the slowest readers lose their oldest messages. A message that a reader may be
        reading stays.
        """
        while len(self._files) >= MAX_FILES and all(file.senders for file in self._files):
            senders = {sender for file in self._files for sender in file.senders}
            slowest = max(senders, key=lambda sender: len(sender.messages))
            if not slowest.messages:  # each file has a reader that is reading it
                break
            slowest.drop_beyond(len(slowest.messages) - 1)
        free_files = [file for file in self._files if not file.senders]
        for file in free_files:
            if size <= file.capacity <= MAX_EXCESS * size:
                return file
        if not free_files:
            self._files.append(MemoryFile(len(self._files), size))
            return self._files[-1]
        unfit_file = free_files[0]
        self._files[unfit_file.position] = MemoryFile(unfit_file.position, size)
        unfit_file.close()
        return self._files[unfit_file.position]

    def close(self) -> None:
        """Free the files."""
        with self.lock:
            for file in self._files:
                file.close()
            self._files.clear()


class Entry(NamedTuple):
    """A message in the queue of a sender."""

    file: MemoryFile | None
    slot: int  # of the field in the file, or WHOLE
    size: int  # bytes in the file
    data: bytes  # the rest of the message; all of it if there is no file
    time: float  # of sending


class MemoryTransport(LocalTransport):
    """One end of a connection."""

    transport_type = 'SHARED_MEMORY'

    def __init__(self, direction: str, topic: str, endpoint_id: str, sock: socket.socket) -> None:
        super().__init__(direction, topic, endpoint_id)
        self._socket = sock


class MemorySender(MemoryTransport, BoundedQueue):
    """The publisher's end of a connection.

    The lock of the MessageMemory guards the queue and the files. put(), take_receipts(), _send_ready()
    and _break() need it held; is_busy, give_up() and close() take it.

    :ivar dropped: the number of messages that were dropped since the last packet
    """

    is_sending = False  # True while a thread sends the queue
    is_broken = False  # True from _break() on; close() follows once the memory's lock is free
    announced: MemoryFile | None = None  # the file that the reader has no receipt for yet

    def __init__(self, publisher, reader_name: str, sock: socket.socket) -> None:
        MemoryTransport.__init__(self, 'o', publisher.resolved_name, reader_name, sock)
        BoundedQueue.__init__(self)  # its messages are Entries
        self._publisher = publisher
        self._memory = publisher.memory
        self.queue_bytes = self._memory.run.node.queue_bytes
        self._known_files: dict[int, MemoryFile | None] = {}  # that the reader has, by position

    def fileno(self) -> int:
        """Let rospy find readers that have left; a reader has none, since it reads to the end."""
        return self._socket.fileno()

    @property
    def is_busy(self) -> bool:
        """True until the reader has read all: if its receipt finds the socket closed, it drops a message."""
        with self._memory.lock:
            if self.announced:
                self.take_receipts()
            return bool(self.messages or self.announced)

    def put(self, entry: Entry) -> None:
        """Add a message to the queue, and send all that the socket takes; never waits."""
        if self.done or self.is_broken:
            return
        if entry.file:
            entry.file.senders.add(self)
        # rospy sets this after the first connections may have been made
        self.queue_size = self._publisher.queue_size
        self.add(entry, len(entry.data))
        self._send_ready()
        if self.messages and not self.is_sending:
            self.is_sending = self._memory.run.start_thread(self._send_queue) is not None

    def forget(self, entry: Entry) -> bool:
        """Free the file of a dropped message."""
        if entry.file:
            entry.file.senders.discard(self)
        return True

    def give_up(self) -> None:
        """Have the reader connect anew."""
        with self._memory.lock:
            self._break()

    def _break(self) -> None:
        """Have the reader find its socket closed: its receipt fails, and it drops the message."""
        self.is_broken = True
        shutdown_socket(self._socket)
        if self.announced:
            self.announced.senders.discard(self)
            self.announced = None
        self.drop_beyond(0)

    def _send_ready(self) -> None:
        """Send the messages that the socket takes, one in a file at a time."""
        while self.messages:
            entry = self.messages[0]
            if entry.file and self.announced:
                return
            try:
                self._send(entry)
            except BlockingIOError:
                return
            except OSError:  # the reader has gone
                self._break()
                return
            self.messages.popleft()
            self.announced = entry.file or self.announced
            self.dropped = 0
            self.stat_num_msg += 1
            self.stat_bytes += entry.size + len(entry.data)

    def _send(self, entry: Entry) -> None:
        file = entry.file
        position = file.position if file else NO_FILE
        head = PACKET.pack(position, entry.slot, entry.size, self.dropped, entry.time)
        rights = []
        if file and self._known_files.get(position) is not file:
            descriptors = array.array('i', [file.descriptor])
            rights = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, descriptors)]
        self._socket.sendmsg([head, entry.data], rights, socket.MSG_DONTWAIT)
        self._known_files[position] = file

    def take_receipts(self) -> None:
        """Free the file that the reader has read."""
        try:
            receipt = self._socket.recv(1, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return
        except OSError:
            receipt = b''
        if not receipt:
            self._break()
        elif self.announced:
            self.announced.senders.discard(self)
            self.announced = None

    def _send_queue(self) -> None:
        send_while_waiting(self._socket, self._send_rest)
        self.close_if_broken()

    def _send_rest(self) -> int | None:
        """Send what the socket takes; return the event to wait for, None if that is all."""
        with self._memory.lock:
            self.take_receipts()
            self._send_ready()
            self.is_sending = bool(self.messages)
            if not self.messages:
                return None
            waits_for_receipt = self.messages[0].file and self.announced
            return select.POLLIN if waits_for_receipt else select.POLLOUT

    def close_if_broken(self) -> None:
        if self.is_broken:
            self.close()

    def close(self) -> None:
        if not self.done:
            super().close()
            with self._memory.lock:
                self._break()
                self._socket.close()


def is_plain(message_class: type[genpy.Message]) -> bool:
    """True for classes as genpy makes them: not AnyMsg, and not a class of numpy_msg."""
    return message_class.__bases__ == (genpy.Message,) and message_class._md5sum != '*'


@functools.lru_cache(None)
def _byte_fields(message_class: type[genpy.Message]) -> list[int]:
    """Return the slots of the fields that may lie in a file by themselves."""
    if not is_plain(message_class):
        return []
    return [slot for slot, name in enumerate(message_class._slot_types) if name == 'uint8[]']


def _view(value) -> bytes | memoryview:
    """Return the bytes of a field without copying them, b'' if that cannot be."""
    if isinstance(value, bytes):
        return value
    if getattr(value, 'dtype', None) == 'uint8' and value.flags.c_contiguous:
        return memoryview(value).cast('B')
    return b''
