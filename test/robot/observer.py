"""Print what a rospy node of another process finds out about the robot of robot.launch."""
import json
import threading
import time

import actionlib
import rospy
from actionlib.msg import TestAction, TestGoal
from geometry_msgs.msg import Twist
from rosgraph_msgs.msg import Log
from sensor_msgs.msg import Range
from std_msgs.msg import Int32, String
from std_srvs.srv import SetBool, Trigger

LIMIT = 20
logs = {}
rospy.Subscriber('/rosout', Log, lambda log: logs.setdefault(log.msg, log))


def wait(topic):
    return rospy.wait_for_message(topic, String, LIMIT).data


def take(topic, type_):
    messages, full = [], threading.Event()

    def keep(message):
        messages.append(message)
        if len(messages) >= 4:
            full.set()

    rospy.Subscriber(topic, type_, keep)
    assert full.wait(LIMIT), topic
    return messages[:4]


def call(name, type_, *args):
    rospy.wait_for_service(name, LIMIT)
    return rospy.ServiceProxy(name, type_)(*args)


def act(goal, is_cancelled=False):
    client = actionlib.SimpleActionClient('/rover/go', TestAction)
    assert client.wait_for_server(rospy.Duration(LIMIT))
    moving = threading.Event()
    client.send_goal(TestGoal(goal), feedback_cb=lambda feedback: moving.set())
    assert moving.wait(LIMIT)
    if is_cancelled:
        client.cancel_goal()
    assert client.wait_for_result(rospy.Duration(LIMIT))
    # of a goal that is cancelled, rospy's client may lose the last state
    return is_cancelled or (client.get_state(), client.get_result().result)


def logged(text):
    deadline = time.monotonic() + LIMIT
    while text not in logs and time.monotonic() < deadline:
        rospy.sleep(0.01)
    return logs[text].name, logs[text].level, logs[text].function


def observe():
    beats = [message.data for message in take('/rover/beat', Int32)]
    return {
        'started_as': json.loads(wait('/rover/settings/found')),
        'ranges': {(m.range, m.header.frame_id) for m in take('/rover/sonar/front', Range)},
        'commands': {(m.linear.x, m.angular.z) for m in take('/cmd_vel', Twist)},
        'beats': [beat - beats[0] for beat in beats],
        'latched_by_timer': wait('/rover/born'),
        'service': str(call('/rover/grip', SetBool, True)),
        'private_service': call('/rover/gripper/count', Trigger).message,
        'action': act(3),
        'preempted_action': act(-1, True),
        'state': next(state for state in iter(lambda: wait('/rover/state'), '') if state != 'move'),
        'parameters': rospy.get_param('/rover'),
        'log': logged('bumper is ready'),
        'warning': logged('hears the sonar'),
        'topics': sorted(t for t in rospy.get_published_topics('/rover') if '/go/' not in t[0]),
    }
