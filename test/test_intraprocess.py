"""INTRAPROCESS: messages between nodes of one process, which differ from TCPROS in speed alone."""
import itertools
import re
import socket
import subprocess
import sys
import threading
import types

import genpy
import pytest

from helpers import InProcessMaster, create, speak_tcpros_only
from pharos.testing import Mailbox, TIMEOUT
import pharos
from pharos import Master
from pharos.intraprocess import dispatcher, inbox as inboxes
from pharos.run import Lifecycle
from programs import PROGRAMS

TWIST, IMAGE, STRING = 'geometry_msgs/Twist', 'sensor_msgs/Image', 'std_msgs/String'


def pair(master, topic, type_, **kwargs):
    """The channel of a publisher, that of a receiver, and what that one gets."""
    mailbox = Mailbox()
    received = create(master, '/receiver', delegate=mailbox).interested_in(topic, type_, **kwargs)
    sent = create(master, '/sender').output_channel(topic, type_)
    return sent, received, mailbox


def by_tcpros(master, name, topic, type_):
    """What a subscriber gets that knows TCPROS only."""
    mailbox = Mailbox()
    node = speak_tcpros_only(create(master, name))
    node.ros.Subscriber(topic, pharos.message_class(type_), lambda message: mailbox(message, None))
    return mailbox


def connected(channel, count):
    assert channel.wait_for_subscribers(count, TIMEOUT)
    return sorted(channel.connections)


# -- the transport


@pytest.mark.parametrize('is_before', [True, False])
def test_a_channel_that_opens_while_the_link_of_another_one_does_hears_all_of_it_once(
    master, monkeypatch, is_before
):
    sender, receiver = create(master, '/sender'), create(master, '/receiver')
    receiver.connect_timeout = 0  # the link is not waited for by who delays it
    first, second = Mailbox(), Mailbox()
    sent = sender.output_channel('/meanwhile', STRING, latch=True)
    sent.send(data='latched')
    subscription = receiver.ros_import('rospy.topics')._SubscriberImpl
    add_connection = subscription.add_connection

    def add_meanwhile(self, connection):
        monkeypatch.undo()
        if is_before:
            receiver.interested_in('/meanwhile', STRING, delegate=second)
        is_added = add_connection(self, connection)
        if not is_before:
            receiver.interested_in('/meanwhile', STRING, delegate=second)
        return is_added

    monkeypatch.setattr(subscription, 'add_connection', add_meanwhile)
    receiver.interested_in('/meanwhile', STRING, delegate=first)
    assert sent.wait_for_subscribers(1, TIMEOUT)
    sent.send(data='sent')
    for mailbox in first, second:
        assert [message.data for message in mailbox.take(2)] == ['latched', 'sent']


def test_no_socket_is_opened_and_nothing_serialized(master, monkeypatch):
    sent, _, mailbox = pair(master, '/t', TWIST)
    sent.send(linear={'x': 1})
    mailbox.next()
    really = socket.socket
    # one watches the master, and others let in who asks for a node's state
    others = re.compile('watcher|.* (xmlrpc-accept|accept_clients)')

    def no_socket(*args, **kwargs):
        if others.match(threading.current_thread().name):
            return really(*args, **kwargs)
        raise AssertionError('a socket was opened')

    def never(*args, **kwargs):
        raise AssertionError('a message was serialized')

    with monkeypatch.context() as patch:
        patch.setattr(socket, 'socket', no_socket)
        patch.setattr(sent.message_class, 'serialize', never)
        patch.setattr(sent.message_class, 'deserialize', never)
        for number in range(100):
            sent.send(linear={'x': number})
            assert mailbox.next().linear.x == number


def test_ros_tools_see_the_connection(master):
    pair(master, '/t', TWIST)
    for name, peer in ('/sender', '/receiver'), ('/receiver', '/sender'):
        info = subprocess.run(
            ['rosnode', 'info', name], stdout=subprocess.PIPE, text=True, timeout=60
        ).stdout
        assert 'transport: INTRAPROCESS' in info
        assert '* topic: /t' in info
        assert peer in info.split('* topic: /t')[1]


def test_a_channels_repr_says_what_is_connected(master):
    sent, received, _ = pair(master, '/t', TWIST)
    assert repr(sent) == '<OutputChannel /t geometry_msgs/Twist of /sender: 1 INTRAPROCESS>'
    assert repr(received) == '<InputChannel /t geometry_msgs/Twist of /receiver: 1 INTRAPROCESS>'
    received.close()
    assert repr(received) == '<InputChannel /t geometry_msgs/Twist of /receiver: closed>'
    assert (sent.connections, received.connections) == ([], [])  # at once (ros_comm #927)


def test_nodes_of_different_masters_do_not_mix(master, mailbox):
    other = InProcessMaster()
    try:
        create(Master(other.url), '/receiver', delegate=mailbox).interested_in('/t', STRING)
        sent = create(master, '/sender').output_channel('/t', STRING)
        sent.send(data='not for you')
        assert sent.connections == []
        assert mailbox.empty()
    finally:
        pharos.node_registry.stop_all()
        other.stop()


def test_another_type_is_refused_and_both_are_named(master, capfd):
    create(master, '/receiver').interested_in('/t', TWIST)
    channel = create(master, '/sender')
    channel.connect_timeout = 0.1
    assert channel.output_channel('/t', STRING).connections == []
    said = capfd.readouterr().err
    assert '/receiver wants /t as geometry_msgs/Twist' in said
    assert '/sender publishes std_msgs/String' in said


# -- the same as TCPROS


def test_a_receivers_message_is_its_own(master):
    sent, _, first = pair(master, '/t', 'geometry_msgs/PoseArray')
    second = Mailbox()
    create(master, '/second', delegate=second).interested_in('/t')
    message = sent.message_class(poses=[pharos.message_class('geometry_msgs/Pose')()])
    sent.publish(message)
    message.poses[0].position.x = 1
    one = first.next()
    one.poses[0].position.x = 2
    one.poses.append(None)
    assert [pose.position.x for pose in second.next().poses] == [0.0]


def test_two_channels_of_one_node_get_a_message_each(master):
    sent, _, first = pair(master, '/t', TWIST)
    second = Mailbox()
    pharos.node_registry.nodes()[0].interested_in('/t', delegate=second)
    sent.send(linear={'x': 1})
    one, two = first.next(), second.next()
    assert one == two
    assert one is not two
    assert one.linear is not two.linear


def test_a_shared_message_is_the_published_one(master):
    sent, _, mailbox = pair(master, '/t', TWIST, shared=True)
    message = sent.message_class()
    sent.publish(message)
    assert mailbox.next() is message


@pytest.mark.parametrize('kwargs', [{}, {'inline': True}, {'shared': True}])
def test_headers_are_as_tcpros_has_them(master, kwargs):
    sent, _, mailbox = pair(master, '/t', IMAGE, **kwargs)
    remote = by_tcpros(master, '/remote', '/t', IMAGE)
    connected(sent, 2)
    for _ in range(3):
        sent.send(header={'frame_id': 'camera'})
        ours, theirs = mailbox.next(), remote.next()
        assert ours._connection_header == theirs._connection_header
        assert ours.header.seq == theirs.header.seq
    assert ours._connection_header['callerid'] == '/sender'
    assert ours.header.seq == 3


def test_any_type_and_numpy_types_are_received(master):
    from rospy.numpy_msg import numpy_msg
    from sensor_msgs.msg import LaserScan

    sent, _, _ = pair(master, '/t', 'sensor_msgs/LaserScan')
    node = create(master, '/tools')
    raw, arrays = Mailbox(), Mailbox()
    node.interested_in('/t', node.ros.AnyMsg, delegate=raw)
    create(master, '/arrays', delegate=arrays).interested_in('/t', numpy_msg(LaserScan))
    message = sent.send(ranges=[1.0, 2.5])
    assert connected(sent, 3) == [
        ('/arrays', 'INTRAPROCESS'),
        ('/receiver', 'INTRAPROCESS'),
        ('/tools', 'INTRAPROCESS'),
    ]
    assert LaserScan().deserialize(raw.next()._buff) == message
    ranges = arrays.next().ranges
    assert type(ranges).__name__ == 'ndarray'
    assert ranges.tolist() == [1.0, 2.5]


def test_a_type_made_at_run_time_is_received(master):
    pharos.define_message(
        'made_up/Thing',
        'Part[] parts\nstring name\n' + '=' * 80 + '\nMSG: made_up/Part\nint8 x\ntime t',
    )
    sent, _, mailbox = pair(master, '/t', 'made_up/Thing')
    sent.send(parts=[{'x': 5}], name='it')
    message = mailbox.next()
    assert message.parts[0].x == 5
    assert message.name == 'it'
    assert type(message.parts[0].t) is genpy.Time


def test_a_latched_message_reaches_those_who_come_late_as_it_was(master):
    """By value; rospy keeps the object, and later changes of it show (ros_comm #1481)."""
    node = create(master, '/sender')
    channel = node.output_channel('/t', 'std_msgs/Header', latch=True)
    message = channel.message_class(frame_id='as it was')
    channel.publish(message)
    message.frame_id = 'changed since'
    late = Mailbox()
    create(master, '/late', delegate=late).interested_in('/t')
    remote = by_tcpros(master, '/remote', '/t', 'std_msgs/Header')
    assert late.next().frame_id == remote.next().frame_id == 'as it was'
    second = Mailbox()
    pharos.node_registry.nodes()[1].interested_in('/t', delegate=second)
    assert second.next().frame_id == 'as it was'
    assert late.empty()


def test_each_latched_channel_of_a_node_keeps_its_message(master):
    """ros_comm #146: rospy keeps one for all of them."""
    node = create(master, '/sender')
    for text in 'first', 'second':
        node.output_channel('/t', STRING, latch=True).send(data=text)
    late = Mailbox()
    create(master, '/late', delegate=late).interested_in('/t')
    remote = by_tcpros(master, '/remote', '/t', STRING)
    for mailbox in late, remote:
        assert [message.data for message in mailbox.take(2)] == ['first', 'second']
    node.channels[0].close()
    later = Mailbox()
    create(master, '/later', delegate=later).interested_in('/t')
    assert later.next().data == 'second'


# -- delegates


def test_messages_arrive_in_order_and_none_is_lost_while_there_is_room(master):
    sent, received, mailbox = pair(master, '/t', 'std_msgs/Int32', queue_size=10000)
    for number in range(10000):
        sent.publish(sent.message_class(number))
    assert [message.data for message in mailbox.take(10000)] == list(range(10000))
    assert (sent.sent, received.received, received.dropped) == (10000, 10000, 0)


@pytest.mark.parametrize('transport', ['INTRAPROCESS', 'TCPROS'])
def test_a_full_queue_drops_the_oldest_and_counts(master, transport):
    entered, release, mailbox = threading.Event(), threading.Event(), Mailbox()

    def slow(message, channel):
        entered.set()
        release.wait(TIMEOUT)
        mailbox(message, channel)

    node = create(master, '/receiver', delegate=slow)
    if transport == 'TCPROS':
        speak_tcpros_only(node)
    received = node.interested_in('/t', 'std_msgs/Int32', queue_size=3)
    sent = create(master, '/sender').output_channel('/t', 'std_msgs/Int32')
    assert connected(sent, 1) == [('/receiver', transport)]
    sent.send(data=0)
    assert entered.wait(TIMEOUT)
    if transport == 'INTRAPROCESS':
        for number in range(1, 10):
            sent.send(data=number)
        release.set()
        assert [message.data for message in mailbox.take(4)] == [0, 7, 8, 9]
        assert (received.received, received.dropped) == (4, 6)
    else:
        offer = received._endpoint.callback
        offer._inbox.put(sent.message_class(1))
        for number in range(2, 6):
            offer(sent.message_class(number))
        release.set()
        assert [message.data for message in mailbox.take(4)] == [0, 3, 4, 5]
        assert (received.received, received.dropped) == (4, 2)


def test_the_publisher_does_not_wait_for_a_receiver_that_is_busy(master):
    release, mailbox = threading.Event(), Mailbox()

    def stuck(message, channel):
        release.wait(TIMEOUT)
        mailbox(message, channel)

    sent, received, _ = pair(master, '/t', TWIST)
    received.delegate = stuck
    for _ in range(100):
        sent.send()
    assert mailbox.empty()
    release.set()
    mailbox.take(100)


@pytest.mark.parametrize('inline, thread', [(False, '/receiver dispatcher'), (True, 'MainThread')])
def test_a_delegate_runs_in_the_nodes_thread_or_inline_in_the_publishers(master, inline, thread):
    threads = Mailbox()
    sent, received, _ = pair(master, '/t', TWIST, inline=inline)
    received.delegate = lambda message, channel: threads(threading.current_thread().name, channel)
    sent.send()
    assert threads.next() == thread


@pytest.mark.parametrize('inline', [False, True])
def test_a_node_may_publish_to_itself_from_its_delegate(master, mailbox, inline):
    node = create(master, '/loop')
    channel = node.output_channel('/t', 'std_msgs/Int32')

    def count(message, input_channel):
        if message.data < 2000:
            channel.send(data=message.data + 1)  # would overflow the stack if it recursed
        else:
            mailbox(message, input_channel)

    node.interested_in('/t', delegate=count, inline=inline)
    channel.send(data=0)
    assert mailbox.next().data == 2000
    assert not node.errors


def test_two_nodes_may_publish_to_each_other_inline_from_two_threads(master):
    """With rospy's publish lock held while delegates run, these deadlock."""
    done = Mailbox()
    nodes = [create(master, name) for name in ('/ping', '/pong')]
    outs = [
        node.output_channel(topic, 'std_msgs/Int32')
        for node, topic in zip(nodes, ('/to_pong', '/to_ping'))
    ]
    for node, out, topic in zip(nodes, outs, ('/to_ping', '/to_pong')):

        def play(message, channel, out=out):
            if message.data:
                out.send(data=message.data - 1)
            else:
                done(message, channel)

        node.interested_in(topic, 'std_msgs/Int32', delegate=play, inline=True)
    threads = [
        threading.Thread(
            target=lambda out=out: [out.send(data=20) for _ in range(200)], daemon=True
        )
        for out in outs
    ]
    for thread in threads:
        thread.start()
    done.take(400)
    assert not nodes[0].errors
    assert not nodes[1].errors


def test_a_delegate_may_subscribe_close_and_publish_a_lot(master, mailbox):
    node = create(master, '/busy')
    out = node.output_channel('/many', 'std_msgs/Int32')

    def delegate(message, channel):
        channel.close()
        node.interested_in('/many', delegate=mailbox)
        for number in range(1000):
            out.send(data=number)

    node.interested_in('/start', 'std_msgs/Empty', delegate=delegate)
    create(master, '/sender').send_to('/start')
    assert [message.data for message in mailbox.take(1000)] == list(range(1000))


def test_a_delegate_may_stop_another_node_and_its_own(master):
    first, second = create(master, '/first'), create(master, '/second')
    stopped = threading.Event()

    def stop_both(message, channel):
        second.stop()
        first.stop()
        stopped.set()

    first.interested_in('/stop_both', 'std_msgs/Empty', delegate=stop_both)
    second.send_to('/stop_both')
    assert stopped.wait(TIMEOUT)
    assert (first.lifecycle, second.lifecycle) == (Lifecycle.STOPPED, Lifecycle.STOPPED)


def test_a_failing_inline_delegate_does_not_reach_the_publisher(master, transcript):
    sent, received, _ = pair(master, '/t', TWIST, inline=True)
    received.delegate = lambda message, channel: 1 / 0
    sent.send()
    assert isinstance(received.node.errors[-1], ZeroDivisionError)
    assert 'ZeroDivisionError' in transcript[0]


@pytest.mark.parametrize('inline, laps', [(False, 200), (True, 50)])
def test_a_ring_of_ten_nodes_loses_nothing(master, inline, laps):
    """A million messages, from two threads at once."""
    tokens = 250
    arrived = Mailbox()
    nodes = [create(master, '/ring%d' % i) for i in range(10)]
    for i, node in enumerate(nodes):
        out = node.output_channel('/link%d' % ((i + 1) % 10), 'std_msgs/Int64MultiArray')

        def pass_on(message, channel, out=out, last=i == 9):
            lap, token = message.data
            if not last:
                out.publish(message)
            elif lap + 1 < laps:
                message.data = (lap + 1, token)
                out.publish(message)
            else:
                arrived(message, channel)

        node.interested_in(
            '/link%d' % i, 'std_msgs/Int64MultiArray', delegate=pass_on, inline=inline
        )

    def feed(number):
        out = create(master, '/feeder%d' % number).output_channel(
            '/link0', 'std_msgs/Int64MultiArray'
        )
        for token in range(tokens):
            out.send(data=(0, number * tokens + token))

    threads = [threading.Thread(target=feed, args=(number,), daemon=True) for number in range(2)]
    for thread in threads:
        thread.start()
    tokens_seen = [message.data[1] for message in arrived.take(2 * tokens)]
    assert sorted(tokens_seen) == list(range(2 * tokens))
    assert arrived.empty()
    for number in range(2):
        mine = [token for token in tokens_seen if token // tokens == number]
        assert mine == sorted(mine)
    assert all(
        not node.errors and not any(c.dropped for c in node.channels if hasattr(c, 'dropped'))
        for node in nodes
    )


# -- mixed topics

SUBSCRIBER, PUBLISHER = (
    [sys.executable, PROGRAMS / f'external_{name}.py'] for name in ('subscriber', 'publisher')
)


def test_receivers_here_and_elsewhere_get_everything_once(master):
    sent, _, mailbox = pair(master, '/t', STRING)
    with subprocess.Popen(SUBSCRIBER, stdout=subprocess.PIPE, text=True) as external:
        assert connected(sent, 2) == [('/external', 'TCPROS'), ('/receiver', 'INTRAPROCESS')]
        for number in range(100):
            sent.send(data=str(number))
        expected = [str(number) for number in range(100)]
        assert [message.data for message in mailbox.take(100)] == expected
        assert mailbox.empty()
        assert [external.stdout.readline().strip() for _ in range(100)] == expected
        external.terminate()


def test_a_receiver_gets_everything_once_from_publishers_here_and_elsewhere(master):
    sent, received, mailbox = pair(master, '/t', STRING)
    with subprocess.Popen(PUBLISHER) as external:
        for number in range(100):
            sent.send(data='here %d' % number)
        texts = [message.data for message in mailbox.take(200)]
        for source in 'here', 'external':
            assert [text for text in texts if text.startswith(source)] == [
                '%s %d' % (source, i) for i in range(100)
            ]
        assert sorted(received.connections) == [
            ('/external', 'TCPROS'),
            ('/sender', 'INTRAPROCESS'),
        ]
        external.terminate()


def test_a_node_that_moves_is_found_again_by_the_right_transport(master, mailbox):
    receiver = create(master, '/receiver', delegate=mailbox)
    channel = receiver.interested_in('/t', STRING)
    for turn in range(2):
        here = create(master, '/external')
        here.send_to('/t', data='here')
        assert mailbox.next().data == 'here'
        assert channel.connections == [('/external', 'INTRAPROCESS')]
        here.stop()
        with subprocess.Popen(PUBLISHER) as elsewhere:
            assert mailbox.take(100)[-1].data == 'external 99'
            assert channel.connections == [('/external', 'TCPROS')]
            elsewhere.terminate()
        wait_until_gone(master, '/external')


def wait_until_gone(master, name):
    pause = threading.Event()
    while any(node.name == name for node in master.nodes()):
        pause.wait(0.01)  # another process: the master is all there is to ask


def test_one_nodes_messages_only(master):
    one, two = create(master, '/one'), create(master, '/two')
    everything, from_one = Mailbox(), Mailbox()
    receiver = create(master, '/receiver', delegate=everything)
    receiver.interested_in('/t', STRING)
    receiver.interested_in('/t', STRING, delegate=from_one, from_=one)
    with subprocess.Popen(PUBLISHER) as external:
        everything.take(100)
        from_external = Mailbox()
        create(master, '/picky', delegate=from_external).interested_in(
            '/t', STRING, from_='/external'
        )
        external.terminate()
    two.send_to('/t', data='from two')
    one.send_to('/t', data='from one')
    assert {message.data for message in everything.take(2)} == {'from one', 'from two'}
    assert from_one.next().data == 'from one'
    assert from_one.empty()
    assert from_external.empty()


def test_to_one_node_only(master):
    sender = create(master, '/sender')
    mailboxes = {name: Mailbox() for name in ('/one', '/two')}
    nodes = [create(master, name, delegate=mailbox) for name, mailbox in mailboxes.items()]
    for node in nodes:
        node.interested_in('/t', STRING)
    remote = by_tcpros(master, '/three', '/t', STRING)
    connected(sender.output_channel('/t', STRING), 3)
    sender.send_to('/t', data='for one', to=nodes[0])
    sender.send_to('/t', data='for three', to='/three')
    sender.send_to('/t', data='for all')
    assert [message.data for message in mailboxes['/one'].take(2)] == ['for one', 'for all']
    assert mailboxes['/two'].next().data == 'for all'
    assert [message.data for message in remote.take(2)] == ['for three', 'for all']


def test_a_plain_rospy_subscriber_beside_a_channel_gets_everything_too(master, mailbox):
    node = create(master, '/both')
    plain = Mailbox()
    channel = node.interested_in('/t', STRING, delegate=mailbox)
    sent = create(master, '/sender').output_channel('/t', STRING)
    assert connected(sent, 1) == [('/both', 'INTRAPROCESS')]
    node.ros.Subscriber('/t', channel.message_class, lambda message: plain(message, None))
    assert connected(sent, 1) == [('/both', 'INTRAPROCESS')]
    sent.send(data='to both')
    assert mailbox.next().data == plain.next().data == 'to both'


def test_counters_hold_over_many_publishers(master, mailbox):
    received = create(master, '/receiver', delegate=mailbox).interested_in('/t', STRING)
    for number in itertools.islice(itertools.count(), 10):
        with create(master, '/sender%d' % number) as sender:
            sender.send_to('/t', data='x')
        mailbox.next()
    assert (received.received, received.dropped) == (10, 0)


def test_a_publisher_gives_way_to_a_receiver_that_takes_nothing_once_in_a_while(monkeypatch):
    now, naps = [1.0], []
    monkeypatch.setattr(
        inboxes, 'time', types.SimpleNamespace(perf_counter=lambda: now[0], sleep=naps.append)
    )
    dropped = []
    receiver = types.SimpleNamespace(
        queue_size=10,
        queue_bytes=1000,
        inline=True,
        shared=False,
        count_dropped=lambda: dropped.append(1),
    )
    inbox = inboxes.Inbox(receiver, dispatcher.Dispatcher(None))
    for number in range(1000):
        inbox.put(number)
    assert len(naps) == 1
    assert len(dropped) == 990
    now[0] += 2 * inboxes.STARVATION_INTERVAL
    for number in range(1000):
        inbox.put(number)
    assert len(naps) == 2
    assert len(dropped) == 1990
