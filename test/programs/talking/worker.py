#!/usr/bin/python3
"""Ends as it is told to: ``worker.py HOW [FILE]``."""
import atexit
import os
import queue
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pharos
import rospy
from std_msgs.msg import String

RUNS = []  # of this program, in the module that this is


class Unprintable:
    """Fails when it is printed."""

    def __str__(self):
        return str(divide())


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


def sleep_long(file):
    """Do something that takes its time, and note whether it got that."""
    say(file, 'opened')
    begun = time.monotonic()
    time.sleep(0.3)
    say(file, f'closed in time: {time.monotonic() - begun >= 0.3}')


def leave_sleeping(file):
    """Have a daemon sleep when the program ends."""

    def fire():
        say(file, 'armed')
        time.sleep(1000)
        say(file, 'fired')

    threading.Thread(target=fire, daemon=True).start()


def work_late(file):
    """Do something a little later."""
    time.sleep(0.05)
    say(file, 'done')


def leave_to_executor(file):
    """Leave more work to an executor than it has threads."""
    executor = ThreadPoolExecutor(1)
    for _ in range(2):
        executor.submit(work_late, file)


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


def tell_order(file):
    """Say what comes after what at the end."""
    atexit.register(say, file, 'atexit')
    rospy.on_shutdown(lambda: say(file, 'hook'))
    rospy.spin()
    say(file, 'main')


def wait_for_hook():
    """Wait for what a hook of on_shutdown does."""
    ended = queue.Queue()
    rospy.on_shutdown(lambda: ended.put(None))
    ended.get()


def call_itself(file):
    """Call a service of its own in a hook of on_shutdown."""
    loggers = rospy.ServiceProxy('~get_loggers', pharos.service_class('roscpp/GetLoggers'))
    rospy.on_shutdown(lambda: say(file, type(loggers()).__name__))
    rospy.spin()


def stop_itself(file):
    """Stop the node in a callback."""

    def stop(message):
        pharos.Master().node('/worker').stop()
        say(file, 'stopped')

    rospy.Subscriber('stop', String, stop)
    rospy.spin()


def handle_signal(file, is_before):
    """Exit in a handler of SIGINT."""

    def handle(number, frame):
        say(file, f'is_shutdown {rospy.is_shutdown()}')
        sys.exit(4)

    signal.signal(signal.SIGINT, handle)
    if is_before:
        rospy.init_node('worker')
    say(file, 'ready')
    try:
        loop()
    finally:
        say(file, 'finally')


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
    elif how == 'bad argv':
        rospy.init_node('worker', argv=['_rate:=[1'])
    elif 'nameless' not in how:
        rospy.init_node('worker', disable_signals='interrupted' in how)
    rospy.sleep(0)
    ends = {
        'return': lambda: None,
        'exit': sys.exit,
        'exit 3': lambda: sys.exit(3),
        'exit -1': lambda: sys.exit(-1),
        'exit unprintable': lambda: sys.exit(Unprintable()),
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
        'order': tell_order,
        'handles': lambda file: handle_signal(file, False),
        'nameless handles': lambda file: handle_signal(file, True),
        'queue': wait_for_hook,
        'calls itself': call_itself,
        'stops itself': stop_itself,
        'late': lambda file: [rospy.signal_shutdown('enough'), ignore(file), sys.exit(3)],
        'sleep long': sleep_long,
        'daemon': lambda file: [leave_sleeping(file), rospy.spin()],
        'daemon alone': leave_sleeping,
        'thread': lambda file: threading.Thread(target=work_late, args=[file]).start(),
        'timer': lambda file: threading.Timer(0.05, say, [file, 'done']).start(),
        'executor': leave_to_executor,
        'hook': hook,
        'runs': lambda file: [say(file, len(RUNS)), rospy.spin()],
        'nameless runs': lambda file: [say(file, len(RUNS)), time.sleep(1000)],
    }
    ends[how](*more)
