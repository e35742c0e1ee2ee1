"""Callbacks of one node begin in the order in which their messages came, whatever their kind.

In virtual time a test has ten seeds, and nothing is wrong. Virtual time does not see how threads wake:
a test in real time counts what is wrong in many rounds. A round sends in one go, and waits until all is
heard.
"""
import functools
import sqlite3
import threading
import time

import pytest
import std_msgs.msg

from helpers import TIMEOUT, Gate, PharosPeer, create
from pharos import BlockNode, message_class, testing
from pharos.intraprocess.callback_queues import TURN_LIMIT
from pharos.testing import Mailbox, until

INT, STRING = 'std_msgs/Int32', 'std_msgs/String'
ROUNDS = 250
TOLERATED = ROUNDS // 200  # beside load on all cores; on a quiet machine nothing is wrong
SEEDS = range(10)
JITTER = 1e-3  # seconds; a longer one makes a quick callback a slow one
TOPICS = '/a', '/b', '/c', '/d'
Int32 = message_class(INT)
create_node, simulation = testing.create_node, testing.simulation


@pytest.fixture
def node(master):
    return create(master)


class Ear:
    """Hears integers on some topics in one node, by plain rospy or by delegates."""

    def __init__(self, master, topics, kinds):
        self.node = create(master, '/ear')
        self.heard = []
        for topic, kind in zip(topics, kinds):
            hear = functools.partial(self._hear, topic)
            if kind == 'rospy':
                self.node.ros.Subscriber(topic, Int32, hear, queue_size=10)
            elif kind == 'socket':
                self.node.ros.Subscriber(topic, Int32, hear)
            else:
                self.node.interested_in(topic, INT, hear)

    def _hear(self, topic, message):
        self.heard.append((message.data, topic))

    def count_wrong(self, send, topics, rounds=ROUNDS):
        """Send ``send(topic, number)`` for all topics in each round; count the disordered rounds."""
        wrong = 0
        for number in range(rounds):
            self.heard.clear()
            for topic in topics:
                send(topic, number)
            until(lambda: len(self.heard) == len(topics))
            wrong += self.heard != [(number, topic) for topic in topics]
        return wrong


def publishers_of(node, topics=TOPICS):
    """Plain publishers of a node, each with its subscriber."""
    publishers = {topic: node.ros.Publisher(topic, Int32, queue_size=10) for topic in topics}
    for publisher in publishers.values():
        until(publisher.get_num_connections)
    time.sleep(0.06)  # callbacks of plain rospy begin after a pause
    return publishers


def test_publishers_keep_their_order(master):
    ear = Ear(master, TOPICS, ['rospy'] * 4)
    mouths = {topic: create(master, f'/mouth{topic}') for topic in TOPICS}
    publishers = {topic: publishers_of(node, [topic])[topic] for topic, node in mouths.items()}
    assert ear.count_wrong(lambda topic, n: publishers[topic].publish(n), TOPICS) <= TOLERATED


KINDS = ['rospy'] * 4, ['delegate'] * 4, ['rospy', 'delegate'] * 2, ['socket'] * 4


@pytest.mark.parametrize('publisher_count', [1, 4])
@pytest.mark.parametrize('kinds', KINDS)
def test_topics_keep_their_order(master, simulation, create_node, kinds, publisher_count):
    ear = Ear(master, TOPICS, kinds)
    mouths = [create_node(BlockNode, f'mouth{number}') for number in range(publisher_count)]
    publishers = {
        topic: mouths[number % publisher_count].ros.Publisher(topic, Int32, queue_size=10)
        for number, topic in enumerate(TOPICS)
    }
    simulation.run(1)  # callbacks of plain rospy begin after a pause
    for seed in SEEDS:
        simulation.seed(seed, JITTER)
        assert not ear.count_wrong(lambda topic, n: publishers[topic].publish(n), TOPICS, 25), seed
    ear.node.stop()


def test_quick_callback_is_waited_for(simulation, create_node):
    """By those on later messages, if it takes less than SLOW."""
    node, mouth, order = create_node(BlockNode, 'node'), create_node(BlockNode, 'mouth'), []

    def first(message):
        time.sleep(0.002)
        order.append('first')

    node.ros.Subscriber('/first', Int32, first, queue_size=9)
    node.ros.Subscriber('/second', Int32, lambda message: order.append('second'), queue_size=9)
    publishers = [mouth.ros.Publisher(t, Int32, queue_size=10) for t in ('/first', '/second')]
    simulation.run(1)
    for seed in SEEDS:
        simulation.seed(seed, JITTER)
        for publisher in publishers:
            publisher.publish(1)
        simulation.run(1)
    assert order == ['first', 'second'] * len(SEEDS)


def test_slow_callback_delays_others_once(simulation, create_node):
    """The next callback on a later message waits for it no more, until it is quick again."""
    node, mouth, delays = create_node(BlockNode, 'node'), create_node(BlockNode, 'mouth'), []
    node.ros.Subscriber('/slow', Int32, lambda message: time.sleep(0.04), queue_size=9)
    quick = lambda message: delays.append(simulation.now - start)  # noqa: E731
    node.ros.Subscriber('/quick', Int32, quick, queue_size=9)
    publishers = [mouth.ros.Publisher(t, Int32, queue_size=10) for t in ('/slow', '/quick')]
    simulation.run(1)
    for _ in range(3):
        start = simulation.now
        for publisher in publishers:
            publisher.publish(1)
        simulation.run(1)
    assert 0.003 < delays[0] < 0.01 and max(delays[1:]) < 0.003


def test_full_queue_keeps_the_order(master):
    """The message that replaces a dropped one takes its own place, not the dropped one's."""
    node = create(master, '/ear')
    heard = []
    gate = threading.Event()
    node.ros.Subscriber('/gate', Int32, lambda message: gate.wait(), queue_size=1)
    node.interested_in('/new', INT, lambda message: heard.append(message.data), queue_size=1)
    node.interested_in('/all', INT, lambda message: heard.append(message.data))
    first = node.interested_in('/first', INT, lambda message: gate.wait())
    mouth = create(master, '/mouth')
    mouth.send_to('/first', typed_as=INT, data=0)
    until(lambda: first.received)
    for topic, number in [('/new', 1), ('/all', 2), ('/new', 3), ('/all', 4)]:
        mouth.send_to(topic, typed_as=INT, data=number)
    gate.set()
    until(lambda: len(heard) == 3)
    assert heard == [2, 3, 4]


def test_transform_is_there_for_its_scan(master):
    mapper, base = create(master, '/mapper'), create(master, '/base')
    listener = mapper.ros_import('tf2_ros')
    buffer = listener.Buffer()
    listener.TransformListener(buffer)
    results = []

    def take_scan(scan):
        results.append(buffer.can_transform('map', 'base', scan.header.stamp))

    mapper.ros.Subscriber('/scan', message_class('sensor_msgs/LaserScan'), take_scan, queue_size=1)
    broadcasters = base.ros_import('tf2_ros')
    transform_class = message_class('geometry_msgs/TransformStamped')
    static = transform_class()
    static.header.frame_id, static.child_frame_id = 'map', 'odom'
    static.transform.rotation.w = 1
    broadcasters.StaticTransformBroadcaster().sendTransform(static)
    moving_broadcaster = broadcasters.TransformBroadcaster()
    scans = base.ros.Publisher('/scan', message_class('sensor_msgs/LaserScan'), queue_size=10)
    until(scans.get_num_connections)
    until(lambda: 'odom' in buffer.all_frames_as_string())
    for number in range(ROUNDS):
        moving = transform_class()
        moving.header.stamp = base.ros.Time.from_sec(1000 + number)
        moving.header.frame_id, moving.child_frame_id = 'odom', 'base'
        moving.transform.rotation.w = 1
        moving_broadcaster.sendTransform(moving)
        scan = message_class('sensor_msgs/LaserScan')()
        scan.header.stamp = moving.header.stamp
        scan.ranges = [1.0] * 360
        scans.publish(scan)
        until(lambda: len(results) > number)
    assert results.count(False) <= TOLERATED


def test_synchronizer_is_done_before_next_topic(master):
    ear, mouth = create(master, '/ear'), create(master, '/mouth')
    filters = ear.ros_import('message_filters')
    point = message_class('geometry_msgs/PointStamped')
    heard = []
    subscribers = [filters.Subscriber(topic, point, queue_size=10) for topic in ('/left', '/right')]
    synchronizer = filters.TimeSynchronizer(subscribers, 10)
    synchronizer.registerCallback(lambda left, right: heard.append('both'))
    ear.ros.Subscriber('/next', Int32, lambda message: heard.append('next'), queue_size=10)
    topics = {
        topic: mouth.ros.Publisher(topic, type_, queue_size=10)
        for topic, type_ in [('/left', point), ('/right', point), ('/next', Int32)]
    }
    for publisher in topics.values():
        until(publisher.get_num_connections)
    time.sleep(0.06)
    wrong = 0
    for number in range(ROUNDS):
        heard.clear()
        message = point()
        message.header.stamp = mouth.ros.Time(number + 1)
        topics['/left'].publish(message)
        topics['/right'].publish(message)
        topics['/next'].publish(number)
        until(lambda: len(heard) == 2)
        wrong += heard != ['both', 'next']
    assert wrong <= TOLERATED


def test_feedback_comes_before_result(simulation, create_node):
    """Also if they come before send_goal() has stored the goal: they wait, and are not dropped."""
    server_node, client_node = create_node(BlockNode, 'server'), create_node(BlockNode, 'client')
    actionlib = server_node.ros_import('actionlib')
    actions = __import__('actionlib.msg').msg

    def run(goal):
        server.publish_feedback(actions.TestFeedback(goal.goal + 1))
        server.set_succeeded(actions.TestResult(goal.goal * 2))

    server = actionlib.SimpleActionServer('/act', actions.TestAction, run, auto_start=False)
    server.start()
    client = client_node.ros_import('actionlib').SimpleActionClient('/act', actions.TestAction)
    assert client.wait_for_server(client_node.ros.Duration(10))
    manager = client.action_client.manager
    send = manager.send_goal_fn
    manager.send_goal_fn = lambda goal: (send(goal), time.sleep(0.02))
    simulation.run(1)
    for seed in SEEDS:
        simulation.seed(seed, JITTER)
        for number in range(10):
            feedback = []

            def hear(message, heard=feedback):
                heard.append(message.feedback)
                time.sleep(0.01)  # goes on as the next goal is sent

            begin = time.monotonic()
            client.send_goal(actions.TestGoal(number), feedback_cb=hear)
            assert client.wait_for_result(client_node.ros.Duration(10))
            assert client.get_result().result == 2 * number
            assert time.monotonic() - begin < TURN_LIMIT  # they wait for send_goal() alone
            assert feedback == [number + 1]


def test_constructor_may_take_its_time_between_two_subscriptions(simulation, create_node):
    """The first callback waits for a pause after the last one."""
    ear, mouth = create_node(BlockNode, 'ear'), create_node(BlockNode, 'mouth')
    mouth.output_channel('/a', INT, latch=True).send(data=1)
    times = []
    begin = simulation.now
    ear.ros.Subscriber('/a', Int32, lambda message: times.append(simulation.now))
    simulation.run(0.03)
    ear.ros.Subscriber('/b', Int32, print)
    simulation.run(1)
    assert times == [pytest.approx(begin + 0.08, abs=0.01)]


def test_waiting_callback_lets_others_run(master):
    """A callback may wait for one of another topic; it holds up that topic for a few ms alone."""
    node, mouth = create(master, '/ear'), create(master, '/mouth')
    answers = []
    answered = threading.Event()
    node.ros.Subscriber('/ask', Int32, lambda message: answers.append(answered.wait(30)))
    node.ros.Subscriber('/answer', Int32, lambda message: answered.set())
    mouth.send_to('/ask', typed_as=INT, data=1)
    mouth.send_to('/answer', typed_as=INT, data=1)
    until(lambda: answers == [True])


def test_callbacks_of_each_kind_have_one_thread(master):
    node, mouth = create(master, '/ear'), create(master, '/mouth')
    rows = Mailbox()
    connections = threading.local()

    def count(message, channel=None):
        if not hasattr(connections, 'sqlite'):
            connections.sqlite = sqlite3.connect(':memory:')
            connections.sqlite.execute('create table numbers (number)')
        connections.sqlite.execute('insert into numbers values (?)', [message.data])
        rows(connections.sqlite.execute('select count(*) from numbers').fetchone()[0])

    node.ros.Subscriber('/plain', Int32, count, queue_size=10)
    node.interested_in('/one', INT, count)
    node.interested_in('/two', INT, count)
    for topic, counts in [('/plain', [1, 2, 3]), ('/one', [1, 2, 3]), ('/two', [4, 5, 6])]:
        for expected_count in counts:
            mouth.send_to(topic, typed_as=INT, data=0)
            assert rows.next() == expected_count
    names = {thread.name for thread in threading.enumerate()}
    assert '/ear (loop)' in names


def test_external_topics_keep_their_order(master):
    """A node in another process sends by shared memory; one thread reads in the order of sending."""
    ear = Ear(master, TOPICS, ['rospy'] * 4)
    with PharosPeer(master.url, 'mouth') as peer:
        peer.run(
            f"publishers = {{t: rospy.Publisher(t, message_class('{INT}'), queue_size=10) for t in {TOPICS}}}"
        )
        until(lambda: peer.value('all(p.get_num_connections() for p in publishers.values())'))
        peer.run(
            'def send(number):\n    for publisher in publishers.values(): publisher.publish(number)'
        )
        wrong = 0
        for number in range(ROUNDS):
            ear.heard.clear()
            peer.run(f'send({number})')
            until(lambda: len(ear.heard) == 4)
            wrong += ear.heard != [(number, topic) for topic in TOPICS]
    assert wrong <= TOLERATED


def burst(publisher, count):
    for number in range(count):
        publisher.publish(number)


def test_full_queue_of_two_publishers_goes_on(master):
    """Bursts of two publishers into a queue of one message: the last message always comes."""
    heard = Mailbox()
    create(master, '/ear').ros.Subscriber('/t', Int32, heard, queue_size=1)
    publishers = [publishers_of(create(master, f'/mouth{n}'), ['/t'])['/t'] for n in range(2)]
    for number in range(1000, 1100):
        threads = [threading.Thread(target=burst, args=[each, 200]) for each in publishers]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        publishers[0].publish(number)
        heard.wait_for(lambda message, number=number: message.data == number)


def test_full_queue_goes_on_in_virtual_time(simulation, create_node):
    heard = Mailbox()
    create_node(BlockNode, 'ear').ros.Subscriber('/t', Int32, heard, queue_size=1)
    nodes = [create_node(BlockNode, f'mouth{number}') for number in range(2)]
    publishers = [node.ros.Publisher('/t', Int32, queue_size=10) for node in nodes]
    simulation.run(1)
    for seed in SEEDS:
        simulation.seed(seed, JITTER)
        threads = [threading.Thread(target=burst, args=[each, 20]) for each in publishers]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        publishers[0].publish(1000 + seed)
        heard.wait_for(lambda message, number=1000 + seed: message.data == number)


def test_stop_ends_all_threads_of_busy_node(master):
    """A node with four busy topics stops at once: a thread that waits for its turn ends, too."""
    mouth = create(master, '/mouth')
    publishers = [mouth.ros.Publisher(topic, Int32, queue_size=10) for topic in TOPICS]
    is_over = threading.Event()

    def publish():
        while not is_over.is_set():
            for publisher in publishers:
                publisher.publish(1)
            time.sleep(0)

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        for _ in range(10):
            ear = Ear(master, TOPICS, ['rospy'] * 4)
            until(lambda ear=ear: len(ear.heard) > 100)
            ear.node.stop()
            names = [each.name for each in threading.enumerate()]
            assert not [name for name in names if name.startswith('/ear')]
    finally:
        is_over.set()
        thread.join()


def test_closed_subscription_delays_no_callback(master, monkeypatch):
    """A message for a closed subscription waits for ever: no callback waits for that one."""
    monkeypatch.setattr('pharos.intraprocess.callback_queues.TURN_LIMIT', TIMEOUT)
    node, mouth = create(master, '/ear'), create(master, '/mouth')
    gate, box = Gate(), Mailbox()
    old = node.ros.Subscriber('/old', Int32, gate)
    node.ros.Subscriber('/new', Int32, box)
    for number in range(3):
        mouth.send_to('/old', typed_as=INT, data=number)
    assert gate.begun.wait(TIMEOUT)
    old.unregister()
    gate.open.set()
    mouth.send_to('/new', typed_as=INT, data=7)
    assert box.next(TIMEOUT / 3).data == 7


def waits_for_turn(queue):
    return queue.running_thread and not queue.begin_time


def test_callback_waits_for_one_on_an_earlier_message(master, node, monkeypatch):
    for limit in 'SLOW', 'TURN_LIMIT':  # both are too short for a test
        monkeypatch.setattr(f'pharos.intraprocess.callback_queues.{limit}', TIMEOUT)
    order, gate, mouth = [], Gate(), create(master, '/mouth')
    callbacks = {
        '/first': lambda message: [gate(message), order.append('first')],
        '/second': lambda message: order.append('second'),
    }
    for topic, callback in callbacks.items():
        node.ros.Subscriber(topic, std_msgs.msg.String, callback)
        mouth.send_to(topic, typed_as=STRING, data='x')
    queues = node._current_run.callback_queue.order.queues
    until(lambda: order or gate.heard and any(map(waits_for_turn, list(queues))))
    gate.open.set()
    until(lambda: len(order) == 2)
    assert order == ['first', 'second']
