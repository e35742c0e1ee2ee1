"""Fast delegates of several nodes that get the same message run in one thread, one after the other,
and no node holds another one up by that."""
import itertools
import os
import threading
import types
import warnings

import pytest
from hypothesis import given, settings, strategies as st
from std_msgs.msg import Int32

from helpers import create, ended, in_thread, interrupted_at
from pharos.intraprocess import common_thread, dispatcher, fanout, inbox
from pharos.intraprocess.dispatcher import Dispatcher
from pharos.intraprocess.fanout import Fanout
from pharos.intraprocess.inbox import Inbox
from pharos.private_rospy.lifetime import Interruption
from pharos.testing import TIMEOUT, Mailbox, until

INT = 'std_msgs/Int32'


@pytest.fixture(autouse=True)
def all_are_fast(monkeypatch):
    """However long a delegate takes, and however soon the next message comes: so the common thread
    runs whatever it may."""
    monkeypatch.setattr(dispatcher, 'FAST_CREDIT', 0)
    monkeypatch.setattr(fanout, 'BURST_INTERVAL', -1.0)


def common_is_idle():
    common = common_thread._common or common_thread._begin()
    return common.idle


class Receiver:
    """Runs ``block(number)`` for what comes."""

    topic, message_class, from_ = '/t', Int32, None
    queue_size, queue_bytes, shared = 1000, 1 << 20, False

    def __init__(self, block, inline):
        self.block, self.inline = block, inline

    def deliver(self, message, header):
        self.block(message.data)


class Nodes:
    """Dispatchers with threads, each with a receiver of what is published."""

    def __init__(self, blocks, on_behalf=lambda run, name: run(), inline=False):
        self.threads = []
        self.dispatchers = [Dispatcher(self.start_thread, on_behalf=on_behalf) for _ in blocks]
        self.fanout = Fanout(Int32, threading.RLock(), None)
        connections = []
        for each, block in zip(self.dispatchers, blocks):
            receiver = Receiver(block, inline)
            inbox = Inbox(receiver, each, self.fanout._thaw, {})
            link = types.SimpleNamespace(inboxes={receiver: inbox}, header={})
            connections.append(types.SimpleNamespace(endpoint_id='', link=link))
            each.need_thread()
        self.fanout.set_connections(connections)

    def start_thread(self, target, name):
        self.threads.append(in_thread(target))

    def are_idle(self):
        return all(each.idle for each in self.dispatchers)

    def publish(self, number, fast=True):
        for each in self.dispatchers:
            each.is_fast = fast
        self.fanout.publish(Int32(number))

    def close(self):
        for each in self.dispatchers:
            each.close()
        assert all(ended(thread) for thread in self.threads)


@pytest.fixture
def nodes_with():
    """Makes dispatchers with receivers."""
    made = []

    def make(blocks, **options):
        made.append(Nodes(blocks, **options))
        until(lambda: made[-1].are_idle() and common_is_idle())
        return made[-1]

    yield make
    for each in made:
        each.close()
    common_thread.end()


# -- what it does


def in_one_thread(channel, mailbox, count):
    """Send until the delegates of so many nodes have run in one thread; returns what they told of
    it."""
    for number in itertools.count():
        channel.send(data=number)
        told = mailbox.take(count)
        if len({thread for thread, _, _ in told}) == 1:
            return told
        until(common_is_idle)


def tell_thread(told):
    """A delegate that tells in which thread it runs."""

    def tell(message, channel):
        name = threading.current_thread().name
        told((threading.get_ident(), name, channel.node.name), channel)

    return tell


def receivers(master, delegate, count=5):
    nodes = [create(master, f'/receiver{number}') for number in range(count)]
    for node in nodes:
        node.interested_in('/t', INT, delegate=delegate)
    return nodes


def test_fast_delegates_of_several_nodes_run_in_one_thread_as_if_it_were_each_nodes(
    master, mailbox
):
    nodes = receivers(master, tell_thread(mailbox))
    sent = create(master, '/sender').output_channel('/t', INT)
    told = in_one_thread(sent, mailbox, len(nodes))
    assert sorted(name for _, name, _ in told) == [f'{node.name} dispatcher' for node in nodes]
    assert all(name == f'{node} dispatcher' for _, name, node in told)


def test_the_common_thread_ends_with_the_last_node(master, mailbox):
    nodes = receivers(master, tell_thread(mailbox))
    sent = create(master, '/sender').output_channel('/t', INT)
    in_one_thread(sent, mailbox, len(nodes))
    thread = common_thread._common.thread
    sent.node.stop()
    for node in nodes[:-1]:
        node.stop()
    assert thread.is_alive()
    nodes[-1].stop()
    assert not thread.is_alive()


def test_a_publisher_that_comes_too_late_begins_none_again(nodes_with, monkeypatch):
    nodes = nodes_with([lambda number: None] * 2)
    begin = common_thread._begin

    def begin_late():
        nodes.close()
        common_thread.end()
        return begin()

    common_thread.end()
    monkeypatch.setattr(common_thread, '_begin', begin_late)
    nodes.publish(1)
    assert common_thread._common is None


def test_a_node_is_run_by_it_once_it_has_been_fast_for_some_time(monkeypatch, nodes_with):
    monkeypatch.undo()
    monkeypatch.setattr(dispatcher, 'FAST_TURN', TIMEOUT)
    nodes = nodes_with([lambda number: None] * 2)
    # a publisher that yields in vain, as on a busy machine, would count as a slow turn
    for each in nodes.dispatchers:
        each.is_yielded_to = False
    for number in range(dispatcher.FAST_CREDIT):
        assert not any(each.is_fast for each in nodes.dispatchers)
        nodes.fanout.publish(Int32(number))
        until(nodes.are_idle)
    assert all(each.is_fast for each in nodes.dispatchers)
    monkeypatch.setattr(dispatcher, 'FAST_TURN', 0.0)
    for each in nodes.dispatchers:
        each.is_yielded_to = True
    # a turn in a thread of its own does not count
    while any(each.is_fast for each in nodes.dispatchers):
        nodes.fanout._last_wake = 0.0
        nodes.fanout.publish(Int32(0))
        until(lambda: nodes.are_idle() and common_is_idle())


def test_a_node_that_keeps_to_its_thread_is_run_by_no_other(nodes_with):
    ran = Mailbox()
    nodes = nodes_with([lambda number: ran(threading.get_ident(), None)] * 3, on_behalf=None)
    for number in range(3):
        nodes.fanout.publish(Int32(number))
        assert len(set(ran.take(3))) == 3
        until(lambda: nodes.are_idle() and common_is_idle())


# -- no node holds another one, or a publisher, up


def test_a_publisher_waits_for_a_delegate_only_while_that_is_fast(nodes_with, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(dispatcher, 'FAST_TURN', 0.0)
    goes_on, ran = threading.Semaphore(0), threading.Semaphore(0)

    def wait(number):
        assert goes_on.acquire(timeout=TIMEOUT)
        ran.release()

    nodes = nodes_with([wait])
    (one,) = nodes.dispatchers
    one.is_fast, one._credit = True, dispatcher.MAX_CREDIT
    count = 0
    while one.is_fast:
        nodes.fanout._last_wake = 0.0  # no burst
        nodes.fanout.publish(Int32(count))  # returns, though the delegate waits for what follows
        goes_on.release()
        assert ran.acquire(timeout=TIMEOUT)
        until(nodes.are_idle)
        count += 1
    assert 1 < count < 5


def test_a_publisher_does_not_wait_for_who_was_woken_in_vain(nodes_with):
    (one,) = nodes_with([lambda number: None]).dispatchers
    one.is_fast = True
    one.wake()
    assert one._awake_signal.acquire(True, TIMEOUT)


def test_delegates_of_a_hundred_nodes_that_all_wait_hold_none_of_them_up(nodes_with):
    everyone = threading.Barrier(101)
    nodes = nodes_with([lambda number: everyone.wait(TIMEOUT)] * 100)
    for number in range(5):
        nodes.publish(number)
        everyone.wait(TIMEOUT)
        until(lambda: nodes.are_idle() and common_is_idle())


def test_other_nodes_go_on_getting_messages_while_the_common_thread_waits_in_a_delegate(
    nodes_with,
):
    release, stuck, got = threading.Event(), threading.Event(), Mailbox()

    def wait(number):
        stuck.set()
        release.wait(TIMEOUT)

    nodes = nodes_with([wait, *[lambda number: got(number, None)] * 5])
    for number in range(20):
        nodes.publish(number)
        assert got.take(5) == [number] * 5
    assert stuck.is_set()
    release.set()


def test_a_publisher_does_not_wait_for_a_delegate_that_waits_for_it(nodes_with):
    has_returned = threading.Event()
    nodes = nodes_with([lambda number: has_returned.wait(TIMEOUT)] * 3)
    nodes.publish(1)
    has_returned.set()
    until(nodes.are_idle)


def test_a_node_that_another_thread_runs_is_left_to_its_own(nodes_with):
    is_run, release, got = threading.Event(), threading.Event(), Mailbox()
    nodes = nodes_with(
        [lambda number, index=index: got((index, number), None) for index in range(3)]
    )

    def run():
        is_run.set()
        release.wait(TIMEOUT)

    in_thread(nodes.dispatchers[1].run_in_turn, run)
    is_run.wait(TIMEOUT)
    nodes.publish(7)
    assert sorted(got.take(2)) == [(0, 7), (2, 7)]
    assert got.empty()
    release.set()
    assert got.next() == (1, 7)


@pytest.mark.parametrize('fast', [True, False])
def test_a_signal_that_interrupts_a_publisher_anywhere_leaves_no_node_deaf(nodes_with, fast):
    goes_on, got = threading.Event(), Mailbox()

    def block(number):
        goes_on.wait(TIMEOUT)
        got(number, None)

    nodes = nodes_with([block] * 3)
    for step in itertools.count():
        goes_on.clear()
        is_interrupted = interrupted_at(
            step, lambda: nodes.publish(-1, fast), (common_thread, dispatcher)
        )
        goes_on.set()
        nodes.publish(step)
        assert sorted(got.take(6)) == [-1] * 3 + [step] * 3
        if not is_interrupted:
            break
        until(lambda: nodes.are_idle() and common_is_idle())
    assert step > 5


@pytest.mark.parametrize('what', ['publish', 'run in turn', 'wait'])
def test_a_signal_that_interrupts_who_runs_a_node_leaves_it_to_others(nodes_with, what):
    got = Mailbox()
    nodes = nodes_with([lambda number: got(number, None)] * 2, inline=True)
    one, _ = nodes.dispatchers
    act = {
        'publish': lambda: nodes.publish(-1),
        'run in turn': lambda: one.run_in_turn(bool),
        'wait': lambda: one.wait_for_delegate(TIMEOUT),
    }[what]
    for step in itertools.count():
        is_interrupted = interrupted_at(step, act, (dispatcher, inbox))
        assert ended(in_thread(one.run_in_turn, bool))
        nodes.publish(step)
        until(lambda: got.all().count(step) == 2)
        if not is_interrupted:
            break
    assert step > 3


ACTS = st.sampled_from(['return', 'let go', 'wait for all', 'publish'])
PLANS = st.lists(st.lists(ACTS, min_size=6, max_size=6), min_size=2, max_size=6)


@settings(max_examples=40, deadline=None)
@given(PLANS, st.lists(st.booleans(), min_size=6, max_size=6))
def test_each_node_gets_all_messages_in_order_and_one_at_a_time_whatever_delegates_do(plan, pauses):
    """They return, let go of the interpreter, wait until all nodes have the message, or publish one
    more."""
    lock, arrived = threading.Lock(), threading.Condition()
    got, running, wrong = [[] for _ in plan], [0] * len(plan), []
    numbers = len(pauses)

    def block(index, acts, number):
        with lock:
            running[index] += 1
            if running[index] > 1:
                wrong.append(f'node {index} runs two delegates')
        with arrived:
            got[index].append(number)
            arrived.notify_all()
        act = acts[number] if number < numbers else 'return'
        if act == 'let go':
            threading.Event().wait(1e-6)
        elif act == 'publish':
            nodes.publish(numbers + number)
        elif act == 'wait for all':
            with arrived:
                if not arrived.wait_for(lambda: all(len(each) > number for each in got), TIMEOUT):
                    wrong.append(f'node {index} holds others up')
        with lock:
            running[index] -= 1

    blocks = [
        lambda number, index=index, acts=acts: block(index, acts, number)
        for index, acts in enumerate(plan)
    ]
    nodes = Nodes(blocks)
    try:
        until(lambda: nodes.are_idle() and common_is_idle())
        for number, pause in enumerate(pauses):
            nodes.publish(number)
            if pause:
                until(nodes.are_idle)
        more = sum(acts.count('publish') for acts in plan)
        until(lambda: all(len(each) == numbers + more for each in got))
    finally:
        nodes.close()
        common_thread.end()
    assert not wrong
    for each in got:
        assert [number for number in each if number < numbers] == list(range(numbers))
        assert sorted(each) == sorted(got[0])


# -- what ends a node


def in_common_thread(master, then):
    """Nodes of which one, '/receiver1', calls ``then(message, channel)`` while the common thread
    runs it; the others' delegates return. Returns the nodes, and the channel to them."""
    mailbox = Mailbox()
    tell = tell_thread(mailbox)
    nodes = receivers(master, tell, 3)
    sent = create(master, '/sender').output_channel('/t', INT)
    in_one_thread(sent, mailbox, 3)

    def run(message, channel):
        if threading.current_thread() is common_thread._common.thread:
            then(message, channel)
        else:
            tell(message, channel)

    nodes[1].channels[0].delegate = run
    return nodes, sent


def send_until(predicate, sent):
    """Send until that holds: on a busy machine, the node's own thread may be the first."""
    for number in itertools.count():
        until(lambda: common_is_idle() or predicate())
        if predicate():
            return
        sent.send(data=number)
        until(
            lambda: predicate()
            or all(
                node.latest_run.dispatcher.idle
                for node in sent.node.master.local_nodes()
                if node is not sent.node  # which has no thread that could be
            )
        )


def test_a_delegate_that_the_common_thread_runs_may_stop_its_node(master, capfd):
    stopped = threading.Event()

    def stop(message, channel):
        channel.node.stop()
        stopped.set()

    nodes, sent = in_common_thread(master, stop)
    send_until(stopped.is_set, sent)
    assert not nodes[1].is_running
    assert 'left behind' not in capfd.readouterr().out
    assert nodes[0].is_running and nodes[2].is_running


def test_the_stop_of_a_node_waits_for_its_delegate_in_the_common_thread(master):
    entered, stopping, waited = threading.Event(), [], []

    def wait(message, channel):
        entered.set()
        until(lambda: stopping and channel.node.latest_run.dispatcher._closed)
        stopping[0].join(0.3)  # well within JOIN_TIMEOUT
        waited.append(stopping[0].is_alive())

    nodes, sent = in_common_thread(master, wait)
    send_until(entered.is_set, sent)
    stopping.append(in_thread(nodes[1].stop))
    assert ended(stopping[0])
    assert waited == [True]


def test_what_waits_in_a_delegate_in_the_common_thread_ends_with_its_node_alone(master, mailbox):
    entered, woken = threading.Event(), threading.Event()

    def wait(message, channel):
        with Interruption(woken.set) as stop:
            entered.set()
            woken.wait(TIMEOUT)
            mailbox(stop.came, channel)

    nodes, sent = in_common_thread(master, wait)
    send_until(entered.is_set, sent)
    nodes[0].stop()
    assert not woken.is_set()
    nodes[1].stop()
    assert mailbox.next() is True


def test_what_a_delegate_raises_in_the_common_thread_fails_alone(master):
    ran = threading.Event()

    def fail(message, channel):
        ran.set()
        raise SystemExit('of this delegate alone')

    nodes, sent = in_common_thread(master, fail)
    send_until(ran.is_set, sent)
    until(lambda: nodes[1].errors)
    assert not nodes[0].errors and not nodes[2].errors
    assert ended(in_thread(lambda: until(common_is_idle)))


def test_a_program_runs_its_delegates_in_a_thread_of_its_own(master, mailbox, tmp_path):
    """A thread of a program has its working directory, and sleeps and ends as one of a process."""
    program = tmp_path / 'program.py'
    program.write_text('import rospy\nrospy.init_node("program")\nrospy.spin()\n')
    nodes = [master.load(str(program), name=f'program{number}') for number in range(3)]
    for node in nodes:
        node.interested_in('/t', INT, delegate=tell_thread(mailbox))
    sent = create(master, '/sender').output_channel('/t', INT)
    for number in range(5):
        sent.send(data=number)
        assert len({thread for thread, _, _ in mailbox.take(3)}) == 3
        until(lambda: all(node.latest_run.dispatcher.idle for node in nodes))


def test_a_forked_process_does_not_wait_for_who_looks_for_a_delegate():
    has_turn, forked = threading.Event(), threading.Event()

    def look():
        with dispatcher._looking:
            has_turn.set()
            forked.wait(TIMEOUT)

    looking = in_thread(look)
    assert has_turn.wait(TIMEOUT)
    with warnings.catch_warnings():  # as below
        warnings.simplefilter('ignore', DeprecationWarning)
        child = os.fork()
    if not child:
        os._exit(not dispatcher._looking.acquire(False))
    forked.set()
    assert os.waitpid(child, 0)[1] == 0
    assert ended(looking)


def test_a_forked_process_has_a_common_thread_of_its_own(master, mailbox):
    nodes = receivers(master, tell_thread(mailbox))
    sent = create(master, '/sender').output_channel('/t', INT)
    in_one_thread(sent, mailbox, len(nodes))
    with warnings.catch_warnings():  # Python 3.12 and later do not like what is tried here
        warnings.simplefilter('ignore', DeprecationWarning)
        child = os.fork()
    if not child:
        os._exit(common_thread._common is not None)
    assert os.waitpid(child, 0)[1] == 0
