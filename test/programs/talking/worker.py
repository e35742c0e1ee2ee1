#!/usr/bin/python3
"""Ends as it is told to: ``worker.py HOW [FILE]``."""
import os
import sys
import threading
import time

import rospy
from std_msgs.msg import String

RUNS = []  # of this program, in the module that this is


def divide():
    """Fail."""
    return 1 / 0


def loop():
    """Sleep again and again."""
    while True:
        time.sleep(0.01)


def be_interrupted(file):
    """Loop until Ctrl-C."""
    try:
        loop()
    except KeyboardInterrupt:
        say(file, 'interrupted')


def ignore(file):
    """Go on until there is the file."""
    while not os.path.exists(file):
        threading.Event().wait(0.01)


def say(file, text):
    """Add a line to the file."""
    with open(file, 'a') as lines:
        print(text, file=lines)


def speak_last(file):
    """Do some things after the stop has begun."""
    rospy.spin()
    time.sleep(0.05)
    rospy.sleep(0.05)
    say(file, 'put away')


def wait_in_thread(file):
    """Leave work to a thread."""

    def work():
        time.sleep(0.05)
        say(file, 'done')

    threading.Thread(target=work).start()


def hook(file):
    """Say something in a hook of on_shutdown."""

    def shut_down():
        begun = time.monotonic()
        rospy.sleep(0.1)
        publisher.publish('stopping')
        is_slept = time.monotonic() - begun >= 0.1
        say(file, f'slept {is_slept}, is_shutdown {rospy.is_shutdown()}')

    rospy.on_shutdown(shut_down)
    publisher = rospy.Publisher('last_words', String, queue_size=1)
    rospy.spin()


def speak():
    """Print lines, whole and in parts, and log one."""
    rospy.on_shutdown(lambda: print('dead'))
    print('two\nlines')
    print('one', end='')
    print(' more', flush=True)
    print('aside', file=sys.stderr)
    rospy.loginfo('logged')
    print('no end', end='')


if __name__ == '__main__':
    RUNS.append(1)
    how, *more = rospy.myargv()[1:]
    if how == 'own argv':
        rospy.init_node('worker', argv=['__name:=called_by_itself', 'image:=/camera'])
    elif 'nameless' not in how:
        rospy.init_node('worker', disable_signals='interrupted' in how)
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
        'nameless late': lambda file: [ignore(file), rospy.init_node('worker')],
        'nameless sleep': lambda: time.sleep(1000),
        'again': lambda: rospy.init_node('worker'),
        'other name': lambda: rospy.init_node('somebody_else'),
        'signal_shutdown': lambda: [rospy.signal_shutdown('enough'), rospy.spin()],
        'sleep': lambda: time.sleep(1000),
        'spin': rospy.spin,
        'loop': loop,
        'own argv': rospy.spin,
        'speak': speak,
        'ignore': ignore,
        'interrupted': be_interrupted,
        'nameless interrupted': be_interrupted,
        'interrupted loop': loop,
        'last words': speak_last,
        'thread': wait_in_thread,
        'hook': hook,
        'runs': lambda file: [say(file, len(RUNS)), rospy.spin()],
        'nameless runs': lambda file: [say(file, len(RUNS)), time.sleep(1000)],
    }
    ends[how](*more)
