"""The report's programs with the turtle of every release of turtlesim: where it takes its commands comes from
the graph."""
import os
import posixpath

import pytest
from pharos.testing import Mailbox, TIMEOUT
from programs import ROOT, Program, forget_parameters, run, script

from pharos import BlockNode, Node, PharosError
from pharos_turtle import commands
from pharos_turtle.commands import TWIST, VELOCITY

TOPICS = {TWIST: '/turtle1/cmd_vel', VELOCITY: '/turtle1/command_velocity'}
EITHER = pytest.mark.parametrize('type_name', TOPICS)
PUBLISHERS = ['turtle_driver', 'block_publisher', 'block_both']
LISTENERS = ['turtle_logger', 'block_subscriber', 'block_both']


@pytest.fixture(autouse=True)
def no_parameters_left(master):
    yield
    forget_parameters(master.url)


def turtlesim(master, type_name, topic=None):
    """A node in turtlesim's place, whose delegate keeps the commands: since hydro with Twists, before
    it with Velocities."""
    node = master.create(BlockNode, named='/turtlesim', delegate=Mailbox())
    topic = topic or TOPICS[type_name]
    node.output_channel(f'{posixpath.dirname(topic)}/pose', 'turtlesim/Pose')
    node.interested_in(topic, type_name)
    return node


def next_command(node):
    message = node.delegate.next()
    if message._type == TWIST:
        return message.linear.x, message.angular.z
    return message.linear, message.angular


def find(node):
    """What :func:`commands.find_commands` finds, and what it logs."""
    lines = []
    node.log = lambda text, level='info': lines.append(text)
    return commands.find_commands(node), lines


@EITHER
@pytest.mark.parametrize('name', PUBLISHERS)
def test_a_publisher_drives_the_turtle_and_says_by_which_topic(master, name, type_name):
    turtle = turtlesim(master, type_name)
    with Program(master.url, script(name), '_linear:=0.5', '_angular:=0.25') as program:
        assert next_command(turtle) == (0.5, 0.25)
        program.wait_for(f'drives {TOPICS[type_name]} ({type_name})')


@EITHER
@pytest.mark.parametrize('name', LISTENERS)
def test_a_listener_shows_the_commands_to_the_turtle(master, name, type_name):
    turtlesim(master, type_name)
    driver = master.create(BlockNode, named='/driver')
    channel = driver.output_channel(TOPICS[type_name], type_name)
    with Program(master.url, script(name), '__name:=listener') as program:
        assert channel.wait_for_subscribers(2, TIMEOUT)
        channel.send(lambda message: fill(message, 0.125))
        program.wait_for(': 0.125')


def fill(message, linear):
    commands.Commands('', message._type).fill(message, linear, 0.0)


@EITHER
def test_a_driver_waits_for_a_turtle_that_starts_later_whoever_listens_meanwhile(master, type_name):
    other = next(name for name in TOPICS if name != type_name)
    master.create(BlockNode, named='/echo').interested_in(TOPICS[other], other, lambda *_: None)
    with Program(master.url, script('turtle_driver'), '_linear:=0.5') as driver:
        driver.wait_for('waits for a turtle, which listens to /turtle1/cmd_vel (geometry_msgs/Twi')
        turtle = turtlesim(master, type_name)
        assert next_command(turtle) == (0.5, 1.0)


@EITHER
def test_a_turtle_of_another_name_is_driven_by_its_topic_alone(master, type_name):
    topic = f'/{posixpath.basename(type_name)}/speed'  # for the master never forgets a topic's type
    turtle = turtlesim(master, type_name, topic)
    turtlesim_of_hydro = master.create(BlockNode, named='/other', delegate=Mailbox())
    turtlesim_of_hydro.interested_in('/turtle1/cmd_vel', TWIST)
    with Program(master.url, script('turtle_driver'), f'_topic:={topic}', '_linear:=3') as driver:
        assert next_command(turtle) == (3.0, 1.0)
        driver.wait_for(f'drives {topic} ({type_name})')
    assert turtlesim_of_hydro.delegate.empty()


def test_both_can_be_named(master):
    node = master.create(Node, named='/driver', argv=['_topic:=speed', f'_type:={VELOCITY}'])
    master.create(BlockNode, named='/echo').interested_in('/speed', VELOCITY, lambda *_: None)
    assert find(node) == (('speed', VELOCITY), [f'drives /speed ({VELOCITY})'])
    only_type = master.create(Node, named='/other', argv=[f'_type:={VELOCITY}'])
    assert commands.possible_commands(only_type) == [(TOPICS[VELOCITY], VELOCITY)]


def test_of_a_turtle_that_takes_both_a_driver_takes_the_topic_of_hydro_and_later(master):
    turtle = turtlesim(master, TWIST)
    turtle.interested_in(TOPICS[VELOCITY], VELOCITY)
    assert find(master.create(Node, named='/driver'))[0] == (TOPICS[TWIST], TWIST)


def test_a_remapped_topic_is_looked_up_under_its_new_name(master):
    turtlesim(master, VELOCITY, '/robot1/turtle1/command_velocity')
    argv = ['/turtle1/command_velocity:=/robot1/turtle1/command_velocity']
    found, lines = find(master.create(Node, named='/driver', argv=argv))
    assert found == (TOPICS[VELOCITY], VELOCITY)
    assert lines == [f'drives /robot1/turtle1/command_velocity ({VELOCITY})']


def test_where_no_turtle_comes_the_topic_is_one_that_somebody_hears(master, monkeypatch):
    monkeypatch.setattr(commands, 'PATIENCE', 0.0)
    node = master.create(Node, named='/driver')
    found, lines = find(node)
    assert found == (TOPICS[TWIST], TWIST)
    assert lines[1:] == ['no turtle came within 0 s', f'drives {TOPICS[TWIST]} ({TWIST})']
    node.interested_in(TOPICS[TWIST], TWIST, lambda *_: None)  # nor is the driver its own turtle
    master.create(BlockNode, named='/echo').interested_in(TOPICS[VELOCITY], VELOCITY, print)
    assert find(node)[0] == (TOPICS[VELOCITY], VELOCITY)


def test_a_driver_that_waits_ends_when_it_is_told_to(master):
    with Program(master.url, script('turtle_driver')) as driver:
        driver.wait_for('waits for a turtle')
        assert driver.end() == 0
        assert 'Traceback' not in driver.read_to_the_end()


def test_a_type_that_commands_no_turtle_is_an_error_that_says_what_to_do(master):
    done = run(master.url, script('block_publisher'), '_type:=std_msgs/String')
    assert (done.returncode, done.stderr) == (
        1,
        'block_publisher: no topic of turtlesim has type std_msgs/String: name one with _topic:=\n',
    )
    echo = master.create(BlockNode, named='/echo', delegate=lambda *_: None)
    echo.interested_in('/chatter', 'std_msgs/String')
    done = run(master.url, script('block_publisher'), '_topic:=/chatter', '_type:=')
    assert done.returncode == 1
    assert '/chatter is of type std_msgs/String, and a turtle takes' in done.stderr
    assert done.stderr.count('\n') == 1


@pytest.mark.parametrize(
    'program, arguments, said',
    [
        ('block_publisher', ['_topic:=5'], "'5' cannot be a topic name"),
        ('block_publisher', ['_topic:=/a b'], "'/a b' cannot be a topic name"),
        (
            'block_publisher',
            ['_topic:=/x', '_type:=spam'],
            '/x is of type spam, and a turtle takes',
        ),
        ('turtle_logger', ['_topic:=5'], "'5' cannot be a topic name"),
        ('turtle_driver', ['_linear:=fast'], "linear holds float, and 'fast' is none"),
        (
            'turtle_simulator',
            ['_window:=perhaps'],
            "~window is 'perhaps': give auto, true or false",
        ),
    ],
)
def test_a_parameter_that_can_be_none_is_told_at_once(master, program, arguments, said):
    """A driver waited for a turtle on a topic of no possible name; a number in its place was a
    traceback."""
    done = run(master.url, script(program), *arguments)
    assert done.returncode == 1
    assert f'{program}: ' in done.stderr
    assert said in done.stderr
    assert 'Traceback' not in done.stderr


def test_the_launch_file_refuses_a_simulator_that_it_does_not_know(master, monkeypatch):
    monkeypatch.setenv('ROS_PACKAGE_PATH', os.pathsep.join([str(ROOT), '/usr/share']))
    with master.launch(ROOT / 'launch' / 'turtle.launch', simulator='gazebo') as process:
        assert process.wait(TIMEOUT) != 0
    said = 'there is no simulator:=gazebo, but pharos, turtlesim and none'
    assert said in process.output
    with pytest.raises(PharosError, match=said):
        master.compose(ROOT / 'launch' / 'turtle.launch', simulator='gazebo')


def test_the_launch_file_drives_a_turtle_that_runs_already(master, monkeypatch):
    monkeypatch.setenv('ROS_PACKAGE_PATH', os.pathsep.join([str(ROOT), '/usr/share']))
    monkeypatch.setenv('PYTHONPATH', str(ROOT / 'src'))
    turtle = turtlesim(master, TWIST, '/turtle2/cmd_vel')
    with master.launch(
        None,
        str(ROOT / 'launch' / 'turtle.launch'),
        simulator='none',
        topic='/turtle2/cmd_vel',
        linear=0.5,
    ):
        assert next_command(turtle) == (0.5, 1.0)
        for name in '/turtlesim', '/turtle_driver', '/turtle_logger':
            master.wait_for_node(name, TIMEOUT)
    assert not [name for name in master.api().getParamNames() if 'background' in name]
