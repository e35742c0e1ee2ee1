"""What ``thing?`` tells at a prompt, and how things look in a notebook."""
import re

import pytest

import pharos
from helpers import create
from pharos.live.explanation import explain
from pharos.live.notebook import html_of
from sockets import refused_url


@pytest.fixture
def turtle(master):
    """A node that hears and publishes poses, and offers a service."""
    node = create(master, '/turtle')
    node.interested_in('/pose', 'turtlesim/Pose', delegate=lambda message, channel: None)
    poses = node.output_channel('/pose', 'turtlesim/Pose')
    node.spawn = node.serve('/spawn', 'turtlesim/Spawn', lambda request: ['name'])
    node.fork(lambda me: [poses.send(x=1.0) for _ in me.every(0.05)])
    return node


def test_a_topic_tells_its_type_fields_users_and_rate(master, turtle):
    *lines, rate = explain(master.topic('/pose')).splitlines()
    assert lines == [
        '/pose [turtlesim/Pose]',
        '  fields',
        *('    x: float32', '    y: float32', '    theta: float32'),
        *('    linear_velocity: float32', '    angular_velocity: float32'),
        '  published by /turtle',
        '  heard by /turtle',
    ]
    assert ' Hz (' in rate


def test_the_fields_of_messages_in_a_message_are_told(master, turtle):
    turtle.interested_in('/twists', 'geometry_msgs/TwistStamped')
    lines = explain(master.topic('/twists'), seconds=0).splitlines()
    assert lines[2:7] == [
        '    header: std_msgs/Header',
        '      seq: uint32',
        '      stamp: time',
        '      frame_id: string',
        '    twist: geometry_msgs/Twist',
    ]
    assert lines[-2:] == ['  published by nobody', '  heard by /turtle']


def test_channels_tell_what_has_come_and_gone(turtle):
    heard, sent = turtle.channels
    text = explain(heard, seconds=0)
    assert text.startswith('/pose [turtlesim/Pose], an InputChannel of /turtle\n')
    assert ', dropped 0, refused 0\n' in text
    assert '  connected with /turtle by INTRAPROCESS\n' in text
    assert '\n  sent ' in explain(sent, seconds=0)


def test_a_node_tells_its_topics(turtle):
    assert '  /pose [turtlesim/Pose], ' in explain(turtle, seconds=0)


def test_services_tell_both_their_messages(master, turtle):
    lines = [
        '/spawn [turtlesim/Spawn]',
        '  request',
        *('    x: float32', '    y: float32', '    theta: float32', '    name: string'),
        '  response',
        '    name: string',
        '  offered by /turtle',
    ]
    assert explain(master.lookup_service('/spawn')).splitlines() == lines
    assert explain(turtle.spawn).splitlines() == lines


def test_a_parameter_tells_its_value(turtle):
    assert explain(turtle.parameter('~rate', 2.5)) == (
        '/turtle/rate = 2.5 [float], a parameter of /turtle'
    )
    del turtle.master.parameters['/turtle/rate']


def test_a_master_tells_its_nodes(master, turtle):
    text = explain(master)
    assert text.startswith(f'the ROS master {master.url}, process ')
    assert '\n  nodes of this process /turtle\n  others nobody\n' in text


def test_what_cannot_be_told_is_said(master):
    assert 'no node of' in explain(master.topic('/nobodys'))
    away = pharos.Master(refused_url())
    assert 'no ROS master answers' in explain(away) or away.url in explain(away)
    assert explain(3) is None


def test_a_message_is_a_table_in_a_notebook():
    message = pharos.message_class('geometry_msgs/PoseStamped')()
    message.header.frame_id = '<map>'
    message.pose.position.x = 1.5
    table = html_of(message)
    assert '<caption>geometry_msgs/PoseStamped</caption>' in table
    assert 'header.frame_id</td>' in table
    assert '&lt;map&gt;' in table
    assert 'pose.position.x</td>' in table
    assert '1.5' in table


def test_a_long_array_is_cut_in_a_notebook():
    table = html_of(pharos.message_class('sensor_msgs/Image')(data=bytes(6000000)))
    assert '6000000 in all' in table
    assert len(table) < 2000


def test_a_node_has_html_in_a_notebook(turtle):
    text = html_of(turtle)
    assert text.startswith('<pre><b>/turtle: BlockNode, running')
    assert '/pose [turtlesim/Pose]' in text
    assert html_of(3) is None


def test_a_graph_counts_what_it_has_and_says_how_it_is_shown():
    with pharos.Master.embedded() as master:
        create(master, '/only')
        text = repr(master.graph())
    assert re.search(r': 1 node, \d topics?, \d edges?; print\(graph.text\(\)\)', text), text
    assert not re.search(r'\b1 \w+s\b', text), text
