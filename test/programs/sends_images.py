"""A plain rospy node that sends so many images of a size, one after the other: sends_images.py TOPIC
SIZE COUNT."""
import sys
import threading

import rospy
from sensor_msgs.msg import Image


class Heard(rospy.SubscribeListener):
    """Notes that a subscriber has connected."""

    def __init__(self):
        super().__init__()
        self.came = threading.Event()

    def peer_subscribe(self, topic_name, topic_publish, peer_publish):
        self.came.set()


topic, size, count = sys.argv[1:4]
rospy.init_node('sends_images')
heard = Heard()
publisher = rospy.Publisher(topic, Image, heard)  # without a queue it waits for who hears it
heard.came.wait()
for _ in range(int(count)):
    publisher.publish(data=bytes(int(size)))
rospy.spin()
