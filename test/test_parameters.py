"""Parameters, bound to a node both ways."""
import datetime
import itertools
import socketserver
import threading
import types
import xmlrpc.server

import numpy
import pytest
import rosgraph

from helpers import InProcessMaster, create, ended, in_thread
from pharos.testing import Mailbox, TIMEOUT, until
from pharos import Master, MasterUnreachableError, NodeStoppedError, node_registry
from pharos.blocks import attempt
from pharos.private_rospy.instance import PrivateRospy
from pharos.private_rospy.parameters import WatchedParameters
from programs import run

PRIVATE = '/robot1/driver/rate'


@pytest.fixture(autouse=True)
def no_parameters_left(ros_master):
    yield
    node_registry.stop_all()
    forget_all(ros_master.url)


def forget_all(url):
    rosgraph.Master('/test', master_uri=url).setParam('/', {})


class Changes:
    """What the blocks of a node's parameters are told, in order.

    A master makes its calls to one node one after the other, so that a further parameter marks the
    end.
    """

    _marks = itertools.count(1)

    def __init__(self, node):
        self._node, self._mailbox = node, Mailbox()
        self._end = node.parameter('/end_of' + node.name)
        self.of(self._end)

    def of(self, *parameters):
        for parameter in parameters:
            parameter.on_change(
                lambda value, name=parameter.name: self._mailbox((name, value), None)
            )
        return self

    def get(self):
        """The next value."""
        return self._mailbox.next()[1]

    def until_now(self):
        """``[(name, value)]`` that came until now and have not been asked for."""
        mark = next(self._marks)
        self._node.master.parameters[self._end.name] = mark
        return list(iter(self._mailbox.next, (self._end.name, mark)))


# -- rosparam, the program


def test_what_rosparam_sets_and_deletes_reaches_the_block_at_once(master):
    rate = create(master, '/robot1/driver').parameter('~rate', initialized=1.0)
    changes = Changes(rate.node).of(rate)
    assert (rate.name, rate.value) == (PRIVATE, 1.0)
    for given, value in ('2.5', 2.5), ('5', 5.0):
        assert run(master.url, 'rosparam', 'set', PRIVATE, given).returncode == 0
        got = changes.get()
        assert (got, type(got), rate.value, type(rate.value)) == (value, float, value, float)
    assert run(master.url, 'rosparam', 'delete', PRIVATE).returncode == 0
    assert changes.get() is None
    assert rate.value is None
    assert changes.until_now() == []


def test_what_a_node_sets_is_what_rosparam_gets(master):
    node = create(master, '/robot1/driver')
    node.parameter('~rate', initialized=1.0).set(2)
    node.parameter('~gains').set({'p': 0.5, 'limits': (1, 'a', True)})
    assert run(master.url, 'rosparam', 'get', PRIVATE).stdout == '2.0\n'
    assert run(master.url, 'rosparam', 'get', '/robot1/driver/gains/p').stdout == '0.5\n'
    assert (
        run(master.url, 'rosparam', 'get', '/robot1/driver/gains/limits').stdout
        == '- 1\n- a\n- true\n\n'
    )


def test_what_rosparam_sets_to_another_type_is_reported_and_the_block_not_run(master, transcript):
    rate = create(master, '/robot1/driver').parameter('~rate', initialized=1.0)
    changes = Changes(rate.node).of(rate)
    assert run(master.url, 'rosparam', 'set', PRIVATE, 'fast').returncode == 0
    assert changes.until_now() == []
    (error,) = rate.node.errors
    assert isinstance(error, ValueError)
    assert str(error).startswith(PRIVATE + " holds float, and 'fast' is none")
    assert any(f'parameter {PRIVATE}' in line for line in transcript)
    with pytest.raises(ValueError, match=PRIVATE):
        rate.value
    master.parameters[PRIVATE] = 3.0
    assert changes.get() == rate.value == 3.0


# -- stops, and a master that does not answer


@pytest.mark.parametrize(
    'how',
    [
        lambda node, parameter: parameter.value,
        lambda node, parameter: parameter.on_change(print),
        lambda node, parameter: node.log('a line, of which rospy asks where it may go'),
        lambda node, parameter: node.ros.get_param_cached(parameter.name, 0),
    ],
)
def test_a_node_that_stops_while_it_subscribes_to_a_parameter_leaves_nothing(
    master, ros_master, monkeypatch, how
):
    node = create(master, '/stopping')
    began, handler, ended_event = threading.Event(), ros_master.handler, node.latest_run.rospy.ended
    subscribe = handler.subscribeParam

    def subscribe_when_it_stops(*args):
        began.set()
        ended_event.wait(TIMEOUT)
        return subscribe(*args)

    monkeypatch.setattr(handler, 'subscribeParam', subscribe_when_it_stops)
    parameter = node.parameter('/stopping/speed')
    thread = in_thread(attempt, lambda: how(node, parameter))
    assert began.wait(TIMEOUT)
    node.stop()
    assert ended(thread)
    with pytest.raises(rosgraph.MasterError, match='unknown node'):
        master.api().lookupNode('/stopping')


def test_who_reads_a_parameter_waits_no_longer_for_others_that_do(master, monkeypatch):
    monkeypatch.setattr('pharos.private_rospy.parameters.TIMEOUT', 0.1)
    node = create(master, '/reading')
    with node.latest_run.rospy.parameters._turn():  # another thread asks, and gets no answer
        with pytest.raises(MasterUnreachableError, match='timed out'):
            node.parameter('/speed').value
    assert node.parameter('/speed').value is None


def test_first_values_are_set_and_watched_though_a_restarted_master_goes_once_more(
    mortal_master, monkeypatch
):
    node = create(Master(mortal_master.url), '/repaired')
    speed, changes = node.parameter('~speed', initialized=2.0), Mailbox()
    speed.on_change(lambda value: changes(value, None))
    failures, renew = [], WatchedParameters.renew

    def renew_at_the_second_attempt(watched):
        if not failures:
            failures.append(ConnectionResetError())
            raise failures[0]
        renew(watched)

    mortal_master.end()
    monkeypatch.setattr(WatchedParameters, 'renew', renew_at_the_second_attempt)
    mortal_master.come_back()
    until(lambda: '/repaired/speed' in node.master.parameters)
    until(lambda: speed in node.latest_run.parameters and not node.latest_run.rospy.was_forgotten)
    assert run(mortal_master.url, 'rosparam', 'set', '/repaired/speed', '3.0').returncode == 0
    assert changes.next() == 3.0 and failures


# -- names


@pytest.mark.parametrize(
    'named, argv, asked, name',
    [
        ('/driver', None, '~rate', '/driver/rate'),
        ('/robot1/driver', None, '~rate', '/robot1/driver/rate'),
        ('/robot1/driver', None, '~gains/p/', '/robot1/driver/gains/p'),
        ('/robot1/driver', None, 'rate', '/robot1/rate'),
        ('/robot1/driver', None, 'wheels/left', '/robot1/wheels/left'),
        ('/robot1/driver', None, '/rate', '/rate'),
        ('/robot1/driver', ['__ns:=/robot2', '__name:=pilot'], '~rate', '/robot2/pilot/rate'),
        ('/robot1/driver', ['rate:=/common/rate'], 'rate', '/common/rate'),
        ('/robot1/driver', ['rate:=/common/rate'], '~rate', '/robot1/driver/rate'),
        ('/robot1/driver', ['~rate:=/common/rate'], '~rate', '/common/rate'),
        ('/robot1/driver', ['/rate:=speed'], '/rate', '/robot1/speed'),
        ('/robot1/driver', ['/a:=/b', '/b:=/a'], '/a', '/b'),
    ],
)
def test_names_are_resolved_and_remapped(master, named, argv, asked, name):
    parameter = create(master, named, argv=argv).parameter(asked, initialized=1)
    changes = Changes(parameter.node).of(parameter)
    assert parameter.name == name
    assert master.parameters[name] == 1
    master.parameters[name] = 2
    assert changes.get() == parameter.value == 2
    parameter.set(3)
    assert changes.get() == master.parameters[name] == 3


def test_a_name_is_not_remapped_twice(master):
    parameter = create(master, '/robot1/driver', argv=['/a:=/b', '/b:=/a']).parameter('/a')
    changes = Changes(parameter.node).of(parameter)
    master.parameters['/b/part'] = 2
    assert changes.get() == parameter.value == {'part': 2}


@pytest.mark.parametrize('name', ['', '/', None, 5, '1rate', 'ra te', 'rate!', '~r\n', 'é'])
def test_what_is_no_name_is_refused(master, name):
    with pytest.raises(ValueError):
        create(master, '/robot1/driver').parameter(name)


# -- the first value


def test_a_parameter_without_a_value_gets_the_first_one_and_another_keeps_its_own(master):
    master.parameters['/robot1/driver/set'] = 7
    node = create(master, '/robot1/driver', argv=['_rate:=5'])
    assert (node.parameter('~rate', initialized=1.0).value, master.parameters[PRIVATE]) == (5.0, 5)
    assert node.parameter('~set', initialized=1).value == 7
    assert (
        node.parameter('~new', initialized=1).value == master.parameters['/robot1/driver/new'] == 1
    )
    assert node.parameter('~none').value is None
    assert '/robot1/driver/none' not in master.parameters


@pytest.mark.parametrize(
    'value',
    [
        0,
        False,
        '',
        0.0,
        [],
        'ü\n<&>',
        -(2**31),
        1e300,
        [1, 'a', [True]],
        {'p': 1, 'limits': {'low': [0.5]}},
    ],
)
def test_any_value_that_the_server_can_hold_may_be_the_first(master, value):
    parameter = create(master, '/robot1/driver').parameter('~value', initialized=value)
    assert (parameter.value, type(parameter.value)) == (value, type(value))
    assert master.parameters[parameter.name] == value


def test_a_value_of_another_type_that_is_there_already_is_refused_by_name(master):
    rate = create(master, '/robot1/driver', argv=['_rate:=fast']).parameter(
        '~rate', initialized=1.0
    )
    with pytest.raises(
        ValueError, match=f"{PRIVATE} holds float, and 'fast' is none.*None to allow any"
    ):
        rate.value


# -- types


@pytest.mark.parametrize(
    'initialized, value',
    [
        (1.0, '2.0'),
        (1.0, True),
        (1, 2.5),
        (1, True),
        (True, 1),
        (False, 'no'),
        ('a', 1),
        ([1], {'a': 1}),
        ([1], 'a'),
        ({'a': 1}, [1]),
        ('a', ['a']),
    ],
)
def test_a_value_of_another_type_is_refused_by_name(master, initialized, value):
    parameter = create(master, '/robot1/driver').parameter('~rate', initialized)
    with pytest.raises(ValueError, match=f'{PRIVATE} holds {type(initialized).__name__}'):
        parameter.set(value)
    assert parameter.value == initialized


def test_initialized_with_none_any_value_is_taken(master):
    parameter = create(master, '/robot1/driver').parameter('~any', initialized=None)
    changes = Changes(parameter.node).of(parameter)
    for value in 1, 'text', 2.5, True, [1, 'a'], {'a': 1}:
        parameter.set(value)
        assert changes.get() == parameter.value == value
    assert changes.until_now() == []


@pytest.mark.parametrize(
    'value',
    [
        None,
        2**31,
        object(),
        {1: 'a'},
        'a\0b',
        [1, None],
        1j,
        {'a': 2**40},
        '\ud800',
        {1, 2},
        datetime.date(2020, 2, 3),
        # each was stored as a dict of its attributes, which is empty for a function
        len,
        lambda: 1,
        ValueError('x'),
        types.SimpleNamespace(a=1),
        Master,
        [types.SimpleNamespace(a=1)],
    ],
)
def test_a_value_that_the_server_cannot_hold_is_refused_by_name(master, value):
    parameter = create(master, '/robot1/driver').parameter('~any')
    with pytest.raises(ValueError, match='/robot1/driver/any cannot be'):
        parameter.set(value)
    assert parameter.value is None
    with pytest.raises(ValueError, match='/robot1/driver/any cannot be'):
        master.parameters[parameter.name] = value
    assert parameter.value is None
    assert parameter.name not in master.parameters
    if value is not None:
        with pytest.raises(ValueError, match='/robot1/driver/any cannot be'):
            parameter.node.parameter('~any', initialized=value)


@pytest.mark.parametrize('value', [numpy.float64(1.5), [numpy.int64(3)], numpy.zeros(2)])
def test_what_is_numpys_is_told_with_what_makes_it_pythons(master, value):
    with pytest.raises(ValueError, match='but what its tolist'):
        master.parameters['/numpys'] = value


# -- namespaces


@pytest.fixture
def gains(master):
    """A namespace and what is in it, watched by one node; ``gains.until_now()`` tells the
    changes."""
    node = create(master, '/robot1/driver')
    master.parameters['/gains'] = {'p': 1, 'd': {'low': 2}}
    return Changes(node).of(*map(node.parameter, ('/gains', '/gains/p', '/gains/d/low')))


@pytest.mark.parametrize('set_by_the_node', [False, True])
@pytest.mark.parametrize(
    'name, value, told',
    [
        ('/gains/p', 5, {'/gains': {'p': 5, 'd': {'low': 2}}, '/gains/p': 5}),
        ('/gains/d/high', 5, {'/gains': {'p': 1, 'd': {'low': 2, 'high': 5}}}),
        ('/gains/d', {'low': 5}, {'/gains': {'p': 1, 'd': {'low': 5}}, '/gains/d/low': 5}),
        ('/gains', {'p': 5}, {'/gains': {'p': 5}, '/gains/p': 5, '/gains/d/low': None}),
        ('/gains', 5, {'/gains': 5, '/gains/p': None, '/gains/d/low': None}),
        ('/gainsaid', 5, {}),
    ],
)
def test_a_namespace_and_its_parts_hear_once_of_a_change_in_one_another(
    master, gains, set_by_the_node, name, value, told
):
    if set_by_the_node:
        gains._node.parameter(name).set(value)
    else:
        master.parameters[name] = value
    assert sorted(gains.until_now()) == sorted(told.items())


@pytest.mark.parametrize('set_by_the_node', [False, True])
@pytest.mark.parametrize('value, told', [({'p': 5}, 5), ({'d': 5}, None)])
def test_a_part_hears_once_of_a_change_of_the_namespace_around_it(
    master, set_by_the_node, value, told
):
    node = create(master, '/robot1/driver')
    changes = Changes(node).of(node.parameter('/gains/p', initialized=1))
    if set_by_the_node:
        node.parameter('/gains').set(value)
    else:
        master.parameters['/gains'] = value
    assert changes.until_now() == [('/gains/p', told)]


@pytest.mark.parametrize(
    'name, told',
    [
        ('/gains/p', {'/gains': {'d': {'low': 2}}, '/gains/p': None}),
        ('/gains', {'/gains': None, '/gains/p': None, '/gains/d/low': None}),
    ],
)
def test_what_is_deleted_is_none(master, gains, name, told):
    del master.parameters[name]
    assert sorted(gains.until_now()) == sorted(told.items())


def test_a_part_watched_before_its_namespace_is_not_told_twice(master):
    node = create(master, '/robot1/driver')
    changes = Changes(node).of(node.parameter('/gains/p'))
    changes.of(node.parameter('/gains'))
    master.parameters['/gains/p'] = 5
    assert sorted(changes.until_now()) == [('/gains', {'p': 5}), ('/gains/p', 5)]


# -- blocks


def test_each_block_of_a_parameter_is_run_and_a_failing_one_alone_is_reported(master, transcript):
    node = create(master, '/robot1/driver')
    first, second, again = Mailbox(), Mailbox(), Mailbox()
    rate = node.parameter('~rate', 1)
    assert rate.on_change(block := lambda value: first(value, None)) is block

    @rate.on_change
    def failing(value):
        raise KeyError('not with %d' % value)

    rate.on_change(lambda value: second(value, None))
    node.parameter('~rate', 1).on_change(lambda value: again(value, None))
    for value, set_ in (2, lambda: master.parameters.update({rate.name: 2})), (
        3,
        lambda: rate.set(3),
    ):
        set_()
        assert first.next() == second.next() == again.next() == value
        error = node.errors.pop()
        assert isinstance(error, KeyError)
        assert 'not with %d' % value in str(error)
        assert not node.errors
    assert f'parameter {PRIVATE}' in transcript[-1]
    assert 'failing' in transcript[-1]
    assert 'KeyError' in transcript[-1]


@pytest.mark.parametrize('block', [None, 5, lambda: None, lambda value, more: None])
def test_what_is_no_block_is_refused(master, block):
    with pytest.raises(TypeError, match='value'):
        create(master, '/robot1/driver').parameter('~rate').on_change(block)


def test_two_nodes_of_one_process_watch_one_parameter(master):
    one, other = create(master, '/one').parameter('/shared', 1), create(master, '/other').parameter(
        '/shared', 2
    )
    assert one.value == other.value == 1
    changes = [Changes(parameter.node).of(parameter) for parameter in (one, other)]
    one.set(3)
    assert [told.get() for told in changes] == [3, 3]
    assert other.value == 3
    master.parameters['/shared'] = 4
    assert [told.get() for told in changes] == [4, 4]
    one.node.stop()
    other.set(5)
    assert changes[1].until_now() == [('/shared', 5)]


def test_a_block_may_read_set_and_watch_parameters(master):
    node = create(master, '/robot1/driver')
    first, second = node.parameter('~first', 0), node.parameter('~second', 0)
    changes = Changes(node).of(second)

    def follow(value):
        second.set(first.value + second.value)
        changes.of(node.parameter('~third'))

    first.on_change(follow)
    master.parameters[first.name] = 4
    assert changes.get() == 4
    first.set(5)
    assert changes.get() == 9
    assert not node.errors


# -- life


class _Server(socketserver.ThreadingMixIn, xmlrpc.server.SimpleXMLRPCServer):
    daemon_threads = True


def test_a_master_no_longer_calls_where_a_stopped_node_was(master):
    node = create(master, '/robot1/driver')
    for name in '~rate', '/gains', '/gains/p':
        Changes(node).of(node.parameter(name))
    assert node.ros.get_param_cached('~rate', 1) == 1  # rospy itself subscribes here
    assert node.parameter('/read').value is None
    node.stop()
    calls = Mailbox()
    with _Server(('127.0.0.1', node.xmlrpc_port), logRequests=False) as server:
        server.register_function(
            lambda caller, name, value: calls(name, None) or [1, '', 0], 'paramUpdate'
        )
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        master.api(node.name).subscribeParam(node.uri, '/sentinel')
        for name in PRIVATE, '/gains', '/gains/p', '/read', '/sentinel':
            master.parameters[name] = 5
        assert calls.next() == '/sentinel/'  # a master calls one node in order
        server.shutdown()
        thread.join(TIMEOUT)
    master.api(node.name).unsubscribeParam(node.uri, '/sentinel')


def test_a_parameter_needs_a_running_node_and_goes_on_with_the_next_run(master):
    rate = create(master, '/robot1/driver').parameter('~rate', 1)
    changes = Changes(rate.node).of(rate)
    rate.node.stop()
    for use in (
        lambda: rate.value,
        lambda: rate.set(2),
        lambda: rate.on_change(print),
        lambda: rate.node.parameter('~other'),
    ):
        with pytest.raises(NodeStoppedError, match='/robot1/driver is stopped'):
            use()
    assert repr(rate) == f'<Parameter {PRIVATE} of /robot1/driver>'
    master.parameters[rate.name] = 2
    rate.node.start()
    assert changes.until_now() == []
    assert rate.value == 2
    master.parameters[rate.name] = 3
    rate.set(4)
    assert sorted(changes.until_now()) == [(PRIVATE, 3), (PRIVATE, 4)]
    rate.node.stop()
    forget_all(master.url)
    rate.node.start()
    assert rate.value == 1


def test_a_block_goes_on_with_the_next_run_that_came_as_the_node_was_restarted(master, monkeypatch):
    node, changes = create(master, '/node'), Mailbox()
    really = WatchedParameters.watch

    def restart_and_watch(*arguments):
        monkeypatch.undo()
        node.restart()
        really(*arguments)

    monkeypatch.setattr(WatchedParameters, 'watch', restart_and_watch)
    node.parameter('/rate').on_change(lambda value: changes(value, None))
    master.parameters['/rate'] = 5
    assert changes.next() == 5


@pytest.mark.parametrize('known_again', [False, True], ids=['unknown', 'known_again'])
def test_values_and_watches_are_back_after_a_restart_of_the_master(
    mortal_master, monkeypatch, known_again
):
    """Also where the node opens a channel with the new master before anybody notices that it is
    new."""
    master = Master(mortal_master.url)
    node = create(master, '/robot1/driver', argv=['_given:=7'])
    rate, gains, none = (
        node.parameter('~rate', 1.5),
        node.parameter('/gains', {'p': 1}),
        node.parameter('~none'),
    )
    part = node.parameter('/gains/p', 1)
    master.parameters['/cached'] = 1
    assert node.ros.get_param_cached('/cached') == 1
    changes = Changes(node).of(rate, gains, none, part)
    rate.set(2.5)
    assert changes.get() == 2.5
    looked, repair = threading.Event(), PrivateRospy.repair
    monkeypatch.setattr(PrivateRospy, 'repair', lambda *args: looked.is_set() and repair(*args))
    mortal_master.end()
    mortal_master.come_back()
    if known_again:
        node.output_channel('/opened', 'std_msgs/Empty')
    looked.set()
    until(lambda: {rate.name, gains.name + '/p', '/robot1/driver/given'} <= set(master.parameters))
    assert (rate.value, gains.value, none.value) == (1.5, {'p': 1}, None)
    until(lambda: told_of(changes, master, rate.name, 3.5))
    master.parameters[none.name] = 'something'
    master.parameters['/gains/p'] = 2
    told = changes.until_now()
    assert sorted(told, key=str) == [
        ('/gains', {'p': 2}),
        ('/gains/p', 2),
        (none.name, 'something'),
    ]
    master.parameters['/cached'] = 2
    assert node.ros.get_param_cached('/cached') == node.ros.get_param('/cached') == 2


def told_of(changes, master, name, value):
    """Whether the master tells the node of a change, which it does once the node has asked for
    it."""
    master.parameters[name] = value
    return not changes._mailbox.empty() and changes.until_now()


# -- values that are kept


@pytest.fixture
def asked(monkeypatch):
    """The names of the parameters whose values the master was asked for."""
    names, call = [], Master.call

    def note(self, method, *args, **options):
        if method == 'getParam':
            names.append(args[0])
        return call(self, method, *args, **options)

    monkeypatch.setattr(Master, 'call', note)
    return names


def until_told(node, parameter):
    """Wait until the node has heard what the master had to tell of the parameter by now."""
    Changes(node).until_now()
    return parameter.value


@pytest.mark.parametrize('value', [5, 2.5, 'text', True, [1, 2], {'p': 1}, None])
def test_a_value_is_asked_for_once_and_then_kept(master, asked, value):
    parameter = create(master).parameter('~kept')
    if value is not None:
        parameter.set(value)
    del asked[:]
    for _ in range(3):
        assert parameter.value == value
    assert parameter.node.parameter('~kept').value == value
    assert asked == ['/node/kept']


def test_what_another_program_sets_or_deletes_is_known_as_soon_as_the_master_tells(master, asked):
    rate = create(master, '/robot1/driver').parameter('~rate', initialized=1.0)
    assert rate.value == 1.0
    for given, value in ('2.5', 2.5), ('3', 3.0):
        assert run(master.url, 'rosparam', 'set', PRIVATE, given).returncode == 0
        assert until_told(rate.node, rate) == value
    assert run(master.url, 'rosparam', 'delete', PRIVATE).returncode == 0
    assert until_told(rate.node, rate) is None
    assert run(master.url, 'rosparam', 'set', PRIVATE, '4').returncode == 0
    assert until_told(rate.node, rate) == 4.0
    assert asked == 5 * [PRIVATE]


@pytest.mark.parametrize(
    'change, value',
    [
        (lambda node, other: node.parameter('/gains').set({'p': 7}), {'p': 7}),
        (lambda node, other: node.parameter('/gains/p').set(7), {'p': 7, 'i': [1, 2]}),
        (lambda node, other: other.parameter('/gains').set({'p': 7}), {'p': 7}),
        (lambda node, other: other.parameter('/gains/p').set(7), {'p': 7, 'i': [1, 2]}),
        (lambda node, other: node.ros.set_param('gains/p', 7), {'p': 7, 'i': [1, 2]}),
        (lambda node, other: other.ros.set_param('gains/p', 7), {'p': 7, 'i': [1, 2]}),
        (lambda node, other: node.ros.delete_param('gains/p'), {'i': [1, 2]}),
        (lambda node, other: other.ros.delete_param('gains'), None),
        (lambda node, other: node.master.parameters.update({'/gains/p': 7}), {'p': 7, 'i': [1, 2]}),
        (lambda node, other: node.master.parameters.pop('/gains/p'), {'i': [1, 2]}),
        (lambda node, other: node.master.parameters.pop('/gains'), None),
        (lambda node, other: node.parameter('/gains').set(5), 5),
    ],
)
def test_what_this_process_changes_is_known_at_once(master, change, value):
    node, other = create(master), create(master, '/other')
    node.parameter('/gains').set({'p': 1, 'i': [1, 2]})
    read = [
        each.parameter(name)
        for each in (node, other)
        for name in ('/gains', '/gains/p', '/gains/i', '/gains/d')
    ]
    parts = [value.get(name) for name in 'pid'] if isinstance(value, dict) else 3 * [None]
    for _ in range(3):
        change(node, other)
        assert [each.value for each in read] == 2 * [value, *parts]
        node.parameter('/gains').set({'p': 1, 'i': [1, 2]})
        assert [each.value for each in read] == 2 * [{'p': 1, 'i': [1, 2]}, 1, [1, 2], None]


def test_what_is_done_to_a_value_is_not_done_to_the_one_that_is_kept(master, asked):
    gains = create(master).parameter('/gains', {'limits': [1, 2], 'pid': {'p': 1}})
    for _ in range(2):  # the first one was asked for, the second one is kept
        gains.value['limits'].append(3)
        gains.value['pid']['p'] = 5
        gains.value.clear()
    assert gains.value == {'limits': [1, 2], 'pid': {'p': 1}}
    assert asked == ['/gains']


def test_a_block_for_changes_reads_the_value_that_it_is_told(master):
    rate = create(master).parameter('~rate', 1)
    read = Mailbox()
    rate.on_change(lambda value: read((value, rate.value), None))
    for value in range(20):
        assert rate.value is not None
        if value % 2:
            rate.set(value)
        else:
            master.parameters[rate.name] = value
        assert read.next() == (value, value)
    assert rate.node.failures == []


def test_of_many_who_set_it_at_once_the_last_value_stays(master):
    nodes = [create(master, f'/node{number}') for number in range(3)]
    rates = [node.parameter('/rate', 0) for node in nodes]

    def work(number):
        for value in range(20):
            rates[number].set(100 * number + value)
            master.api('/elsewhere').setParam('/rate', -value)
            rates[number - 1].value

    threads = [in_thread(work, number) for number in range(3)]
    assert all(map(ended, threads))
    last = master.parameters['/rate']
    assert [until_told(node, rate) for node, rate in zip(nodes, rates)] == 3 * [last]


def test_a_kept_value_is_of_one_run_and_one_master(mortal_master):
    master = Master(mortal_master.url)
    node = create(master)
    rate, free = node.parameter('~rate', 1), node.parameter('~free')
    rate.set(2)
    free.set('set')
    assert (rate.value, free.value) == (2, 'set')
    node.stop()
    master.parameters[rate.name] = 3
    node.start()
    assert (rate.value, free.value) == (3, 'set')
    mortal_master.end()
    assert (rate.value, free.value) == (3, 'set')  # what was known last
    mortal_master.come_back()
    until(lambda: (rate.value, free.value) == (1, None))
    master.parameters[free.name] = 'again'
    assert until_told(node, free) == 'again'


def test_a_set_that_fails_leaves_nothing_that_may_be_old(mortal_master):
    rate = create(Master(mortal_master.url)).parameter('~rate', 1)
    assert rate.value == 1
    mortal_master.end()
    with pytest.raises(MasterUnreachableError):
        rate.set(2)  # nobody knows whether it has been set
    with pytest.raises(MasterUnreachableError):
        rate.value


def test_a_master_that_is_away_is_named(monkeypatch):
    ros_master = InProcessMaster()
    monkeypatch.setenv('ROS_MASTER_URI', ros_master.url)
    rate = create(Master(ros_master.url)).parameter('~rate', 1)
    ros_master.stop()
    for use in (
        lambda: rate.value,
        lambda: rate.set(2),
        lambda: rate.on_change(print),
        lambda: rate.node.parameter('~other', 1),
    ):
        with pytest.raises(MasterUnreachableError, match=ros_master.url):
            use()
    node_registry.stop_all()
