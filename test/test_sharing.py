"""Shared connections: nodes of one process that hear one topic of one node elsewhere, by TCPROS."""
import gc
import threading
import time
import weakref

import pytest

from helpers import TIMEOUT, Peer, create
from pharos import Master, message_class
from pharos.private_rospy.topics import SHARED_QUEUE, SOCKET_BYTES
from pharos.testing import until

STRING = 'std_msgs/String'
PUBLISHER = """
import itertools, threading, time
from std_msgs.msg import String
publisher = rospy.Publisher('/words', String, queue_size=10000, latch={latch})
ends = threading.Event()
def count():
    for number in itertools.count():
        if ends.wait(0.002): return
        publisher.publish(str(number))
"""


@pytest.fixture
def sharing(master):
    """A master whose nodes share connections."""
    return Master(master.url, share_connections=True)


@pytest.fixture
def publisher(peer):
    peer.run(PUBLISHER.format(latch=False))
    return peer


def listeners(master, count, delegate=None, **options):
    """Create nodes with a channel each, and return the channels when they are connected."""
    channels = []
    for number in range(count):
        node = create(master, f'/ear{number}')
        channels.append(node.interested_in('/words', STRING, delegate, **options))
    until(lambda: all(channel.connections == [('/peer', 'TCPROS')] for channel in channels))
    return channels


def words(messages):
    return [message.data for message in messages]


@pytest.mark.parametrize('shares', [True, False])
def test_nodes_share_one_connection_if_asked(master, publisher, shares):
    heard = []
    channels = listeners(
        Master(master.url, share_connections=shares),
        3,
        lambda message, channel: heard.append(channel),
    )
    until(lambda: publisher.value('publisher.get_num_connections()') == (1 if shares else 3))
    publisher.run("publisher.publish('x')")
    until(lambda: len(heard) == 3)
    assert set(heard) == set(channels)
    assert [channel.received for channel in channels] == [1, 1, 1]


def test_each_node_has_its_own_message(sharing, publisher):
    heard = []

    def change(message):
        heard.append(message)
        message.data += '!'

    listeners(sharing, 3, change)
    publisher.run("publisher.publish('x')")
    until(lambda: len(heard) == 3)
    assert words(heard) == ['x!', 'x!', 'x!']
    assert len({id(message) for message in heard}) == 3


def test_shared_channels_get_one_object(sharing, publisher):
    heard = []
    listeners(sharing, 3, heard.append, shared=True)
    publisher.run("publisher.publish('x')")
    until(lambda: len(heard) == 3)
    assert len({id(message) for message in heard}) == 1


def test_late_node_gets_the_latched_message_once(sharing, peer):
    peer.run(PUBLISHER.format(latch=True))
    peer.run("publisher.publish('latched')")
    first, late = [], []
    listeners(sharing, 1, first.append)
    until(lambda: first)
    create(sharing, '/late').interested_in('/words', STRING, late.append)
    until(lambda: late)
    peer.run("publisher.publish('next')")
    until(lambda: len(late) > 1 and len(first) > 1)
    assert words(late) == words(first) == ['latched', 'next']


@pytest.mark.parametrize('plain', [True, False])
def test_node_that_stops_takes_nothing_from_others(sharing, publisher, plain):
    """The first one, whose connection rospy has made, and one that came later."""
    heard = {number: [] for number in range(4)}
    nodes = [create(sharing, f'/ear{number}') for number in heard]
    for number, node in enumerate(nodes):
        if plain:
            node.ros.Subscriber('/words', message_class(STRING), heard[number].append)
        else:
            node.interested_in('/words', STRING, heard[number].append)
    publisher.run('threading.Thread(target=count, daemon=True).start()')
    until(lambda: all(len(messages) > 20 for messages in heard.values()))
    nodes[0].stop()
    nodes[2].stop()
    counts = len(heard[1]), len(heard[3])
    until(lambda: len(heard[1]) > counts[0] + 50 and len(heard[3]) > counts[1] + 50)
    publisher.run('ends.set()')
    for number in 1, 3:
        numbers = [int(message.data) for message in heard[number]]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def test_publisher_that_comes_back_is_heard_by_all(sharing, master):
    heard = [[], []]
    for number, messages in enumerate(heard):
        create(sharing, f'/ear{number}').interested_in('/words', STRING, messages.append)
    for word in 'first', 'second':
        with Peer(master.url, 'mouth') as mouth:
            mouth.run(PUBLISHER.format(latch=False))
            until(lambda: mouth.value('publisher.get_num_connections()') == 1, TIMEOUT)
            until(lambda: publish_until_heard(mouth, word, heard), TIMEOUT)


def publish_until_heard(peer, word, heard):
    peer.run(f'publisher.publish({word!r})')
    return all(word in words(messages) for messages in heard)


def test_topic_that_is_registered_anew_is_heard_by_all(sharing, publisher):
    """The publisher's node lives on: its address is the same."""
    nodes = [create(sharing, f'/ear{number}') for number in range(6)]
    heard = [[] for _ in nodes]
    for node, messages in zip(nodes, heard):
        node.interested_in('/words', STRING, messages.append)
    for word in 'abcde':
        publisher.run('publisher.unregister()')
        publisher.run("publisher = rospy.Publisher('/words', String, queue_size=10)")
        until(lambda: publish_until_heard(publisher, word, heard), TIMEOUT)


def test_ended_connection_keeps_no_node_alive(sharing, master):
    node = create(sharing, '/ear')
    run = weakref.ref(node._current_run)
    with Peer(master.url, 'mouth') as mouth:
        mouth.run(PUBLISHER.format(latch=True))
        mouth.run("publisher.publish('x')")
        (channel,) = [node.interested_in('/words', STRING, lambda message: None)]
        until(lambda: channel.received)
        node.stop()
        node.start()  # makes another run
        until(lambda: gc.collect() and run() is None, TIMEOUT)


def test_blocked_node_does_not_hold_up_others(sharing, publisher):
    may_end, heard = threading.Event(), []
    blocked = create(sharing, '/blocked')
    blocked.ros.Subscriber('/words', message_class(STRING), lambda message: may_end.wait(TIMEOUT))
    create(sharing, '/other').interested_in('/words', STRING, heard.append)
    until(lambda: publisher.value('publisher.get_num_connections()') == 1)
    publisher.run("for number in range(10): publisher.publish(str(number)); time.sleep(0.01)")
    try:
        until(lambda: '9' in words(heard))
    finally:
        may_end.set()


def test_slow_callback_without_queue_size_gets_all(sharing, publisher):
    """Messages of 2 MB wait, as in the publisher's queue and the sockets of a process."""
    heard = []

    def hear(message):
        heard.append(message.data[0])
        time.sleep(0.02)

    create(sharing, '/slow').ros.Subscriber('/words', message_class(STRING), hear)
    until(lambda: publisher.value('publisher.get_num_connections()') == 1)
    publisher.run("for letter in 'abcdefghijkl': publisher.publish(letter * 2_000_000)")
    until(lambda: len(heard) == 12)
    assert ''.join(heard) == 'abcdefghijkl'


def test_slow_callback_without_queue_size_does_not_fall_behind(sharing, publisher):
    """It hears what would wait between processes: what is older is dropped."""
    heard, may_go_on = [], threading.Event()

    def hear(message):
        heard.append(message.data[0])
        may_go_on.wait(TIMEOUT)

    create(sharing, '/slow').ros.Subscriber('/words', message_class(STRING), hear)
    quick = []
    create(sharing, '/quick').interested_in('/words', STRING, quick.append)
    until(lambda: publisher.value('publisher.get_num_connections()') == 1)
    publisher.run("publisher.publish('a')")
    until(lambda: heard)
    size = SOCKET_BYTES // 3
    for letter in 'bcdefghijklmnopqrstuvwxyz':
        publisher.run(f'publisher.publish({letter!r} * {size})')
        until(lambda letter=letter: quick[-1].data[0] == letter)
    may_go_on.set()
    until(lambda: heard[-1] == 'z')
    waiting = SHARED_QUEUE + 2  # a message has some bytes more
    assert ''.join(heard) == 'a' + 'bcdefghijklmnopqrstuvwxyz'[-waiting:]


def test_subscriptions_that_come_and_go_disturb_nobody(sharing, publisher):
    """One waits for single messages in a loop, and so joins and leaves; each wait ends."""
    heard = []
    create(sharing, '/steady').interested_in('/words', STRING, heard.append)
    waiting = create(sharing, '/waiting')
    publisher.run('threading.Thread(target=count, daemon=True).start()')
    for _ in range(60):
        waiting.ros.wait_for_message('/words', message_class(STRING), TIMEOUT)
    until(lambda: heard)
    publisher.run('ends.set()')
    numbers = [int(message.data) for message in heard]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def test_from_names_the_publisher(sharing, publisher):
    heard, unheard = [], []
    create(sharing, '/a').interested_in('/words', STRING, heard.append, from_='/peer')
    create(sharing, '/b').interested_in('/words', STRING, unheard.append, from_='/other')
    until(lambda: publisher.value('publisher.get_num_connections()') == 1)
    until(lambda: publish_until_heard(publisher, 'x', [heard]))
    assert unheard == []
