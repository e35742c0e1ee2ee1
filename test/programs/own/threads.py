#!/usr/bin/python3
"""A program whose threads go on when its main thread has ended."""
import atexit
import threading

import rospy

go_on, ended = threading.Event(), []


def work():
    """What a thread does that is waited for."""
    go_on.wait()
    ended.append('thread')


atexit.register(ended.append, 'atexit')
threading.Thread(target=work).start()
threading.Thread(target=rospy.spin, daemon=True).start()
