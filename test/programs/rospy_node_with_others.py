"""A rospy node that has two nodes of this package beside it."""
import logging
import sys
import threading

logging.getLogger().addHandler(logging.StreamHandler(sys.stdout))

import rospy  # noqa: E402
import std_msgs.msg  # noqa: E402

import pharos  # noqa: E402

rospy.init_node('host', argv=[])
master = pharos.Master()
a, b = (master.create(pharos.BlockNode, named=name) for name in ('/a', '/b'))
heard = threading.Event()
rospy.Subscriber('/t', std_msgs.msg.String, lambda message: heard.set())
a.send_to('/t', data='hello', typed_as='std_msgs/String')
assert heard.wait(20)
log = rospy.Publisher('/t', std_msgs.msg.String, queue_size=1)
rospy.loginfo('the host speaks')
a.log('node a speaks')
assert rospy.get_name() == '/host'
assert a.ros.get_name() == '/a'
try:
    a.ros.get_param('/none')
except KeyError:
    pass
try:
    a.ros.wait_for_message('/nothing', std_msgs.msg.String, timeout=0.01)
except rospy.ROSException:
    print('caught')
a.stop()
b.stop()
assert not rospy.is_shutdown()
assert a.lifecycle.value == 'stopped'
