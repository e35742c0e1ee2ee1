"""What hurts rospy's users, by the issues of ros_comm, which is archived: doc/robustness.md says
which test shows what.

Here are the tests that fit nowhere else, and for most of the pains a twin: it wishes of bare rospy
what a node of this package does, and is expected to fail. Where that would depend on luck or take
minutes, a docstring says what came out.
"""
import contextlib
import inspect
import json
import pkgutil
import re
import socket
import struct
import sys
import threading

import pytest

from helpers import create, speak_tcpros_only
from pharos.testing import TIMEOUT, Mailbox
from programs import ROOT, Program
from sockets import subscribe

STRING = 'std_msgs/String'
DOCUMENT = ROOT / 'doc' / 'robustness.md'


def receive(sock):
    """The next thing that comes: the connection header, or a message."""

    def exactly(size):
        data = b''
        while len(data) < size:
            more = sock.recv(size - len(data))
            if not more:
                raise EOFError('closed')
            data += more
        return data

    return exactly(*struct.unpack('<I', exactly(4)))


def until(condition):
    """Wait for what nobody tells, also in the programs of bare rospy, which get its source."""
    pause = threading.Event()
    for _ in range(2000):
        if condition():
            return
        pause.wait(0.01)
    raise RuntimeError('it did not come to be')


def leave(sock):
    """Close a connection, and wait until the other side could know."""
    sock.shutdown(socket.SHUT_WR)
    # FIN_WAIT1: not acknowledged yet
    until(lambda: sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0] != 4)
    sock.close()


def is_without_delay(sock):
    return bool(sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))


# -- bare rospy

BARE = '''
import json, os, queue, socket, struct, sys, threading, time, xmlrpc.client
import rosgraph.network, rospy, rospy.impl.tcpros_base
from rosgraph.network import encode_ros_handshake_header
from std_msgs.msg import String
from std_srvs.srv import Empty

def show(found):
    # in one piece: a callback may print meanwhile what it has raised
    sys.stdout.write(f'found {json.dumps(found)}\\n')
    sys.stdout.flush()

def tcp_port():
    return rospy.impl.tcpros_base.get_tcpros_server_address()[1]

''' + '\n\n'.join(
    inspect.getsource(function) for function in (until, subscribe, receive, leave, is_without_delay)
)
NODE = '''
rospy.init_node('bare', anonymous=True)
'''


@pytest.fixture(scope='module')
def bare(ros_master):
    """``bare(code)`` runs a program with rospy alone, and returns what it shows.

    ``bare(code, node='')`` starts no node. The programs end in their own time, half a second, while
    others run.
    """
    with contextlib.ExitStack() as programs:

        def run(code, node=NODE):
            program = Program(
                ros_master.url, sys.executable, '-W', 'ignore', '-c', BARE + node + code
            )
            programs.callback(program.end)
            programs.callback(program.read_to_the_end)
            try:
                line = program.wait_for('found ')
            except AssertionError as error:
                # no twin is to pass for failing because its program did
                raise RuntimeError(error) from error
            return json.loads(line.partition(' ')[2])

        yield run


def fails(issue, is_always=True):
    """The mark of a twin: what it asserts is not so with bare rospy, for this is known there.

    :param is_always: whether it never is, also on a machine that is busy
    """
    return pytest.mark.xfail(strict=is_always, raises=AssertionError, reason='ros_comm ' + issue)


@fails('#185')
def test_bare_rospy_gives_a_process_a_second_node(bare):
    assert (
        bare(
            '''
try:
    rospy.init_node('second')
    show('another node')
except rospy.ROSException as error:
    show(str(error))
'''
        )
        == 'another node'
    )


@fails('#214')
def test_bare_rospy_starts_a_node_again(bare):
    """It says nothing, and stays shut down."""
    assert (
        bare(
            '''
rospy.signal_shutdown('stop')
rospy.init_node('bare', anonymous=True)
show('shut down' if rospy.is_shutdown() else 'running')
'''
        )
        == 'running'
    )


@fails('#2238')
def test_bare_rospy_uses_no_cpu_after_its_shutdown(bare):
    """Its XML-RPC thread turns on a closed socket: 1.99 s of CPU in 2 s."""
    assert (
        bare(
            '''
rospy.signal_shutdown('stop')
begin = time.process_time() - time.thread_time()
try:
    until(lambda: time.process_time() - time.thread_time() > begin + 0.2)
    show('busy')
except RuntimeError:
    show('at rest')
'''
        )
        == 'at rest'
    )


@fails('(no issue)', is_always=False)
def test_bare_rospy_frees_its_port_at_its_shutdown(bare):
    assert (
        bare(
            '''
port = tcp_port()
rospy.signal_shutdown('stop')
try:
    socket.create_server(('127.0.0.1', port))
    show('free')
except OSError as error:
    show(error.strerror)
'''
        )
        == 'free'
    )


@fails('PR #1918')
def test_bare_rospy_serves_others_beside_a_silent_client(bare):
    """The client that comes second is served as soon as the first has gone, and no earlier."""
    assert bare(
        '''
publisher = rospy.Publisher('/pains/silent', String, queue_size=1)
silent = socket.create_connection(('127.0.0.1', tcp_port()))
client = subscribe(tcp_port(), '/pains/silent')
client.settimeout(0.5)
try:
    found = bool(client.recv(1, socket.MSG_PEEK))
except socket.timeout:
    found = False
silent.close()
client.settimeout(20)
receive(client)
show(found)
'''
    )


BUSY = '''
busy = socket.create_server(('127.0.0.1', 0))
port = busy.getsockname()[1]
try:
    rospy.init_node('bare', anonymous=True, %s=port)
    show('no error; the TCPROS server is at %%s:%%s' %% rospy.impl.tcpros_base.get_tcpros_server_address())
except Exception as error:
    show(str(error).replace(str(port), 'the port'))
'''


@fails('#127')
def test_bare_rospy_names_an_xmlrpc_port_that_is_busy(bare):
    """'init_node interrupted before it could complete'."""
    assert 'the port' in bare(BUSY % 'xmlrpc_port', node='')


@fails('#127')
def test_bare_rospy_names_a_tcpros_port_that_is_busy(bare):
    """It prints a traceback, registers, and nobody can connect to it."""
    assert 'the port' in bare(BUSY % 'tcpros_port', node='')


@fails('#2241')
def test_bare_rospy_is_not_shut_down_for_an_earlier_owner_of_its_uri(bare):
    assert (
        bare(
            '''
xmlrpc.client.ServerProxy(rospy.get_node_uri()).shutdown('/master', '[/old] Reason: new node registered with same name')
show(rospy.is_shutdown())
'''
        )
        is False
    )


@fails('#176, #286')
def test_bare_rospy_loses_no_first_message(bare):
    """The subscriber is there and the master knows it; 3 of 3 are lost."""
    assert (
        bare(
            '''
found = []
for topic in '/pains/first0', '/pains/first1', '/pains/first2':
    heard = queue.SimpleQueue()
    subscriber = rospy.Subscriber(topic, String, heard.put)
    publisher = rospy.Publisher(topic, String, queue_size=10)
    publisher.publish('first')
    until(lambda: publisher.publish('later') or not heard.empty())
    found.append(heard.get().data)
show(found)
'''
        )
        == ['first'] * 3
    )


@fails('#1362, #2318')
def test_bare_rospy_sends_small_messages_without_delay(bare):
    """Nagle's algorithm is on: 42.9 ms once in 50 messages."""
    assert bare(
        '''
subscriber = rospy.Subscriber('/pains/small', String)
publisher = rospy.Publisher('/pains/small', String, queue_size=1)
until(publisher.get_num_connections)
show(is_without_delay(publisher.impl.connections[0].socket))
'''
    )


@fails('#1481')
def test_bare_rospy_latches_a_message_as_it_was(bare):
    assert (
        bare(
            '''
heard = queue.SimpleQueue()
publisher = rospy.Publisher('/pains/latched', String, queue_size=1, latch=True)
message = String('as it was')
publisher.publish(message)
message.data = 'changed since'
subscriber = rospy.Subscriber('/pains/latched', String, heard.put)
show(heard.get(timeout=20).data)
'''
        )
        == 'as it was'
    )


@fails('#146')
def test_bare_rospy_latches_for_each_publisher_of_a_node(bare):
    assert (
        bare(
            '''
heard = []
for text in 'first', 'second':
    publisher = rospy.Publisher('/pains/latches', String, queue_size=10, latch=True)
    publisher.publish(text)
subscriber = rospy.Subscriber('/pains/latches', String, lambda message: heard.append(message.data))
until(lambda: heard)
until(lambda: publisher.publish('later') or 'later' in heard)
show(heard[:2])
'''
        )
        == ['first', 'second']
    )


@fails('#927')
def test_bare_rospy_knows_that_a_subscriber_has_left(bare):
    """It looks twice a second, and at the next publish; who waits for a subscriber has that one: 16
    of 30 lost."""
    assert all(
        bare(
            '''
found = []
publisher = rospy.Publisher('/pains/leaving', String, queue_size=1)
for number in range(10):
    client = subscribe(tcp_port(), '/pains/leaving', '/raw%d' % number)
    until(lambda: publisher.impl.has_connection('/raw%d' % number))
    leave(client)
    found.append(publisher.get_num_connections() == 0)
show(found)
'''
        )
    )


@fails('#152')
def test_bare_rospy_takes_a_time_limit_for_a_service_call(bare):
    assert (
        bare(
            '''
try:
    rospy.ServiceProxy('/pains/no_service', Empty)(timeout=0.01)
except rospy.ServiceException as error:
    show('given up')
except Exception as error:
    show(str(error))
'''
        )
        == 'given up'
    )


PUBLISH_BESIDE_ONE_THAT_READS_NOTHING = '''
publisher = rospy.Publisher('/pains/stuck', String)
clients = [subscribe(tcp_port(), '/pains/stuck', '/raw%d' % number) for number in range(2)]
until(lambda: publisher.get_num_connections() == 2)
def publish():
    for _ in range(20):
        publisher.publish('x' * 1000000)
publishing = threading.Thread(target=publish, daemon=True)
publishing.start()
receive(clients[1])
try:
    clients[1].settimeout(0.5)
    for _ in range(20):
        receive(clients[1])
    show(20)
except socket.timeout:
    show(_)
'''


@fails('#169, #507')
def test_bare_rospy_publishes_to_others_while_one_does_not_read(bare):
    """Unless each publisher has been given a queue_size."""
    assert bare(PUBLISH_BESIDE_ONE_THAT_READS_NOTHING) == 20


@fails('#1377')
def test_bare_rospy_runs_one_callback_at_a_time(bare):
    assert (
        bare(
            '''
both, found = threading.Barrier(2), queue.SimpleQueue()
def callback(message):
    try:
        both.wait(20)
        found.put('two at a time')
    except threading.BrokenBarrierError:
        found.put('one at a time')
subscribers = [rospy.Subscriber(topic, String, callback) for topic in ('/pains/left', '/pains/right')]
publishers = [rospy.Publisher(topic, String, queue_size=1, latch=True) for topic in ('/pains/left', '/pains/right')]
for publisher in publishers:
    publisher.publish('go')
show(found.get(timeout=40))
'''
        )
        == 'one at a time'
    )


@fails('(no issue)')
def test_bare_rospy_subscribes_without_a_type(bare):
    assert (
        bare(
            '''
try:
    rospy.Subscriber('/pains/untyped', None, print)
    show('subscribed')
except ValueError as error:
    show(str(error))
'''
        )
        == 'subscribed'
    )


@fails('#315')
def test_bare_rospy_listens_on_one_interface(bare):
    """This is where both its servers bind, for the environment of the whole process alone says
    otherwise."""
    assert (
        bare(
            '''
del os.environ['ROS_HOSTNAME']
show(rosgraph.network.get_bind_address())
''',
            node='',
        )
        != '0.0.0.0'
    )


@fails('(by design)')
def test_bare_rospy_tells_of_an_exception_in_a_callback(bare):
    """It is logged; Python's own hooks hear nothing of it either."""
    assert bare(
        '''
told, done = [], threading.Event()
sys.excepthook = threading.excepthook = lambda *arguments: 'bad' in str(arguments) and told.append(arguments)
def callback(message):
    if message.data == 'good':
        done.set()
    raise ValueError(message.data)
subscriber = rospy.Subscriber('/pains/raising', String, callback)
publisher = rospy.Publisher('/pains/raising', String, queue_size=10)
until(lambda: publisher.publish('bad') or publisher.publish('good') or done.is_set())
show(len(told))
'''
    )


# -- the same, of nodes of this package


def test_small_messages_are_sent_without_delay_whatever_the_subscriber_asks_for(master):
    """rospy's and roscpp's ask for Nagle's algorithm unless they are told otherwise: 40 ms (#1362,
    #2318)."""
    node = create(master, '/quick')
    channel = node.output_channel('/pains/small', STRING)
    with subscribe(node.tcp_port, channel.topic) as client:
        receive(client)
        until(lambda: channel.connections)
        (connection,) = node.latest_run.rospy.publisher(channel.topic).connections
        assert is_without_delay(connection.socket)


def test_a_rospy_publisher_sends_small_messages_to_a_node_without_delay(master, bare):
    create(master, '/asking').interested_in('/pains/asked', STRING)
    assert bare(
        '''
publisher = rospy.Publisher('/pains/asked', String, queue_size=1)
until(publisher.get_num_connections)
show(is_without_delay(publisher.impl.connections[0].socket))
'''
    )


def test_a_subscriber_that_has_left_is_not_taken_for_the_next_one(master):
    """With rospy, who waits for a subscriber has one that is gone, and loses the message (#927)."""
    node = create(master, '/sender')
    channel = node.output_channel('/pains/leaving', STRING)
    for number in range(10):
        with subscribe(node.tcp_port, channel.topic, '/raw%d' % number) as client:
            assert channel.wait_for_subscribers(1, TIMEOUT)
            assert channel.connections == [('/raw%d' % number, 'TCPROS')]
            channel.send(data=str(number))
            receive(client)
            assert receive(client)[4:].decode() == str(number)
            leave(client)
        assert channel.connections == []
        assert not channel.wait_for_subscribers(1, 0)


def test_a_subscriber_that_reads_nothing_takes_nothing_from_the_others(master, mailbox):
    """With rospy, the publisher waits for it, unless it was given a queue_size (#169, #507)."""
    sender, receiver = create(master, '/sender'), create(master, '/receiver')
    channel = sender.output_channel('/pains/stuck', STRING, queue_size=20)
    with subscribe(sender.tcp_port, channel.topic) as client:
        receive(client)
        receiver.ros.Subscriber(
            channel.topic, channel.message_class, lambda message: mailbox(message, None)
        )
        assert channel.wait_for_subscribers(2, TIMEOUT)
        sender.fork(
            lambda me: [
                channel.send(data='%d %s' % (number, 'x' * 1000000)) for number in range(20)
            ]
        )
        assert [int(message.data.split()[0]) for message in mailbox.take(20)] == list(range(20))


@pytest.mark.parametrize('transport', ['INTRAPROCESS', 'TCPROS'])
def test_a_delegate_is_not_run_beside_another(master, transport):
    """With rospy, each connection's callbacks run in a thread of its own (#1377)."""
    node, sender, began, go_on = (
        create(master, '/careful'),
        create(master, '/sender'),
        Mailbox(),
        threading.Event(),
    )

    def delegate(message, channel):
        began(message, channel)
        if message.data == 'wait':
            go_on.wait(TIMEOUT)

    topics = '/pains/left', '/pains/right'
    if transport == 'TCPROS':
        speak_tcpros_only(node)
    left, right = (node.interested_in(topic, STRING, delegate, queue_size=1) for topic in topics)
    to_left, to_right = (sender.output_channel(topic, STRING) for topic in topics)
    for channel in to_left, to_right:
        until(lambda: channel.connections == [('/careful', transport)])
        # with TCPROS, such delegates are then run by the thread that reads the socket
        channel.send(data='quick')
        began.next()
    to_left.send(data='wait')
    assert began.next().data == 'wait'
    for text in 'dropped', 'kept':
        to_right.send(data=text)
    until(lambda: right.dropped == 1)  # both have come, and neither was begun with
    assert began.empty()
    go_on.set()
    assert began.next().data == 'kept'


# -- the document


def rows(heading):
    """The rows of the table under that heading of the document, as lists of cells."""
    section = (
        DOCUMENT.read_text(encoding='utf-8').partition(f'\n## {heading}\n')[2].partition('\n## ')[0]
    )
    table = [line for line in section.splitlines() if line.startswith('|')]
    return [[cell.strip() for cell in line.strip('|').split('|')] for line in table[2:]]


def functions_of(file):
    """The names of the test functions of a file of this folder."""
    return set(
        re.findall(
            r'^def (test_\w+)\(', (ROOT / 'test' / file).read_text(encoding='utf-8'), re.MULTILINE
        )
    )


def test_each_pain_in_the_document_has_a_test_and_each_test_there_exists():
    table = rows('What hurts, and what shows that it is gone')
    assert len(table) == 21
    for pain, *_, tests in table:
        assert re.search(r'`test_\w+\.py::test_\w+`', tests), pain
    named = re.findall(r'`(test_\w+\.py)::(\w+)`', DOCUMENT.read_text(encoding='utf-8'))
    assert [(file, name) for file, name in named if name not in functions_of(file)] == []


UNITS = {'': 1, 's': 1, 'KiB': 1 << 10, 'MiB': 1 << 20, 'bytes': 1, 'characters': 1}


def test_the_limits_in_the_document_are_those_of_the_code():
    table = rows('Limits')
    assert table
    for name, value, _ in table:
        number, _, unit = value.partition(' ')
        limit = pkgutil.resolve_name('pharos.' + name.strip('`'))
        assert float(number.replace(',', '')) * UNITS[unit] == limit, name
