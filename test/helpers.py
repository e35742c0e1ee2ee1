"""What the tests of several files need: nodes, threads, a master in this process."""
import itertools
import signal
import sys
import threading

import numpy
import pytest
import rosmaster.master

from pharos import BlockNode
from pharos.private_rospy.local_link import PROTOCOL
from pharos.testing import TIMEOUT

#: of a test that serializes a numpy_msg
serializes_numpy = pytest.mark.skipif(
    not hasattr(numpy.ndarray, 'tostring'),
    reason="genpy's code writes numpy_msg with ndarray.tostring, which this numpy has no more; "
    'bare rospy fails, too',
)


class InProcessMaster:
    """rosmaster's own master, in this process."""

    def __init__(self, port=0):
        self._master = rosmaster.master.Master(port=port)
        self._master.start()
        ready = threading.Event()
        while not self._master.uri:
            ready.wait(0.001)  # rosmaster has no event for it
        self.url = f'http://127.0.0.1:{self._master.master_node.port}/'

    @property
    def handler(self):
        """What answers its calls."""
        return self._master.handler

    def forget(self):
        """Forget the parameters, and the type of each topic that no node has, which rosmaster itself
        never does: the next test may use the names for others."""
        handler = self.handler
        with handler.param_server.lock:
            handler.param_server.parameters.clear()
        with handler.ps_lock:
            kept = set(handler.publishers.map) | set(handler.subscribers.map)
            for topic in set(handler.topics_types) - kept:
                del handler.topics_types[topic]

    def stop(self):
        """End its server."""
        node = self._master.master_node
        node.is_shutdown = True
        # rosgraph itself only closes its socket, and its thread spins (ros_comm #2238)
        node.server.shutdown()
        self._master.stop()


def create(master, name='/node', node_class=BlockNode, **settings):
    """A node on the loopback interface; the fixture of the master stops it."""
    return master.create(node_class, named=name, **{'domain': '127.0.0.1', **settings})


def speak_tcpros_only(node):
    """Have the node connect by sockets alone, as those of other processes do; returns it."""
    handlers = node.latest_run.rospy.lifetime.xmlrpc.handler.protocol_handlers
    handlers[:] = [handler for handler in handlers if not handler.supports(PROTOCOL)]
    impl = node.latest_run.rospy.module.impl
    impl.tcpros_service.TCPROSTransport = impl.tcpros_base.TCPROSTransport
    return node


def in_thread(block, *arguments):
    """Run ``block(*arguments)`` in a thread; returns that."""
    thread = threading.Thread(target=block, args=arguments, daemon=True)
    thread.start()
    return thread


def ended(thread):
    """Wait for the end of a thread; returns whether it came."""
    thread.join(TIMEOUT)
    return not thread.is_alive()


def registrations(master, name):
    """The topics that the node publishes, those it hears, and the services that it offers."""
    return [
        sorted(topic for topic, nodes in kind.items() if name in nodes)
        for kind in master.system_state()
    ]


def interrupted_at(step, block, modules, with_signal=None):
    """Have ``block()`` end with a KeyboardInterrupt, as by a handler of signals, at a step of what is
    in these modules; returns whether it came so far.

    :param with_signal: the number of one, whose handler is to raise it; otherwise it comes without
    """
    files = [module.__file__ for module in modules]
    steps = itertools.count()

    def look(frame, event, argument):
        is_step = frame.f_code.co_filename in files and event in ('call', 'c_return')
        if is_step and next(steps) == step:
            sys.setprofile(None)
            if with_signal is None:
                raise KeyboardInterrupt
            signal.getsignal(with_signal)(with_signal, frame)  # as where that code takes it

    sys.setprofile(look)
    try:
        block()
    except KeyboardInterrupt:
        return True
    finally:
        sys.setprofile(None)
    return False
