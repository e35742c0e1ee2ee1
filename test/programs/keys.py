#!/usr/bin/python3
"""Drives by keys, as turtle_teleop_key and teleop_twist_keyboard do: each is published as it is hit; q
ends it. It prints as Python does that is not told to do otherwise."""
import os
import sys
import termios
import tty

import rospy
from std_msgs.msg import String

rospy.init_node('keys')
pressed = rospy.Publisher('pressed', String, queue_size=10)
while not pressed.get_num_connections():
    rospy.rostime.wallsleep(0.01)
before = termios.tcgetattr(sys.stdin)
try:
    tty.setraw(sys.stdin.fileno())
    os.write(1, b'what is your ')  # no line yet
    print('key?')
    while True:
        key = sys.stdin.read(1)
        if key in ('q', ''):
            break
        print('pressed', repr(key))
        pressed.publish(key)
finally:
    termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
print('done')
sys.exit(3)
