"""A rospy node of that name for ROS's tools to look at."""
import sys

import rospy
from std_msgs.msg import String
from std_srvs.srv import Empty

rospy.init_node(sys.argv[1].strip('/'))
rospy.Subscriber('/t0', String, lambda message: None)
publisher = rospy.Publisher('/from_peer', String, queue_size=1)
rospy.Service('~service', Empty, lambda request: {})
print('ready')
rospy.spin()
