"""What waits for a slow receiver is bounded: by a number of messages, and by their bytes."""
import struct
import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import create, ended, in_thread, speak_tcpros_only
from pharos.testing import Mailbox, TIMEOUT, until
from pharos import Node, define_message, message_class
from pharos.intraprocess.dispatcher import Dispatcher
from pharos.intraprocess.inbox import Inbox
from pharos.private_rospy import sender
from sockets import subscribe

BYTES, NUMBERS = 'std_msgs/UInt8MultiArray', 'std_msgs/Float64MultiArray'
MEGABYTE = 1 << 20


class Gate:
    """A delegate that is entered with the first message, and keeps all others waiting until it is
    opened."""

    def __init__(self):
        self.entered, self.opened, self.sizes = threading.Event(), threading.Event(), Mailbox()

    def __call__(self, message, channel):
        self.entered.set()
        self.opened.wait(TIMEOUT)
        self.sizes(len(message.data), channel)


class Small(Node):
    queue_bytes = 4 * MEGABYTE


@pytest.mark.parametrize('shared', [False, True])
def test_large_messages_wait_up_to_so_many_bytes_and_the_oldest_are_dropped_and_counted(
    master, shared
):
    gate = Gate()
    received = create(master, '/receiver', Small, delegate=gate).interested_in(
        '/large', BYTES, shared=shared
    )
    sent = create(master, '/sender').output_channel('/large', BYTES)
    sent.send(data=b'')
    assert gate.entered.wait(TIMEOUT)
    for number in range(10):
        sent.send(data=bytes(MEGABYTE - 1000 + number))
    assert received.dropped == 6
    gate.opened.set()
    assert [len_ for len_ in gate.sizes.take(5)] == [0, *range(MEGABYTE - 994, MEGABYTE - 990)]
    assert (received.received, received.dropped) == (5, 6)


def test_messages_are_large_too_where_their_definition_fixes_their_size(master):
    fixed = define_message('queues_test/Fixed', f'uint8[{MEGABYTE}] data')
    gate = Gate()
    received = create(master, '/receiver', Small, delegate=gate).interested_in('/fixed', fixed)
    sent = create(master, '/sender').output_channel('/fixed', fixed)
    sent.send()
    assert gate.entered.wait(TIMEOUT)
    for _ in range(10):
        sent.send()
    gate.opened.set()
    assert received.dropped == 7  # three, and a little for each, are less than four megabytes


def test_the_newest_message_has_room_however_large_it_is(master):
    gate = Gate()
    received = create(master, '/receiver', Small, delegate=gate).interested_in('/larger', BYTES)
    sent = create(master, '/sender').output_channel('/larger', BYTES)
    sent.send(data=b'')
    assert gate.entered.wait(TIMEOUT)
    for size in (10, 20 * MEGABYTE, 30, 40):
        sent.send(data=bytes(size))
    gate.opened.set()
    assert gate.sizes.take(3) == [0, 30, 40]
    assert received.dropped == 2


def test_by_default_a_slow_receiver_of_images_holds_64_megabytes(master):
    gate = Gate()
    received = create(master, '/receiver', delegate=gate).interested_in('/images', BYTES)
    sent = create(master, '/sender').output_channel('/images', BYTES)
    sent.send(data=b'')
    assert gate.entered.wait(TIMEOUT)
    image = bytes(10 * MEGABYTE)
    for _ in range(20):
        sent.send(data=image)
    assert received.dropped == 14
    gate.opened.set()


def test_what_comes_through_tcpros_is_bounded_by_bytes_too(master):
    gate = Gate()
    received = create(master, '/receiver', Small, delegate=gate).interested_in('/remote', NUMBERS)
    message = received.message_class
    offer = received._endpoint.callback
    offer(message())
    received.node.latest_run.dispatcher.schedule(offer._inbox)
    assert gate.entered.wait(TIMEOUT)
    for _ in range(10):
        offer(message(data=(1.0,) * (MEGABYTE // 8)))
    assert received.dropped == 7
    gate.opened.set()


class Receiver:
    queue_size, queue_bytes, inline, shared = 5, 100, True, False

    def __init__(self):
        self.taken, self.dropped = [], 0

    def deliver(self, message, header):
        self.taken.append(message)

    def count_dropped(self):
        self.dropped += 1


@settings(max_examples=300, deadline=None)
@given(st.lists(st.one_of(st.none(), st.integers(1, 150)), max_size=60))
def test_a_queue_never_holds_more_than_it_may_and_counts_what_it_drops(steps):
    """None takes a message, a number puts one of so many bytes."""
    receiver = Receiver()
    inbox = Inbox(receiver, Dispatcher(None))
    put = []
    for size in steps:
        if size is None:
            inbox.run_next()
        else:
            put.append(size)
            inbox.put(size, size)
            waiting = list(inbox._queue)
            assert waiting == put[len(put) - len(waiting) :]
            assert len(waiting) <= 5
            assert sum(waiting) <= 100 or len(waiting) == 1
        assert receiver.dropped == len(put) - len(receiver.taken) - len(inbox._queue)


def test_no_delegate_begins_to_run_inline_once_the_dispatcher_has_closed():
    dispatcher = Dispatcher(None)
    receiver, closing = Receiver(), Receiver()
    inbox, others = Inbox(receiver, dispatcher), Inbox(closing, dispatcher)

    def close(message, header):
        dispatcher.close()
        inbox.put('put while another delegate runs')

    closing.deliver = close
    others.put('closes')
    dispatcher.run()
    assert receiver.taken == []
    inbox.put('put afterwards')
    dispatcher.run()
    assert receiver.taken == []


def test_a_dispatcher_that_closes_while_its_thread_waits_for_a_delegate_runs_no_more():
    threads = []

    def start_thread(target, name):
        threads.append(threading.Thread(target=target, name=name, daemon=True))
        threads[-1].start()

    dispatcher = Dispatcher(start_thread)
    receiver = Receiver()
    receiver.inline = False
    inbox = Inbox(receiver, dispatcher)
    dispatcher.need_thread()

    def close_while_the_thread_waits():
        inbox.put('waits for this delegate')
        dispatcher.wake()
        until(lambda: not dispatcher.scheduled, what='the thread to take the inbox')
        dispatcher.close()

    dispatcher.run_in_turn(close_while_the_thread_waits)
    threads[0].join(TIMEOUT)
    assert not threads[0].is_alive()
    assert receiver.taken == []


class Connection:
    """A connection whose socket is full, and stays so."""

    done, socket, cleanup_cb = False, None, None

    def __init__(self):
        self.writes = threading.Semaphore(0)

    def set_cleanup_callback(self, callback):
        pass

    def write_data(self, data):
        self.writes.acquire()


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(1, 150), max_size=30))
def test_what_waits_for_a_subscriber_elsewhere_is_bounded_too(sizes):
    threads = []
    way = sender.Sender(
        Connection(), 5, lambda target, name: threads.append(target), queue_bytes=100
    )
    way._is_idle = False
    for size in sizes:
        way.write_data(bytes(size))
        waiting = [len(data) for data in way._queue]
        assert len(waiting) <= 5
        assert sum(waiting) <= 100 or len(waiting) == 1
        assert waiting[-1] == size


def test_a_latched_message_that_waits_counts_with_its_bytes(master):
    gate = Gate()
    receiver = create(master, '/receiver', Small)
    receiver.interested_in('/busy_with', BYTES, delegate=gate)
    sender = create(master, '/sender')
    sender.output_channel('/latched_large', BYTES, latch=True).send(data=bytes(3 * MEGABYTE))
    sender.send_to('/busy_with', typed_as=BYTES, data=b'')
    assert gate.entered.wait(TIMEOUT)
    latched = receiver.interested_in('/latched_large', BYTES, delegate=gate)
    sender.send_to('/latched_large', data=bytes(3 * MEGABYTE))
    assert latched.dropped == 1
    gate.opened.set()


# -- what waits for a subscriber elsewhere


def read(sock, count):
    """The ``data`` of so many messages, after the connection header."""
    file = sock.makefile('rb')
    read = [file.read(*struct.unpack('<I', file.read(4))) for _ in range(count + 1)]
    return [message[12:] for message in read[1:]]


@pytest.mark.parametrize('first, second', [(100, 1), (1, 100)])
def test_of_the_sizes_that_the_channels_of_a_topic_ask_for_the_largest_is_the_queues(
    master, first, second
):
    node = create(master, '/sender')
    sent = node.output_channel('/remote', BYTES, queue_size=first)
    with subscribe(node.tcp_port, '/remote') as sock:
        until(lambda: sent.connections)
        node.output_channel('/remote', BYTES, queue_size=second)
        messages = [bytes([number]) * (MEGABYTE // 2) for number in range(30)]
        for message in messages:
            sent.send(data=message)
        assert read(sock, 30) == messages


@pytest.mark.filterwarnings('ignore:The publisher should be created')
def test_a_channel_waits_for_nobody_also_beside_a_publisher_without_a_queue(master):
    node = create(master, '/sender')
    plain = node.ros.Publisher('/remote', message_class(BYTES))
    with subscribe(node.tcp_port, '/remote') as sock:
        until(plain.get_num_connections)
        sent = node.output_channel('/remote', BYTES)
        messages = [bytes([number]) * (MEGABYTE // 2) for number in range(30)]
        thread = in_thread(lambda: [sent.send(data=message) for message in messages])
        assert ended(thread)
        assert read(sock, 30) == messages
    until(lambda: not sent.connections)


def test_the_queue_of_a_plain_subscriber_cuts_nothing_of_a_channel_beside_it(master):
    node, mailbox, plain = speak_tcpros_only(create(master, '/receiver')), Mailbox(), Gate()
    node.ros.Subscriber(
        '/beside', message_class(BYTES), lambda message: plain(message, None), queue_size=1
    )
    channel = node.interested_in('/beside', BYTES, delegate=mailbox)
    sent = create(master, '/sender').output_channel('/beside', BYTES)
    sent.send()
    assert plain.entered.wait(TIMEOUT)
    for size in range(1, 100):
        sent.send(data=bytes(size))
    plain.opened.set()
    assert [len(mailbox.next().data) for _ in range(100)] == list(range(100))
    assert channel.dropped == 0
    sizes = [plain.sizes.next()]
    while sizes[-1] != 99:
        sizes.append(plain.sizes.next())
    assert len(sizes) < 50  # it gets the newest of what was read at once
