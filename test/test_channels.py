"""Topics and channels: what a node sends, and what another one hears."""
import concurrent.futures
import os
import signal
import sys
import threading
import time

import numpy
import pytest
import rospy
from geometry_msgs.msg import Twist, Vector3
from std_msgs.msg import Int32, String

from helpers import TIMEOUT, Gate, Peer, PharosPeer, create, fill, has_come_to, registrations
import pharos
from pharos import (
    MessageTypeError,
    NodeStoppedError,
    PharosError,
    UnknownNodeError,
    UnknownTopicError,
    UnknownTypeError,
)
from pharos.private_rospy import topics
from pharos.private_rospy.topics import PublisherOverlay
from pharos.testing import Mailbox, until

TWIST, STRING, INT32 = 'geometry_msgs/Twist', 'std_msgs/String', 'std_msgs/Int32'
BYTES, FLOATS, HEADER = 'std_msgs/UInt8MultiArray', 'std_msgs/Float64MultiArray', 'std_msgs/Header'
MEGABYTE = 1 << 20


@pytest.fixture
def node(master):
    return create(master, '/sender')


@pytest.fixture
def other(master):
    return create(master, '/hearer')


@pytest.fixture
def pool(master):
    with concurrent.futures.ThreadPoolExecutor() as pool:
        yield pool


def take(mailbox, count):
    """Take so many messages; returns their data."""
    return [mailbox.next().data for _ in range(count)]


# -- send_to: the type, and what fills the message


@pytest.mark.parametrize('type_', [STRING, String], ids=['name', 'class'])
def test_type_is_name_or_class(node, other, type_):
    mailbox = Mailbox(other, '/chatter', type_)
    node.send_to('/chatter', typed_as=type_, data='hello')
    assert mailbox.next() == String('hello')


def test_type_is_what_node_knows(node):
    node.output_channel('/chatter', STRING)
    assert node.send_to('/chatter', data='hello') == String('hello')


def test_type_is_what_master_knows(node, other):
    mailbox = Mailbox(other, '/chatter', STRING)
    node.send_to('/chatter', data='hello')
    assert mailbox.next() == String('hello')
    assert node.interested_in('/chatter').type == STRING


def test_ready_message_brings_its_type(node, other):
    mailbox = Mailbox(other, '/chatter', STRING)
    ready = String('hello')
    assert node.send_to('/chatter', ready) is ready
    assert mailbox.next() == ready


def set_in_block(message):
    message.linear.x = 2.0
    message.angular.z = 1.0


@pytest.mark.parametrize(
    'block, fields',
    [
        (set_in_block, {}),
        (Twist(Vector3(2, 0, 0), Vector3(0, 0, 1)), {}),
        ({'linear': {'x': 2.0}, 'angular': {'z': 1.0}}, {}),
        (None, {'linear': {'x': 2.0}, 'angular': {'z': 1.0}}),
        (None, {'linear': Vector3(2, 0, 0), 'angular': Vector3(0, 0, 1)}),
        (lambda message: setattr(message.linear, 'x', 2.0), {'angular': {'z': 1.0}}),
    ],
)
def test_message_is_filled_by(node, other, block, fields):
    mailbox = Mailbox(other, '/velocity', TWIST)
    channel = node.output_channel('/velocity', TWIST)
    expected = Twist(Vector3(2, 0, 0), Vector3(0, 0, 1))
    assert node.send_to('/velocity', block, **fields) == mailbox.next() == expected
    assert channel.send(block, **fields) == mailbox.next() == expected


def test_value_fits_its_field(node, other):
    table = [
        (INT32, 7, 7),
        (INT32, numpy.int32(7), 7),
        (STRING, 'grün', 'grün'),
        ('std_msgs/Float64', 2, 2.0),
        ('std_msgs/Time', rospy.Time(1, 2), rospy.Time(1, 2)),
        (FLOATS, [1.0, 2.0], (1.0, 2.0)),
        (BYTES, b'ab', b'ab'),
        (BYTES, [97, 98], b'ab'),
        (BYTES, numpy.array([97, 98], 'u1'), b'ab'),
        (FLOATS, numpy.array([1.0, 2.0]), (1.0, 2.0)),
    ]
    for number, (type_, value, came) in enumerate(table):
        mailbox, cls = Mailbox(other, f'/value{number}', type_), pharos.message_class(type_)
        node.send_to(f'/value{number}', typed_as=type_, data=value)
        node.send_to(f'/value{number}', cls, data=value)
        assert mailbox.next().data == mailbox.next().data == came


@pytest.mark.parametrize(
    'type_, fields, said',
    [
        ('sensor_msgs/CameraInfo', {'K': [1.0] * 3}, 'K takes 9 values, not 3'),
        ('std_msgs/Int32MultiArray', {'data': [1, 'x']}, r'data\[1\]'),
        ('geometry_msgs/Polygon', {'points': [{}, 3]}, r'points\[1\]'),
        ('sensor_msgs/PointCloud2', {'fields': [{}, {'offset': 'a'}]}, r'fields\[1\].offset'),
    ],
)
def test_list_that_does_not_fit_is_named(node, type_, fields, said):
    with pytest.raises(pharos.MessageTypeError, match=said):
        node.send_to('/list', typed_as=type_, **fields)


def test_unfit_field_is_refused(node, other):
    """The channel goes on, and the next message arrives."""
    table = [
        (INT32, None, {'data': 'seven'}),
        (INT32, None, {'data': 1 << 40}),
        (INT32, None, {'no_such_field': 7}),
        (INT32, {'no_such_field': 7}, {}),
        (INT32, String('seven'), {}),
        (STRING, None, {'data': 7}),
        (TWIST, None, {'linear': 2.0}),
        (TWIST, None, {'linear': {'no_such_field': 2.0}}),
        (TWIST, None, {'linear': {'x': 'two'}}),
        (FLOATS, None, {'data': [1.0, 'two']}),
        (HEADER, None, {'stamp': 'now'}),
    ]
    for number, (type_, block, fields) in enumerate(table):
        mailbox = Mailbox(other, f'/field{number}', type_)
        sender = node.output_channel(f'/field{number}', type_)
        with pytest.raises(MessageTypeError):
            node.send_to(f'/field{number}', block, **fields)
        with pytest.raises(MessageTypeError):
            sender.send(block, **fields)
        assert sender.sent == 0
        assert sender.send() == mailbox.next()


def test_other_type_leaves_nothing_registered(node, other):
    node.output_channel('/chatter', STRING)
    for open_ in node.output_channel, node.interested_in:
        with pytest.raises(MessageTypeError):
            open_('/chatter', INT32)
    with pytest.raises(MessageTypeError):
        node.send_to('/chatter', typed_as=INT32, data=7)
    assert len(node.channels) == 1
    assert '/chatter' not in registrations(node.master, '/sender')[1]


@pytest.mark.parametrize('way', ['send_to', 'interested_in', 'output_channel', 'wait_for_message'])
@pytest.mark.parametrize(
    'type_, error', [(None, UnknownTopicError), ('no_such_msgs/Type', UnknownTypeError)]
)
def test_unknown_topic_leaves_nothing(node, way, type_, error):
    before = node.master.system_state()
    with pytest.raises(error):
        getattr(node, way)('/nobody', typed_as=type_)
    assert node.channels == []
    assert node.master.system_state() == before


# -- the first message, and latched ones


def test_latched_message_reaches_late_subscriber(node, other):
    channel = node.output_channel('/map', STRING, latch=True)
    channel.send(data='old')
    channel.send(data='new')
    mailbox = Mailbox(other, '/map', STRING)
    channel.send(data='newest')
    assert take(mailbox, 2) == ['new', 'newest']


def test_latched_message_wakes_a_node_that_has_heard_others(node, other):
    """The thread of its delegates rests; no further message comes."""
    node.output_channel('/map', STRING, latch=True).send(data='map')
    words = Mailbox(other, '/words', STRING)
    node.send_to('/words', data='word')
    assert words.next().data == 'word'
    assert Mailbox(other, '/map', STRING).next().data == 'map'


def test_unlatched_channel_beside_a_latched_one(node, other):
    latched = node.output_channel('/map', STRING, latch=True)
    unlatched = node.output_channel('/map', STRING)
    latched.send(data='map')
    unlatched.send(data='event')
    mailbox = Mailbox(other, '/map', STRING)
    unlatched.send(data='last')
    assert take(mailbox, 2) == ['map', 'last']


def test_latched_message_goes_to_the_new_peer_alone(master, node, peer):
    out = node.output_channel('/map', STRING, latch=True)
    out.send(data='map')
    peer.hear('/map', STRING)
    peer.heard('/map')
    with Peer(master.url, 'late') as late:
        late.hear('/map', STRING)
        late.heard('/map')
    out.send(data='end')
    assert [message.data for message in peer.heard('/map', 2)] == ['map', 'end']


def test_latched_message_goes_to_the_new_subscriber_alone(master, node):
    out = create(master, '/map').output_channel('/map', STRING, latch=True)
    out.send(data='map')
    boxes = [Mailbox(), Mailbox()]
    for box in boxes:
        node.ros.Subscriber('/map', String, box)
        assert box.next().data == 'map'
    out.send(data='end')
    for box in boxes:
        assert box.next().data == 'end'


def test_closed_channel_takes_its_latched_message_along(master, node):
    channels = [node.output_channel('/map', STRING, latch=True) for _ in range(2)]
    for channel, text in zip(channels, ['old', 'new']):
        channel.send(data=text)
    channels[0].close()
    box = Mailbox(create(master, '/late'), '/map', STRING)
    assert box.next().data == 'new'
    channels[1].send(data='last')
    assert box.next().data == 'last'


def test_delegate_may_close_its_channel_at_the_latched_message(master, node):
    create(master, '/maps').output_channel('/map', STRING, latch=True).send(data='map')
    channel = node.interested_in('/map', delegate=lambda message, channel: channel.close())
    until(lambda: channel.closed or node.errors)
    assert not node.errors and not channel.connections


# -- queues, and order


@pytest.mark.parametrize('size, count', [(1, 7), (3, 7), (5, 3), (12, 40)])
def test_full_queue_drops_oldest(node, other, size, count):
    gate = Gate()
    channel = other.interested_in('/numbers', INT32, delegate=gate, queue_size=size)
    sender = node.output_channel('/numbers', INT32)
    sender.send(data=0)
    assert gate.begun.wait(TIMEOUT)
    for number in range(1, 1 + count):
        sender.send(data=number)
    gate.open.set()
    kept = min(size, count)
    assert take(gate, 1 + kept) == [0, *range(1 + count - kept, 1 + count)]
    assert (channel.received, channel.dropped) == (1 + kept, count - kept)


def test_queue_is_bounded_by_bytes(node, other):
    gate = Gate()
    other.queue_bytes = 4 * MEGABYTE
    channel = other.interested_in('/large', BYTES, delegate=gate)
    sender = node.output_channel('/large', BYTES)
    sender.send(data=b'')
    assert gate.begun.wait(TIMEOUT)
    for number in range(10):
        sender.send(data=bytes(MEGABYTE - 1000 + number))
    gate.open.set()
    kept = [len(data) for data in take(gate, 5)]
    assert kept == [0, *range(MEGABYTE - 994, MEGABYTE - 990)]
    assert channel.dropped == 6


def test_heard_message_is_not_kept(node, other):
    heard = threading.Event()
    other.interested_in('/large', BYTES, lambda message: heard.set())
    data = bytes(MEGABYTE)
    references = sys.getrefcount(data)
    node.send_to('/large', data=data)
    assert heard.wait(TIMEOUT)
    until(lambda: sys.getrefcount(data) == references)


def test_messages_of_publisher_keep_order(master, other, peer, pool):
    """One node of this process and one of another publish at once."""
    mailbox = Mailbox(other, '/numbers', INT32)
    sender = create(master, '/sender').output_channel('/numbers', INT32)
    peer.run(
        'publisher = rospy.Publisher("/numbers", message_class("std_msgs/Int32"), queue_size=0)'
    )
    until(lambda: len(mailbox.channel.connections) == 2, TIMEOUT)
    until(lambda: peer.value('publisher.get_num_connections()'), TIMEOUT)
    waiting = pool.submit(peer.run, 'for number in range(300): publisher.publish(1000 + number)')
    for number in range(300):
        sender.send(data=number)
    waiting.result(TIMEOUT)
    came = take(mailbox, 600)
    assert [number for number in came if number < 1000] == list(range(300))
    assert [number for number in came if number >= 1000] == list(range(1000, 1300))


def test_message_larger_than_the_queue_comes(node, other):
    """Behind another one; the queue then holds that message alone."""
    other.queue_bytes = 1000
    mailbox, gate = Mailbox(other, '/words', STRING), Gate()
    other.interested_in('/gate', STRING, gate)
    node.send_to('/gate', data='x')
    assert gate.begun.wait(TIMEOUT)
    for text in 'ab':
        node.send_to('/words', data=text * 5000)
    gate.open.set()
    assert mailbox.next(TIMEOUT / 3).data == 'b' * 5000


def test_subscriber_may_be_slow_twice(node, peer):
    """The thread that writes what waits for a socket ends, and another one starts."""
    peer.hear('/words', STRING)
    out = node.output_channel('/words', STRING, queue_size=2)
    newest = "[message.data for message in heard['/words'][-1:]]"
    for last in '1', '2':
        os.kill(peer.pid, signal.SIGSTOP)
        for _ in range(30):
            out.send(data='x' * MEGABYTE)
        os.kill(peer.pid, signal.SIGCONT)
        out.send(data=last)
        until(lambda last=last: peer.value(newest) == [last], TIMEOUT / 3)
        until(lambda: 'send_queue' not in str(threading.enumerate()))


def test_message_of_many_large_parts_is_sent(node, peer, monkeypatch):
    """A call of the system takes 1024 parts."""
    monkeypatch.setattr('pharos.private_rospy.tcpros.LARGE_PART', 1)
    peer.hear('/status', 'diagnostic_msgs/DiagnosticStatus')
    values = [{'key': 'k', 'value': 'v'}] * 1000
    node.output_channel('/status', 'diagnostic_msgs/DiagnosticStatus').send(values=values)
    assert len(peer.heard('/status')[0].values) == 1000


def test_closed_channel_drops_what_waits(master):
    ear, gate, channel, mouth = fill(master)
    after = Mailbox(ear, '/after', STRING)
    channel.close()
    gate.open.set()
    mouth.send_to('/after', typed_as=STRING, data='x')
    after.next()  # delegates of a node run in order
    assert gate.heard == ['first']


@pytest.mark.parametrize(
    'library, size, limit',
    [(Peer, MEGABYTE, 2), (Peer, MEGABYTE, 0), (PharosPeer, 60_000, 2)],
)
def test_queue_to_a_standing_subscriber_is_bounded(master, node, library, size, limit):
    """By its queue_size, or by the node's queue_bytes."""
    node.queue_bytes = 2 * MEGABYTE
    with library(master.url) as ear:
        ear.hear('/words', STRING)
        out = node.output_channel('/words', STRING, queue_size=limit)
        os.kill(ear.pid, signal.SIGSTOP)
        for number in range(100):
            out.send(data=str(number).ljust(size))
        os.kill(ear.pid, signal.SIGCONT)
        numbers = "[message.data[:3].strip() for message in heard['/words']]"
        until(lambda: ear.value(numbers)[-1:] == ['99'])
        assert len(ear.value(numbers)) < 60


@pytest.mark.parametrize('end', ['close', 'stop'])
def test_end_sends_what_waits(node, peer, end):
    peer.hear('/words', STRING)
    out = node.output_channel('/words', STRING)
    os.kill(peer.pid, signal.SIGSTOP)
    for number in range(10, 30):
        out.send(data=str(number).ljust(1 << 20))
    node.stop_timeout = TIMEOUT
    thread = threading.Thread(target=out.close if end == 'close' else node.stop)
    thread.start()
    until(lambda: has_come_to(thread, PublisherOverlay.flush))
    os.kill(peer.pid, signal.SIGCONT)
    until(lambda: peer.value("[message.data[:2] for message in heard['/words']]")[-1:] == ['29'])
    thread.join(TIMEOUT)
    assert out.closed


def test_channels_of_a_node_get_messages_of_their_own(node, peer):
    boxes = [Mailbox(node, '/words', STRING) for _ in range(2)]
    peer.run("out = rospy.Publisher('/words', message_class('std_msgs/String'), queue_size=1)")
    until(lambda: peer.value('out.get_num_connections()'))
    peer.run("out.publish('one')")
    one, other = [box.next() for box in boxes]
    assert one == other and one is not other


# -- from_ and to


AS_PEER = {
    'name': lambda node: node.name,
    'relative': lambda node: node.name.lstrip('/'),
    'node': lambda node: node,
}


@pytest.mark.parametrize('given', AS_PEER)
def test_from_hears_that_node_alone(master, node, other, given):
    mailbox = Mailbox()
    other.interested_in('/chatter', STRING, delegate=mailbox, from_=AS_PEER[given](node))
    create(master, '/third').send_to('/chatter', data='of the third')
    node.send_to('/chatter', data='of the sender')
    assert take(mailbox, 1) == ['of the sender']


@pytest.mark.parametrize('given', AS_PEER)
def test_to_reaches_that_node_alone(master, node, other, given):
    third = Mailbox(create(master, '/third'), '/chatter', STRING)
    mailbox = Mailbox(other, '/chatter', STRING)
    node.send_to('/chatter', to=AS_PEER[given](other), data='for the hearer')
    node.send_to('/chatter', data='for all')
    assert take(mailbox, 2) == ['for the hearer', 'for all']
    assert take(third, 1) == ['for all']


def test_from_and_to_take_external_node(master, node, other, peer):
    external = master.node('/peer')
    mailbox, here = Mailbox(), Mailbox(other, '/orders', STRING)
    other.interested_in('/chatter', STRING, delegate=mailbox, from_=external)
    peer.hear('/orders', STRING)
    peer.run(
        'publisher = rospy.Publisher("/chatter", message_class("std_msgs/String"), latch=True,'
        ' queue_size=1)'
    )
    until(lambda: '/peer' in master.topic('/orders').subscribers, TIMEOUT)
    node.send_to('/chatter', data='of the sender')
    peer.run('publisher.publish("of the peer")')
    assert take(mailbox, 1) == ['of the peer']
    node.send_to('/orders', to=external, data='for the peer')
    node.send_to('/orders', data='for all')
    assert [message.data for message in peer.heard('/orders', 2)] == ['for the peer', 'for all']
    assert take(here, 1) == ['for all']


def test_from_drops_what_others_send(node, other, peer):
    """A second channel shows that the peer's message has come."""
    mailbox, everything = Mailbox(), Mailbox(other, '/chatter', STRING)
    other.interested_in('/chatter', STRING, delegate=mailbox, from_=node)
    peer.run(
        'publisher = rospy.Publisher("/chatter", message_class("std_msgs/String"), queue_size=1)'
    )
    until(lambda: peer.value('publisher.get_num_connections()'), TIMEOUT)
    peer.run('publisher.publish("of the peer")')
    assert take(everything, 1) == ['of the peer']
    node.send_to('/chatter', data='of the sender')
    assert take(mailbox, 1) == ['of the sender']


def test_to_unknown_node_is_an_error(node):
    channel = node.output_channel('/chatter', STRING)
    with pytest.raises(UnknownNodeError, match='/nobody'):
        node.send_to('/chatter', to='/nobody', data='hello')
    assert channel.sent == 0


@pytest.mark.parametrize('name', ['/a b', 'a-b', '/ä'])
def test_impossible_peer_raises_value_error(node, name):
    with pytest.raises(ValueError):
        node.send_to('/chatter', typed_as=STRING, to=name, data='hello')
    with pytest.raises(ValueError):
        node.interested_in('/chatter', STRING, from_=name)
    assert '/chatter' not in registrations(node.master, '/sender')[1]


def test_shared_message_names_no_sender(node):
    with pytest.raises(ValueError, match='/chatter: give shared or from_, not both'):
        node.interested_in('/chatter', STRING, shared=True, from_='/other')


# -- channels


def test_input_channel_has_attributes(node, other):
    mailbox = Mailbox()
    channel = other.interested_in('/chatter', STRING, delegate=mailbox)
    assert (channel.received, channel.dropped, channel.connections) == (0, 0, [])
    node.send_to('/chatter', data='hello')
    mailbox.next()
    assert (channel.topic, channel.type, channel.node) == ('/chatter', STRING, other)
    assert channel.delegate is mailbox
    assert (channel.received, channel.dropped) == (1, 0)
    assert channel.connections == [('/sender', 'INTRAPROCESS')]
    assert other.channels == [channel]


def test_output_channel_has_attributes(node, other):
    other.interested_in('/chatter', STRING)
    channel = node.output_channel('/chatter', STRING)
    channel.send(data='one')
    channel.publish(String('two'))
    assert (channel.topic, channel.type, channel.node) == ('/chatter', STRING, node)
    assert channel.sent == 2
    assert channel.connections == [('/hearer', 'INTRAPROCESS')]
    assert node.channels == [channel]


def test_closed_input_hears_no_more(node, other):
    closed, mailbox = Mailbox(other, '/chatter', STRING), Mailbox(other, '/chatter', STRING)
    sender = node.output_channel('/chatter', STRING)
    sender.send(data='one')
    assert take(closed, 1) == ['one']
    closed.channel.close()
    sender.send(data='two')
    assert take(mailbox, 2) == ['one', 'two']
    assert len(closed.all()) == 1
    assert other.channels == [mailbox.channel]


def test_unregistered_subscriber_of_rospy_hears_no_more(node, other):
    """Another one of the topic goes on."""
    gone, heard = Mailbox(), Mailbox()
    subscribers = [other.ros.Subscriber('/chatter', String, each) for each in (gone, heard)]
    subscribers[0].unregister()
    node.send_to('/chatter', typed_as=STRING, data='one')
    assert take(heard, 1) == ['one']
    assert not gone.all()


def test_close_unregisters_both_ends(master, node, other):
    sender, hearer = node.output_channel('/chatter', STRING), other.interested_in('/chatter')
    for channel in hearer, sender:
        channel.close()
        assert channel.connections == []
    until(lambda: '/chatter' not in [*master.system_state()[0], *master.system_state()[1]], TIMEOUT)
    assert node.channels == other.channels == []


@pytest.mark.parametrize('end', ['close', 'stop'])
def test_closed_output_refuses_to_send(node, end):
    channel = node.output_channel('/chatter', STRING)
    channel.close() if end == 'close' else node.stop()
    with pytest.raises(NodeStoppedError):
        channel.publish(String('late'))
    with pytest.raises(NodeStoppedError):
        channel.send(data='late')


@pytest.mark.parametrize('message', [Int32(7), {'data': 'hello'}], ids=repr)
def test_publish_takes_its_type_alone(node, message):
    with pytest.raises(MessageTypeError):
        node.output_channel('/chatter', STRING).publish(message)


def test_subscribers_are_waited_for(master, node, other, pool):
    channel = node.output_channel('/chatter', STRING)
    assert not channel.wait_for_subscribers(timeout=0.05)
    waiting = pool.submit(channel.wait_for_subscribers, 2, TIMEOUT)
    other.interested_in('/chatter')
    assert not channel.wait_for_subscribers(2, 0.05)
    create(master, '/third').interested_in('/chatter')
    assert waiting.result(TIMEOUT)


@pytest.mark.parametrize('owner', ['channel', 'node'])
def test_delegate_is_replaced(node, other, owner):
    first, second = Mailbox(), Mailbox()
    other.delegate = first
    channel = other.interested_in('/chatter', STRING)
    node.send_to('/chatter', data='one')
    assert take(first, 1) == ['one']
    {'channel': channel, 'node': other}[owner].delegate = second
    node.send_to('/chatter', data='two')
    assert take(second, 1) == ['two']
    assert len(first.all()) == 1


def test_nodes_delegate_is_default(node, other):
    default, own = Mailbox(), Mailbox()
    other.delegate = default
    other.interested_in('/chatter', STRING)
    other.interested_in('/orders', STRING, delegate=own)
    node.send_to('/chatter', data='one')
    node.send_to('/orders', data='two')
    assert (take(default, 1), take(own, 1)) == (['one'], ['two'])


def test_node_hears_itself(node):
    mailbox = Mailbox(node, '/chatter', STRING)
    node.send_to('/chatter', data='hello')
    assert take(mailbox, 1) == ['hello']


def test_sender_learns_that_its_node_stops(master):
    """A thread of the program's own sends until the stop; rospy says that the topic is closed."""
    for _ in range(10):
        node, errors = create(master, '/sender'), []

        def send(node=node, errors=errors):
            try:
                while True:
                    node.send_to('/t', typed_as=STRING, data='x')
            except PharosError as error:
                errors.append(type(error))

        thread = threading.Thread(target=send)
        thread.start()
        until(lambda: node.channels and node.channels[0].sent)
        node.stop()
        thread.join(TIMEOUT)
        assert errors == [NodeStoppedError]


# -- Topic


def test_topic_hands_out_channels(master, node, other):
    topic, mailbox = master.topic('/chatter'), Mailbox()
    hearer = topic.input_channel(other, STRING, delegate=mailbox)
    sender = topic.output_channel(node)
    sender.send(data='hello')
    assert take(mailbox, 1) == ['hello']
    assert (topic.name, topic.type) == ('/chatter', STRING)
    assert (topic.publishers, topic.subscribers) == (['/sender'], ['/hearer'])
    assert topic.name in [each.name for each in master.topics()]
    assert set(topic.channels) == {sender, hearer}


# -- names


@pytest.mark.parametrize(
    'name, topic',
    [
        ('chatter', '/robot/chatter'),
        ('~chatter', '/robot/talker/chatter'),
        ('/chatter', '/chatter'),
        ('a/b', '/robot/a/b'),
        ('orders', '/kitchen'),
        ('/robot/orders', '/kitchen'),
        ('~plan', '/plans'),
    ],
)
def test_topic_name_is_resolved(master, name, topic):
    argv = ['program', 'orders:=/kitchen', '~plan:=/plans']
    node = create(master, '/robot/talker', argv=argv)
    assert node.output_channel(name, STRING).topic == topic
    assert node.interested_in(name).topic == topic
    assert master.topic(topic).publishers == ['/robot/talker']


def test_impossible_topic_raises_value_error(node):
    for name in ['', '/a b', 'a-b', '7up', '/ä']:
        for open_ in node.interested_in, node.output_channel, node.wait_for_message:
            with pytest.raises(ValueError):
                open_(name, STRING)
        with pytest.raises(ValueError):
            node.send_to(name, typed_as=STRING, data='hello')
        assert node.channels == []


# -- wait_for_message


def test_next_message_is_waited_for(node, other, pool):
    sender = node.output_channel('/chatter', STRING)
    waiting = pool.submit(other.wait_for_message, '/chatter', timeout=TIMEOUT)
    assert sender.wait_for_subscribers(1, TIMEOUT)
    sender.send(data='hello')
    assert waiting.result(TIMEOUT) == String('hello')
    assert other.channels == []


def test_where_chooses_among_messages(node, other, pool):
    sender = node.output_channel('/numbers', INT32)
    waiting = pool.submit(
        other.wait_for_message, '/numbers', INT32, TIMEOUT, where=lambda m: m.data > 2
    )
    assert sender.wait_for_subscribers(1, TIMEOUT)
    for number in range(5):
        sender.send(data=number)
    assert waiting.result(TIMEOUT).data == 3


def test_no_message_is_a_timeout(node, other):
    node.output_channel('/chatter', STRING)
    with pytest.raises(TimeoutError):
        other.wait_for_message('/chatter', timeout=0.05)
    assert other.channels == []
    until(lambda: node.master.topic('/chatter').subscribers == [], TIMEOUT)


def test_delegate_waits_for_message(node, other):
    node.output_channel('/map', STRING, latch=True).send(data='old')
    got = Mailbox()

    def look(message, channel):
        got(channel.node.wait_for_message('/map', timeout=TIMEOUT), channel)

    other.interested_in('/chatter', STRING, delegate=look)
    node.send_to('/chatter', data='look')
    assert take(got, 1) == ['old']


# -- a rospy.SubscribeListener


class Greeter(rospy.SubscribeListener):
    """It takes a lock under which its node publishes, too."""

    def __init__(self):
        self.lock = threading.Lock()
        self.begun = threading.Semaphore(0)

    def peer_subscribe(self, topic, publish, peer_publish):
        self.begun.release()
        with self.lock:
            peer_publish(String('welcome'))


def subscribe_here(master):
    create(master, '/ear').interested_in('/words', STRING)


def subscribe_by(library):
    """Return a function that has a peer subscribe to /words, and then end."""

    def subscribe(master):
        with library(master.url) as peer:
            peer.hear('/words', STRING)
            assert peer.heard('/words')

    return subscribe


SUBSCRIBERS = {
    'INTRAPROCESS': subscribe_here,
    'TCPROS': subscribe_by(Peer),
    'SHARED_MEMORY': subscribe_by(PharosPeer),
}


@pytest.mark.parametrize('kind', SUBSCRIBERS)
def test_listener_may_wait_for_a_publisher(master, pool, kind):
    """Its calls hold no lock that a publish() needs."""
    node, greeter = create(master), Greeter()
    out = node.ros.Publisher('/words', String, queue_size=1, subscriber_listener=greeter)
    with greeter.lock:
        subscriber = pool.submit(SUBSCRIBERS[kind], master)
        assert greeter.begun.acquire(timeout=TIMEOUT)
        pool.submit(out.publish, 'a state').result(TIMEOUT)
    subscriber.result(TIMEOUT)


class Slow(rospy.SubscribeListener):
    """It notes of each call whether no other one ran beside it."""

    def __init__(self):
        self.turn, self.were_alone = threading.Lock(), []

    def peer_subscribe(self, *arguments):
        is_alone = self.turn.acquire(blocking=False)
        time.sleep(0.1)  # as rospy.Subscriber() may take
        if is_alone:
            self.turn.release()
        self.were_alone.append(is_alone)

    peer_unsubscribe = peer_subscribe


@pytest.mark.parametrize('library', [Peer, PharosPeer])
def test_listener_hears_one_subscriber_at_a_time(master, library):
    """Else a node that subscribes for its first subscriber alone would do so twice."""
    node, slow = create(master), Slow()
    for number in range(3):
        node.ros.Publisher(f'/words{number}', String, queue_size=1, subscriber_listener=slow)
    with library(master.url) as peer:
        subscribe = f"rospy.Subscriber(topic, message_class('{STRING}'))"
        peer.run(f"ears = [{subscribe} for topic in ('/words0', '/words1', '/words2')]")
        until(lambda: len(slow.were_alone) == 3)
        peer.run('for ear in ears: ear.unregister()')
        # rospy of Debian 11 connects once more if it unregisters before its handshake has ended
        until(lambda: len(slow.were_alone) >= 6)
    assert all(slow.were_alone)


def test_failing_listener_is_a_failure_of_its_node(master, peer):
    class Rude(rospy.SubscribeListener):
        def peer_subscribe(self, *arguments):
            raise ValueError('in vain')

    node = create(master)
    node.ros.Publisher('/words', String, queue_size=1, subscriber_listener=Rude())
    peer.hear('/words', STRING)
    until(lambda: [str(error) for error in node.errors] == ['in vain'])


def test_publisher_of_rospy_counts_its_subscribers(master, peer):
    """Programs compute while somebody hears it."""
    out = create(master).ros.Publisher('/words', String, queue_size=1)
    for _ in range(2):
        peer.hear('/words', STRING)
        until(lambda: out.get_num_connections() == 1)
        peer.run('subscribers.pop().unregister()')
        until(lambda: out.get_num_connections() == 0)


def test_closed_topic_is_forgotten(master, node, other):
    """Else the node would connect anew to publishers of long ago."""
    node.output_channel('/words', STRING)
    channels = [other.interested_in('/words', STRING) for _ in range(2)]
    subscriptions = other._current_run.topic_manager.subs
    until(lambda: subscriptions['/words'].publisher_uris)
    for channel in channels:
        channel.close()
    assert '/words' not in subscriptions


# -- two threads at once


class Meeting:
    """Holds up the first thread that comes until another one has been here and gone on."""

    def __init__(self):
        self.turn, self.other_is_done = threading.Lock(), threading.Event()
        self.first_is_here = threading.Event()

    def hold_up(self):
        if self.turn.acquire(blocking=False):
            self.first_is_here.set()
            self.other_is_done.wait(0.5)  # it may wait for this thread


def side_by_side(pool, meeting, first, second):
    """Run two functions, the second one while the first one is held up; return their values."""
    held = pool.submit(first)
    meeting.first_is_here.wait(1)
    other = pool.submit(second)
    other.add_done_callback(lambda done: meeting.other_is_done.set())
    return held.result(TIMEOUT), other.result(TIMEOUT)


@pytest.mark.parametrize('change', ['open', 'close'])
def test_channels_of_two_threads_are_kept(node, pool, monkeypatch, change):
    """The node opens at its next start what it has now."""
    meeting = Meeting()

    def open_channel(topic):
        return node.output_channel(topic, STRING)

    def store(run, endpoints):
        meeting.hold_up()
        vars(run)['endpoints'] = endpoints

    kept = [open_channel('/a'), open_channel('/b')]
    slow = property(lambda run: vars(run)['endpoints'], store)
    monkeypatch.setattr(type(node._current_run), 'endpoints', slow, raising=False)
    if change == 'open':
        opens = [lambda: open_channel('/c'), lambda: open_channel('/d')]
        kept += side_by_side(pool, meeting, *opens)
    else:
        side_by_side(pool, meeting, kept.pop().close, kept.pop().close)
    node.restart()
    assert {channel.topic for channel in node.channels} == {channel.topic for channel in kept}


def test_subscribers_of_two_threads_both_hear(node, other, pool, monkeypatch):
    """One of plain rospy, and a channel."""
    meeting, heard, plain = Meeting(), Mailbox(), Mailbox()
    pause_for = topics.first_pause_for

    def hold_up(callbacks):
        meeting.hold_up()
        return pause_for(callbacks)

    monkeypatch.setattr(topics, 'first_pause_for', hold_up)
    side_by_side(
        pool,
        meeting,
        lambda: other.ros.Subscriber('/words', String, plain),
        lambda: other.interested_in('/words', STRING, delegate=heard),
    )
    out = node.output_channel('/words', STRING)
    until(lambda: out.connections)
    out.send(data='x')
    assert [box.next().data for box in (heard, plain)] == ['x', 'x']
