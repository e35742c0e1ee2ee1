#!/usr/bin/python3
"""A rospy node that prints the texts that it hears."""
import rospy
from std_msgs.msg import String

rospy.init_node('external')
rospy.Subscriber('/t', String, lambda message: print(message.data, flush=True))
rospy.spin()
