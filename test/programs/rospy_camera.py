#!/usr/bin/python3
"""A rospy node that publishes as many images as it is asked for: ``rospy_camera.py QUEUE_SIZE``."""
import sys
import threading

import rospy
from load import Image, Int32, image


class Viewer(rospy.SubscribeListener):
    """Notes that a subscriber has connected, which itself knows that before its publisher does."""

    def __init__(self):
        super().__init__()
        self.came = threading.Event()

    def peer_subscribe(self, topic_name, topic_publish, peer_publish):
        self.came.set()


def publish(message):
    """Called with the number of images that are wanted."""
    viewer.came.wait()
    for number in range(message.data):
        images.publish(image(number))


rospy.init_node('camera')
viewer = Viewer()
images = rospy.Publisher('/load/images', Image, viewer, queue_size=int(sys.argv[1]))
rospy.Subscriber('/load/more', Int32, publish)
rospy.spin()
