#!/usr/bin/python3
"""A rospy node that publishes a hundred texts once somebody hears them."""
import threading

import rospy
from std_msgs.msg import String


class Heard(rospy.SubscribeListener):
    """Notes that a subscriber has connected."""

    def __init__(self):
        super().__init__()
        self.came = threading.Event()

    def peer_subscribe(self, topic_name, topic_publish, peer_publish):
        self.came.set()


rospy.init_node('external')
heard = Heard()
publisher = rospy.Publisher('/t', String, heard, queue_size=100)
heard.came.wait()
for number in range(100):
    publisher.publish(f'external {number}')
rospy.spin()
