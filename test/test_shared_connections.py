"""One connection to a publisher elsewhere for the nodes of this process: what each of them gets is
what its own connection would bring."""
import contextlib
import os
import struct
import sys
import threading
import types
import warnings
import weakref

import genpy
import pytest
from std_msgs.msg import Int32, String

from helpers import create, ended, in_thread, speak_tcpros_only
from pharos import Master, NodeStoppedError, first_message
import pharos
from pharos.private_rospy import registration, shared_connections
from pharos.private_rospy.patches import subscribers
from pharos.private_rospy.tcpros_connection import TcprosConnection
from pharos.testing import Mailbox, TIMEOUT, until
import programs

COUNT = 200  # messages sent while something changes


@pytest.fixture
def sharing(master):
    """The master, by which nodes share connections."""
    return Master(master.url, share_connections=True)


def listen(sharing, *names, topic='/shared', typed_as=Int32, **options):
    """Nodes that hear a topic through sockets alone, each with a mailbox."""
    boxes = []
    for name in names:
        box = Mailbox()
        node = speak_tcpros_only(create(sharing, name))
        node.interested_in(topic, typed_as, delegate=box, **options)
        boxes.append((node, box))
    return boxes


def sender_of(master, *heard_by, topic='/shared', typed_as=Int32, **options):
    """A channel, once these nodes hear it."""
    channel = create(master, '/sender').output_channel(topic, typed_as, **options)
    wait_until_heard(channel, *heard_by)
    return channel


def wait_until_heard(channel, *nodes):
    """A publisher has a connection somewhat later than who hears it, whom it has answered before."""
    name = channel.node.name
    for node in nodes:
        until(lambda: (name, 'TCPROS') in node.channels[0].connections)
    until(lambda: channel.connections)


def waits_for_its_turn(thread):
    """Whether the thread waits for another one that makes a connection."""
    frame = sys._current_frames().get(thread.ident)
    return frame is not None and (frame.f_code.co_name, 'before' in frame.f_locals) == (
        '_turn',
        True,
    )


def data(box, count):
    """The numbers in all messages that came, after so many more."""
    box.take(count)
    return [message.data for message in box.all()]


def test_the_nodes_share_one_connection_and_each_has_a_message_of_its_own(master, sharing):
    (first, one), (second, two) = listen(sharing, '/first', '/second', typed_as=String)
    channel = sender_of(master, first, second, typed_as=String)
    assert [name in ('/first', '/second') for name, _ in channel.connections] == [True]
    channel.send(data='hello')
    mine, other = one.next(), two.next()
    assert mine == other and mine is not other
    for message in mine, other:
        assert message._connection_header['callerid'] == '/sender'
        assert message._connection_header['type'] == 'std_msgs/String'
    assert first.channels[0].received == second.channels[0].received == 1


def test_those_who_take_shared_messages_get_one_and_the_same(master, sharing):
    (first, one), (second, two) = listen(sharing, '/first', '/second', shared=True)
    sender_of(master, first, second).send(data=1)
    assert one.next() is two.next()


def test_who_comes_late_gets_what_is_latched_once(master, sharing):
    ((first, one),) = listen(sharing, '/first')
    channel = sender_of(master, first, latch=True)
    channel.send(data=1)
    assert one.next().data == 1
    ((late, two),) = listen(sharing, '/late')
    assert two.next().data == 1
    channel.send(data=2)
    assert data(one, 1) == data(two, 1) == [1, 2]
    assert len(channel.connections) == 1


def test_header_seq_is_the_publishers(master, sharing):
    ((first, one),) = listen(sharing, '/first', typed_as='std_msgs/Header')
    channel = sender_of(master, first, typed_as='std_msgs/Header')
    ((late, two),) = listen(sharing, '/late', topic='/pose', typed_as='geometry_msgs/PoseStamped')
    poses = channel.node.output_channel('/pose', 'geometry_msgs/PoseStamped')
    wait_until_heard(poses, late)
    for expected in 1, 2:
        poses.send()
        assert two.next().header.seq == expected


@pytest.mark.parametrize('leaves', [0, 1], ids=['the one that connected', 'another'])
def test_when_one_stops_the_others_miss_nothing_and_get_nothing_twice(master, sharing, leaves):
    listeners = listen(sharing, '/first', '/second', '/third')
    channel = sender_of(master, *(node for node, _ in listeners))
    by_name = {node.name: node for node, _ in listeners}
    connected = by_name[channel.connections[0][0]]
    others = [node for node, _ in listeners if node is not connected]
    stopped = [connected, *others][leaves]

    def publish():
        for number in range(COUNT):
            channel.send(data=number)

    publishing = in_thread(publish)
    until(lambda: listeners[2][0].channels[0].received > COUNT // 10)
    stopped.stop()
    publishing.join(TIMEOUT)
    for node, box in listeners:
        if node is not stopped:
            assert data(box, COUNT) == list(range(COUNT))
    assert len(channel.connections) == 1


def test_when_the_last_has_stopped_the_connection_is_closed(master, sharing):
    (first, one), (second, two) = listen(sharing, '/first', '/second')
    channel = sender_of(master, first, second)
    first.stop()
    assert len(channel.connections) == 1
    second.stop()
    until(lambda: not channel.connections)
    ((third, three),) = listen(sharing, '/third')
    wait_until_heard(channel, third)
    channel.send(data=1)
    assert three.next().data == 1


@pytest.fixture
def connecting(monkeypatch):
    """A list of who has made a connection, and an event: they may go on."""
    makers, go_on = [], threading.Event()

    def make(address, header, *args):
        made = TcprosConnection(address, header, *args)
        makers.append(header['callerid'])
        go_on.wait(TIMEOUT)
        return made

    monkeypatch.setattr(shared_connections, 'TcprosConnection', make)
    yield makers, go_on
    go_on.set()


def test_a_connection_whose_maker_is_not_interested_any_more_is_closed(master, sharing, connecting):
    makers, go_on = connecting
    ((first, one),) = listen(sharing, '/first')
    sender = create(master, '/sender')
    opening = in_thread(sender.output_channel, '/shared', Int32)
    until(lambda: makers)
    first.channels[0].close()
    go_on.set()
    assert ended(opening)
    (channel,) = sender.channels
    until(lambda: not channel.connections)
    channel.send(data=1)
    ((second, two),) = listen(sharing, '/second')
    wait_until_heard(channel, second)
    channel.send(data=2)
    assert two.next().data == 2


def test_a_node_stops_while_another_one_makes_the_connection(
    master, sharing, connecting, transcript
):
    makers, go_on = connecting
    (first, one), (second, two) = listen(sharing, '/first', '/second')
    sender = create(master, '/sender')
    opening = in_thread(sender.output_channel, '/shared', Int32)
    until(lambda: makers)
    maker, other = (first, second) if makers == ['/first'] else (second, first)
    until(lambda: other.latest_run.rospy.connections._connecting)
    other.stop()
    assert not [line for line in transcript if 'left behind' in line]
    go_on.set()
    assert ended(opening)
    wait_until_heard(sender.channels[0], maker)


def test_two_threads_do_not_make_a_connection_at_once(monkeypatch):
    """Which both look for it while neither has found one."""
    node, both, second = types.SimpleNamespace(ended=threading.Event()), threading.Barrier(2), []
    reference = weakref.KeyedRef

    def take_turn():
        with shared_connections._turn(node, 'key'):
            try:
                both.wait(0.2)
            except threading.BrokenBarrierError:
                return
            second.append('at once')

    def refer(*arguments):
        monkeypatch.undo()
        other.append(in_thread(take_turn))
        other[0].join(0.1)  # it has looked, too, or waits for its turn to
        return reference(*arguments)

    other = []
    monkeypatch.setattr(weakref, 'KeyedRef', refer)
    take_turn()
    assert ended(other[0])
    assert not second


def test_a_process_forked_while_a_connection_is_made_makes_its_own():
    node = types.SimpleNamespace(ended=threading.Event())
    has_turn, forked = threading.Event(), threading.Event()

    def connect():
        with shared_connections._turn(node, 'key'):
            has_turn.set()
            forked.wait(TIMEOUT)

    connecting = in_thread(connect)
    assert has_turn.wait(TIMEOUT)
    with warnings.catch_warnings():  # Python 3.12 and later do not like what is tried here
        warnings.simplefilter('ignore', DeprecationWarning)
        child = os.fork()
    if not child:
        node.ended.set()  # so that a turn that does not come is an error
        try:
            with shared_connections._turn(node, 'key'):
                os._exit(0)
        finally:
            os._exit(1)
    forked.set()
    assert os.waitpid(child, 0)[1] == 0
    assert ended(connecting)


@pytest.mark.parametrize('is_shared', [False, True], ids=['own', 'shared'])
def test_a_node_for_which_there_was_no_thread_says_so_and_hears_the_publisher_once_there_is_one(
    master, monkeypatch, is_shared
):
    node, heard, told = (
        create(Master(master.url, share_connections=is_shared)),
        Mailbox(),
        Mailbox(),
    )
    speak_tcpros_only(node)
    monkeypatch.setattr(registration, 'RETRY_DELAY', 0.1)
    monkeypatch.setattr(node.latest_run.rospy, 'warn', lambda line: told(line, None))
    start, refused = threading.Thread.start, []

    def refuse(self):
        if self.name in ('/shared of /sender', '/node /shared') and len(refused) < 2:
            refused.append(self)
            raise RuntimeError("can't start new thread")
        start(self)

    monkeypatch.setattr(threading.Thread, 'start', refuse)
    node.interested_in('/shared', Int32, delegate=heard)
    sender = create(master, '/sender')
    sender.connect_timeout = 0
    sender.latest_run.rospy.connections._neighbours = list  # as if it were of another process
    channel = sender.output_channel('/shared', Int32)
    wait_until_heard(channel, node)
    assert len(refused) == 2
    assert "can't start new thread" in told.next() and told.empty()
    channel.send(data=1)
    assert heard.next().data == 1


def test_who_has_a_class_of_its_own_is_not_in_the_way_of_the_others(master, sharing):
    """One that reads what comes as something else, or cannot."""

    class Unreadable(Int32):
        def deserialize(self, data):
            raise genpy.DeserializationError('as it is')

    class Other(Int32):
        pass

    listeners = [
        *listen(sharing, '/unreadable', typed_as=Unreadable),
        *listen(sharing, '/first', '/second', shared=True),
        *listen(sharing, '/other', typed_as=Other, shared=True),
    ]
    channel = sender_of(master, *(node for node, _ in listeners[1:]))
    channel.send(data=1)
    messages = [box.next() for _, box in listeners[1:]]
    assert [(type(each), each.data) for each in messages] == [(Int32, 1), (Int32, 1), (Other, 1)]
    assert messages[0] is messages[1]


def test_a_delegate_cannot_wait_for_what_its_thread_is_to_bring_to_another_node(
    master, sharing, mailbox
):
    (first, _), (second, two) = listen(sharing, '/first', '/second')
    first.channels[0].close()

    def wait(message, channel):
        try:
            second.wait_for_message('/shared')
        except pharos.PharosError as error:
            mailbox(error, None)

    first.interested_in('/shared', Int32, delegate=wait, inline=True)
    sender_of(master, first, second).send(data=1)
    assert 'this delegate runs in the thread that brings' in str(mailbox.next())
    assert two.next().data == 1


def test_who_waits_for_a_connection_that_fails_does_not_try_for_as_long_again():
    """A publisher that does not answer would hold the last of ten nodes up for a hundred seconds."""
    node, told = types.SimpleNamespace(ended=threading.Event(), name='/node'), Mailbox()
    has_turn, fails = threading.Event(), threading.Event()

    def fail():
        with contextlib.suppress(ConnectionError), shared_connections._turn(node, 'key'):
            has_turn.set()
            fails.wait(TIMEOUT)
            raise ConnectionError('no answer')

    def take_turn():
        try:
            with shared_connections._turn(node, 'key'):
                told('made', None)
        except OSError as error:
            told(str(error), None)

    failing = in_thread(fail)
    assert has_turn.wait(TIMEOUT)
    waiting = [in_thread(take_turn) for _ in range(2)]
    until(lambda: all(map(waits_for_its_turn, waiting)))
    fails.set()
    assert all(map(ended, [failing, *waiting]))
    assert told.take(2) == ['another node could not connect to it'] * 2
    take_turn()
    assert told.next() == 'made'


@pytest.mark.parametrize('is_shared', [False, True], ids=['own', 'shared'])
@pytest.mark.parametrize('what', ['no md5sum', 'no address'])
def test_a_publisher_that_answers_nonsense_is_heard_once_it_answers_properly(
    master, monkeypatch, is_shared, what
):
    ((node, heard),) = listen(Master(master.url, share_connections=is_shared), '/node')
    monkeypatch.setattr(registration, 'RETRY_DELAY', 0.1)
    sender, said = create(master, '/sender'), []
    of_sender = sender.latest_run.rospy.module.impl.tcpros_pubsub
    really = of_sender.TCPROSHandler.init_publisher, of_sender.TCPROSPub.get_header_fields

    def init_publisher(self, topic, protocol):
        answer = really[0](self, topic, protocol)
        said.append(answer)
        return (
            (1, 'ok', ['TCPROS', 'a..b', 5]) if what == 'no address' and len(said) < 3 else answer
        )

    def get_header_fields(self):
        fields = really[1](self)
        if what == 'no md5sum' and len(said) < 3:
            del fields['md5sum']
        return fields

    monkeypatch.setattr(of_sender.TCPROSHandler, 'init_publisher', init_publisher)
    monkeypatch.setattr(of_sender.TCPROSPub, 'get_header_fields', get_header_fields)
    sender.connect_timeout = 0
    channel = sender.output_channel('/shared', Int32)
    until(lambda: node.latest_run.rospy.connections.hears('/shared'))
    wait_until_heard(channel, node)
    assert len(said) == 3
    channel.send(data=1)
    assert heard.next().data == 1
    assert not node.channels[0].refused


def test_what_is_no_message_ends_the_connection_and_is_told(master, sharing, monkeypatch):
    ((first, one),) = listen(sharing, '/first')
    told = Mailbox()
    monkeypatch.setattr(first.latest_run.rospy, 'warn', lambda line: told(line, None))
    channel = sender_of(master, first)
    (connection,) = channel.node.latest_run.rospy.publisher('/shared').fanout.connections
    connection.write_data(struct.pack('<I', 0xFFFFFFFF))
    assert told.next() == (
        'connection with /sender for /shared closed: 4294967295 bytes were announced; the limit is'
        ' 1073741824'
    )
    until(lambda: connection.done)
    wait_until_heard(channel, first)
    channel.send(data=1)
    assert one.next().data == 1


@pytest.mark.parametrize('is_shared', [False, True], ids=['own', 'shared'])
def test_a_publisher_that_sends_nothing_but_nonsense_is_not_stormed(master, monkeypatch, is_shared):
    """One that was understood before is connected to again at once, so that little is lost."""
    master = Master(master.url, share_connections=is_shared)
    ((node, heard),) = listen(master, '/node')
    channel = sender_of(master, node)
    connections, delays = node.latest_run.rospy.connections, Mailbox()
    connect_later = connections.connect_later

    def connect_at_once(subscriber, uri, delay):
        delays(delay, None)
        connect_later(subscriber, uri, 0)

    monkeypatch.setattr(connections, 'connect_later', connect_at_once)
    publisher = channel.node.latest_run.rospy.publisher('/shared')
    for is_understood in False, True, False:
        if is_understood:
            channel.send(data=1)
            assert heard.next().data == 1
        (connection,) = publisher.fanout.connections
        connection.write_data(struct.pack('<I', 0xFFFFFFFF))
        delay = delays.next()
        assert delay == (subscribers.RECONNECT_DELAY if is_understood else registration.RETRY_DELAY)
        until(lambda: connection not in publisher.fanout.connections)
        wait_until_heard(channel, node)


def test_a_publisher_that_comes_back_is_heard_by_all(master, sharing):
    (first, one), (second, two) = listen(sharing, '/first', '/second')
    channel = sender_of(master, first, second)
    channel.node.stop()
    until(lambda: not first.channels[0].connections and not second.channels[0].connections)
    channel.node.start()
    wait_until_heard(channel, first, second)
    channel.send(data=1)
    assert one.next().data == two.next().data == 1
    assert len(channel.connections) == 1


def test_a_node_that_is_busy_holds_no_other_up_and_its_queue_drops_the_oldest(master, sharing):
    busy = speak_tcpros_only(create(sharing, '/busy'))
    begun, goes_on = Mailbox(), Mailbox()

    def work(message, channel):
        begun(message, channel)
        goes_on.next()

    busy.interested_in('/shared', Int32, delegate=work, queue_size=1)
    ((other, box),) = listen(sharing, '/other')
    channel = sender_of(master, busy, other)
    channel.send(data=0)
    begun.next()
    for number in range(1, 10):
        channel.send(data=number)
    assert data(box, 10) == list(range(10))
    until(lambda: busy.channels[0].dropped == 8)
    goes_on(None, None)
    assert begun.next().data == 9
    goes_on(None, None)


def test_a_plain_subscriber_and_one_of_any_type_hear_it_too(master, sharing):
    ((first, box),) = listen(sharing, '/first')
    plain = speak_tcpros_only(create(sharing, '/plain'))
    any_type = speak_tcpros_only(create(sharing, '/any_type'))
    channel = sender_of(master, first)
    heard, raw = Mailbox(), Mailbox()
    plain.ros.Subscriber('/shared', Int32, lambda message: heard(message, None))
    any_type.ros.Subscriber('/shared', plain.ros.AnyMsg, lambda message: raw(message, None))
    # one who takes any type says another md5sum to the publisher
    until(lambda: len(channel.connections) == 2)
    until(lambda: plain.latest_run.rospy.connections.hears('/shared'))
    channel.send(data=7)
    assert box.next().data == heard.next().data == 7
    assert raw.next()._buff == b'\7\0\0\0'


def test_one_of_another_type_is_refused_and_the_others_hear_on(master, sharing):
    ((first, box),) = listen(sharing, '/first')
    channel = sender_of(master, first)
    ((wrong, _),) = listen(sharing, '/wrong', typed_as=String)
    until(lambda: wrong.errors)
    assert 'std_msgs/Int32' in str(wrong.errors[0])
    channel.send(data=1)
    assert box.next().data == 1


def test_only_messages_of_a_node_asked_for_come(master, sharing):
    (first, one), (second, two) = listen(sharing, '/first', '/second')
    ((choosy, three),) = listen(sharing, '/choosy', from_='/other')
    channel = sender_of(master, first, second)
    other = create(master, '/other').output_channel('/shared', Int32)
    wait_until_heard(other, first, second, choosy)
    channel.send(data=1)
    other.send(data=2)
    assert three.next().data == 2
    assert sorted(data(one, 2)) == [1, 2]
    assert three.empty()


def test_the_first_message_of_a_publisher_elsewhere_waits_for_no_connection_of_their_own(
    master, sharing
):
    (first, one), (second, two) = listen(sharing, '/first', '/second')
    sender = create(master, '/sender')
    sender.connect_timeout = 10 * TIMEOUT  # which the test would not wait for
    sender.send_to('/shared', data=1)
    assert one.next().data == two.next().data == 1


def test_nodes_of_other_masters_objects_have_connections_of_their_own(master, sharing):
    (first, one), (second, two) = listen(sharing, '/first', '/second')
    ((own, three),) = listen(master, '/own')
    channel = sender_of(master, first, second, own)
    assert len(channel.connections) == 2
    channel.send(data=1)
    assert one.next().data == two.next().data == three.next().data == 1


def test_the_first_message_waits_no_longer_than_for_one_who_shares_the_connection_late(
    master, sharing, monkeypatch, transcript
):
    (first, one), (second, two) = listen(sharing, '/first', '/second')
    really, connect, asked = first_message._may_connect, shared_connections.connect, []
    looked = threading.Event()

    def ask(channel, name):
        asked.append(name)
        answer = really(channel, name)
        looked.set()
        return answer

    def connect_late(node, *arguments):
        if node is second.latest_run.rospy:
            looked.wait(TIMEOUT)
        return connect(node, *arguments)

    monkeypatch.setattr(first_message, '_may_connect', ask)
    monkeypatch.setattr(shared_connections, 'connect', connect_late)
    sender = create(master, '/sender')
    sender.connect_timeout = 10 * TIMEOUT
    sender.latest_run.rospy.connections._neighbours = list  # as if they were of another process
    assert ended(in_thread(lambda: sender.send_to('/shared', typed_as=Int32, data=1)))
    assert set(asked) == {'/second'}
    assert one.next().data == two.next().data == 1


def test_what_an_inline_delegate_waits_for_ends_with_its_node_and_is_not_its_own_topic(
    master, sharing, mailbox
):
    """As where the node has a connection of its own."""

    def wait(message, channel):
        try:
            if message.data == 1:
                channel.node.wait_for_message('/shared', Int32)
            else:
                mailbox(threading.current_thread().name, None)
                channel.node.wait_for_message('/never', Int32)
        except BaseException as error:
            mailbox(error, None)

    ((waiting, _), (other, box)) = listen(sharing, '/waiting', '/other', inline=True)
    waiting.channels[0].delegate = wait
    channel = sender_of(master, waiting, other)
    channel.send(data=1)
    assert 'this delegate runs in the thread that brings' in str(mailbox.next())
    channel.send(data=2)
    assert mailbox.next() == '/waiting /shared'
    waiting.stop()
    assert isinstance(mailbox.next(), NodeStoppedError)
    channel.send(data=3)
    assert data(box, 3) == [1, 2, 3]


def test_rosnode_shows_it_at_each_node(master, sharing):
    (first, _), (second, _) = listen(sharing, '/first', '/second')
    sender_of(master, first, second)
    for name in '/first', '/second':
        said = programs.run(master.url, 'rosnode', 'info', name).stdout
        assert 'topic: /shared\n    * to: /sender' in said
        assert 'transport: TCPROS' in said


def test_a_message_that_could_not_be_sent_on_comes_all_the_same(master, sharing):
    """Deserializing makes of many nanoseconds more seconds than the wire takes."""
    listeners = listen(sharing, '/first', '/second', typed_as='std_msgs/Time')
    channel = sender_of(master, *(node for node, _ in listeners), typed_as='std_msgs/Time')
    latest = 2**32 - 1
    time = channel.message_class()
    time.data.secs = time.data.nsecs = latest
    channel.publish(time)
    channel.send(data={'secs': 1, 'nsecs': 0})
    for _, box in listeners:
        assert box.next().data.secs == latest + 4
        assert box.next().data.secs == 1
