"""A process forked off one with nodes has none of them, however it ends: they, and what they hold,
are its parent's."""
import os
import sys
import threading
import warnings

import pytest

from helpers import create, ended, in_thread
import pharos
from pharos import BlockNode, memory, node_registry
from pharos.private_rospy import arguments, changes, parameters
from pharos.testing import TIMEOUT
from programs import Program

CODE = '''
import multiprocessing, os, signal, sys, threading, warnings
import pharos
from pharos import BlockNode, Master

# Python 3.12 and later say in the middle of what is printed that they do not like what is tried
# here.
warnings.filterwarnings('ignore', '.* is multi-threaded, use of fork', DeprecationWarning)
heard, embedded = threading.Event(), Master.embedded()

def tell(message, channel):
    print('heard', message.data, flush=True)
    heard.set()

me = Master().create(BlockNode, named='/program', domain='127.0.0.1', delegate=tell)
other = embedded.create(BlockNode, named='/other')
channel = me.interested_in('/forks', 'std_msgs/String')
back = me.output_channel('/forks_back', 'std_msgs/String')
me.output_channel('/forks_said', 'std_msgs/String', latch=True).send(data='said by the parent')
started = embedded.run('topic_tools', 'relay', '/a', '/b', name='relay')
embedded.wait_for_node('/relay', 60)
parameter = me.parameter('~rate', 1)
service = me.serve('~serve', 'std_srvs/Empty', lambda request: None)

def child():
    {child}

heard.wait()
{fork}
print('still', me.lifecycle.value, other.health().registered, started.poll(),
      embedded.is_reachable(), flush=True)
back.send(data='back')

def tell_of_the_wait():
    while not pharos.signals._waits:
        threading.Event().wait(0.001)
    print('waiting', flush=True)

threading.Thread(target=tell_of_the_wait, daemon=True).start()
pharos.spin()
'''

FORK = '''
pid = os.fork()
if not pid:
    child()
    sys.exit()
os.waitpid(pid, 0)
'''

CHILDREN = {
    'sys.exit': 'sys.exit(3)',
    'an exception': '1 / 0',
    'os._exit': 'os._exit(3)',
    'SIGTERM': 'os.kill(os.getpid(), signal.SIGTERM)',
    'SIGINT': 'os.kill(os.getpid(), signal.SIGINT)',
    'stop()': 'me.stop(); pharos.node_registry.stop_all()',
    'with': '''
    with embedded, other, me, started:
        sys.exit()''',
    'Master.stop()': 'embedded.stop()',
    'terminate()': 'started.terminate()',
    'close()': 'channel.close(); back.close(); service.close()',
    'spin()': 'pharos.spin()',
    'nodes of its own': '''
    mine = Master().create(BlockNode, named='/program_child', domain='127.0.0.1')
    got = threading.Event()
    mine.interested_in('/forks_said', 'std_msgs/String', delegate=lambda message, channel: got.set())
    mine.send_to('/forks_back', data='from the child')
    assert got.wait(60)
    assert mine.master.nodes() and mine.health().registered
    def live(me):
        for _ in me.every(3600):
            lives.set()
        me.send_to('/forks_back', data='good-bye')
    lives = threading.Event()
    mine.fork(live)
    assert lives.wait(60)''',
}


@pytest.mark.parametrize(
    'fork',
    [FORK, 'c = multiprocessing.get_context("fork").Process(target=child)\nc.start()\nc.join()'],
    ids=['os.fork', 'multiprocessing'],
)
@pytest.mark.parametrize('child', CHILDREN.values(), ids=CHILDREN)
def test_the_end_of_a_child_leaves_its_parents_nodes_alone(master, mailbox, child, fork):
    node = master.create(BlockNode, named='/tester', domain='127.0.0.1', delegate=mailbox)
    node.interested_in('/forks_back', 'std_msgs/String')
    with Program(master.url, sys.executable, '-c', CODE.format(child=child, fork=fork)) as program:
        out = node.output_channel('/forks', 'std_msgs/String')
        assert out.wait_for_subscribers(timeout=60)
        out.send(data='first')
        program.wait_for('heard first')
        assert program.wait_for('still') == 'still running True None True\n'
        if 'from the child' in child:
            assert mailbox.next().data == 'from the child'
            assert mailbox.next().data == 'good-bye'
            assert '/program_child' not in [node.name for node in master.nodes()]
        assert mailbox.next().data == 'back'
        program.wait_for('waiting')  # before that, Ctrl-C ends it with another status
        out.send(data='second')
        program.wait_for('heard second')
        assert program.end() == 0


@pytest.mark.parametrize(
    'use',
    [
        'me.send_to("/forks_back", data="x")',
        'back.send(data="x")',
        'me.sleep(1)',
        'me.ros',
        'me.execute()',
        'me.interested_in("/c", "std_msgs/String")',
    ],
)
def test_a_node_of_the_parent_is_stopped_in_the_child(master, use):
    child = f"""
    try:
        {use}
    except pharos.NodeStoppedError as error:
        print('refused', error, repr(me), flush=True)"""
    with Program(master.url, sys.executable, '-c', CODE.format(child=child, fork=FORK)) as program:
        node = master.create(BlockNode, named='/tester', domain='127.0.0.1')
        node.output_channel('/forks', 'std_msgs/String', latch=True).send(data='go')
        assert '/program' in program.wait_for('refused')
        program.wait_for('still running')


def test_a_process_forked_while_another_thread_creates_a_node_does_not_fail_in_that(
    master, monkeypatch
):
    claims, goes_on, really = threading.Event(), threading.Event(), node_registry._claim_name

    def claim_name(*arguments):
        really(*arguments)
        claims.set()
        goes_on.wait(TIMEOUT)

    monkeypatch.setattr(node_registry, '_claim_name', claim_name)
    # what a handler of forks raises, Python tells there
    monkeypatch.setattr(sys, 'unraisablehook', lambda _: os._exit(3))
    creating = in_thread(lambda: create(master, '/claiming'))
    assert claims.wait(TIMEOUT)
    with warnings.catch_warnings():  # Python 3.12 and later do not like what is tried here
        warnings.simplefilter('ignore', DeprecationWarning)
        child = os.fork()
    if not child:
        try:
            os._exit(len(node_registry.nodes()))
        finally:
            os._exit(2)
    status = os.waitpid(child, 0)[1]
    goes_on.set()
    assert ended(creating)
    assert status == 0


@pytest.mark.parametrize(
    'held',
    [
        'changes._changed',
        'Transcript._lock',
        'memory._lock',
        'arguments._lock',
        'parameters._adding',
    ],
)
def test_a_process_forked_while_another_thread_holds_a_lock_does_not_hang(master, held):
    create(master, '/node').output_channel('/forked', 'std_msgs/String')
    owner, _, name = held.partition('.')
    owners = {
        'changes': changes,
        'Transcript': pharos.Transcript,
        'memory': memory,
        'arguments': arguments,
        'parameters': parameters,
    }
    lock, has_it, goes_on = getattr(owners[owner], name), threading.Event(), threading.Event()

    def hold():
        with lock:
            has_it.set()
            goes_on.wait(TIMEOUT)

    holding = in_thread(hold)
    assert has_it.wait(TIMEOUT)
    with warnings.catch_warnings():  # Python 3.12 and later do not like what is tried here
        warnings.simplefilter('ignore', DeprecationWarning)
        child = os.fork()
    if not child:
        try:
            is_free = getattr(owners[owner], name).acquire(timeout=1)
            os._exit(0 if is_free else 1)
        finally:
            os._exit(2)
    os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
    goes_on.set()
    assert ended(holding)
    assert os.waitpid(child, 0)[1] == 0
