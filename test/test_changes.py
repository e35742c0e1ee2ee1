"""What is changed of a node while it runs: its blocks, its souls, a restart, its class."""
import queue
import threading

import pytest

import pharos
from helpers import create, ended, speak_tcpros_only
from pharos.testing import Mailbox, TIMEOUT, until


def publisher(master, topic='/changed', over=None, name='/publisher'):
    """A node that publishes, and its open channel."""
    node = create(master, name)
    if over == 'TCPROS':
        speak_tcpros_only(node)
    return node.output_channel(topic, 'std_msgs/Int32')


def turning(taken, what, seconds=0.001):
    """A soul that puts ``what`` at each of its turns."""

    def soul(me):
        for _ in me.every(seconds):
            taken.put(what)

    return soul


# -- blocks


@pytest.mark.parametrize('inline', [False, True])
@pytest.mark.parametrize('over', ['INTRAPROCESS', 'TCPROS'])
def test_a_delegate_takes_effect_with_the_next_message(master, over, inline):
    node = create(master)
    before, after, own = Mailbox(), Mailbox(), Mailbox()
    channel = node.interested_in('/changed', 'std_msgs/Int32', inline=inline)
    numbers = publisher(master, over=over)
    node.delegate = before
    for number in range(20):  # more than what makes a connection's thread run delegates itself
        numbers.send(data=number)
        assert before.next().data == number
    node.delegate = after
    numbers.send(data=1)
    assert after.next().data == 1
    channel.delegate = own
    numbers.send(data=2)
    assert own.next().data == 2
    channel.delegate = None
    numbers.send(data=3)
    assert after.next().data == 3
    node.delegate = None
    numbers.send(data=4)
    until(lambda: channel.received == 24)
    node.delegate = after
    numbers.send(data=5)
    assert after.next().data == 5
    assert before.empty()
    assert own.empty()
    assert not node.errors


def test_a_soul_takes_effect_with_the_next_run(master):
    node = create(master, soul=lambda me: 'first')
    assert node.execute() == 'first'
    node.soul = lambda me: 'second'
    assert node.execute() == 'second'


# -- souls that begin anew


def test_a_soul_that_turns_goes_on_as_the_new_one_at_its_next_turn_if_asked(master):
    node, taken = create(master), queue.SimpleQueue()
    node.soul = turning(taken, 'left')
    thread = node.fork()
    assert taken.get(timeout=TIMEOUT) == 'left'
    node.soul = turning(taken, 'right')
    assert [taken.get(timeout=TIMEOUT) for _ in range(20)] == ['left'] * 20
    node.renew()
    until(lambda: taken.get(timeout=TIMEOUT) == 'right')
    assert [taken.get(timeout=TIMEOUT) for _ in range(20)] == ['right'] * 20
    node.stop()
    assert ended(thread)
    assert not node.errors


def test_a_soul_that_begins_anew_does_what_it_does_at_its_end_before(master):
    node, taken = create(master), queue.SimpleQueue()

    def drive(me):
        threads = [threading.current_thread()]
        for _ in me.every(0.001):
            for _ in me.every(0.001):  # both loops end
                taken.put('drives')
        taken.put('halts')
        taken.put(threads)

    thread = node.fork(drive)
    for _ in range(2):
        assert taken.get(timeout=TIMEOUT) == 'drives'
        node.renew()
        until(lambda: taken.get(timeout=TIMEOUT) == 'halts')
        assert taken.get(timeout=TIMEOUT) == [thread]


def test_each_soul_that_is_forked_begins_anew_with_its_own_block(master):
    node, taken, other = create(master), queue.SimpleQueue(), queue.SimpleQueue()
    begun = threading.Semaphore(0)

    def block(me):
        begun.release()
        turning(other, 'block')(me)

    node.soul = turning(taken, 'before')
    node.fork()
    node.fork(block, name='another')
    assert begun.acquire(timeout=TIMEOUT)
    node.soul = turning(taken, 'after')
    node.renew()
    assert begun.acquire(timeout=TIMEOUT)
    until(lambda: taken.get(timeout=TIMEOUT) == 'after')


def test_who_executes_a_soul_is_not_asked(master):
    node, taken = create(master), queue.SimpleQueue()
    node.soul = turning(taken, 'executed')
    executing = threading.Thread(target=node.execute, daemon=True)
    executing.start()
    node.fork(turning(queue.SimpleQueue(), 'forked'))
    node.soul = lambda me: taken.put('new')
    assert taken.get(timeout=TIMEOUT) == 'executed'
    node.renew()
    assert [taken.get(timeout=TIMEOUT) for _ in range(20)] == ['executed'] * 20
    node.stop()
    assert ended(executing)


def test_a_soul_that_was_taken_away_ends_when_it_is_to_begin_anew(master):
    node = create(master, soul=turning(queue.SimpleQueue(), 'turns'))
    thread = node.fork()
    node.soul = None
    node.renew()
    assert ended(thread)
    with pytest.raises(pharos.PharosError, match='no soul of /node runs.*fork'):
        node.renew()
    assert not node.errors


def test_only_souls_that_run_begin_anew(master, transcript):
    node = create(master, soul=lambda me: 1 / 0)
    assert ended(node.fork())
    with pytest.raises(pharos.PharosError, match='no soul of /node runs.*fork'):
        node.renew()
    node.stop()
    with pytest.raises(pharos.NodeStoppedError):
        node.renew()
