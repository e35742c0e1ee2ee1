"""Libraries written on rospy, and rospy itself, as each node's own: between two nodes of one
process."""
import threading

import actionlib.msg
import actionlib_msgs.msg
import geometry_msgs.msg
import pytest
import std_msgs.msg
import std_srvs.srv

from pharos.testing import Mailbox, TIMEOUT, until
import pharos
from pharos import BlockNode, node_registry
from pharos.private_rospy.process_rospy import rospy

LIBRARIES = 'message_filters', 'actionlib', 'tf2_ros'


@pytest.fixture
def pair(master):
    """Two nodes: one that sends or asks, one that receives or serves."""
    return [
        master.create(BlockNode, named=name, domain='127.0.0.1') for name in ('/asking', '/serving')
    ]


def kept_in(mailbox):
    """A callback of rospy's kind that keeps what it gets."""
    return lambda *messages: mailbox(messages if len(messages) > 1 else messages[0], None)


@pytest.mark.parametrize('library', LIBRARIES)
def test_a_library_is_bound_to_the_node_that_imports_it(pair, library):
    asking, serving = (node.ros_import(library) for node in pair)
    assert asking is not serving
    assert asking is pair[0].ros_import(library)
    assert asking is not __import__(library)
    assert [node.ros.get_name() for node in pair] == ['/asking', '/serving']


def test_a_submodule_is_found_too(pair):
    assert pair[0].ros_import('tf2_ros.buffer').Buffer is pair[0].ros_import('tf2_ros').Buffer


def test_a_library_that_is_not_there(pair):
    with pytest.raises(ModuleNotFoundError, match='no_such_library'):
        pair[0].ros_import('no_such_library')


def test_a_stopped_node_imports_nothing(pair):
    pair[0].stop()
    with pytest.raises(pharos.NodeStoppedError, match='/asking is stopped: start'):
        pair[0].ros_import('tf2_ros')
    with pytest.raises(pharos.NodeStoppedError, match='/asking is stopped: start'):
        pair[0].ros


# -- message_filters


def header(seconds, frame_id=''):
    return std_msgs.msg.Header(stamp=rospy.Time(seconds), frame_id=frame_id)


def test_message_filters_bring_messages_of_the_same_time_together(pair):
    asking, serving = pair
    filters, matched = serving.ros_import('message_filters'), Mailbox()
    sides = [
        filters.Subscriber(topic, geometry_msgs.msg.PointStamped) for topic in ('/left', '/right')
    ]
    filters.TimeSynchronizer(sides, 10).registerCallback(kept_in(matched))
    for seconds in (1, 2):
        asking.send_to(
            '/left', typed_as='geometry_msgs/PointStamped', header=header(seconds, 'left')
        )
    asking.send_to('/right', typed_as='geometry_msgs/PointStamped', header=header(2, 'right'))
    left, right = matched.next()
    assert (left.header.frame_id, right.header.frame_id) == ('left', 'right')
    assert left.header.stamp == right.header.stamp == rospy.Time(2)


def test_message_filters_cache_keeps_what_a_node_published(pair):
    asking, serving = pair
    filters, arrived = serving.ros_import('message_filters'), Mailbox()
    subscriber = filters.Subscriber('/cached', geometry_msgs.msg.PointStamped)
    cache = filters.Cache(subscriber, 2)
    subscriber.registerCallback(kept_in(arrived))
    for seconds in (1, 2, 3):
        asking.send_to('/cached', typed_as='geometry_msgs/PointStamped', header=header(seconds))
    arrived.take(3)
    assert (cache.getOldestTime(), cache.getLastestTime()) == (rospy.Time(2), rospy.Time(3))


# -- actionlib


def action(pair, execute):
    """A running action server of the second node, and a client of the first that is connected to
    it."""
    asking, serving = pair
    server = serving.ros_import('actionlib').SimpleActionServer(
        '/count', actionlib.msg.TestAction, lambda goal: execute(server, goal), auto_start=False
    )
    server.start()
    client = asking.ros_import('actionlib').SimpleActionClient('/count', actionlib.msg.TestAction)
    assert client.wait_for_server(asking.ros.Duration(TIMEOUT))
    # a subscriber is connected a moment before its publisher knows; what is published in between
    # goes to nobody
    until(lambda: server.action_server.feedback_pub.get_num_connections() == 1)
    return client


def test_an_action_runs_with_feedback_to_its_result(pair):
    feedback, heard = [], threading.Semaphore(0)

    def execute(server, goal):
        for number in range(goal.goal):
            server.publish_feedback(actionlib.msg.TestFeedback(feedback=number))
            # the result may overtake it, and actionlib then drops it
            assert heard.acquire(timeout=TIMEOUT)
        server.set_succeeded(actionlib.msg.TestResult(result=goal.goal), 'counted')

    client = action(pair, execute)
    client.send_goal(
        actionlib.msg.TestGoal(goal=3),
        feedback_cb=lambda message: (feedback.append(message.feedback), heard.release()),
    )
    assert client.wait_for_result(pair[0].ros.Duration(TIMEOUT))
    assert client.get_state() == actionlib_msgs.msg.GoalStatus.SUCCEEDED
    assert (client.get_result().result, client.get_goal_status_text()) == (3, 'counted')
    assert feedback == [0, 1, 2]


def test_an_action_is_cancelled(pair):
    started, cancelled = threading.Event(), threading.Event()

    def execute(server, goal):
        server.register_preempt_callback(cancelled.set)
        started.set()
        assert cancelled.wait(TIMEOUT)
        server.set_preempted()

    client = action(pair, execute)
    client.send_goal(actionlib.msg.TestGoal(goal=1))
    assert started.wait(TIMEOUT)
    client.cancel_goal()
    assert client.wait_for_result(pair[0].ros.Duration(TIMEOUT))
    assert client.get_state() == actionlib_msgs.msg.GoalStatus.PREEMPTED


def test_an_answer_that_comes_before_the_goal_is_sent_is_not_lost(pair):
    """The client did not know its goal yet, and waited for ever."""
    client = action(pair, lambda server, goal: server.set_succeeded())
    manager, over = client.action_client.manager, Mailbox()
    send = manager.send_goal_fn

    def send_and_be_answered(goal):
        send(goal)
        until(lambda: manager.statuses[-1]().state)  # it has been accepted

    manager.register_send_goal_fn(send_and_be_answered)
    client.send_goal(actionlib.msg.TestGoal(goal=1), done_cb=lambda state, _: over(state, None))
    assert over.next() == actionlib_msgs.msg.GoalStatus.SUCCEEDED
    assert client.wait_for_result(pair[0].ros.Duration(TIMEOUT))


# -- tf2


def transform(parent, child, x, seconds=1):
    message = geometry_msgs.msg.TransformStamped(
        header=header(seconds, parent), child_frame_id=child
    )
    message.transform.translation.x, message.transform.rotation.w = x, 1.0
    return message


def test_a_transform_is_looked_up_in_another_node(pair):
    asking, serving = pair
    tf2_sending, tf2 = asking.ros_import('tf2_ros'), serving.ros_import('tf2_ros')
    buffer = tf2.Buffer()
    tf2.TransformListener(buffer, tcp_nodelay=True)
    tf2_sending.StaticTransformBroadcaster().sendTransform(transform('map', 'odom', 1.0))
    broadcaster = tf2_sending.TransformBroadcaster()
    # moving frames are told of again and again, for what was sent before the listener connected is
    # lost
    asking.fork(
        lambda me: [
            broadcaster.sendTransform(transform('odom', 'base', 2.0, seconds))
            for seconds, _ in enumerate(me.every(0.01), 1)
        ]
    )
    found = buffer.lookup_transform(
        'map', 'base', serving.ros.Time(0), serving.ros.Duration(TIMEOUT)
    )
    assert (found.header.frame_id, found.child_frame_id) == ('map', 'base')
    assert found.transform.translation.x == 3.0


def test_a_missing_transform_raises_the_librarys_own_error(pair):
    tf2 = pair[0].ros_import('tf2_ros')
    with pytest.raises(tf2.LookupException):
        tf2.Buffer().lookup_transform('map', 'nowhere', pair[0].ros.Time(0))


# -- rospy itself


def test_a_publisher_and_a_subscriber_of_two_rospys(pair, mailbox):
    asking, serving = pair
    serving.ros.Subscriber('/plain', std_msgs.msg.String, kept_in(mailbox))
    asking.ros.Publisher('/plain', std_msgs.msg.String, latch=True, queue_size=1).publish('hello')
    message = mailbox.next()
    assert (message.data, message._connection_header['callerid']) == ('hello', '/asking')


def test_a_plain_subscriber_hears_a_channel_and_a_channel_a_plain_publisher(pair, mailbox):
    asking, serving = pair
    serving.ros.Subscriber('/there', std_msgs.msg.String, kept_in(mailbox))
    asking.send_to('/there', data='to rospy', typed_as='std_msgs/String')
    assert mailbox.next().data == 'to rospy'
    serving.interested_in('/back', 'std_msgs/String', delegate=mailbox)
    asking.ros.Publisher('/back', std_msgs.msg.String, latch=True, queue_size=1).publish(
        'to pharos'
    )
    assert mailbox.next().data == 'to pharos'


def test_a_service_proxy_calls_another_node(pair):
    asking, serving = pair
    serving.ros.Service('/enable', std_srvs.srv.SetBool, lambda request: (request.data, 'thanks'))
    asking.ros.wait_for_service('/enable', TIMEOUT)
    answer = asking.ros.ServiceProxy('/enable', std_srvs.srv.SetBool)(True)
    assert (answer.success, answer.message) == (True, 'thanks')


def test_a_failed_service_call_is_caught_as_rospys_own_error(pair):
    asking, serving = pair
    serving.serve('/fail', 'std_srvs/Empty', lambda request: 1 / 0)
    proxy = asking.ros.ServiceProxy('/fail', std_srvs.srv.Empty)
    with pytest.raises(rospy.ServiceException, match='division by zero'):
        proxy()
    assert asking.ros.ServiceException is serving.ros.ServiceException is rospy.ServiceException
    assert asking.ros.ROSException is rospy.ROSException


def test_wait_for_message(pair):
    asking, serving = pair
    asking.output_channel('/latched', 'std_msgs/Int32', latch=True).send(data=5)
    assert serving.ros.wait_for_message('/latched', std_msgs.msg.Int32, TIMEOUT).data == 5


def test_a_timer_fires_until_its_node_stops(pair, mailbox):
    asking, serving = pair
    timer = asking.ros.Timer(asking.ros.Duration(0.005), kept_in(mailbox))
    first, second = mailbox.take(2)
    assert second.last_real == first.current_real < second.current_real
    asking.stop()
    assert not timer.is_alive()
    assert serving.is_running


def test_a_rate_ends_with_its_node(pair):
    asking, _ = pair
    ros, turned = asking.ros, Mailbox()  # node.ros is for a node that runs
    rate = ros.Rate(1e-3)

    def turn():
        while not ros.is_shutdown():
            turned('turn', None)
            rate.sleep()
        turned('end', None)

    threading.Thread(target=turn, daemon=True).start()
    assert turned.next() == 'turn'
    asking.stop()
    assert turned.next() == 'end'


def test_a_rate_keeps_its_period(pair):
    rate, time = pair[0].ros.Rate(200), pair[0].ros.Time
    begin = time.now()
    for _ in range(10):
        rate.sleep()
    assert (time.now() - begin).to_sec() >= 0.045


def test_what_is_private_to_a_node_stays_so(pair):
    """Parameters and names are resolved for each node on its own."""
    asking, serving = pair
    asking.ros.set_param('~mine', 1)
    try:
        assert asking.ros.get_param('/asking/mine') == 1
        assert not serving.ros.has_param('~mine')
        assert [node.ros.resolve_name('~x') for node in pair] == ['/asking/x', '/serving/x']
    finally:
        asking.ros.delete_param('~mine')


def test_signal_shutdown_stops_that_node(pair):
    asking, serving = pair
    asking.ros.signal_shutdown('enough')
    with node_registry.changed:
        assert node_registry.changed.wait_for(lambda: asking.lifecycle.value == 'stopped', TIMEOUT)
    assert serving.is_running
    assert not serving.ros.is_shutdown()


def test_a_shutdown_hook_runs_at_the_stop(pair):
    ran = []
    pair[0].ros.on_shutdown(lambda: ran.append('hook'))
    pair[0].stop()
    assert ran == ['hook']
