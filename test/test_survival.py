"""Causes that end or silence a rospy node do not end or silence these nodes: doc/limits.md."""
import collections
import concurrent.futures
import contextlib
import errno
import itertools
import os
import re
import signal
import socket
import struct
import sys
import threading
import time
import xmlrpc.client
import xmlrpc.server

import geometry_msgs.msg
import psutil
import pytest
import rosgraph
import rosnode
import std_msgs.msg
import std_srvs.srv
from rosgraph.network import encode_ros_handshake_header

import pharos
from helpers import PYTHON, ROOT, TIMEOUT, Peer, PharosPeer, Program, create, registrations
from pharos import BlockNode, Master
from pharos.private_rospy import connections
from pharos.testing import Mailbox, until
from programs.raw_tcpros import (
    FakeNode,
    connect,
    is_without_delay,
    leave,
    receive,
    string_message,
    subscribe,
    text,
)

STRING = 'std_msgs/String'
LOG = 'rosgraph_msgs/Log'
LARGE = 'x' * 1_000_000


@pytest.fixture
def node(master):
    return create(master)


def sockets_of(port):
    """Return duplicates of this process's connected sockets whose own port this is."""
    return [
        socket.socket(fileno=os.dup(found.fd))
        for found in psutil.Process().connections('tcp4')
        if found.laddr.port == port and found.status == psutil.CONN_ESTABLISHED
    ]


def listening():
    """Return the addresses, with ports, on which this process listens."""
    found = psutil.Process().connections('tcp')
    return {tuple(each.laddr) for each in found if each.status == psutil.CONN_LISTEN}


def is_closed(sock):
    """Wait until the other side closes the connection."""
    sock.settimeout(TIMEOUT)
    with contextlib.suppress(ConnectionResetError):
        while sock.recv(1 << 16):
            pass
    return True


def publish_from(peer, topic):
    """Have the peer get a `publisher` of a topic, and wait until a node hears it."""
    string = 'message_class("std_msgs/String")'
    peer.run(f'publisher = rospy.Publisher({topic!r}, {string}, queue_size=100)')
    until(lambda: peer.value('publisher.get_num_connections()'))


class LogOf:
    """The log of a node that runs, as /rosout has it."""

    def __init__(self, master, node):
        self._mailbox, self._node = Mailbox(create(master, '/log_reader'), '/rosout', LOG), node
        until(lambda: node.name in dict(self._mailbox.channel.connections))

    def warnings(self, marker):
        """Return the warnings and errors up to a line with the marker."""
        found = []
        while True:
            line = self._mailbox.next()
            if line.name == self._node.name and line.level > line.INFO:
                found.append(line.msg)
            if marker in line.msg:
                return found


# -- the 21 pains, in the table's order


def test_second_node_and_second_start(master):
    first = create(master, '/first')
    create(master, '/second')
    assert {'/first', '/second'} <= {node.name for node in master.nodes()}
    ports = first.tcp_port, first.xmlrpc_port
    first.stop()
    first.start()
    assert (first.tcp_port, first.xmlrpc_port) == ports
    assert rosnode.rosnode_ping('/first', max_count=1)


def test_stopped_node_uses_no_core(master):
    create(master).stop()
    begin = time.process_time()
    threading.Event().wait(0.5)
    assert time.process_time() - begin < 0.25


def test_ports_are_free_after_stop(master):
    node = create(master)
    node.stop()
    for port in node.tcp_port, node.xmlrpc_port:
        socket.create_server(('127.0.0.1', port)).close()
    assert registrations(master, '/node') == [[], [], []]


@pytest.fixture
def host(master):
    """A node that publishes and serves, for clients to misbehave at."""

    class Patient(BlockNode):
        client_timeout = TIMEOUT

    node = create(master, '/host', Patient)
    node.output_channel('/out', STRING, latch=True).send(data='hello')
    node.serve('/set', 'std_srvs/SetBool', lambda request: {'success': request.data})
    return node


def assert_served(node):
    """Assert that the node answers a call, and that a new subscriber gets its message."""
    with xmlrpc.client.ServerProxy(node.uri) as proxy:
        assert proxy.getPid('/test')[0] == 1
    with subscribe(node.tcp_port, '/out') as client:
        receive(client)
        assert text(receive(client)) == 'hello'


def test_silent_clients_keep_nobody_out(host, peer):
    """Half of the 100 at each port say nothing at all; the others begin, and do not go on."""
    beginnings = {host.tcp_port: struct.pack('<I', 1000), host.xmlrpc_port: b'POST / HTTP/1.1'}
    with contextlib.ExitStack() as clients:
        for number in range(100):
            for port, beginning in beginnings.items():
                client = clients.enter_context(connect(port))
                client.sendall(beginning if number % 2 else b'')
        peer.hear('/out', STRING)
        assert peer.heard('/out')[0].data == 'hello'
        peer.run('from std_srvs.srv import SetBool; rospy.wait_for_service("/set", 20)')
        assert peer.value('rospy.ServiceProxy("/set", SetBool)(True).success')
        assert_served(host)


@pytest.mark.parametrize('which', ['tcp_port', 'xmlrpc_port'])
def test_busy_port_is_named(master, which):
    with socket.create_server(('127.0.0.1', 0)) as busy:
        port = busy.getsockname()[1]
        with pytest.raises(pharos.PortInUseError, match=str(port)):
            create(master, **{which: port})
    assert registrations(master, '/node') == [[], [], []]
    assert create(master, **{which: port}).is_running


def test_shutdown_for_earlier_owner_is_refused(master):
    node = create(master)
    with xmlrpc.client.ServerProxy(node.uri) as proxy:
        proxy.shutdown('/master', '[/old] Reason: new node registered with same name')
        assert proxy.getPid('/test')[0] == 1
    assert node.is_running


def test_restarted_master_knows_all_again(mortal):
    master = Master(mortal.url)
    heard, changes = Mailbox(), Mailbox()
    receiver = create(master, '/receiver', delegate=heard, argv=['_private:=7', '_other:=7'])
    receiver.interested_in('/t', STRING)
    receiver.serve('/service', 'std_srvs/Empty', lambda request: None)
    receiver.parameter('~watched', 1).on_change(lambda value: changes(value, None))
    other = receiver.parameter('~other')
    other.set(3)
    sent = create(master, '/sender').output_channel('/t', STRING)
    before = [registrations(master, name) for name in ('/receiver', '/sender')]
    mortal.end()
    sent.send(data='while it is away')
    assert heard.next().data == 'while it is away'
    mortal.come_back()
    until(lambda: [registrations(master, name) for name in ('/receiver', '/sender')] == before)
    until(lambda: master.parameters.get('/receiver/private') == 7)
    create(master, '/late').send_to('/t', data='from a new node')
    sent.send(data='from the old one')
    assert {heard.next().data, heard.next().data} == {'from a new node', 'from the old one'}
    assert len(heard.all()) == 3
    master.lookup_service('/service').call(timeout=TIMEOUT)
    master.parameters['/receiver/watched'] = 2
    assert changes.wait_for(lambda value: value == 2) and other.value == 3


def test_first_message_arrives(master, peer):
    node = create(master)
    for number in range(3):
        peer.hear(f'/first{number}', STRING)
        node.output_channel(f'/first{number}', STRING).send(data='first')
        node.send_to(f'/first{number}', data='second')
        assert [each.data for each in peer.heard(f'/first{number}', 2)] == ['first', 'second']


def test_slow_receiver_gets_newest_next(master, peer):
    began, go_on = Mailbox(), threading.Semaphore(0)

    def look(message, channel):
        began(message, channel)
        go_on.acquire(timeout=TIMEOUT)

    channel = create(master).interested_in('/image', STRING, delegate=look, queue_size=1)
    publish_from(peer, '/image')
    peer.run('publisher.publish("first")')
    assert began.next().data == 'first'
    peer.run('for number in range(1, 40): publisher.publish(f"{number:02}" + "x" * 100000)')
    until(lambda: channel.dropped == 38)
    for _ in range(40):
        go_on.release()
    assert began.next().data[:2] == '39'


def test_small_messages_go_without_delay(master, peer):
    """A subscriber that asks for Nagle's algorithm, and a publisher of rospy's, which has it on."""
    node = create(master)
    channel = node.output_channel('/small', STRING)
    with subscribe(node.tcp_port, '/small') as client:
        receive(client)
        until(lambda: channel.connections)
        (connection,) = sockets_of(node.tcp_port)
        with connection:
            assert is_without_delay(connection)
    node.interested_in('/asked', STRING)
    publish_from(peer, '/asked')
    sock = 'publisher.impl.connections[0].socket'
    assert peer.value(f'{sock}.getsockopt({socket.IPPROTO_TCP}, {socket.TCP_NODELAY})')


def test_latched_message_stays_as_sent(master):
    channel = create(master).output_channel('/latched', 'geometry_msgs/Twist', latch=True)
    message = geometry_msgs.msg.Twist()
    channel.publish(message)
    message.linear.x = 7.0
    assert Mailbox(create(master, '/late'), '/latched').next().linear.x == 0.0


def test_each_latched_channel_keeps_its_message(master):
    node = create(master)
    for data in 'first', 'second':
        node.output_channel('/latches', STRING, latch=True).send(data=data)
    late = Mailbox(create(master, '/late'), '/latches')
    assert [late.next().data, late.next().data] == ['first', 'second']


def test_subscriber_that_left_is_known(master):
    node = create(master)
    channel = node.output_channel('/leaving', STRING)
    for number in range(10):
        with subscribe(node.tcp_port, '/leaving', f'/raw{number}') as client:
            assert channel.wait_for_subscribers(1, TIMEOUT)
            assert channel.connections == [(f'/raw{number}', 'TCPROS')]
            channel.send(data=str(number))
            receive(client)
            assert text(receive(client)) == str(number)
            leave(client, until)
        assert channel.connections == []
        assert not channel.wait_for_subscribers(1, 0)


def test_service_call_has_a_timeout(master):
    with socket.create_server(('127.0.0.1', 0)) as silent:
        address = f'rosrpc://127.0.0.1:{silent.getsockname()[1]}'
        api = rosgraph.Master('/silent', master_uri=master.url)
        api.registerService('/silent/set', address, 'http://127.0.0.1:1/')
        try:
            service = master.lookup_service('/silent/set')
            with pytest.raises(pharos.ServiceCallError, match='/silent/set'):
                service.call(timeout=0.1)
        finally:
            api.unregisterService('/silent/set', address)


def test_link_comes_back_after_a_loss(master):
    """The publisher's port refuses for a while, and nobody tells the node when it does not."""
    with FakeNode(master, '/lossy').publish_here() as publisher:
        heard = Mailbox(create(master), '/lossy', STRING)
        with publisher.accept() as connection:
            connection.sendall(string_message('before'))
            assert heard.next().data == 'before'
            publisher.move()
        for _ in range(3):  # one for the first connection, one that is refused, and the next
            assert publisher.asked.acquire(timeout=TIMEOUT)
        with publisher.accept() as connection:
            connection.sendall(string_message('after'))
            assert heard.next().data == 'after'


def assert_silence_ends(port):
    """The kernel probes a silent connection of this process, and breaks it within 30 s."""
    (connection,) = sockets_of(port)
    with connection:
        assert connection.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        idle, interval, count = (
            connection.getsockopt(socket.IPPROTO_TCP, option)
            for option in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
        )
        assert idle + interval * count <= 30


def test_silent_loss_is_noticed_soon(master, node):
    channel = node.output_channel('/quiet', STRING)
    with subscribe(node.tcp_port, '/quiet') as client:
        receive(client)
        until(lambda: channel.connections)
        assert_silence_ends(node.tcp_port)


def test_silent_loss_of_a_publisher_is_noticed_soon(master, node):
    heard = Mailbox(node, '/quiet', STRING)
    with FakeNode(master, '/quiet').publish_here() as publisher, publisher.accept() as connection:
        connection.sendall(string_message('the last one'))
        assert heard.next()
        assert_silence_ends(connection.getpeername()[1])


def test_stuck_subscriber_starves_nobody(master):
    node = create(master)
    channel = node.output_channel('/stuck', STRING, queue_size=20)
    port = node.tcp_port
    with subscribe(port, '/stuck', '/stuck'), subscribe(port, '/stuck', '/reader') as reader:
        assert channel.wait_for_subscribers(2, TIMEOUT)
        for number in range(20):
            channel.send(data=f'{number:02}{LARGE}')
        receive(reader)
        assert [int(text(receive(reader))[:2]) for _ in range(20)] == list(range(20))


@pytest.mark.filterwarnings('ignore:The publisher should be created:SyntaxWarning')
def test_stop_ends_publisher_that_waits_for_subscriber(master):
    """Without a queue_size, rospy's publish() waits for the socket."""
    node = create(master)
    publisher = node.ros.Publisher('/stuck', std_msgs.msg.String)
    with subscribe(node.tcp_port, '/stuck') as client:
        receive(client)
        until(publisher.get_num_connections)
        sender = threading.Thread(target=publisher.publish, args=[30 * LARGE])
        sender.start()
        client.recv(1)  # the rest of the message does not fit into the sockets
        node.stop()
        sender.join(TIMEOUT)
    assert not sender.is_alive()


def test_delegates_run_one_at_a_time(master, peer):
    """One message comes through INTRAPROCESS, the other through TCPROS."""
    began, go_on = Mailbox(), threading.Event()

    def delegate(message, channel):
        began(message, channel)
        if message.data == 'wait':
            go_on.wait(TIMEOUT)

    node = create(master, '/careful', delegate=delegate)
    node.interested_in('/left', STRING)
    right = node.interested_in('/right', STRING, queue_size=1)
    create(master, '/sender').send_to('/left', typed_as=STRING, data='wait')
    assert began.next().data == 'wait'
    publish_from(peer, '/right')
    peer.run('publisher.publish("dropped"); publisher.publish("kept")')
    until(lambda: right.dropped == 1)
    assert len(began.all()) == 1
    go_on.set()
    assert began.next().data == 'kept'


def test_publishing_takes_one_step(master, peer):
    peer.hear('/speed', 'geometry_msgs/Point')
    create(master).send_to('/speed', x=2.0)
    assert peer.heard('/speed')[0].x == 2.0


def test_subscription_needs_no_type(master):
    """The type is on no disk: it comes from the publisher."""
    with FakeNode(master, '/unknown', 'nowhere_msgs/Thing').publish_here() as publisher:
        with publisher.sending('found'):
            heard = Mailbox(create(master), '/unknown')
            assert heard.next().data == 'found'
        assert heard.channel.type == 'nowhere_msgs/Thing'


def test_loopback_domain_listens_there_alone(master):
    before = listening()
    node = create(master, domain='127.0.0.2')
    ports = {('127.0.0.2', node.tcp_port), ('127.0.0.2', node.xmlrpc_port)}
    assert listening() - before == ports


def test_failed_delegate_is_told(master, transcript):
    def fail(message, channel):
        raise ValueError(f'bad {message.data}')

    node = create(master, delegate=fail)
    log = LogOf(master, node)
    node.interested_in('/raising', STRING)
    create(master, '/sender').send_to('/raising', data='luck')
    until(lambda: node.errors)
    assert str(node.errors[-1]) == 'bad luck'
    assert 'bad luck' in ''.join(log.warnings('bad luck'))
    until(lambda: 'bad luck' in ''.join(transcript))


# -- the master


def test_link_to_rospy_survives_the_master(mortal):
    """Nothing comes twice, though the node and its peer are registered at another master now."""
    master = Master(mortal.url)
    heard = Mailbox(create(master), '/chat', STRING)
    with Peer(mortal.url) as peer:
        publish_from(peer, '/chat')
        peer.run('publisher.publish("before")')
        mortal.end()
        peer.run('publisher.publish("meanwhile")')
        mortal.come_back()
        until(lambda: '/chat' in registrations(master, '/node')[1])
        peer.run('publisher.publish("after")')
        assert heard.wait_for(lambda message: message.data == 'after')
        assert [message.data for message in heard.all()] == ['before', 'meanwhile', 'after']


def test_nodes_of_a_process_connect_without_the_master(mortal):
    heard = Mailbox(create(mortal.master, '/ear'), '/plain', STRING)
    node = create(mortal.master)
    mortal.end()
    node.ros.Publisher('/plain', std_msgs.msg.String, queue_size=5).publish('hello')
    assert heard.next().data == 'hello'


def test_forgotten_subscriber_hears_new_publishers(master, node, peer):
    """A new master may know the publisher first."""
    heard = Mailbox(node, '/words', STRING)
    rosgraph.Master('/node', master.url).unregisterSubscriber('/words', node.uri)
    peer.run("out = rospy.Publisher('/words', message_class('std_msgs/String'), latch=True)")
    peer.run("out.publish('hello')")
    assert heard.next().data == 'hello'


def test_plain_rospy_is_registered_later(mortal):
    master = Master(mortal.url)
    node, heard = create(master), Mailbox()
    mortal.end()
    node.ros.Subscriber('/plain', std_msgs.msg.String, lambda message: heard(message, None))
    publisher = node.ros.Publisher('/plain', std_msgs.msg.String, queue_size=5)
    node.ros.Service('/plain_service', std_srvs.srv.Empty, lambda request: None)
    mortal.come_back()
    until(publisher.get_num_connections)
    publisher.publish('found')
    assert heard.next().data == 'found'
    until(lambda: '/plain_service' in registrations(master, '/node')[2])


OPENERS = {
    'interested_in': lambda node: node.interested_in('/opened', STRING),
    'output_channel': lambda node: node.output_channel('/opened', STRING),
    'send_to': lambda node: node.send_to('/opened', typed_as=STRING, data='x'),
    'serve': lambda node: node.serve('/opened', 'std_srvs/Empty', lambda request: None),
    'parameter': lambda node: node.parameter('/opened', 5),
    'lookup_service': lambda node: node.lookup_service('/opened'),
}


def test_killed_master_is_unreachable_and_harmless(mortal):
    """A channel that cannot be opened raises, and is not there later; a closed one is gone later."""
    master = Master(mortal.url)
    node = create(master)
    before = registrations(master, '/node')
    closed = node.interested_in('/closed', STRING)
    mortal.end()
    for opener in OPENERS.values():
        with pytest.raises(pharos.MasterUnreachableError):
            opener(node)
    closed.close()
    mortal.come_back()
    until(lambda: registrations(master, '/node') == before)
    assert node.channels == []


def test_node_stops_without_its_master(mortal):
    node = create(Master(mortal.url))
    node.interested_in('/t', STRING)
    mortal.end()
    node.stop()
    assert not node.is_running


@contextlib.contextmanager
def stopped(pid):
    """Have a process hang meanwhile."""
    os.kill(pid, signal.SIGSTOP)
    until(lambda: psutil.Process(pid).status() == psutil.STATUS_STOPPED)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def test_hanging_master_ends_no_wait(mortal):
    """Each question ends with an error in its own time, and a node stops."""
    master = Master(mortal.url)
    node, other = create(master), create(master, '/other')
    other.interested_in('/t', STRING)
    node.connect_timeout = 0.5
    with stopped(mortal.pid):
        asks = [
            master.system_state,
            lambda: master.parameters['/x'],
            lambda: node.lookup_service('/x'),
            lambda: create(Master(mortal.url), '/third'),
        ]
        with concurrent.futures.ThreadPoolExecutor() as pool:
            asked = [pool.submit(ask) for ask in asks]
            other.stop()
            assert not other.is_running
            for ask in asked:
                assert isinstance(ask.exception(TIMEOUT), pharos.MasterUnreachableError)
    node.send_to('/goes_on', typed_as=STRING, data='x')


def test_silent_master_is_told_in_one_line(mortal, capfd):
    """A node that stops meanwhile cannot unregister."""
    node = create(Master(mortal.url))
    node.interested_in('/t', STRING)
    capfd.readouterr()
    with stopped(mortal.pid):
        node.stop()
    (line,) = ''.join(capfd.readouterr()).splitlines()
    assert mortal.url in line


def test_master_that_goes_away_is_told_and_keeps_its_nodes(mortal):
    node = create(mortal.master)
    log = Mailbox(node, '/rosout', 'rosgraph_msgs/Log')
    mortal.end()
    with pytest.raises(pharos.MasterUnreachableError):
        node.restart()
    assert node.is_running
    log.wait_for(lambda line: 'no master answers at' in line.msg)


def test_stop_at_a_hanging_master_closes_connections(mortal):
    node, other = create(mortal.master), create(mortal.master, '/other')
    channel = node.interested_in('/words', STRING)
    other.output_channel('/words', STRING)
    until(lambda: channel.connections)
    os.kill(mortal.pid, signal.SIGSTOP)
    other.stop()
    os.kill(mortal.pid, signal.SIGCONT)
    assert not channel.connections


# -- peers that die


def test_killed_peer_is_found_again(master):
    heard, node = Mailbox(), create(master, '/node', delegate=Mailbox())
    channel = node.interested_in('/from_peer', STRING, delegate=heard)
    told = node.output_channel('/to_peer', STRING)
    service = None
    for _ in range(2):
        peer = Peer(master.url)
        peer.run(
            'from std_srvs.srv import Empty, Trigger\n'
            'def hang(request): called.append(1); rospy.sleep(3600)\n'
            'called, string = [], message_class("std_msgs/String")\n'
            'hanging = rospy.Service("/hang", Empty, hang)\n'
            'quick = rospy.Service("/quick", Trigger, lambda request: (True, "here"))\n'
            'publisher = rospy.Publisher("/from_peer", string, latch=True, queue_size=1)\n'
            'publisher.publish("hello"); subscriber = rospy.Subscriber("/to_peer", string)'
        )
        assert heard.next().data == 'hello'
        assert told.wait_for_subscribers(1, TIMEOUT)
        service = service or master.lookup_service('/quick')
        assert service.call(timeout=TIMEOUT).message == 'here'
        with concurrent.futures.ThreadPoolExecutor() as pool:
            call = pool.submit(master.lookup_service('/hang').call)
            until(lambda: peer.value('called'))
            peer.end()
            assert isinstance(call.exception(TIMEOUT), pharos.ServiceCallError)
        until(lambda: not channel.connections and not told.connections)
        told.send(data='into the void')
        with pytest.raises(pharos.PharosError):
            service.call(timeout=TIMEOUT)
    create(master, '/peer')  # it takes the name, so that nothing of the killed one stays


def test_refused_connection_is_tried_again(node, peer):
    handler = node._current_run.ros_handler
    connect = handler._connect_topic
    answers = [(0, 'not now', 0)]
    handler._connect_topic = lambda *names: answers.pop() if answers else connect(*names)
    box = Mailbox(node, '/words', STRING)
    peer.run("out = rospy.Publisher('/words', message_class('std_msgs/String'), latch=True)")
    peer.run("out.publish('x')")
    assert box.next().data == 'x' and not answers


def test_publisher_that_has_left_is_not_connected_again(node, monkeypatch, peer):
    attempts = []
    peer.run("out = rospy.Publisher('/words', message_class('std_msgs/String'), queue_size=1)")
    channel = node.interested_in('/words', STRING)
    until(lambda: channel.connections)
    start = 'pharos.private_rospy.connections._start_connecting'
    monkeypatch.setattr(start, lambda *arguments: attempts.append(arguments))
    peer.run('out.unregister()')
    subscription = node._current_run.topic_manager.subs['/words']
    until(lambda: subscription.retries)
    until(lambda: not subscription.retries)
    assert not attempts


# -- clients that misbehave

FOUR_GIB = struct.pack('<I', 0xFFFFFFFF)
NONSENSE = {
    'tcp_port': {
        'announced 4 GiB': FOUR_GIB,
        'HTTP': b'GET / HTTP/1.0\r\n\r\n',
        'no fields': struct.pack('<I', 0),
        'no equals sign': struct.pack('<II', 7, 3) + b'abc',
        'length of a field': struct.pack('<II', 8, 1000) + b'abcd',
        'other topic': encode_ros_handshake_header(
            {'callerid': '/bad', 'topic': '/other', 'type': '*', 'md5sum': '*'}
        ),
        'other type': encode_ros_handshake_header(
            {'callerid': '/bad', 'topic': '/out', 'type': 'a/B', 'md5sum': '0' * 32}
        ),
        'ends at once': b'',
        'ends early': struct.pack('<I', 100) + b'abc',
    },
    'xmlrpc_port': {
        'no HTTP': b'\0\1\2\3\r\n\r\n',
        'no XML': b'POST / HTTP/1.0\r\nContent-Length: 3\r\n\r\nabc',
        'announced 4 GiB': b'POST / HTTP/1.0\r\nContent-Length: 4294967295\r\n\r\nabc',
        'no length': b'POST / HTTP/1.0\r\n\r\n',
        'no number': b'POST / HTTP/1.0\r\nContent-Length: many\r\n\r\n',
        'ends early': b'POST / HTTP/1.0\r\nContent-Length: 30\r\n\r\nabc',
    },
}


@pytest.mark.parametrize('which', NONSENSE)
def test_nonsense_closes_its_client_alone(host, which):
    for kind, nonsense in NONSENSE[which].items():
        with connect(getattr(host, which)) as client:
            with contextlib.suppress(OSError):
                client.sendall(nonsense)
                client.shutdown(socket.SHUT_WR)
            assert is_closed(client), kind
    assert_served(host)


@pytest.mark.parametrize('kind', ['announced 4 GiB', 'HTTP', 'other type'])
def test_nonsense_is_logged_in_one_line(master, host, kind):
    log = LogOf(master, host)
    with connect(host.tcp_port) as client:
        client.sendall(NONSENSE['tcp_port'][kind])
        assert is_closed(client)
    lines = log.warnings('/bad' if kind == 'other type' else 'nbound TCP')
    host.log('the end', level='warning')
    assert log.warnings('the end') == ['the end']
    assert len(lines) == 1


@pytest.mark.parametrize('beginning', ['', 'a byte at a time'])
@pytest.mark.parametrize('which', ['tcp_port', 'xmlrpc_port'])
def test_slow_client_is_closed(master, which, beginning):
    class Host(BlockNode):
        client_timeout = 0.5

    host = create(master, '/host', Host)
    host.output_channel('/out', STRING, latch=True).send(data='hello')
    said = {'tcp_port': struct.pack('<I', 100000), 'xmlrpc_port': b'POST / HTTP/1.1\r\n'}[which]
    pause = threading.Event()
    with connect(getattr(host, which)) as client:
        if beginning:
            with contextlib.suppress(OSError):
                for byte in said + b'x' * 5000:
                    client.sendall(bytes([byte]))
                    pause.wait(0.01)
                pytest.fail('it listens for ever')
        assert is_closed(client)
    assert_served(host)


def test_lying_publisher_is_tried_again(master, node):
    log = LogOf(master, node)
    with FakeNode(master, '/huge').publish_here() as publisher:
        heard = Mailbox(node, '/huge', STRING)
        with publisher.accept() as connection:
            connection.sendall(FOUR_GIB)
            assert is_closed(connection)
            assert '/huge: no connection to' in log.warnings('4294967295 bytes')[0]
        with publisher.accept() as connection:
            connection.sendall(string_message('small'))
            assert heard.next().data == 'small'


# -- the first message, and subscribers that cannot take it


ASKED_WITHIN = 1.5  # seconds; a node that has not connected by then was asked about it


def test_hanging_subscriber_is_named_in_log(master, peer):
    """A send to a subscriber that hangs returns, and a warning says who did not connect."""
    peer.hear('/first', STRING)
    node = create(master)
    node.connect_timeout = ASKED_WITHIN
    log = LogOf(master, node)
    with stopped(peer.pid):
        node.send_to('/first', typed_as=STRING, data='x')
        node.log('the end', level='warning')
        assert '/peer' in ''.join(log.warnings('the end'))


def test_nonsense_about_connections_breaks_no_send(master):
    """Subscribers that do not connect answer getBusInfo with nonsense."""
    answers = [[0, 0, 0, 0]], [0, 0, 0, 0], [[]], 'nonsense', 5, {'a': 1}, [[1, 2, 3, 4, 5]]
    with contextlib.ExitStack() as fakes:
        for number, info in enumerate(answers):
            fake = FakeNode(master, '/first', bus_info=info, name=f'/fake{number}')
            fakes.enter_context(fake).hear_here()
        node = create(master)
        node.connect_timeout = ASKED_WITHIN
        assert node.send_to('/first', typed_as=STRING, data='x').data == 'x'
        assert not node.errors


def test_dead_subscriber_is_not_waited_for(master):
    """Its port refuses connections, as that of a node that was killed."""
    with FakeNode(master, '/first').hear_here() as dead:
        dead.stop_answering()
        node = create(master)
        node.connect_timeout = 10 * TIMEOUT
        fields = {'typed_as': STRING, 'data': 'x'}
        send = threading.Thread(target=node.send_to, args=('/first',), kwargs=fields, daemon=True)
        send.start()
        send.join(TIMEOUT)
        assert not send.is_alive()


# -- for a moment


def test_moment_without_threads_is_told(master, peer, monkeypatch):
    """Delegates, callbacks of rospy and slow connections go on when there are threads again."""
    ear, mouth = create(master, '/ear'), create(master, '/mouth')
    delegate, callback = Mailbox(ear, '/t', STRING), Mailbox()
    ear.ros.Subscriber('/t', std_msgs.msg.String, callback, queue_size=10)
    peer.hear('/t', STRING)
    peer.run(f'log = []; rospy.Subscriber("/rosout", message_class("{LOG}"), log.append)')
    channel = mouth.output_channel('/t', STRING)
    until(lambda: len(channel.connections) == 2)

    def fail(thread):
        raise RuntimeError("can't start new thread")

    large = 'x' * (3 << 20)  # a connection needs a thread for this
    with monkeypatch.context() as moment:
        moment.setattr(threading.Thread, 'start', fail)
        channel.send(data=large)
    for data in 'one', 'two':
        channel.send(data=data)
    for mailbox in delegate, callback:
        assert [mailbox.next().data for _ in range(3)] == [large, 'one', 'two']
    assert [message.data for message in peer.heard('/t', 3)] == [large, 'one', 'two']
    until(lambda: 'lacks a thread' in peer.value('"".join(line.msg for line in log)'))


def test_subscription_connects_after_lack_of_threads(master, peer, monkeypatch):
    peer.run('publisher = rospy.Publisher("/t", message_class("std_msgs/String"), queue_size=100)')
    ear, mailbox = create(master, '/ear'), Mailbox()
    start = threading.Thread.start

    def fail_in_ear(thread):
        if 'ear' in thread.name or thread.name == '/t':
            raise RuntimeError("can't start new thread")
        start(thread)

    with monkeypatch.context() as moment:
        moment.setattr(threading.Thread, 'start', fail_in_ear)
        ear.ros.Subscriber('/t', std_msgs.msg.String, mailbox)
    until(lambda: peer.value('publisher.get_num_connections()') == 1)
    peer.run('publisher.publish("hello")')
    assert mailbox.next().data == 'hello'


@pytest.mark.skipif(sys.version_info >= (3, 14), reason='it leaves locks locked: see doc/limits.md')
@pytest.mark.parametrize('queue_size', [None, 10])
def test_handler_that_raises_in_publish(master, peer, queue_size, monkeypatch):
    """The next publish() sends the rest of a message that signals have cut, and then its own."""
    monkeypatch.delenv('COVERAGE_PROCESS_START', False)  # its lock in Python would stay locked
    peer.hear('/t', STRING)
    text = f'''
import signal

class Alarm(Exception):
    pass

def handle(number, frame):
    raise Alarm

signal.signal(signal.SIGALRM, handle)
publisher = rospy.Publisher('/t', message_class('std_msgs/String'), queue_size={queue_size})

def publish_until_alarm():
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.003, 1)  # again: one in a __del__() is ignored
        while True:
            publisher.publish('x' * 100_000)
    except Alarm:
        signal.setitimer(signal.ITIMER_REAL, 0)
'''
    with PharosPeer(master.url, 'mouth') as mouth:  # its main thread; a test may have another one
        mouth.run(text)
        until(lambda: mouth.value('publisher.get_num_connections()'))
        os.kill(peer.pid, signal.SIGSTOP)
        try:
            mouth.run('for _ in range(300): publish_until_alarm()')
        finally:
            os.kill(peer.pid, signal.SIGCONT)
        mouth.run("publisher.publish('whole')")
        until(lambda: peer.value('heard["/t"] and heard["/t"][-1].data') == 'whole')
    heard = peer.value('{message.data for message in heard["/t"]}')
    assert set(heard) == {'whole', 'x' * 100_000}


@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason='it knows the bytecode of 3.11')
@pytest.mark.parametrize('scenario', ['send', 'inline', 'first'])
def test_handler_that_raises_leaves_no_queue_asleep(master, monkeypatch, scenario):
    """At any point of a send(), which may be the first one; the next message arrives."""
    monkeypatch.delenv('COVERAGE_PROCESS_START', False)  # its trace function would be lost
    path = str(ROOT / 'test' / 'programs' / 'points.py')
    with Program([PYTHON, '-u', path, scenario], master.url) as program:
        assert program.wait() == 0, program.output
    assert int(re.search(r'(\d+) points', program.output)[1]) > 20


# -- lines that cannot be printed, and looks that fail


def without_output(code, where='1>/dev/full 2>/dev/full'):
    """Return the command of a program whose lines cannot be printed."""
    return ['sh', '-c', f'exec "$0" -u -c "$1" {where}', PYTHON, code]


def port_of(mortal):
    """Return the port of a MortalMaster."""
    return int(mortal.url.rstrip('/').rpartition(':')[2])


BEGIN = "import pharos; me = pharos.Master().create(pharos.BlockNode, '/me')\n"
PRINTS = {
    'log': "me.log('x'); me.log('x', level='error')",
    'rospy': "me.ros.loginfo('x'); me.ros.logwarn('x')",
    'Transcript': "pharos.Transcript.show('x')",
    'soul left behind': 'import time; me.stop_timeout = 0.1; me.fork(lambda: time.sleep(1))',
}


@pytest.mark.parametrize('name', PRINTS)
def test_full_disk_ends_no_program(master, name):
    with Program(without_output(f'{BEGIN}{PRINTS[name]}\nme.stop()'), master.url) as program:
        assert program.wait() == 0


def test_stop_unregisters_on_a_full_disk(master):
    text = f"{BEGIN}{PRINTS['soul left behind']}\nme.stop()\nprint(me.lifecycle.value)"
    with Program(without_output(text, '2>/dev/full'), master.url) as program:
        program.wait()
        assert 'stopped' in program.output
    assert not any(master.system_state())


def test_watcher_outlives_a_full_disk(mortal):
    """A line about the master that has gone cannot be printed; a new master gets all again."""
    text = BEGIN + "me.interested_in('/t', 'std_msgs/String')\npharos.spin()"
    with Program(without_output(text), mortal.url) as program:
        until(lambda: '/t' in registrations(mortal.master, '/me')[1])
        before = registrations(mortal.master, '/me')
        mortal.end()
        with socket.create_server(('127.0.0.1', port_of(mortal))) as silent:
            silent.settimeout(TIMEOUT)
            silent.accept()[0].close()  # the watcher asks, and will tell that nobody answers
        mortal.come_back()
        until(lambda: registrations(mortal.master, '/me') == before)
        program.signal(signal.SIGINT)
        program.wait()


def prepare_retries(run):
    run.node.interested_in('/heard', STRING)
    run.topic_manager.subs['/heard'].retries = collections.UserDict()


LOOKED_AT = {
    'connections': ('topic_manager.check_all', lambda run: None),
    'log': ('ros.logwarn_throttle_identical', lambda run: run.troubles.add('a trouble')),
    'retries': ('topic_manager.subs./heard.retries.items', prepare_retries),
    'silent clients': (
        'deadlines.items',
        lambda run: setattr(run, 'deadlines', collections.UserDict()),
    ),
    'topics': ('topic_manager.get_publications', lambda run: None),
    'services': ('service_manager.get_services', lambda run: None),
}


def break_look(monkeypatch, run, what):
    """Have a call of the watcher's look at a run raise; return the list of those calls."""
    path, prepare = LOOKED_AT[what]
    prepare(run)
    *names, name = path.split('.')
    owner, calls = run, []
    for each in names:
        owner = owner[each] if isinstance(owner, dict) else getattr(owner, each)

    def fail(*arguments):
        calls.append(arguments)
        raise RuntimeError('this look fails')

    monkeypatch.setattr(owner, name, fail)
    return calls


@pytest.fixture
def quick_watcher(monkeypatch):
    """The watcher looks more often."""
    monkeypatch.setattr('pharos.private_rospy.connections.WATCH_PERIOD', 0.05)


@pytest.mark.parametrize('what', LOOKED_AT)
def test_failed_look_costs_no_other_node(master, monkeypatch, quick_watcher, what):
    """The watcher looks at the others, and looks again."""
    victim, other = create(master, '/victim'), create(master, '/other')
    other.output_channel('/topic', STRING)
    calls = break_look(monkeypatch, victim._current_run, what)
    until(lambda: calls)
    rosgraph.Master('/other', master.url).unregisterPublisher('/topic', other.uri)
    until(lambda: master.topic('/topic').publishers == ['/other'])
    count = len(calls)
    if what != 'log':
        until(lambda: len(calls) > count)
    monkeypatch.undo()
    rosgraph.Master('/victim', master.url).unregisterPublisher('/rosout', victim.uri)
    until(lambda: '/victim' in master.topic('/rosout').publishers)


def test_failed_connection_is_told_and_made_again(master, monkeypatch, quick_watcher):
    """Whatever the error is."""
    link, calls = connections.link_topic, []

    def fail_once(*arguments):
        calls.append(arguments)
        if len(calls) == 1:
            raise RuntimeError('this attempt fails')
        link(*arguments)

    ear = create(master, '/ear')
    log = Mailbox(ear, '/rosout', 'rosgraph_msgs/Log')
    monkeypatch.setattr(connections, 'link_topic', fail_once)
    box = Mailbox(ear, '/words', STRING)
    create(master, '/mouth').send_to('/words', typed_as=STRING, data='x')
    assert box.next().data == 'x'
    log.wait_for(lambda line: 'this attempt fails' in line.msg)


def test_failed_look_is_told_once(master, monkeypatch, quick_watcher, transcript):
    monkeypatch.setattr('pharos.transcript._shown_keys', set())  # of other tests
    calls = break_look(monkeypatch, create(master)._current_run, 'silent clients')
    until(lambda: len(calls) > 10)
    assert len([text for text in transcript if 'this look fails' in text]) == 1


@pytest.mark.parametrize(
    'which, error',
    [
        ('tcp_port', OSError(errno.EMFILE, 'no descriptor is left')),
        ('tcp_port', ValueError('odd')),
        ('xmlrpc_port', ValueError('odd')),
    ],
    ids=str,
)
def test_failed_accept_ends_no_server(host, monkeypatch, which, error):
    accept, failed = socket.socket.accept, threading.Event()

    def fail_once(sock):
        if sock.getsockname()[1] == getattr(host, which) and not failed.is_set():
            failed.set()
            raise error
        return accept(sock)

    monkeypatch.setattr(socket.socket, 'accept', fail_once)
    while not failed.is_set():  # the server may wait in accept() already
        with connect(getattr(host, which)):
            failed.wait(0.1)
    assert_served(host)


NO_STATES = [5, 'nonsense', [], [1, ''], [1, '', None], [1, '', [[]]], [1, '', [1, 2, 3]], {}]


def test_answer_without_sense_ends_no_look(mortal, quick_watcher):
    """Another program answers at the URL of the master for a while."""
    node = create(mortal.master)
    node.interested_in('/t', STRING)
    before = registrations(mortal.master, '/node')
    mortal.end()
    address = '127.0.0.1', port_of(mortal)
    asked = []

    def answer(method, arguments):
        asked.append(method)
        return NO_STATES[len(asked) % len(NO_STATES)]

    with xmlrpc.server.SimpleXMLRPCServer(address, logRequests=False, allow_none=True) as server:
        server._dispatch = answer
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            until(lambda: asked.count('getSystemState') > len(NO_STATES))
        finally:
            server.shutdown()
            thread.join()
    mortal.come_back()
    until(lambda: registrations(mortal.master, '/node') == before)


# -- for a while

SOAK = float(os.environ.get('PHAROS_SOAK', 0))  # seconds; benchmark/soak takes its time


def in_use(master):
    """Return how many threads, descriptors and registered names there are."""
    names = sum(map(len, master.system_state()))
    return threading.active_count(), len(os.listdir('/proc/self/fd')), names


def come_and_go(master, is_killed):
    """Have nodes, channels and a peer start, talk and end."""
    with create(master, '/one') as one, create(master, '/two') as two, Peer(master.url) as peer:
        heard, told = Mailbox(two, '/soak', STRING), Mailbox(one, '/from_peer', STRING)
        two.serve('/set', 'std_srvs/SetBool', lambda request: {'success': request.data})
        publish_from(peer, '/from_peer')
        peer.run('publisher.publish("hello")')
        assert told.next().data == 'hello'
        peer.hear('/soak', STRING)
        for number in range(10):
            one.send_to('/soak', data=str(number))
            assert heard.next().data == str(number)
            assert master.lookup_service('/set').call(data=True, timeout=TIMEOUT).success
            one.channels[-1].close()
        if is_killed:
            peer.end()
            create(master, '/peer').stop()  # takes the name, and all that is registered for it
        two.restart()
        one.stop()
        one.start()
        one.send_to('/soak', data='again')
        assert heard.next().data == 'again'
        assert not one.errors and not two.errors


@pytest.mark.timeout(SOAK + 120)
def test_soak_leaves_nothing_behind(mortal):
    master = Master(mortal.url)
    come_and_go(master, is_killed=False)  # loads what a process loads once
    until(lambda: not any(master.system_state()))
    before, end = in_use(master), time.monotonic() + SOAK
    with create(master, '/stays') as stays:
        stays.interested_in('/t', STRING)
        for number in itertools.count(1):
            come_and_go(master, is_killed=number % 2)
            if number == 2:
                mortal.end()
                mortal.come_back()
                until(lambda: '/t' in registrations(master, '/stays')[1])
            if time.monotonic() > end and number > 2:
                break
    until(lambda: all(now <= then for now, then in zip(in_use(master), before)), what=str(before))
