"""What those who know rospy, or read no manual, try first: it works, or the error says what to write."""
import dataclasses
import re
import sys

import pytest

from helpers import create
import pharos
from pharos import BlockNode, Node, PharosError, program, wrong_guesses
from pharos.testing import Mailbox, until
from std_msgs.msg import String
from std_srvs.srv import Empty

STRING, TWIST, HEADER = 'std_msgs/String', 'geometry_msgs/Twist', 'std_msgs/Header'

# -- nodes made, and named, in another way than by create()


class Driver(Node):
    """A node with a keyword of its own."""

    def __init__(self, speed=1.0):
        self.speed = speed


@dataclasses.dataclass
class Compared(Node):
    """A node that Python compares by its values."""

    speed: float = 1.0


@pytest.mark.parametrize(
    'make, said',
    [
        (lambda: BlockNode(), r'create\(BlockNode, named=\.\.\.\), not BlockNode\(\)'),
        (lambda: Node('driver'), r"create\(Node, named='driver'\), not Node\(\)"),
        (lambda: Node(named='driver', soul=print), r"create\(Node, named='driver'\)"),
        (lambda: Driver(speed=2.0), r'create\(Driver, named=\.\.\.\), not Driver\(\)'),
        (lambda: Compared(2.0), r'create\(Compared, named=\.\.\.\), not Compared\(\)'),
    ],
    ids=['BlockNode()', 'Node(name)', 'Node(named=)', '__init__ without super()', 'dataclass'],
)
def test_a_node_made_by_hand_is_told_how_it_is_made(make, said):
    with pytest.raises(TypeError, match='made by a master: .*' + said):
        make()


def test_an_init_needs_no_super(master):
    assert create(master, '/driver', Driver, speed=2.0).speed == 2.0


@pytest.mark.parametrize('arguments', [('driver',), {'named': 'driver'}], ids=repr)
def test_a_name_given_to_the_init_of_node_as_in_ros_2_is_told_where_it_goes(master, arguments):
    class Named(Node):
        def __init__(self):
            if isinstance(arguments, dict):
                super().__init__(**arguments)
            else:
                super().__init__(*arguments)

    with pytest.raises(
        TypeError,
        match=r"takes nothing, and got .*'driver': a name.* create\(\).*super\(\).__init__\(\)",
    ):
        create(master, '/driver', Named)
    assert master.local_nodes() == []


def test_a_keyword_that_nobody_takes_is_named(master):
    with pytest.raises(
        TypeError, match=r"takes nothing, and got callback=3: .*help\(Master.create\)"
    ):
        create(master, callback=3)
    with pytest.raises(TypeError, match="Driver.__init__.. got an unexpected keyword .*'sped'"):
        create(master, '/driver', Driver, sped=2.0)


@pytest.mark.parametrize('name', ['domain', 'soul', 'named'])
def test_a_parameter_of_an_init_that_create_takes_for_itself_is_told(master, name):
    """It never got there, in silence where it had a default."""
    classes = {
        'domain': type('Framed', (Node,), {'__init__': lambda self, domain='odom': None}),
        'soul': type('Framed', (Node,), {'__init__': lambda self, soul: None}),
        'named': type('Framed', (Node,), {'__init__': lambda self, named=None: None}),
    }
    with pytest.raises(
        TypeError, match=f'takes {name}= for itself, .*Framed.__init__ would never .* my_{name}'
    ):
        create(master, '/node', classes[name], soul=print)
    assert master.local_nodes() == []


def test_a_node_that_is_compared_by_its_values_is_refused(master):
    with pytest.raises(TypeError, match=r'Compared compares .*@dataclass\(eq=False\)'):
        create(master, '/node', Compared)
    same = dataclasses.dataclass(eq=False)(
        type('Same', (Node,), {'__annotations__': {'speed': float}, 'speed': 1.0})
    )
    assert create(master, '/node', same, speed=2.0).speed == 2.0


PROPERTIES = sorted(
    name
    for owner in Node.__mro__
    for name, value in vars(owner).items()
    if isinstance(value, property)
)


@pytest.mark.parametrize('name', [*PROPERTIES, 'latest_run'])
def test_what_each_node_has_is_not_hidden_by_a_class_of_its_own(master, name):
    """It went on half, or failed far from there: ``errors = []`` had no failure in it."""
    for value in [], 'text', lambda self: 'text', property(lambda self: 'text'):
        if name != 'latest_run':
            with pytest.raises(AttributeError, match=f'^{name} is what each Node has.* my_{name}'):
                type('Arm', (Node,), {name: value})
    node = create(master)
    with pytest.raises(AttributeError, match=f'^{name} is what each|^/node is the name'):
        setattr(node, name, [])
    node.stop()
    assert not node.errors


def test_what_each_node_has_is_not_hidden_by_another_base_either():
    class Named:
        name = 'arm'

    with pytest.raises(
        AttributeError, match=r'^name is what each Node has.*\(a node.s name is given'
    ):
        type('Arm', (Named, Node), {})
    type('Arm', (Node, Named), {})


def test_a_stop_that_does_not_call_super_stops_the_node(master):
    class Silent(Node):
        def stop(self):
            pass

    node = create(master, '/silent', Silent)
    node.stop()
    assert not master.is_node_alive('/silent')
    assert node.lifecycle is pharos.Lifecycle.STOPPED


@pytest.mark.parametrize(
    'use, said',
    [
        (lambda node: node.interested_in('/t', spam=1), 'Node.interested_in'),
        (lambda node: node.send_to(), 'Node.send_to'),
        (lambda node: node.fork(spam=1), 'Node.fork'),
        (lambda node: node.renew(1), 'Node.renew'),
        (lambda node: node.log(), 'Node.log'),
        (lambda node: node.parameter(), 'Node.parameter'),
        (lambda node: node.master.lookup_service(), 'Master.lookup_service'),
        (lambda node: node.master.topic_types(1), 'Master.topic_types'),
    ],
)
@pytest.mark.skipif(sys.version_info < (3, 10), reason='Python names no class before')
def test_what_python_complains_of_a_method_names_the_class_that_users_know(master, use, said):
    with pytest.raises(TypeError, match=fr'^{said}\(\) '):
        use(create(master))


# -- names that rospy has, and ROS 2


@pytest.mark.parametrize(
    'name, said',
    [
        ('Publisher', r"write node.send_to\('/topic', typed_as='std_msgs/String', data='x'\)"),
        ('create_subscription', r"write node.interested_in\('/topic', delegate=lambda"),
        ('Rate', r'write for _ in node.every\(0.1\)'),
        ('is_shutdown', 'node.is_running'),
        ('ServiceProxy', r'write node.lookup_service\(name\).call\(field=value\)'),
        ('get_param', r"write node.parameter\('~name', initialized=1\).value"),
        ('loginfo', r'write node.log\(text\)'),
        ('Timer', r'rospy has by that name is node.ros.Timer$'),
    ],
)
def test_a_name_of_rospys_is_told_by_what_it_is_here(master, name, said):
    for thing in create(master), master, pharos:
        assert not hasattr(thing, name)
        with pytest.raises(AttributeError, match=f"has no attribute '{name}': .*{said}"):
            getattr(thing, name)


def test_what_the_table_of_guesses_says_is_there(master):
    """It may have been renamed."""
    node = create(master)
    channel = node.output_channel('/guessed', 'std_msgs/String')
    names = {'node': node, 'master': master, 'channel': channel, 'pharos': pharos}
    for guess, text in wrong_guesses._TABLE.items():
        for owner, name in re.findall(r'\b(node|master|channel|pharos)\.(\w+)', text):
            assert hasattr(names[owner], name), (guess, name)
        assert not all(hasattr(thing, guess) for thing in names.values()), guess


@pytest.mark.parametrize(
    'name, meant', [('delgate', 'delegate'), ('send', 'send_to'), ('sped', 'speed')]
)
def test_a_name_with_a_slip_is_told_once_by_what_may_be_meant(master, capsys, name, meant):
    node = create(master, '/driver', Driver)
    with pytest.raises(AttributeError) as raised:
        getattr(node, name)
    capsys.readouterr()
    sys.__excepthook__(
        raised.type, raised.value, raised.tb
    )  # which may have a suggestion of Python's
    told = f"AttributeError: 'Driver' object has no attribute '{name}' (did you mean '{meant}'?)"
    assert capsys.readouterr().err.splitlines()[-1] == told


def test_any_other_name_and_what_a_property_raises_are_as_python_has_it(master):
    class Arm(Node):
        @property
        def speed(self):
            return self._sped

    node = create(master, '/arm', Arm)
    for name, missing in ('speed', '_sped'), ('spam', 'spam'), ('topic', 'topic'):
        with pytest.raises(AttributeError, match=f"'Arm' object has no attribute '{missing}'$"):
            getattr(node, name)


# -- values that are published


def test_a_value_in_the_place_of_a_message_is_told_by_the_name_of_its_field(master):
    node = create(master)
    channel = node.output_channel('/said', 'std_msgs/String')
    with pytest.raises(pharos.MessageTypeError, match=r"\(data: string\), not 'hello': send\(\) "):
        channel.publish('hello')
    for send in (
        lambda: channel.send('hello'),
        lambda: node.send_to('/said', 'hello'),
        lambda: node.send_to('/never_said', 'hello', typed_as='std_msgs/String'),
    ):
        with pytest.raises(TypeError, match="as a keyword: data='hello'$"):
            send()
    with pytest.raises(TypeError, match=r"'hello' cannot be called: .* typed_as=, and the value"):
        node.send_to('/never_said', 'hello')
    with pytest.raises(pharos.UnknownTypeError, match="did you mean 'std_msgs/String'"):
        node.output_channel('/never_said', 'String')
    assert node.channels == [channel]


def test_a_block_in_the_place_of_a_type_is_told_where_it_goes(master):
    node = create(master)
    for give in node.interested_in, lambda name, block: node.serve(name, block, 'std_srvs/Empty'):
        with pytest.raises(pharos.UnknownTypeError, match='malformed .*a block comes after the ty'):
            give('/guessed_type', lambda *arguments: None)


# -- messages and types


def test_a_message_for_which_there_is_no_delegate_is_told_once(master, mailbox):
    """It was silent. Nothing is said before one is lost, for the delegate may be set later."""
    told = Mailbox(create(master, '/other'), '/rosout', 'rosgraph_msgs/Log')
    node, sender = create(master), create(master, '/sender')
    late, silent = (node.interested_in(name, STRING) for name in ('/late', '/silent'))
    node.delegate = mailbox
    sender.send_to('/late', data='heard')
    assert mailbox.next().data == 'heard'
    node.delegate = None
    for text in 'lost', 'again':
        sender.send_to('/silent', data=text)
    until(lambda: silent.received == 2)
    silent.delegate = mailbox
    sender.send_to('/silent', data='heard')
    assert mailbox.next().data == 'heard'
    node.log('end')
    told.wait_for(lambda line: line.msg == 'end')
    lines = [line.msg for line in told.all() if 'delegate' in line.msg]
    assert len(lines) == 1, lines
    assert lines[0].startswith('/node has no delegate for what comes on /silent')


def test_a_field_that_a_block_reads_in_vain_is_told_by_those_that_there_are(master):
    node, sender = create(master), create(master, '/sender')
    node.interested_in('/cmd', TWIST, delegate=lambda message, channel: message.lineer)
    node.interested_in('/near', TWIST, delegate=lambda message, channel: message.linear.w)
    node.interested_in('/at', HEADER, delegate=lambda message, channel: message.stamp.sec)
    node.interested_in('/own', STRING, delegate=lambda message, channel: Driver.sped)
    node.serve('/s', 'std_srvs/SetBool', lambda request: request.dta)
    for topic, cls in ('/cmd', TWIST), ('/near', TWIST), ('/at', HEADER), ('/own', STRING):
        sender.send_to(topic, typed_as=cls)
    with pytest.raises(pharos.ServiceCallError, match="no field 'dta' .did you mean 'data'"):
        master.lookup_service('/s').call(data=True)
    until(lambda: len(node.errors) == 5)
    texts = {failure.channel and failure.channel.topic: failure.text for failure in node.failures}
    assert "has no field 'lineer' (did you mean 'linear'?); its fields are linear" in texts['/cmd']
    assert 'geometry_msgs/Vector3 has no field' in texts['/near']
    assert 'its fields are secs: uint32, nsecs: uint32' in texts['/at']
    assert texts['/own'] == "type object 'Driver' has no attribute 'sped'"


@pytest.mark.parametrize(
    'use, said',
    [
        # as create_publisher of ROS 2 has it, where it is a number of messages
        (
            lambda node: node.output_channel('/t', STRING, 10),
            'latch is True or False, not 10: .*queue_',
        ),
        (lambda node: node.interested_in('/t', STRING, inline='no'), "inline is True .* not 'no'"),
        (lambda node: node.interested_in('/t', STRING, shared=5), 'shared is True .* not 5'),
        (lambda node: node.interested_in('/t', STRING, Mailbox), 'not the class .*give Mailbox'),
        (lambda node: setattr(node, 'soul', BlockNode), 'a soul is a function.* not the class'),
        (lambda node: node.master.load('/x/y.py', 'z'), "'/x/y.py' is a path, and no ROS package"),
        (lambda node: node.master.run('/bin/ls', '-l'), "'/bin/ls' is a path, and no ROS package"),
        (lambda node: program.run('arm', None), "program.run.'name', main. .* None is none"),
        (lambda node: node.master.uri_of(None), 'a node name is a string, not None'),
        (
            lambda node: node.ros_import('tf2_ros/Buffer'),
            "by its name, such as 'actionlib', not as 't",
        ),
        (lambda node: setattr(node, 'latest_run', node), 'latest_run is what each Node has'),
    ],
)
def test_a_value_in_another_one_s_place_is_told(master, use, said):
    with pytest.raises((ValueError, TypeError, AttributeError, PharosError), match=said):
        use(create(master))


@pytest.mark.parametrize(
    'use, said',
    [
        (lambda node: node.interested_in(STRING, '/t'), 'it comes after the name'),
        (lambda node: node.serve('std_srvs/Empty', '/s', print), 'it comes after the name'),
        (lambda node: node.interested_in('/t', 'std_srvs/Empty'), "the type of a service$"),
        (lambda node: node.interested_in('/t', Empty), 'this is the class of a service$'),
        (lambda node: node.serve('/s', STRING, print), 'the type of a message$'),
        (lambda node: node.serve('/s', String, print), 'this is the class of a message$'),
        (
            lambda node: node.serve('/s', 'std_srvs/SetBoolRequest', print),
            "mean 'std_srvs/SetBool'",
        ),
        (
            lambda node: node.send_to(
                '/t', lambda it: setattr(it.stamp, 'sec', 1), typed_as=HEADER
            ),
            "Time has no field 'sec' .did you mean 'secs'",
        ),
    ],
)
def test_a_type_or_field_of_something_else_is_told(master, use, said):
    with pytest.raises((pharos.UnknownTypeError, pharos.MessageTypeError), match=said):
        use(create(master))


# -- keywords


@pytest.mark.parametrize(
    'call, said',
    [
        (
            lambda master: master.create(BlockNode, name='/x'),
            r"'named' \(did you mean 'named='\?\)$",
        ),
        (lambda master: master.create(BlockNode, nmaed='/x'), "did you mean 'named='"),
        (lambda master: master.create(BlockNode, '/x', delagate=print), "did you mean 'delegate='"),
        (lambda master: master.create(Driver, '/x', sped=2), "did you mean 'speed='"),
        (lambda master: create(master).interested_in('/t', callback=print), "'delegate='"),
        (lambda master: create(master).interested_in('/t', type='a_b/C'), "'typed_as='"),
        (lambda master: create(master).output_channel('/t', msg_type='a_b/C'), "'typed_as='"),
        (lambda master: create(master).wait_for_message('/t', timout=1), "'timeout='"),
        (lambda master: create(master).serve('/s', 'a_b/C', handler=print), "'block='"),
        (lambda master: create(master).parameter('~p', default=1), "'initialized='"),
        (lambda master: create(master).every(hz=5), r"'seconds='\?\), which is 1 / hz$"),
        (lambda master: create(master).sleep(duration=5), "'seconds='"),
        (lambda master: master.lookup_service('/s', callerid='/x'), "'caller_id='"),
        (lambda master: master.run('pharos', 'graph', nam='x'), "'name='"),
        (lambda master: master.load('pharos', 'talker', argv=['_a:=1']), r"mean '\*args'\?\)$"),
        (lambda master: master.run('pharos', 'graph', args=['x']), r"mean '\*args'\?\)$"),
        (lambda master: master.compose('pharos', 'turtle.launch', 'linear:=1'), 'takes .* given$'),
    ],
)
def test_a_keyword_of_others_is_told_by_what_it_is_here(master, call, said):
    with pytest.raises(TypeError, match=said):
        call(master)


def test_what_a_call_raises_that_was_right_is_as_it_was(master):
    class Failing(Node):
        def start(self):
            raise TypeError('of its own')

    with pytest.raises(TypeError, match='^of its own$'):
        master.create(Failing, named='/failing')


def test_a_name_of_the_report_s_is_told_by_what_it_is_here(master):
    node = create(master)
    for thing, name, meant in (
        (node, 'sendTo', 'send_to'),
        (node, 'interestedin', 'interested_in'),
        (master, 'lookupService', 'lookup_service'),
    ):
        with pytest.raises(AttributeError, match=f"'{name}' .did you mean '{meant}'"):
            getattr(thing, name)
