"""What a node is told: names, namespaces, remappings, parameters, addresses."""
import os
import sys

import pytest

from pharos import BlockNode
from sockets import listening


def create(master, name, **kwargs):
    return master.create(BlockNode, named=name, **{'domain': '127.0.0.1', **kwargs})


@pytest.mark.parametrize('named, argv, namespace, name', [
    ('/driver', None, None, '/driver'),
    ('driver', None, None, '/driver'),
    ('/robot1/driver', None, None, '/robot1/driver'),
    ('driver', None, '/robot2', '/robot2/driver'),
    ('arm/driver', None, '/robot2', '/robot2/arm/driver'),
    ('/driver', None, '/robot2', '/driver'),
    ('/driver', ['__name:=pilot'], None, '/pilot'),
    ('/robot1/driver', ['__ns:=/robot3', '__name:=pilot'], None, '/robot3/pilot'),
    ('driver', ['script', '--option', '__name:=pilot'], '/robot2', '/robot2/pilot'),
])
def test_the_name_of_a_node(master, monkeypatch, named, argv, namespace, name):
    if namespace:
        monkeypatch.setenv('ROS_NAMESPACE', namespace)
    node = create(master, named, argv=argv)
    assert (node.name, node.ros.get_name()) == (name, name)
    assert name in {other.name for other in master.nodes()}


def test_topics_are_resolved_and_remapped_for_each_node(master):
    plain = create(master, '/robot1/plain')
    remapped = create(master, '/robot1/remapped', argv=['pose:=/elsewhere/pose', '~state:=/state'])
    for node, pose, state in ((plain, '/robot1/pose', '/robot1/plain/state'),
                              (remapped, '/elsewhere/pose', '/state')):
        assert node.output_channel('pose', 'std_msgs/Empty').topic == pose
        assert node.output_channel('~state', 'std_msgs/Empty').topic == state


def test_private_parameters_come_from_argv(master):
    node = create(master, '/robot1/driver', argv=['_rate:=2.5', '_name:=bob'])
    assert node.ros.get_param('~rate') == 2.5
    assert master._api().getParam('/robot1/driver/name') == 'bob'


def test_the_process_keeps_its_arguments_and_environment(master):
    argv, environ = list(sys.argv), dict(os.environ)
    create(master, '/robot1/driver', argv=['__name:=x', '/a:=/b'])
    assert (sys.argv, dict(os.environ)) == (argv, environ)


def test_a_loopback_domain_listens_on_loopback_alone(master):
    """rospy listens on all interfaces unless the whole process is told otherwise (ros_comm #315)."""
    before = listening()
    node = create(master, '/local', domain='127.0.0.2')
    assert node.domain == '127.0.0.2' and node.uri == 'http://127.0.0.2:%d/' % node.xmlrpc_port
    assert listening() - before == {('127.0.0.2', node.tcp_port), ('127.0.0.2', node.xmlrpc_port)}


def test_parameters_of_the_server_have_the_nodes_names(master):
    node = create(master, '/robot1/rated')
    rate = node.parameter('~rate', initialized=10)
    assert (rate.name, rate.value) == ('/robot1/rated/rate', 10)
    rate.set(20)
    assert node.parameter('~rate', initialized=10).value == 20
    with pytest.raises(ValueError, match='/robot1/rated/rate holds int'):
        rate.set('fast')
