#!/usr/bin/python3
"""A program with hooks for what nobody catches, and with what is to be done in the end."""
import sys
import tempfile
import threading
import weakref

import rospy

told = []


def tell(kind, error, frames):
    """What Python calls for the main thread."""
    told.append(('main thread', str(error)))


def tell_of_thread(arguments):
    """What it calls for the others."""
    told.append((arguments.thread.name.split()[-1], str(arguments.exc_value)))


def fail():
    """Raise something."""
    raise ValueError('in vain')


rospy.init_node('hooks')
sys.excepthook, threading.excepthook = tell, tell_of_thread
finalizer = weakref.finalize(tell, told.append, 'finalized')
folder = tempfile.TemporaryDirectory()
thread = threading.Thread(target=fail, name='worker')
thread.start()
thread.join()
fail()
