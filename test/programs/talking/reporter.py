#!/usr/bin/python3
"""Publishes, latched, what it was started with, and spins."""
import argparse
import json
import sys

import helpers
import rospy
from std_msgs.msg import String

parser = argparse.ArgumentParser()
parser.add_argument('--mode')
given = parser.parse_args(rospy.myargv()[1:])
rospy.init_node('reporter', log_level=rospy.WARN, disable_rostime=True)
report = {
    'argv': sys.argv,
    'mode': given.mode,
    'name': rospy.get_name(),
    'rate': rospy.get_param('~rate', None),
    'topic': rospy.resolve_name('image'),
    'main': __name__,
    'file': __file__,
    'helper': helpers.NAME,
    'calls': helpers.count(),
}
publisher = rospy.Publisher('report', String, queue_size=1, latch=True)
publisher.publish(json.dumps(report))
rospy.spin()
