"""A rospy node of that name that hears /to_peers, and sends its name on /from_peers when ~clear is
called."""
import sys

import rospy
import std_msgs.msg
import std_srvs.srv


def hear(message):
    print(rospy.get_name(), 'heard', message.data, flush=True)


rospy.init_node(sys.argv[1])
rospy.Subscriber('/to_peers', std_msgs.msg.String, hear)
sent = rospy.Publisher('/from_peers', std_msgs.msg.String, queue_size=10)
rospy.Service('~clear', std_srvs.srv.Empty, lambda request: sent.publish(rospy.get_name()) or {})
print(rospy.get_name(), 'is ready', flush=True)
rospy.spin()
