#!/usr/bin/python3
"""Plays one row of the table: a process that sends and receives as it is told. benchmark/channels
starts it.

It reads commands from standard input, one a line, and answers each with a line of JSON:

    open MESSAGE RECEIVERS QUEUE        be ready for these slices; a player may have several open
    begin MESSAGE RECEIVERS QUEUE       forget what was received, and count CPU time from here
    send RATE SECONDS BUSY              send on what was begun, RATE a second (0: flat out), and
                                        compute in between (BUSY 1)
    result EXPECTED SILENCE             wait until so many have arrived, or none for so many
                                        seconds, and tell

Stamps are kept beside the messages, which carry an index into them: reading a clock is not part of
what is serialized.
"""
import argparse
import json
import mmap
import os
import queue
import random
import sys
import threading
import time

from geometry_msgs.msg import Twist
from sensor_msgs.msg import Image
from std_msgs.msg import String

clock = time.perf_counter  # CLOCK_MONOTONIC, the same in all processes
STAMPS = 1 << 21  # messages of a slice at the most
SAMPLES = 4000  # latencies told of a slice at the most
PATIENCE = 10.0  # seconds that connecting may take
IMAGES = {'image0.9': (640, 480), 'image6.2': (1920, 1080)}


class Kind:
    """A kind of message: how to make one, and how to keep the index of its stamp in it."""

    def __init__(self, name):
        self.ros_class = {'twist': Twist, 'string': String}.get(name, Image)
        self._name = name

    def make(self):
        message = self.ros_class()
        if self._name in IMAGES:
            message.width, message.height = IMAGES[self._name]
            message.encoding = 'rgb8'
            message.data = bytes(3 * message.width * message.height)
        elif self._name.startswith('bytes'):  # as benchmark/scale asks for them
            message.data = bytes(int(self._name[len('bytes') :]))
        return message

    def mark(self):
        """A function ``mark(message, index)``."""

        def twist(message, index):
            message.linear.x = float(index)

        def string(message, index):
            message.data = str(index)

        def image(message, index):
            message.step = index  # rospy overwrites header.seq

        return {Twist: twist, String: string, Image: image}[self.ros_class]

    def noter(self, sent, took):
        """A delegate that notes how long a message took; also a rospy callback."""
        append, now = took.append, clock

        def twist(message, channel=None):
            append(now() - sent[int(message.linear.x)])

        def string(message, channel=None):
            append(now() - sent[int(message.data)])

        def image(message, channel=None):
            append(now() - sent[message.step])

        return {Twist: twist, String: string, Image: image}[self.ros_class]


class Player:
    """Sends and receives; subclasses say by which way, in :meth:`opened`."""

    kind_class = Kind
    commands = 'open', 'begin', 'send', 'result'  # methods

    def __init__(self, options):
        self.options = options
        self.sends = options.role in ('both', 'send')
        self.receives = options.role in ('both', 'receive')
        self.took = []
        if not options.stamps:
            self.sent = [0.0] * STAMPS
        else:
            with open(options.stamps, 'r+b') as file:
                self.sent = memoryview(mmap.mmap(file.fileno(), 8 * STAMPS)).cast('d')
        self._ways, self._way = {}, None

    def opened(self, kind, topic, receivers, queue_size):
        """Return ``publish(message)``, None where the player only receives."""
        raise NotImplementedError

    # -- commands
    # -----------------------------------------------------------------------------------------------------

    def open(self, *what):
        name, receivers, queue_size = what
        kind = self.kind_class(name)
        topic = '/'.join(['', self.options.name, name.replace('.', '_'), receivers, queue_size])
        self._ways[what] = kind, self.opened(kind, topic, int(receivers), int(queue_size))
        return {}

    def begin(self, *what):
        self._way = self._ways[what]
        self.took.clear()
        self._cpu = time.process_time()
        return {}

    def send(self, rate, seconds, busy):
        kind, publish = self._way
        rate, seconds = float(rate), float(seconds)
        message, mark = kind.make(), kind.mark()
        begun = clock()
        count = (
            self._flat_out(publish, message, mark, begun + seconds)
            if not rate
            else self._paced(
                publish, message, mark, max(1, int(rate * seconds)), 1 / rate, busy == '1'
            )
        )
        self._begun = begun
        return {'sent': count, 'begun': begun, 'took': clock() - begun}

    def _flat_out(self, publish, message, mark, end):
        sent = self.sent
        for index in range(STAMPS):
            mark(message, index)
            sent[index] = now = clock()
            publish(message)
            if now > end:
                break
        return index + 1

    def _paced(self, publish, message, mark, count, period, busy):
        sent, due = self.sent, clock()
        for index in range(count):
            mark(message, index)
            sent[index] = clock()
            publish(message)
            due += period
            if busy:
                while clock() < due:
                    pass
            else:
                time.sleep(max(0.0, due - clock()))
        return count

    def result(self, expected, silence):
        expected, silence, arrived, last = int(expected), float(silence), -1, clock()
        cpu = time.process_time()
        while arrived < expected and clock() - last < silence:
            if len(self.took) > arrived:
                arrived, last, cpu = len(self.took), clock(), time.process_time()
            time.sleep(0.002)
        took = self.took
        if len(took) > SAMPLES:  # at random, for receivers note in turn
            took = random.sample(took, SAMPLES)
        return {'received': max(arrived, 0), 'last': last, 'cpu': cpu - self._cpu, 'took': took}

    def serve(self, commands, answers):
        for line in commands:
            name, *arguments = line.split()
            assert name in self.commands, name
            answer = getattr(self, name)(*arguments)
            print(json.dumps(answer), file=answers, flush=True)


class Direct(Player):
    """A function called."""

    def opened(self, kind, topic, receivers, queue_size):
        note = kind.noter(self.sent, self.took)
        if receivers == 1:
            return note

        def call_all(message):
            for _ in range(receivers):
                note(message)

        return call_all


class Queue(Player):
    """A bare hand-over to a thread through a SimpleQueue: of the index alone, the least there is to
    hand over."""

    def opened(self, kind, topic, receivers, queue_size):
        append, sent, number = self.took.append, self.sent, kind.mark()
        queues = [queue.SimpleQueue() for _ in range(receivers)]
        of = {
            'twist': lambda m: int(m.linear.x),
            'string': lambda m: int(m.data),
            'image': lambda m: m.step,
        }[number.__name__]

        def receive(get):
            while True:
                index = get()
                append(clock() - sent[index])

        for each in queues:
            threading.Thread(target=receive, args=(each.get,), daemon=True).start()
        if receivers == 1:
            put = queues[0].put
            return lambda message: put(of(message))

        def put_all(message):
            index = of(message)
            for each in queues:
                each.put(index)

        return put_all


class Pharos(Player):
    """Nodes of pharos: one that publishes, and a node for each receiver."""

    def __init__(self, options):
        import pharos

        super().__init__(options)
        self._master = pharos.Master(share_connections=options.share_connections)
        self._options = {'inline': options.inline, 'shared': options.shared}
        self._pharos = pharos
        self._nodes, self._heard = [], []
        self._publisher = self._node('publisher') if self.sends else None

    def _node(self, name):
        return self._master.create(
            self._pharos.BlockNode, named=f'{self.options.name}/{name}', domain='127.0.0.1'
        )

    def begin(self, *what):
        deadline = clock() + PATIENCE
        while not all(channel.connections for channel in self._heard):
            if clock() > deadline:
                raise SystemExit(f'not connected: {self._heard}')
            time.sleep(0.01)
        return super().begin(*what)

    def opened(self, kind, topic, receivers, queue_size):
        if self.receives:
            while len(self._nodes) < receivers:
                self._nodes.append(self._node(f'receiver{len(self._nodes)}'))
            for node in self._nodes[:receivers]:
                channel = node.interested_in(
                    topic,
                    typed_as=kind.ros_class,
                    delegate=kind.noter(self.sent, self.took),
                    queue_size=queue_size,
                    **self._options,
                )
                self._heard.append(channel)
        if self.sends:
            channel = self._publisher.output_channel(
                topic, typed_as=kind.ros_class, queue_size=queue_size
            )
            connections = 1 if self.options.share_connections else receivers
            if not channel.wait_for_subscribers(connections, PATIENCE):
                raise SystemExit(f'not connected: {channel!r}')
            return self._sending_to(topic) if self.options.send_to else channel.publish

    def _sending_to(self, topic):
        send_to = self._publisher.send_to

        def publish(message):
            def fill(fresh):
                for name in message.__slots__:
                    setattr(fresh, name, getattr(message, name))

            send_to(topic, fill)

        return publish


class Rospy(Player):
    """rospy; a process has one node, and one connection to a publisher whatever the number of
    callbacks."""

    def __init__(self, options):
        import rospy

        super().__init__(options)
        self._rospy = rospy
        rospy.init_node(f'{options.name}_{options.role}', disable_signals=True)

    def opened(self, kind, topic, receivers, queue_size):
        rospy = self._rospy
        tuned = {'tcp_nodelay': True} if self.options.tuned else {}
        if self.receives:
            if tuned:
                tuned_input = {
                    'buff_size': 1 << 24 if self.options.role == 'both' else 1 << 20,
                    **tuned,
                }
            for _ in range(receivers):
                rospy.Subscriber(
                    topic,
                    kind.ros_class,
                    kind.noter(self.sent, self.took),
                    queue_size=queue_size,
                    **(tuned_input if tuned else {}),
                )
        if self.sends:
            publisher = rospy.Publisher(topic, kind.ros_class, queue_size=queue_size, **tuned)
            deadline = clock() + PATIENCE
            while not publisher.get_num_connections():
                if clock() > deadline:
                    raise SystemExit(f'not connected: {topic}')
                time.sleep(0.01)
            return publisher.publish


WAYS = {'direct': Direct, 'queue': Queue, 'pharos': Pharos, 'rospy': Rospy}


def make_parser(ways, text=__doc__):
    """A parser of what all players are told."""
    parser = argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('way', choices=ways)
    parser.add_argument('name', help='of the row: for topics and nodes')
    parser.add_argument('--role', choices=('both', 'send', 'receive'), default='both')
    parser.add_argument(
        '--stamps', help='file of %d doubles, shared by a sender and a receiver' % STAMPS
    )
    parser.add_argument(
        '--inline', action='store_true', help="pharos: the delegate runs in the publisher's thread"
    )
    parser.add_argument(
        '--shared', action='store_true', help='pharos: the receiver gets the published instance'
    )
    parser.add_argument(
        '--share-connections',
        action='store_true',
        help='pharos: the receivers have one connection to the sender',
    )
    parser.add_argument(
        '--send-to', action='store_true', help='pharos: node.send_to(topic, block), not publish'
    )
    parser.add_argument(
        '--tuned', action='store_true', help='rospy: tcp_nodelay, and a large buff_size'
    )
    return parser


def play(player_class, options):
    """Play until standard input ends."""
    answers = os.fdopen(os.dup(1), 'w')
    os.dup2(2, 1)  # what ROS prints is no answer
    player_class(options).serve(sys.stdin, answers)
    answers.flush()
    os._exit(0)  # no nodes to be stopped tidily: all that is measured is over


if __name__ == '__main__':
    arguments = make_parser(WAYS).parse_args()
    play(WAYS[arguments.way], arguments)
