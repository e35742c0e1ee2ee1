"""A block that fails, however it does, fails alone; it is kept, told, counted, and run again."""
import asyncio
import dataclasses
import gc
import io
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
import traceback
from unittest import mock

import pytest

from helpers import create, ended, in_thread
from pharos.testing import Mailbox, TIMEOUT, until
import pharos
from pharos import BlockNode, Transcript, failures, node_registry
from pharos.live import debugger, failure_table
from programs import PROGRAMS, Program, environment, run
from geometry_msgs.msg import Pose
from sensor_msgs.msg import Image
from std_msgs.msg import String


class OfMyOwn(BaseException):
    """Derived from no Exception, as nothing should be but often is."""


class HasEverything(Exception):
    """Answers for any attribute, as errors do that carry the details of a device."""

    def __getattr__(self, name):
        return name


class LacksEverything(Exception):
    """Raises what no one expects for any attribute."""

    def __getattr__(self, name):
        raise KeyError(name)


OUTCASTS = [
    SystemExit,
    KeyboardInterrupt,
    GeneratorExit,
    asyncio.CancelledError,
    pytest.fail.Exception,
    OfMyOwn,
]


class Raising:
    """A block that raises one error after the other, and when there are none left takes what it
    gets."""

    def __init__(self, *errors):
        self._errors = list(errors)
        self.taken = Mailbox()

    def __call__(self, *args):
        if self._errors:
            raise self._errors.pop(0)
        self.taken(args[0], None)


def classes_of(errors):
    return [type(error) for error in errors]


@pytest.fixture
def dead_threads(monkeypatch):
    """The exceptions by which threads ended."""
    dead = []
    monkeypatch.setattr(threading, 'excepthook', lambda arguments: dead.append(arguments.exc_value))
    return dead


# -- whatever it raises, no thread and no caller ends


RAISED = [*OUTCASTS, HasEverything, LacksEverything]


@pytest.mark.parametrize('inline', [False, True])
def test_a_delegate_may_raise_anything(master, transcript, inline):
    block = Raising(*[outcast('out') for outcast in RAISED])
    node = create(master, delegate=block)
    node.interested_in('/failing', 'std_msgs/Int32', inline=inline)
    for number in range(len(RAISED) + 1):
        create(master, '/sender%d' % number).send_to('/failing', data=number)
    assert block.taken.next().data == len(RAISED)
    assert classes_of(node.errors) == RAISED
    assert [line.split(' raised ')[1] for line in transcript] == [
        outcast.__name__ + ': out' for outcast in RAISED
    ]


def test_a_delegate_of_an_external_publisher_may_raise_anything(master, transcript):
    block = Raising(*[outcast('out') for outcast in OUTCASTS])
    node = create(master, delegate=block)
    node.interested_in('/failing_outside', 'std_msgs/Int32')
    with Program(
        master.url, 'rostopic', 'pub', '-r', '50', '/failing_outside', 'std_msgs/Int32', '5'
    ):
        block.taken.take(20)
    assert classes_of(node.errors) == OUTCASTS


@pytest.mark.parametrize('outcast', OUTCASTS)
def test_a_soul_may_raise_anything(master, transcript, dead_threads, outcast):
    def soul(me):
        raise outcast('out')

    node = create(master, soul=soul)
    assert node.execute() is None
    node.fork().join(TIMEOUT)
    (failure,) = node.failures
    assert type(failure.error) is outcast
    assert failure.count == 2
    assert failure.block is soul
    assert not dead_threads


@pytest.mark.parametrize('outcast', OUTCASTS)
@pytest.mark.parametrize('timeout', [None, TIMEOUT])
def test_a_service_block_may_raise_anything(master, transcript, dead_threads, outcast, timeout):
    block = Raising(outcast('out'))
    node = create(master)
    node.serve('/fails', 'std_srvs/Empty', block)
    service = master.lookup_service('/fails')
    begin = time.monotonic()
    with pytest.raises(pharos.ServiceCallError, match=f'/fails failed: .*{outcast.__name__}: out'):
        service.call(timeout=timeout)
    assert time.monotonic() - begin < TIMEOUT  # it is not waited for in vain
    service.call(timeout=timeout)
    assert classes_of(node.errors) == [outcast]
    assert not dead_threads


def test_a_service_block_called_from_outside_may_raise_anything(master, transcript, dead_threads):
    node = create(master)
    node.serve('/fails_outside', 'std_srvs/Empty', Raising(SystemExit('out')))
    done = run(master.url, 'rosservice', 'call', '/fails_outside')
    assert 'SystemExit: out' in done.stderr
    assert 'not able to' not in done.stderr
    assert run(master.url, 'rosservice', 'call', '/fails_outside').returncode == 0
    assert classes_of(node.errors) == [SystemExit]
    assert not dead_threads


def test_a_parameter_block_may_raise_anything(master, transcript):
    node = create(master)
    parameter = node.parameter('~failing', 0)
    block = Raising(*[outcast('out') for outcast in OUTCASTS * 2])
    parameter.on_change(block)
    for number in range(len(OUTCASTS)):
        parameter.set(number)  # runs it here
        master.parameters['/node/failing'] = number  # runs it in a thread of the XML-RPC server
        until(lambda: node.health().errors == 2 * number + 2)
    parameter.set(99)
    assert block.taken.next() == 99
    assert set(classes_of(node.errors)) == set(OUTCASTS)


def test_a_block_for_changes_may_raise_anything(master, transcript):
    watched, events = Mailbox(), {}

    def block(kind, name, is_there):
        if name in events:
            events.pop(name)
            raise SystemExit('out')

    end = master.on_change(block)
    also = master.on_change(lambda kind, name, is_there: watched((kind, name), None))
    for name in '/first', '/second':
        events[name] = True
        create(master, name)
        until(lambda: name not in events)
        while watched.next() != ('node', name):
            pass
    end()
    also()
    assert any('block' in line and 'raised SystemExit: out' in line for line in transcript)


def test_a_node_whose_registration_fails_leaves_the_others_watched(master, transcript):
    node, watched = create(master), Mailbox()
    node.latest_run.rospy.repair = lambda *arguments: 1 / 0
    end = master.on_change(lambda kind, name, is_there: watched((kind, name), None))
    create(master, '/another')
    while watched.next() != ('node', '/another'):
        pass
    end()
    assert classes_of(node.errors) == [ZeroDivisionError]


def test_on_line_may_raise_anything(master, transcript):
    lines = Mailbox()

    def on_line(text):
        lines(text, None)
        raise SystemExit(text)

    with master.run('topic_tools', 'relay', on_line=on_line) as process:
        process.wait(TIMEOUT)
    printed = process.output.split('\n')
    assert len(printed) > 1
    assert lines.take(len(printed)) == printed
    assert 'block' in transcript[0]
    assert 'for the output of' in transcript[0]
    assert 'raised SystemExit' in transcript[0]


# -- plain rospy, and what else a thread of ours runs


@pytest.mark.parametrize('timeout', [None, TIMEOUT])
@pytest.mark.parametrize('outcast', OUTCASTS)
def test_a_service_of_plain_rospy_may_raise_anything(master, dead_threads, outcast, timeout):
    node, told = create(master), []

    def tell(error, *information):
        told.append(type(error))
        raise SystemExit('cannot tell')

    block = Raising(outcast('out'))
    node.ros.Service(
        '/plain',
        pharos.service_class('std_srvs/Empty'),
        lambda request: block(request) or {},
        error_handler=tell,
    )
    service = master.lookup_service('/plain')
    with pytest.raises(
        pharos.ServiceCallError, match='/plain failed: error processing request: out'
    ):
        service.call(timeout=timeout)
    service.call(timeout=timeout)
    assert told == [outcast]
    assert not dead_threads


def test_a_service_of_plain_rospy_called_from_outside_may_raise_anything(master, dead_threads):
    node, block = create(master), Raising(SystemExit('out'))
    node.ros.Service(
        '/plain_outside',
        pharos.service_class('std_srvs/Empty'),
        lambda request: block(request) or {},
    )
    assert (
        'error processing request: out'
        in run(master.url, 'rosservice', 'call', '/plain_outside').stderr
    )
    assert run(master.url, 'rosservice', 'call', '/plain_outside').returncode == 0
    assert not dead_threads


def test_a_callback_of_plain_rospy_takes_nothing_from_a_channel_whatever_it_raises(
    master, mailbox, dead_threads
):
    node, plain = create(master), Raising(*[outcast('out') for outcast in OUTCASTS])
    type_ = pharos.message_class('std_msgs/Int32')
    node.ros.Subscriber('/plain_topic', type_, plain)
    node.interested_in('/plain_topic', type_, delegate=mailbox)
    sender = create(master, '/sender')
    for number in range(len(OUTCASTS) + 1):
        sender.send_to('/plain_topic', data=number)
    assert [message.data for message in mailbox.take(len(OUTCASTS) + 1)] == list(
        range(len(OUTCASTS) + 1)
    )
    assert plain.taken.next().data == len(OUTCASTS)
    assert not dead_threads


@pytest.mark.parametrize('outcast', [SystemExit, ValueError])
def test_a_hook_of_on_shutdown_may_raise_anything(master, transcript, monkeypatch, outcast):
    read, write = os.pipe()
    os.close(read)
    node, hook = create(master), Raising(outcast('out'))
    node.ros.on_shutdown(lambda: hook('out'))
    node.ros.on_shutdown(lambda: hook('the other'))
    with monkeypatch.context() as patched, io.TextIOWrapper(
        io.FileIO(write, 'w'), write_through=True
    ) as closed:
        patched.setattr(sys, 'stderr', closed)  # where rospy would print it
        node.stop()
    assert hook.taken.next() == 'the other'
    assert classes_of(node.errors) == [outcast]
    assert '/node' not in [other.name for other in master.nodes()]


class Failing(pharos.Node):
    def start(self):
        super().start()
        if self.master.parameters.get('/fail_to_start'):
            raise KeyError('start')

    def stop(self):
        raise SystemExit('stop')


@pytest.mark.parametrize('how', ['asked by ROS', 'all are stopped'])
def test_a_stop_that_fails_in_a_thread_of_ours_is_a_failure_and_the_node_stops(
    master, transcript, dead_threads, how
):
    node = master.create(Failing, named='/failing_stop', domain='127.0.0.1')
    if how == 'asked by ROS':
        node.ros.signal_shutdown('enough')
    else:
        node_registry.stop_all()
    until(lambda: node.failures)
    assert node.lifecycle.value == 'stopped'
    assert classes_of(node.errors) == [SystemExit]
    assert not dead_threads
    says = 'Failing.stop of /failing_stop raised SystemExit: stop\nTraceback'
    until(lambda: any(line.startswith(says) for line in transcript))  # it is kept first
    assert '/failing_stop' not in [other.name for other in master.nodes()]


def test_a_stop_that_fails_keeps_no_embedded_master_from_its_end(transcript):
    embedded = pharos.Master.embedded()
    embedded.create(Failing, named='/failing_stop', domain='127.0.0.1')
    embedded.stop()
    assert not embedded.is_reachable()
    assert 'SystemExit' in transcript[-1]


def test_a_stop_that_fails_hides_no_failure_of_the_start(master, transcript):
    master.parameters['/fail_to_start'] = True
    with pytest.raises(KeyError, match='start'):
        master.create(Failing, named='/failing_stop', domain='127.0.0.1')
    del master.parameters['/fail_to_start']
    assert '/failing_stop' not in [other.name for other in master.nodes()]


# -- nor by what the report of it raises


class Unspeakable(Exception):
    def __str__(self):
        raise SystemExit('no text')

    __repr__ = __str__


class UnnameableBlock:
    def __init__(self, block):
        self._block = block

    def __call__(self, message, channel):
        self._block(message, channel)

    def __repr__(self):
        raise SystemExit('no name')

    def __getattr__(self, name):
        raise SystemExit('no name') if name == '__qualname__' else AttributeError(name)


def fails_on_bad(mailbox, error):
    def delegate(message, channel):
        if message.data == 'bad':
            raise error
        mailbox(message, channel)

    return delegate


def send_bad_and_good(node, inline=False):
    node.interested_in('/reported', 'std_msgs/String', inline=inline)
    node.send_to('/reported', data='bad')
    node.send_to('/reported', data='good')


@pytest.mark.parametrize(
    'make', [Unspeakable, lambda: SystemExit(Unspeakable())], ids=['itself', 'what it holds']
)
def test_an_error_that_cannot_be_shown_is_kept_all_the_same(master, transcript, mailbox, make):
    error = make()
    error.__cause__ = Unspeakable()
    node = create(master, delegate=fails_on_bad(mailbox, error))
    send_bad_and_good(node)
    assert mailbox.next().data == 'good'
    assert node.errors[0] is error
    assert f'raised {type(error).__name__}' in transcript[0]
    assert repr(node.failures)


def test_a_block_that_cannot_be_named_is_told_all_the_same(master, transcript, mailbox):
    node = create(master, delegate=UnnameableBlock(fails_on_bad(mailbox, ValueError('bad one'))))
    send_bad_and_good(node)
    assert mailbox.next().data == 'good'
    assert classes_of(node.errors) == [ValueError]
    assert 'UnnameableBlock' in transcript[0]
    assert 'bad one' in transcript[0]


@pytest.mark.parametrize('inline', [False, True])
@pytest.mark.parametrize('outcast', [SystemExit, OSError])
def test_a_log_and_a_transcript_that_fail_change_nothing(master, mailbox, capsys, inline, outcast):
    class Mute(BlockNode):
        def log(self, text, level='info'):
            raise outcast('no log')

    def receiver(text):
        raise outcast('no line')

    before = Transcript.on_show(receiver)
    try:
        node = master.create(
            Mute, named='/mute', delegate=fails_on_bad(mailbox, ValueError('bad one'))
        )
        send_bad_and_good(node, inline)
        assert mailbox.next().data == 'good'
        assert classes_of(node.errors) == [ValueError]
        Transcript.show('another', Unspeakable())
    finally:
        Transcript.on_show(before)
    about, line, another = capsys.readouterr().out.splitlines()
    assert 'receiver' in about
    assert f'raised {outcast.__name__}: no line' in about
    assert line.endswith('raised ValueError: bad one')
    assert another == 'another <Unspeakable that cannot be shown>'


@pytest.mark.parametrize('output', ['/dev/full', 'a closed pipe', 'a closed file'])
def test_an_output_that_cannot_be_written_changes_nothing(master, mailbox, monkeypatch, output):
    if output == '/dev/full':
        file = open(output, 'w')
    else:
        read, write = os.pipe()
        os.close(read)
        file = os.fdopen(write, 'w')
        if output == 'a closed file':
            file.close()
    with monkeypatch.context() as patched:
        patched.setattr(sys, 'stdout', file)
        patched.setattr(sys, 'stderr', file)
        node = create(master, delegate=fails_on_bad(mailbox, ValueError('bad one')))
        send_bad_and_good(node)
        assert mailbox.next().data == 'good'
        assert classes_of(node.errors) == [ValueError]
        node.fork(lambda me: 1 / 0).join(TIMEOUT)
        assert classes_of(node.errors) == [ValueError, ZeroDivisionError]
        with pytest.raises((OSError, ValueError)):
            file.write('x')
            file.flush()
    try:
        file.close()
    except OSError:
        pass


def test_a_line_is_shown_on_a_terminal_that_knows_ascii_only(monkeypatch):
    written = io.BytesIO()
    monkeypatch.setattr(sys, 'stdout', io.TextIOWrapper(written, encoding='ascii'))
    Transcript.show('gr\xfcn')
    assert written.getvalue() == b'gr\\xfcn\n'


def test_a_receiver_that_works_again_gets_the_lines_again(capsys):
    receiver = Raising(ValueError('not yet'))
    before = Transcript.on_show(receiver)
    try:
        Transcript.show('first')
        Transcript.show('second')
    finally:
        Transcript.on_show(before)
    assert receiver.taken.next() == 'second'
    assert capsys.readouterr().out.splitlines()[1:] == ['first']


# -- kept, told, counted


def failing(node, error_of, count, topic='/counted'):
    """Have a delegate of the node raise ``error_of(message.data)`` on each of so many messages;
    returns the channel."""

    def delegate(message, channel):
        raise error_of(message.data)

    before = node.health().errors
    channel = node.interested_in(topic, 'std_msgs/Int32', delegate=delegate, inline=True)
    for number in range(count):
        node.send_to(topic, data=number)
    assert node.health().errors == before + count
    return channel


def test_identical_failures_are_one_told_once_and_then_counted(master, transcript):
    node = create(master)
    channel = failing(node, lambda number: ValueError('the same'), 250)
    (error,) = node.errors
    (failure,) = node.failures
    assert isinstance(failure, pharos.Failure)
    assert failure.error is error
    assert failure.count == 250
    assert failure.channel is channel
    assert failure.message.data == 249
    assert abs(failure.time - time.time()) < 100
    assert 'ValueError: the same, 250 times' in repr(failure)
    assert 'raise error_of' in failure.traceback
    first, tenth, hundredth = transcript
    assert first.endswith('on /counted raised ValueError: the same')
    assert tenth == first + ', 10 times by now'
    assert hundredth == first + ', 100 times by now'
    assert '250 errors' in repr(node)


def test_the_log_has_the_traceback_of_a_failure_once(master, transcript):
    lines = []
    create(master, '/auditor', delegate=lambda line, channel: lines.append(line.msg)).interested_in(
        '/rosout', 'rosgraph_msgs/Log', inline=True
    )
    failing(create(master), lambda number: ValueError('the same'), 50)

    def told():
        return ['Traceback' in text for text in lines if 'ValueError: the same' in text]

    until(lambda: len(told()) == 2)  # the listener may connect later than the first line
    assert told() == [True, False]


def test_a_listener_to_the_log_that_fails_does_not_hear_of_itself_for_ever(
    master, transcript, mailbox
):
    def delegate(line, channel):
        mailbox(line, channel)
        raise ValueError(f'cannot read {line.msg}')

    node = create(master, delegate=delegate)
    node.interested_in('/rosout', 'rosgraph_msgs/Log')
    speaker = create(master, '/speaker')
    speaker.log('the last')
    while mailbox.next().msg != 'the last':
        pass
    speaker.log('one more')
    until(lambda: any('one more' in failure.text for failure in node.failures))
    # and for the 10th and 100th, should it come to that
    assert len(transcript) <= failures.TEXTS + 2


def test_failures_differ_in_block_channel_class_place_and_text(master, transcript):
    node = create(master)
    for topic, error_of in [
        ('/one', lambda number: ValueError('a')),
        ('/two', lambda number: ValueError('a')),
        ('/two', lambda number: ValueError('b')),
        ('/two', lambda number: KeyError('a')),
    ]:
        failing(node, error_of, 2, topic).close()
    assert [failure.count for failure in node.failures] == [2] * 4
    assert len(transcript) == 4


def test_failures_of_ever_changing_text_are_told_a_few_times(master, transcript):
    node = create(master)
    failing(node, lambda number: ValueError(f'no transform at {number}'), 1000)
    assert [line.split('no transform at ')[1] for line in transcript] == [
        '0',
        '1',
        '2',
        '9, 10 times by now, with different texts',
        '99, 100 times by now, with different texts',
        '999, 1000 times by now, with different texts',
    ]
    assert len(node.errors) == len(node.failures) == failures.KEPT
    assert str(node.errors[0]) == 'no transform at 0'
    assert str(node.errors[-1]) == 'no transform at 999'


def test_a_block_that_replaces_another_and_fails_as_that_did_is_told(master, transcript):
    """At the prompt every block is in line 1 of <stdin>, and silence would look like success."""
    node = create(master)
    for text in 'lambda me: me.nothing()', 'lambda me: [me.nothing()]':
        node.soul = eval(text)
        node.execute()
        node.execute()
    assert len(transcript) == 2
    assert [failure.count for failure in node.failures] == [2, 2]


def test_closures_of_one_place_that_fail_alike_are_told_once(master, transcript):
    node = create(master)
    for number in range(3):
        node.soul = lambda me, number=number: me.nothing()
        node.execute()
    assert len(transcript) == 1
    assert node.failures[0].count == 3


def test_what_nobody_raised_is_told_without_a_traceback_that_only_repeats_it():
    told = []
    kept = failures.Failures(lambda line, details: told.append((line, details)))
    kept.report(ValueError('of another type'), print, 'connection of /a to /b')
    assert told == [('connection of /a to /b raised ValueError: of another type', '')]


def test_a_flood_of_failures_displaces_no_other(master, transcript):
    node = create(master)
    failing(node, lambda number: ValueError(f'first, at {number}'), 300, '/flood')
    failing(node, lambda number: KeyError('the cause, perhaps'), 1, '/rare')
    failing(node, lambda number: ValueError(f'then, at {number}'), 300, '/flood_too')
    assert [str(error) for error in node.errors if isinstance(error, KeyError)] == [
        "'the cause, perhaps'"
    ]
    assert any('/rare' in line for line in transcript)
    assert len(node.errors) == failures.KEPT


def test_the_newest_failure_is_the_last(master, transcript):
    node = create(master)
    failing(node, lambda number: ValueError(number % 2), 4)
    assert [(str(failure.error), failure.count) for failure in node.failures] == [
        ('0', 2),
        ('1', 2),
    ]
    failing(node, lambda number: ValueError('more'), 1, '/more')
    assert [str(error) for error in node.errors] == ['0', '1', 'more']
    assert [str(error) for error in node.errors[1:]] == ['1', 'more']
    assert repr(node.errors).startswith('[ValueError(0)')


def test_errors_that_have_been_seen_to_may_be_taken_out(master, transcript):
    node = create(master)
    failing(node, ValueError, 3)
    assert str(node.errors.pop()) == '2'
    assert str(node.errors.pop(0)) == '0'
    assert [str(failure.error) for failure in node.failures] == ['1']
    node.errors.clear()
    assert not node.errors
    assert not node.failures
    failing(node, lambda number: ValueError('new'), 1, '/new')
    assert len(node.errors) == 1
    assert 'new' in transcript[-1]


# -- what is large is kept for the newest alone

SIZE = 200000


@dataclasses.dataclass(frozen=True)
class Frozen(Exception):
    """Its attributes cannot be set, not even __traceback__ by its name."""

    what: object


def throw(error):
    raise error


def with_attribute(message):
    error = ValueError('bad image')
    error.image = message
    return error


def in_a_chain(message):
    try:
        data = message.data
        raise KeyError(data[:5])
    except KeyError as error:
        raise ValueError('bad image') from error


def in_a_group(message):
    try:
        in_a_chain(message)
    except ValueError as error:
        raise ExceptionGroup('bad images', [error])  # noqa: F821: of Python 3.11


WAYS = {
    'the same': lambda message: int('x'),
    'another text': lambda message: int(f'x{message.height}'),
    'the message in the error': lambda message: throw(
        ValueError('bad image', message, message.height)
    ),
    'messages in the error': lambda message: throw(ValueError([message], {'image': message})),
    'its data in the error': lambda message: throw(ValueError(message.height, message.data)),
    'the message an attribute': lambda message: throw(with_attribute(message)),
    'in a frozen error': lambda message: throw(Frozen(message)),
    'in a chain': in_a_chain,
    'in a group': in_a_group,
    'undecodable': lambda message: message.data.decode(),
}
if sys.version_info < (3, 11):
    del WAYS['in a group']


def held(datas):
    """How many of them something holds on to but their list."""
    gc.collect()
    return sum(sys.getrefcount(datas[index]) > 2 for index in range(len(datas)))


@pytest.mark.parametrize('inline', [False, True])
@pytest.mark.parametrize('way', WAYS.values(), ids=WAYS)
def test_a_delegate_that_fails_on_images_holds_on_to_few(master, transcript, way, inline):
    node, sender = create(master, delegate=lambda message, channel: way(message)), create(
        master, '/sender'
    )
    node.interested_in('/failing_images', 'sensor_msgs/Image', inline=inline)
    # each decodes up to another place
    datas = [b'x' * (number + 1) + b'\xff' * SIZE for number in range(30)]
    assert held(datas) == 0
    for number in range(len(datas)):
        sender.send_to('/failing_images', data=datas[number], height=number)
    until(lambda: node.health().errors == len(datas))
    assert 1 <= held(datas) <= failures.WHOLE
    assert node.failures[-1].message.height == len(datas) - 1
    assert all('Traceback' in failure.traceback for failure in node.failures)
    node.errors.clear()
    until(lambda: held(datas) == 0)


def test_an_error_that_is_raised_again_and_again_does_not_collect_frames(master, transcript):
    node, error = create(master), ValueError('always this one')
    failing(node, lambda number: error, 100)
    assert len(list(traceback.walk_tb(node.errors[0].__traceback__))) == 2


def test_long_texts_are_cut(master, transcript):
    node = create(master)
    failing(node, lambda number: ValueError('x' * 10000000), 1)
    assert len(transcript[0]) < 5000
    assert len(node.failures[0].traceback) < 50000


# -- again


def test_a_delegate_is_run_again_as_it_is_now_on_the_same_message(master, transcript, mailbox):
    node = create(master, delegate=lambda message, channel: 1 / 0)
    channel = node.interested_in('/again', 'std_msgs/String', inline=True)
    node.send_to('/again', data='bad')
    (failure,) = node.failures
    # told, for somebody waits for it
    assert failure.retry() is False
    assert failure.count == 2
    assert len(transcript) == 2
    node.delegate = mailbox
    assert failure.retry() is True
    assert mailbox.next_with_channel() == (failure.message, channel)
    assert failure.message.data == 'bad'
    assert (failure.count, channel.received) == (2, 1)
    channel.delegate = Raising(SystemExit('out'))
    assert failure.retry() is False
    assert classes_of(node.errors) == [ZeroDivisionError, SystemExit]


def test_a_delegate_is_run_again_when_no_other_runs(master, transcript, mailbox):
    node = create(master)
    node.interested_in('/again', 'std_msgs/String', delegate=Raising(ValueError('bad')))
    node.send_to('/again', data='bad')
    until(lambda: node.failures)
    busy, go_on, ran = threading.Event(), threading.Event(), []

    def slow(message, channel):
        busy.set()
        go_on.wait(TIMEOUT)
        ran.append('slow')

    node.interested_in('/slow', 'std_msgs/Empty', delegate=slow)
    node.send_to('/slow')
    assert busy.wait(TIMEOUT)
    node.failures[0].channel.delegate = lambda message, channel: ran.append('again')
    retrying = threading.Thread(target=lambda: mailbox(node.failures[0].retry(), None))
    retrying.start()
    assert mailbox.empty()
    assert not ran
    go_on.set()
    assert mailbox.next() is True
    assert ran == ['slow', 'again']


class Opens(pharos.Node):
    """Opens in its start() what it opens."""

    def start(self):
        super().start()
        self.interested_in('/again', 'std_msgs/String', lambda message, channel: None)
        self.interested_in('/again', 'std_msgs/String', self.hear)
        self.serve('/fails_again', 'std_srvs/SetBool', self.answer)

    def hear(self, message, channel):
        raise ValueError('old')

    def answer(self, request):
        raise ValueError('old')


class OpensMended(Opens):
    """The same, mended."""

    def hear(self, message, channel):
        self.heard = message, channel

    def answer(self, request):
        self.answered = request
        return {'success': True}


def test_what_is_run_again_is_what_a_restart_has_opened_anew(master, transcript):
    node = create(master, node_class=Opens)
    node.send_to('/again', data='bad')
    until(lambda: node.failures)
    with pytest.raises(pharos.ServiceCallError):
        master.lookup_service('/fails_again').call(data=True)
    heard, asked = node.failures
    node.restart()
    node.become(OpensMended)
    assert heard.retry() is True
    assert node.heard == (heard.message, node.channels[1])
    assert asked.retry() is True
    assert node.answered is asked.message


def test_what_is_run_again_is_what_was_opened_since(master, transcript, mailbox):
    node = create(master)
    channel = node.interested_in('/again', 'std_msgs/String', Raising(ValueError('old')))
    node.send_to('/again', data='bad')
    until(lambda: node.failures)
    channel.close()
    anew = node.interested_in('/again', 'std_msgs/String', mailbox)
    assert node.failures[0].retry() is True
    assert mailbox.next_with_channel()[1] is anew


@pytest.mark.parametrize('inline', [False, True])
def test_a_delegate_may_have_another_one_run_again(master, transcript, mailbox, inline):
    node, failing_once = create(master), Raising(ValueError('bad'))
    node.interested_in('/again', 'std_msgs/String', delegate=failing_once, inline=inline)
    node.interested_in(
        '/retry',
        'std_msgs/Empty',
        inline=inline,
        delegate=lambda message, channel: mailbox(node.failures[-1].retry(), channel),
    )
    node.send_to('/again', data='bad')
    until(lambda: node.failures)
    node.send_to('/retry')
    assert mailbox.next() is True
    assert failing_once.taken.next().data == 'bad'


@pytest.mark.parametrize('does', ['retry', 'become'])
def test_of_delegates_that_wait_for_one_another_one_gives_up(master, transcript, does):
    nodes = [create(master, name) for name in ('/a', '/b', '/c')]
    together, ended, heard = threading.Barrier(3), [], queue.SimpleQueue()

    def each_other(message, channel):
        if message.data == 'fail':
            raise ValueError('bad')
        if message.data != 'wait':
            return heard.put(channel.node)
        other = nodes[(nodes.index(channel.node) + 1) % 3]
        together.wait(TIMEOUT)
        try:
            if does == 'retry':
                ended.append(other.failures[0].retry())
            else:
                ended.append(other.become(type(other)))
        except pharos.PharosError as error:
            ended.append(str(error))
        return None

    for node in nodes:
        node.interested_in('/each_other', 'std_msgs/String', each_other)
    sender = create(master, '/sender')
    sender.send_to('/each_other', data='fail')
    until(lambda: all(node.failures for node in nodes))
    for text in 'wait', 'go on':
        sender.send_to('/each_other', data=text)
    assert {heard.get(timeout=TIMEOUT) for _ in nodes} == set(nodes)
    assert len([text for text in ended if 'wait for one another' in str(text)]) == 1


def test_what_came_inline_while_a_delegate_was_run_again_is_not_left_lying(
    master, transcript, mailbox
):
    node, sender = create(master), create(master, '/sender')
    channel = node.interested_in(
        '/again', 'std_msgs/String', delegate=Raising(ValueError('bad')), inline=True
    )
    sender.send_to('/again', data='bad')
    (failure,) = node.failures

    def again(message, channel):
        mailbox(message, channel)
        if message.data == 'bad':
            meanwhile = threading.Thread(
                target=sender.send_to, args=('/again',), kwargs={'data': 'meanwhile'}
            )
            meanwhile.start()
            meanwhile.join(TIMEOUT)

    channel.delegate = again
    assert failure.retry() is True
    assert [message.data for message in mailbox.take(2)] == ['bad', 'meanwhile']


def test_a_soul_is_run_again_as_it_is_now(master, transcript, mailbox):
    node, forked = create(master, soul=lambda me: 1 / 0), Raising(ValueError('bad'))
    node.execute()
    node.fork(forked).join(TIMEOUT)
    node.soul = lambda me: mailbox('again', None)
    of_soul, of_fork = node.failures
    assert of_soul.retry() is True
    assert mailbox.next() == 'again'
    assert of_soul.message is of_soul.channel is None
    assert of_fork.retry() is True
    assert forked.taken.next() is node
    assert mailbox.empty()


def test_a_service_block_is_run_again_on_the_same_request(master, transcript, mailbox):
    node = create(master)
    offered = node.serve('/fails_again', 'std_srvs/SetBool', lambda request: 1 / 0)
    with pytest.raises(pharos.ServiceCallError):
        master.lookup_service('/fails_again').call(data=True)
    (failure,) = node.failures
    assert failure.message.data is True
    assert failure.retry() is False
    assert failure.count == 2
    offered.block = lambda request: mailbox(request, None) or {'success': True}
    assert failure.retry() is True
    assert mailbox.next() is failure.message


def test_a_parameter_block_is_run_again_on_the_same_value(master, transcript):
    node, block = create(master), Raising(ValueError('bad'))
    parameter = node.parameter('~again')
    parameter.on_change(block)
    parameter.set(5)
    (failure,) = node.failures
    assert failure.message == 5
    assert failure.block is block
    assert failure.retry() is True
    assert block.taken.next() == 5
    failing(node, ValueError, failures.WHOLE)
    with pytest.raises(pharos.PharosError, match='newest 5'):
        failure.retry()


def test_the_newest_failures_alone_are_run_again_and_looked_at(master, transcript, monkeypatch):
    looked_at = []
    monkeypatch.setattr(debugger, 'look_at', looked_at.append)
    node = create(master)
    failing(node, lambda number: ValueError(f'bad {number}'), 10)
    assert [failure.is_whole for failure in node.failures] == [False] * 5 + [True] * 5
    old, new = node.failures[0], node.failures[-1]
    new.debug()
    *_, (innermost, _) = traceback.walk_tb(looked_at.pop())
    assert innermost.f_locals['message'].data == 9
    assert old.message is None
    assert old.error.__traceback__ is None
    assert 'bad 0' in old.traceback
    for do in old.retry, old.debug:
        with pytest.raises(pharos.PharosError, match='of /node on /counted.* newest 5'):
            do()
    assert not looked_at


def test_a_delegate_of_a_stopped_node_is_not_run_again(master, transcript):
    node = create(master)
    failing(node, lambda number: ValueError('bad'), 1)
    (failure,) = node.failures
    node.stop()
    with pytest.raises(pharos.NodeStoppedError):
        failure.retry()
    assert failure.message.data == 0


def test_a_retry_that_waits_for_its_turn_ends_when_the_node_stops(master, transcript):
    node = create(master)
    node.stop_timeout = 0.1
    failing(node, lambda number: ValueError('bad'), 1)
    (failure,) = node.failures
    busy, go_on, raised = threading.Event(), threading.Event(), []

    def slow(message, channel):
        busy.set()
        go_on.wait(TIMEOUT)

    def retry():
        try:
            failure.retry()
        except pharos.NodeStoppedError as error:
            raised.append(str(error))

    node.interested_in('/slow', 'std_msgs/Empty', delegate=slow)
    node.send_to('/slow')
    assert busy.wait(TIMEOUT)
    retrying = in_thread(retry)
    node.stop()
    assert ended(retrying)
    go_on.set()
    assert raised == ['/node has stopped meanwhile: start() it first']
    assert failure.count == 1


def test_no_block_of_a_stopped_node_is_run_again(master, transcript):
    node, failing_once = create(master), Raising(*[ValueError('bad')] * 3)
    node.serve('/fails_again', 'std_srvs/Empty', failing_once)
    with pytest.raises(pharos.ServiceCallError):
        master.lookup_service('/fails_again').call()
    node.parameter('~again').on_change(failing_once)
    master.parameters['/node/again'] = 1
    node.fork(failing_once)
    until(lambda: len(node.failures) == 3)
    node.stop()
    for failure in node.failures:
        with pytest.raises(pharos.NodeStoppedError, match='/node is stopped: start'):
            failure.retry()
    node.start()
    assert [failure.retry() for failure in node.failures] == [True] * 3


class Fails(pharos.Node):
    """Blocks that fail, of every kind."""

    def __init__(self):
        super().__init__()
        self.done = []

    def hear(self, message, channel):
        raise ValueError(message.data)

    def answer(self, request):
        raise ValueError('answer')

    def change(self, value):
        raise ValueError(value)

    def live(self):
        raise ValueError('live')


class Mended(Fails):
    """The same, mended."""

    def hear(self, message, channel):
        self.done.append(message.data)

    def answer(self, request):
        self.done.append('answer')
        return {}

    def change(self, value):
        self.done.append(value)

    def live(self):
        self.done.append('live')


def test_blocks_that_are_mended_by_another_class_are_run_again(master, transcript):
    node = create(master, node_class=Fails)
    channel = node.interested_in('/fails', 'std_msgs/String', node.hear)
    node.serve('/fails_again', 'std_srvs/Empty', node.answer)
    node.parameter('~again').on_change(node.change)
    node.send_to('/fails', data='hear')
    until(lambda: channel.received)
    with pytest.raises(pharos.ServiceCallError):
        master.lookup_service('/fails_again').call()
    master.parameters['/node/again'] = 5
    ended(node.fork(Fails.live))
    until(lambda: len(node.failures) == 4)
    node.become(Mended)
    assert [failure.retry() for failure in node.failures] == [True] * 4
    assert {*node.done} == {'hear', 'answer', 5, 'live'}
    assert len(node.done) == 4


def test_a_debugger_opens_in_the_frame_while_the_node_goes_on(master):
    debugged = subprocess.run(
        [PROGRAMS / 'debugs.py'],
        input='p local\np counted()\nw\nc\n',
        env=environment(master.url),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=2 * TIMEOUT,
        check=False,
    )
    told = debugged.stdout.split('(Pdb) ')
    assert "raise ValueError(f'{local} is bad')" in told[0]
    assert told[1:3] == ['1\n', 'True\n'], debugged.stdout
    assert 'debugs.py' in told[3]
    assert told[-1] == "retried True [1, 2, 'again 1']\n"
    assert debugged.returncode == 0


def test_ipython_shows_failures_and_debugs_them_with_its_own_debugger(master, tmp_path):
    session = subprocess.run(
        [sys.executable, '-m', 'IPython', '--simple-prompt', '--no-banner', '--colors=NoColor'],
        input=(PROGRAMS / 'debugs.ipy').read_text(),
        env=environment(master.url, IPYTHONDIR=str(tmp_path), COLUMNS='120'),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=2 * TIMEOUT,
        check=False,
    )
    told = [line.split('told ')[1] for line in session.stdout.splitlines() if 'told ' in line]
    assert told == ['1', '1 True', "True ['again']"], session.stdout
    assert re.search(
        r'\n0  1 .*  delegate on_number on /debugged  ZeroDiv.*  data=1\n', session.stdout
    )
    assert 'ipdb> ' in session.stdout
    assert session.returncode == 0


def test_a_ctrl_c_after_the_debugger_is_no_wish_to_debug(master):
    before = signal.getsignal(signal.SIGINT)
    with mock.patch('builtins.input', return_value='continue'):
        try:
            1 / 0
        except ZeroDivisionError as error:
            debugger.look_at(error.__traceback__)
    assert signal.getsignal(signal.SIGINT) is before


def test_what_nobody_raised_cannot_be_looked_at():
    kept = failures.Failures(lambda line, details: None)
    kept.report(ValueError('refused'), None, 'connection of /node')
    with pytest.raises(pharos.PharosError, match='connection of /node failed.*has no frames'):
        kept.all()[0].debug()


# -- as a table


def test_failures_are_shown_as_a_table_that_fits_the_terminal(master, transcript, monkeypatch):
    node = create(master)
    assert repr(node.failures) == 'no failures'
    failing(node, lambda number: ValueError('the turtle\nis too fast'), 3)
    node.parameter('~watched').on_change(lambda value: 1 / 0)
    master.parameters['/node/watched'] = {'a': [1.0] * 1000}
    until(lambda: len(node.failures) == 2)
    for width in 80, 200:
        monkeypatch.setenv('COLUMNS', str(width))
        lines = repr(node.failures).split('\n')
        assert lines[0].split() == ['#', 'count', 'when', 'block', 'cause', 'message']
        assert max(map(len, lines)) <= width
        assert re.match(r'0  3      \d\d:\d\d:\d\d  delegate .*  ValueError: ', lines[1])
        (second,) = [line for line in lines if line.startswith('1 ')]
        assert re.match(r'1  1      \d\d:\d\d:\d\d  parameter .*  Zero', second)
    assert re.search('  ValueError: the turtle is too fast +data=2$', lines[1])
    assert '  delegate failing.<locals>.delegate on /counted  ' in lines[1]
    assert isinstance(node.failures, list)


def test_failures_are_a_table_in_a_notebook(master, transcript):
    node = create(master)
    failing(node, lambda number: ValueError('<b>'), 1)
    table = node.failures._repr_html_()
    assert '<td>ValueError: &lt;b&gt;</td><td>data=0</td>' in table


def test_the_table_shows_the_newest_failures_and_messages_in_few_digits(monkeypatch):
    monkeypatch.setenv('COLUMNS', '120')
    pose = Pose()
    pose.position.x, pose.orientation.w = 2.6249999, 1.0
    failed = [
        failures.Failure(ValueError(f'bad {number}'), None, 'delegate', message=pose)
        for number in range(100)
    ]
    lines = failure_table.as_text(failed).splitlines()
    assert [line.split()[0] for line in lines if line[0].isdigit()] == [*map(str, range(90, 100))]
    assert lines[-1] == '... 90 more, which are older'
    text = failure_table.as_html(failed)
    message = 'position=(x=2.62, y=0, z=0), orientation=(x=0, y=0, z=0, w=1)'
    assert message in text and '90 more' in text
    assert 'more' not in failure_table.as_text(failed[:10])


def test_the_table_names_a_large_message_by_its_first_values():
    failure = failures.Failure(
        ValueError('bad'), None, 'delegate', message=Image(data=b'1' * 10**7)
    )
    begin = time.monotonic()
    text = failure_table.as_html([failure])
    assert time.monotonic() - begin < 1.0
    assert 'data=[49, 49, 49, ... 10000000 in all]' in text


def test_a_message_that_cannot_be_shown_is_named_in_the_table():
    message = String(data=Unspeakable())
    table = failure_table.as_text(
        [failures.Failure(ValueError('bad'), None, 'delegate', message=message)]
    )
    assert '<std_msgs/String>' in table


def test_the_words_of_an_error_do_nothing_to_the_terminal():
    error = ValueError('\x1b[31mred\x00')
    assert '?[31mred?' in failure_table.as_text([failures.Failure(error, None, 'delegate')])
