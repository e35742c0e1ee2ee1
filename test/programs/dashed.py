#!/usr/bin/python3
"""A rospy node with names that rospy warns of, and takes."""
import rospy
from std_msgs.msg import String
from std_srvs.srv import Empty

rospy.init_node('my-node')
rospy.set_param('~top-speed', 5)
publisher = rospy.Publisher('/my-topic', String, latch=True, queue_size=1)
publisher.publish('latched')
service = rospy.Service('/my-service', Empty, lambda request: [])
rospy.spin()
