#!/usr/bin/python3
"""Ends as it is told to: ``worker.py HOW``."""
import sys
import time

import rospy


def divide():
    """Fail."""
    return 1 / 0


if __name__ == '__main__':
    how = rospy.myargv()[1]
    if 'nameless' not in how:
        rospy.init_node('worker')
    rospy.sleep(0)
    ends = {
        'return': lambda: None,
        'exit': sys.exit,
        'exit 3': lambda: sys.exit(3),
        'exit text': lambda: sys.exit('cannot go on'),
        'raise': divide,
        'nameless': lambda: None,
        'nameless raise': divide,
        'nameless exit 4': lambda: sys.exit(4),
        'nameless sleep': lambda: time.sleep(1000),
        'again': lambda: rospy.init_node('worker'),
        'other name': lambda: rospy.init_node('somebody_else'),
        'signal_shutdown': lambda: [rospy.signal_shutdown('enough'), rospy.spin()],
        'sleep': lambda: time.sleep(1000),
        'spin': rospy.spin,
    }
    ends[how]()
