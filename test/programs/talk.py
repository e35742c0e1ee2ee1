#!/usr/bin/python3
"""A rospy node that publishes what its parameter says, once."""
import rospy
import std_msgs.msg

rospy.init_node('talker')
sent = rospy.Publisher('talk', std_msgs.msg.String, queue_size=1, latch=True)
sent.publish(rospy.get_param('~text', 'nothing'))
print('%s talks' % rospy.get_name())
rospy.spin()
