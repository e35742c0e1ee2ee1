"""A rospy node with a publisher or subscriber of a type of that definition: KIND NAME TOPIC TYPE
TEXT."""
import sys

import rospy

from pharos import messages

kind, name, topic, type_, text = sys.argv[1:]
cls = messages.class_from_definition(type_, text)
rospy.init_node(name)
if kind == 'publisher':
    end = rospy.Publisher(topic, cls, latch=True, queue_size=1)
    end.publish(cls(data=cls().data))
else:
    end = rospy.Subscriber(topic, cls, lambda message: None)
print('ready', flush=True)
rospy.spin()
