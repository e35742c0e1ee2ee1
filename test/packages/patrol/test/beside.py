#!/usr/bin/python3
"""A test that is a rospy node, with nodes of pharos beside itself; run by rostest."""
import queue
import unittest

import pharos
import rospy
import rostest
import std_msgs.msg
from patrol.walker import Walker

LIMIT = 30  # seconds; a bound on waits for events


class Beside(unittest.TestCase):
    """What the launch file has started, and what is made here."""

    def test_the_launched_walker_is_heard_by_the_test_and_by_a_node_beside_it(self) -> None:
        here, beside = queue.Queue(), queue.Queue()
        subscriber = rospy.Subscriber('/yard/whereabouts', std_msgs.msg.Float64, here.put)
        with pharos.Master().create(pharos.BlockNode, named='ear') as ear:
            ear.interested_in('/yard/whereabouts', delegate=lambda message, channel: beside.put(1))
            here.get(timeout=LIMIT)
            beside.get(timeout=LIMIT)
        subscriber.unregister()

    def test_a_walker_made_here_is_driven_by_the_test(self) -> None:
        positions = queue.Queue()
        rospy.Subscriber('position', std_msgs.msg.Float64, positions.put)
        goal = rospy.Publisher('goal', std_msgs.msg.Float64, latch=True, queue_size=1)
        with pharos.Master().create(Walker, named='walker_here'):
            goal.publish(0.5)
            while positions.get(timeout=LIMIT).data != 0.5:
                pass
        self.assertFalse(rospy.is_shutdown())


if __name__ == '__main__':
    rospy.init_node('beside')
    rostest.rosrun('patrol', 'beside', Beside)
