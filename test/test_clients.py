"""Clients that misbehave: none keeps others out, costs much, or ends anything; each is logged once,
with its address.

With rospy, one silent client blocks all new connections (ros_comm PR #1918), 4 GiB announced are
waited for, and what is refused becomes a traceback in the log that does not say who it was.
"""
import contextlib
import io
import os
import pathlib
import random
import socket
import struct
import sys
import threading
import xmlrpc.client

import pytest
import rosnode
import std_msgs.msg
from rosgraph.network import encode_ros_handshake_header

from helpers import create, speak_tcpros_only
from pharos.testing import Mailbox, TIMEOUT, until
from fuzz import Fuzz
from pharos import BlockNode
from pharos.private_rospy import acceptor, xmlrpc_server
from programs import Program, run

FUZZ_COUNT = int(os.environ.get('PHAROS_FUZZ_COUNT', 2500))  # bad clients; tools/soak makes it more
STRING = std_msgs.msg.String


def connect(port):
    return socket.create_connection(('127.0.0.1', port), TIMEOUT)


def threads(node, kind):
    return [thread.name for thread in threading.enumerate() if thread.name == f'{node.name} {kind}']


def limits(node):
    """Those for the clients of the node, which may be set."""
    return node.latest_run.rospy.limits


def address_of(client):
    return '%s:%d' % client.getsockname()


def is_closed(client):
    """Wait for the other side to close the connection."""
    with contextlib.suppress(ConnectionResetError):
        while client.recv(1 << 16):
            pass
    return True


def answers(node):
    """Whether the node answers an XML-RPC call, and a fresh subscriber receives what it
    publishes."""
    with xmlrpc.client.ServerProxy(node.uri) as proxy, connect(node.tcp_port) as subscriber:
        assert proxy.getPid('/test')[0] == 1
        subscriber.sendall(
            encode_ros_handshake_header(
                {
                    'callerid': '/test',
                    'topic': '/clients/out',
                    'type': STRING._type,
                    'md5sum': STRING._md5sum,
                }
            )
        )
        file = subscriber.makefile('rb')
        file.read(*struct.unpack('<I', file.read(4)))
        return file.read(*struct.unpack('<I', file.read(4))) == struct.pack('<I', 5) + b'hello'


@pytest.fixture
def warnings():
    """What /node warns of, in the order in which it does."""
    return Mailbox()


@pytest.fixture
def screen(capsys):
    """``screen()``: all that was printed so far."""
    printed = []

    def screen():
        printed.extend(capsys.readouterr())
        return ''.join(printed)

    return screen


@pytest.fixture
def node(master, warnings, screen):
    """A node that publishes and serves; no traceback gets to its log or to the screen."""

    def keep(line, channel):
        if line.name == '/node' and line.level > line.INFO:
            warnings(line.msg, channel)

    log_lines = create(master, '/auditor', delegate=keep).interested_in(
        '/rosout', 'rosgraph_msgs/Log'
    )
    log = pathlib.Path(os.environ['ROS_LOG_DIR']) / 'node.log'
    logged_before = log.stat().st_size if log.exists() else 0
    node = create(master, '/node')
    node.output_channel('/clients/out', STRING, latch=True).send(data='hello')
    node.serve('/clients/set', 'std_srvs/SetBool', lambda request: {'success': request.data})
    until(lambda: '/node' in dict(log_lines.connections))
    yield node
    assert node.is_running
    with open(log) as file:
        file.seek(logged_before)
        assert 'Traceback' not in file.read()
    assert 'Traceback' not in screen()


# -- silent and slow clients, and many of them

HANG = """
import signal, socket, struct, sys
clients = []
for port, beginning in zip(sys.argv[1:], (struct.pack('<I', 1000), b'POST / HTTP/1.1')):
    for number in range(400):
        clients.append(socket.create_connection(('127.0.0.1', int(port))))
        if number % 2:
            clients[-1].sendall(beginning)
print('there', flush=True)
signal.pause()
"""


def test_hundreds_of_silent_clients_keep_nobody_out(master, mailbox, node, warnings):
    """400 at each port say nothing, or begin and do not go on."""
    limits(node).handshake_timeout = TIMEOUT
    with Program(
        master.url, sys.executable, '-c', HANG, str(node.tcp_port), str(node.xmlrpc_port)
    ) as crowd:
        crowd.wait_for('there')
        receiver = create(master, '/receiver')
        # through TCPROS
        speak_tcpros_only(receiver).ros.Subscriber(
            '/clients/out', STRING, lambda message: mailbox(message, None)
        )
        assert mailbox.next().data == 'hello'
        assert answers(node)
        assert rosnode.rosnode_ping('/node', max_count=1)
        assert master.lookup_service('/clients/set').call(data=True, timeout=TIMEOUT).success
        for kind in 'TCPROS', 'XML-RPC':
            until(lambda: len(threads(node, kind)) <= acceptor.Limits.clients)
            assert len(threads(node, kind)) > 1  # some do hang there
        assert {warnings.next(), warnings.next()} == {
            '%d %s clients say nothing: those that said nothing for longest are closed, to let others in'
            % (acceptor.Limits.clients, kind)
            for kind in ('TCPROS', 'XML-RPC')
        }
        assert warnings.empty()


RUSH = """
import socket, struct, sys
port, said = int(sys.argv[1]), bytes.fromhex(sys.argv[2])
clients = [socket.create_connection(('127.0.0.1', port)) for _ in range(400)]
for client in clients:
    client.sendall(said)
for client in clients:
    client.settimeout(20)
    assert client.recv(1)
print('all were served')
"""


def test_of_hundreds_of_good_clients_none_is_taken_for_a_silent_one(master, node, warnings):
    """Those that come in a rush wait for their turn; it is 0.25 s otherwise until one is silent."""
    limits(node).grace = TIMEOUT
    request = post(call('getPid', '/test'), more='Connection: close\r\n')
    for port, said in (node.tcp_port, shake()), (node.xmlrpc_port, request):
        with Program(master.url, sys.executable, '-c', RUSH, str(port), said.hex()) as rush:
            rush.wait_for('all were served')
    assert warnings.empty()


def test_a_slow_handshake_ends_after_its_limit(node, warnings):
    """However steadily it comes, a byte at a time."""
    limits(node).handshake_timeout = 0.3
    with connect(node.tcp_port) as client:
        dribble(client, struct.pack('<I', 100000))
        assert is_closed(client)
        assert (
            warnings.next()
            == f'TCPROS client {address_of(client)} refused: no handshake within 0.3 s'
        )
    assert answers(node)
    assert warnings.empty()


def test_a_slow_request_ends_after_its_limit(node, warnings):
    limits(node).request_timeout = 0.3
    with connect(node.xmlrpc_port) as client:
        dribble(client, b'POST / HTTP/1.1\r\nContent-Length: 10000\r\n\r\n')
        assert is_closed(client)
        line = warnings.next()
        assert line.startswith(f'XML-RPC client {address_of(client)} refused: Request timed out')
    assert answers(node)
    assert warnings.empty()


def dribble(client, beginning):
    """Say it, and then a byte every 10 ms for as long as the other side listens."""
    pause = threading.Event()
    client.sendall(beginning)
    with contextlib.suppress(OSError):
        for _ in range(int(TIMEOUT / 0.01)):
            client.sendall(b'.')
            pause.wait(0.01)
        raise AssertionError('the node listens for ever')


def test_a_client_that_has_nothing_more_to_ask_is_no_bad_one(node, warnings):
    limits(node).request_timeout = 0.3
    with connect(node.xmlrpc_port) as client:
        client.sendall(post(call('getPid', '/test')))
        assert is_closed(client)
    assert answers(node)
    assert warnings.empty()


def test_a_node_out_of_descriptors_serves_again_once_there_are_some(master):
    """rospy's accept loop ends with the first error, and the XML-RPC server turns without pause."""
    program = r'''
import os, resource, sys
import pharos
node = pharos.Master().create(pharos.BlockNode, named='/poor', domain='127.0.0.1')
node.output_channel('/clients/out', 'std_msgs/String', latch=True).send(data='hello')
limit = max(map(int, os.listdir('/proc/self/fd'))) + 8
resource.setrlimit(resource.RLIMIT_NOFILE, (limit, limit))
print('ports', node.tcp_port, node.xmlrpc_port, flush=True)
pharos.spin()
'''
    with Program(
        master.url, sys.executable, '-c', program
    ) as poor, contextlib.ExitStack() as clients:
        tcp_port, xmlrpc_port = map(int, poor.wait_for('ports').split()[1:])
        crowd = [
            clients.enter_context(connect(port))
            for port in (tcp_port, xmlrpc_port)
            for _ in range(40)
        ]
        poor.wait_for('Too many open files')
        for client in crowd:
            client.close()
        poor.tcp_port, poor.uri = tcp_port, 'http://127.0.0.1:%d/' % xmlrpc_port
        assert answers(poor)
        poor.end()
        assert 'Traceback' not in poor.read_to_the_end()


def test_a_client_for_whom_there_is_no_thread_is_closed(node, warnings, monkeypatch):
    def start(thread):
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(node.latest_run.rospy.lifetime.Thread, 'start', start)
        for port in node.tcp_port, node.xmlrpc_port:
            with connect(port) as client:
                assert is_closed(client)
    assert "can't start new thread" in warnings.next()
    assert answers(node)


def named(value):
    """A test's name: what is logged, not the bytes that are said."""
    return '' if isinstance(value, bytes) else ascii(value)[1:30]


# -- handshakes


def shake(**fields):
    """The bytes of a subscriber's handshake, with these fields; None: without that one."""
    header = {
        'callerid': '/bad',
        'topic': '/clients/out',
        'type': STRING._type,
        'md5sum': STRING._md5sum,
        **fields,
    }
    return encode_ros_handshake_header(
        {name: value for name, value in header.items() if value is not None}
    )


def assert_refused_and_logged_once(node, port, kind, warnings, said, logged):
    with connect(port) as client:
        with contextlib.suppress(OSError):  # it closes before all of a long one is said
            client.sendall(said)
            client.shutdown(socket.SHUT_WR)
        assert is_closed(client)
        line = warnings.next()
        assert logged in line
        assert line.startswith(f'{kind} client {address_of(client)} refused: ')
    assert '\n' not in line
    assert len(line) < 500
    assert answers(node)
    assert warnings.empty()


@pytest.mark.parametrize(
    'said, logged',
    [
        (struct.pack('<I', 0xFFFFFFFF), '4294967299 bytes; the limit is'),
        (b'GET / HTTP/1.0\r\n\r\n', 'the limit is'),
        (struct.pack('<I', 4) + struct.pack('<I', 0), '0-length'),
        (struct.pack('<I', 7) + struct.pack('<I', 3) + b'abc', 'Invalid line'),
        (struct.pack('<I', 0), 'no topic or service name detected'),
        (struct.pack('<I', 2) + b'ab', 'unpack requires'),
        (struct.pack('<I', 7) + struct.pack('<I', 3) + b'\xff=a', "can't decode byte"),
        (b'', 'closed within the handshake'),
        (b'\x01\x02', 'closed within the handshake'),
        (shake()[:-3], 'closed within the handshake'),
        (shake(topic=None), 'no topic or service name detected (/bad)'),
        (shake(callerid=None), "Missing required 'callerid' field"),
        (shake(topic='/clients/other'), '[/node] is not a publisher of [/clients/other]'),
        (shake(md5sum='0' * 32), 'to have datatype/md5sum'),
        (shake(topic=None, service='/clients/none'), 'is not a provider of  [/clients/none]'),
        (shake(callerid='/a\nINFO: all is well'), r'/a\nINFO: all is well can be no callerid'),
        (shake(callerid='\x1b[2J'), r'\x1b[2J can be no callerid'),
        (shake(callerid='/' + 'a' * 1000000), 'aaa... can be no callerid'),
        (shake(topic='/\x00'), r'/\x00 can be no topic'),
        (
            shake(topic='/%s%n%(x)s{0.__class__}'),
            '[/node] is not a publisher of [/%s%n%(x)s{0.__class__}]',
        ),
    ],
    ids=named,
)
def test_a_bad_handshake_is_refused_and_logged_once(node, warnings, said, logged):
    assert_refused_and_logged_once(node, node.tcp_port, 'TCPROS', warnings, said, logged)


def test_a_caller_id_is_shown_as_it_is(node, warnings, screen):
    """It comes to the log and the screen, and to those who ask for the node's connections, whatever
    it is made of.

    rosgraph takes '${time:' in a message for a part of its own format, and raises where it is
    logged.
    """
    name = '/%s%n%(x)s{0.__class__}<&>${time:${message}'
    with connect(node.tcp_port) as client, xmlrpc.client.ServerProxy(node.uri) as proxy:
        client.sendall(shake(callerid=name))
        client.recv(1)
        until(lambda: any(name in line for line in proxy.getBusInfo('/test')[2]))
        with connect(node.tcp_port) as other:
            other.sendall(shake(callerid=name, md5sum='0' * 32))
            is_closed(other)
        line = warnings.next()
        assert f'Client [{name}] wants topic' in line
        assert line in screen()


def test_a_node_whose_screen_is_closed_refuses_as_before(node, warnings):
    """With rospy, it is an error of whoever logs; here that would be the thread that is to close
    the connection."""
    (screen,) = [
        handler
        for handler in node.latest_run.rospy._logging.getLogger('rosout').handlers
        if hasattr(handler, '_stderr')
    ]
    screen._stderr = io.StringIO()
    screen._stderr.close()
    with connect(node.tcp_port) as client:
        client.sendall(struct.pack('<I', 0))
        assert is_closed(client)
    assert 'no topic or service' in warnings.next()
    assert answers(node)


# -- service clients


def call_service(node, **fields):
    """A connection to the node's service, that has shaken hands."""
    client = connect(node.tcp_port)
    header = {'callerid': '/bad', 'service': '/clients/set', 'md5sum': '*', **fields}
    client.sendall(encode_ros_handshake_header(header))
    file = client.makefile('rb')
    assert b'error' not in file.read(*struct.unpack('<I', file.read(4)))
    return client


@pytest.mark.parametrize('persistent', ['0', '1'])
@pytest.mark.parametrize(
    'said, logged',
    [
        (struct.pack('<I', 0xFFFFFFFF), 'a message of 4294967295 bytes; the limit is'),
        (struct.pack('<I', 0), 'cannot deserialize'),
    ],
    ids=named,
)
def test_a_bad_request_of_a_service_ends_its_connection(
    master, node, warnings, said, logged, persistent
):
    """With rospy, it raises in a thread of its own and the connection stays open."""
    with call_service(node, persistent=persistent) as client:
        client.sendall(said)
        assert is_closed(client)
        line = warnings.next()
        assert logged in line
        assert line.startswith(f'service client {address_of(client)} refused: ')
    assert master.lookup_service('/clients/set').call(data=True).success
    assert warnings.empty()


def test_a_service_client_that_leaves_without_a_request_is_logged_once(node, warnings):
    with call_service(node) as client:
        address = address_of(client)
    assert warnings.next().startswith(f'service client {address} refused: unable to receive')
    assert warnings.empty()


def test_a_client_that_does_not_wait_for_its_answer_is_no_error(master, node, warnings):
    asked, left, served = threading.Event(), threading.Event(), threading.Event()

    def answer(request):
        asked.set()
        assert left.wait(TIMEOUT)
        served.set()
        return {'message': 'x' * 10000000}

    node.serve('/clients/slow', 'std_srvs/Trigger', answer)
    with call_service(node, service='/clients/slow') as client:
        # close() breaks off
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack('ii', 1, 0))
        client.sendall(struct.pack('<I', 0))
        assert asked.wait(TIMEOUT)
    left.set()
    assert served.wait(TIMEOUT)
    assert answers(node)
    assert warnings.empty()
    assert not node.errors


def test_service_clients_that_ask_nothing_keep_nobody_out(master, node, warnings):
    def ask():
        with call_service(node) as client:
            client.sendall(struct.pack('<I', 1) + b'\1')
            assert client.recv(1) == b'\1'
            return not warnings.empty()

    with contextlib.ExitStack() as clients:
        longest, *_ = [
            clients.enter_context(call_service(node)) for _ in range(acceptor.Limits.clients + 20)
        ]
        until(ask)
        assert '%d service clients say nothing' % acceptor.Limits.clients in warnings.next()
        assert is_closed(longest)


def test_a_publisher_that_announces_4_gib_is_left_and_found_again(master, mailbox, node, warnings):
    """With rospy, what was received stays in the buffer, and no later message of that connection is
    understood."""
    other = create(master, '/other')
    sent = other.output_channel('/clients/in', STRING)
    speak_tcpros_only(node)
    node.ros.Subscriber('/clients/in', STRING, lambda message: mailbox(message, None))
    for said, logged in (struct.pack('<I', 0xFFFFFFFF), '4294967295'), (
        struct.pack('<I', 0),
        'cannot deserialize',
    ):
        assert sent.wait_for_subscribers(1, TIMEOUT)
        fanout = other.latest_run.rospy.publisher('/clients/in').fanout
        (connection,) = fanout.connections
        connection.write_data(said)
        line = warnings.next()
        assert logged in line
        assert line.startswith(f'connection with {other.uri} for /clients/in closed: ')
        until(lambda: connection not in fanout.connections and sent.connections)
    sent.send(data='understood')
    assert mailbox.next().data == 'understood'


# -- XML-RPC


def call(method, *parameters):
    return xmlrpc.client.dumps(parameters, method).encode()


def post(body, head='POST / HTTP/1.1', length=None, more=''):
    length = len(body) if length is None else length
    return (f'{head}\r\nContent-Length: {length}\r\n{more}\r\n').encode() + body


PID = call('getPid', '/test')
LAUGHS = b'<!DOCTYPE a [<!ENTITY b "ha"><!ENTITY c "&b;&b;">]>' + call('getPid', 'x').replace(
    b'>x<', b'>&c;<'
)


@pytest.mark.parametrize(
    'said, logged',
    [
        (random.Random(1).randbytes(5000) + b'\r\n', 'code 4'),
        (b'\0' * 100000, 'code 414'),
        (shake(), 'code 400'),
        (b'POST / HTTP/1.1\r\nContent-Le', 'code 411'),
        (post(PID)[:-10], 'closed after %d of %d bytes' % (len(PID) - 10, len(PID))),
        (b'POST / HTTP/1.1\r\n\r\n' + PID, 'code 411'),
        (post(b'5\r\nabcde\r\n0\r\n\r\n', more='Transfer-Encoding: chunked\r\n'), 'code 411'),
        (post(PID, length=-1), 'code 411'),
        (post(PID, length='1e3'), 'code 411'),
        (post(PID, length=8 << 30), 'a request of 8589934592 bytes; the limit is'),
        (post(PID, length='9' * 5000), 'the limit is'),
        (post(PID, more='Content-Encoding: gzip\r\n'), 'code 415'),
        (post(PID, more=f"X: {'y' * 70000}\r\n"), 'code 431'),
        (post(PID, more='X: y\r\n' * 200), 'code 431'),
        (post(PID, head='GET / HTTP/1.1'), 'code 501'),
        (post(PID, head='POST /etc/passwd HTTP/1.1'), 'code 404'),
        (post(PID, head='POST / HTTP/7.1'), 'code 505'),
        (post(b''), 'no XML-RPC call: no element found'),
        (post(b'\xff\xfe garbage'), 'no XML-RPC call: '),
        (post(b'<a/>'), 'no XML-RPC call: '),
        (post(PID[:-5]), 'no XML-RPC call: '),
        (post(LAUGHS), 'no XML-RPC call: it has a document type'),
        (post(LAUGHS.decode().encode('utf-16')), 'no XML-RPC call: it has a document type'),
        (post(call('getPid', '/test').replace(b'/test', b'\x01')), 'no XML-RPC call: '),
        (post(call('nothing', '/test')), 'call of nothing: method "nothing" is not supported'),
        (post(call('_shutdown', '/test')), 'method "_shutdown" is not supported'),
        (post(call('reg_man.cleanup', '/test')), 'method "reg_man.cleanup" is not supported'),
        (post(call('reg_man', '/test')), 'not callable'),
        (post(call('no\nbody')), r'call of no\nbody: '),
        (post(call('n' * 100000)), 'nnn...'),
        (
            post(call('publisherUpdate', '/test', '/clients/in', ['http://a/'] * 2000)),
            '2000 publishers; the limit is',
        ),
        (
            post(call('system.multicall', [{'methodName': 'nothing', 'params': []}])),
            'call of nothing: ',
        ),
    ],
    ids=named,
)
def test_a_bad_call_is_refused_and_logged_once(node, warnings, said, logged):
    assert_refused_and_logged_once(node, node.xmlrpc_port, 'XML-RPC', warnings, said, logged)


# what ROS's slave API says to a call that does not suit it: as bare rospy, and no warning (rospy
# itself writes none)
SLAVE_API = {
    'getPid': (),
    'getBusStats': (),
    'getBusInfo': (),
    'getMasterUri': (),
    'getUri': (),
    'getName': (),
    'getSubscriptions': (),
    'getPublications': (),
    'shutdown': ('a reason',),
    'paramUpdate': ('/clients/parameter', 1),
    'publisherUpdate': ('/clients/none', []),
    'requestTopic': ('/clients/out', [['TCPROS']]),
}
WRONG_NUMBERS = [
    (method, arguments)
    for method, parameters in SLAVE_API.items()
    for right in [('/test', *parameters)]
    for arguments in [*(right[:n] for n in range(len(right))), (*right, 'one more')]
]


@pytest.mark.parametrize(
    'method, arguments, code, said',
    [
        *(
            (method, arguments, -1, 'caller_id' if not arguments else 'bad call arity')
            for method, arguments in WRONG_NUMBERS
        ),
        *(
            (method, (5, *parameters), -1, 'caller_id must be a string')
            for method, parameters in SLAVE_API.items()
        ),
        ('paramUpdate', ('/test', 7, 7), -1, 'parameter_key'),
        ('paramUpdate', ('/test', '', 7), -1, 'parameter_key'),
        ('paramUpdate', ('/test', 'no/namespace', 7), -1, 'parameter_key'),
        ('paramUpdate', ('/test', '/%s/{0}/../../etc/passwd\n', 1), -1, 'not subscribed'),
        ('paramUpdate', ('/test', '/' + 'a' * 1000000, {'': [1, {'b': {}}]}), -1, 'not subscribed'),
        ('requestTopic', ('/test', '/clients/none', [['TCPROS']]), -1, 'Not a publisher of'),
        ('requestTopic', ('/test', '/clients/out', []), -1, 'non-empty'),
        ('requestTopic', ('/test', '/clients/out', 5), -1, 'invalid arguments'),
        ('requestTopic', ('/test', '/clients/out', [[]]), 0, 'Internal failure: '),
        (
            'requestTopic',
            ('/test', '/clients/out', [['CARRIER-PIGEON']]),
            0,
            'no supported protocol',
        ),
        ('requestTopic', ('/test', {}, [['TCPROS']]), -1, 'ERROR'),
        ('publisherUpdate', ('/test', '/../../tmp/%s', ['http://127.0.0.1:1/']), 1, ''),
        ('publisherUpdate', ('/test', '/clients/in', 'http://127.0.0.1:1/'), -1, 'must be a list'),
        ('publisherUpdate', ('/test', '/clients/in', [5]), -1, 'must be a list of strings'),
        (
            'publisherUpdate',
            ('/test', '/clients/in', ['gopher']),
            -1,
            'does not contain valid URLs [gopher]',
        ),
        ('publisherUpdate', ('/test', '/clients/in', ['http://[']), 0, 'Invalid IPv6 URL'),
    ],
    ids=named,
)
def test_a_call_that_does_not_suit_the_slave_api_is_answered_and_no_warning(
    node, warnings, method, arguments, code, said
):
    with xmlrpc.client.ServerProxy(node.uri) as proxy:
        answer = getattr(proxy, method)(*arguments)
    assert answer[0] == code
    assert said in answer[1]
    assert len(answer) == 3
    assert answers(node)
    assert warnings.empty()


def test_a_parameter_update_for_no_parameter_is_told_to_nobody(node):
    told = Mailbox()
    node.parameter('/clients/watched').on_change(lambda value: told(value, None))
    with xmlrpc.client.ServerProxy(node.uri) as proxy:
        for key in '', 'clients/watched':
            assert proxy.paramUpdate('/test', key, 'bad')[0] == -1
        assert proxy.paramUpdate('/test', '/clients/watched', 'good') == [1, '', 0]
    assert told.next() == 'good'
    assert told.empty()


def test_a_flood_of_bad_clients_does_not_fill_the_log(node, warnings):
    limits(node).rejection_period = 3600
    with xmlrpc.client.ServerProxy(node.uri) as proxy:

        def refused():
            with contextlib.suppress(xmlrpc.client.Fault):
                proxy.nothing()

        for _ in range(acceptor.Limits.rejection_lines + 5):
            refused()
        assert all(
            'call of nothing' in line for line in warnings.take(acceptor.Limits.rejection_lines)
        )
        assert warnings.empty()
        limits(node).rejection_period = 0
        refused()
    assert 'and 5 more' in warnings.next()


def test_a_large_call_is_answered(node, warnings):
    with xmlrpc.client.ServerProxy(node.uri) as proxy:
        # not subscribed
        assert proxy.paramUpdate('/test', '/robot_description', 'x' * 1000000)[0] == -1
        assert proxy.getPid('/test')[0] == 1
    assert warnings.empty()


# -- all at once


def test_thousands_of_mutated_handshakes_and_calls_change_nothing(master, mailbox, node):
    seed = int(os.environ.get('PHAROS_FUZZ_SEED', 0)) or random.randrange(1, 1 << 32)
    node.delegate = mailbox
    node.interested_in('/clients/in', STRING)
    resting = len(threading.enumerate())
    clients = Fuzz(
        seed,
        topics=[('/clients/out', STRING._type, STRING._md5sum)],
        services=[('/clients/set', '*')],
    )
    try:
        clients.attack(node.tcp_port, node.xmlrpc_port, FUZZ_COUNT)
        assert answers(node)
        assert rosnode.rosnode_ping('/node', max_count=1)
        assert master.lookup_service('/clients/set').call(data=True).success
        create(master, '/sender').send_to('/clients/in', data='still there')
        assert mailbox.next().data == 'still there'
        assert not node.errors
        until(lambda: not threads(node, 'TCPROS') and len(threads(node, 'XML-RPC')) < 5)
        until(lambda: len(threading.enumerate()) < resting + 30)
    except Exception as error:
        raise AssertionError('after Fuzz(%d): PHAROS_FUZZ_SEED repeats it' % seed) from error


# -- who may stop a node

FAR = '192.0.2.7'  # of a range that no host has (RFC 5737)


@pytest.fixture
def far_client(monkeypatch):
    """XML-RPC calls seem to come from another host."""
    monkeypatch.setattr(xmlrpc_server, 'ends_of_call', lambda: (FAR, '192.0.2.1'))


def test_another_host_may_not_stop_a_node(node, warnings, far_client):
    with xmlrpc.client.ServerProxy(node.uri) as proxy:
        code, said, _ = proxy.shutdown('/intruder', 'go away')
        assert code == -1
        assert 'allow_remote_shutdown' in said
    line = warnings.next()
    assert 'XML-RPC client 127.0.0.1:' in line
    assert 'call of shutdown: only this host' in line
    assert answers(node)
    assert warnings.empty()


def test_nor_through_a_multicall_or_in_the_name_of_the_master(node, far_client):
    taken = '[/node] Reason: new node registered with same name'  # what a master says; this one knows better
    with xmlrpc.client.ServerProxy(node.uri) as proxy:
        ((answer,),) = proxy.system.multicall(
            [{'methodName': 'shutdown', 'params': ['/intruder', 'go away']}]
        )
        assert answer[0] == -1
        proxy.shutdown('/master', taken)
    assert answers(node)


def test_a_node_may_allow_it(master, far_client):
    class Trusting(BlockNode):
        allow_remote_shutdown = True

    node = master.create(Trusting, named='/trusting', domain='127.0.0.1')
    with xmlrpc.client.ServerProxy(node.uri) as proxy:
        assert proxy.shutdown('/friend', 'please')[0] == 1
    until(lambda: node.lifecycle.value == 'stopped')


def test_the_same_host_may_stop_a_node(master):
    node = create(master, '/obedient')
    with xmlrpc.client.ServerProxy(node.uri) as proxy:
        assert proxy.shutdown('/test', 'please')[0] == 1
    until(lambda: node.lifecycle.value == 'stopped')


def test_the_master_may_stop_a_node_whose_name_it_gave_away(master, far_client):
    """From wherever it calls: a host may have many addresses, but the master itself says whose the
    name is."""
    node = create(master, '/taken_over')
    master.api('/taken_over').registerPublisher(
        '/clients/taken', 'std_msgs/String', 'http://127.0.0.1:1/'
    )
    until(lambda: node.lifecycle.value == 'stopped')
    master.api('/taken_over').unregisterPublisher('/clients/taken', 'http://127.0.0.1:1/')


def test_a_service_that_is_for_nearby_callers_answers_them_alone(node, warnings, monkeypatch):
    node.serve(
        '/clients/near', 'std_srvs/Trigger', lambda request: (True, 'done'), only_nearby=True
    )
    caller = ['rosservice', 'call', '/clients/near']
    assert 'done' in run(node.master.url, *caller).stdout
    monkeypatch.setattr(xmlrpc_server, 'ends_of_call', lambda: (FAR, '192.0.2.1'))
    assert "for this host and the master's alone" in run(node.master.url, *caller).stderr
    assert "/clients/near is for this host and the master's alone: refused to /" in warnings.next()


@pytest.mark.parametrize(
    'ends, master_url, nearby',
    [
        ((FAR, '192.0.2.1'), 'http://127.0.0.1:11311/', False),
        ((FAR, '192.0.2.1'), f'http://{FAR}:11311/', True),
        ((FAR, FAR), 'http://127.0.0.1:11311/', True),
        (('127.0.0.2', '127.0.0.1'), 'http://192.0.2.9:11311/', True),
        (('::1', '::1'), 'http://192.0.2.9:11311/', True),
        (('fe80::1', 'fe80::2'), 'http://localhost:11311/', False),
        ((FAR, '192.0.2.1'), 'http://no.such.host.invalid:11311/', False),
    ],
)
def test_who_calls_from_nearby(monkeypatch, ends, master_url, nearby):
    monkeypatch.setattr(xmlrpc_server, 'ends_of_call', lambda: ends)
    assert xmlrpc_server.is_call_from_nearby(master_url) is nearby
