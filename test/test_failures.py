"""Exceptions of blocks, which end nothing else; and the errors of the package."""
import contextlib
import re
import signal
import threading
import time

import pexpect
import pytest
import rospy
from geometry_msgs.msg import Point32

import pharos
from helpers import COMPOSE, PYTHON, TIMEOUT, Gate, Program, create, free_port, registrations
from pharos import BlockNode, Transcript
from pharos.testing import Mailbox, until

STRING = 'std_msgs/String'


@pytest.fixture
def node(master):
    return create(master)


@pytest.fixture
def other(master):
    return create(master, '/other')


class Odd(BaseException):
    """Not an Exception."""


RAISED = [RuntimeError('no fuel'), SystemExit(3), KeyboardInterrupt(), Odd('x')]


@pytest.fixture(params=RAISED, ids=[type(error).__name__ for error in RAISED])
def error(request):
    return request.param


def raise_it(error):
    raise error


# -- nothing else ends


def test_raising_soul_ends_only_itself(node, error):
    node.soul = lambda me: raise_it(error)
    assert node.execute() is None
    assert node.errors[-1] is error
    assert node.is_running


def test_raising_forked_soul_is_kept(node, error):
    node.fork(lambda me: raise_it(error)).join(TIMEOUT)
    assert node.errors[-1] is error


@pytest.mark.parametrize('inline', [False, True], ids=['worker', 'inline'])
def test_delegate_goes_on_after_failure(node, other, error, inline):
    box = Mailbox()

    def delegate(message, channel):
        box(message, channel)
        if message.data == 'bad':
            raise error

    other.interested_in('/a', STRING, delegate=delegate, inline=inline)
    node.send_to('/a', data='bad')
    node.send_to('/a', data='good')
    assert [box.next().data for _ in range(2)] == ['bad', 'good']
    assert other.errors[-1] is error


def test_delegate_of_external_publisher_goes_on(other, peer):
    box = Mailbox()

    def delegate(message, channel):
        box(message, channel)
        raise SystemExit

    other.interested_in('/a', STRING, delegate=delegate)
    peer.run("out = rospy.Publisher('/a', message_class('std_msgs/String'), queue_size=9)")
    until(lambda: peer.value('out.get_num_connections()'))
    for text in 'one', 'two':
        peer.run(f'out.publish({text!r})')
        assert box.next().data == text
    until(lambda: isinstance(other.errors[-1], SystemExit))


def test_raising_service_fails_its_call_alone(master, node, error):
    node.serve('/s', 'std_srvs/Empty', lambda request: raise_it(error))
    for _ in range(2):
        with pytest.raises(pharos.ServiceCallError, match='/s'):
            master.lookup_service('/s').call()
    assert node.errors[-1] is error
    assert node.is_running


def test_raising_change_block_is_kept(master, node, error):
    node.parameter('~rate', 1).on_change(lambda value: raise_it(error))
    master.parameters['/node/rate'] = 2
    until(lambda: node.errors)
    assert node.errors[-1] is error
    assert node.parameter('~rate').value == 2


def test_unwritable_transcript_changes_nothing(node, other):
    box = Mailbox()

    def delegate(message, channel):
        box(message, channel)
        raise RuntimeError

    before = Transcript.on_show(lambda line: raise_it(OSError('full')))
    try:
        other.interested_in('/a', STRING, delegate=delegate)
        for text in 'one', 'two':
            node.send_to('/a', data=text)
            assert box.next().data == text
        until(lambda: other.errors)
        assert isinstance(other.errors[-1], RuntimeError)
    finally:
        Transcript.on_show(before)


# -- kept and told


def test_failure_tells_what_failed(node, other):
    other.delegate = lambda message, channel: raise_it(RuntimeError('no fuel'))
    channel = other.interested_in('/a', STRING)
    before = time.time()
    node.send_to('/a', data='x')
    until(lambda: other.failures)
    (failure,) = other.failures
    assert (str(failure.error), failure.message.data) == ('no fuel', 'x')
    assert (failure.block, failure.channel, failure.count) == (other.delegate, channel, 1)
    assert before <= failure.time <= time.time()


def test_same_failure_is_one_and_counted(node, transcript):
    """It is told at the 1st, 10th and 100th time."""
    node.soul = lambda me: raise_it(RuntimeError('no fuel'))
    told = []
    for count in range(1, 101):
        before = len(transcript)
        node.execute()
        if len(transcript) > before:
            told.append(count)
    assert told == [1, 10, 100]
    (failure,) = node.failures
    assert failure.count == 100
    assert len(node.errors) == 1


def test_other_failures_are_told_too(node, transcript):
    for error in ValueError('one'), KeyError('two'):
        node.soul = lambda me, error=error: raise_it(error)
        node.execute()
    assert len(node.failures) == 2
    assert any('one' in line for line in transcript)
    assert any('two' in line for line in transcript)


def test_failure_is_in_log(master, node, other):
    box = Mailbox(other, '/rosout', 'rosgraph_msgs/Log')
    node.soul = lambda me: raise_it(RuntimeError('no fuel'))
    node.execute()
    line = box.wait_for(lambda line: line.name == '/node' and 'no fuel' in line.msg)
    assert line.level == line.ERROR
    assert 'raise_it' in line.msg  # the traceback


def test_failures_are_bounded(node):
    for number in range(300):
        exec(f'def soul(me): raise ValueError({number})', scope := {})
        scope['soul'].__qualname__ = f'soul{number}'
        node.soul = scope['soul']
        node.execute()
    assert len(node.errors) <= 100
    assert str(node.errors[-1]) == '299'


def test_newest_failures_alone_keep_messages(node, other):
    box = Mailbox()
    for number in range(20):

        def delegate(message, channel, number=number):
            box(message, channel)
            raise ValueError(str(number))

        delegate.__qualname__ = f'delegate{number}'
        exec(f'class Own{number}(ValueError): pass', scope := {})
        other.delegate = lambda m, c, cls=scope[f'Own{number}']: (box(m, c), raise_it(cls()))
        if not other.channels:
            other.interested_in('/a', STRING)
        node.send_to('/a', data=str(number))
        box.next()
        until(lambda: len(other.failures) == number + 1)
    kept = [failure.message is not None for failure in other.failures]
    assert kept[-1] and not kept[0]
    assert sum(kept) <= 10


def test_retry_runs_new_delegate_on_message(node, other):
    box = Mailbox()
    other.delegate = lambda message, channel: raise_it(RuntimeError)
    other.interested_in('/a', STRING)
    node.send_to('/a', data='x')
    until(lambda: other.failures)
    other.delegate = box
    other.failures[0].retry()
    assert box.next().data == 'x'


def test_retry_runs_soul_again(node):
    ran = []
    node.soul = lambda me: raise_it(RuntimeError)
    node.execute()
    node.soul = lambda me: ran.append(me)
    node.failures[0].retry()
    assert ran == [node]


def test_retry_waits_for_its_turn(node, other):
    """No other delegate of the node runs meanwhile."""
    entered, leave, order = threading.Event(), threading.Event(), []

    def delegate(message, channel):
        if message.data == 'bad':
            order.append('bad')
            raise RuntimeError
        entered.set()
        leave.wait(TIMEOUT)
        order.append('long')

    other.delegate = delegate
    other.interested_in('/a', STRING)
    node.send_to('/a', data='bad')
    until(lambda: other.failures)
    node.send_to('/a', data='long')
    assert entered.wait(TIMEOUT)
    thread = threading.Thread(target=other.failures[0].retry, daemon=True)
    thread.start()
    leave.set()
    thread.join(TIMEOUT)
    assert order == ['bad', 'long', 'bad']


def test_message_during_a_retry_comes(node, other):
    gate, numbers = Gate(), []

    def delegate(message, channel):
        if message.data != 'bad':
            numbers.append(message.data)
        elif other.failures:
            gate(message)
        else:
            raise RuntimeError

    other.interested_in('/a', STRING, delegate)
    node.send_to('/a', data='bad')
    until(lambda: other.failures)
    thread = threading.Thread(target=other.failures[0].retry, daemon=True)
    thread.start()
    assert gate.begun.wait(TIMEOUT)
    node.send_to('/a', data='good')
    assert not numbers
    gate.open.set()
    until(lambda: numbers == ['good'], TIMEOUT / 3)
    thread.join(TIMEOUT)


def test_debug_looks_at_raising_frame(master):
    source = (
        'import pharos\n'
        'def soul(me):\n'
        '    fuel = 40 + 2\n'
        '    raise RuntimeError\n'
        f'node = pharos.Master({master.url!r}).create(pharos.BlockNode, named="/n", soul=soul)\n'
        'node.execute()\n'
        'node.failures[-1].debug()\n'
        'node.stop()\n'
    )
    debugger = pexpect.spawn(PYTHON, ['-c', source], encoding='utf-8', timeout=TIMEOUT)
    debugger.expect('(?i)pdb')
    debugger.sendline('p "fuel is", fuel')
    debugger.expect('fuel is.*42')
    debugger.sendline('q')
    debugger.expect(pexpect.EOF)
    debugger.close()
    assert debugger.exitstatus == 0


# -- the errors


ERRORS = [
    *('MasterUnreachableError', 'NodeNameInUseError', 'PortInUseError', 'UnknownNodeError'),
    *('UnknownTopicError', 'UnknownTypeError', 'MessageTypeError', 'UnknownServiceError'),
    *('ServiceTypeError', 'ServiceCallError', 'NodeStoppedError'),
]


def test_errors_are_caught_as_rospys():
    errors = [getattr(pharos, name) for name in ERRORS]
    assert [error for error in errors if not issubclass(error, pharos.PharosError)] == []
    assert issubclass(pharos.PharosError, rospy.ROSException)


EXPORTS = [
    *('Master', 'Node', 'BlockNode', 'ScriptNode', 'ExternalNode', 'Topic', 'InputChannel'),
    *('OutputChannel', 'Service', 'Parameter', 'Transcript', 'RosProcess', 'Composition', 'Graph'),
    *('Lifecycle', 'Failure', 'message_class', 'service_class', 'define_message', 'spin'),
    *('define_service', '__version__', 'PharosError', *ERRORS),
]


def test_exports_are_the_contract():
    assert sorted(pharos.__all__) == sorted(EXPORTS)
    assert [name for name in EXPORTS if not hasattr(pharos, name)] == []


TEXTS = {
    'no master': (
        lambda node: create(pharos.Master(f'http://127.0.0.1:{free_port()}/')),
        pharos.MasterUnreachableError,
        ['http://127.0.0.1', 'roscore'],
    ),
    'name in use': (
        lambda node: node.master.create(BlockNode, named='/node'),
        pharos.NodeNameInUseError,
        ['/node', 'another name'],
    ),
    'port in use': (
        lambda node: node.master.create(BlockNode, named='/n', tcp_port=node.tcp_port),
        pharos.PortInUseError,
        ['port', 'another'],
    ),
    'no node': (
        lambda node: node.master.node('/nobody'),
        pharos.UnknownNodeError,
        ['/nobody', 'rosnode'],
    ),
    'no receiver': (
        lambda node: node.send_to('/a', typed_as=STRING, to='/nobody', data='x'),
        pharos.UnknownNodeError,
        ['/nobody'],
    ),
    'no type of a topic': (
        lambda node: node.interested_in('/unheard'),
        pharos.UnknownTopicError,
        ['/unheard', 'typed_as'],
    ),
    'no such type': (
        lambda node: node.interested_in('/a', 'no_msgs/Thing'),
        pharos.UnknownTypeError,
        ['no_msgs/Thing', 'define_message'],
    ),
    'malformed type': (
        lambda node: pharos.message_class('Thing'),
        pharos.UnknownTypeError,
        ['Thing', 'package/Type'],
    ),
    'no such field': (
        lambda node: node.send_to('/a', typed_as=STRING, date='x'),
        pharos.MessageTypeError,
        ['std_msgs/String', 'date', 'data'],
    ),
    'wrong value': (
        lambda node: node.send_to('/a', typed_as='std_msgs/Int8', data='many'),
        pharos.MessageTypeError,
        ['std_msgs/Int8', 'data', 'many'],
    ),
    'no service': (
        lambda node: node.master.lookup_service('/nothing'),
        pharos.UnknownServiceError,
        ['/nothing', 'rosservice'],
    ),
    'stopped': (
        lambda node: (node.stop(), node.send_to('/a', data='x')),
        pharos.NodeStoppedError,
        ['/node', 'start'],
    ),
    'malformed URL': (lambda node: pharos.Master('robot'), ValueError, ['robot', 'http://']),
    'malformed name': (
        lambda node: node.interested_in('two words', STRING),
        ValueError,
        ['two words'],
    ),
    'no block': (lambda node: node.fork(), pharos.PharosError, ['/node', 'soul']),
}


@pytest.mark.parametrize('use, error, words', TEXTS.values(), ids=TEXTS)
def test_error_says_what_to_do(master, node, use, error, words):
    with pytest.raises(error) as caught:
        use(node)
    text = str(caught.value)
    assert [word for word in words if word not in text] == []
    with contextlib.suppress(pharos.PharosError):
        assert registrations(master, '/n') == [[], [], []]


# -- no silence for those who write nodes


PLAIN = '''
import rospy, sys, threading
from pharos import Master, Node, spin
from std_msgs.msg import String
class Habit(Node):
    def start(self):
        super().start()
        rospy.loginfo('in vain')
        rospy.get_param('~gain', 1)
        try: rospy.Time.now()
        except rospy.ROSInitException: pass
        rospy.Subscriber('words', String, print)
        rospy.Subscriber('more_words', String, print)
        self.fork(Habit.loop)
    def loop(self):
        while not rospy.is_shutdown(): self.sleep(0.01)
        print('the loop ends', flush=True)
Master().create(Habit, named='habit', argv=sys.argv)
print('up', flush=True)
spin()
'''


@pytest.mark.parametrize('command', [[PYTHON], [*COMPOSE, '--script']], ids=['process', 'composed'])
def test_plain_rospy_says_what_to_write(master, tmp_path, command):
    (tmp_path / 'program').write_text(PLAIN)
    with Program([*command, str(tmp_path / 'program')], master.url) as program:
        program.expect('up')
        program.signal(signal.SIGINT)
        program.wait()
    told = re.findall(r'write node\.ros\.(.*)', program.output)
    names = [name.strip() for name in dict.fromkeys(told)]
    assert names == ['loginfo', 'get_param', 'Time.now', 'Subscriber']
    assert 'left behind' not in program.output


@pytest.mark.parametrize('command', [[PYTHON], [*COMPOSE, '--script']], ids=['process', 'composed'])
def test_library_of_plain_rospy_is_named(master, tmp_path, command):
    text = (
        'import message_filters\nfrom pharos import *\nfrom std_msgs.msg import String\n'
        'node = Master().create(Node, named="n")\nmessage_filters.Subscriber("t", String)\n'
    )
    (tmp_path / 'program').write_text(text + 'node.stop()\n')
    with Program([*command, str(tmp_path / 'program')], master.url) as program:
        program.wait()
    assert "write node.ros_import('message_filters')" in program.output
    assert 'write node.ros.' not in program.output


@pytest.mark.parametrize('end', ['1 / 0', 'return'])
def test_required_soul_ends_its_program(master, tmp_path, end):
    text = 'from pharos import *\nnode = Master().create(BlockNode, named="/driver")\n'
    text += f'def work(me):\n    me.sleep(0.01)\n    {end}\n'
    (tmp_path / 'program').write_text(text + 'node.fork(work, required=True)\nspin()\n')
    for command in [PYTHON], [*COMPOSE, '--script']:
        with Program([*command, str(tmp_path / 'program')], master.url) as program:
            assert program.wait() == 1
        assert 'stops: work, which is required, has ended' in program.output


def test_required_soul_may_end_with_its_node(master):
    node = create(master)
    node.fork(lambda me: me.sleep(60), required=True)
    node.restart()
    assert node.is_running
    node.stop()
    assert not pharos.signals.lost_names


def test_delegate_that_hangs_is_seen(master):
    ear, free = create(master, '/ear'), threading.Event()
    ear.interested_in('/words', STRING, delegate=lambda message: free.wait(TIMEOUT))
    mouth = create(master, '/mouth').output_channel('/words', STRING)
    for _ in range(3):
        mouth.send(data='')
    until(lambda: ear.health().callback_seconds > 0.1)
    assert ear.health().waiting == 2
    free.set()
    until(lambda: ear.health().callback_seconds == 0 == ear.health().waiting)


def test_missing_parameter_is_told(node, other):
    log = Mailbox(other, '/rosout', 'rosgraph_msgs/Log')
    node.parameter('~gian')
    log.wait_for(lambda line: 'has no parameter' in line.msg)


def test_clock_that_stands_still_is_told(master, other):
    log = Mailbox(other, '/rosout', 'rosgraph_msgs/Log')
    master.parameters['/use_sim_time'] = True
    create(master)
    log.wait_for(lambda line: 'time stands still' in line.msg)


def test_failure_stands_once_with_the_name_on_each_line(master, tmp_path):
    text = 'from pharos import *\nnode = Master().create(BlockNode, named="/driver")\n'
    text += 'node.soul = lambda me: 1 / 0\nnode.execute()\n'
    (tmp_path / 'program').write_text(text)
    with Program([PYTHON, str(tmp_path / 'program')], master.url) as program:
        program.wait()
    lines = [line for line in program.output.splitlines() if line]
    assert all('/driver' in line for line in lines)
    assert sum('raised ZeroDivisionError' in line for line in lines) == 1


def test_health_before_the_start_is_an_error(master):
    class Early(pharos.Node):
        def __init__(self):
            for method in self.health, self.restart:
                with pytest.raises(pharos.NodeStoppedError):
                    method()

    create(master, node_class=Early)


def test_values_fill_the_fields(master, node):
    box = Mailbox(create(master, '/ear'), '/words', STRING)
    words = node.output_channel('/words', STRING)
    words.publish('one')
    words.publish(data='two')
    words.send('three')
    node.send_to('/words', 'four')
    assert [box.next().data for _ in range(4)] == ['one', 'two', 'three', 'four']
    points = node.output_channel('/points', 'geometry_msgs/Point')
    with pytest.raises(pharos.MessageTypeError):
        points.publish(1.0)
    points.publish(1.0, 2.0, 3.0)
    polygon = node.send_to(
        '/polygon', typed_as='geometry_msgs/Polygon', points=[Point32(), {'y': 2.0}]
    )
    assert [point.y for point in polygon.points] == [0.0, 2.0]
