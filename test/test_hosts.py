"""Several hosts: the addresses of nodes, who may come in, and links that fail; as root, with
network namespaces."""
import contextlib
import os
import signal
import socket
import sys
import threading
import xmlrpc.server

import pytest
import rosgraph
import rosgraph.network
from std_msgs.msg import Int32
from catkin.find_in_workspaces import find_in_workspaces

from helpers import InProcessMaster, create
from pharos.testing import TIMEOUT, until
import pharos
from hosts import MASTER_PORT, network
from pharos.private_rospy import registration
from programs import ROOT, script
from sockets import listening, refused_url

STRING = 'std_msgs/String'
#: seconds that a cut goes on once it has been noticed; where it is set, the package's own time
#: limits hold
CUT = float(os.environ.get('PHAROS_TEST_CUT', 0))


@pytest.fixture(scope='module')
def hosts():
    """Hosts one, two and three."""
    with network('one', 'two', 'three') as found:
        yield found


@pytest.fixture
def programs():
    """Programs given to this are killed at the end of the test: they leave nothing, for their
    master goes too."""
    with contextlib.ExitStack() as running:

        def keep(program):
            running.callback(program.end, signal.SIGKILL)
            return program

        yield keep


@pytest.fixture
def one(hosts, programs, tmp_path):
    """Host one, where the ROS master is."""
    host = hosts[0]
    master = programs(
        host.start(host, 'rosmaster', '--core', '-p', str(MASTER_PORT), ROS_LOG_DIR=str(tmp_path))
    )
    until(lambda: MASTER_PORT in {port for _, port in listening(master.process.pid)})
    return host


@pytest.fixture
def two(hosts):
    return hosts[1]


@pytest.fixture
def three(hosts):
    return hosts[2]


# -- messages and calls

PHAROS = '''
from pharos import BlockNode, Master, Transcript, spin

node = Master().wait(20).create(BlockNode, named='/pharos')
answers = node.output_channel('/pharos/answer', 'std_msgs/String')
node.interested_in('/pharos/question', answers.type, lambda message, channel: answers.publish(message))
node.serve('/pharos/who', 'std_srvs/Trigger', lambda request: {'success': True, 'message': 'a pharos node'})
Transcript.show('ready')
spin()
'''

ROSPY = '''
import rospy
from std_msgs.msg import String
from std_srvs.srv import Trigger

rospy.init_node('rospy')
answers = rospy.Publisher('/rospy/answer', String, queue_size=10)
rospy.Subscriber('/rospy/question', String, answers.publish)
rospy.Service('/rospy/who', Trigger, lambda request: (True, 'a rospy node'))
print('ready')
rospy.spin()
'''

ASKING = '''
import queue
import sys
from pharos import BlockNode, Master, Transcript

master, peer = Master().wait(20), sys.argv[1]
with master.create(BlockNode, named='/asking') as node:
    answers = queue.SimpleQueue()
    heard = node.interested_in('/%s/answer' % peer, 'std_msgs/String', lambda message, channel: answers.put(message))
    asked = node.output_channel('/%s/question' % peer, 'std_msgs/String')
    while answers.empty():    # relay advertises only with its first message, which so is lost
        asked.wait_for_subscribers(1, 20)
        asked.send(data='hello')
        node.sleep(0.05)
    Transcript.show(answers.get().data, asked.connections, heard.connections)
    Transcript.show(master.lookup_service(sys.argv[2], caller_id='/asking').call(timeout=20))
'''


def relay():
    """The path of a ROS program in C++ that passes messages on."""
    (folder,) = find_in_workspaces(['libexec'], project='topic_tools')
    return os.path.join(folder, 'relay')


@pytest.mark.parametrize(
    'peer, service, said',
    [
        ('pharos', '/pharos/who', 'a pharos node'),
        ('rospy', '/rospy/who', 'a rospy node'),
        ('roscpp', '/roscpp/get_loggers', 'ros.roscpp'),
    ],
)
def test_a_node_talks_with_one_of_another_host(one, two, three, programs, peer, service, said):
    if peer == 'roscpp':
        programs(two.start(one, relay(), '/roscpp/question', '/roscpp/answer', '__name:=roscpp'))
    else:
        programs(two.python(one, {'pharos': PHAROS, 'rospy': ROSPY}[peer])).wait_for('ready')
    asking = programs(three.python(one, ASKING, peer, service))
    link = [('/' + peer, 'TCPROS')]
    assert asking.wait_for('hello') == f'hello {link} {link}\n'
    assert said in asking.read_to_the_end()


def test_rospys_tools_talk_with_a_node_of_another_host(one, two, three, programs):
    programs(two.python(one, PHAROS)).wait_for('ready')
    assert (
        'a pharos node'
        in programs(three.start(one, 'rosservice', 'call', '/pharos/who')).read_to_the_end()
    )
    assert (
        'xmlrpc reply'
        in programs(three.start(one, 'rosnode', 'ping', '-c', '1', '/pharos')).read_to_the_end()
    )
    echo = programs(three.start(one, 'rostopic', 'echo', '/pharos/answer'))
    programs(
        three.start(
            one, 'rostopic', 'pub', '-r', '20', '/pharos/question', STRING, 'data: there and back'
        )
    )
    assert echo.wait_for('there and back')


def test_only_its_own_host_and_the_masters_have_a_program_loaded(one, two, three, programs):
    path = str(ROOT / 'test' / 'programs') + ':/usr/share'
    program = programs(two.start(one, sys.executable, script('compose'), ROS_PACKAGE_PATH=path))
    call = 'rosservice', 'call', '--wait', '/compose/load_nodelet'
    for host, said in (
        (three, "for this host and the master's alone"),
        (two, 'success: True'),
        (one, 'success: True'),
    ):
        request = f'{{name: /at_{host.name}, type: composed_robot/talker}}'
        assert said in programs(host.start(one, *call, request)).read_to_the_end()
    assert program.end() == 0


# -- addresses

ADDRESSED = '''
import sys
from pharos import BlockNode, Master, Transcript, spin

node = Master().wait(20).create(BlockNode, named='/addressed', domain=sys.argv[1])
node.output_channel('/t', 'std_msgs/String', latch=True).send(data='found')
node.interested_in('/u', 'std_msgs/String')
node.serve('/s', 'std_srvs/Empty', lambda request: None)
node.parameter('~p', 1).on_change(print)
Transcript.show('ports', node.xmlrpc_port, node.tcp_port)
spin()
'''

ADVERTISED = '''
import rosgraph
import rosgraph.network
from xmlrpc.client import ServerProxy

master = rosgraph.Master('/test')
uri = master.lookupNode('/addressed')
print(uri)
print(*ServerProxy(uri).requestTopic('/test', '/t', [['TCPROS']])[2])
print(master.lookupService('/s'))
'''

CONNECTING = '''
import socket
import sys

for port in sys.argv[2:]:
    try:
        socket.create_connection((sys.argv[1], int(port)), 20).close()
        print('connected')
    except OSError as error:
        print(type(error).__name__)
'''


def ports_of(program):
    """The XML-RPC and the TCPROS port that it says it has."""
    return program.wait_for('ports').split()[1:]


@pytest.mark.parametrize('is_name', [False, True], ids=['address', 'name'])
def test_the_domain_is_advertised_as_given(one, two, three, programs, is_name):
    domain = two.domain if is_name else two.address
    program = programs(
        two.python(one, ADDRESSED, domain, ROS_HOSTNAME='elsewhere.test', ROS_IP=three.address)
    )
    xmlrpc_port, tcp_port = ports_of(program)
    assert programs(three.python(one, ADVERTISED)).read_to_the_end().splitlines() == [
        f'http://{domain}:{xmlrpc_port}/',
        f'TCPROS {domain} {tcp_port}',
        f'rosrpc://{domain}:{tcp_port}',
    ]
    assert (
        'found' in programs(three.start(one, 'rostopic', 'echo', '-n', '1', '/t')).read_to_the_end()
    )


def test_a_loopback_domain_is_reached_from_its_own_host_alone(one, two, three, programs):
    """rospy listens on all interfaces unless the whole process is told otherwise (ros_comm
    #315)."""
    program = programs(two.python(one, ADDRESSED, '127.0.0.1'))
    ports = ports_of(program)
    assert {('127.0.0.1', int(port)) for port in ports} == listening(program.process.pid)
    assert (
        programs(two.python(one, CONNECTING, '127.0.0.1', *ports)).read_to_the_end()
        == 'connected\n' * 2
    )
    assert programs(three.python(one, CONNECTING, two.address, *ports)).read_to_the_end() == (
        'ConnectionRefusedError\n' * 2
    )
    assert (
        'found' in programs(two.start(one, 'rostopic', 'echo', '-n', '1', '/t')).read_to_the_end()
    )


def test_an_address_is_reached_from_other_hosts(one, two, three, programs):
    """So that what refuses a connection above is the domain."""
    ports = ports_of(programs(two.python(one, ADDRESSED, two.address)))
    assert (
        programs(three.python(one, CONNECTING, two.address, *ports)).read_to_the_end()
        == 'connected\n' * 2
    )


# -- links that fail

IMPATIENT = (
    ''
    if CUT
    else '''
from pharos.private_rospy import lifetime, registration
lifetime.KEEPALIVE_IDLE = lifetime.KEEPALIVE_INTERVAL = lifetime.KEEPALIVE_COUNT = 1
registration.RETRY_DELAY = 0.2
'''
)

SPEAKING = (
    IMPATIENT
    + '''
from pharos import BlockNode, Master, Transcript

node = Master().wait(20).create(BlockNode, named='/pharos')
latched = node.output_channel('/latched/pharos', 'std_msgs/String', latch=True)
latched.send(data='kept')
chat = node.output_channel('/chat/pharos', 'std_msgs/String')
Transcript.show('ready')
before = []
for _ in node.every(0.05):
    chat.send(data='x')
    if latched.connections != before:
        before = latched.connections
        Transcript.show('told', before)
'''
)

LISTENING = (
    IMPATIENT
    + '''
import sys
from pharos import BlockNode, Master, Transcript
from pharos.watcher import watcher_of

master = Master().wait(20)
node = master.create(BlockNode, named='/listening')
node.delegate = lambda message, channel: Transcript.show('heard', channel.topic)
channels = [node.interested_in(topic, 'std_msgs/String') for topic in sys.argv[1:]]
watched = {channel.topic: (lambda channel=channel: channel.connections) for channel in channels}
watched['the master'] = lambda: watcher_of(master).reachable_since
before = {}
for _ in node.every(0.05):
    now = {name: bool(value()) for name, value in watched.items()}
    for name in now:
        if now[name] != before.get(name, False):
            Transcript.show('found' if now[name] else 'lost', name)
    before = now
'''
)


def wait_for_each(program, *texts):
    """Wait for lines with these texts, in whatever order."""
    since = len(program.printed)
    for text in texts:
        if not any(text in line for line in program.printed[since:]):
            program.wait_for(text)


@contextlib.contextmanager
def cut(host):
    """Its link is down, for CUT seconds before what happens within."""
    host.link('down')
    try:
        threading.Event().wait(CUT)
        yield
    finally:
        host.link('up')


def test_links_come_back_after_a_silent_loss_however_long(one, two, three, programs):
    """rospy's subscriber notices it after 150 s and lets the link go for good (ros_comm #851), its
    publisher never."""
    topics = '/chat/pharos', '/chat/rospy', '/latched/pharos', '/latched/rospy'
    speaking = programs(two.python(one, SPEAKING))
    programs(two.start(one, 'rostopic', 'pub', '-r', '20', '/chat/rospy', STRING, 'data: x'))
    programs(two.start(one, 'rostopic', 'pub', '/latched/rospy', STRING, 'data: x'))
    listening = programs(three.python(one, LISTENING, *topics))
    wait_for_each(listening, *('heard ' + topic for topic in topics))
    with cut(three):
        wait_for_each(listening, *('lost ' + topic for topic in topics))
        speaking.wait_for('told []')
    wait_for_each(listening, *('heard ' + topic for topic in topics))


def test_a_publisher_that_came_during_a_cut_is_found_after_it(one, two, three, programs, tmp_path):
    """The master tells of it once; rospy, which did not hear that, never connects."""
    programs(two.python(one, SPEAKING)).wait_for('ready')
    # it hears of that one when it registers, so that the master has no connection to it that would
    # wait out the cut
    listening = programs(three.python(one, LISTENING, '/chat/pharos', '/late'))
    wait_for_each(listening, 'heard /chat/pharos', 'found the master')
    with cut(three):
        programs(two.start(one, 'rostopic', 'pub', '-r', '20', '/late', STRING, 'data: x'))
        one.forget_neighbours()  # so that it fails at once
        until(lambda: 'publisherUpdate[/late]' in failures(tmp_path / 'master.log'))
        listening.wait_for('lost the master')
    listening.wait_for('heard /late')


def failures(log):
    """The lines of a rosmaster's log that tell of calls that failed."""
    return ''.join(line for line in log.read_text().splitlines() if 'exception=' in line)


CALLING = (
    IMPATIENT
    + '''
import sys
from pharos import Master, ServiceCallError, Transcript

try:
    Master().lookup_service('/slow').call()
except ServiceCallError as error:
    Transcript.show('the call ended:', error)
'''
)

SLOW = '''
from pharos import BlockNode, Master, Transcript, spin

node = Master().create(BlockNode, named='/slow_one')

def serve(request):
    Transcript.show('called')
    node.sleep(3600)

node.serve('/slow', 'std_srvs/Empty', serve)
Transcript.show('ready')
spin()
'''


def test_a_service_call_ends_when_its_provider_vanishes(one, two, three, programs):
    """With rospy it lasts for ever, for it has no time limit and nothing asks whether the provider
    is there."""
    slow = programs(two.python(one, SLOW))
    slow.wait_for('ready')
    calling = programs(three.python(one, CALLING))
    slow.wait_for('called')
    with cut(three):
        assert 'broke' in calling.wait_for('the call ended:')


# -- publishers out of reach, of one host


class Stranger:
    """What a publisher seems to be to the master and to subscribers, but is not.

    :param ports: that it names to subscribers as its TCPROS port, one at each request, and the last
        from then on; None: it closes the connection instead
    """

    def __init__(self, master, topic, *ports):
        self._ports, self.asked = list(ports), threading.Semaphore(0)
        self._server = xmlrpc.server.SimpleXMLRPCServer(('127.0.0.1', 0), logRequests=False)
        self._server.handle_error = lambda request, address: None
        self._server.register_function(self._request_topic, 'requestTopic')
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.01,))
        self._thread.start()
        self.uri = 'http://127.0.0.1:%d/' % self._server.server_address[1]
        self._topic, self._name = topic, '/stranger_%d' % self._server.server_address[1]
        self._master = rosgraph.Master(self._name, master_uri=master.url)
        self._master.handle.registerPublisher(self._name, topic, STRING, self.uri)

    def _request_topic(self, *_):
        self.asked.release()
        port = self._ports.pop(0) if len(self._ports) > 1 else self._ports[0]
        if port is None:
            raise SystemExit  # passes xmlrpc.server by, and its connection is closed
        return 1, '', ['TCPROS', '127.0.0.1', port]

    def unregister(self):
        self._master.handle.unregisterPublisher(self._name, self._topic, self.uri)

    def end(self):
        self.unregister()
        self._server.shutdown()
        self._thread.join(TIMEOUT)
        self._server.server_close()


@pytest.fixture
def stranger(master):
    """``stranger(topic, *ports)`` -> a Stranger, gone at the end."""
    with contextlib.ExitStack() as ends:

        def make(*arguments):
            found = Stranger(master, *arguments)
            ends.callback(found.end)
            return found

        yield make


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(registration, 'RETRY_DELAY', 0.01)


@pytest.fixture
def speaker():
    """A node at a master of its own, so that others find the way to it by their own wits."""
    ros_master = InProcessMaster()
    node = create(pharos.Master(ros_master.url), '/speaker')
    yield node
    node.stop()
    ros_master.stop()


def test_a_publisher_whose_port_cannot_be_reached_yet_is_tried_again(
    master, mailbox, impatient, stranger, speaker
):
    """As when a link comes back for one connection, and is lost before the next; rospy then gives
    up."""
    speaker.output_channel('/hosts/seldom', STRING, latch=True).send(data='reached')
    closed = int(refused_url().rsplit(':', 1)[1].strip('/'))
    stranger('/hosts/seldom', None, closed, None, closed, closed, speaker.tcp_port)
    create(master, '/listener', delegate=mailbox).interested_in('/hosts/seldom', STRING)
    assert mailbox.next().data == 'reached'


def test_a_publisher_is_tried_no_longer_than_the_master_knows_it(master, impatient, stranger):
    """rospy tries for ever, once in half a minute, in a thread for each."""
    node = create(master, '/listener')
    channels = [node.interested_in(topic, STRING) for topic in ('/hosts/gone', '/hosts/not_wanted')]
    gone, not_wanted = stranger('/hosts/gone', None), stranger('/hosts/not_wanted', None)
    for found in gone, not_wanted:
        for _ in range(5):
            assert found.asked.acquire(timeout=TIMEOUT)
    assert len(threads('/listener connecting')) == 2
    gone.unregister()
    until(lambda: len(threads('/listener connecting')) == 1)
    channels[1].close()
    until(lambda: not threads('/listener connecting'))


def threads(name):
    """The threads of this process with that in their names."""
    return [thread for thread in threading.enumerate() if name in thread.name]


def test_a_publisher_that_refuses_is_asked_once(master, impatient, stranger):
    """It would refuse again: the type is another."""
    with socket.create_server(('127.0.0.1', 0)) as server:
        server.settimeout(TIMEOUT)
        asked = stranger('/hosts/refused', server.getsockname()[1]).asked
        create(master, '/listener').interested_in('/hosts/refused', STRING)
        connection, _ = server.accept()
        with connection:
            connection.settimeout(TIMEOUT)
            rosgraph.network.write_ros_handshake_header(
                connection, {'error': 'topic types do not match'}
            )
            while connection.recv(4096):  # its handshake, and then that it closes
                pass
        connection, _ = server.accept()  # the question what it publishes
        with connection:
            rosgraph.network.write_ros_handshake_header(
                connection,
                {
                    'callerid': '/stranger',
                    'type': Int32._type,
                    'md5sum': Int32._md5sum,
                    'message_definition': Int32._full_text,
                },
            )
            connection.recv(4096)
    until(lambda: not threads('/hosts/refused'))
    assert asked.acquire(blocking=False)
    assert not threads('reconnect')
    assert not asked.acquire(blocking=False)


def test_a_publisher_that_refuses_for_another_reason_is_tried_again(
    master, mailbox, impatient, stranger, speaker
):
    """It may have been about to end, or to begin."""
    speaker.output_channel('/hosts/refused_once', STRING, latch=True).send(data='reached')
    with socket.create_server(('127.0.0.1', 0)) as server:
        server.settimeout(TIMEOUT)
        stranger('/hosts/refused_once', server.getsockname()[1], speaker.tcp_port)
        create(master, '/listener', delegate=mailbox).interested_in('/hosts/refused_once', STRING)
        for _ in range(2):  # of the second, it asks what it publishes
            connection, _ = server.accept()
            with connection:
                connection.settimeout(TIMEOUT)
                rosgraph.network.write_ros_handshake_header(connection, {'error': 'not now'})
                while connection.recv(4096):
                    pass
        assert mailbox.next().data == 'reached'


@pytest.mark.parametrize('hangs', ['before it is asked', 'before it shakes hands'])
@pytest.mark.parametrize('shares', [False, True], ids=['alone', 'sharing'])
def test_a_stop_does_not_wait_for_a_publisher_that_hangs(
    master, stranger, transcript, hangs, shares, ros_master
):
    node = create(pharos.Master(ros_master.url, share_connections=shares), '/listener')
    with contextlib.ExitStack() as ends:
        silent = ends.enter_context(socket.create_server(('127.0.0.1', 0)))
        port = silent.getsockname()[1]
        if hangs == 'before it is asked':
            uri = f'http://127.0.0.1:{port}/'
            api = rosgraph.Master('/stranger', master_uri=ros_master.url).handle
            api.registerPublisher('/stranger', '/hosts/hangs', STRING, uri)
            ends.callback(api.unregisterPublisher, '/stranger', '/hosts/hangs', uri)
        else:
            stranger('/hosts/hangs', port)
        node.interested_in('/hosts/hangs', STRING)
        silent.settimeout(TIMEOUT)
        ends.enter_context(silent.accept()[0])
        node.stop()
        assert not [line for line in transcript if 'left behind' in line]


# -- a look at all of them

LOOKING = '''
import sys, time
from pharos import Master
from pharos.live import snapshot

master = Master().wait(20)
for name in sys.argv[1:]:
    master.wait_for_node(name, 20)
seen = snapshot.take(master)
print('hosts', [(host.name, host.is_here, [process.nodes for process in host.processes]) for host in seen.hosts])
print('states', {name: node.state for name, node in seen.nodes.items()})
print('seconds', round(time.time() - seen.time))
'''


def test_a_look_at_the_graph_tells_hosts_apart_and_waits_for_none_that_is_gone(one, two, programs):
    programs(one.python(one, PHAROS)).wait_for('ready')
    programs(two.start(one, relay(), '/looked_at', '__name:=roscpp'))
    looking = programs(one.python(one, LOOKING, '/pharos', '/roscpp'))
    hosts = [(socket.gethostname(), True, [['/pharos']]), (two.address, False, [['/roscpp']])]
    assert looking.wait_for('hosts') == f'hosts {hosts}\n'
    assert looking.wait_for('states') == "states {'/pharos': 'alive', '/roscpp': 'alive'}\n"
    with cut(two):
        looking = programs(one.python(one, LOOKING))
        assert looking.wait_for('hosts') == f'hosts {hosts}\n'
        assert looking.wait_for('states') == "states {'/pharos': 'alive', '/roscpp': 'silent'}\n"
        assert looking.wait_for('seconds') in ('seconds 1\n', 'seconds 2\n')
