"""Nodes: their names, addresses and arguments, souls and time, starts, stops and changes."""
import concurrent.futures
import contextlib
import gc
import re
import socket
import threading
import time
import urllib.parse
import weakref

import pytest
import rosgraph_msgs.msg
import rospy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import pharos
from helpers import TIMEOUT, Gate, Hasty, Program, create, fill, has_come_to, registrations
from pharos import BlockNode, Node, NodeNameInUseError, NodeStoppedError, PharosError
from pharos.intraprocess.callback_queues import CallbackQueue
from pharos.private_rospy import xmlrpc
from pharos.private_rospy.run import Run
from pharos.testing import Mailbox, until

STRING = 'std_msgs/String'


@pytest.fixture
def node(master):
    return create(master)


class Driver(Node):
    """It opens its channels itself, and says when it starts and stops."""

    def __init__(self, wheels=4, log=None):
        super().__init__()
        self.wheels, self.log_of_life = wheels, [] if log is None else log

    def start(self):
        super().start()
        self.log_of_life.append('start')
        self.interested_in('/steer', STRING, delegate=self.steer)

    def steer(self, message, channel):
        self.send_to('/steered', typed_as=STRING, data=f'{message.data} {self.wheels}')

    def stop(self):
        self.log_of_life.append('stop')
        super().stop()


# -- names


@pytest.mark.parametrize(
    'named, argv, namespace, name',
    [
        ('driver', [], None, '/driver'),
        ('/driver', [], None, '/driver'),
        ('/robot/driver', [], None, '/robot/driver'),
        ('robot/driver', [], None, '/robot/driver'),
        ('driver', [], '/robot', '/robot/driver'),
        ('/driver', [], '/robot', '/driver'),
        ('driver', ['__name:=pilot'], None, '/pilot'),
        ('/robot/driver', ['__name:=helmsman'], None, '/robot/helmsman'),
        ('driver', ['__ns:=/robot'], None, '/robot/driver'),
        ('driver', ['__ns:=robot'], '/outer', '/robot/driver'),
        ('driver', ['__name:=pilot', '__ns:=/robot'], None, '/robot/pilot'),
        ('driver', ['program', 'plain', '--option'], None, '/driver'),
    ],
)
def test_name_comes_from_arguments(master, monkeypatch, named, argv, namespace, name):
    if namespace:
        monkeypatch.setenv('ROS_NAMESPACE', namespace)
    assert create(master, named, argv=argv).name == name
    assert name in [node.name for node in master.nodes()]


BAD_NAMES = ['', '/', 'two words', '1st', 'a//b', 'a-b', '~a', 'ä', 'a/', None, 7, '/a/1']


def test_impossible_name_raises_value_error(master):
    for name in BAD_NAMES:
        with pytest.raises(ValueError):
            create(master, name)


LETTERS = 'abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ'
BASES = st.text(f'{LETTERS}0123456789_', min_size=1, max_size=12).filter(lambda s: s[0] in LETTERS)


@settings(max_examples=12, suppress_health_check=list(HealthCheck), deadline=None)
@given(parts=st.lists(BASES, min_size=1, max_size=3))
def test_every_legal_name_works(master, parts):
    name = '/' + '/'.join(parts)
    with master.create(BlockNode, named=name) as node:
        assert node.name == name
        assert registrations(master, name)[0] == ['/rosout']


def test_name_in_use_is_refused(master, node):
    with pytest.raises(pharos.NodeNameInUseError, match='/node'):
        create(master)
    assert node.is_running


def test_name_of_peer_is_refused(master, peer):
    with pytest.raises(pharos.NodeNameInUseError):
        create(master, peer.name)
    assert peer.value('rospy.is_shutdown()') is False


def test_name_is_free_if_another_node_has_its_uri(master):
    other = create(master, '/other')
    master.call('registerPublisher', '/words', STRING, other.uri, caller_id='/talker')
    assert master.call('lookupNode', '/talker') == other.uri
    assert create(master, '/talker').is_running
    assert other.is_running


def test_first_node_takes_name_of_argv(master):
    argv = ['__name:=pilot', '__ns:=/robot', '/a:=/b']
    names = [create(master, name, argv=argv).name for name in ('one', 'two', 'three')]
    assert names == ['/robot/pilot', '/robot/two', '/robot/three']


def test_remappings_hold_for_all(master):
    nodes = [create(master, name, argv=['/a:=/b', 'c:=d']) for name in ('/one', '/two')]
    for node in nodes:
        assert node.interested_in('/a', STRING).topic == '/b'
        assert node.interested_in('c', STRING).topic == '/d'


def test_argv_sets_private_parameters(master):
    create(master, '/node', argv=['_rate:=2.5', '_text:=abc', '_list:=[1, 2]'])
    values = [master.parameters[f'/node/{name}'] for name in ('rate', 'text', 'list')]
    assert values == [2.5, 'abc', [1, 2]]


def test_nodes_are_many_in_one_process(master):
    nodes = [create(master, f'/node{number}') for number in range(10)]
    found = {node.name: node for node in master.nodes()}
    assert [found[node.name] for node in nodes] == nodes
    assert len({node.uri for node in nodes}) == len({node.tcp_port for node in nodes}) == 10


# -- addresses


def test_ports_are_those_asked_for(master):
    with socket.create_server(('127.0.0.1', 0)) as one, socket.create_server(
        ('127.0.0.1', 0)
    ) as two:
        ports = one.getsockname()[1], two.getsockname()[1]
    node = create(master, '/node', tcp_port=ports[0], xmlrpc_port=ports[1])
    assert (node.tcp_port, node.xmlrpc_port) == ports
    assert urllib.parse.urlsplit(node.uri).port == ports[1]


def test_impossible_port_is_refused(master):
    for port in [-1, 65536, 'any', 1.5]:
        with pytest.raises((ValueError, TypeError)):
            create(master, '/node', tcp_port=port)


def test_domain_is_what_node_advertises(master):
    node = create(master, '/node', domain='127.0.0.2')
    assert node.domain == urllib.parse.urlsplit(node.uri).hostname == '127.0.0.2'


def test_impossible_domain_is_refused(master):
    for domain in ['', 'two words', 'http://host', 7]:
        with pytest.raises((ValueError, TypeError)):
            create(master, '/node', domain=domain)


# -- classes and blocks


def test_keywords_go_to_init(master):
    assert create(master, '/driver', Driver, wheels=3).wheels == 3


def test_failing_start_leaves_nothing(master):
    class Broken(Node):
        def start(self):
            super().start()
            self.interested_in('/a', STRING)
            raise RuntimeError('no wheels')

    with pytest.raises(RuntimeError, match='no wheels'):
        create(master, '/broken', Broken)
    assert registrations(master, '/broken') == [[], [], []]


def test_delegate_gets_message_and_channel(master, node):
    box, seen = Mailbox(), threading.Event()

    def delegate(message, channel):
        box(message, channel)
        box(channel, channel)
        seen.set()

    other = create(master, '/other', delegate=delegate)
    channel = other.interested_in('/a', STRING)
    node.send_to('/a', data='hello')
    assert box.next().data == 'hello'
    assert box.next() is channel


def test_block_must_be_callable(node):
    with pytest.raises(TypeError):
        node.delegate = 'no block'
    node.soul = 'no block'
    with pytest.raises(TypeError):
        node.execute()


# -- souls and time


def test_execute_runs_soul_and_returns(master):
    node = create(master, '/node', soul=lambda me: (me.name, threading.current_thread()))
    assert node.execute() == ('/node', threading.current_thread())


def test_execute_without_soul_is_an_error(node):
    with pytest.raises(PharosError, match='soul'):
        node.execute()


def test_new_soul_runs_next(node):
    node.soul = lambda me: 'one'
    assert node.execute() == 'one'
    node.soul = lambda me: 'two'
    assert node.execute() == 'two'


def test_fork_runs_soul_in_thread(node):
    ran = []
    node.soul = lambda me: ran.append(threading.current_thread())
    thread = node.fork()
    thread.join(TIMEOUT)
    assert ran == [thread]


def test_fork_takes_block_and_name(node):
    ran = []
    thread = node.fork(lambda me: ran.append(me), name='steering')
    thread.join(TIMEOUT)
    assert ran == [node]
    assert 'steering' in thread.name


@pytest.mark.parametrize('wait', ['every', 'sleep'])
def test_stop_ends_soul(node, wait):
    began, ended = threading.Event(), threading.Event()

    def soul(me):
        try:
            began.set()
            if wait == 'sleep':
                me.sleep(3600)
            for turn in me.every(3600):
                began.set()
        finally:
            ended.set()

    thread = node.fork(soul)
    assert began.wait(TIMEOUT)
    node.stop()
    assert ended.is_set()
    thread.join(TIMEOUT)
    assert not node.errors


def test_every_counts_its_turns(node):
    turns = []
    for turn in node.every(0.001):
        turns.append(turn)
        if len(turns) == 3:
            break
    assert turns == [0, 1, 2]


def test_impossible_period_is_refused(node):
    for seconds in [0, -1, 'often', float('nan')]:
        with pytest.raises((ValueError, TypeError)):
            node.every(seconds)


@pytest.mark.parametrize('is_main', [True, False], ids=['main thread', 'other thread'])
def test_sleep_raises_after_stop_begins(node, is_main):
    stopping, may_end = threading.Event(), threading.Event()

    def linger(me):
        try:
            me.sleep(3600)
        finally:
            stopping.set()
            may_end.wait(TIMEOUT)

    def sleep():
        with pytest.raises(NodeStoppedError):
            node.sleep(0.01)

    node.stop_timeout = TIMEOUT
    node.fork(linger)
    with concurrent.futures.ThreadPoolExecutor() as pool:
        stop = pool.submit(node.stop)
        assert stopping.wait(TIMEOUT)
        try:
            sleep() if is_main else pool.submit(sleep).result(TIMEOUT)
        finally:
            may_end.set()
        stop.result(TIMEOUT)


def test_every_and_sleep_follow_ros_time(master):
    master.parameters['/use_sim_time'] = True
    try:
        node, clock = create(master), create(master, '/clock_of_all')
        clocks = clock.output_channel('/clock', 'rosgraph_msgs/Clock')
        ended = [threading.Event(), threading.Event()]

        def turn(me):
            for turn in me.every(100):
                if turn == 2:
                    break
            ended[0].set()

        def sleep(me):
            me.sleep(100)
            ended[1].set()

        clocks.publish(rosgraph_msgs.msg.Clock(rospy.Time(1)))
        until(lambda: node.ros.Time.now().to_sec() == 1)
        node.fork(turn), node.fork(sleep)
        seconds = 1
        while not all(event.wait(0.01) for event in ended):
            seconds += 50
            assert seconds < 1e5
            clocks.publish(rosgraph_msgs.msg.Clock(rospy.Time(seconds)))
    finally:
        del master.parameters['/use_sim_time']


def test_ended_soul_is_not_run_again(node):
    ran, begun = [], threading.Semaphore(0)
    node.fork(lambda me: ran.append(1)).join(TIMEOUT)
    node.fork(lambda me: ran.append(1) or 1 / 0).join(TIMEOUT)  # a job of that time
    node.fork(lambda me: (begun.release(), me.sleep(3600)))
    assert begun.acquire(timeout=TIMEOUT)
    node.restart()
    assert begun.acquire(timeout=TIMEOUT)
    assert ran == [1, 1]


@pytest.mark.parametrize('end', ['raises', 'stops', 'stops by itself'])
def test_restart_runs_a_soul_again_that_has_not_returned(node, end):
    begun = threading.Semaphore(0)

    def work(me):
        begun.release()
        if end == 'raises':
            raise ValueError('in vain')
        if end == 'stops by itself':
            me.stop()
        me.sleep(3600)

    node.soul = work
    node.fork()
    for _ in range(3):
        assert begun.acquire(timeout=TIMEOUT)
        if end == 'raises':
            until(lambda: node.failures)
        elif end == 'stops':
            node.stop()
        else:
            until(lambda: not node.is_running)
        node.restart()
    assert begun.acquire(timeout=TIMEOUT)


def test_ended_soul_leaves_its_name_alone(node):
    blocks = weakref.WeakSet()
    for number in range(30):

        def block(me):
            pass

        blocks.add(block)
        node.fork(block, name=f'job {number}').join(TIMEOUT)
    del block

    def are_gone():
        gc.collect()
        return not blocks

    until(are_gone)
    assert node.health().ended_souls == [f'job {number}' for number in range(20, 30)]


def test_soul_of_a_former_run_ends(node):
    begun, ended = [], threading.Semaphore(0)

    def watch(me):
        begun.append(me)
        try:
            if len(begun) == 1:
                me.restart()
            me.sleep(3600)
        except pharos.NodeStoppedError:
            ended.release()
            raise

    node.fork(watch)
    assert ended.acquire(timeout=TIMEOUT)
    assert len(begun) == 2 and node.health().souls == 1


def test_thread_that_sleeps_ends_with_its_node(node):
    sleep = node.ros.rostime.wallsleep

    def work():
        with contextlib.suppress(SystemExit):
            while True:
                sleep(0.01)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    node.stop()
    thread.join(TIMEOUT)
    assert not thread.is_alive()


def test_clock_that_jumps_back_stops_no_turns(master):
    master.parameters['/use_sim_time'] = True
    node, turns = create(master), []
    clock = create(master, '/clock_of_all').output_channel('/clock', 'rosgraph_msgs/Clock')

    def tick(seconds):
        clock.publish(rosgraph_msgs.msg.Clock(rospy.Time(seconds)))
        until(lambda: node.ros.Time.now().to_sec() == seconds)

    tick(100)
    node.fork(lambda me: [turns.append(turn) for turn in me.every(1)])
    until(lambda: turns)
    for start in 100, 10:
        count = len(turns)
        for seconds in range(start + 2, start + 9, 2):
            tick(seconds)
        until(lambda count=count: len(turns) > count)
    del master.parameters['/use_sim_time']


# -- starts and stops


def test_stop_unregisters_everything(master, node):
    node.interested_in('/a', STRING), node.output_channel('/b', STRING)
    node.serve('/c', 'std_srvs/Empty', lambda request: None)
    assert registrations(master, '/node')[:2] == [['/b', '/rosout'], ['/a']]
    node.stop()
    assert registrations(master, '/node') == [[], [], []]


def test_second_stop_does_nothing(node):
    node.stop()
    node.stop()
    assert not node.is_running


def test_second_start_is_an_error(node):
    with pytest.raises(PharosError):
        node.start()
    assert node.is_running


def test_lifecycle_is_told(master):
    seen = []

    class Watched(Node):
        def __init__(self):
            seen.append(self.lifecycle.value)

        def stop(self):
            seen.append(self.lifecycle.value)
            super().stop()

    node = create(master, '/watched', Watched)
    node.stop()
    assert [*seen, node.lifecycle.value] == ['new', 'running', 'stopped']


@pytest.mark.parametrize('where', ['delegate', 'soul', 'service'])
def test_node_stops_from_own_block(master, node, where):
    other = create(master, '/other')
    other.stop_timeout = 2 * TIMEOUT  # it does not wait for the block that stops it
    if where == 'delegate':
        other.interested_in('/a', STRING, delegate=lambda message, channel: other.stop())
        node.send_to('/a', data='x')
    elif where == 'soul':
        other.fork(lambda me: me.stop())
    else:
        other.serve('/end', 'std_srvs/Empty', lambda request: other.stop())
        with contextlib.suppress(PharosError):  # the answer may end with the node
            master.lookup_service('/end').call()
    until(lambda: other.lifecycle is pharos.Lifecycle.STOPPED)
    until(lambda: registrations(master, '/other') == [[], [], []])


def test_sent_before_stop_arrives(master, node, peer):
    peer.hear('/a', STRING)
    for number in range(50):
        node.send_to('/a', typed_as=STRING, data=str(number))
    node.stop()
    assert [message.data for message in peer.heard('/a', 50)] == [str(n) for n in range(50)]


@pytest.mark.parametrize('again', ['start', 'restart'])
def test_channels_and_services_come_back(master, node, again):
    other = create(master, '/other')
    box = Mailbox(other, '/a', STRING)
    out = other.output_channel('/b', STRING, latch=True)
    out.send(data='kept')
    other.serve('/c', 'std_srvs/Trigger', lambda request: (True, 'yes'))
    if again == 'start':
        other.stop()
        other.start()
    else:
        other.restart()
    node.send_to('/a', data='x')
    assert box.next().data == 'x'
    assert Mailbox(node, '/b').next().data == 'kept'
    assert master.lookup_service('/c').call().message == 'yes'
    assert out in other.channels and box.channel in other.channels


def test_start_of_class_opens_once(master, node):
    log = []
    driver = create(master, '/driver', Driver, log=log)
    driver.restart()
    box = Mailbox(node, '/steered', STRING)
    node.send_to('/steer', data='left')
    assert box.next().data == 'left 4'
    node.send_to('/steer', data='right')
    assert box.next().data == 'right 4'
    assert log == ['start', 'stop', 'start']


def test_overridden_stop_runs_at_rosnode_kill(master):
    log = []
    driver = create(master, '/driver', Driver, log=log)
    with Program(['rosnode', 'kill', '/driver'], master.url) as program:
        program.wait()
    until(lambda: driver.lifecycle is pharos.Lifecycle.STOPPED)
    assert log == ['start', 'stop']


STOPPED = {
    'interested_in': lambda node: node.interested_in('/a', STRING),
    'output_channel': lambda node: node.output_channel('/a', STRING),
    'send_to': lambda node: node.send_to('/a', typed_as=STRING, data='x'),
    'serve': lambda node: node.serve('/a', 'std_srvs/Empty', lambda request: None),
    'parameter': lambda node: node.parameter('~a'),
    'execute': lambda node: node.execute(),
    'fork': lambda node: node.fork(),
    'sleep': lambda node: node.sleep(0.01),
    'every': lambda node: list(node.every(0.01)),
    'wait_for_message': lambda node: node.wait_for_message('/a', STRING, 0.01),
    'lookup_service': lambda node: node.lookup_service('/a'),
    'ros_import': lambda node: node.ros_import('message_filters'),
}


def test_stopped_node_refuses_use(node):
    node.soul = lambda me: None
    node.stop()
    for use in STOPPED.values():
        with pytest.raises(NodeStoppedError, match='/node'):
            use(node)
    assert node.ros.is_shutdown()  # or a loop on it would not get to its last lines


def test_node_without_a_start_has_no_rospy(master):
    class Early(Node):
        def __init__(self):
            self.is_over = self.ros.is_shutdown()

    with pytest.raises(NodeStoppedError):
        create(master, node_class=Early)


def test_channel_of_a_stopped_node_stays_closed(node):
    channel = node.output_channel('/words', STRING)
    node.stop()
    with pytest.raises(NodeStoppedError, match='/node'):
        channel.open()
    assert channel.closed


def test_restarted_node_hears_no_old_message(master):
    ear, gate, _, mouth = fill(master)
    ear.stop()
    gate.open.set()
    ear.start()
    mouth.send_to('/words', data='new')
    gate.wait_for(lambda message: message.data == 'new')
    assert gate.heard == ['first', 'new']


def test_stop_drops_what_waits(master):
    ear, gate, channel, _ = fill(master)
    ear.stop_timeout = TIMEOUT
    stopping = threading.Thread(target=ear.stop)
    stopping.start()
    until(lambda: channel.callback_queue.closed)
    gate.open.set()
    stopping.join(TIMEOUT)
    assert gate.heard == ['first']


def test_failed_start_keeps_channels(master, node):
    box = Mailbox(node, '/words', STRING)
    node.stop()
    with create(master, '/node'):
        with pytest.raises(NodeNameInUseError):
            node.start()
    node.start()
    create(master, '/other').send_to('/words', typed_as=STRING, data='x')
    assert box.next().data == 'x'


def test_stop_waits_for_the_delegate(master, node):
    words, gate, mouth = [], Gate(), create(master, '/mouth')
    create(master, '/wheels').interested_in('/speed', STRING, lambda m: words.append(m.data))
    speed = node.output_channel('/speed', STRING)
    node.interested_in('/words', STRING, lambda message: [gate(message), speed.send(data='halt')])
    mouth.send_to('/words', data='x')
    assert gate.begun.wait(TIMEOUT)
    node.stop_timeout = TIMEOUT
    thread = threading.Thread(target=node.stop)
    thread.start()
    until(lambda: has_come_to(thread, CallbackQueue.close))
    gate.open.set()
    until(lambda: words or node.errors)
    thread.join(TIMEOUT)
    assert words == ['halt']


def test_stop_fires_no_timer(node):
    fired = []
    timer = node.ros.Timer(node.ros.Duration(3600), fired.append)
    until(lambda: has_come_to(timer, Run.sleep))
    node.stop()
    assert not fired


# -- becoming another


class Slow(Node):
    def on_message(self, message, channel):
        self.said.append(f'slow {message.data}')

    def answer(self, request):
        return True, 'slow'

    def work(self):
        self.said.append('slow soul')


class Fast(Slow):
    def on_message(self, message, channel):
        self.said.append(f'fast {message.data}')

    def answer(self, request):
        return True, 'fast'

    def work(self):
        self.said.append('fast soul')


def test_node_becomes_another_class(master, node):
    other = create(master, '/other', Slow)
    other.said = []
    channel = other.interested_in('/a', STRING, delegate=other.on_message)
    other.serve('/which', 'std_srvs/Trigger', other.answer)
    node.send_to('/a', data='1')
    until(lambda: other.said)
    uri = other.uri
    other.soul = other.work
    other.become(Fast)
    node.send_to('/a', data='2')
    until(lambda: len(other.said) == 2)
    assert other.said == ['slow 1', 'fast 2']
    assert isinstance(other, Fast) and other.uri == uri and channel in other.channels
    assert master.lookup_service('/which').call().message == 'fast'
    other.execute()
    assert other.said[2:] == ['fast soul']


@pytest.mark.parametrize('again', [False, True], ids=['delegate', 'retry'])
def test_delegate_changes_the_class_of_its_node(master, node, again):
    """It need not wait for itself, also if the delegate runs again."""
    other = create(master, '/other')

    def delegate(message):
        if again and not other.failures:
            raise RuntimeError
        other.become(Fast)

    other.interested_in('/a', STRING, delegate)
    node.send_to('/a', typed_as=STRING, data='x')
    if again:
        until(lambda: other.failures)
        threading.Thread(target=other.failures[0].retry, daemon=True).start()
    until(lambda: isinstance(other, Fast))


def test_change_that_waits_ends_with_the_stop(master, node):
    other, begun, go_on = create(master, '/other'), threading.Event(), threading.Event()
    other.interested_in('/a', STRING, lambda message: [begun.set(), go_on.wait(TIMEOUT)])
    node.send_to('/a', typed_as=STRING, data='x')
    assert begun.wait(TIMEOUT)
    stopper = threading.Thread(target=other.stop, daemon=True)
    stopper.start()
    until(other._current_run.stopping.is_set)
    changer = threading.Thread(target=other.become, args=[Fast], daemon=True)
    changer.start()
    go_on.set()
    for thread in stopper, changer:
        thread.join(TIMEOUT)
        assert not thread.is_alive()


@pytest.mark.parametrize('cls', [dict, type('Plain', (), {}), 'Fast', None])
def test_node_becomes_only_a_node(node, cls):
    with pytest.raises(TypeError):
        node.become(cls)


# -- its rospy, its log, its health


def test_rospy_of_node_is_whole(node):
    ticked = threading.Event()
    node.ros.Timer(node.ros.Duration(0.001), lambda event: ticked.set())
    assert ticked.wait(TIMEOUT)
    assert node.ros.get_name() == '/node'
    assert node.ros.Time.now().to_sec() > 0


@pytest.mark.parametrize(
    'level, number', [('info', 2), ('warn', 4), ('warning', 4), ('error', 8), ('fatal', 16)]
)
def test_log_goes_to_rosout(master, node, level, number):
    box = Mailbox(create(master, '/ear'), '/rosout', 'rosgraph_msgs/Log')
    node.log('out of fuel', level)
    line = box.wait_for(lambda line: line.name == '/node' and line.msg == 'out of fuel')
    assert line.level == number
    assert line.file == 'test_nodes.py'


def test_unknown_log_level_is_refused(node):
    with pytest.raises(ValueError, match='loud'):
        node.log('x', 'loud')


def test_health_tells_about_node(master, node, peer):
    peer.hear('/a', STRING)
    node.send_to('/a', typed_as=STRING, data='x')
    health = node.health()
    assert health.registered is True
    assert health.connections['TCPROS'] >= 1
    assert (health.dropped, health.errors) == (0, 0)
    assert health.threads > 0
    assert 'registered=True' in str(health)


# -- a slow master

#: questions to the master, one after another, of a node with two channels from create() to stop()
MAX_QUESTIONS = 11  # of a start, two channels and a stop, one after another


@pytest.fixture
def slow_master(master, monkeypatch):
    """A master whose answers take a while: ``delays`` has those of the next ones, in seconds."""

    class Slow:
        url = master.url
        lock, in_flight, rounds, delays = threading.Lock(), 0, [], iter(())

    request = xmlrpc._Transport.single_request

    def ask(transport, host, *arguments):
        if host not in master.url:
            return request(transport, host, *arguments)
        with Slow.lock:
            if not Slow.in_flight:  # those that are asked meanwhile take no further time
                Slow.rounds.append(re.findall('<methodName>(.*)</methodName>', str(arguments)))
            Slow.in_flight += 1
        try:
            time.sleep(next(Slow.delays, 0.01))
            return request(transport, host, *arguments)
        finally:
            with Slow.lock:
                Slow.in_flight -= 1

    monkeypatch.setattr(xmlrpc._Transport, 'single_request', ask)
    return Slow


def test_start_and_stop_ask_few_questions(master, slow_master):
    """With a master of 2 s for an answer, each one counts."""
    node = create(master)
    node.interested_in('/heard', STRING)
    node.output_channel('/sent', STRING)
    node.stop()
    assert len(slow_master.rounds) <= MAX_QUESTIONS, slow_master.rounds


def test_slow_master_is_told_once(master, slow_master, capfd, monkeypatch):
    monkeypatch.setattr('pharos.transcript._shown_keys', set())  # of other tests
    slow_master.delays = iter([2, 2])
    create(master).stop()
    lines = ''.join(capfd.readouterr()).splitlines()
    assert len([line for line in lines if master.url in line]) == 1


def test_health_counts_souls_and_the_log_names_what_is_left(master):
    node, free = create(master, node_class=Hasty), threading.Event()
    log = Mailbox(create(master, '/ear'), '/rosout', 'rosgraph_msgs/Log')
    node.fork(lambda me: None, name='short').join(TIMEOUT)
    node.fork(lambda me: free.wait(TIMEOUT), name='stubborn')
    assert (node.health().souls, node.health().ended_souls) == (1, ['short'])
    node.stop()
    log.wait_for(lambda line: 'left behind' in line.msg and 'stubborn' in line.msg)
    assert '/node' not in str(master.system_state())
    free.set()


def test_log_names_a_delegate_that_is_left(master):
    log = Mailbox(create(master, '/log'), '/rosout', 'rosgraph_msgs/Log')
    ear, gate, *_ = fill(master)
    ear.stop()
    log.wait_for(lambda line: 'left behind' in line.msg and 'a delegate' in line.msg)
    gate.open.set()
