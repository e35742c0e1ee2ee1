"""Waiting for the next message on a topic, in whatever thread."""
import subprocess
import threading
from unittest import mock

import pytest
import std_msgs.msg

from helpers import create, ended, in_thread, speak_tcpros_only
from pharos import next_message
from pharos.intraprocess.inbox import Inbox
from pharos.testing import TIMEOUT
import pharos

INT = 'std_msgs/Int32'


@pytest.fixture
def pair(master):
    """A node that waits, and one that publishes on /waited."""
    waiting, sending = create(master, '/waiting'), create(master, '/sending')
    return waiting, sending, sending.output_channel('/waited', INT)


def send_when_heard(channel, *values):
    """Send numbers as soon as somebody is connected, from a thread of its own."""

    def send():
        channel.wait_for_subscribers(timeout=TIMEOUT)
        for value in values:
            channel.send(data=value)

    return in_thread(send)


def is_left(master, node):
    """Whether a subscription of the node is left."""
    return bool(node.channels) or node.name in str(master.topic('/waited').subscribers)


def test_the_next_message_is_returned_and_nothing_is_left(master, pair):
    waiting, sending, channel = pair
    thread = send_when_heard(channel, 1, 2)
    assert waiting.wait_for_message('/waited', timeout=TIMEOUT).data == 1
    assert ended(thread)
    assert not is_left(master, waiting)
    assert channel.connections == []


def test_it_comes_without_a_socket_and_with_its_header(master, pair):
    waiting, sending, channel = pair
    transports = []
    thread = send_when_heard(channel, 1)
    message = waiting.wait_for_message(
        '/waited', INT, where=lambda message: transports.extend(channel.connections) or True
    )
    assert transports == [('/waiting', 'INTRAPROCESS')]
    assert message._connection_header['callerid'] == '/sending'
    assert ended(thread)


def test_it_comes_through_tcpros(master, pair):
    waiting, sending, channel = pair
    speak_tcpros_only(waiting)
    thread = send_when_heard(channel, 1)
    assert waiting.wait_for_message('/waited', timeout=TIMEOUT).data == 1
    assert ended(thread)
    assert not is_left(master, waiting)


def test_rostopic_sends_it(master):
    node = create(master)
    command = 'rostopic pub -r 20 /waited std_msgs/Int32 5'.split()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as publisher:
        try:
            message = node.wait_for_message('/waited', std_msgs.msg.Int32, TIMEOUT)  # as rospy's
        finally:
            publisher.terminate()
    assert message.data == 5


def test_a_latched_message_comes_at_once_also_beside_a_channel(master, mailbox):
    node, other = create(master), create(master, '/other')
    other.output_channel('/waited', INT, latch=True).send(data=7)
    assert node.wait_for_message('/waited', timeout=TIMEOUT).data == 7
    node.interested_in('/waited', delegate=mailbox)
    assert mailbox.next().data == 7
    assert node.wait_for_message('/waited', timeout=TIMEOUT).data == 7
    assert len(node.channels) == 1


def test_a_message_that_is_dropped_while_it_is_taken_is_none(master, pair):
    waiting, sending, channel = pair
    is_dropped = threading.Event()
    run_next = Inbox.run_next

    def run_when_it_is_dropped(inbox):
        if not is_dropped.is_set():  # as where the next one is too large for both
            inbox._queue.clear()
            is_dropped.set()
        return run_next(inbox)

    with mock.patch.object(Inbox, 'run_next', run_when_it_is_dropped):
        send_when_heard(channel, 1)
        in_thread(lambda: is_dropped.wait(TIMEOUT) and channel.send(data=2))
        assert waiting.wait_for_message('/waited', timeout=TIMEOUT).data == 2


def test_a_channel_of_the_node_gets_the_message_too(master, pair, mailbox):
    waiting, sending, channel = pair
    waiting.interested_in('/waited', delegate=mailbox)
    in_thread(lambda: [channel.send(data=3) for _ in sending.every(0.02)])
    message = waiting.wait_for_message('/waited', timeout=TIMEOUT)
    assert message.data == mailbox.next().data == 3
    assert message is not mailbox.next()


def test_where_chooses_and_what_it_raises_is_raised(master, pair):
    waiting, sending, channel = pair
    thread = send_when_heard(channel, *range(10))
    assert waiting.wait_for_message('/waited', where=lambda message: message.data > 4).data == 5
    assert ended(thread)
    thread = send_when_heard(channel, 0)
    with pytest.raises(ZeroDivisionError):
        waiting.wait_for_message('/waited', where=lambda message: 1 / message.data)
    assert ended(thread)
    assert not is_left(master, waiting)
    with pytest.raises(TypeError, match=r'called as where\(message\)'):
        waiting.wait_for_message('/waited', where=lambda: True)


@pytest.mark.parametrize(
    'topic', ['/waited/trigger', '/waited'], ids=['another topic', 'its own topic']
)
def test_a_delegate_waits_for_a_message_while_it_runs(master, pair, topic):
    """It is the node's dispatcher that would bring it to a channel, and that is busy."""
    waiting, sending, channel = pair
    got, has_got = [], threading.Event()

    def delegate(message, channel):
        if not got:
            got.append(waiting.wait_for_message('/waited', timeout=TIMEOUT).data)
            has_got.set()

    waiting.interested_in(topic, INT, delegate=delegate)
    sending.send_to(topic, data=1, typed_as=INT)
    in_thread(lambda: [channel.send(data=2) for _ in sending.every(0.02)])
    assert has_got.wait(TIMEOUT)
    assert got == [2]
    assert not waiting.errors


def test_a_delegate_that_reads_the_socket_itself_is_told_that_nothing_would_come(master, pair):
    waiting, sending, channel = pair
    speak_tcpros_only(waiting)
    asked, told = threading.Event(), threading.Event()

    def delegate(message, channel):
        if asked.is_set() and waiting.latest_run.rospy.connections.is_read_here('/waited'):
            with pytest.raises(pharos.PharosError, match='thread that brings .*/waited.*fork'):
                waiting.wait_for_message('/waited', timeout=TIMEOUT)
            told.set()

    heard = waiting.interested_in('/waited', delegate=delegate)
    in_thread(lambda: [channel.send(data=2) for _ in sending.every(0.001)])
    asked.set()
    assert told.wait(TIMEOUT)
    heard.close()


def test_a_soul_waits_and_ends_with_its_node(master, pair):
    waiting, sending, channel = pair
    thread = waiting.fork(lambda me: me.wait_for_message('/waited/never', INT))
    assert sending.output_channel('/waited/never', INT).wait_for_subscribers(timeout=TIMEOUT)
    waiting.stop()
    assert ended(thread)
    assert not waiting.errors


def test_the_main_thread_is_told_that_the_node_stops(master, pair):
    waiting, sending, channel = pair
    never = sending.output_channel('/waited/never', INT)
    thread = in_thread(lambda: never.wait_for_subscribers(timeout=TIMEOUT) and waiting.stop())
    with pytest.raises(
        pharos.NodeStoppedError, match='/waiting stops, and the wait .* /waited/never'
    ):
        waiting.wait_for_message('/waited/never', INT)
    assert ended(thread)
    with pytest.raises(pharos.NodeStoppedError, match=r'/waiting is stopped: start\(\) it first'):
        waiting.wait_for_message('/waited/never', INT)


def test_the_block_of_another_node_stops_to_wait_when_that_stops(master, pair):
    waiting, sending, channel = pair
    never = sending.output_channel('/waited/never', INT)
    other = create(master, '/other', soul=lambda me: waiting.wait_for_message('/waited/never', INT))
    thread = other.fork()
    assert never.wait_for_subscribers(timeout=TIMEOUT)
    other.stop()
    assert ended(thread)
    assert waiting.channels == []


def test_a_node_that_stops_before_the_first_message_is_waited_for_ends_the_wait(
    master, pair, monkeypatch
):
    waiting, sending, channel = pair
    take, other = next_message.NextMessages.take, create(master, '/other')

    def stop_and_take(*args):
        in_thread(other.stop)
        assert other.latest_run.rospy.ended.wait(TIMEOUT)
        return take(*args)

    monkeypatch.setattr(next_message.NextMessages, 'take', stop_and_take)
    assert ended(other.fork(lambda me: waiting.wait_for_message('/waited/never', INT)))
    assert waiting.channels == []


def test_a_restart_of_its_own_node_between_two_messages_is_what_ends_the_wait(master, pair):
    waiting, sending, channel = pair

    def restart(message):
        assert ended(in_thread(waiting.restart))

    restarted = sending.output_channel('/waited/restarted', INT)
    thread = in_thread(
        lambda: restarted.wait_for_subscribers(timeout=TIMEOUT) and restarted.send(data=1)
    )
    with pytest.raises(pharos.NodeStoppedError, match='/waiting stops, and the wait'):
        waiting.wait_for_message('/waited/restarted', INT, where=restart)
    assert ended(thread)


def test_what_does_not_come_in_time_is_a_timeout_error_that_names_the_publishers(master, pair):
    waiting, sending, channel = pair
    for topic, who in ('/waited', '/sending'), ('/waited/never', 'nobody'):
        with pytest.raises(
            TimeoutError, match=rf'in time \(0.05 s\) on {topic}: .* published by {who}$'
        ):
            waiting.wait_for_message(topic, INT, timeout=0.05)
    thread = send_when_heard(channel, 1, 2)
    with pytest.raises(TimeoutError, match=r'where\(\) held for none of 2'):
        waiting.wait_for_message('/waited', timeout=0.5, where=lambda message: False)
    assert ended(thread)
    assert not is_left(master, waiting)


def test_another_type_is_told_in_the_timeout_error(master, pair, transcript):
    waiting, sending, channel = pair
    with pytest.raises(TimeoutError, match='/sending, as another type than std_msgs/String'):
        waiting.wait_for_message('/waited', 'std_msgs/String', timeout=0.5)


def test_a_topic_without_a_type_is_unknown_or_waited_for_within_the_time_limit(master):
    node, other = create(master), create(master, '/other')
    for timeout in None, 0.05:
        with pytest.raises(pharos.UnknownTopicError, match='/waited/untyped.*typed_as='):
            node.wait_for_message('/waited/untyped', timeout=timeout)

    def come():
        other.output_channel('/waited/untyped', INT, latch=True).send(data=4)

    thread = in_thread(come)
    assert node.wait_for_message('/waited/untyped', timeout=TIMEOUT).data == 4
    assert ended(thread)


def test_a_start_waits_for_a_message(master, mailbox):
    class Follower(pharos.Node):
        def start(self):
            super().start()
            self.first = self.wait_for_message('/waited', timeout=TIMEOUT).data

    create(master, '/other').output_channel('/waited', INT, latch=True).send(data=4)
    follower = create(master, '/follower', Follower)
    assert follower.first == 4
    follower.restart()
    assert follower.first == 4
