"""What completes a line at a prompt: names of the graph, types and fields, as the call asks for."""
import time

import pytest
from IPython.core.interactiveshell import InteractiveShell
from traitlets.config import Config

import pharos
from helpers import create
from pharos.live import completion, workspace
from pharos.live.completion import completions, place_of
from sockets import refused_url, silent_peer

TWIST = 'geometry_msgs/Twist'


@pytest.fixture
def names(master):
    """The names of a session, and a robot in the graph."""
    turtle = create(master, '/robot/turtle')
    turtle.interested_in('/turtle1/cmd_vel', TWIST)
    turtle.interested_in('scan_of_robot', 'std_msgs/String')
    turtle.output_channel('/turtle1/pose', 'turtlesim/Pose')
    turtle.serve('/clear', 'std_srvs/Empty', lambda request: None)
    turtle.serve('/spawn', 'turtlesim/Spawn', lambda request: ['name'])
    me = create(master, '/workspace')
    master.parameters['/robot/turtle/rate'] = 10
    yield {
        'master': master,
        'me': me,
        'turtle': turtle,
        'Velocity': pharos.message_class('turtlesim/Velocity'),
        'spawn': master.lookup_service('/spawn'),
        'heard': turtle.channels[0],
        'channel': me.output_channel('/turtle1/cmd_vel'),
        'message_class': pharos.message_class,
        'service_class': pharos.service_class,
        'print': print,
    }
    del master.parameters['/robot/turtle/rate']


TOPICS = ['/turtle1/cmd_vel', '/turtle1/pose']


@pytest.mark.parametrize(
    'code, words',
    [
        ("master.node('/rob", ['/robot/turtle']),
        ('master.node("/rob', ['/robot/turtle']),
        ("master.wait_for_node(name='/rob", ['/robot/turtle']),
        ("master.topic('/turtle1/", TOPICS),
        ("me.send_to('/turtle1/", TOPICS),
        ("me.interested_in('/turtle1/p", ['/turtle1/pose']),
        ("x = [1, me.output_channel(topic='/turtle1/c", ['/turtle1/cmd_vel']),
        ("self.send_to('/turtle1/", TOPICS),
        ("me.interested_in('/turtle1/pose', from_='/rob", ['/robot/turtle']),
        ("me.send_to('/turtle1/cmd_vel', to='/rob", ['/robot/turtle']),
        ("turtle.interested_in('sc", ['scan_of_robot']),
        ("turtle.parameter('~r", ['~rate']),
        ("me.parameter('/robot/", ['/robot/turtle/rate']),
        ("master.parameters['/robot/", ['/robot/turtle/rate']),
        ("master.lookup_service('/cl", ['/clear']),
        ("me.send_to('/new', typed_as='geometry_msgs/TwistS", ['geometry_msgs/TwistStamped']),
        ("me.serve('/new', 'std_srvs/Em", ['std_srvs/Empty']),
        ("message_class('geometry_msgs/Quaternion", None),
        ("service_class('std_srvs/Em", ['std_srvs/Empty']),
        ("master.run('rosgraph_m", ['rosgraph_msgs']),
        ("master.load('rosgraph_m", ['rosgraph_msgs']),
        ("master.compose('rosgraph_m", ['rosgraph_msgs']),
        ("heard.plot('linear.", ['linear.x', 'linear.y', 'linear.z']),
        ("heard.plot('linear.x', 'angular.z", ['angular.z']),
    ],
)
def test_names_are_completed_as_the_call_asks_for(names, code, words):
    found = completions(code, names)
    assert found == words if words else all(word.startswith('geometry_msgs/Q') for word in found)
    assert found


@pytest.mark.parametrize(
    'code, words',
    [
        ("me.send_to('/turtle1/cmd_vel', lin", ['linear=']),
        ("me.send_to('/turtle1/cmd_vel', ", ['linear=', 'angular=']),
        ("me.send_to('/turtle1/cmd_vel', angular={'z': 1.0}, ", ['linear=']),
        ("me.send_to('/turtle1/cmd_vel',\n           lin", ['linear=']),
        ("turtle.send_to('/turtle1/pose', linear_v", ['linear_velocity=']),
        ("me.send_to('/new', typed_as='turtlesim/Velocity', l", ['linear=']),
        ('spawn.call(n', ['name=']),
        ('channel.send(', ['linear=', 'angular=']),
    ],
)
def test_fields_are_completed_as_keywords(names, code, words):
    assert completions(code, names) == words


@pytest.mark.parametrize(
    'code',
    [
        '',
        "'/turtle1/",
        "print('/turtle1/",
        "me.send_to('/turtle1/cmd_vel', lambda message: print('/turtle1/",
        "me.send_to('/turtle1/cmd_vel', typed_as='no/Such', l",
        "me.send_to('/unknown', l",
        "me.send_to('/turtle1/' + '/tur",
        "unknown.function('/tur",
        "me.channels.nothing('/tur",
        "me.send_to(topic, li",
        "turtle.health.send_to('/tur",
        "me.send_to('/turtle1/cmd_vel')",
        "me.send_to('not a name', li",
        "# me.send_to('/tur",
        "x[me['/tur",
        "))}me('",
    ],
)
def test_what_asks_for_no_name_is_not_completed(names, code):
    assert completions(code, names) == []


def test_a_method_that_overrides_one_of_ours_is_completed(names, master):
    class Sender(pharos.Node):
        """A node with a send_to of its own."""

        def send_to(self, topic, *args, **fields):
            """Send."""
            return super().send_to(topic, *args, **fields)

    names['sender'] = create(master, '/sender', Sender)
    assert completions("sender.send_to('/turtle1/p", names) == ['/turtle1/pose']


def test_a_master_that_is_away_has_nothing_to_complete():
    names = workspace.namespace(pharos.Master(refused_url()))
    assert completions("master.node('/", names) == []


def test_a_master_that_does_not_answer_is_not_waited_for_long():
    with silent_peer() as url:
        names = {'master': pharos.Master(url)}
        began = time.monotonic()
        assert completions("master.node('/", names) == []
        assert completions("master.topic('/", names) == []
        assert time.monotonic() - began < 3 * completion.LIMIT


def test_a_place_is_a_call_and_its_last_argument():
    place = place_of("f(g(1, '('), me.send_to('/a', \"b\", x='/tu")
    assert place.function == 'me.send_to'
    assert place.before == "'/a', \"b\","
    assert (place.argument, place.string) == (' x=', '/tu')
    assert place_of('f(1)') is None


@pytest.mark.filterwarnings('ignore')  # IPython calls its completer provisional
@pytest.mark.parametrize('code, word', [('T.', 'last'), ('T.la', 'last'), ('T.last.', None)])
def test_ipython_evaluates_no_property_to_complete(names, master, monkeypatch, code, word):
    looks = []
    monkeypatch.setattr(pharos.Topic, 'last', property(looks.append))
    shell = InteractiveShell(config=Config({'HistoryManager': {'enabled': False}}))
    shell.push({**names, 'T': master.topic('/turtle1/pose')}, interactive=False)
    end = completion.equip(shell)
    try:
        found = [each.text for each in shell.Completer.completions(code, len(code))]
    finally:
        end()
    assert looks == []
    assert word in [*found, None]
