"""Runs the delegates of one node, one at a time, in whichever thread has the message."""
import collections
import threading


class Dispatcher:
    """Sees to it that a node's delegates run one at a time, whatever their messages came through.

    Channels put messages into their own queues and :meth:`announce` them. Whoever then calls :meth:`run` runs the
    delegates of all that waits, unless another thread is doing so already: that one goes on with it. So nobody
    waits for a busy node, and a delegate that causes a message to its own node neither deadlocks nor recurses.
    """

    def __init__(self):
        self._running = threading.Lock()        # held by the thread that runs delegates
        self._announced = collections.deque()   # a channel for each message, in the order of arrival
        self.announce = self._announced.append

    def run(self):
        """Run the delegates for all announced messages, unless another thread is about it."""
        announced, running = self._announced, self._running
        while announced and running.acquire(blocking=False):
            try:
                while announced:
                    announced.popleft().run_next()
            finally:
                running.release()
            # looked at again: a message announced just before the release found the node busy

    def close(self):
        """Forget what has not run."""
        self._announced.clear()
