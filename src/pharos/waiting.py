"""Waiting: the stop of a node ends each wait on its behalf."""
import contextlib
import math
import threading
import time
from time import sleep  # by name: real, also in a simulation
from typing import Any

from pharos.errors import PharosError
from pharos.transcript import Transcript

NOTICE_DELAY = 3.0  # seconds


class _Current(threading.local):
    """The node with its soul or its program in this thread, and their run, or None.

    :ivar run: a soul that a restart has left behind keeps its own run, which has stopped
    :ivar service_run: the run whose service this thread answers, or None
    """

    node: Any = None
    run: Any = None
    service_run: Any = None


current = _Current()


def let_others_run() -> None:
    """Let other threads of this process run: one that computes keeps the interpreter for 5 ms."""
    time.sleep(1e-6)  # sleep(0) may end before another thread has woken


def let_senders_run() -> None:
    """Let the threads of senders run, which have no virtual time."""
    sleep(1e-6)


def wait(predicate, timeout=None, node=None, subject=''):
    """Wait until ``predicate()`` is true.

    :param timeout: seconds; None: without limit
    :param node: the node's stop ends the wait, too; default: the node with its soul in this thread
    :param subject: the thing that is waited for; a wait without a limit tells it after NOTICE_DELAY
    :returns: the last value of ``predicate()``, false if the wait ended otherwise
    """
    deadline = math.inf if timeout is None else time.monotonic() + timeout
    node = node or current.node
    notice_time = math.inf
    if subject and timeout is None:
        notice_time = time.monotonic() + NOTICE_DELAY
    pause = 0.002  # seconds between the first two looks
    while True:
        value = predicate()
        if value or time.monotonic() >= deadline:
            return value
        if time.monotonic() > notice_time:
            notice_time = math.inf
            Transcript.show(f'waits for {subject}')
        if node:
            is_stopping = node._current_run.stopping.wait(pause)
            if is_stopping:
                return value
        else:
            time.sleep(pause)
        pause = min(pause * 1.2, 0.02)


def wait_for(find, timeout, subject, node=None):
    """Return ``find()``; try again for ``timeout`` seconds while ``find()`` raises a PharosError.

    :raises PharosError: the error of ``find()`` after that time, or after the stop of the node
    """

    def find_or_none():
        with contextlib.suppress(PharosError):
            return find()

    return wait(find_or_none, timeout, node, subject) or find()  # the last look raises the error
