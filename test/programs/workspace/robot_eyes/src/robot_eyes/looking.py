# flake8: noqa
"""Code that uses the messages of its own package."""
import sys, rospy

import robot_eyes
from robot_eyes.msg import *
from robot_eyes.srv import Find, FindResponse


def look(colour):
    """A message, noted by the package."""
    robot_eyes.SEEN.append((rospy.get_name(), sys.argv[0]))
    return Look(colour=colour)
