"""What is latched: for whom, and for how long; over INTRAPROCESS and TCPROS alike."""
import pytest
import rospy
import std_msgs.msg

from helpers import InProcessMaster, speak_tcpros_only
from pharos.testing import Mailbox, until
import pharos
from pharos import BlockNode, Master, Node
from programs import Program

STRING = 'std_msgs/String'
TRANSPORTS = 'INTRAPROCESS', 'TCPROS'


@pytest.fixture(params=TRANSPORTS)
def come(request, master):
    """``come(name, topic)``: a node becomes interested; returns what it gets, and its handle."""

    def come(name, topic):
        mailbox = Mailbox()
        node = master.create(BlockNode, named=name, domain='127.0.0.1')
        if request.param == 'TCPROS':
            speak_tcpros_only(node).ros.Subscriber(
                topic, std_msgs.msg.String, lambda message: mailbox(message, None)
            )
        else:
            node.interested_in(topic, STRING, delegate=mailbox)
        return mailbox, node

    return come


def latched_channel(master, topic, name='/sender'):
    node = master.create(BlockNode, named=name, domain='127.0.0.1')
    return node.output_channel(topic, STRING, latch=True)


def texts(mailbox, count):
    return [message.data for message in mailbox.take(count)]


# -- for whom


def test_what_is_sent_to_one_node_is_latched_for_that_one_alone(master, come):
    channel = latched_channel(master, '/latch/one')
    channel.send(data='for all')
    mailbox, receiver = come('/b', '/latch/one')
    assert texts(mailbox, 1) == ['for all']
    until(lambda: channel.connections)
    channel.send(data='for b', to='/b')
    assert texts(mailbox, 1) == ['for b']
    other, _ = come('/c', '/latch/one')
    assert texts(other, 1) == ['for all']
    receiver.stop()
    again, _ = come('/b', '/latch/one')
    assert texts(again, 1) == ['for b']  # the last message for it
    channel.send(data='news')
    assert texts(again, 1) == texts(other, 1) == ['news']
    assert mailbox.empty()


def test_what_is_sent_to_a_node_that_is_not_there_is_latched_for_nobody(master, come):
    channel = latched_channel(master, '/latch/before')
    with pytest.raises(pharos.UnknownNodeError, match='/b'):
        channel.send(data='for b', to='/b')
    mailbox, _ = come('/b', '/latch/before')
    channel.send(data='for all')
    assert texts(mailbox, 1) == ['for all']


def test_what_a_rospy_publisher_sends_to_one_listener_is_latched_for_that_one_alone(master, come):
    node = master.create(BlockNode, named='/sender', domain='127.0.0.1')

    class Greeter(rospy.SubscribeListener):
        """What rospy offers for greeting those who come."""

        def peer_subscribe(self, topic_name, topic_publish, peer_publish):
            peer_publish(std_msgs.msg.String('welcome'))

    publisher = node.ros.Publisher(
        '/latch/greeted',
        std_msgs.msg.String,
        latch=True,
        queue_size=5,
        subscriber_listener=Greeter(),
    )
    publisher.publish('for all')
    for name in '/b', '/c':
        mailbox, _ = come(name, '/latch/greeted')
        assert texts(mailbox, 2) == ['for all', 'welcome']


# -- for how long


def test_a_latched_value_survives_a_restart_of_its_node(master, come):
    channel = latched_channel(master, '/latch/restart')
    channel.send(data='kept')
    present, _ = come('/present', '/latch/restart')
    assert texts(present, 1) == ['kept']
    for _ in range(2):
        channel.node.stop()
        channel.node.start()
        assert texts(present, 1) == ['kept']  # as each who connects gets it
    late, _ = come('/late', '/latch/restart')
    assert texts(late, 1) == ['kept']
    until(lambda: len(channel.connections) == 2)
    channel.send(data='news')
    assert texts(present, 1) == texts(late, 1) == ['news']
    assert present.empty()
    assert late.empty()


def test_each_latched_channel_of_a_node_survives_its_restart(master, come):
    first = latched_channel(master, '/latch/several')
    second = first.node.output_channel('/latch/several', latch=True)
    first.send(data='one')
    second.send(data='two')
    first.node.stop()
    first.node.start()
    late, _ = come('/late', '/latch/several')
    assert sorted(texts(late, 2)) == ['one', 'two']
    first.close()
    later, _ = come('/later', '/latch/several')
    assert texts(later, 1) == ['two']
    assert late.empty()
    assert later.empty()


def test_a_latched_value_survives_a_restart_of_a_class_that_opens_its_channels_in_start(
    master, come
):
    class Mapper(Node):
        def start(self):
            super().start()
            self.map, self.route = [
                self.output_channel(f'/latch/{name}', STRING, latch=True)
                for name in ('map', 'route')
            ]

    node = master.create(Mapper, named='/sender', domain='127.0.0.1')
    node.map.send(data='kept')
    node.route.send(data='gone')
    node.route.close()
    for _ in range(2):
        node.stop()
        node.start()
    late, _ = come('/late', '/latch/map')
    assert texts(late, 1) == ['kept']
    other, _ = come('/other', '/latch/route')
    until(lambda: node.route.connections)
    node.route.send(data='news')
    assert texts(other, 1) == ['news']


def test_a_closed_channel_latches_nothing_any_more(master, come):
    closed = latched_channel(master, '/latch/closed')
    closed.send(data='gone')
    unlatched = closed.node.output_channel('/latch/closed')
    closed.close()
    closed.node.stop()
    closed.node.start()
    late, _ = come('/late', '/latch/closed')
    until(lambda: unlatched.connections)
    unlatched.send(data='news')
    assert texts(late, 1) == ['news']


def test_what_is_under_way_while_its_channel_closes_is_latched_no_more(master, come):
    closed = latched_channel(master, '/latch/under_way')
    unlatched = closed.node.output_channel('/latch/under_way')
    fanout, latch = closed._fanout, closed.latched
    closed.close()
    fanout.publish(std_msgs.msg.String('gone'), latch)  # as another thread that was about to
    late, _ = come('/late', '/latch/under_way')
    until(lambda: unlatched.connections)
    unlatched.send(data='news')
    assert texts(late, 1) == ['news']


def test_a_latched_value_survives_a_restart_of_the_master():
    first = InProcessMaster()
    port = int(first.url.split(':')[-1].strip('/'))
    master = Master(first.url)
    try:
        latched_channel(master, '/latch/master').send(data='kept')
        first.stop()
        first = InProcessMaster(port)
        late = Mailbox()
        master.create(BlockNode, named='/late', domain='127.0.0.1').interested_in(
            '/latch/master', STRING, delegate=late
        )
        assert texts(late, 1) == ['kept']
        with Program(master.url, 'rostopic', 'echo', '-n1', '/latch/master') as echo:
            echo.wait_for('data: "kept"')
    finally:
        pharos.node_registry.stop_all()
        first.stop()


# -- what a receiver sees


def test_a_late_receiver_of_one_node_gets_what_that_one_latched(master):
    one = latched_channel(master, '/latch/from', '/one')
    two = latched_channel(master, '/latch/from', '/two')
    one.send(data='one')
    two.send(data='two')
    mailbox = Mailbox()
    node = master.create(BlockNode, named='/late', domain='127.0.0.1', delegate=mailbox)
    node.interested_in('/latch/from', from_='/two')
    message = mailbox.next()
    assert (message.data, message._connection_header['latching']) == ('two', '1')
    node.interested_in('/latch/from', from_='/one')
    assert texts(mailbox, 1) == ['one']
    assert mailbox.empty()


def test_a_shared_receiver_that_comes_late_gets_a_message_of_its_own(master):
    channel = latched_channel(master, '/latch/shared')
    sent = channel.send(data='as it was')
    first, second = Mailbox(), Mailbox()
    for name, mailbox in ('/first', first), ('/second', second):
        node = master.create(BlockNode, named=name, domain='127.0.0.1', delegate=mailbox)
        node.interested_in('/latch/shared', shared=True)
    sent.data = 'changed since'
    one, two = first.next(), second.next()
    assert one.data == two.data == 'as it was'
    assert one is not two
    assert one._connection_header == two._connection_header
    assert one._connection_header['callerid'] == '/sender'
