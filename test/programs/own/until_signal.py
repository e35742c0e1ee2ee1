#!/usr/bin/python3
"""A program that goes on until a signal, and does its last things then."""
import atexit
import signal
import time

import rospy

running = True


def on_signal(number, frame):
    """What Ctrl-C calls."""
    global running
    running = False


@atexit.register
def last():
    """What Python calls last."""
    print('the last')


rospy.init_node('until_signal')
signal.signal(signal.SIGINT, on_signal)
rospy.set_param('~is_ready', True)
while running:
    time.sleep(0.05)
raise SystemExit(5)
