"""Names: checked alike wherever they are given, resolved once, and what `from_=` and `to=` make of
them."""
import sys

import pytest

from helpers import create
from pharos.testing import Mailbox, TIMEOUT, until
import pharos
from pharos import BlockNode
from programs import PROGRAMS, Program

STRING = 'std_msgs/String'
SWAP = ['one:=two', 'two:=one']
CHAIN = ['first:=second', 'second:=third']
NO_NAMES = [
    '/1a',
    '1a',
    '~',
    'a~b',
    '',
    '/',
    '//',
    'a//b',
    '/a//',
    'a b',
    '/a-b',
    'é',
    '_a',
    '/a\n',
    None,
    5,
    b'/a',
]


@pytest.fixture
def node(master):
    return create(master, '/node')


# -- what can be a name

USES = {
    'a node created': lambda node, name: create(node.master, name),
    'a node looked up': lambda node, name: node.master.node(name),
    'a node waited for': lambda node, name: node.master.wait_for_node(name, 0.01),
    'a topic looked up': lambda node, name: node.master.topic(name),
    'a topic heard': lambda node, name: node.interested_in(name, STRING),
    'a topic published': lambda node, name: node.output_channel(name, STRING),
    'a topic sent to': lambda node, name: node.send_to(name, typed_as=STRING),
    'a service offered': lambda node, name: node.serve(
        name, 'std_srvs/Empty', lambda request: None
    ),
    'a service looked up': lambda node, name: node.master.lookup_service(name),
    'a service looked up by a node': lambda node, name: node.lookup_service(name),
    'a service waited for by a node': lambda node, name: node.wait_for_service(name, 0.01),
    'a caller': lambda node, name: node.master.lookup_service('/s', caller_id=name),
    'a parameter': lambda node, name: node.parameter(name),
    'a parameter set': lambda node, name: node.master.parameters.__setitem__(name, 1),
    'a parameter sought': lambda node, name: name in node.master.parameters,
    'a sender': lambda node, name: node.interested_in('/named', STRING, from_=name),
    'a receiver': lambda node, name: node.send_to('/named', typed_as=STRING, to=name),
    'a receiver of a channel': lambda node, name: node.output_channel('/named', STRING).send(
        to=name
    ),
}


def test_no_name_at_all_is_refused_where_there_are_parameters(master):
    master.parameters['/some/parameter'] = 1
    with pytest.raises(ValueError):
        '' in master.parameters
    del master.parameters['/some']


@pytest.mark.parametrize('use', USES)
def test_what_is_no_name_is_refused_wherever_one_is_given(node, use):
    refused = []
    for name in NO_NAMES:
        # the namespace of all
        if (use, name) in [
            ('a sender', None),
            ('a receiver', None),
            ('a receiver of a channel', None),  # all of them
            ('a parameter set', '/'),
            ('a parameter sought', '/'),
        ]:
            continue
        with pytest.raises(ValueError):
            USES[use](node, name)
        refused.append(name)
    assert len(refused) > 15
    assert not [channel for channel in node.channels if channel.topic != '/named']


@pytest.mark.parametrize('use', USES)
def test_a_name_too_long_for_other_nodes_is_refused(node, use):
    with pytest.raises(ValueError, match='characters at the most, and .* has 1001'):
        USES[use](node, '/' + 1000 * 'x')
    assert not [channel for channel in node.channels if channel.topic != '/named']


def test_a_nodes_name_can_be_that_of_its_log_file(master):
    create(master, '/' + 249 * 'x').stop()
    for name, argv in ('/' + 250 * 'x', []), ('/' + 125 * 'x', ['__ns:=/' + 125 * 'y']):
        with pytest.raises(ValueError, match='a node name has 250 characters at the most'):
            create(master, name, argv=argv)


@pytest.mark.parametrize(
    'name, at',
    [
        ('/1a', 1),
        ('1a', 0),
        ('a~b', 1),
        ('//', 1),
        ('a//b', 2),
        ('/a//', 3),
        ('a b', 1),
        ('/a/b-c', 4),
        ('_a', 0),
        ('~1', 1),
        ('~//', 2),
        ('/a/é', 3),
    ],
)
def test_a_caret_stands_under_the_first_bad_character(node, name, at):
    for use in 'a topic heard', 'a service offered', 'a parameter', 'a sender':
        with pytest.raises(ValueError) as error:
            USES[use](node, name)
        line, caret = str(error.value).split('\n')[-2:]
        assert (line.strip(), caret.index('^') - line.index(name)) == (name, at)


def test_names_that_ros_takes_are_taken(node):
    for name in '/robots/1/pose', 'a', '/a/', '~state', '~/state', '/_hidden', 'A1_/b2':
        node.interested_in(name, STRING)
    assert [channel.topic for channel in node.channels] == [
        '/robots/1/pose',
        '/a',
        '/a',
        '/node/state',
        '/node/state',
        '/_hidden',
        '/A1_/b2',
    ]


def test_a_private_name_is_for_a_node_alone(node):
    for use in 'a topic looked up', 'a node looked up', 'a parameter set', 'a node waited for':
        with pytest.raises(ValueError, match='~ is private to a node'):
            USES[use](node, '~state')
    node.serve('~reset', 'std_srvs/Empty', lambda request: None)
    assert node.master.lookup_service('~reset', caller_id='/node').name == '/node/reset'


def test_a_name_that_is_remapped_to_none_is_refused_when_it_is_used(master):
    node = create(master, '/node', argv=['image:=cam 1', 'unused:=2.5'])
    with pytest.raises(ValueError, match=r"'/cam 1' cannot be a topic name"):
        node.interested_in('image', STRING)


# -- remapped once


def test_swapped_topics_are_swapped(master):
    node, one, two = create(master, '/swapped/node', argv=SWAP), Mailbox(), Mailbox()
    plain = create(master, '/swapped/plain')
    plain.interested_in('one', STRING, delegate=one)
    plain.interested_in('two', STRING, delegate=two)
    node.send_to('one', data='to two', typed_as=STRING)
    node.send_to('two', data='to one', typed_as=STRING)
    assert (two.next().data, one.next().data) == ('to two', 'to one')
    heard = Mailbox()
    channel = node.interested_in('one', STRING, delegate=heard)
    assert channel.topic == '/swapped/two'
    plain.send_to('two', data='from two', typed_as=STRING)
    assert heard.next().data == 'from two'
    for opened in node.channels:
        opened.close()
    publishers, subscribers, _ = master.system_state()
    assert '/swapped/node' not in str(
        [
            publishers.get(name, []) + subscribers.get(name, [])
            for name in ('/swapped/one', '/swapped/two')
        ]
    )


def test_a_chain_is_followed_one_step(master):
    node, heard = create(master, '/chained/node', argv=CHAIN), Mailbox()
    node.serve(
        'first', 'std_srvs/Trigger', lambda request: {'success': True, 'message': 'the second'}
    )
    assert master.lookup_service('/chained/second').call().message == 'the second'
    assert '/chained/third' not in master.services()
    node.parameter('first', initialized=1)
    assert (master.parameters['/chained/second'], '/chained/third' in master.parameters) == (
        1,
        False,
    )
    latched = node.output_channel('first', STRING, latch=True)
    latched.send(data='kept')
    create(master, '/chained/late', delegate=heard).interested_in('second', STRING)
    assert heard.next().data == 'kept'
    with Program(master.url, 'rostopic', 'echo', '/chained/second') as echo:
        assert echo.wait_for('kept')
    latched.close()
    assert not master.topic('/chained/second').publishers


def test_remapped_channels_survive_a_restart_and_their_masters(master):
    node, heard = create(master, '/again/node', argv=SWAP), Mailbox()
    node.interested_in('one', STRING, delegate=heard)
    node.serve('two', 'std_srvs/Empty', lambda request: None)
    node.stop()
    node.start()
    api = master.api('/again/node')
    api.unregisterSubscriber('/again/two', node.uri)  # as a master that has been restarted
    until(lambda: master.topic('/again/two').subscribers == ['/again/node'], what='the repair')
    assert not master.topic('/again/one').subscribers
    assert '/again/one' in master.services()
    assert '/again/two' not in master.services()
    create(master, '/again/plain').send_to('two', data='once', typed_as=STRING)
    assert heard.next().data == 'once'


def test_swapped_topics_cross_to_another_process(master):
    node, heard = create(master, '/far/node', argv=SWAP), Mailbox()
    node.interested_in('one', STRING, delegate=heard)
    with Program(master.url, 'rostopic', 'pub', '-r', '20', '/far/two', STRING, 'data: from afar'):
        assert heard.next().data == 'from afar'


def test_a_topic_given_in_full_by_its_master_is_not_remapped(master):
    node = create(master, '/exact/node', argv=SWAP)
    assert master.topic('/exact/one').input_channel(node, STRING).topic == '/exact/one'
    assert master.topic('/exact/one').subscribers == ['/exact/node']


def test_plain_rospy_in_a_node_remaps_as_ever(master):
    node, heard = create(master, '/plain/node', argv=['from:=into', '~here:=there']), Mailbox()
    create(master, '/plain/other', delegate=heard).interested_in('into', STRING)
    publisher = node.ros.Publisher('from', pharos.message_class(STRING), queue_size=1, latch=True)
    publisher.publish(data='plain')
    assert heard.next().data == 'plain'
    assert node.ros.resolve_name('~here') == '/plain/there'


# -- from_ and to

PEERS = {
    'relative': lambda node: 'peer',
    'full': lambda node: '/team/peer',
    'remapped': lambda node: 'friend',
    'a node': lambda node: node.master.node('/team/peer'),
    'external': lambda node: pharos.ExternalNode(node.master, '/team/peer'),
}
ARGV = ['friend:=peer', '/team/other:=/nobody']


@pytest.mark.parametrize('peer', PEERS)
def test_to_is_resolved_like_the_nodes_other_names(master, peer):
    boxes = {name: Mailbox() for name in ('peer', 'other')}
    for name, box in boxes.items():
        create(master, '/team/' + name, delegate=box).interested_in('talk', STRING)
    node = create(master, '/team/node', argv=ARGV)
    node.send_to('talk', data='for the peer', to=PEERS[peer](node))
    node.send_to('talk', data='for all')
    assert [message.data for message in boxes['peer'].take(2)] == ['for the peer', 'for all']
    assert boxes['other'].next().data == 'for all'


@pytest.mark.parametrize('peer', PEERS)
def test_from_is_resolved_like_the_nodes_other_names(master, mailbox, peer):
    create(master, '/team/peer')
    node = create(master, '/team/node', argv=ARGV, delegate=mailbox)
    channel = master.topic('/team/talk').input_channel(node, STRING, from_=PEERS[peer](node))
    assert channel.from_ == '/team/peer'
    create(master, '/team/other').send_to('talk', data='not this')
    master.node('/team/peer').send_to('talk', data='this')
    assert mailbox.next().data == 'this'
    assert mailbox.empty()


@pytest.mark.parametrize('find', ['lookup_service', 'wait_for_service'])
def test_a_service_is_found_by_the_name_that_the_node_means_and_called_in_the_nodes(master, find):
    """The master knows neither the namespace nor the remappings that a launch file gives it."""
    node = create(master, '/team/node', argv=['stop:=other/reset'])
    for provider in create(master, '/team/detector'), create(master, '/team/other'), node:
        provider.serve(
            '~reset',
            'std_srvs/Trigger',
            lambda request: (True, request._connection_header['callerid']),
        )
    meant = {
        'detector/reset': '/team/detector/reset',
        '/team/other/reset': '/team/other/reset',
        'stop': '/team/other/reset',
        '~reset': '/team/node/reset',
    }
    for name, full_name in meant.items():
        service = getattr(node, find)(name)
        assert service.name == full_name
        assert service.call(timeout=TIMEOUT).message == '/team/node'


def test_a_node_that_looks_a_service_up_may_wait_and_keep_the_connection(master):
    node = create(master, '/team/node')
    with pytest.raises(pharos.UnknownServiceError, match='offered /team/reset within 0.01 s'):
        node.lookup_service('reset', wait=0.01)
    node.serve('reset', 'std_srvs/Empty', lambda request: None)
    assert node.lookup_service('reset', wait=TIMEOUT, persistent=True).persistent
    node.stop()
    with pytest.raises(pharos.NodeStoppedError, match='start'):
        node.lookup_service('reset')


def test_a_private_name_is_that_of_a_node_below(master, mailbox):
    create(master, '/boss/worker', delegate=mailbox).interested_in('/work', STRING)
    create(master, '/boss').send_to('/work', data='do it', to='~worker')
    assert mailbox.next().data == 'do it'


def test_from_a_node_that_is_not_there_yet(master, mailbox):
    node = create(master, '/waiting', delegate=mailbox)
    node.interested_in('/calls', STRING, from_='caller')
    with Program(
        master.url,
        'rostopic',
        'pub',
        '-r',
        '20',
        '/calls',
        STRING,
        'data: called',
        '__name:=caller',
    ):
        assert mailbox.next().data == 'called'


@pytest.mark.parametrize('to', ['/lisener', 'lisener'])
def test_to_a_node_that_is_not_there_is_an_error_and_not_counted(master, node, mailbox, to):
    create(master, '/listener', delegate=mailbox).interested_in('/orders', STRING)
    channel = node.output_channel('/orders', STRING)
    for send in channel.send, lambda **kwargs: node.send_to('/orders', **kwargs):
        with pytest.raises(
            pharos.UnknownNodeError, match='no node /lisener at .*did you mean ./listener'
        ):
            send(data='lost', to=to)
    channel.send(data='found', to='listener')
    assert mailbox.next().data == 'found'
    assert mailbox.empty()
    assert channel.sent == 1


def test_to_a_node_that_is_not_interested_is_said_once_and_not_counted(master, node, mailbox):
    log = Mailbox()
    create(master, '/elsewhere').interested_in('/rosout', 'rosgraph_msgs/Log', delegate=log)
    create(master, '/listener', delegate=mailbox).interested_in('/orders', STRING)
    channel = node.output_channel('/orders', STRING)
    for _ in range(3):
        channel.send(data='nowhere', to='/elsewhere')
    channel.send(data='somewhere', to='/listener')
    node.log('end')
    assert mailbox.next().data == 'somewhere'
    lines = []
    while not lines or lines[-1] != 'end':
        lines.append(log.next().msg)
    assert [line for line in lines if '/elsewhere' in line] == [
        '/elsewhere is not interested in /orders, or not connected yet: what /node sends to it alone goes nowhere'
    ]
    assert channel.sent == 1


def test_to_a_program_elsewhere(master, node):
    channel = node.output_channel('/afar', STRING)  # rostopic waits for the type
    with Program(master.url, 'rostopic', 'echo', '/afar', '__name:=hearer') as echo:
        assert channel.wait_for_subscribers(1, TIMEOUT)  # the master knows it some time before
        hearer = master.topic('/afar').subscribers[0]
        node.send_to('/afar', data='hello', to=hearer)
        assert echo.wait_for('hello')
    until(lambda: '/afar' not in master.system_state()[1], what='its leaving')
    with pytest.raises(pharos.UnknownNodeError):
        node.send_to('/afar', data='hello', to=hearer)


def test_a_node_of_another_master_is_refused(master, node):
    with pharos.Master.embedded() as other:
        stranger = other.create(BlockNode, named='/stranger', domain='127.0.0.1')
        with pytest.raises(ValueError, match='/stranger .*another master'):
            node.send_to('/t_of_one', typed_as=STRING, to=stranger)
        with pytest.raises(ValueError, match='/stranger .*another master'):
            node.interested_in('/t_of_one', STRING, from_=stranger)


@pytest.mark.leaves('it cannot ask the master any more')
def test_to_costs_the_master_nothing_where_the_peer_is_connected(
    master, node, mailbox, monkeypatch
):
    create(master, '/listener', delegate=mailbox).interested_in('/quick', STRING)
    channel = node.output_channel('/quick', STRING)
    assert channel.wait_for_subscribers(1, TIMEOUT)
    monkeypatch.setattr(pharos.Master, 'api', None)
    channel.send(data='at once', to='listener')
    assert mailbox.next().data == 'at once'


# -- what others have named otherwise


@pytest.mark.filterwarnings('ignore:.*not a legal ROS graph')  # rospy says so
def test_what_the_graph_has_is_reached_by_a_name_that_ours_could_not_have(master, node):
    with Program(master.url, sys.executable, str(PROGRAMS / 'dashed.py')):
        external = until(lambda: master.has('/my-service', 'service') and master.node('/my-node'))
        topic = master.topic('/my-topic')
        assert topic.type == STRING and topic.last.data == 'latched'
        assert master.wait_for_node('/my-node') == external
        assert node.interested_in('/my-topic', from_='/my-node').topic == '/my-topic'
        master.lookup_service('/my-service').call()
        text = external.describe(0)
        assert '/my-topic [std_msgs/String]' in text and '/my-service [std_srvs/Empty]' in text
        assert '~top-speed: 5' in text
    for look in master.node, master.topic, master.lookup_service:
        with pytest.raises(ValueError, match='/no-such. cannot be'):
            look('/no-such')
