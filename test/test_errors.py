"""Bad input: each its own error, which names the thing and the remedy, and leaves nothing
behind."""
import socket
import threading

import genpy
import pytest
from std_msgs.msg import Int32

from helpers import create
import pharos
from pharos import BlockNode, Master
from pharos.messages.fields import check_fits
from pharos.private_rospy.process_rospy import rospy


@pytest.fixture
def busy_port():
    with socket.socket() as sock:
        sock.bind(('127.0.0.1', 0))
        sock.listen()
        yield sock.getsockname()[1]


@pytest.fixture
def nothing_left(master):
    """After the test, no thread and no registration more than before."""
    before = set(threading.enumerate()), master.system_state()
    yield
    left = [
        thread.name for thread in set(threading.enumerate()) - before[0] if '/node' in thread.name
    ]
    assert (left, master.system_state()) == ([], before[1])


@pytest.mark.parametrize('which', ['tcp_port', 'xmlrpc_port'])
def test_a_busy_port(master, busy_port, nothing_left, which):
    """rospy says 'init_node interrupted', or prints the error and registers a node that is deaf
    (ros_comm #127)."""
    with pytest.raises(
        pharos.PortInUseError, match='%s %d cannot be bound .*: choose another' % (which, busy_port)
    ):
        create(master, **{which: busy_port})


def test_a_taken_name(master):
    owner = create(master, '/taken')
    with pytest.raises(
        pharos.NodeNameInUseError, match='/taken is taken by a running node of this process: .*stop'
    ):
        create(master, '/taken')
    assert owner.is_running
    assert master.is_node_alive('/taken')


def test_a_name_left_by_a_dead_node_is_free(master):
    with socket.socket() as sock:
        sock.bind(('127.0.0.1', 0))
        dead = 'http://127.0.0.1:%d/' % sock.getsockname()[1]
    master.api('/dead').registerPublisher('/left_behind', 'std_msgs/Empty', dead)
    create(master, '/dead')
    assert '/left_behind' not in master.system_state()[0]


def test_no_master():
    with socket.socket() as sock:
        sock.bind(('127.0.0.1', 0))
        nobody = Master('http://127.0.0.1:%d' % sock.getsockname()[1])
    with pytest.raises(pharos.MasterUnreachableError, match=nobody.url + '.*roscore'):
        create(nobody)
    with pytest.raises(pharos.MasterUnreachableError, match=nobody.url):
        nobody.nodes()
    assert not nobody.is_reachable()


def test_a_master_that_never_answers_is_given_up(monkeypatch):
    monkeypatch.setattr(BlockNode, 'connect_timeout', 0.2)
    with socket.socket() as silent:
        silent.bind(('127.0.0.1', 0))
        silent.listen()
        with pytest.raises(pharos.MasterUnreachableError, match='timed out'):
            create(Master('http://127.0.0.1:%d' % silent.getsockname()[1]))


@pytest.mark.parametrize(
    'url',
    [
        '',
        'localhost:11311',
        'http://',
        'http://host',
        'http://host:port',
        'ftp://host:1',
        'http://host:1/path',
        7,
        b'http://host:1',
    ],
)
def test_a_malformed_url(url):
    with pytest.raises(ValueError, match='looks like http://127.0.0.1:11311/'):
        Master(url)


@pytest.mark.parametrize(
    'name', ['', '/', '//', '/a b', '/1st', '~private', '/ends/', 'é', None, '/a-b']
)
def test_a_name_that_cannot_be_a_nodes(master, nothing_left, name):
    with pytest.raises(ValueError, match='node'):
        create(master, name)


def test_a_bad_name_has_a_caret_under_its_first_bad_character(master):
    with pytest.raises(ValueError) as error:
        create(master, '/robot/dri ver')
    line, caret = str(error.value).split('\n')[-2:]
    assert line[caret.index('^')] == ' '
    assert line.strip() == '/robot/dri ver'


@pytest.mark.parametrize('port', [-1, 65536, '80', 1.5, None, True])
def test_a_port_that_is_none(master, port):
    with pytest.raises(ValueError, match='tcp_port must be a port number'):
        create(master, tcp_port=port)


def test_a_node_class_that_is_none(master):
    with pytest.raises(TypeError, match='subclass of Node'):
        master.create(dict, named='/node')


@pytest.mark.parametrize('block', [7, 'text', lambda: None, lambda message: None])
def test_a_delegate_that_cannot_be_called_as_one(master, block):
    with pytest.raises(TypeError, match=r'delegate\(message, channel\)'):
        create(master, delegate=block)


def test_an_unknown_type(master):
    with pytest.raises(
        pharos.UnknownTypeError, match="unknown message type 'turtlesim/Speed'.*define_message"
    ):
        create(master).send_to('/t', typed_as='turtlesim/Speed')


def test_an_unknown_topic(master):
    node = create(master)
    with pytest.raises(
        pharos.UnknownTopicError,
        match='no node of .* publishes or subscribes to /untyped_yet.*typed_as=',
    ):
        node.send_to('/untyped_yet', data=1)
    node.output_channel('/posing_turtle/pose', 'turtlesim/Pose')
    with pytest.raises(pharos.UnknownTopicError, match='did you mean ./posing_turtle/pose'):
        create(master, '/other').interested_in('/posing_turtle/poes')


def test_another_type_for_a_topic_in_use(master):
    node = create(master)
    node.interested_in('/t', 'std_msgs/String')
    with pytest.raises(
        pharos.MessageTypeError, match=r'std_msgs/String \[.*\] already .* std_msgs/Bool \['
    ):
        node.send_to('/t', data=True, typed_as='std_msgs/Bool')


def fills_by_setattr(message):
    message.liner = 1.0


def fills_with_text(message):
    message.linear = 'fast'


@pytest.mark.parametrize(
    'block, fields, said',
    [
        (
            None,
            {'liner': 1.0},
            'turtlesim/Velocity has no field .liner. .*did you mean .linear.*linear: float32, angular',
        ),
        (fills_by_setattr, {}, 'turtlesim/Velocity has no field .liner.'),
        (
            None,
            {'linear': 'fast'},
            'turtlesim/Velocity.linear = .fast. does not fit float32: give a number',
        ),
        (fills_with_text, {}, 'turtlesim/Velocity.linear = .fast. does not fit float32'),
    ],
)
@pytest.mark.parametrize('interested', [False, True])
def test_a_field_that_does_not_exist_or_does_not_fit(
    master, mailbox, block, fields, said, interested
):
    node = create(master)
    if interested:
        create(master, '/other', delegate=mailbox).interested_in('/t', 'turtlesim/Velocity')
    with pytest.raises(pharos.MessageTypeError, match=said):
        node.send_to('/t', block, typed_as='turtlesim/Velocity', **fields)
    node.send_to('/t', linear=2)  # and the next one goes through
    assert not interested or mailbox.next().linear == 2.0


def test_a_value_in_a_blocks_place_is_told_how_a_block_is_called(master):
    node = create(master)
    channel = node.output_channel('/t', 'std_msgs/String')
    for send in channel.send, lambda block: node.send_to('/t', block):
        with pytest.raises(
            TypeError, match=r"called as block\(message\); 'hello' cannot .* name.*: data='hello'$"
        ):
            send('hello')
    with pytest.raises(TypeError, match='cannot be called: .*typed_as='):
        node.send_to('/another', pharos.message_class('std_msgs/String'))


@pytest.mark.parametrize('interested', [False, True])
def test_a_ready_message_that_does_not_suit_is_told(master, mailbox, interested):
    node, string = create(master), pharos.message_class('std_msgs/String')
    velocity = pharos.message_class('turtlesim/Velocity')
    if interested:
        create(master, '/other', delegate=mailbox).interested_in('/t', 'turtlesim/Velocity')
        with pytest.raises(
            pharos.MessageTypeError, match='/t carries turtlesim/Velocity, not std_'
        ):
            node.send_to('/t', string())
    channel = node.output_channel('/t', 'turtlesim/Velocity')
    for send in channel.send, lambda *args, **fields: node.send_to('/t', *args, **fields):
        with pytest.raises(pharos.MessageTypeError, match='/t carries turtlesim/Velocity'):
            send(string())
        with pytest.raises(TypeError, match='is sent as it is, without linear, angular'):
            send(velocity(), linear=1.0, angular=1.0)
        with pytest.raises(pharos.MessageTypeError, match='Velocity.linear = .fast. does not fit'):
            send(velocity(linear='fast'))


def test_a_block_that_returns_a_message_of_its_own_is_told_that_it_would_not_be_sent(master):
    """An empty message went out in silence."""
    node, cls = create(master), pharos.message_class('std_msgs/String')
    with pytest.raises(
        pharos.MessageTypeError, match='returned another std_msgs/String than it was given'
    ):
        node.send_to('/t', lambda message: cls('lost'), typed_as=cls)
    assert node.send_to('/t', lambda message: message).data == ''
    assert node.send_to('/t', lambda message: setattr(message, 'data', 'x')).data == 'x'


def test_a_block_that_returns_a_value_instead_of_setting_it_is_told_what_to_set(master):
    """An empty message went out in silence."""
    node = create(master)
    with pytest.raises(
        pharos.MessageTypeError, match=r"returned 'hello' and set no field.*\(data: string\)"
    ):
        node.send_to('/t', lambda message: 'hello', typed_as='std_msgs/String')


@pytest.mark.parametrize('value', [0, 'x', 5.0], ids=repr)
def test_what_a_block_that_sets_fields_returns_does_not_matter(master, value):
    def block(message):
        message.data = 'set'
        return value

    node = create(master)
    assert node.send_to('/t', block, typed_as='std_msgs/String').data == 'set'
    node.send_to('/empty', lambda message: value, typed_as='std_msgs/Empty')


def test_the_base_of_all_messages_is_no_type(master):
    node = create(master)
    for use in node.interested_in, node.output_channel:
        with pytest.raises(pharos.UnknownTypeError, match='malformed message type'):
            use('/t', genpy.Message)


def test_a_service_that_plain_rospy_offers_already(master):
    with pytest.raises(pharos.PharosError, match='/node offers /node/get_loggers already'):
        create(master).serve('~get_loggers', 'std_srvs/Empty', lambda request: None)


def test_the_namespace_of_all_parameters_holds_a_dict(master):
    with pytest.raises(ValueError, match='set to a dict of them, not 5'):
        master.parameters['/'] = 5
    with pytest.raises(ValueError, match='cannot be deleted'):
        del master.parameters['/']


def test_a_node_taken_for_a_master(master):
    url = create(master).uri
    for ask in Master(url).nodes, lambda: Master(url).create(BlockNode, named='/lost'):
        with pytest.raises(
            pharos.MasterUnreachableError, match='is no ROS master .*that of a node'
        ):
            ask()


def test_a_message_of_another_type(master):
    channel = create(master).output_channel('/t', 'turtlesim/Velocity')
    for wrong in pharos.message_class('std_msgs/String')(), {'linear': 1.0}, None:
        with pytest.raises(
            pharos.MessageTypeError, match='/t carries turtlesim/Velocity .linear: float32'
        ):
            channel.publish(wrong)


def test_a_closed_channel(master):
    channel = create(master).output_channel('/t', 'std_msgs/Empty')
    channel.close()
    channel.close()
    with pytest.raises(pharos.NodeStoppedError, match='closed.*output_channel'):
        channel.send()


def test_an_exception_in_start_stops_the_node(master, nothing_left):
    class Broken(pharos.Node):
        def start(self):
            super().start()
            raise RuntimeError('broken')

    with pytest.raises(RuntimeError, match='broken'):
        master.create(Broken, named='/node')


def test_a_name_is_given_to_create_and_not_set(master, nothing_left):
    """The node went on as one of that name, and the master listed it as one of another process."""

    class Arm(pharos.Node):
        def __init__(self):
            self.name = 'left arm'

    with pytest.raises(
        AttributeError, match="/node is the name .*create.., as named='left arm'.*Arm is called"
    ):
        create(master, node_class=Arm)


@pytest.mark.parametrize(
    'name, value, error',
    [
        ('master', None, AttributeError),
        ('log', [], AttributeError),
        ('stop', None, AttributeError),
        ('stop', print, AttributeError),
        ('_settings', {}, AttributeError),
        ('stop_timeout', None, ValueError),
        ('connect_timeout', 'x', ValueError),
        ('queue_bytes', None, ValueError),
    ],
)
def test_what_a_node_needs_is_not_set_to_something_else(master, nothing_left, name, value, error):
    """Its stop failed half way: it stayed registered, and its name could not be had again."""

    class Arm(pharos.Node):
        def start(self):
            super().start()
            setattr(self, name, value)

    with pytest.raises(error, match=f'^{name} is'):
        create(master, node_class=Arm)
    if name in ('log', 'stop_timeout', 'connect_timeout', 'queue_bytes'):
        with pytest.raises(error, match=f'^{name} is'):
            type('Arm', (pharos.Node,), {name: value})


def test_a_node_that_no_master_made_is_refused():
    with pytest.raises(
        TypeError, match=r'made by a master: .*create\(BlockNode, named=...\), not BlockNode\(\)'
    ):
        BlockNode()


def test_a_start_that_does_not_call_super_is_told_so(master, nothing_left):
    class Silent(pharos.Node):
        def start(self):
            pass

    class Early(pharos.Node):
        def start(self):
            self.interested_in('/never', 'std_msgs/Empty')
            super().start()

    class Earlier(pharos.Node):
        def __init__(self):
            self.interested_in('/never', 'std_msgs/Empty')

    class Named(pharos.Node):
        def start(self):
            super().start  # without the brackets

    for cls in Silent, Early, Named:
        with pytest.raises(
            pharos.NodeStoppedError,
            match=rf'/node is not started: {cls.__name__}.start\(\) .* call super\(\).start\(\) before',
        ):
            create(master, '/node', node_class=cls)
    with pytest.raises(
        pharos.NodeStoppedError, match=r'when __init__ has run; .* start\(\) .* super\(\).start\(\)'
    ):
        create(master, '/node', node_class=Earlier)


@pytest.mark.parametrize('name', ['soul', 'delegate'])
def test_a_soul_or_delegate_that_each_node_would_hide_is_refused(name):
    """It was silent, and later an AttributeError: '_soul'."""
    with pytest.raises(TypeError, match=f'Driver.{name} would never run.*set self.{name} in start'):
        type('Driver', (pharos.Node,), {name: lambda self, *args: None})


def test_a_method_for_a_soul_that_already_has_its_self_is_told_what_to_give(master):
    class Driver(pharos.Node):
        def loop(self):
            pass

    node = create(master, node_class=Driver)
    with pytest.raises(
        TypeError, match=r'called as soul\(node\).*Give .*Driver.loop, whose self is the node'
    ):
        node.fork(node.loop)
    node.fork(Driver.loop).join()


def test_all_errors_are_ros_exceptions():
    errors = [getattr(pharos, name) for name in pharos.__all__ if name.endswith('Error')]
    assert len(errors) == 12
    assert all(issubclass(error, (pharos.PharosError, rospy.ROSException)) for error in errors)


def test_a_message_for_which_there_is_no_memory_is_told_as_that():
    class Huge(Int32):
        def serialize(self, buffer):
            raise MemoryError

    with pytest.raises(pharos.PharosError, match='no memory to serialize std_msgs/Int32'):
        check_fits(Huge())
