"""The way of messages into the socket of one subscriber: whole, in order, and never waiting for the
reader."""
import itertools
import socket
import struct
import threading

import pytest
from hypothesis import given, settings, strategies

from pharos.testing import TIMEOUT, until
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.sender import AT_ONCE, Sender

SIZES = strategies.one_of(
    strategies.integers(0, 2000),
    strategies.integers(AT_ONCE - 9, AT_ONCE + 9),
    strategies.integers(0, 4 * AT_ONCE),
)


class Link:
    """A Sender, and the socket at which its subscriber reads."""

    def __init__(self, queue_size=0):
        with socket.create_server(('127.0.0.1', 0)) as server:
            self.socket = socket.create_connection(server.getsockname(), TIMEOUT)
            ours, _ = server.accept()
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 14)
        self._file = self.socket.makefile('rb')
        protocol = rospy.impl.tcpros_pubsub.TCPROSPub('/t', rospy.AnyMsg)
        self.transport = rospy.impl.tcpros_base.TCPROSTransport(protocol, '/t')
        self.transport.set_socket(ours, '/subscriber')
        self.sender = Sender(self.transport, queue_size, start_thread)
        self._numbers = itertools.count()

    def write(self, size):
        self.sender.write_data(struct.pack('<II', next(self._numbers), size) + bytes(size))

    def read(self):
        """The number of the next message."""
        number, size = struct.unpack('<II', self._exactly(8))
        assert not self._exactly(size).strip(b'\0')
        return number

    def _exactly(self, size):
        data = self._file.read(size)
        assert len(data) == size
        return data

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.transport.close()
        self.leave()

    def leave(self):
        """The subscriber goes."""
        self._file.close()
        self.socket.close()


def start_thread(run, name):
    threading.Thread(target=run, name=name, daemon=True).start()


def senders():
    return {thread for thread in threading.enumerate() if thread.name == 'sender'}


@settings(deadline=None)
@given(strategies.lists(SIZES, min_size=1, max_size=30), strategies.integers(0, 30))
def test_all_arrive_whole_and_in_order_whenever_they_are_read(sizes, before):
    with Link() as link:
        for size in sizes[:before]:
            link.write(size)
        reader = threading.Thread(target=lambda: numbers.extend(link.read() for _ in sizes))
        numbers = []
        reader.start()
        for size in sizes[before:]:
            link.write(size)
        reader.join(TIMEOUT)
        assert numbers == list(range(len(sizes)))
        link.sender.flush(TIMEOUT)
        assert link.transport.stat_num_msg == len(sizes)
        assert link.transport.stat_bytes == sum(sizes) + 8 * len(sizes)


@settings(deadline=None)
@given(strategies.lists(SIZES, min_size=1, max_size=40), strategies.integers(1, 5))
def test_of_what_is_not_read_the_newest_are_kept(sizes, queue_size):
    with Link(queue_size) as link:
        for size in sizes:
            link.write(size)
        link.write(0)
        newest = list(range(len(sizes) + 1))[-queue_size:]
        read = [link.read()]
        while read[-1] != len(sizes):
            read.append(link.read())
        assert read == sorted(set(read))
        assert read[-len(newest) :] == newest


def test_a_small_message_is_sent_by_its_publisher():
    with Link() as link:
        link.transport.write_data = None  # the thread's way
        link.write(1000)
        assert link.read() == 0
        assert link.transport.stat_num_msg == 1


def test_flush_waits_until_the_socket_has_everything():
    with Link() as link:
        link.write(4 * AT_ONCE)
        link.sender.flush(0.0)  # and gives up at its time limit
        reader = threading.Thread(target=link.read)
        reader.start()
        link.sender.flush(TIMEOUT)
        assert link.transport.stat_num_msg == 1
        reader.join(TIMEOUT)


@pytest.mark.parametrize('size', [0, 4 * AT_ONCE])
def test_who_publishes_after_the_link_broke_is_told(size):
    before = senders()
    with Link() as link:

        def is_told():
            try:
                link.write(size)
            except (OSError, rospy.exceptions.TransportException):
                return True

        link.leave()
        until(is_told)
    until(lambda: senders() <= before, what='the end of the thread')


def test_closing_ends_the_thread_and_those_who_wait():
    before = senders()
    with Link() as link:
        link.write(4 * AT_ONCE)
        waiting = threading.Thread(target=link.sender.flush, args=(TIMEOUT,))
        waiting.start()
        link.leave()
        link.transport.close()
        waiting.join(TIMEOUT)
        assert not waiting.is_alive()
    until(lambda: senders() <= before, what='the end of the thread')
