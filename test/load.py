"""Much at once: nodes, topics, messages, and slow receivers. test_load.py has seconds of it,
tools/soak minutes.

Each function leaves nothing behind, returns counts, and raises AssertionError where something is
not as it should be.
"""
import collections
import contextlib
import gc
import itertools
import os
import random
import resource
import socket
import struct
import threading
import time
import traceback

from rosgraph.network import encode_ros_handshake_header
from sensor_msgs.msg import Image
from std_msgs.msg import Int32
from std_srvs.srv import SetBool

from helpers import create
from pharos.testing import TIMEOUT, until
from pharos import NodeStoppedError, ServiceCallError, UnknownServiceError, node_registry

NODES, TOPICS = 100, 1000
IMAGE_SIZE = 640 * 480 * 3
STEP = 0.01  # seconds between two bursts of messages, where they are not sent flat out


def image(number):
    """An image of 0.9 MB that knows its number; no two share their bytes."""
    return Image(step=number, data=bytes([number % 256]) * IMAGE_SIZE)


def in_use():
    """What the process has of what a node may leave behind; threads are the kernel's, not only
    those Python knows."""
    gc.collect()
    open_files = []
    for descriptor in os.listdir('/proc/self/fd'):
        with contextlib.suppress(FileNotFoundError):  # that of the listing
            open_files.append(os.readlink('/proc/self/fd/' + descriptor).partition(':')[0])
    return {
        'threads': len(os.listdir('/proc/self/task')),
        'sockets': open_files.count('socket'),
        'descriptors': len(open_files),
    }


def registered(master, prefix):
    """The nodes that the master knows under names that begin so."""
    return {
        name
        for kind in master.system_state()
        for names in kind.values()
        for name in names
        if name.startswith(prefix)
    }


def allow_many_descriptors():
    """A node has six or so, and the limit is 1024 on many machines."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


# -- a crowd


class Crowd:
    """Nodes and topics, many of both; each topic has a publisher and, on another node, a
    subscriber."""

    def __init__(self, master):
        allow_many_descriptors()
        nodes = [create(master, '/crowd/n%d' % number) for number in range(NODES)]
        self._received = [0] * TOPICS  # how many of each topic came, each of them once and in order
        self._inputs, self._outputs = [], []
        for number in range(TOPICS):
            topic = '/crowd/t%d' % number
            self._outputs.append(nodes[number % NODES].output_channel(topic, Int32))
            # 7 and 1: the subscribers of a node's topics are on as many other nodes
            receiver = nodes[(number + 7 * (number // NODES) + 1) % NODES]
            self._inputs.append(receiver.interested_in(topic, Int32, self._receiver(number)))
        assert all(len(channel.connections) == 1 for channel in self._outputs)

    def _receiver(self, topic):
        received = self._received

        def receive(message, channel):
            if message.data == received[topic]:
                received[topic] += 1

        return receive

    def send(self, rounds, rate=None):
        """Send a message on each topic so many times; ``rate`` messages a second, or as fast as it
        goes."""
        begin, pause, burst = time.monotonic(), threading.Event(), rate and int(rate * STEP)
        messages = ((channel, number) for number in range(rounds) for channel in self._outputs)
        for count, (channel, number) in enumerate(messages):
            if rate and count % burst == 0:
                pause.wait(max(0.0, begin + count / rate - time.monotonic()))
            channel.publish(Int32(number))
        sent = rounds * TOPICS
        took = time.monotonic() - begin
        dropped = sum(channel.dropped for channel in self._inputs)
        until(lambda: sum(self._received) + dropped == sent, what='all %d messages' % sent)
        assert not any(node.errors for node in node_registry.nodes())
        return {
            'sent': sent,
            'delivered': sum(self._received),
            'dropped': dropped,
            'per second': int(sent / took),
        }


def crowd(master, rounds, rate=None):
    """A Crowd that comes, talks and goes; nothing is lost, for its queues have room."""
    before = sorted(registered(master, '/crowd/'))
    try:
        counts = Crowd(master).send(rounds, rate)
    finally:
        node_registry.stop_all()
    assert not before and not registered(master, '/crowd/')
    return counts


# -- nodes that come and go


class Traffic:
    """Nodes that start, stop, send, listen and call each other at random, from a seed, in several
    threads at once."""

    THREADS, NODES, TOPICS = 4, 4, 6  # NODES are a thread's own

    def __init__(self, master, seed):
        self._master, self._seed = master, seed
        self._counting, self._counts = threading.Lock(), collections.Counter()
        self._problems = []
        self._names = [
            '/traffic/n%d_%d' % place
            for place in itertools.product(range(self.THREADS), range(self.NODES))
        ]

    def run(self, turns):
        """Let it go on for so many turns in each thread; returns the counts of what was done."""
        threads = [
            threading.Thread(target=self._work, args=(number, turns))
            for number in range(self.THREADS)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert not self._problems, '\n'.join(self._problems)
        until(lambda: not registered(self._master, '/traffic/'), what='an empty graph')
        return dict(self._counts)

    def _work(self, number, turns):
        some, nodes = random.Random(f'{self._seed} {number}'), {}
        names = self._names[number * self.NODES :][: self.NODES]
        actions = (
            [self._start_or_stop] * 2
            + [self._restart, self._close]
            + [self._send] * 8
            + [self._call] * 4
        )
        try:
            for _ in range(turns):
                name = some.choice(names)
                node, action = nodes.get(name), some.choice(actions)
                if node is None or not node.is_running:
                    node = nodes[name] = self._start(name, some)
                with self._judged(f'{action.__name__} of {name}'):
                    action(node, some)
        except Exception as error:
            self._problems.append(f'{name}: {error!r}')
        for node in nodes.values():
            node.stop()
            self._problems += map(repr, node.errors)

    @contextlib.contextmanager
    def _judged(self, what):
        """Services may be gone when they are called, and stop while they answer, and so may the node
        that calls; that is all that may go wrong."""
        try:
            yield
        except Exception as error:
            expected = NodeStoppedError, ServiceCallError, UnknownServiceError
            if not isinstance(error, expected) or 'in time' in str(error):
                self._problems.append(f'{what}: {traceback.format_exc()}')
            self._count('calls refused')

    def _count(self, what):
        with self._counting:
            self._counts[what] += 1

    def _topic(self, some):
        return '/traffic/t%d' % some.randrange(self.TOPICS)

    def _start(self, name, some):
        node = create(self._master, name)
        node.serve(name + '/set', SetBool, lambda request: {'success': request.data})

        def receive(message, channel):
            self._count('delivered')
            if message.data % 10 == 0:  # a delegate that calls, perhaps the node that sent it
                with self._judged('a delegate of ' + name):
                    self._master.lookup_service(
                        self._names[message.data % len(self._names)] + '/set'
                    ).call(data=True)

        for topic in {self._topic(some), self._topic(some)}:
            node.interested_in(topic, Int32, receive)
        self._count('starts')
        return node

    def _start_or_stop(self, node, some):
        node.stop()  # the next turn of its name starts another

    def _restart(self, node, some):
        node.stop()
        node.start()
        self._count('starts')

    def _close(self, node, some):
        if node.channels:
            some.choice(node.channels).close()

    def _send(self, node, some):
        node.send_to(self._topic(some), typed_as=Int32, data=some.randrange(1000))
        self._count('sent')

    def _call(self, node, some):
        asked = some.random() < 0.5
        service = self._master.lookup_service(some.choice(self._names) + '/set', node.name)
        assert service.call(data=asked, timeout=TIMEOUT).success is asked
        self._count('calls')


def come_and_go(master, seed, turns):
    """Traffic, after which the process uses no more than before, and nothing is registered."""
    create(master, '/traffic/first').stop()  # what is loaded once per process
    until(lambda: not any('watcher' in thread.name for thread in threading.enumerate()))
    before = in_use()
    try:
        counts = Traffic(master, seed).run(turns)
        with contextlib.suppress(AssertionError):
            until(lambda: in_use() == before)
        left = in_use()
        assert left == before, f'{before} before, {left} left'
    except Exception as error:
        raise AssertionError('%s\nPHAROS_LOAD_SEED=%d repeats it' % (error, seed)) from error
    return counts


# -- slow receivers


def camera(master, queue_size):
    """A node that publishes as many images on /load/images as it is told to on /load/more."""
    node = create(master, '/camera')
    images = node.output_channel('/load/images', Image, queue_size=queue_size)

    def publish(message, channel):
        images.wait_for_subscribers(1, TIMEOUT)
        for number in range(message.data):
            images.publish(image(number))

    node.interested_in('/load/more', Int32, publish)
    return node


#: the same, as a program of its own
CAMERA = '''
import load, pharos
load.camera(pharos.Master(), queue_size=%d)
pharos.spin()
'''


class Viewer:
    """A node that receives images, and asks a camera for them."""

    def __init__(self, master, delegate, queue_size=1):
        node = create(master, '/viewer')
        self.channel = node.interested_in('/load/images', Image, delegate, queue_size=queue_size)
        self._more = node.output_channel('/load/more', Int32)
        assert self._more.wait_for_subscribers(1, TIMEOUT)
        until(lambda: self.channel.connections)
        self._asked = 0

    def ask(self, count):
        self._more.send(data=count)
        self._asked += count

    def wait_for_all(self):
        """Wait until all has arrived; what the queue has room for is still in it."""
        until(
            lambda: self.channel.received + self.channel.dropped
            == self._asked - self.channel.queue_size
        )


def subscribe(node, topic, message_class):
    """A TCPROS connection that receives; the file of what comes, past the handshake."""
    client = socket.socket()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
    client.settimeout(TIMEOUT)
    client.connect(('127.0.0.1', node.tcp_port))
    client.sendall(
        encode_ros_handshake_header(
            {
                'callerid': '/silent',
                'topic': topic,
                'type': message_class._type,
                'md5sum': message_class._md5sum,
            }
        )
    )
    with client:
        file = client.makefile('rb')
    file.read(*struct.unpack('<I', file.read(4)))
    return file


class Busy:
    """A delegate for images that is busy with each until :meth:`go_on`."""

    def __init__(self):
        self._begun, self._go_on = threading.Semaphore(0), threading.Semaphore(0)
        self.numbers = []

    def __call__(self, message, channel):
        self.numbers.append(message.step)
        self._begun.release()
        assert self._go_on.acquire(timeout=TIMEOUT)

    def wait(self):
        """Wait until it has begun with the next image; returns its number."""
        assert self._begun.acquire(timeout=TIMEOUT), 'no image came'
        return self.numbers[-1]

    def go_on(self):
        """Let it be done with the image that it has."""
        self._go_on.release()
