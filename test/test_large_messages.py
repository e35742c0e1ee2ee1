"""Messages over TCPROS that are larger than what is read from a socket at once."""
import resource
import struct
import sys

import pytest
from sensor_msgs.msg import Image
from std_msgs.msg import String

from helpers import create, speak_tcpros_only
from pharos.testing import Mailbox, TIMEOUT, until
from programs import PROGRAMS, Program, run

MB = 1 << 20
READ = 1 << 16  # as much is read at once
SIZES = (10, 2 * MB, 10, 0, READ - 4, READ - 3, 5 * MB, 5 * MB, READ, READ + 1, 3, 2 * MB, 7)


@pytest.fixture
def receiver(master):
    return speak_tcpros_only(create(master, '/receiver'))


def opened(master, receiver, topic, message_class):
    """The channel of another node, to which the receiver is connected."""
    channel = create(master, '/sender').output_channel(topic, message_class, queue_size=100)
    assert channel.wait_for_subscribers(1, TIMEOUT)
    return channel


def connection_of(receiver, topic):
    """The receiver's end, as rospy has it."""
    (connection,) = receiver.latest_run.rospy.subscriber(topic).connections
    return connection


@pytest.mark.parametrize('is_plain', [False, True])
def test_messages_of_all_sizes_arrive_whole_and_in_order(master, receiver, mailbox, is_plain):
    if is_plain:
        receiver.ros.Subscriber('/sizes', String, lambda message: mailbox(message, None))
    else:
        receiver.interested_in('/sizes', String, mailbox, queue_size=100)
    channel = opened(master, receiver, '/sizes', String)
    texts = [chr(ord('a') + number) * size for number, size in enumerate(SIZES)]
    for text in texts:
        channel.publish(String(text))
    for text in texts:
        assert mailbox.next().data == text


def test_all_bytes_are_counted(master, receiver, mailbox):
    receiver.interested_in('/counted', String, mailbox, queue_size=100)
    channel = opened(master, receiver, '/counted', String)
    connection = connection_of(receiver, '/counted')
    # rospy does not count what comes along with the handshake
    until(lambda: getattr(connection, 'is_heard', False))
    for size in SIZES:
        channel.publish(String('x' * size))
    for _ in SIZES:
        mailbox.next()
    assert connection.stat_num_msg == len(SIZES)
    header = connection.stat_bytes - sum(SIZES) - 8 * len(SIZES)
    assert 0 <= header < 1000  # which the subscriber sent


def test_one_large_message_after_the_other_takes_no_new_memory(master):
    """With rospy the system gives, and clears, as many pages anew as each message has, which is half
    of the time that an image takes; not always in this process, where memory has been used before.
    """
    sends = sys.executable, str(PROGRAMS / 'sends_images.py'), '/images', str(6 * MB), '20'
    with Program(master.url, *sends):
        ended = run(master.url, sys.executable, str(PROGRAMS / 'hears_images.py'))
    assert ended.returncode == 0, ended.stderr
    assert float(ended.stdout.split()[1]) < 6 * MB / resource.getpagesize() / 2


def test_who_hears_any_type_keeps_what_came(master, receiver, mailbox):
    receiver.ros.Subscriber('/any', receiver.ros.AnyMsg, lambda message: mailbox(message, None))
    channel = opened(master, receiver, '/any', String)
    for text in 'abc':
        channel.publish(String(text * 2 * MB))
    heard = [mailbox.next() for _ in 'abc']
    assert [type(message._buff) for message in heard] == [bytes] * 3
    assert [message._buff[4:] for message in heard] == [b'a' * 2 * MB, b'b' * 2 * MB, b'c' * 2 * MB]


def written_by_hand(node, keeps):
    """A class for String that keeps of what comes what ``keeps(bytes)`` returns."""

    class ByHand(node.ros.AnyMsg):
        _type, _md5sum, _full_text = String._type, String._md5sum, String._full_text

        def deserialize(self, data):
            self._buff = keeps(data)
            return self

    return ByHand


@pytest.mark.parametrize('keeps', [lambda data: data, memoryview], ids=['all', 'a view'])
def test_a_class_written_by_hand_keeps_what_came(master, receiver, mailbox, keeps):
    by_hand = written_by_hand(receiver, keeps)
    receiver.ros.Subscriber('/by_hand', by_hand, lambda message: mailbox(message, None))
    channel = opened(master, receiver, '/by_hand', String)
    for text in 'abc':
        channel.publish(String(text * 2 * MB))
    heard = [mailbox.next()._buff for _ in 'abc']
    assert [bytes(kept[4:6]) for kept in heard] == [b'aa', b'bb', b'cc']


def test_a_publisher_that_leaves_within_a_large_message_is_found_again(master, receiver, mailbox):
    receiver.interested_in('/torn', String, mailbox)
    channel = opened(master, receiver, '/torn', String)
    torn = connection_of(receiver, '/torn')
    (connection,) = channel.node.latest_run.rospy.publisher('/torn').fanout.connections
    connection.write_data(struct.pack('<I', 3 * MB) + bytes(2 * MB))
    connection.flush(TIMEOUT)
    connection.close()
    until(lambda: torn.done and channel.wait_for_subscribers(1, TIMEOUT))
    until(lambda: connection_of(receiver, '/torn').header)
    channel.publish(String('whole'))
    assert mailbox.next().data == 'whole'


def test_a_large_message_that_cannot_be_read_ends_the_connection(master, receiver, monkeypatch):
    told = Mailbox()
    monkeypatch.setattr(receiver.latest_run.rospy, 'warn', lambda line: told(line, None))
    receiver.interested_in('/nonsense', Image, lambda message, channel: None)
    channel = opened(master, receiver, '/nonsense', Image)
    (connection,) = channel.node.latest_run.rospy.publisher('/nonsense').fanout.connections
    connection.write_data(struct.pack('<I', 2 * MB) + b'\xff' * (2 * MB))
    line = told.next()
    assert 'for /nonsense closed: ' in line
    assert 'cannot deserialize' in line
