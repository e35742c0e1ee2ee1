"""ROS's own tools take ten nodes of one process for what they are: ten nodes."""
import os
import re
import signal
import sys

import pytest
import rosbag

from helpers import InProcessMaster
from pharos.testing import Mailbox, TIMEOUT, until
from pharos import BlockNode, Master
from programs import PROGRAMS, Program, run

STRING = 'std_msgs/String'
NAMES = ['/n%d' % number for number in range(10)]
PADDING = 'x' * 200000


class Graph:
    """A master and ten nodes: each publishes on a topic, hears the next node's, and offers a
    service."""

    def __init__(self, master):
        self.master = master
        self.nodes = [master.create(BlockNode, named=name, domain='127.0.0.1') for name in NAMES]
        self.channels = [
            node.output_channel('/t%d' % number, STRING) for number, node in enumerate(self.nodes)
        ]
        self.mailboxes = [Mailbox() for _ in NAMES]
        for number, node in enumerate(self.nodes):
            node.serve('/s%d' % number, 'std_srvs/Empty', lambda request: None)
            node.interested_in('/t%d' % ((number + 1) % 10), STRING, self.mailboxes[number])

    def run(self, *command, **options):
        """Run a tool; returns what it printed, once it has ended well."""
        ended = run(self.master.url, *command, **options)
        assert ended.returncode == 0, ended.stderr
        return ended.stdout


@pytest.fixture(scope='module')
def bare():
    """The graph alone."""
    ros_master = InProcessMaster()
    found = Graph(Master(ros_master.url))
    yield found
    for node in found.nodes:
        node.stop()
    ros_master.stop()


@pytest.fixture(scope='module')
def graph(bare):
    """The graph, and /peer: a rospy node of its own process, linked with the first node both
    ways."""
    heard = bare.nodes[0].interested_in('/from_peer', STRING)
    with peer(bare, '/peer'):
        until(lambda: heard.connections and len(bare.channels[0].connections) == 2)
        yield bare
    heard.close()


def peer(graph, name):
    program = Program(graph.master.url, sys.executable, PROGRAMS / 'tools_peer.py', name)
    program.wait_for('ready')
    return program


def names(graph):
    return sorted(node.name for node in graph.master.nodes())


# -- rosnode, rostopic, rosservice


def test_rosnode_cleanup_finds_nothing_to_remove(graph):
    before = graph.master.system_state()
    assert graph.run('rosnode', 'cleanup').strip() == ''
    assert graph.master.system_state() == before


def test_a_dead_node_is_found_by_roswtf_and_removed_by_rosnode_cleanup(graph, tmp_path):
    with peer(graph, '/dead') as dead:
        dead.end(signal.SIGKILL)
    assert '/dead' in names(graph)
    assert re.search(
        r'ERROR.* Could not contact the following nodes:\s+\* /dead\s', roswtf(graph, tmp_path)
    )
    said = graph.run('sh', '-c', 'echo y | rosnode cleanup')
    assert re.findall(r'^ \* (.*)$', said, re.MULTILINE) == ['/dead']
    assert names(graph) == sorted([*NAMES, '/peer'])


def test_rosnode_ping_reaches_each_at_its_own_address(graph):
    said = graph.run('rosnode', 'ping', '--all')
    for node in graph.nodes:
        assert f'pinging {node.name} with a timeout of 3.0s\nxmlrpc reply from {node.uri}\t' in said
    assert said.count('xmlrpc reply') == 11
    assert 'ERROR' not in said


def test_rosnode_info_tells_of_links_within_the_process_and_to_others(graph):
    said = graph.run('rosnode', 'info', '/n0')
    assert 'Publications: \n * /rosout [rosgraph_msgs/Log]\n * /t0 [std_msgs/String]\n' in said
    assert 'Subscriptions: \n * /from_peer [std_msgs/String]\n * /t1 [std_msgs/String]\n' in said
    assert 'Services: \n * /n0/get_loggers\n * /n0/set_logger_level\n * /s0\n' in said
    assert 'Pid: %d\n' % os.getpid() in said
    links = re.findall(
        r'topic: (\S+)\n +\* to: (\S+).*\n +\* direction: (\w+).*\n +\* transport: (\w+)', said
    )
    assert sorted(links) == [
        ('/from_peer', '/peer', 'inbound', 'TCPROS'),
        ('/t0', '/n9', 'outbound', 'INTRAPROCESS'),
        ('/t0', '/peer', 'outbound', 'TCPROS'),
        ('/t1', '/n1', 'inbound', 'INTRAPROCESS'),
    ]


def test_rostopic_list_counts_each_node(graph):
    published, subscribed = graph.run('rostopic', 'list', '-v').split('Subscribed topics:')
    assert '* /rosout [rosgraph_msgs/Log] 11 publishers\n' in published
    for number in range(10):
        assert '* /t%d [std_msgs/String] 1 publisher\n' % number in published
        users = '1 subscriber' if number else '2 subscribers'
        assert '* /t%d [std_msgs/String] %s\n' % (number, users) in subscribed


def test_rosservice_list_names_the_node_of_each_service(graph):
    said = graph.run('rosservice', 'list', '-n').split('\n')
    for number, name in enumerate(NAMES):
        assert {'/s%d %s' % (number, name), f'{name}/get_loggers {name}'} <= set(said)
    assert '/peer/service /peer' in said


def test_roswtf_finds_no_fault(graph, tmp_path):
    said = roswtf(graph, tmp_path)
    assert 'Beginning tests of your ROS graph' in said
    assert said.split('Online checks summary:')[1].strip() == 'No errors or warnings'


def roswtf(graph, folder):
    """What it says, started where there is no package to be checked too."""
    return graph.run('roswtf', cwd=folder)


# -- rosbag


def record(graph, path, channels, count):
    """Send ``count`` messages through each of the channels, with rosbag recording all there is."""
    before = [len(channel.connections) for channel in channels]
    with Program(
        graph.master.url, 'rosbag', 'record', '-a', '--chunksize=10', '-O', str(path)
    ) as program:
        for channel, others in zip(channels, before):
            assert channel.wait_for_subscribers(others + 1, TIMEOUT), program.read_to_the_end()
        for number in range(count):
            for channel in channels:
                channel.send(data='%s %d' % (channel.node.name, number))
        # When told to end it throws away what it has not come to. What it has is in its file, but
        # for some kilobytes.
        active = path.with_suffix('.bag.active')
        for channel in channels:
            size = active.stat().st_size
            channel.send(data=PADDING)
            until(lambda: active.stat().st_size > size + len(PADDING) / 2)
        assert program.end(signal.SIGINT) == 0


def recorded(path):
    """``{(topic, node): texts}`` of a bag, by the connections that it has."""
    with rosbag.Bag(str(path)) as bag:
        found = {}
        for _, message, _, header in bag.read_messages(
            return_connection_header=True, topics=strings(bag)
        ):
            texts = found.setdefault((header['topic'].decode(), header['callerid'].decode()), [])
            texts += [message.data] if message.data != PADDING else []
        connections = [
            (c.topic, c.header['callerid'].decode()) for c in bag._get_connections(strings(bag))
        ]
    assert sorted(connections) == sorted(found)
    return found


def strings(bag):
    return [
        topic
        for topic, info in bag.get_type_and_topic_info().topics.items()
        if info.msg_type == STRING
    ]


def test_a_bag_of_two_nodes_on_one_topic_has_two_connections(bare, tmp_path):
    channels = [node.output_channel('/shared', STRING) for node in bare.nodes[:2]]
    try:
        record(bare, tmp_path / 'two.bag', channels, 40)  # rosbag's queue takes 100 of a topic
    finally:
        for channel in channels:
            channel.close()
    assert recorded(tmp_path / 'two.bag') == {
        ('/shared', name): ['%s %d' % (name, number) for number in range(40)]
        for name in ('/n0', '/n1')
    }
    assert re.search(
        r'/shared +82 msgs +: std_msgs/String +\(2 connections\)',
        bare.run('rosbag', 'info', str(tmp_path / 'two.bag')),
    )


def test_rosbag_records_all_of_ten_nodes_and_plays_it_to_them(bare, tmp_path):
    path, texts = tmp_path / 'ten.bag', {
        name: ['%s %d' % (name, number) for number in range(20)] for name in NAMES
    }
    record(bare, path, bare.channels, 20)
    assert recorded(path) == {
        ('/t%d' % number, name): texts[name] for number, name in enumerate(NAMES)
    }
    sent = [mailbox.take(21) for mailbox in bare.mailboxes]
    bare.run(
        'rosbag',
        'play',
        '--quiet',
        '--wait-for-subscribers',
        str(path),
        '--topics',
        *(channel.topic for channel in bare.channels),
    )
    played = [mailbox.take(21) for mailbox in bare.mailboxes]
    for number, (first, again) in enumerate(zip(sent, played)):
        neighbour = NAMES[(number + 1) % 10]
        for messages in first, again:
            assert [message.data for message in messages] == [*texts[neighbour], PADDING]
        assert {message._connection_header['callerid'] for message in first} == {neighbour}
        assert neighbour not in {message._connection_header['callerid'] for message in again}
    assert all(mailbox.empty() for mailbox in bare.mailboxes)
