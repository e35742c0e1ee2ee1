"""What ends or silences a rospy node does not end or silence this one."""
import http.server
import subprocess
import sys
import threading
import xmlrpc.server

import pytest

from helpers import create, registrations
from pharos.testing import Mailbox, TIMEOUT, until
import pharos
from pharos import Master
from pharos.private_rospy import registration


# -- the master restarts


def test_everything_is_registered_again_when_the_master_comes_back_empty(mortal_master, mailbox):
    """With rospy, the node is never registered again: rosnode list lacked it 20 s later, and
    nothing in rospy tries."""
    master = Master(mortal_master.url)
    receiver = create(master, '/receiver', delegate=mailbox, argv=['_private:=7'])
    receiver.interested_in('/t', 'std_msgs/String')
    receiver.serve('/service', 'std_srvs/Empty', lambda request: None)
    changes = Mailbox()
    receiver.parameter('~watched', 1).on_change(lambda value: changes(value, None))
    sender = create(master, '/sender')
    sent = sender.output_channel('/t', 'std_msgs/String')
    before = [registrations(master, name) for name in ('/receiver', '/sender')]
    mortal_master.end()
    sent.send(data='while the master is away')
    assert mailbox.next().data == 'while the master is away'
    mortal_master.come_back()
    until(lambda: [registrations(master, name) for name in ('/receiver', '/sender')] == before)
    until(lambda: '/receiver/private' in master.parameters)
    assert master.parameters['/receiver/private'] == 7
    late = create(master, '/late')
    late.send_to('/t', data='from a new peer')
    sent.send(data='from the old one')
    assert {message.data for message in mailbox.take(2)} == {
        'from a new peer',
        'from the old one',
    }
    assert mailbox.empty()
    master.lookup_service('/service').call(timeout=TIMEOUT)
    master.parameters['/receiver/watched'] = 2
    assert changes.next() == 2


def test_a_node_stops_while_the_master_is_away(mortal_master):
    node = create(Master(mortal_master.url), '/node')
    node.interested_in('/t', 'std_msgs/String')
    mortal_master.end()
    node.stop()
    assert node.lifecycle.value == 'stopped'


def test_there_is_one_watcher_per_master_and_none_without_a_node(master):
    watching = f'watcher of {master.url}'

    def watchers():
        return [thread.name for thread in threading.enumerate()].count(watching)

    nodes = [create(master, '/n%d' % i) for i in range(3)]
    assert watchers() == 1
    for node in nodes:
        node.stop()
    until(lambda: watchers() == 0)


# -- peers that die

PEER = """
import rospy, std_msgs.msg
rospy.init_node('peer')
rospy.Subscriber('/to_peer', std_msgs.msg.String, lambda message: None)
publisher = rospy.Publisher('/from_peer', std_msgs.msg.String, latch=True, queue_size=1)
publisher.publish('hello')
rospy.spin()
"""


def test_a_peer_killed_outright_is_let_go_and_found_again(master, mailbox):
    node = create(master, '/node', delegate=mailbox)
    heard = node.interested_in('/from_peer', 'std_msgs/String')
    told = node.output_channel('/to_peer', 'std_msgs/String')
    for _ in range(2):
        with subprocess.Popen([sys.executable, '-c', PEER]) as peer:
            assert mailbox.next().data == 'hello'
            assert told.wait_for_subscribers(1, TIMEOUT)
            peer.kill()
        until(lambda: not heard.connections and not told.connections)
        told.send(data='into the void')
    # whose name it is from now on: nothing of the killed one stays with the master
    create(master, '/peer')


# -- stop at any moment


def test_two_threads_may_stop_a_node_at_once(master):
    for round_ in range(10):
        node = create(master, '/node')
        threads = [threading.Thread(target=node.stop) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(TIMEOUT)
        assert node.lifecycle.value == 'stopped'
        assert not any(registrations(master, '/node'))


def test_a_node_stops_while_it_publishes_receives_and_calls(master):
    server = create(master, '/server')
    server.serve('/echo', 'std_srvs/SetBool', lambda request: {'success': request.data})
    for _ in range(5):
        node = create(master, '/node')
        busy = threading.Event()
        service = master.lookup_service('/echo')
        channel = node.output_channel('/t', 'std_msgs/String')

        def work(me):
            while True:
                channel.send(data='x' * 1000)
                service.call(data=True)
                busy.set()
                me.sleep(0)

        node.interested_in('/t', delegate=lambda message, channel: service.call(data=True))
        node.fork(work)
        assert busy.wait(TIMEOUT)
        node.stop()
        assert not [
            error for error in node.errors if not isinstance(error, pharos.NodeStoppedError)
        ]


# -- peers that answer nonsense


def test_a_publisher_that_once_answers_nonsense_is_asked_again(master, monkeypatch):
    monkeypatch.setattr(registration, 'RETRY_DELAY', 0.1)
    codes = Mailbox()
    node = create(master, '/node')
    node.interested_in('/survival/nonsense', 'std_msgs/String', delegate=Mailbox())
    handler = node.latest_run.rospy.lifetime.xmlrpc.handler
    asked, proceed = threading.Semaphore(0), threading.Event()

    def request_topic(caller_id, topic, protocols):
        asked.release()
        proceed.wait(TIMEOUT)
        return 1, 'a dict is no protocol', {'protocol': 'TCPROS'}

    with xmlrpc.server.SimpleXMLRPCServer(('127.0.0.1', 0), logRequests=False) as publisher:
        publisher.register_function(request_topic, 'requestTopic')
        threading.Thread(target=publisher.serve_forever, daemon=True).start()
        uri = 'http://127.0.0.1:%d/' % publisher.server_address[1]

        def connect():
            codes(handler._connect_topic('/survival/nonsense', uri)[0], None)

        first = threading.Thread(target=connect, daemon=True)
        first.start()
        assert asked.acquire(timeout=TIMEOUT)
        assert handler._connect_topic('/survival/nonsense', uri)[0] == 1  # it is being asked
        proceed.set()
        first.join(TIMEOUT)
        connect()
        assert codes.take(2) == [0, 0]
        assert asked.acquire(timeout=TIMEOUT)
        publisher.shutdown()


def test_a_name_whose_dead_node_left_its_port_to_another_server_is_refused_with_advice(master):
    with http.server.HTTPServer(('127.0.0.1', 0), http.server.SimpleHTTPRequestHandler) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        uri = 'http://127.0.0.1:%d/' % other.server_address[1]
        left_behind = master.api('/left_behind')
        left_behind.registerPublisher('/survival/left', 'std_msgs/String', uri)
        try:
            with pytest.raises(pharos.NodeNameInUseError, match='rosnode cleanup'):
                create(master, '/left_behind')
        finally:
            left_behind.unregisterPublisher('/survival/left', uri)
            other.shutdown()
