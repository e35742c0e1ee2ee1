#!/usr/bin/python3
"""Greets, ten times a second, until its node stops."""
import rospy
from std_msgs.msg import String

if __name__ == '__main__':
    publisher = rospy.Publisher('chatter', String, queue_size=10)
    rospy.init_node('talker', anonymous=True)
    rate = rospy.Rate(10)
    try:
        while not rospy.is_shutdown():
            publisher.publish(f'hello from {rospy.get_name()}')
            rate.sleep()
    except rospy.ROSInterruptException:
        pass
