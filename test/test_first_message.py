"""The first message on a topic waits for the subscribers that the master knows, whichever thread
sends it."""
import contextlib
import struct
import threading
import xmlrpc.server

import pytest
import rosgraph

from helpers import create, ended, in_thread
from pharos.testing import Mailbox, TIMEOUT, until
from pharos import BlockNode, NodeStoppedError, OutputChannel
from pharos.intraprocess.link import Link
from sockets import subscribe

STRING = 'std_msgs/String'


class LateSubscriber:
    """A subscriber elsewhere that the master knows, and that connects when the test lets it."""

    def __init__(self, master, topic, name='/late'):
        self._topic, self._name = topic, name
        self._rpc = xmlrpc.server.SimpleXMLRPCServer(('127.0.0.1', 0), logRequests=False)
        self._rpc.register_function(lambda *arguments: [1, '', 0], 'getPid')
        self._rpc.register_function(self._publisher_update, 'publisherUpdate')
        self.told = threading.Event()
        self._thread = threading.Thread(target=self._rpc.serve_forever, daemon=True)
        self._thread.start()
        self._master = rosgraph.Master(name, master_uri=master.url)
        self._uri = 'http://127.0.0.1:%d/' % self._rpc.server_address[1]
        self._master.registerSubscriber(topic, STRING, self._uri)

    def _publisher_update(self, caller_id, topic, publishers):
        self.told.set()
        return [1, '', 0]

    def connect(self, node):
        """Connect to the node; returns ``receive(count)``, the texts of the next messages."""
        sock = subscribe(node.tcp_port, self._topic, self._name)
        file = sock.makefile('rb')

        def sized():
            return file.read(*struct.unpack('<I', file.read(4)))

        sized()  # the connection header
        return lambda count: [sized()[4:].decode() for _ in range(count)]

    def close(self):
        self._master.unregisterSubscriber(self._topic, self._uri)
        self._rpc.shutdown()
        self._rpc.server_close()
        self._thread.join(TIMEOUT)


@pytest.mark.parametrize('opens', ['send_to', 'output_channel'])
def test_nothing_is_lost_of_what_several_threads_send_first(master, opens):
    """The channel of the first is known to the others before it is connected."""
    node = create(master, '/sender')
    node.connect_timeout = TIMEOUT
    with contextlib.closing(LateSubscriber(master, '/first/threads')) as late:

        def send(number):
            if opens == 'output_channel' and number == 0:
                node.output_channel('/first/threads', STRING).send(data='0')
            else:
                node.send_to('/first/threads', typed_as=STRING, data=str(number))

        threads = [in_thread(send, 0)]
        assert late.told.wait(TIMEOUT)  # the first has registered, and waits
        threads += [in_thread(send, number) for number in range(1, 10)]
        until(lambda: len(node.channels) == 1)
        receive = late.connect(node)
        assert sorted(receive(10)) == [str(number) for number in range(10)]
        for thread in threads:
            thread.join(TIMEOUT)
        assert len(node.channels) == 1


def test_threads_that_send_first_at_the_same_time_share_a_channel(master, mailbox):
    receiver, sender = create(master, '/receiver', delegate=mailbox), create(master, '/sender')
    for turn in range(5):
        topic, begun = f'/first/together{turn}', threading.Barrier(8)
        receiver.interested_in(topic, STRING)

        def send():
            begun.wait(TIMEOUT)
            sender.send_to(topic, typed_as=STRING, data='text')

        threads = [in_thread(send) for _ in range(8)]
        for thread in threads:
            thread.join(TIMEOUT)
        assert len(mailbox.take(8)) == 8
        assert len([channel for channel in sender.channels if channel.topic == topic]) == 1


def test_the_log_names_a_subscriber_that_did_not_connect_in_time_once(master):
    log = Mailbox()
    create(master, '/reader').interested_in('/rosout', 'rosgraph_msgs/Log', delegate=log)
    node = create(master, '/sender')
    node.connect_timeout = 0.6
    with contextlib.closing(LateSubscriber(master, '/first/late')):
        for _ in range(3):
            node.send_to('/first/late', typed_as=STRING, data='text')
        node.channels[0].close()
        node.send_to('/first/late', typed_as=STRING, data='text')
    node.log('the end')
    lines = []
    while 'the end' not in lines:
        lines.append(log.next().msg)
    told = [line for line in lines if 'did not connect' in line]
    assert len(told) == 1
    assert '/late' in told[0]
    assert '/first/late' in told[0]
    assert '0.6 s' in told[0]


def test_a_send_that_waits_for_another_threads_channel_ends_with_the_node(master):
    node = create(master, '/sender')
    node.connect_timeout = 10 * TIMEOUT
    with contextlib.closing(LateSubscriber(master, '/first/ending')) as late:
        errors = Mailbox()

        def send():
            try:
                node.send_to('/first/ending', typed_as=STRING, data='text')
            except Exception as error:
                errors(error, None)

        threads = [in_thread(send)]
        assert late.told.wait(TIMEOUT)
        threads += [in_thread(send) for _ in range(3)]
        node.stop()
        for thread in threads:
            thread.join(TIMEOUT)
            assert not thread.is_alive()


def test_a_send_that_comes_to_its_wait_right_after_the_stop_ends(master, monkeypatch):
    node = create(master, '/sender')
    node.connect_timeout = 10 * TIMEOUT
    wait = OutputChannel.wait_until_connected

    def stop_and_wait(*arguments):
        node.stop()
        wait(*arguments)

    monkeypatch.setattr(OutputChannel, 'wait_until_connected', stop_and_wait)

    def send():
        with pytest.raises(NodeStoppedError):
            node.send_to('/first/ended', typed_as=STRING, data='text')

    assert ended(in_thread(send))


def test_a_first_message_may_wait_without_limit_for_its_type(master):
    node = master.create(BlockNode, named='/sender', domain='127.0.0.1')
    node.send_to('/first/unlimited', typed_as='std_msgs/String', wait=float('inf'), data='sent')
    assert [channel.sent for channel in node.channels] == [1]


def test_who_waits_for_a_subscriber_waits_until_messages_go_to_it(master, mailbox, monkeypatch):
    """A connection that counts, and gets nothing yet, would lose the first message."""
    sent = create(master, '/sender').output_channel('/first/counts', STRING)
    receiver = create(master, '/receiver', delegate=mailbox)
    reached, allowed = threading.Event(), threading.Event()
    match = Link.match_receivers

    def match_late(link):
        reached.set()
        allowed.wait(TIMEOUT)
        return match(link)

    monkeypatch.setattr(Link, 'match_receivers', match_late)
    opening = in_thread(receiver.interested_in, '/first/counts', STRING)
    assert reached.wait(TIMEOUT)
    assert sent.connections == []
    assert not sent.wait_for_subscribers(1, 0)
    allowed.set()
    assert sent.wait_for_subscribers(1, TIMEOUT)
    sent.send(data='first')
    assert mailbox.next().data == 'first'
    opening.join(TIMEOUT)


def test_a_delegate_that_sends_while_its_node_starts_again_opens_no_second_channel(master):
    node, mailbox = create(master, '/relay'), Mailbox()
    create(master, '/end').interested_in('/first/again', STRING, delegate=mailbox)
    before = node.interested_in('/first/before', STRING)
    node.output_channel('/first/again', STRING, latch=True)
    open_again = before.open
    before.open = lambda run: (open_again(run), node.send_to('/first/again', data='early'))
    for _ in range(3):
        node.stop()
        node.start()
        assert len(node.channels) == 2
    assert mailbox.next().data == 'early'
