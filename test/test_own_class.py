"""Classes and blocks of users: their names, parameters, mistakes, and the order of their start."""
import collections
import concurrent.futures
import contextlib
import functools
import threading
import time

import pytest
from std_msgs.msg import String

from helpers import TIMEOUT, create, fill, has_come_to, registrations
import pharos
from pharos import Node, NodeStoppedError, PharosError
from pharos.intraprocess.callback_queues import CallbackQueue
from pharos.testing import Mailbox, until

STRING, TRIGGER = 'std_msgs/String', 'std_srvs/Trigger'
NAMES = '''
    abandon battery bridge buffer callback check_running client close config count data
    delegate_runs enabled end_now error goal image init listener lock loop mission mode motor opened
    parameters peer_name pose publish queue rate read_parameters refused remappings report reset
    resolve run run_class sensor server setup shutdown souls speed state status step subscribe thread
    tick timer told update
'''.split()


@pytest.fixture
def sender(master):
    return create(master, '/sender')


@pytest.fixture
def other(master):
    return create(master, '/other')


# -- names


class Robot(Node):
    own = {}  # attributes that it gives itself

    def start(self):
        super().start()
        vars(self).update(self.own)
        self.interested_in('/orders', STRING, delegate=self.obey)
        self.serve('/ask', TRIGGER, lambda request: (True, 'yes'))
        self.fork(lambda: self.send_to('/greetings', typed_as=STRING, data='hello'))

    def obey(self, message):
        if message.data == 'fail':
            raise KeyError('an order')
        self.send_to('/done', typed_as=STRING, data=message.data)


calls = []  # of the robot's own methods
METHODS = {name: lambda self, *_, name=name, **__: calls.append(name) for name in NAMES}
ATTRIBUTES = {'own': dict.fromkeys(NAMES, 'of the robot')}
PUBLIC = {'own': {'name': 'left', 'failures': 0, 'uri': 'rtsp://x', 'master': 'x', 'domain': 0}}


@pytest.mark.parametrize('names', [METHODS, ATTRIBUTES, PUBLIC], ids='methods own public'.split())
def test_robot_has_own_names(master, sender, other, names):
    greetings, done = Mailbox(other, '/greetings', STRING), Mailbox(other, '/done', STRING)
    robot = create(master, '/robot', type('Own', (Robot,), names))
    for run in 'first', 'second':
        assert greetings.next().data == 'hello'
        for order in run, 'fail', run:
            sender.send_to('/orders', data=order)
        assert [done.next().data for _ in range(2)] == [run, run]
        assert master.lookup_service('/ask').call().message == 'yes'
        assert list(map(repr, robot.errors)) == ["KeyError('an order')"]
        assert names is PUBLIC or robot.failures[0].message.data == 'fail'
        assert master.node('/robot') is robot and robot.health().registered
        robot.restart()
    robot.stop()
    assert registrations(master, '/robot') == [[], [], []]
    assert calls == []
    assert {name: getattr(robot, name) for name in robot.own} == robot.own


@pytest.mark.parametrize('own', [{'report': print}, {'failures': 0}])
def test_failing_delegate_silences_no_other(master, sender, other, own):
    robot = create(master, '/robot', type('Robot', (Node,), own))
    vars(robot).update(own)
    robot.interested_in('/t', STRING, delegate=lambda message: 1 / 0)
    box = Mailbox(other, '/t', STRING)
    for number in range(20):
        sender.send_to('/t', data=str(number))
    assert [box.next().data for _ in range(20)] == [str(number) for number in range(20)]
    until(lambda: robot.health().errors == 20)


# -- the parameters of blocks


class Camera(collections.deque):
    def look(self, message, verbose=False):
        self.append((message.data, verbose))


DELEGATES = {
    'channel': (lambda kept: lambda message, channel: kept.append(channel.topic), '/t'),
    'loop': (lambda kept: [lambda message, i=i: kept.append(i) for i in range(3)][1], 1),
    'method': (lambda kept: kept.look, ('x', False)),
    'args': (lambda kept: lambda *values: kept.append(len(values)), 2),
    'partial': (lambda kept: functools.partial(lambda i, message: kept.append(i), 1), 1),
    'in C': (lambda kept: kept.append, String('x')),
}


@pytest.mark.parametrize('make, expected', DELEGATES.values(), ids=DELEGATES)
def test_delegate_keeps_its_defaults(sender, other, make, expected):
    kept = Camera()
    other.interested_in('/t', STRING, delegate=make(kept))
    sender.send_to('/t', data='x')
    until(lambda: kept or other.errors)
    assert list(kept) == [expected]


def test_other_blocks_keep_defaults(master, other):
    for soul, value in [
        (lambda: 'none', 'none'),
        (lambda number=7: number, 7),
        (lambda me, number=7: (me, number), (other, 7)),
        (lambda *values: len(values), 1),
    ]:
        other.soul = soul
        assert other.execute() == value
    other.serve('/ask', TRIGGER, lambda request, text='yes': (True, text))
    assert master.lookup_service('/ask').call().message == 'yes'
    rate, kept = other.parameter('~rate', 1), []
    rate.on_change(lambda value, side='left': kept.append((value, side)))
    rate.set(2)
    assert kept == [(2, 'left')]


# -- mistakes


async def wait(*_):
    pass


Bare = type('Bare', (Node,), {})
Named = type('Named', (Node,), {'__init__': lambda self: Node.__init__(self, 'named')})
Wheeled = type('Wheeled', (Node,), {'__init__': lambda self, wheels=4: Node.__init__(self)})
Superless = type('Superless', (Node,), {'start': lambda self: None})
Hidden = type('Hidden', (Node,), {'delegate': lambda self, message: None})
Early = type('Early', (Node,), {'start': lambda self: self.interested_in('/t', STRING)})
MISTAKES = {
    'call': (lambda m: Bare(), PharosError, r"create\(Bare, named='bare'\)"),
    'argument': (lambda m: Bare('bare'), PharosError, r"create\(Bare, named='bare'\)"),
    'name': (lambda m: create(m, '/n', Named), PharosError, r"create\(Named, named=.*super"),
    'anonymous': (lambda m: create(m, '/n', Bare, anonymous=True), PharosError, 'named='),
    'hidden': (lambda m: create(m, '/n', Hidden), TypeError, 'has delegate, as Node has'),
    'size': (lambda m: create(m).interested_in('/t', STRING, print, 'left'), ValueError, 'left'),
    'keyword': (lambda m: create(m, '/n', Wheeled, anonymous=True), TypeError, 'named=anonymous'),
    'unknown': (lambda m: create(m, '/n', Wheeled, wings=2), TypeError, 'wings'),
    'class': (lambda m: create(m, '/n', dict), TypeError, ''),
    'no super': (lambda m: create(m, '/n', Superless), PharosError, 'super'),
    'early': (lambda m: create(m, '/n', Early), NodeStoppedError, 'super'),
    'soul': (lambda m: create(m, '/n', soul=wait), TypeError, 'async'),
    'forked': (lambda m: create(m).fork(wait), TypeError, 'async'),
    'delegate': (lambda m: create(m, '/n', delegate=wait), TypeError, 'async'),
    'of channel': (lambda m: create(m).interested_in('/t', STRING, wait), TypeError, 'async'),
    'of service': (lambda m: create(m).serve('/ask', TRIGGER, wait), TypeError, 'async'),
    'of change': (lambda m: create(m).parameter('~x').on_change(wait), TypeError, 'async'),
}


@pytest.mark.parametrize('use, error, said', MISTAKES.values(), ids=MISTAKES)
def test_mistake_says_what_to_write(master, use, error, said):
    with pytest.raises(error, match=said):
        use(master)
    state = repr(master.system_state())
    assert [name for name in ('/n', '/t', '/ask') if repr(name) in state] == []


def test_node_whose_own_stop_fails_is_stopped(master):
    class Careless(pharos.BlockNode):
        def stop(self):
            assert not self.is_running, 'its motor does not answer'

    node = create(master, node_class=Careless)
    node.ros.signal_shutdown('enough')
    until(lambda: node.lifecycle is pharos.Lifecycle.STOPPED)
    assert [type(error) for error in node.errors] == [AssertionError]


def drive_on(me):
    """Drive after the stop has sent its zero, as a block that computes meanwhile does."""
    me.begun.set()
    assert me.zeroed.wait(TIMEOUT)
    me.log('drives on')
    me.send_to('/speed', typed_as=STRING, data='on')
    me.send_to('/diary', typed_as=STRING, data='drove on')
    me.drove.set()


WORK = {
    'soul': lambda me: me.fork(drive_on),
    'delegate': lambda me: me.interested_in('/go', STRING, lambda message: drive_on(me)),
    'timer': lambda me: me.ros.Timer(me.ros.Duration(0.001), lambda event: drive_on(me), True),
    'thread': lambda me: threading.Thread(target=drive_on, args=[me], daemon=True).start(),
}


@pytest.mark.parametrize('way', ['stop', 'hook'])
@pytest.mark.parametrize('work', WORK)
def test_stop_has_the_last_word(master, sender, other, way, work):
    class Robot(Node):
        stop_timeout = 0.01

        def start(self):
            super().start()
            self.begun, self.zeroed, self.drove = [threading.Event() for _ in range(3)]
            self.send_to('/speed', typed_as=STRING, data='first')
            self.send_to('/diary', typed_as=STRING, data='first')
            if way == 'hook':
                self.ros.on_shutdown(self.halt)
            WORK[work](self)

        def halt(self):
            self.log('halts')
            self.send_to('/speed', typed_as=STRING, data='zero')
            self.zeroed.set()
            self.drove.wait(TIMEOUT)

        def stop(self):
            if way == 'stop':
                self.halt()
            super().stop()

    speeds, diary = Mailbox(other, '/speed', STRING), Mailbox(other, '/diary', STRING)
    log = Mailbox(other, '/rosout', 'rosgraph_msgs/Log')
    robot = create(master, '/robot', Robot)
    sender.send_to('/go', typed_as=STRING, data='go')
    assert robot.begun.wait(TIMEOUT)
    robot.stop()
    diary.wait_for(lambda message: message.data == 'drove on')
    log.wait_for(lambda message: message.msg == 'drives on')
    assert [each.data for each in speeds.all()] == ['first', 'zero']


@pytest.mark.parametrize('error', [None, OSError('no gripper')], ids=['no super', 'raises'])
def test_node_that_goes_on_after_its_stop_sends_on(master, other, error):
    class Careless(Node):
        def stop(self):
            self.send_to('/speed', typed_as=STRING, data='zero')
            if error:
                raise error

    box = Mailbox(other, '/speed', STRING)
    node = create(master, '/careless', Careless)
    with pytest.raises(OSError) if error else contextlib.nullcontext():
        node.stop()
    threading.Thread(target=node.send_to, args=['/speed', 'on']).start()
    assert [box.next().data for _ in 'ab'] == ['zero', 'on']
    Node.stop(node)


def test_second_stop_does_not_take_the_last_word(master, other):
    """As that of a `with` at Ctrl-C: the first one brakes in two steps."""

    class Braking(Node):
        braking = None

        def stop(self):
            if self.braking:
                self.braking.set()
                self.zeroed.wait(TIMEOUT)
                return
            self.braking, self.zeroed = threading.Event(), threading.Event()
            self.send_to('/speed', typed_as=STRING, data='slow')
            second = threading.Thread(target=self.stop)
            second.start()
            assert self.braking.wait(TIMEOUT)
            self.send_to('/speed', typed_as=STRING, data='zero')
            self.zeroed.set()
            second.join(TIMEOUT)
            super().stop()

    box = Mailbox(other, '/speed', STRING)
    create(master, '/braking', Braking).stop()
    assert [box.next().data for _ in 'ab'] == ['slow', 'zero']


def test_node_becomes_another_class_after_the_delegate(master):
    ear, gate, _, _ = fill(master)
    former_class = type(ear)
    thread = threading.Thread(target=ear.become, args=[pharos.BlockNode])
    thread.start()
    until(lambda: has_come_to(thread, CallbackQueue.run_exclusively))
    assert type(ear) is former_class
    gate.open.set()
    thread.join(TIMEOUT)
    assert type(ear) is pharos.BlockNode


# -- the order of a start


def test_delegate_waits_for_start(master, sender, other):
    class Filter(Node):
        def start(self):
            super().start()
            self.interested_in('/map', STRING, delegate=self.filter)
            self.output_channel('/more', STRING)
            self.filtered = self.output_channel('/filtered', STRING)

        def filter(self, message):
            self.filtered.send(data=message.data)

    box = Mailbox(other, '/filtered', STRING)
    sender.output_channel('/map', STRING, latch=True).send(data='map')
    node = create(master, '/filter', Filter)
    for _ in range(5):
        assert box.next().data == 'map'
        assert node.errors == []
        node.restart()


WAITS = {
    'sleep': lambda me: me.sleep(0.001),
    'every': lambda me: any(me.kept for _ in me.every(0.001)),
    'wait_for_message': lambda me: me.kept.append(me.wait_for_message('/map', STRING, TIMEOUT)),
}


@pytest.mark.parametrize('wait', WAITS.values(), ids=WAITS)
def test_start_waits_for_message(master, sender, wait):
    class Waiter(Node):
        def start(self):
            super().start()
            self.kept = []
            self.interested_in('/map', STRING, delegate=self.kept.append)
            while not self.kept:
                wait(self)

    sender.output_channel('/map', STRING, latch=True).send(data='map')
    node = create(master, '/waiter', Waiter)
    node.restart()
    assert node.kept[0].data == 'map'


def test_first_sends_open_one_channel(sender, other):
    barrier, topics = threading.Barrier(2), [f'/t{number}' for number in range(10)]
    boxes = [Mailbox(other, topic, STRING) for topic in topics]

    def send(text):
        for topic in topics:
            barrier.wait(TIMEOUT)
            sender.send_to(topic, typed_as=STRING, data=text)

    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        list(pool.map(send, ['one', 'two']))
    assert sorted(channel.topic for channel in sender.channels) == topics
    assert [sorted(box.next().data for _ in 'ab') for box in boxes] == 10 * [['one', 'two']]


def test_stop_without_that_of_node_is_told(master, capfd):
    class Forgetful(Node):
        def stop(self, reason='no reason'):
            return reason

    node = create(master, '/forgetful', Forgetful)
    assert node.stop(reason='tired') == 'tired'
    assert 'Forgetful.stop() must call super().stop()' in ''.join(capfd.readouterr())
    Node.stop(node)


def test_sleep_in_start_lets_delegates_run(master, monkeypatch):
    monkeypatch.setattr('pharos.private_rospy.run.HOLD_LIMIT', TIMEOUT)
    create(master, '/maps').output_channel('/map', STRING, latch=True).send(data='map')

    class Waiter(Node):
        def start(self):
            super().start()
            heard = Mailbox(self, '/map', STRING)
            while not heard.all() and time.monotonic() < end:
                self.sleep(0.01)

    end = time.monotonic() + TIMEOUT / 3
    create(master, '/waiter', Waiter)
    assert time.monotonic() < end


def test_constructor_cannot_wait_for_a_service(master):
    class Early(Node):
        def __init__(self):
            self.wait_for_service('/clear')

    with pytest.raises(NodeStoppedError):
        create(master, node_class=Early)


def test_start_may_wait_for_its_delegate(master, monkeypatch):
    monkeypatch.setattr('pharos.private_rospy.run.HOLD_LIMIT', 0.1)

    class Patient(pharos.BlockNode):
        def start(self):
            super().start()
            heard = threading.Event()
            self.interested_in('/map', STRING, lambda message: heard.set())
            self.has_heard = heard.wait(TIMEOUT)

    create(master, '/maps').output_channel('/map', STRING, latch=True).send(data='map')
    assert create(master, '/patient', Patient).has_heard
