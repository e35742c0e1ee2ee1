"""/statistics, where the parameter /enable_statistics is true: of INTRAPROCESS connections as of
TCPROS ones."""
import io
import threading

import pytest
import rosgraph
import rospy

from helpers import speak_tcpros_only
from pharos.testing import Mailbox, until
from pharos import BlockNode

POINT = 'geometry_msgs/PointStamped'
TRANSPORTS = 'INTRAPROCESS', 'TCPROS'


@pytest.fixture
def statistics(master):
    """What is told on /statistics."""
    rosgraph.Master('/test').setParam('/enable_statistics', True)
    mailbox = Mailbox()
    node = master.create(BlockNode, named='/auditor', domain='127.0.0.1', delegate=mailbox)
    node.interested_in('/statistics', 'rosgraph_msgs/TopicStatistics')
    yield mailbox
    rosgraph.Master('/test').deleteParam('/enable_statistics')


def listen(master, name, topic, transport):
    mailbox = Mailbox()
    node = master.create(BlockNode, named=name, domain='127.0.0.1')
    if transport == 'TCPROS':
        speak_tcpros_only(node)
    node.interested_in(topic, POINT, delegate=mailbox)
    return mailbox, node


def tell(statistics, channel, *mailboxes):
    """Send, and have each received, until the next statistics are there; returns them."""
    said, sent = [], []

    def next_statistics():
        sent.append(channel.send(header={'stamp': channel.node.ros.Time.now() - rospy.Duration(5)}))
        for mailbox in mailboxes:
            mailbox.next()
        if not statistics.empty():
            said.append(statistics.next())
        return any(one.delivered_msgs > 1 for one in said)

    until(next_statistics)
    return next(one for one in said if one.delivered_msgs > 1), sent[-1]


@pytest.mark.parametrize('transport', TRANSPORTS)
def test_statistics_tell_of_a_connection(master, statistics, transport):
    mailbox, receiver = listen(master, '/receiver', f'/statistics_of/{transport}', transport)
    channel = master.create(BlockNode, named='/sender', domain='127.0.0.1').output_channel(
        f'/statistics_of/{transport}', POINT
    )
    told, sent = tell(statistics, channel, mailbox)
    assert channel.connections == [('/receiver', transport)]
    assert (told.topic, told.node_sub, told.node_pub) == (channel.topic, '/receiver', '/sender')
    buffer = io.BytesIO()
    sent.serialize(buffer)
    assert told.traffic == told.delivered_msgs * (4 + len(buffer.getvalue()))
    assert told.dropped_msgs == 0
    assert told.period_mean.to_sec() > 0
    assert told.period_max >= told.period_mean
    assert 5 <= told.stamp_age_mean.to_sec() < 20
    assert told.stamp_age_max >= told.stamp_age_mean
    assert told.window_stop > told.window_start
    receiver.stop()
    until(lambda: '/receiver' not in master.topic('/statistics').publishers)


def test_a_node_with_two_channels_counts_a_message_once(master, statistics):
    first, receiver = listen(master, '/receiver', '/statistics_of/two', 'INTRAPROCESS')
    second = Mailbox()
    receiver.interested_in('/statistics_of/two', delegate=second, shared=True)
    channel = master.create(BlockNode, named='/sender', domain='127.0.0.1').output_channel(
        '/statistics_of/two', POINT
    )
    told, _ = tell(statistics, channel, first, second)
    assert told.delivered_msgs <= channel.sent


@pytest.mark.parametrize('transport', TRANSPORTS)
def test_a_subscription_that_ends_tells_no_more(master, statistics, transport):
    topic = f'/statistics_of/ending_{transport}'
    mailbox, receiver = listen(master, '/receiver', topic, 'INTRAPROCESS')
    other, _ = listen(master, '/other', topic, transport)
    channel = master.create(BlockNode, named='/sender', domain='127.0.0.1').output_channel(
        topic, POINT
    )
    tell(statistics, channel, mailbox, other)
    until(lambda: '/receiver' in master.topic('/statistics').publishers)
    receiver.channels[0].close()
    until(lambda: '/receiver' not in master.topic('/statistics').publishers)
    until(
        lambda: not any(thread.name == '/receiver statistics' for thread in threading.enumerate())
    )
    until(lambda: len(channel.connections) == 1)
    tell(statistics, channel, other)
    assert receiver.is_running


def test_without_the_parameter_there_is_nothing_to_tell(master):
    """It is read when a subscription begins, as in rospy."""
    mailbox, _ = listen(master, '/receiver', '/statistics_of/none', 'INTRAPROCESS')
    channel = master.create(BlockNode, named='/sender', domain='127.0.0.1').output_channel(
        '/statistics_of/none', POINT
    )
    channel.send()
    mailbox.next()
    assert not any(thread.name == '/receiver statistics' for thread in threading.enumerate())
