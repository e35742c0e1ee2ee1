"""Two ends of a topic that have different types: not connected, told once on each side, and
shown."""
import contextlib
import itertools
import sys
import threading

import pytest
import rospy
import std_msgs.msg

from helpers import create
from pharos.testing import Mailbox, TIMEOUT, until
import pharos
from pharos import MessageTypeError
from pharos import messages
from pharos.private_rospy import refusals
from pharos.intraprocess.link import Link
from programs import PROGRAMS, Program
from test_graph_types import Publisher

STRING, INT32 = 'std_msgs/String', 'std_msgs/Int32'
MD5SUM = {STRING: '992ce8a1687cec8c8bd883ec73ca41d1', INT32: 'da5909fbe378aeaf85e547e830cc1bb7'}
FIELD = {STRING: 'data: string', INT32: 'data: int32'}

numbers = itertools.count()  # the master never forgets the type of a topic


def create_patient(master, name, **kwargs):
    node = create(master, name, **kwargs)
    # what waits for a connection that never comes would not return
    node.connect_timeout = 100 * TIMEOUT
    return node


def in_time(job):
    """What ``job()`` returns; fails if it takes TIMEOUT."""
    outcome = []
    thread = threading.Thread(target=lambda: outcome.append(job()), daemon=True)
    thread.start()
    thread.join(TIMEOUT)
    assert outcome, 'it does not return'
    return outcome[0]


@pytest.fixture
def topic():
    return '/refusals/%d' % next(numbers)


@contextlib.contextmanager
def rospy_peer(url, topic, type_, text, kind='publisher', name='/far'):
    with Program(
        url, sys.executable, PROGRAMS / 'typed_peer.py', kind, name.strip('/'), topic, type_, text
    ) as peer:
        peer.wait_for('ready')
        yield name


@contextlib.contextmanager
def roscpp_publisher(url, topic, type_, text):
    """topic_tools' relay, which publishes what it has heard on another topic."""
    with rospy_peer(url, topic + '/heard', type_, text, name='/source'):
        with pharos.Master(url).run('topic_tools', 'relay', topic + '/heard', topic, name='far'):
            until(lambda: '/far' in pharos.Master(url).topic(topic).publishers)
            yield '/far'


@contextlib.contextmanager
def publisher_here(url, topic, type_, text):
    sender = create_patient(pharos.Master(url), '/far')
    in_time(
        lambda: sender.output_channel(
            topic, messages.class_from_definition(type_, text), latch=True
        )
    )
    yield '/far'
    sender.stop()


@contextlib.contextmanager
def careless_publisher(url, topic, type_, text):
    """One that does not check."""
    cls = messages.class_from_definition(type_, text)
    with Publisher(pharos.Master(url), topic, type_, text, cls._md5sum, name='/far'):
        yield '/far'


publishing = pytest.mark.parametrize(
    'publishing', [rospy_peer, roscpp_publisher, publisher_here, careless_publisher]
)


@pytest.fixture
def screen(capfd):
    """``screen(text)``: the lines on standard error, so far, with that text."""
    lines = []

    def with_text(text):
        lines.extend(capfd.readouterr().err.splitlines())
        return [line for line in lines if text in line]

    return with_text


def attempts(node):
    """A list that grows with each connection of the node that is refused."""
    made, refused = [], node.latest_run.rospy.refusals.publisher_refused
    node.latest_run.rospy.refusals.publisher_refused = lambda *args: (
        refused(*args),
        made.append(args),
    )
    return made


# -- the subscriber


@publishing
@pytest.mark.parametrize('first', ['the subscriber', 'the publisher'])
def test_a_publisher_of_another_type_is_told_once(master, topic, publishing, first, screen):
    node = create_patient(master, '/near')
    with contextlib.ExitStack() as there:
        if first == 'the publisher':
            there.enter_context(publishing(master.url, topic, INT32, 'int32 data'))
        channel = in_time(lambda: node.interested_in(topic, STRING))
        if first == 'the subscriber':
            there.enter_context(publishing(master.url, topic, INT32, 'int32 data'))
        until(lambda: node.health().refused)
        until(lambda: node.errors)
        (error,) = node.errors
        assert isinstance(error, MessageTypeError)
        assert str(error) == (
            f'/near wants {topic} as {STRING} [{MD5SUM[STRING]}] (data: string), but /far publishes {INT32} '
            f'[{MD5SUM[INT32]}] (data: int32), and is not heard: use one type, or another topic'
        )
        assert (channel.refused, channel.connections, node.health().refused) == (1, [], 1)
        assert '1 refused' in str(node.health())
        assert '1 refused' in repr(channel)
        until(lambda: screen('ERROR'))
        assert len(screen('ERROR')) == 1
        assert '/near wants' in screen('ERROR')[0]
        (failure,) = node.failures
        assert failure.count == 1
    until(lambda: node.health().refused == 0)  # it has gone


@publishing
def test_a_type_that_is_defined_otherwise_there_is_told_with_both_definitions(
    master, topic, publishing
):
    node = create_patient(master, '/near')
    node.interested_in(topic, STRING)
    with publishing(master.url, topic, STRING, 'int8 data'):
        until(lambda: node.errors)
    (error,) = node.errors
    assert f'as {STRING} [{MD5SUM[STRING]}] (data: string), but /far publishes {STRING} [' in str(
        error
    )
    assert '(data: int8), and is not heard: have both sides use the same String.msg' in str(error)


@publishing
def test_who_is_refused_and_tries_again_does_not_tell_again(master, topic, publishing):
    node, mailbox = create_patient(master, '/near'), Mailbox()
    made = attempts(node)
    node.interested_in(topic, STRING, delegate=mailbox)
    with publishing(master.url, topic, INT32, 'int32 data'):
        until(lambda: made)
        node.interested_in(topic, STRING)  # another channel
        # the master tells of both publishers, and rospy tries both
        before = len(made)
        with rospy_peer(master.url, topic, STRING, 'string data', name='/right'):
            assert mailbox.next().data == ''
            until(lambda: len(made) > before)
        assert node.health().refused == 1
    (failure,) = node.failures
    assert failure.count == 1


@pytest.mark.parametrize('publishing', [rospy_peer, publisher_here])
def test_a_master_that_has_restarted_is_no_reason_to_tell_again(mortal_master, topic, publishing):
    node = create_patient(pharos.Master(mortal_master.url), '/near')
    node.interested_in(topic, STRING)
    with publishing(mortal_master.url, topic, INT32, 'int32 data'):
        until(lambda: node.errors)
        made = attempts(node)
        mortal_master.end()
        mortal_master.come_back()
        until(lambda: '/near' in node.master.topic(topic).subscribers)
        if publishing is publisher_here:  # rospy's does not come back
            until(lambda: '/far' in node.master.topic(topic).publishers)
            until(lambda: made)
    (failure,) = node.failures
    assert failure.count == 1


def test_what_was_right_meanwhile_is_counted_anew(master, topic):
    node, sender, mailbox = (
        create_patient(master, '/near'),
        create_patient(master, '/far'),
        Mailbox(),
    )
    node.interested_in(topic, STRING, delegate=mailbox)
    for turn in 1, 2:
        wrong = in_time(lambda: sender.output_channel(topic, INT32))
        until(lambda: [failure.count for failure in node.failures] == [turn])
        wrong.close()
        until(lambda: node.health().refused == 0)
        right = in_time(lambda: sender.output_channel(topic, STRING))
        right.send(data='right')
        assert mailbox.next().data == 'right'
        assert node.health().refused == 0
        right.close()
        until(lambda: not node.channels[0].connections)


def test_each_publisher_of_another_type_is_told(master, topic):
    node = create_patient(master, '/near')
    senders = [create_patient(master, '/far_%d' % number) for number in range(5)]
    for sender in senders:
        in_time(lambda: sender.output_channel(topic, INT32))
    channel = in_time(lambda: node.interested_in(topic, STRING))
    until(lambda: len(node.errors) == 5)
    assert channel.refused == node.health().refused == 5
    channel.close()
    assert channel.refused == node.health().refused == 0


def test_a_subscriber_of_any_type_hears_all(master, topic):
    node, mailbox = create_patient(master, '/near'), Mailbox()
    create_patient(master, '/here').output_channel(topic, STRING, latch=True).send(data='from here')
    with rospy_peer(master.url, topic, INT32, 'int32 data'):
        node.interested_in(topic, rospy.AnyMsg, delegate=mailbox)
        assert sorted(message._connection_header['type'] for message in mailbox.take(2)) == [
            INT32,
            STRING,
        ]
    assert not node.errors
    assert node.health().refused == 0


def test_a_publisher_of_any_type_is_told_as_one(master, topic):
    node = create_patient(master, '/near')
    create_patient(master, '/far').ros.Publisher(topic, rospy.AnyMsg, queue_size=1)
    in_time(lambda: node.interested_in(topic, STRING))
    until(lambda: node.errors)
    assert '/far publishes messages of any type, and is not heard: only subscribers of any' in str(
        node.errors[0]
    )


@pytest.mark.parametrize('publishing', [rospy_peer, publisher_here])
@pytest.mark.parametrize('first', ['the subscribers', 'the publisher'])
def test_a_channel_beside_a_subscriber_of_any_type_hears_its_own_type_alone(
    master, topic, publishing, first
):
    """rospy connects a node once to a publisher: by the md5sum of its first subscriber, which here
    is none."""
    node, mailbox, anything = create_patient(master, '/near'), Mailbox(), Mailbox()

    def subscribe():
        node.ros.Subscriber(topic, rospy.AnyMsg, lambda message: anything(message, None))
        in_time(lambda: node.interested_in(topic, STRING, delegate=mailbox))

    with contextlib.ExitStack() as there:
        if first == 'the subscribers':
            subscribe()
        there.enter_context(publishing(master.url, topic, INT32, 'int32 data'))
        if first == 'the publisher':
            subscribe()
        if publishing is publisher_here:
            (far,) = [
                channel for channel in master.topic(topic).channels if hasattr(channel, 'send')
            ]
            far.send(data=0)  # which, read as a string, is an empty one
        assert anything.next()._buff == bytes(4)
        until(lambda: node.errors)
        assert f'/near wants {topic} as {STRING}' in str(node.errors[0])
        assert len(node.errors) == 1
        assert node.health().refused == 1
        with rospy_peer(master.url, topic, STRING, 'string data', name='/right'):
            assert mailbox.next()._connection_header['callerid'] == '/right'
        assert mailbox.empty()


def test_a_plain_rospy_subscriber_is_told_too(master, topic):
    node = create_patient(master, '/near')
    node.ros.Subscriber(topic, std_msgs.msg.String)
    with rospy_peer(master.url, topic, INT32, 'int32 data'):
        until(lambda: node.errors)
    assert f'/near wants {topic} as {STRING}' in str(node.errors[0])


def test_a_publisher_that_refuses_for_another_reason_is_no_matter_of_types(master, topic):
    """It has just closed its topic, or another node has its address by now."""
    node, other = create_patient(master, '/near'), create_patient(master, '/far')
    made = attempts(node)
    with Publisher(
        master, topic, STRING, name='/busy', answer=[1, '', ['TCPROS', '127.0.0.1', other.tcp_port]]
    ):
        node.interested_in(topic, STRING)
        until(lambda: made)
    assert not node.errors
    assert node.health().refused == 0


def test_a_channel_that_is_opened_while_its_node_connects_hears_the_publisher(
    master, topic, monkeypatch
):
    """The subscription is connected already, but the link was made without the channel."""
    node, sender, mailbox = (
        create_patient(master, '/near'),
        create_patient(master, '/far'),
        Mailbox(),
    )
    match, opened = Link.match_receivers, []

    def match_and_open(self):
        new = match(self)
        if not opened:
            opened.append(
                threading.Thread(target=lambda: node.interested_in(topic, STRING, delegate=mailbox))
            )
            opened[0].start()
            until(lambda: len(node.latest_run.rospy.subscriber(topic).callbacks) == 2)
        return new

    monkeypatch.setattr(Link, 'match_receivers', match_and_open)
    node.ros.Subscriber(topic, rospy.AnyMsg, lambda message: None)
    channel = sender.output_channel(topic, STRING)
    opened[0].join(TIMEOUT)
    channel.send(data='heard')
    assert mailbox.next().data == 'heard'


# -- the publisher


@pytest.mark.parametrize('where', ['here', 'elsewhere'])
@pytest.mark.parametrize('first', ['the subscriber', 'the publisher'])
def test_a_subscriber_of_another_type_is_warned_of_once_and_not_waited_for(
    master, topic, where, first, screen
):
    sender = create_patient(master, '/near')
    with contextlib.ExitStack() as there:

        def subscribe():
            if where == 'here':
                create_patient(master, '/far').interested_in(topic, STRING)
            else:
                there.enter_context(
                    rospy_peer(master.url, topic, STRING, 'string data', 'subscriber')
                )

        if first == 'the subscriber':
            subscribe()
        in_time(lambda: sender.send_to(topic, typed_as=INT32, data=7))
        if first == 'the publisher':
            subscribe()
        until(lambda: screen('WARN'))
        # so that it tries again
        in_time(lambda: create_patient(master, '/other').output_channel(topic, INT32))
        until(lambda: len(screen('WARN')) == 2)
        mine, others = screen('WARN')
        for line in mine, others:
            assert topic in line
            assert '/far' in line
            assert STRING in line
            assert INT32 in line
        # another one, for which the master is asked
        in_time(lambda: sender.output_channel(topic, INT32))
        assert sender.latest_run.rospy.refusals.subscribers(topic) == ['/far']


def test_a_subscriber_that_has_changed_its_type_is_waited_for_again(master, topic):
    sender, receiver, mailbox = (
        create_patient(master, '/near'),
        create_patient(master, '/far'),
        Mailbox(),
    )
    wrong = receiver.interested_in(topic, STRING)
    sender.output_channel(topic, INT32)
    assert sender.latest_run.rospy.refusals.subscribers(topic) == ['/far']
    wrong.close()
    receiver.interested_in(topic, INT32, delegate=mailbox)
    assert sender.latest_run.rospy.refusals.subscribers(topic) == []
    sender.send_to(topic, data=7)
    assert mailbox.next().data == 7


def test_a_crowd_of_refusals_is_remembered_within_bounds(master, topic, monkeypatch):
    monkeypatch.setattr(refusals, 'REMEMBERED', 3)
    node = create_patient(master, '/near')
    node.output_channel(topic, INT32)
    publisher = node.latest_run.rospy.publisher(topic)
    for number in range(10):
        node.latest_run.rospy.refusals.subscriber_refused(
            publisher, '/far_%d' % number, 'words', 'line'
        )
    assert node.latest_run.rospy.refusals.subscribers(topic) == ['/far_7', '/far_8', '/far_9']
