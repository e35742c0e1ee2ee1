"""Several masters in one process, and the bridge between two."""
import re
import signal
import socket
import threading

import numpy
import pytest

from helpers import InProcessMaster, create
from pharos.testing import Mailbox, TIMEOUT
import pharos
from pharos import Master
from pharos.private_rospy import addresses
from programs import Program, run, script
from sockets import refused_url

STRING = 'std_msgs/String'


@pytest.fixture
def masters():
    """Two masters, as of two robots."""
    both = InProcessMaster(), InProcessMaster()
    yield [Master(ros_master.url) for ros_master in both]
    pharos.node_registry.stop_all()
    for ros_master in both:
        ros_master.stop()


def listen(master, topic, type_=STRING, name='/listener'):
    mailbox = Mailbox()
    create(master, name, delegate=mailbox).interested_in(topic, type_)
    return mailbox


# -- side by side


def test_nodes_of_one_name_live_on_two_masters(masters):
    nodes = [create(master, '/same') for master in masters]
    for master, node in zip(masters, nodes):
        assert master.nodes() == [node]
        assert master.node('/same') is node
        assert master.local_nodes() == [node]
        assert run(master.url, 'rosnode', 'list').stdout == '/same\n'
        assert node.uri in run(master.url, 'rosnode', 'info', '/same').stdout
    nodes[0].stop()
    assert masters[0].nodes() == []
    assert masters[1].nodes() == [nodes[1]]


def test_topics_services_and_parameters_of_two_masters_do_not_mix(masters):
    one, two = masters
    heard = [listen(master, '/t') for master in masters]
    for master, text in (one, 'of one'), (two, 'of two'):
        node = create(master, '/speaker')
        node.serve(
            '/who',
            'std_srvs/Trigger',
            lambda request, text=text: {'success': True, 'message': text},
        )
        node.parameter('~text', initialized=text)
        node.send_to('/t', data=text)
    assert [mailbox.next().data for mailbox in heard] == ['of one', 'of two']
    assert [master.lookup_service('/who').call().message for master in masters] == [
        'of one',
        'of two',
    ]
    assert [master.parameters['/speaker/text'] for master in masters] == ['of one', 'of two']
    assert all(mailbox.empty() for mailbox in heard)
    assert len(one.topic('/t').channels) == 2 == len(two.topic('/t').channels)


def test_each_master_has_rospy_peers_of_its_own(masters):
    heard = [listen(master, '/t') for master in masters]
    with Program(masters[0].url, 'rostopic', 'pub', '/t', STRING, 'data: one'), Program(
        masters[1].url, 'rostopic', 'pub', '/t', STRING, 'data: two'
    ):
        assert [mailbox.next().data for mailbox in heard] == ['one', 'two']


def test_a_master_that_goes_away_leaves_the_nodes_of_another_alone(masters, mailbox):
    with Master.embedded() as third:
        node = create(third, '/n')
        listener = create(masters[0], '/n', delegate=mailbox)
        listener.interested_in('/t', STRING)
    assert not node.is_running
    assert listener.is_running
    create(masters[0], '/speaker').send_to('/t', data='still here')
    assert mailbox.next().data == 'still here'


def test_a_block_joins_two_masters(masters):
    """The five lines that `bridge --help` shows."""
    heard = listen(masters[1], '/map')
    speaker = create(masters[0], '/speaker')
    sent = speaker.output_channel('/map', STRING)
    lines = [
        line.strip() for line in run(masters[0].url, script('bridge'), '--help').stdout.splitlines()
    ]
    start = next(number for number, line in enumerate(lines) if line.startswith('a = Master'))
    code = '\n'.join(lines[start : start + 4])
    assert lines[start + 4 : start + 6] == ['spin()', '']
    for old, new in (
        ('http://robot-a:11311/', masters[0].url),
        ('http://robot-b:11311/', masters[1].url),
        ('nav_msgs/OccupancyGrid', STRING),
    ):
        assert old in code
        code = code.replace(old, new)
    exec(code, vars(pharos).copy())
    assert sent.wait_for_subscribers(1, TIMEOUT)
    for number in range(100):
        sent.send(data=str(number))
    assert [message.data for message in heard.take(100)] == [str(number) for number in range(100)]


# -- one master, spelt in several ways


@pytest.fixture
def spellings(master):
    """The session's master, as given and by another name of its address."""
    return master, Master(master.url.replace('127.0.0.1', 'LocalHost').rstrip('/'))


def test_masters_of_one_address_are_one(spellings):
    given, other = spellings
    assert given == other
    assert hash(given) == hash(other)
    assert len({given, other}) == 1
    assert other.url == given.url.replace('127.0.0.1', 'localhost')
    assert given.topic('/t') == other.topic('/t')
    assert len({given.topic('/t'), other.topic('/t')}) == 1
    assert pharos.ExternalNode(given, '/n') == pharos.ExternalNode(other, '/n')
    node = create(given, '/own')
    assert other.node('/own') is node
    assert other.local_nodes() == [node]
    assert other.wait_for_node('/own', TIMEOUT) is node
    assert other.nodes() == [node]
    assert pharos.watcher.watcher_of(given) is pharos.watcher.watcher_of(other)


def test_an_address_that_is_any_of_this_host_is_this_hosts(master):
    everywhere = Master(master.url.replace('127.0.0.1', '0.0.0.0'))
    assert everywhere == master
    node = create(master, '/own')
    assert everywhere.node('/own') is node


@pytest.mark.parametrize('url', ['', 'robot1', 'http://robot1/'])
def test_the_variable_that_gives_no_masters_url_is_named(monkeypatch, url):
    monkeypatch.setenv('ROS_MASTER_URI', url)
    with pytest.raises(
        ValueError, match=f"^ROS_MASTER_URI is '{url}', which is not the URL of a ROS master"
    ):
        Master()


def test_nodes_at_one_master_are_neighbours_however_it_is_spelt(spellings):
    given, other = spellings
    heard = listen(given, '/spelt')
    speaker = create(other, '/speaker')
    speaker.serve('/spelt', 'std_srvs/Empty', lambda request: None)
    channel = speaker.output_channel('/spelt', STRING)
    channel.send(data='next door', to=given.node('/listener'))
    assert heard.next().data == 'next door'
    assert channel.connections == [('/listener', 'INTRAPROCESS')]
    assert other.topic('/spelt').channels == given.topic('/spelt').channels != []


def test_an_embedded_master_stops_the_nodes_that_spell_it_otherwise():
    with Master.embedded() as embedded:
        node = create(Master(embedded.url.replace('127.0.0.1', 'localhost')), '/n')
    assert not node.is_running


@pytest.mark.parametrize(
    'one, other, are_one',
    [
        ('http://127.0.0.1:11311', 'HTTP://127.0.0.1:011311/', True),
        ('http://localhost:11311', 'http://127.0.0.1:11311', True),
        ('http://me:11311', 'http://localhost:11311', True),
        ('http://me:11311', 'http://ME:11311', True),
        ('http://me:11311', 'http://10.0.0.1:11311', True),
        ('http://robot:11311', 'http://10.0.0.2:11311', True),
        ('http://robot:11311', 'http://me:11311', False),
        ('http://127.0.0.2:11311', 'http://127.0.0.1:11311', False),
        ('http://127.0.0.1:11311', 'http://127.0.0.1:11312', False),
        ('http://nowhere:11311', 'http://nowhere:11311', True),
        ('http://nowhere:11311', 'http://127.0.0.1:11311', False),
    ],
)
def test_which_urls_mean_one_address(monkeypatch, one, other, are_one):
    """On a host called me, as Debian sets one up, with a robot beside it."""
    looked_up = []
    known = {'me': '127.0.1.1', 'localhost': '127.0.0.1', 'robot': '10.0.0.2'}

    def getaddrinfo(host, *_, **__):
        looked_up.append(host)
        if host == 'nowhere':
            raise socket.gaierror('Name or service not known')
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, '', (known.get(host, host), 0))]

    addresses._of_master.cache_clear()
    monkeypatch.setattr(addresses.socket, 'getaddrinfo', getaddrinfo)
    monkeypatch.setattr(addresses.socket, 'gethostname', lambda: 'me')
    monkeypatch.setattr(
        addresses.rosgraph.network, 'get_local_addresses', lambda: ['127.0.0.1', '10.0.0.1']
    )
    try:
        one, other = Master(one), Master(other)
        assert {one: 1} and not looked_up  # neither by making one nor by keeping one
        assert (one == other, other == one) == (are_one, are_one)
        assert len({one, other}) == (1 if are_one else 2)
    finally:
        addresses._of_master.cache_clear()


def test_a_master_at_a_host_that_does_not_resolve_is_unreachable():
    with pytest.raises(
        pharos.MasterUnreachableError, match='http://nowhere.invalid:11311/ .*not known'
    ):
        create(Master('http://nowhere.invalid:11311'), '/n')


# -- the script


def bridge(masters, *arguments, wait_for=None):
    program = Program(
        masters[0].url, script('bridge'), *(master.url for master in masters), *arguments
    )
    for topic in wait_for or ():
        program.wait_for(f'{topic} (')
    return program


def test_the_bridge_passes_messages_both_ways_without_echo(masters):
    heard = [listen(master, '/chat') for master in masters]
    speakers = [create(master, '/speaker').output_channel('/chat', STRING) for master in masters]
    with bridge(masters, '/chat', wait_for=['/chat']):
        for speaker in speakers:
            assert speaker.wait_for_subscribers(2, TIMEOUT)
        for number in range(100):
            for side, speaker in zip('ab', speakers):
                speaker.send(data='%s%d' % (side, number))
        for mailbox in heard:
            told = [message.data for message in mailbox.take(200)]
            for side in 'ab':
                assert [text for text in told if text[0] == side] == [
                    '%s%d' % (side, i) for i in range(100)
                ]
        # what echoed would come before what is sent after it
        for speaker in speakers:
            speaker.send(data='end')
        for mailbox in heard:
            assert [message.data for message in mailbox.take(2)] == [
                'end',
                'end',
            ]
            assert mailbox.empty()


def test_the_bridge_joins_rospys_nodes(masters):
    one, two = (master.url for master in masters)
    with bridge(masters, '/t'), Program(two, 'rostopic', 'echo', '/t') as echo, Program(
        one, 'rostopic', 'pub', '-r', '20', '/t', STRING, 'data: across'
    ):
        assert echo.wait_for('across')
    with Program(one, 'rostopic', 'echo', '/back') as echo, bridge(masters, '/back'), Program(
        two, 'rostopic', 'pub', '-r', '20', '/back', STRING, 'data: and back'
    ):
        assert echo.wait_for('and back')


def test_the_type_is_found_on_whichever_side_names_it_first(masters):
    with bridge(masters, '/a_first', '/b_first', '/later') as program:
        heard = [
            listen(masters[1], '/a_first', 'geometry_msgs/Twist'),
            listen(masters[0], '/b_first', 'sensor_msgs/LaserScan', name='/second'),
        ]
        line = program.wait_for('/b_first (')
        assert 'sensor_msgs/LaserScan' in line + ''.join(program.printed)
        first, second = create(masters[0], '/one'), create(masters[1], '/two')
        wait_for_subscriber(masters[0], '/a_first')
        first.send_to('/a_first', linear={'x': 2})  # the first message is not lost on the way
        second.send_to('/b_first', ranges=[1, 2])
        assert (heard[0].next().linear.x, heard[1].next().ranges) == (2, (1, 2))
        listen(masters[1], '/later', name='/third')
        assert STRING in program.wait_for('/later (')


def wait_for_subscriber(master, topic):
    while not master.topic(topic).subscribers:
        threading.Event().wait(0.01)  # another process: the master is all there is to ask


def test_a_latched_message_is_latched_on_the_other_side(masters):
    create(masters[0], '/map_server').output_channel('/map', STRING, latch=True).send(
        data='the map'
    )
    first = listen(masters[1], '/map')
    with bridge(masters, '/map'):
        assert first.next().data == 'the map'
        assert listen(masters[1], '/map', name='/late').next().data == 'the map'


def test_two_bridges_to_one_robot_have_names_of_their_own(masters):
    heard = listen(masters[1], '/one'), listen(masters[1], '/two', name='/other')
    with bridge(masters, '/one', wait_for=['/one']), bridge(
        masters, '/two', '__name:=second', wait_for=['/two']
    ):
        assert {'/bridge', '/second'} <= {node.name for node in masters[0].nodes()}
        speaker = create(masters[0], '/speaker')
        speaker.send_to('/one', data='1')
        speaker.send_to('/two', data='2')
        assert [mailbox.next().data for mailbox in heard] == ['1', '2']


@pytest.mark.parametrize('with_signal', [signal.SIGINT, signal.SIGTERM])
def test_the_bridge_ends_when_it_is_told(masters, with_signal):
    listen(masters[0], '/t')
    program = bridge(masters, '/t', '/unknown', wait_for=['/t'])
    assert program.end(with_signal) == 0
    assert 'Traceback' not in program.read_to_the_end()
    for master in masters:
        assert '/bridge' not in [node.name for node in master.nodes()]


def test_a_bridge_that_cannot_start_says_why_in_one_line(masters):
    url = masters[0].url
    for arguments, reason in (
        ((url, refused_url(), '/t'), 'bridge: no ROS master answers at '),
        ((refused_url(), url, '/t'), 'bridge: no ROS master answers at '),
        ((url, url, '/t'), f'bridge: {url} and {url} are one master: give two'),
        ((url, 'robot-b', '/t'), "bridge: 'robot-b' is not the URL of a ROS master"),
    ):
        ended = run(url, script('bridge'), *arguments)
        assert ended.returncode == 1
        assert len(ended.stderr.splitlines()) == 1
        assert ended.stderr.startswith(reason)
    assert masters[0].nodes() == []


def test_help_says_what_it_is_for():
    shown = run(refused_url(), script('bridge'), '--help')
    assert shown.returncode == 0
    assert not shown.stderr
    assert re.search(r'usage: bridge .*URL_A URL_B TOPIC', shown.stdout)
    for topics in ([], ['http://127.0.0.1:1/']):
        assert run(refused_url(), script('bridge'), *topics).returncode == 2


@pytest.mark.parametrize('value', ['no', 'False', None, 2, [], numpy.array([1, 2])])
def test_whether_connections_are_shared_is_true_or_false(master, value):
    wanted = 'share_connections is True or False, not'
    with pytest.raises(ValueError, match=wanted):
        Master(master.url, share_connections=value)
    with pytest.raises(ValueError, match=wanted):
        master.compose(None, 'any.launch', share_connections=value)
    master.share_connections = value
    with pytest.raises(ValueError, match=wanted):
        create(master)
