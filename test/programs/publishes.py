"""A plain rospy node that publishes strings: publishes.py TOPIC RATE [SIZE]; it prints when it does."""
import rospy
from std_msgs.msg import String

topic, rate, *size = rospy.myargv()[1:4]
rospy.init_node('publishes', anonymous=True, disable_signals=False)
publisher = rospy.Publisher(topic, String, queue_size=10)
print('publishing', flush=True)
turns = rospy.Rate(float(rate))
while not rospy.is_shutdown():
    publisher.publish('x' * int(size[0] if size else 1))
    try:
        turns.sleep()
    except rospy.ROSInterruptException:
        break
