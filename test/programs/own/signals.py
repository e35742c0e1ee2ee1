#!/usr/bin/python3
"""Handles signals as it is told to: ``signals.py HOW``."""
import os
import signal
import sys
import threading

import rospy

HOW = sys.argv[1]
came, is_ready = threading.Event(), threading.Event()
names = []


def on_signal(number, frame):
    """Keep the signal, or fail, or end the program."""
    if HOW == 'fail':
        raise ZeroDivisionError('in a handler')
    if HOW == 'exit':
        sys.exit()
    names.append(signal.Signals(number).name)
    came.set()


if HOW == 'interrupt early':
    os.kill(os.getpid(), signal.SIGINT)

if HOW == 'kill':
    signal.signal(signal.SIGUSR2, on_signal)
rospy.init_node('signals')
if HOW not in ('kill', 'unhandled'):
    for each in signal.SIGALRM, signal.SIGUSR1, signal.SIGUSR2:
        signal.signal(each, on_signal)
if HOW == 'alarm':
    left = signal.alarm(100), signal.alarm(0)
if HOW == 'timer':
    signal.setitimer(signal.ITIMER_REAL, 0.01, 0.01)
    came.wait()
    came.clear()
    came.wait()
    signal.setitimer(signal.ITIMER_REAL, 0)
elif HOW == 'raise':
    signal.raise_signal(signal.SIGUSR1)
elif HOW == 'kill':
    os.kill(os.getpid(), signal.SIGUSR2)
elif HOW == 'interrupt':
    os.kill(os.getpid(), signal.SIGINT)
elif HOW in ('fail', 'exit', 'unhandled'):
    signal.setitimer(signal.ITIMER_REAL, 0.01)
is_ready.set()
rospy.spin()
