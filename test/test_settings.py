"""What a node is told: names, namespaces, remappings, parameters, addresses."""
import os
import socket
import sys

import pytest
import rosgraph.network

from helpers import create
from programs import forget_parameters, run
from sockets import listening


@pytest.mark.parametrize(
    'named, argv, namespace, name',
    [
        ('/driver', None, None, '/driver'),
        ('driver', None, None, '/driver'),
        ('/robot1/driver', None, None, '/robot1/driver'),
        ('driver', None, '/robot2', '/robot2/driver'),
        ('arm/driver', None, '/robot2', '/robot2/arm/driver'),
        ('/driver', None, '/robot2', '/driver'),
        ('/driver', ['__name:=pilot'], None, '/pilot'),
        ('/robot1/driver', ['__ns:=/robot3', '__name:=pilot'], None, '/robot3/pilot'),
        ('driver', ['script', '--option', '__name:=pilot'], '/robot2', '/robot2/pilot'),
    ],
)
def test_the_name_of_a_node(master, monkeypatch, named, argv, namespace, name):
    if namespace:
        monkeypatch.setenv('ROS_NAMESPACE', namespace)
    node = create(master, named, argv=argv)
    assert (node.name, node.ros.get_name()) == (name, name)
    assert name in {other.name for other in master.nodes()}


def test_a_namespace_of_the_environment_that_can_be_none_is_named(master, monkeypatch):
    monkeypatch.setenv('ROS_NAMESPACE', 'robot 2')
    with pytest.raises(ValueError, match="'robot 2' cannot be a ROS_NAMESPACE name"):
        create(master, 'driver')


def test_topics_are_resolved_and_remapped_for_each_node(master):
    plain = create(master, '/robot1/plain')
    remapped = create(master, '/robot1/remapped', argv=['pose:=/elsewhere/pose', '~state:=/state'])
    for node, pose, state in (
        (plain, '/robot1/pose', '/robot1/plain/state'),
        (remapped, '/elsewhere/pose', '/state'),
    ):
        assert node.output_channel('pose', 'std_msgs/Empty').topic == pose
        assert node.output_channel('~state', 'std_msgs/Empty').topic == state


def test_private_parameters_come_from_argv(master):
    node = create(master, '/robot1/driver', argv=['_rate:=2.5', '_name:=bob'])
    assert node.ros.get_param('~rate') == 2.5
    assert master.api().getParam('/robot1/driver/name') == 'bob'


@pytest.mark.parametrize(
    'value, said',
    [
        ('99999999999999999999', '~bad cannot be 99999999999999999999: .*integers of 32 bits'),
        ('-2147483649', '~bad cannot be -2147483649'),
        ('[1, [2, {a: 2147483648}]]', '~bad cannot be .*2147483648'),
        ('~', '~bad cannot be None'),
        ('[1, null]', '~bad cannot be .1, None.'),
        ('2020-02-03', '~bad cannot be datetime.date.2020, 2, 3.'),
        ('{1: a}', "~bad cannot be {1: 'a'}: .*key must be string"),
        ('{a: {2: b}}', '~bad cannot be .*key must be string'),
        ('!!set {a, b}', '~bad cannot be {'),
        ('&loop [*loop]', '~bad cannot be .*recursive'),
        ('{', "'_bad:={' sets no private parameter, for its value is no YAML"),
        ('!!python/object:os.system x', 'its value is no YAML: .*constructor'),
        ('a\x01b', 'its value is no YAML'),
        ('"a\\x01b"', '~bad cannot be'),
        ('[' * 2000, 'its value is no YAML'),
        ('a:=b', 'maps to several names or values'),
    ],
)
def test_a_private_parameter_that_the_server_cannot_hold_is_refused_by_name(master, value, said):
    before = master.system_state(), dict(master.parameters)
    with pytest.raises(ValueError, match=said):
        create(master, '/holds/driver', argv=['_good:=1', '_bad:=' + value])
    assert (master.system_state(), dict(master.parameters)) == before
    create(master, '/holds/driver').stop()  # the name is free


HELD = [
    '0',
    '2147483647',
    '0123',
    '0x10',
    '1e400',
    '.inf',
    '-.inf',
    'yes',
    '"0"',
    "'yes'",
    'ü',
    '12:30:45',
    '[a, [1.5]]',
    '{a: {b: [true]}}',
    '2020-02-03 10:00:00',
    '!!omap [a: 1]',
    '""',
    ' padded ',
    '1_000',
]


def test_private_parameters_are_what_plain_rospy_makes_of_them(master):
    arguments = ['_p%d:=%s' % numbered for numbered in enumerate(HELD)]
    create(master, '/ours', argv=arguments)
    done = run(
        master.url, sys.executable, '-c', "import rospy; rospy.init_node('theirs')", *arguments
    )
    assert done.returncode == 0, done.stderr
    ours, theirs = master.parameters['/ours'], master.parameters['/theirs']
    forget_parameters(master.url)
    assert {name: (type(value), value) for name, value in ours.items()} == {
        name: (type(value), value) for name, value in theirs.items()
    }
    assert len(ours) == len(HELD)


def test_a_private_parameter_without_a_value_is_none_as_with_rospy(master):
    create(master, '/holds/driver', argv=['_empty:=', '_blank:= '])
    assert [name for name in master.parameters if name.startswith('/holds')] == []


def test_the_process_keeps_its_arguments_and_environment(master):
    argv, environ = list(sys.argv), dict(os.environ)
    create(master, '/robot1/driver', argv=['__name:=x', '/a:=/b'])
    assert (sys.argv, dict(os.environ)) == (argv, environ)


def test_a_loopback_domain_listens_on_loopback_alone(master):
    """rospy listens on all interfaces unless the whole process is told otherwise (ros_comm
    #315)."""
    before = listening()
    node = create(master, '/local', domain='127.0.0.2')
    assert node.domain == '127.0.0.2'
    assert node.uri == 'http://127.0.0.2:%d/' % node.xmlrpc_port
    assert listening() - before == {('127.0.0.2', node.tcp_port), ('127.0.0.2', node.xmlrpc_port)}


def test_parameters_of_the_server_have_the_nodes_names(master):
    node = create(master, '/robot1/rated')
    rate = node.parameter('~rate', initialized=10)
    assert (rate.name, rate.value) == ('/robot1/rated/rate', 10)
    rate.set(20)
    assert node.parameter('~rate', initialized=10).value == 20
    with pytest.raises(ValueError, match='/robot1/rated/rate holds int'):
        rate.set('fast')


NO_DOMAINS = [
    'http://127.0.0.1',
    'http://localhost:80',
    '127.0.0.1:80',
    '::1',
    '[::1]',
    'a b',
    ' localhost',
    'x..y',
    'nowhere.invalid',
    '0.0.0.0',
    '5',
    '224.0.0.1',
    '255.255.255.255',
    'robot1/',
]


@pytest.fixture
def nothing_left(master):
    before = master.system_state()
    yield
    assert master.system_state() == before
    create(master, '/nowhere').stop()  # the name is free


@pytest.mark.parametrize('domain', [*NO_DOMAINS, '', 5, b'127.0.0.1', True])
def test_an_address_that_nobody_would_reach_is_refused_before_anything_is_registered(
    master, nothing_left, domain
):
    with pytest.raises(ValueError, match='^domain .*: give a host name or an IPv4 address'):
        create(master, '/nowhere', domain=domain)


@pytest.mark.parametrize('variable', ['ROS_HOSTNAME', 'ROS_IP'])
@pytest.mark.parametrize('domain', NO_DOMAINS)
def test_the_environments_address_is_checked_alike(
    master, nothing_left, monkeypatch, variable, domain
):
    monkeypatch.delenv('ROS_HOSTNAME')
    monkeypatch.setenv(variable, domain)
    with pytest.raises(ValueError, match=f'^{variable} .*: give a host name or an IPv4 address'):
        create(master, '/nowhere', domain=None)


@pytest.mark.parametrize('argument', ['__hostname', '__ip'])
def test_the_address_of_argv_is_checked_alike(master, nothing_left, argument):
    with pytest.raises(ValueError, match=f'^{argument} .*: give a host name or an IPv4 address'):
        create(master, '/nowhere', argv=[f'{argument}:=0.0.0.0'])
    with create(master, '/here', argv=[f'{argument}:=127.0.0.2']) as node:
        assert node.domain == '127.0.0.2'


def test_the_environments_address_does_not_matter_where_another_is_given(master, monkeypatch):
    monkeypatch.setenv('ROS_HOSTNAME', 'nowhere.invalid')
    assert create(master, '/here', domain='127.0.0.1').domain == '127.0.0.1'


def test_a_host_whose_name_does_not_resolve_is_reached_by_its_address(master, monkeypatch):
    """rospy says the name, and nobody reaches the node."""
    monkeypatch.delenv('ROS_HOSTNAME')
    monkeypatch.setattr(socket, 'gethostname', lambda: 'nowhere.invalid')
    node = create(master, '/here', domain=None)
    assert node.domain in rosgraph.network.get_local_addresses()
    assert master.is_node_alive('/here')


def test_an_address_of_another_host_is_told(master, capfd):
    create(master, domain='192.0.2.1')  # nobody's
    assert (
        '192.0.2.1, which /node tells others to come to, is no address of' in capfd.readouterr().err
    )


def test_the_hosts_name_is_taken_without_complaint(master, monkeypatch, capfd):
    monkeypatch.delenv('ROS_HOSTNAME')
    monkeypatch.setattr(socket, 'gethostname', lambda: 'localhost')
    assert create(master, '/here', domain=None).domain == 'localhost'
    assert 'invalid' not in capfd.readouterr().err  # rosgraph's word for a name in ROS_IP


def test_an_empty_variable_says_nothing(master, monkeypatch):
    monkeypatch.setenv('ROS_HOSTNAME', '')
    monkeypatch.setenv('ROS_IP', '127.0.0.1')
    assert create(master, '/here', domain=None).domain == '127.0.0.1'
