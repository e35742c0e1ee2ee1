#!/usr/bin/python3
"""A program that notes how it ends."""
import atexit
import signal
import threading

ended = []
atexit.register(ended.append, 'first registered')
atexit.register(ended.append, 'last registered')


@atexit.register
def forgotten():
    """Is unregistered."""
    ended.append('forgotten')


atexit.unregister(forgotten)


def on_signal(number, frame):
    """What Ctrl-C calls."""
    ended.append((signal.Signals(number).name, frame))


before = signal.signal(signal.SIGINT, on_signal)
known = signal.getsignal(signal.SIGINT) is on_signal
signal.signal(signal.SIGTERM, on_signal)
timer = threading.Timer(3600, ended.append, ['timer'])
timer.start()
