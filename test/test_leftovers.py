"""What a stopped node leaves behind: nothing, however often it was started.

The counting is done in a process of its own, whose threads, descriptors and memory are those of its
nodes alone; the master and the peers are elsewhere.
"""
import errno
import gc
import json
import os
import re
import resource
import subprocess
import sys
import threading
import types
import weakref

import pytest
from std_msgs.msg import String

import load
from helpers import create, ended, in_thread, speak_tcpros_only
from pharos.private_rospy import connections, descriptors, lifetime, registration
from pharos.testing import Mailbox, TIMEOUT, until
import pharos
from pharos import BlockNode
from programs import PROGRAMS, environment


def run(master, program, *arguments):
    """Run a program, and return what it found out."""
    done = subprocess.run(
        [sys.executable, PROGRAMS / program, *arguments],
        env=environment(master.url),
        timeout=120,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope='module')
def rounds(ros_master):
    """What fifty rounds of start and stop of one node on fixed ports left, with peers in this
    process."""
    master, heard = pharos.Master(ros_master.url), Mailbox()
    with master.create(BlockNode, named='/peer', domain='127.0.0.1', delegate=heard) as peer:
        peer.output_channel('/in', 'std_msgs/Int32', latch=True).send(data=7)
        peer.interested_in('/out', 'std_msgs/Int32')
        found = run(master, 'rounds.py', '50')
        assert [message.data for message in heard.take(50)] == list(range(50))
    return found


# the second round, for what is made once per process is there then


def test_fifty_rounds_of_stop_and_start_leave_nothing(rounds):
    """Always on the same ports; rospy's TCPROS port still listens after a shutdown, and cannot be
    bound again."""
    assert rounds['counts'][-1] == rounds['counts'][1]
    assert rounds['counts'][-1]['registrations'] == 0


def test_memory_does_not_grow_from_round_to_round(rounds):
    # MB; a run of a node that stayed would be 0.7 each
    assert rounds['memory'][-1] - rounds['memory'][9] < 8


def test_a_stop_is_quick(rounds):
    assert sorted(rounds['stops'])[25] < 0.1  # s; 6 ms where nothing else goes on


def test_a_node_that_was_stopped_or_has_nothing_to_do_uses_no_cpu(rounds):
    """ros_comm #2238: a closed XML-RPC server spun on its socket, 100 % of a core."""
    stopped, running = rounds['cpu']
    assert stopped < 0.2
    assert running < 0.2


def test_a_hundred_nodes_start_and_stop(master):
    found = run(master, 'hundred_nodes.py')
    assert found['running']['registrations'] >= 100
    assert found['after'] == found['before']
    assert found['started'] < 30 and found['stopped'] < 10  # s; the benchmark looks closer


def test_what_a_stopped_node_held_is_freed(master):
    node = master.create(BlockNode, named='/mortal', domain='127.0.0.1')
    node.interested_in('/a', 'std_msgs/String')
    node.send_to('/a', data='to itself', typed_as='std_msgs/String')
    node.serve('/b', 'std_srvs/Empty', lambda request: None)
    held = [weakref.ref(thing) for thing in (node.latest_run.rospy, node.ros, node.ros.Publisher)]
    node.stop()
    node.start()  # under the same name, another rospy
    gc.collect()
    assert [ref() for ref in held] == [None] * 3
    node.stop()
    last = weakref.ref(node), weakref.ref(node.latest_run.rospy)
    del node
    gc.collect()
    assert [ref() for ref in last] == [None] * 2


def test_closed_channels_hold_no_descriptor(master):
    """rospy's topics have an epoll descriptor each, until the cycle collector comes."""
    with master.create(BlockNode, named='/opens_and_closes', domain='127.0.0.1') as node:
        gc.collect()
        gc.disable()
        try:
            before = len(os.listdir('/proc/self/fd'))
            for _ in range(20):
                node.interested_in('/opened_and_closed', 'std_msgs/String').close()
                node.output_channel('/opened_and_closed', 'std_msgs/String').close()
            assert len(os.listdir('/proc/self/fd')) < before + 20
        finally:
            gc.enable()


def test_a_node_holds_a_descriptor_for_each_port_and_one_for_rosout(monkeypatch):
    """Of three hundred nodes, each more is another three hundred."""
    monkeypatch.setenv('ROS_HOSTNAME', '127.0.0.1')
    with pharos.Master.embedded() as master:
        nodes = [create(master, '/frugal')]
        before = len(os.listdir('/proc/self/fd'))
        nodes += [create(master, f'/frugal{number}') for number in range(10)]
        for node in nodes:
            node.interested_in('/frugal', 'std_msgs/String')
        nodes[0].send_to('/frugal', data='to all')
        # their connections to the master are closed in a while, and its to them
        until(lambda: len(os.listdir('/proc/self/fd')) < before + 4 * 10)


def test_a_node_has_a_thread_for_each_port_and_one_more_at_the_most(master):
    with create(master, '/of_few_threads') as node:  # and no rosout, which has one write to it
        heard = Mailbox()
        node.interested_in('/few', 'std_msgs/String', heard)
        node.send_to('/few', data='to itself')
        heard.next()
        # those that registered and connected it end by themselves
        until(lambda: 2 <= node.health().threads <= 3)


def test_a_node_whose_port_is_known_only_after_its_end_leaves_no_thread(master):
    node = create(master, '/ends_at_once')
    node.stop()
    node.latest_run.rospy.connections.announce()
    until(lambda: not any(thread.name == 'departures' for thread in threading.enumerate()))


def test_a_subscriber_that_left_is_noticed_without_a_message_to_it(master):
    with create(master, '/left_alone') as node:
        channel = node.output_channel('/left', 'std_msgs/String')
        client = load.subscribe(node, '/left', String)
        until(lambda: channel.connections)
        impl = node.latest_run.rospy.publisher('/left')
        client.close()
        until(lambda: not impl.connections)


def test_a_thread_that_waits_for_clients_holds_no_number_of_a_descriptor(monkeypatch):
    """Linux's accept takes one before it waits: of a thousand, those are soon all."""
    monkeypatch.setenv('ROS_HOSTNAME', '127.0.0.1')
    with pharos.Master.embedded() as master:
        before = held_numbers()
        for number in range(10):
            create(master, f'/waiting{number}')
        until(lambda: held_numbers() <= before + 5)


def held_numbers():
    """How many numbers below the lowest free one have no descriptor."""
    with open(os.devnull) as lowest:
        listed = {int(number) for number in os.listdir('/proc/self/fd')}
        return len(set(range(lowest.fileno())) - listed)


def test_a_node_for_which_there_are_no_descriptors_says_so(master, monkeypatch):
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    create(master, '/one')
    used = len(os.listdir('/proc/self/fd'))
    # many more than others of this process may take, or give back, meanwhile
    monkeypatch.setattr(descriptors, 'STARTING', 500)
    resource.setrlimit(resource.RLIMIT_NOFILE, (used + 250, before[1]))
    try:
        with pytest.raises(pharos.PharosError, match='/one_more cannot start: .* ulimit -n'):
            create(master, '/one_more')
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    monkeypatch.undo()
    assert create(master, '/one_more').is_running


def test_a_channel_for_which_there_are_no_descriptors_says_so(master, monkeypatch, mailbox):
    """It would count as open, and hear nobody."""
    sender, receiver = create(master, '/sender'), create(master, '/receiver', delegate=mailbox)
    refuse_descriptors(monkeypatch)
    with pytest.raises(pharos.PharosError, match='/receiver cannot connect to /lacking: .* -n'):
        receiver.interested_in('/lacking', 'std_msgs/String')
    assert not receiver.channels
    monkeypatch.undo()
    receiver.interested_in('/lacking', 'std_msgs/String')
    sender.send_to('/lacking', data='heard')
    assert mailbox.next().data == 'heard'


def test_a_publisher_that_comes_when_there_are_no_descriptors_is_told_once_and_heard_later(
    master, monkeypatch, mailbox
):
    sender, receiver = create(master, '/sender'), create(master, '/receiver', delegate=mailbox)
    speak_tcpros_only(receiver)
    receiver.interested_in('/lacking', 'std_msgs/String')
    told = Mailbox()
    monkeypatch.setattr(receiver.latest_run.rospy, 'warn', lambda line: told(line, None))
    monkeypatch.setattr(registration, 'RETRY_DELAY', 0.01)
    monkeypatch.setattr(
        connections.Connections, '_neighbours', lambda self: []
    )  # all are elsewhere
    refused = refuse_descriptors(monkeypatch)
    opening = in_thread(sender.output_channel, '/lacking', 'std_msgs/String')
    assert all(refused.acquire(timeout=TIMEOUT) for _ in range(3))
    monkeypatch.undo()
    assert ended(opening)
    assert re.match('/receiver cannot connect to /lacking: .* ulimit -n', told.next())
    assert told.empty()
    sender.send_to('/lacking', data='heard')
    assert mailbox.next().data == 'heard'


def test_a_stop_lists_threads_while_others_begin():
    """The iteration of a WeakSet raises where something is added to it."""

    class Kept:
        """What a WeakSet can hold."""

    class Growing(weakref.WeakSet):
        """One that another thread adds to as it is iterated for the first time."""

        def __iter__(self):
            for each in super().__iter__():
                if len(kept) < 3:
                    kept.append(Kept())
                    self.add(kept[-1])
                yield each

    kept = [Kept(), Kept()]
    assert set(lifetime.listed(Growing(kept))) == set(kept)
    assert len(kept) == 3


def test_two_nodes_that_have_no_descriptors_to_connect_say_so(master, monkeypatch):
    sender, receiver = create(master, '/sender'), create(master, '/receiver')
    receiver.interested_in('/lacking', 'std_msgs/String')
    refuse_descriptors(monkeypatch)
    with pytest.raises(pharos.PharosError, match='/receiver cannot connect to /lacking: .* -n'):
        sender.output_channel('/lacking', 'std_msgs/String')
    monkeypatch.undo()
    channel = sender.output_channel('/lacking', 'std_msgs/String')
    assert channel.wait_for_subscribers(timeout=TIMEOUT)


def refuse_descriptors(monkeypatch):
    """Have the process seem to have none for connections between nodes; returns a semaphore, which
    is released for each that is refused."""
    refused = threading.Semaphore(0)

    def refuse(*arguments):
        refused.release()
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(descriptors, 'os', types.SimpleNamespace(**{**vars(os), 'open': refuse}))
    monkeypatch.setattr(connections, 'ServerProxy', refuse)
    return refused


def test_a_node_for_which_there_is_no_thread_says_so_and_leaves_nothing(master):
    found = run(master, 'limited.py')
    assert re.match(
        r"no thread for /limited/n\d+: can't start new thread, beside \d+ .* ulimit -v \(",
        found['said'],
    )
    assert found['goes on'] and not found['is left']


@pytest.mark.parametrize('is_sender_first', [True, False])
def test_two_nodes_that_get_no_thread_to_connect_say_so(master, monkeypatch, is_sender_first):
    sender, receiver = create(master, '/sender'), create(master, '/receiver')
    first, second = sender.output_channel, receiver.interested_in
    if not is_sender_first:
        first, second = second, first
    topic = '/threadless', 'std_msgs/String'
    first(*topic)
    start = threading.Thread.start

    def start_others(thread):
        if re.search('^/sender| connecting$| check$', thread.name):
            raise RuntimeError("can't start new thread")
        start(thread)

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, 'start', start_others)
        with pytest.raises(pharos.PharosError, match='no thread for /receiver to connect to'):
            second(*topic)
    assert second(*topic).connections


def test_questions_to_the_master_and_to_nodes_hold_no_descriptor(master):
    with master.create(BlockNode, named='/questioner', domain='127.0.0.1') as node:
        gc.collect()
        gc.disable()
        try:
            before = len(os.listdir('/proc/self/fd'))
            for _ in range(20):
                master.nodes(), master.parameters.get('/none'), node.health()
            assert len(os.listdir('/proc/self/fd')) < before + 20
        finally:
            gc.enable()


@pytest.mark.parametrize('library', ['actionlib', 'tf2_ros', 'message_filters'])
def test_a_library_of_a_stopped_node_is_freed(master, library):
    held = []
    for name in '/mortal', '/survivor':
        node = master.create(BlockNode, named=name, domain='127.0.0.1')
        held += weakref.ref(node.ros_import(library)), weakref.ref(node.latest_run.rospy)
        node.stop()
        del node
    gc.collect()
    # not the last one: actionlib hangs a function of its own on the class GoalStatus, which all
    # nodes share
    assert [ref() for ref in held[:2]] == [None] * 2


@pytest.mark.parametrize('broken', ['tcp_port', 'xmlrpc_port', 'named'])
def test_a_node_that_could_not_start_is_freed(master, broken):
    class Mortal(BlockNode):
        def __init__(self):
            made.append(weakref.ref(self))

    made = []
    other = master.create(BlockNode, named='/taken', domain='127.0.0.1')
    taken = {'tcp_port': other.tcp_port, 'xmlrpc_port': other.xmlrpc_port, 'named': other.name}
    with pytest.raises(pharos.PharosError):
        master.create(Mortal, domain='127.0.0.1', **{'named': '/mortal', broken: taken[broken]})
    gc.collect()
    assert [ref() for ref in made] == [None]
