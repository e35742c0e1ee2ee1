"""Nodes: real ROS nodes, many in one process."""
import subprocess
import sys
import threading
import xmlrpc.client

import pytest
import rosnode

from helpers import create
from pharos.testing import Mailbox, TIMEOUT, until
import pharos
from pharos import Node, node_registry
from pharos.run import Lifecycle


def registered(master):
    """The node names that the master knows."""
    return {name for kind in master.system_state() for names in kind.values() for name in names}


def run(*command):
    return subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=60
    ).stdout


def test_ten_nodes_of_one_process_are_ten_ros_nodes(master):
    """rospy refuses a second init_node (ros_comm #185, #214)."""
    names = ['/ten/n%d' % i for i in range(10)]
    nodes = [create(master, name) for name in names]
    assert set(names) <= set(run('rosnode', 'list').split())
    assert 'xmlrpc reply' in run('rosnode', 'ping', '-c', '1', names[3])
    assert '/rosout' in run('rosnode', 'info', names[7])
    nodes[4].stop()
    assert registered(master) & set(names) == set(names) - {names[4]}
    assert len({node.tcp_port for node in nodes} | {node.xmlrpc_port for node in nodes}) == 20


def test_a_message_goes_from_node_to_node(master, mailbox):
    receiver = create(master, '/receiver', delegate=mailbox)
    receiver.interested_in('/chat', 'std_msgs/String')
    create(master, '/sender').send_to('/chat', data='hello')
    message, channel = mailbox.next_with_channel()
    assert message.data == 'hello'
    assert (channel.topic, channel.type, channel.node) == ('/chat', 'std_msgs/String', receiver)


def test_a_ready_message_is_sent_as_rospy_publishes_it(master, mailbox):
    node, cls = create(master), pharos.message_class('std_msgs/String')
    ready = cls('first')
    assert node.send_to('/ready', ready) is ready  # whose type the topic then has
    assert master.topic('/ready').type == 'std_msgs/String'
    create(master, '/other', delegate=mailbox).interested_in('/ready')
    for send in node.output_channel('/ready').send, lambda data: node.send_to('/ready', data):
        assert send(ready) is ready
        assert mailbox.next().data == 'first'
    create(master, '/third').send_to('/ready', cls('known'))
    assert mailbox.next().data == 'known'


def test_the_first_message_to_an_external_node_is_not_lost(master):
    """In one call, its type found. rospy has no such call (ros_comm #1377), and loses 3 of 3 (#176,
    #286)."""
    with subprocess.Popen(
        [sys.executable, '-c', RECEIVE_ONE, '/first'], stdout=subprocess.PIPE, text=True
    ) as echo:
        wait_for_subscriber(master, '/first')
        create(master, '/sender').send_to('/first', data='not lost')
        assert 'not lost' in echo.communicate(timeout=60)[0]


RECEIVE_ONE = """
import sys, rospy, std_msgs.msg
rospy.init_node('external_receiver')
print(rospy.wait_for_message(sys.argv[1], std_msgs.msg.String).data)
"""


def wait_for_subscriber(master, topic):
    ready = threading.Event()
    while not master.topic(topic).subscribers:
        ready.wait(0.01)  # another process: the master is all there is to ask


def test_rostopic_publishes_to_a_node(master, mailbox):
    node = create(master, '/listener', delegate=mailbox)
    node.interested_in('/from_outside', 'std_msgs/Int32')
    run('rostopic', 'pub', '-1', '/from_outside', 'std_msgs/Int32', '42')
    assert mailbox.next().data == 42


def test_a_roscpp_relay_passes_messages_between_two_nodes(master, mailbox):
    receiver = create(master, '/receiver', delegate=mailbox)
    receiver.interested_in('/relayed', 'std_msgs/String')
    with master.run('topic_tools', 'relay', '/direct', '/relayed'):
        sender = create(master, '/sender')
        wait_for_subscriber(master, '/direct')
        # relay advertises only once it has received something, so its own first messages are lost
        sender.fork(
            lambda me: [
                me.send_to('/direct', data='through C++', typed_as='std_msgs/String')
                for _ in me.every(0.02)
            ]
        )
        assert mailbox.next().data == 'through C++'


def test_a_node_starts_again_under_the_same_name_and_ports(master, mailbox):
    """rospy's stays shut down, and its TCPROS port taken (ros_comm #185, #214)."""
    node = create(master, '/phoenix', delegate=mailbox)
    node.interested_in('/ashes', 'std_msgs/String')
    ports = node.tcp_port, node.xmlrpc_port
    sender = create(master, '/sender')
    for turn in range(3):
        node.stop()
        assert node.lifecycle is Lifecycle.STOPPED
        assert '/phoenix' not in registered(master)
        node.start()
        assert node.lifecycle is Lifecycle.RUNNING
        assert (node.tcp_port, node.xmlrpc_port) == ports
        sender.stop()
        sender.start()  # its channels come back as well, and wait for who is interested
        sender.send_to('/ashes', data=str(turn), typed_as='std_msgs/String')
        assert mailbox.next().data == str(turn)


def test_a_node_that_waits_for_no_subscriber_waits_for_the_master(master, mailbox):
    node = create(master, '/node')
    create(master, '/receiver').interested_in('/t', 'std_msgs/Int32', delegate=mailbox)
    node.connect_timeout = 0
    node.send_to('/t', data=1)
    node.restart()
    node.send_to('/t', to='/receiver', data=2)
    until(lambda: node.channels[0].connections)
    node.send_to('/t', to='/receiver', data=3)
    while mailbox.next().data != 3:
        pass


def test_a_subclass_makes_its_channels_in_start(master, mailbox):
    class Logger(Node):
        def start(self):
            super().start()
            self.delegate = mailbox
            self.interested_in('/log_me', typed_as='std_msgs/String')

    logger = master.create(Logger, named='/logger')
    logger.stop()
    logger.start()
    assert len(logger.channels) == 1
    create(master, '/sender').send_to('/log_me', data='once')
    assert mailbox.next().data == 'once'
    assert mailbox.empty()


def test_further_keywords_go_to_the_nodes_init(master):
    class Driver(Node):
        def __init__(self, speed, turn=0.5):
            super().__init__()
            self.speed, self.turn = speed, turn

    driver = master.create(Driver, named='/driver', speed=3)
    assert (driver.speed, driver.turn, driver.name) == (3, 0.5, '/driver')


def test_stop_twice_is_harmless_and_start_twice_is_not(master):
    node = create(master, '/twice')
    with pytest.raises(pharos.PharosError, match='running already: stop'):
        node.start()
    node.stop()
    node.stop()
    with pytest.raises(pharos.NodeStoppedError, match='/twice is stopped: start'):
        node.send_to('/x', data='', typed_as='std_msgs/String')


def test_the_end_of_a_with_block_stops_the_node(master):
    with create(master, '/within') as node:
        assert node.is_running
    assert not node.is_running


def test_who_asks_a_node_to_stop_finds_it_gone(master):
    """As with rospy: rosnode asks the next thing at once."""
    for number in range(5):
        victim = create(master, '/victim')
        victim.interested_in('/nodes/victim', 'std_msgs/Empty')
        victim.fork(lambda me: me.sleep(60))
        with xmlrpc.client.ServerProxy(victim.uri) as proxy:
            assert proxy.shutdown('/test', 'enough') == [1, 'shutdown', 0]
        assert not rosnode.rosnode_ping('/victim', max_count=1)
        assert not any(
            '/victim' in users for kind in master.system_state() for users in kind.values()
        )
        victim.stop()  # waits for the rest


def test_rosnode_kill_stops_that_node_and_no_other(master):
    victim, other = create(master, '/victim'), create(master, '/other')
    stopped = threading.Event()
    victim.fork(lambda me: [None for _ in me.every(0.01)] and stopped.set())
    run('rosnode', 'kill', '/victim')
    assert stopped.wait(TIMEOUT)
    with node_registry.changed:
        assert node_registry.changed.wait_for(
            lambda: victim.lifecycle is Lifecycle.STOPPED, TIMEOUT
        )
    assert other.is_running
    assert '/victim' not in registered(master)
    assert '/other' in registered(master)


def test_a_shutdown_meant_for_an_earlier_owner_of_the_uri_does_not_reach_a_node(master):
    """The master tells the old URI of a name to shut down, and a rospy node there by now does so
    (ros_comm #2241)."""
    node = create(master, '/heir')
    code, reason, _ = pharos.private_rospy.proxies.ServerProxy(node.uri).shutdown(
        '/master', '[/old] Reason: new node registered with same name'
    )
    assert node.is_running
    assert 'still this node' in reason


def test_a_node_stops_from_its_own_delegate(master):
    done = threading.Event()

    def stop(message, channel):
        channel.node.stop()
        done.set()

    node = create(master, '/suicide', delegate=stop)
    node.interested_in('/poison', 'std_msgs/Empty')
    create(master, '/sender').send_to('/poison')
    assert done.wait(TIMEOUT)
    assert node.lifecycle is Lifecycle.STOPPED


def test_what_was_sent_before_the_stop_arrives(master, mailbox):
    create(master, '/receiver', delegate=mailbox).interested_in('/late', 'std_msgs/String')
    with create(master, '/sender') as sender:
        for number in range(200):
            sender.send_to('/late', data=str(number) + 'x' * 20000, typed_as='std_msgs/String')
    assert [message.data.rstrip('x') for message in mailbox.take(200)] == [
        str(number) for number in range(200)
    ]


def test_a_soul_says_farewell(master, mailbox):
    """A robot is to be halted when its driver stops."""
    create(master, '/wheels', delegate=mailbox).interested_in('/speed', 'std_msgs/Float32')

    def drive(me):
        try:
            while True:
                me.send_to('/speed', data=1.0)
                me.sleep(3600)
        finally:
            me.send_to('/speed', data=0.0)

    driver = create(master, '/driver', soul=drive)
    driver.fork()
    assert mailbox.next().data == 1.0
    driver.stop()
    assert mailbox.next().data == 0.0
    assert not driver.errors


def test_a_soul_that_ignores_the_stop_is_named_and_left_behind(master, capfd):
    release = threading.Event()
    node = create(master, '/stubborn')
    node.stop_timeout = 0.1
    node.fork(lambda me: release.wait(), name='deaf')
    node.stop()
    release.set()
    assert 'left behind' in capfd.readouterr().err


def test_an_exception_in_a_delegate_ends_only_that_run(master, transcript, mailbox):
    """rospy logs it, and nothing in the program is told."""

    def delegate(message, channel):
        if message.data == 'bad':
            raise ValueError('this one is bad')
        mailbox(message, channel)

    node = create(master, '/careful', delegate=delegate)
    node.interested_in('/mixed', 'std_msgs/String')
    sender = create(master, '/sender')
    sender.send_to('/mixed', data='bad')
    sender.send_to('/mixed', data='good')
    assert mailbox.next().data == 'good'
    assert [str(error) for error in node.errors] == ['this one is bad']
    assert '/careful' in transcript[0]
    assert '/mixed' in transcript[0]
    assert 'ValueError: this one is bad' in transcript[0]


def test_execute_runs_the_soul_here_and_returns_its_value(master):
    node = create(master, '/soul', soul=lambda me: (me.name, threading.current_thread()))
    assert node.execute() == ('/soul', threading.current_thread())
    node.soul = lambda me: 1 / 0
    assert node.execute() is None
    assert isinstance(node.errors[-1], ZeroDivisionError)
    node.soul = None
    with pytest.raises(pharos.PharosError, match='no soul'):
        node.execute()


def test_every_turns_until_the_node_stops(master):
    node = create(master, '/metronome')
    turns = []
    for _ in node.every(0.001):
        turns.append(1)
        if len(turns) == 20:
            node.stop()
    assert len(turns) == 20


def test_sleep_ends_when_the_node_stops(master):
    node = create(master, '/sleeper')
    slept = threading.Event()
    threading.Thread(target=lambda: (node.sleep(3600), slept.set()), daemon=True).start()
    node.stop()
    assert slept.wait(TIMEOUT)


def test_every_and_sleep_follow_simulated_time(master):
    master.api().setParam('/use_sim_time', True)
    try:
        clock = create(master, '/clock_server').output_channel('/clock', 'rosgraph_msgs/Clock')
        node, turns = create(master, '/simulated'), Mailbox()
        until(lambda: '/simulated' in dict(clock.connections))
        clock.send(clock={'secs': 100})
        until(lambda: node.ros.Time.now().secs == 100)

        def soul(me):
            for turn in me.every(10):
                turns((turn, me.ros.Time.now().secs), None)

        node.fork(soul)
        # a turn that comes late does not delay those after it
        for turn, seconds in enumerate((100, 110, 125, 130, 140)):
            clock.send(clock={'secs': seconds})
            assert turns.next() == (turn, seconds)
        node.stop()  # time stands still, the soul ends all the same
    finally:
        master.api().deleteParam('/use_sim_time')


def test_loops_sleeps_and_timers_go_on_after_a_jump_back_in_time(master):
    master.api().setParam('/use_sim_time', True)
    try:
        clock = create(master, '/clock_server').output_channel('/clock', 'rosgraph_msgs/Clock')
        node = create(master, '/simulated')
        loop, sleeper, timer = Mailbox(), Mailbox(), Mailbox()
        until(lambda: '/simulated' in dict(clock.connections))
        clock.send(clock={'secs': 100})
        until(lambda: node.ros.Time.now().secs == 100)

        def turn(me):
            for _ in me.every(10):
                loop(me.ros.Time.now().secs, None)

        def sleep(me):
            while True:
                sleeper(me.ros.Time.now().secs, None)
                me.sleep(10)

        node.fork(turn)
        node.fork(sleep)
        node.ros.Timer(
            node.ros.Duration(10), lambda event: timer(event.current_real.secs, None), reset=True
        )
        assert (loop.next(), sleeper.next()) == (100, 100)
        waiting = node.ros.rostime.get_rostime_cond()._waiters
        for seconds in (110, 120, 50, 60, 70):  # as rosbag play does it when it begins anew
            until(lambda: len(waiting) == 3)
            clock.send(clock={'secs': seconds})
            assert (loop.next(), sleeper.next(), timer.next()) == (seconds, seconds, seconds)
        assert not node.errors
    finally:
        master.api().deleteParam('/use_sim_time')


def test_delegates_of_a_node_run_one_at_a_time(master, mailbox):
    """rospy's callbacks run in as many threads as there are connections (ros_comm #1377)."""
    busy = threading.Lock()
    overlaps = []

    def delegate(message, channel):
        if not busy.acquire(blocking=False):
            overlaps.append(message)
        else:
            busy.release()
        mailbox(message, channel)

    node = create(master, '/single', delegate=delegate)
    senders = [create(master, '/sender%d' % i) for i in range(4)]
    for i in range(4):
        node.interested_in('/lane%d' % i, 'std_msgs/Int32')
    for number in range(50):
        for i, sender in enumerate(senders):
            sender.send_to('/lane%d' % i, data=number)
    received = [mailbox.next_with_channel() for _ in range(200)]
    assert not overlaps
    for i in range(4):
        assert [m.data for m, channel in received if channel.topic == '/lane%d' % i] == list(
            range(50)
        )
