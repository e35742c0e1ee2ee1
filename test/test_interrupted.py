"""What cannot be done because the master is away, or the start ends early, leaves nothing behind
and loses nothing."""
import contextlib
import itertools
import os
import signal
import socket
import threading

import pytest
import std_msgs.msg
import std_srvs.srv

from helpers import create, ended, in_thread, interrupted_at, registrations, speak_tcpros_only
from pharos.testing import Mailbox, TIMEOUT, until
import pharos
from pharos import Master, node_registry, offered_service, openings, output_channel
from pharos import channel as channels, restarts, run, signals, watcher
from pharos.private_rospy import condition, connections, proxies, registration, sender
from pharos.private_rospy.connections import Connections

STRING = 'std_msgs/String'


@pytest.fixture
def away(monkeypatch):
    """A Master whose process a test may end, stop for a while, or start again."""
    monkeypatch.setattr(watcher, 'PERIOD', 0.1)
    embedded = Master.embedded()
    monkeypatch.setenv('ROS_MASTER_URI', embedded.url)

    class Away(Master):
        def end(self):
            """kill -9"""
            embedded._child.kill()
            embedded._child.wait()

        def come_back(self):
            nonlocal embedded
            embedded = Master.embedded(port=int(self.url.rsplit(':', 1)[1].strip('/')))

        def hang(self):
            embedded._child.send_signal(signal.SIGSTOP)
            os.waitid(os.P_PID, embedded._child.pid, os.WSTOPPED)  # it is not at once

        def go_on(self):
            embedded._child.send_signal(signal.SIGCONT)

    master = Away(embedded.url)
    yield master
    master.go_on()
    node_registry.stop_all()
    master.end()


# -- the master is away

OPENERS = {
    'interested_in': lambda node: node.interested_in('/interrupted/opened', STRING),
    'output_channel': lambda node: node.output_channel('/interrupted/opened', STRING),
    'send_to': lambda node: node.send_to('/interrupted/opened', typed_as=STRING, data='x'),
    'serve': lambda node: node.serve('/interrupted/opened', 'std_srvs/Empty', lambda request: None),
    'parameter': lambda node: node.parameter('/interrupted/opened', 5),
    'on_change': lambda node: node.parameter('/interrupted/opened').on_change(print),
}


@pytest.mark.parametrize('opener', OPENERS)
def test_what_is_opened_while_the_master_is_away_raises_and_leaves_nothing_behind(away, opener):
    node = create(away, '/node')
    before = registrations(away, '/node')
    away.end()
    for _ in range(2):
        with pytest.raises(pharos.MasterUnreachableError, match=away.url) as raised:
            OPENERS[opener](node)
        assert isinstance(raised.value.__cause__, ConnectionRefusedError)
    assert node.channels == node.latest_run.opened == []
    assert not node.errors
    away.come_back()
    until(lambda: registrations(away, '/node') == before)
    assert '/interrupted/opened' not in away.parameters
    OPENERS[opener](node)  # it can be done as if nothing had been
    assert sum(map(len, registrations(away, '/node'))) == sum(map(len, before)) + (
        opener not in ('parameter', 'on_change')
    )
    node.stop()
    assert registrations(away, '/node') == [[], [], []]
    assert away.api('/test').subscribeParam('http://127.0.0.1:1/', '/interrupted/opened') in (
        {},
        5,
    )


def test_a_second_channel_on_a_topic_needs_no_master(away, mailbox):
    receiver, sender = create(away, '/receiver', delegate=mailbox), create(away, '/sender')
    receiver.interested_in('/interrupted/second', STRING)
    sender.output_channel('/interrupted/second', STRING)
    away.end()
    other = Mailbox()
    receiver.interested_in('/interrupted/second', delegate=other)
    sender.output_channel('/interrupted/second').send(data='still')
    assert mailbox.next().data == other.next().data == 'still'


def test_what_plain_rospy_opens_while_the_master_is_away_is_registered_later(away):
    node, mailbox = create(away, '/node'), Mailbox()
    away.end()
    node.ros.Subscriber(
        '/interrupted/plain', std_msgs.msg.String, lambda message: mailbox(message, None)
    )
    publisher = node.ros.Publisher('/interrupted/plain', std_msgs.msg.String, queue_size=5)
    node.ros.Service('/interrupted/plain_service', std_srvs.srv.Empty, lambda request: None)
    away.come_back()
    until(lambda: publisher.get_num_connections())
    publisher.publish('found')
    assert mailbox.next().data == 'found'
    until(lambda: '/interrupted/plain_service' in registrations(away, '/node')[2])


def test_what_is_closed_while_the_master_hangs_is_unregistered_when_it_goes_on(away, monkeypatch):
    # seconds that a call may take
    monkeypatch.setattr(proxies.ServerProxy.__init__, '__defaults__', (0.2,))
    node = create(away, '/node')
    before = registrations(away, '/node')
    opened = [
        node.interested_in('/interrupted/in', STRING),
        node.output_channel('/interrupted/out', STRING),
        node.serve('/interrupted/service', 'std_srvs/Empty', lambda request: None),
    ]
    away.hang()
    for closed in opened:
        closed.close()
    with pytest.raises(pharos.MasterUnreachableError, match='timed out'):
        node.output_channel('/interrupted/later', STRING)
    until(lambda: watcher.watcher_of(away).reachable_since is None)
    away.go_on()
    until(lambda: registrations(away, '/node') == before)


def test_a_repair_that_failed_is_made_again_in_full(away, monkeypatch):
    create(away, '/node')
    repair, made = registration.repair, []

    def repair_at_the_second_attempt(node, state, was_away):
        made.append(was_away)
        if len(made) == 1:
            raise ConnectionResetError
        repair(node, state, was_away)

    away.end()
    until(lambda: watcher.watcher_of(away).reachable_since is None)
    monkeypatch.setattr(registration, 'repair', repair_at_the_second_attempt)
    away.come_back()
    until(lambda: len(made) > 2)
    assert made[:3] == [True, True, False]


@pytest.mark.parametrize('how', ['end', 'hang'])
def test_a_first_line_of_the_log_is_told_while_the_master_is_away(away, how):
    speaker, listener, lines = create(away, '/speaker'), create(away, '/listener'), Mailbox()
    listener.interested_in('/rosout', 'rosgraph_msgs/Log', lines, from_=speaker)
    getattr(away, how)()
    speaker.log('all alone')
    assert lines.next().msg == 'all alone'


def test_a_line_that_comes_too_late_for_rosout_shows_no_traceback(away, capfd):
    node = create(away, '/node')
    rosout = node.ros.impl.rosout
    node.stop()
    away.end()
    rosout._rosout(8, 'was under way', 'file.py', 1, 'function')
    node.latest_run.rospy.module.logwarn('the last word')
    assert capfd.readouterr().err == 'the last word\n'


@pytest.mark.parametrize('stops', [False, True])
@pytest.mark.parametrize('opener', ['interested_in', 'output_channel', 'serve'])
def test_what_could_not_be_opened_while_the_master_hung_is_not_there_when_it_goes_on(
    away, monkeypatch, opener, stops
):
    """The call had timed out here, and was made there later."""
    node = create(away, '/node')
    before = registrations(away, '/node')
    node.connect_timeout = 0.1
    monkeypatch.setattr(registration, 'REGISTER_TIMEOUT', 0.1)
    monkeypatch.setattr(registration, 'name_is_anothers', lambda node: False)  # asks it, too
    away.hang()
    with pytest.raises(pharos.MasterUnreachableError):
        OPENERS[opener](node)
    away.go_on()
    if stops:
        node.stop()
        before = [[], [], []]
    until(lambda: registrations(away, '/node') == before)


def test_what_the_master_registers_later_than_it_was_to_be_taken_back_is_taken_back(
    ros_master, master, monkeypatch
):
    """A master that goes on answers what waits in any order."""
    node, handler = create(master, '/node'), ros_master.handler
    unregister = handler.unregisterPublisher

    def register_late(caller_id, topic, uri):
        answer = unregister(caller_id, topic, uri)
        if topic == '/interrupted/late':
            monkeypatch.setattr(handler, 'unregisterPublisher', unregister)
            handler.registerPublisher(caller_id, topic, STRING, uri)
        return answer

    monkeypatch.setattr(handler, 'unregisterPublisher', register_late)
    node.latest_run.rospy.unsure.add(('unregisterPublisher', '/interrupted/late', node.uri))
    node.stop()
    assert handler.unregisterPublisher == unregister
    assert registrations(master, '/node') == [[], [], []]


# -- the start is interrupted


@pytest.fixture
def stopped(away, mailbox):
    """A node that was stopped, which had of everything something."""
    node = create(away, '/node', delegate=mailbox)
    node.interested_in('/interrupted/in', STRING)
    node.output_channel('/interrupted/out', STRING, latch=True).send(data='kept')
    node.serve('/interrupted/service', 'std_srvs/SetBool', lambda request: {'message': 'kept'})
    node.changes = Mailbox()
    node.parameter('/interrupted/parameter', 1).on_change(lambda value: node.changes(value, None))
    node.stop()
    return node


def assert_all_is_back(master, node, mailbox):
    peer = create(master, '/peer')
    peer.send_to('/interrupted/in', typed_as=STRING, data='hello')
    assert mailbox.next().data == 'hello'
    late = Mailbox()
    peer.interested_in('/interrupted/out', STRING, delegate=late)
    assert late.next().data == 'kept'
    assert master.lookup_service('/interrupted/service').call(data=True).message == 'kept'
    peer.parameter('/interrupted/parameter').set(2)
    assert node.changes.next() == 2
    assert len(node.channels) == 2


def test_a_start_without_a_master_loses_nothing(away, stopped, mailbox):
    away.end()
    for _ in range(2):
        with pytest.raises(pharos.MasterUnreachableError):
            stopped.start()
    away.come_back()
    stopped.start()
    assert_all_is_back(away, stopped, mailbox)


def test_a_start_at_a_busy_port_loses_nothing(away, stopped, mailbox):
    with socket.socket() as busy:
        busy.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        busy.bind(('127.0.0.1', stopped.tcp_port))
        busy.listen()
        with pytest.raises(pharos.PortInUseError):
            stopped.start()
    stopped.start()
    assert_all_is_back(away, stopped, mailbox)


@pytest.mark.parametrize('what', ['interested_in', 'output_channel', 'serve', 'parameter'])
@pytest.mark.parametrize(
    'error', [pharos.MasterUnreachableError('gone'), KeyboardInterrupt()], ids=type
)
def test_a_start_that_is_interrupted_while_it_opens_what_it_had_loses_nothing(
    away, stopped, mailbox, monkeypatch, what, error
):
    def interrupt(*args, **kwargs):
        raise error

    with monkeypatch.context() as patch:
        if what == 'parameter':
            patch.setattr('pharos.private_rospy.parameters.WatchedParameters._subscribe', interrupt)
        elif what == 'serve':
            patch.setattr('pharos.offered_service.OfferedService.open', interrupt)
        else:
            kind = 'InputChannel' if what == 'interested_in' else 'OutputChannel'
            patch.setattr(getattr(pharos, kind), 'open', interrupt)
        for _ in range(2):
            with pytest.raises(type(error)):
                stopped.start()
            assert stopped.lifecycle.value == 'stopped'
            assert registrations(away, '/node') == [[], [], []]
    stopped.start()
    assert_all_is_back(away, stopped, mailbox)


def test_a_start_during_which_the_master_goes_loses_nothing(away, stopped, mailbox, monkeypatch):
    begin = pharos.InputChannel.open

    def open_when_it_has_gone(*arguments):
        away.end()
        begin(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(pharos.InputChannel, 'open', open_when_it_has_gone)
        with pytest.raises(pharos.MasterUnreachableError):
            stopped.start()
    away.come_back()
    stopped.start()
    assert_all_is_back(away, stopped, mailbox)


def test_a_start_that_is_stopped_while_it_opens_what_it_had_loses_nothing(
    away, stopped, mailbox, monkeypatch
):
    begin = pharos.OutputChannel.open

    def open_when_it_was_stopped(self, *args):
        stopper = threading.Thread(target=self.node.stop)
        stopper.start()
        stopper.join(TIMEOUT)
        begin(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(pharos.OutputChannel, 'open', open_when_it_was_stopped)
        with pytest.raises(pharos.NodeStoppedError, match='stopped while it started'):
            stopped.start()
    stopped.start()
    assert_all_is_back(away, stopped, mailbox)


def test_a_channel_closed_while_its_node_is_stopped_does_not_come_back(away, stopped):
    for channel in list(stopped.latest_run.opened):
        channel.close()
    stopped.start()
    assert stopped.channels == []
    assert '/interrupted/in' not in registrations(away, '/node')[1]


def test_a_start_that_ends_as_its_node_is_started_again_takes_nothing_with_it(master, monkeypatch):
    node, really = create(master, '/node'), Connections.advertise
    channel = node.output_channel('/interrupted/again', STRING)
    node.stop()
    opened, started, raised = threading.Event(), threading.Event(), Mailbox()

    def open_slowly(*arguments):
        endpoint = really(*arguments)
        if not opened.is_set():
            opened.set()
            started.wait(TIMEOUT)
        return endpoint

    def start():
        try:
            node.start()
        except pharos.NodeStoppedError as error:
            raised(error, None)

    monkeypatch.setattr(Connections, 'advertise', open_slowly)
    starting = in_thread(start)
    assert opened.wait(TIMEOUT)
    node.stop()
    node.start()
    started.set()
    assert ended(starting)
    assert raised.next()
    assert node.channels == [channel]
    channel.send(data='sent')


# -- a handler of the program's own raises


@pytest.fixture
def handler_that_raises():
    def ring(*_):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, ring)
    yield ring
    signal.signal(signal.SIGALRM, before)


STEPS = {
    'stop': (lambda node: node.start(), lambda node: node.stop(), False),
    'start': (lambda node: node.stop(), lambda node: node.start(), True),
    'restart': (lambda node: node.start(), lambda node: node.restart(), True),
}


@pytest.mark.parametrize('step', STEPS)
def test_a_handler_that_raises_anywhere_in_it_tears_up_nothing(
    master, mailbox, handler_that_raises, step
):
    """It has been done in full when that is raised, or not at all."""
    prepare, do, is_to_run = STEPS[step]
    node = create(master, '/node', delegate=mailbox)
    node.interested_in('/interrupted/heard', STRING)
    other = create(master, '/other').output_channel('/interrupted/heard', STRING)
    modules = (contextlib, node_registry, openings, restarts, run, signals)
    was_running = {'stop': True, 'start': False, 'restart': True}[step]
    done = 0
    for number in itertools.count():
        if node.is_running != was_running:
            prepare(node)
        is_interrupted = interrupted_at(number, lambda: do(node), modules, signal.SIGALRM)
        assert node.lifecycle.value in ('running', 'stopped')
        assert not node_registry._stops and not restarts._restarts
        names = [each.name for each in master.nodes()]
        assert ('/node' in names) == node.is_running
        done += node.is_running == is_to_run
        if node.is_running:
            assert other.wait_for_subscribers(timeout=TIMEOUT)
            other.send(data=str(number))
            assert mailbox.wait_for(lambda message: message.data == str(number))
        if not is_interrupted:
            break
    assert node.is_running == is_to_run
    assert signal.getsignal(signal.SIGALRM) is handler_that_raises
    assert done > 5 or step == 'start'  # which is taken back


@pytest.mark.parametrize('when', ['before', 'after'])
def test_a_handler_that_raises_in_an_overriding_stop_lets_that_end(
    master, handler_that_raises, when
):
    went_on = []

    class Careful(pharos.Node):
        def stop(self):
            if when == 'after':
                super().stop()
            signal.raise_signal(signal.SIGALRM)
            went_on.append(self)

    node = create(master, '/careful', Careful)
    with pytest.raises(KeyboardInterrupt):
        node.stop()
    assert went_on == [node]
    assert node.lifecycle.value == 'stopped'
    assert signal.getsignal(signal.SIGALRM) is handler_that_raises


@pytest.mark.parametrize('opener', ['interested_in', 'output_channel', 'serve'])
def test_a_handler_that_raises_anywhere_in_a_close_leaves_no_registration(
    master, handler_that_raises, opener
):
    node = create(master, '/node')
    modules = (channels, connections, openings, offered_service, output_channel, signals)
    before, closed = registrations(master, '/node'), 0
    for number in itertools.count():
        opened = OPENERS[opener](node)
        is_interrupted = interrupted_at(number, opened.close, modules, signal.SIGALRM)
        closed += registrations(master, '/node') == before
        if not is_interrupted:
            break
        opened.close()
        assert registrations(master, '/node') == before
    assert closed > 5


# -- a send is interrupted


def test_a_signal_that_interrupts_a_send_over_tcpros_anywhere_leaves_it_to_others(master, mailbox):
    """Neither a lock is taken for good, nor a message cut short."""
    receiver = speak_tcpros_only(create(master, '/receiver', delegate=mailbox))
    receiver.interested_in('/interrupted/sent', STRING)
    sent = create(master, '/sender').output_channel('/interrupted/sent', STRING)
    for step in itertools.count():
        until(lambda: sent.connections)
        is_interrupted = interrupted_at(
            step, lambda: sent.send(data='interrupted'), (sender, threading)
        )

        def send_until_heard():
            while True:
                sent.send(data=str(step))
                with contextlib.suppress(TimeoutError):  # the connection was closed, for safety
                    return mailbox.wait_for(lambda message: message.data == str(step), 0.2)

        assert ended(in_thread(send_until_heard))
        if not is_interrupted:
            break
    assert step > 3
    assert ended(in_thread(sent.node.stop))


def test_a_condition_is_left_taken_nowhere():
    """Those of threading are, where a handler of signals raises as they are taken."""
    for step in itertools.count():
        lock = condition.Condition()

        def take(lock=lock):
            with lock:
                lock.notify_all()

        is_through = not interrupted_at(step, take, [threading, condition])
        is_free = []
        assert ended(in_thread(lambda: is_free.append(lock.acquire(blocking=False))))
        assert is_free == [True]
        if is_through:
            return
