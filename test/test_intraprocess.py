"""INTRAPROCESS: how messages go between the nodes of one process."""
import itertools
import threading
import xmlrpc.client

import pytest

import pharos
from helpers import TIMEOUT, create
from pharos.testing import Mailbox, until

STRING, IMAGE, POSE = 'std_msgs/String', 'sensor_msgs/Image', 'geometry_msgs/PoseStamped'


@pytest.fixture
def sender(master):
    return create(master, '/sender')


@pytest.fixture
def hearer(master):
    return create(master, '/hearer')


def transports(node, topic):
    """The transports of a topic's connections, as rosnode info asks for them."""
    _, _, info = xmlrpc.client.ServerProxy(node.uri).getBusInfo('/test')
    return sorted(row[3] for row in info if row[4] == topic)


# -- which way


def test_both_ends_tell_their_transport(sender, hearer, peer):
    peer.hear('/a', STRING)
    box = Mailbox(hearer, '/a', STRING)
    out = sender.output_channel('/a', STRING)
    until(lambda: len(out.connections) == 2)
    assert sorted(out.connections) == [('/hearer', 'INTRAPROCESS'), ('/peer', 'TCPROS')]
    assert box.channel.connections == [('/sender', 'INTRAPROCESS')]


def test_external_publisher_comes_by_tcpros(hearer, peer):
    box = Mailbox(hearer, '/a', STRING)
    peer.run(
        "out = rospy.Publisher('/a', message_class('std_msgs/String'), latch=True, queue_size=1)\n"
        "out.publish('x')"
    )
    assert box.next().data == 'x'
    until(lambda: box.channel.connections == [('/peer', 'TCPROS')])


@pytest.mark.parametrize('sends', ['channel', 'rospy'])
@pytest.mark.parametrize('hears', ['channel', 'rospy', 'library'])
def test_plain_rospy_goes_the_same_way(sender, hearer, sends, hears):
    cls, box = pharos.message_class(STRING), Mailbox()

    def take(message):
        box(message, None)

    if hears == 'channel':
        hearer.interested_in('/a', STRING, delegate=box)
    elif hears == 'rospy':
        hearer.ros.Subscriber('/a', cls, take)
    else:
        hearer.ros_import('message_filters').Subscriber('/a', cls).registerCallback(take)
    if sends == 'channel':
        sender.send_to('/a', data='x')
    else:
        publisher = sender.ros.Publisher('/a', cls, queue_size=1)
        until(publisher.get_num_connections)
        publisher.publish('x')
    assert box.next().data == 'x'
    assert transports(sender, '/a') == transports(hearer, '/a') == ['INTRAPROCESS']


def test_restart_keeps_the_way(sender, hearer):
    box = Mailbox(hearer, '/a', STRING)
    out = sender.output_channel('/a', STRING)
    for node in hearer, sender:
        node.restart()
        assert out.wait_for_subscribers(1, TIMEOUT)
        sender.send_to('/a', data=node.name)
        assert box.next().data == node.name
        assert out.connections == [('/hearer', 'INTRAPROCESS')]


def test_later_subscriber_of_rospy_sets_the_queue_size(sender, hearer):
    heard, begun, gate = [], threading.Semaphore(0), threading.Semaphore(0)

    def hear_slowly(message):
        heard.append(message.data)
        begun.release()
        assert gate.acquire(timeout=TIMEOUT)

    cls = pharos.message_class(STRING)
    hearer.ros.Subscriber('/a', cls, lambda message: None)
    hearer.ros.Subscriber('/a', cls, hear_slowly, queue_size=1)
    for number in range(10):
        sender.send_to('/a', cls(str(number)))
        if number == 0:
            assert begun.acquire(timeout=TIMEOUT)
    for _ in range(2):
        gate.release()
    assert begun.acquire(timeout=TIMEOUT)
    assert heard == ['0', '9']


# -- whose message


@pytest.mark.parametrize('type_', [STRING, POSE, IMAGE])
def test_receivers_message_is_its_own(master, sender, type_):
    """It is neither the publisher's, nor another receiver's."""
    cls = pharos.message_class(type_)
    boxes = [Mailbox(create(master, f'/hearer{n}'), '/a', type_) for n in range(2)]
    sent = sender.send_to('/a', cls())
    got = [box.next() for box in boxes]
    assert len({id(sent), *map(id, got)}) == 3
    assert got[0] == got[1]
    if type_ == POSE:
        sent.pose.position.x = got[0].pose.position.x = 7.0
        assert got[1].pose.position.x == 0.0


def test_array_of_message_is_its_own(sender, hearer):
    box = Mailbox(hearer, '/a', 'nav_msgs/Path')
    pose = pharos.message_class(POSE)()
    sent = sender.send_to('/a', poses=[pose])
    got = box.next()
    sent.poses.append(pose)
    pose.pose.position.x = 7.0
    assert len(got.poses) == 1 and got.poses[0].pose.position.x == 0.0


def test_shared_channel_gets_the_object(sender, hearer):
    box = Mailbox()
    hearer.interested_in('/a', IMAGE, delegate=box, shared=True)
    sent = sender.send_to('/a', data=b'abc')
    assert box.next() is sent


# -- headers


def test_header_seq_is_filled_in(sender, hearer):
    box = Mailbox(hearer, '/a', POSE)
    for _ in range(3):
        sender.send_to('/a')
    first, *more = [box.next().header.seq for _ in range(3)]
    assert more == [first + 1, first + 2]


@pytest.mark.parametrize('closing', ['publisher', 'subscriber'])
def test_link_whose_end_closes_meanwhile_is_none(sender, hearer, monkeypatch, closing):
    """To the other end, its half looked like a connection for ever."""
    out = sender.output_channel('/a', STRING)
    subscription_class = hearer.ros.topics._SubscriberImpl
    add_link = subscription_class.add_link

    def close_meanwhile(self, link):
        is_added = add_link(self, link)
        (out if closing == 'publisher' else self).close()
        return is_added

    with monkeypatch.context() as patch:
        patch.setattr(subscription_class, 'add_link', close_meanwhile)
        box = Mailbox(hearer, '/a', STRING)
    if closing == 'publisher':
        sender.send_to('/a', STRING, data='x')
        assert box.next().data == 'x'
    else:
        assert not out.connections


@pytest.mark.parametrize('latch', [False, True])
def test_connection_header_is_tcpros_one(sender, hearer, latch):
    box = Mailbox(hearer, '/a', STRING)
    out = sender.output_channel('/a', STRING, latch=latch)
    out.send(data='x')
    header, cls = box.next()._connection_header, pharos.message_class(STRING)
    wanted = {
        'callerid': '/sender',
        'topic': '/a',
        'type': STRING,
        'md5sum': cls._md5sum,
        'latching': str(int(latch)),
        'message_definition': cls._full_text,
    }
    assert {key: header.get(key) for key in wanted} == wanted


def test_other_type_is_refused_and_told(master, sender, hearer):
    box = Mailbox(hearer, '/a', 'std_msgs/Int8')
    out = sender.output_channel('/a', STRING)
    out.send(data='x')
    until(lambda: hearer.errors)
    assert 'std_msgs/String' in str(hearer.errors[0]) and '/a' in str(hearer.errors[0])
    assert box.channel.connections == out.connections == []


# -- whose thread


def test_inline_delegate_runs_in_publishers_thread(sender, hearer):
    threads = []
    hearer.interested_in(
        '/a', STRING, inline=True, delegate=lambda m, c: threads.append(threading.current_thread())
    )
    sender.send_to('/a', data='x')
    assert threads == [threading.current_thread()]


@pytest.mark.parametrize('inline', [False, True], ids=['worker', 'inline'])
@pytest.mark.parametrize('nodes', [1, 2, 3])
def test_circle_of_nodes_goes_round(master, nodes, inline):
    """No wiring of nodes deadlocks, or recurses."""
    done, ring = threading.Event(), [create(master, f'/n{n}') for n in range(nodes)]
    following = dict(zip(ring, itertools.chain(range(1, nodes), [0])))

    def pass_on(message, channel):
        if message.data == 3000:
            done.set()
        else:
            channel.node.send_to(f'/t{following[channel.node]}', data=message.data + 1)

    for number, node in enumerate(ring):
        node.interested_in(f'/t{number}', 'std_msgs/Int32', inline=inline, delegate=pass_on)
    for number, node in enumerate(ring):
        node.output_channel(f'/t{following[node]}', 'std_msgs/Int32')
    ring[-1].send_to('/t0', data=0)
    assert done.wait(TIMEOUT)


def test_inline_nodes_do_not_deadlock(master):
    """Two threads publish to each other's inline node."""
    one, two, done = create(master, '/one'), create(master, '/two'), []
    one.interested_in('/a', STRING, inline=True, delegate=lambda m, c: one.send_to('/c', data='x'))
    two.interested_in('/b', STRING, inline=True, delegate=lambda m, c: two.send_to('/d', data='x'))
    one.interested_in('/d', STRING, inline=True, delegate=lambda m, c: None)
    two.interested_in('/c', STRING, inline=True, delegate=lambda m, c: None)

    def send(node, topic):
        for _ in range(500):
            node.send_to(topic, typed_as=STRING, data='x')
        done.append(topic)

    threads = [
        threading.Thread(target=send, args=each, daemon=True) for each in ((two, '/a'), (one, '/b'))
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(TIMEOUT)
    assert sorted(done) == ['/a', '/b']


# -- how many


def test_flat_out_loses_nothing(sender, hearer):
    count, got, done = 20_000, [], threading.Event()

    def delegate(message, channel):
        got.append(message.data)
        if len(got) == count:
            done.set()

    channel = hearer.interested_in('/a', 'std_msgs/Int32', delegate=delegate, queue_size=count)
    for number in range(count):
        sender.send_to('/a', data=number)
    assert done.wait(TIMEOUT)
    assert got == list(range(count))
    assert channel.dropped == 0


def test_ten_receivers_get_all(master, sender):
    boxes = [Mailbox(create(master, f'/hearer{n}'), '/a', 'std_msgs/Int32') for n in range(10)]
    for number in range(200):
        sender.send_to('/a', data=number)
    for box in boxes:
        assert [box.next().data for _ in range(200)] == list(range(200))
