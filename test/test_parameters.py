"""Parameters: bound to the parameter server both ways, and the server as a mapping."""
import concurrent.futures
import datetime
import functools
import queue
import threading

import numpy
import pytest
import rosgraph

from helpers import TIMEOUT, Peer, create
from pharos import Master, Node, NodeStoppedError
from pharos.testing import Mailbox, until

VALUES = [0, -(2**31), 0.0, 1e300, '', 'Straße 道\n<&>', False, True, [], [1, 'a', [True, 2.5]]]
VALUES.append({'p': 1, 'limits': {'low': [0.5], 'name': 'ü'}})
NO_VALUES = [None, 2**31, [1, None], {'a': 2**40}, {1: 'a'}, 1j, {1, 2}, 'a\0b', len]
NO_VALUES += [datetime.date(2020, 2, 3), numpy.zeros(2)]


@pytest.fixture
def node(master):
    return create(master, '/robot/driver')


@pytest.fixture
def server(master):
    """The parameter server as any other program sees it."""
    return rosgraph.Master('/elsewhere', master_uri=master.url)


class Changes:
    """The values that the blocks of parameters were told, as (name, value)."""

    def __init__(self, *parameters):
        self._queue = queue.Queue()
        for parameter in parameters:
            parameter.on_change(lambda value, name=parameter.name: self._queue.put((name, value)))

    def next(self):
        """The value of the next change."""
        return self._queue.get(timeout=TIMEOUT)[1]

    def until(self, last):
        """All changes that come before that one."""
        return list(iter(lambda: self._queue.get(timeout=TIMEOUT), last))


# -- one parameter


def test_name_is_resolved(master, server):
    for asked, name in [
        ('~rate', '/robot/driver/rate'),
        ('~gains/p', '/robot/driver/gains/p'),
        ('rate', '/robot/rate'),
        ('/rate', '/rate'),
        ('common', '/all/common'),
    ]:
        with create(master, '/robot/driver', argv=['common:=/all/common']) as driver:
            assert driver.parameter(asked, initialized=5).name == name
            assert server.getParam(name) == 5


def test_impossible_name_raises_value_error(node):
    for name in ['', 'ra te', '1rate', 'rate!', None]:
        with pytest.raises(ValueError):
            node.parameter(name)


def test_initial_value_is_for_unset_parameter(node, server):
    server.setParam('/set', 7)
    assert node.parameter('/set', initialized=1).value == 7
    assert node.parameter('/new', initialized=1).value == 1
    assert node.parameter('/new', initialized=2).value == 1
    assert server.getParam('/new') == 1


def test_unset_parameter_is_none(node, server):
    assert node.parameter('~none').value is None
    assert not server.hasParam('/robot/driver/none')


def test_private_argument_comes_before_initial_value(master):
    node = create(master, '/driver', argv=['_rate:=5', '_name:=left', '_gains/p:=0.5'])
    assert node.parameter('~rate', initialized=1).value == 5
    assert node.parameter('~name').value == 'left'
    assert node.parameter('~gains').value == {'p': 0.5}


def test_value_goes_both_ways(node, server):
    for value in VALUES:
        parameter = node.parameter('~any')
        changes = Changes(parameter)
        parameter.set(value)
        stored = server.getParam(parameter.name)
        assert (stored, type(stored)) == (value, type(value))
        assert changes.next() == value
        server.setParam(parameter.name, 'between')
        assert changes.next() == 'between'
        server.setParam(parameter.name, value)
        assert changes.next() == value
        assert (parameter.value, type(parameter.value)) == (value, type(value))


def test_impossible_value_raises_value_error(master, node):
    for value in NO_VALUES:
        parameter = node.parameter('~any')
        with pytest.raises(ValueError, match='/robot/driver/any'):
            parameter.set(value)
        with pytest.raises(ValueError, match='/robot/driver/any'):
            master.parameters[parameter.name] = value
        assert parameter.value is None


def test_own_set_is_known_at_once(node):
    rate = node.parameter('~rate', initialized=1)
    for value in range(2, 12):
        rate.set(value)
        assert rate.value == node.parameter('~rate').value == value


def test_other_node_sets_and_hears(master, node):
    other = create(master, '/other')
    here, there = node.parameter('/rate', 1), other.parameter('/rate', 2)
    changes = [Changes(here), Changes(there)]
    there.set(3)
    assert [each.next() for each in changes] == [3, 3]
    assert here.value == there.value == 3
    other.stop()
    here.set(4)
    assert changes[0].next() == 4


def test_deleted_parameter_is_none(node, server):
    rate = node.parameter('~rate', initialized=1)
    changes = Changes(rate)
    server.deleteParam(rate.name)
    assert changes.next() is None
    assert rate.value is None


def test_value_is_readers_own(node):
    gains = node.parameter('~gains', {'limits': [1, 2]})
    gains.value['limits'].append(3)
    gains.value.clear()
    assert gains.value == {'limits': [1, 2]}


def test_peer_sets_and_gets(master, node):
    rate = node.parameter('~rate', initialized=1)
    changes = Changes(rate)
    with Peer(master.url) as peer:
        peer.run("rospy.set_param('/robot/driver/rate', 2)")
        assert changes.next() == 2
        rate.set(3)
        assert peer.value("rospy.get_param('/robot/driver/rate')") == 3


# -- namespaces


@pytest.mark.parametrize('own', [False, True], ids=['outside', 'here'])
@pytest.mark.parametrize(
    'name, value, heard',
    [
        ('/gains/p', 5, {'/gains': {'p': 5, 'd': {'low': 2}}, '/gains/p': 5}),
        ('/gains/d/high', 5, {'/gains': {'p': 1, 'd': {'low': 2, 'high': 5}}}),
        ('/gains', {'p': 5}, {'/gains': {'p': 5}, '/gains/p': 5, '/gains/d/low': None}),
        ('/gainsaid', 5, {}),
    ],
)
def test_namespace_and_parts_hear_each_change(node, server, own, name, value, heard):
    server.setParam('/gains', {'p': 1, 'd': {'low': 2}})
    watched = [node.parameter(each) for each in ('/gains', '/gains/p', '/gains/d/low', '/mark')]
    changes = Changes(*watched)
    set_it = node.parameter(name).set if own else functools.partial(server.setParam, name)
    set_it(value)
    server.setParam('/mark', 1)
    assert sorted(changes.until(('/mark', 1))) == sorted(heard.items())


def test_parts_of_namespace_are_parameters(node, server):
    node.parameter('~gains', {'p': 1, 'limits': {'low': 2}})
    assert node.parameter('~gains/limits/low').value == 2
    node.parameter('~gains/p').set(3)
    assert node.parameter('~gains').value == {'p': 3, 'limits': {'low': 2}}
    assert server.getParam('/robot/driver/gains/p') == 3


# -- blocks


def test_raising_block_goes_to_failures(node):
    rate, heard = node.parameter('~rate', 1), []

    @rate.on_change
    def block(value):
        if value == 2:
            raise KeyError('not with 2')
        heard.append(value)

    others = Changes(rate)
    for value in 2, 3:
        rate.set(value)
        assert others.next() == value
    (failure,) = node.failures
    assert isinstance(failure.error, KeyError)
    assert failure.message == 2
    assert heard == [3]


def test_blocks_end_in_order_of_values(node, server):
    """A slow block gets each value, the last one last, though another thread sets it meanwhile."""
    speed, applied = node.parameter('~speed', 0.5), []
    has_begun, may_end = threading.Event(), threading.Event()

    @speed.on_change
    def apply(value):
        has_begun.set()
        if value == 1.0:
            may_end.wait(30)
        applied.append(value)

    server.setParam(speed.name, 1.0)
    assert has_begun.wait(30)
    speed.set(0.0)  # does not wait for the block
    may_end.set()
    until(lambda: len(applied) == 2)
    assert applied == [1.0, 0.0]


def test_block_sets_its_parameter(node):
    rate, heard = node.parameter('~rate', 1), []
    rate.on_change(lambda value: value < 4 and rate.set(value + 1))
    rate.on_change(heard.append)
    rate.set(2)
    # the thread that answers the master may run the blocks
    until(lambda: heard == [2, 3, 4])


def test_block_cannot_change_the_value(node):
    gains = node.parameter('~gains', {'p': 1})
    gains.on_change(lambda value: value.update(p=99))
    gains.set({'p': 2})
    assert gains.value == {'p': 2}


@pytest.mark.parametrize('value', [True, 1.0])
def test_change_of_type_is_heard(node, value):
    rate, heard = node.parameter('~rate', 1), []
    rate.on_change(heard.append)
    rate.set(value)
    until(lambda: heard)
    assert type(heard[0]) is type(value)


# -- stop and start


def test_stopped_node_refuses_use(node):
    rate = node.parameter('~rate', 1)
    node.stop()
    for use in lambda: rate.value, lambda: rate.set(2):
        with pytest.raises(NodeStoppedError, match='/robot/driver'):
            use()


def test_restarted_node_goes_on_watching(node, server):
    rate = node.parameter('~rate', 1)
    changes = Changes(rate)
    node.stop()
    server.setParam(rate.name, 2)  # it does not hear of that
    node.start()
    assert rate.value == 2
    server.setParam(rate.name, 3)
    assert changes.next() == 3
    node.restart()
    rate.set(4)
    assert changes.next() == 4


def test_initial_value_returns_with_start(node, server):
    rate = node.parameter('~rate', 1)
    node.stop()
    server.deleteParam(rate.name)
    node.start()
    assert rate.value == 1


def test_closed_parameter_hears_no_more(master, ros_master, node, server):
    rate, heard = node.parameter('~rate', 1), []
    rate.on_change(heard.append)
    other = create(master, '/other')
    changes = Changes(other.parameter(rate.name))
    rate.close()
    subscribers = ros_master._master.handler.reg_manager.param_subscribers
    for value in 2, 3:
        server.setParam(rate.name, value)
        assert changes.next() == value
        assert subscribers.get_apis(f'{rate.name}/') == [other.uri]
        node.restart()
    assert heard == []


class Driver(Node):
    def start(self):
        super().start()
        self.changes = Changes(self.parameter('~rate', 1.5))


def test_parameter_of_start_is_watched(master, server):
    driver = create(master, '/driver', Driver)
    server.setParam('/driver/rate', 2.5)
    assert driver.changes.next() == 2.5


# -- the server as a mapping


def test_master_parameters_are_a_mapping(master, server):
    parameters = master.parameters
    parameters['/gains'] = {'p': 1, 'i': 2}
    parameters['/rate'] = 5
    assert server.getParam('/gains/p') == parameters['/gains/p'] == 1
    assert parameters['/gains'] == {'p': 1, 'i': 2}
    assert list(parameters) == ['/gains/i', '/gains/p', '/rate']
    assert len(parameters) == 3
    assert '/gains' in parameters and '/gains/p' in parameters
    del parameters['/gains/p']
    assert '/gains/p' not in parameters
    assert dict(parameters) == {'/gains/i': 2, '/rate': 5}
    assert parameters.pop('/rate') == 5
    parameters.update({'/a': 1})
    assert parameters.get('/a') == 1 and parameters.get('/rate', 'none') == 'none'


def test_missing_parameter_raises_key_error(master):
    with pytest.raises(KeyError, match='/none'):
        master.parameters['/none']
    with pytest.raises(KeyError, match='/none'):
        del master.parameters['/none']


def test_mapping_changes_are_heard(master, node):
    rate = node.parameter('~rate', 1)
    changes = Changes(rate)
    master.parameters[rate.name] = 2
    assert changes.next() == 2
    assert rate.value == 2
    del master.parameters[rate.name]
    assert changes.next() is None


# -- the node's rospy


def test_rospy_of_node_agrees(node, server):
    rate = node.parameter('~rate', initialized=1)
    ros = node.ros
    assert ros.get_param('~rate') == ros.get_param('driver/rate') == 1
    assert ros.has_param('~rate') and not ros.has_param('~none')
    assert ros.get_param('~none', 'default') == 'default'
    server.setParam('/robot/size', 3)
    assert ros.search_param('size') == '/robot/size'
    ros.set_param('~rate', 2)
    assert rate.value == 2
    ros.delete_param('~rate')
    assert rate.value is None
    with pytest.raises(KeyError):
        ros.get_param('~rate')


def test_rospy_of_other_node_is_heard(master, node):
    rate = node.parameter('~rate', 1)
    changes = Changes(rate)
    create(master, '/other').ros.set_param(rate.name, 2)
    assert changes.next() == 2


def test_cached_value_follows_changes(node, server):
    server.setParam('/size', 1)
    assert node.ros.get_param_cached('/size') == 1
    server.setParam('/size', 2)
    until(lambda: node.ros.get_param_cached('/size') == 2)


def test_near_parameter_is_named(master, node):
    log = Mailbox(create(master, '/other'), '/rosout', 'rosgraph_msgs/Log')
    node.parameter('~gain', 1.0)
    node.parameter('~gian')
    line = log.wait_for(lambda line: 'has no parameter' in line.msg)
    assert '/robot/driver/gian: /robot/driver/gain? see rosparam list' in line.msg


def test_far_parameter_is_not_named(master, node):
    log = Mailbox(create(master, '/other'), '/rosout', 'rosgraph_msgs/Log')
    node.parameter('~gain', 1.0)
    node.parameter('/camera')
    line = log.wait_for(lambda line: 'has no parameter' in line.msg)
    assert line.msg.endswith('no parameter /camera: see rosparam list')


def test_many_threads_set_one_parameter(master):
    """All nodes agree on the last value."""
    nodes = [create(master, f'/node{number}') for number in range(3)]
    rates = [node.parameter('/rate', 0) for node in nodes]

    def work(number):
        for value in range(10):
            rates[number].set(100 * number + value)

    with concurrent.futures.ThreadPoolExecutor() as pool:
        list(pool.map(work, range(3)))
    last = master.parameters['/rate']
    until(lambda: [rate.value for rate in rates] == 3 * [last])


@pytest.fixture
def reads(monkeypatch):
    """The names that the nodes of this process read from the server."""
    names, call = [], Master.call

    def count(master, method, *args, **kwargs):
        if method.startswith('getParam'):
            names.append(args)
        return call(master, method, *args, **kwargs)

    monkeypatch.setattr(Master, 'call', count)
    return names


@pytest.mark.parametrize('who', ['other', 'node'])
def test_change_costs_one_read(reads, node, server, who):
    """However many parameters the node has."""
    parameters = [node.parameter(f'~rate{number}', number) for number in range(20)]
    last = parameters[-1]
    reads.clear()
    if who == 'node':
        last.set(-1)
    else:
        server.setParam(last.name, -1)
    until(lambda: last.value == -1)
    assert set(reads) == {(last.name,)}
    assert len(reads) <= (2 if who == 'node' else 1)  # the master calls the node that has set, too
