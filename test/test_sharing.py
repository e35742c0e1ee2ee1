"""shared=True: what others hold never changes, whoever publishes it again."""
import pytest

from helpers import create
from pharos.testing import Mailbox, until
from pharos.messages import define_service

POINT, STRING, HEADER = 'geometry_msgs/PointStamped', 'std_msgs/String', 'std_msgs/Header'


def listener(master, name, topic, type_):
    mailbox = Mailbox()
    create(master, name, delegate=mailbox).interested_in(topic, type_, shared=True)
    return mailbox


def snapshot(message):
    return (message.header.seq if message._has_header else None), dict(message._connection_header)


@pytest.mark.parametrize('type_', [POINT, STRING])
def test_a_relay_of_a_shared_message_changes_nothing_that_others_hold(master, type_):
    """Neither header.seq nor _connection_header, of which the relay has its own."""
    holder = listener(master, '/holder', '/sharing/in', type_)
    relayed = listener(master, '/end', '/sharing/out', type_)
    relay = create(master, '/relay')
    out = relay.output_channel('/sharing/out', type_)
    out.send()  # so that its numbers are others
    relayed.next()
    relay.interested_in(
        '/sharing/in', type_, delegate=lambda message, channel: out.publish(message), shared=True
    )
    sent = create(master, '/sender').output_channel('/sharing/in', type_)
    message = sent.send()
    held = holder.next()
    before = snapshot(held)
    assert held is message
    assert before[1]['callerid'] == '/sender'
    passed_on = relayed.next()
    assert snapshot(held) == before
    assert passed_on == held or type_ is POINT
    assert snapshot(passed_on) == (
        2 if type_ is POINT else None,
        {**before[1], 'callerid': '/relay', 'topic': '/sharing/out'},
    )


def test_a_message_with_a_shared_header_gets_a_header_of_its_own(master):
    held_by = listener(master, '/holder', '/sharing/points', POINT)
    out = create(master, '/relay').output_channel(
        '/sharing/vectors', 'geometry_msgs/Vector3Stamped'
    )
    others = listener(master, '/end', '/sharing/vectors', 'geometry_msgs/Vector3Stamped')
    create(master, '/sender').output_channel('/sharing/points', POINT).send(
        header={'frame_id': 'here'}
    )
    held = held_by.next()
    for number in 1, 2:
        message = out.send(header=held.header)
        assert (held.header.seq, message.header.seq, message.header.frame_id) == (1, number, 'here')
        assert others.next().header.seq == number


def test_a_shared_message_that_is_a_header_stays_as_it_is(master):
    held_by = listener(master, '/holder', '/sharing/headers', HEADER)
    create(master, '/sender').output_channel('/sharing/headers', HEADER).send(seq=7)
    held = held_by.next()
    listener(master, '/end', '/sharing/of_header', POINT)
    sent = create(master, '/relay').output_channel('/sharing/of_header', POINT).send(header=held)
    assert (held.seq, sent.header.seq) == (7, 1)


def test_a_message_published_twice_keeps_the_number_that_receivers_hold(master):
    mailbox = listener(master, '/holder', '/sharing/twice', POINT)
    copies = Mailbox()
    create(master, '/other', delegate=copies).interested_in('/sharing/twice', POINT)
    channel = create(master, '/sender').output_channel('/sharing/twice', POINT)
    message = channel.message_class()
    channel.publish(message)
    channel.publish(message)
    first, second = mailbox.take(2)
    assert (first.header.seq, second.header.seq) == (1, 2)
    assert first is message
    assert second is not message
    assert [one.header.seq for one in copies.take(2)] == [1, 2]


def test_a_message_without_a_header_is_handed_over_itself_as_often_as_it_is_published(master):
    mailbox = listener(master, '/holder', '/sharing/plain', STRING)
    channel = create(master, '/sender').output_channel('/sharing/plain', STRING)
    message = channel.message_class('again')
    for _ in range(3):
        channel.publish(message)
        assert mailbox.next() is message


def test_a_publishers_own_message_is_numbered(master):
    """As in rospy, where nobody else holds it."""
    mailbox = Mailbox()
    create(master, '/copies', delegate=mailbox).interested_in('/sharing/own', POINT)
    channel = create(master, '/sender').output_channel('/sharing/own', POINT)
    message = channel.message_class()
    for number in 1, 2, 3:
        channel.publish(message)
        assert message.header.seq == mailbox.next().header.seq == number


def test_a_message_that_was_shared_with_nobody_stays_the_publishers_own(master):
    mailbox = Mailbox()
    create(master, '/copies', delegate=mailbox).interested_in('/sharing/alone', POINT)
    listener(master, '/holder', '/sharing/alone', POINT)
    channel = create(master, '/sender').output_channel('/sharing/alone', POINT)
    message = channel.message_class()
    for number in 1, 2:
        channel.publish(message, to='/copies')
        assert message.header.seq == mailbox.next().header.seq == number
    master.node('/holder').channels[0].close()
    until(lambda: len(channel.connections) == 1)
    for number in 3, 4:
        channel.publish(message)
        assert message.header.seq == mailbox.next().header.seq == number


def test_a_relay_of_a_message_that_is_ones_own_numbers_it(master):
    channel = create(master, '/relay').output_channel('/sharing/relayed', POINT)
    create(master, '/end').interested_in('/sharing/relayed', POINT)
    mailbox = Mailbox()
    create(master, '/middle', delegate=mailbox).interested_in('/sharing/copied', POINT)
    create(master, '/sender').output_channel('/sharing/copied', POINT).send()
    message = mailbox.next()
    for number in 1, 2:
        channel.publish(message)
        assert message.header.seq == number


@pytest.mark.parametrize('timeout', [None, 10.0])
def test_a_service_that_answers_with_a_shared_header_leaves_it_as_it_is(master, timeout):
    define_service('sharing/Latest', 'Header header\n---\nHeader header\n')
    held_by = listener(master, '/holder', '/sharing/latest', POINT)
    channel = create(master, '/sender').output_channel('/sharing/latest', POINT)
    channel.send()
    held = held_by.next()
    node = create(master, '/server')
    node.serve('/sharing/service', 'sharing/Latest', lambda request: {'header': held.header})
    service = master.lookup_service('/sharing/service')
    proxy = create(master, '/client').ros.ServiceProxy('/sharing/service', service.service_class)
    for number in 1, 2, 3:
        answers = service.call(timeout=timeout, header=held.header), proxy(held.header)
        assert held.header.seq == 1
    assert {answer.header.seq for answer in answers} == {5, 6}
