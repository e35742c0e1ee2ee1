#!/usr/bin/python3
"""Play one row of the table: a process that sends and receives as benchmark/channels tells it.

usage: player.py WAY NAME [OPTION[=VALUE] ...]

It answers each line of its standard input with a line of JSON:

    open MESSAGE RECEIVERS QUEUE    get ready for such slices; several may be open
    begin MESSAGE RECEIVERS QUEUE   forget what was received, and count CPU time from here
    send RATE SECONDS BUSY          send, RATE a second (0: flat out), and compute in between (BUSY 1)
    result EXPECTED SILENCE         wait until so many have come, or none for so many seconds

A message carries the index of its stamp: reading a clock is not part of what is serialized.
"""
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

clock = time.perf_counter  # CLOCK_MONOTONIC, the same in all processes
STAMPS = 1 << 21  # messages of a slice at most
SIZES = {'1KB': 1000, '70KB': 70_000, '300KB': 300_000, '1MB': 1_000_000, '6MB': 6_220_800}
SAMPLES = 4000  # latencies of a slice that are answered
PATIENCE = 10.0  # seconds that connecting may take


def make(name):
    """Return a message, ``mark(message, index)`` and ``index_of(message)``."""
    if name == 'twist':
        return Twist(), lambda m, i: setattr(m.linear, 'x', float(i)), lambda m: int(m.linear.x)
    image = Image(encoding='rgb8', data=bytes(SIZES.get(name, SIZES['6MB'])))
    # rospy overwrites header.seq
    return image, lambda m, i: setattr(m, 'step', i), lambda m: m.step


def wait_until(predicate):
    """Wait until a way is connected."""
    deadline = clock() + PATIENCE
    while not predicate():
        if clock() > deadline:
            raise SystemExit('not connected')
        time.sleep(0.01)


class Player:
    """Sends and receives; subclasses say how, in :meth:`opened`."""

    def __init__(self, name, options):
        self.name, self.options = name, options
        role = options.get('role')
        self.sends, self.receives = role != 'receive', role != 'send'
        self.is_one_receiver = 'one' in options  # the others are processes, too
        self.took, self.sent = [], [0.0] * STAMPS
        if role:
            with open(options['stamps'], 'r+b') as file:
                self.sent = memoryview(mmap.mmap(file.fileno(), 8 * STAMPS)).cast('d')
        self._ways, self._way = {}, None

    def noter(self, name):
        """Return a delegate, or callback, that notes how long a message took."""
        append, sent, now = self.took.append, self.sent, clock
        if name == 'twist':
            return lambda message, _=None: append(now() - sent[int(message.linear.x)])
        return lambda message, _=None: append(now() - sent[message.step])

    def open(self, *what):
        name, receivers, queue_size = what
        topic = f'/{self.name}/{name}/{receivers}/{queue_size}'
        self._ways[what] = name, self.opened(name, topic, int(receivers), int(queue_size))

    def begin(self, *what):
        self._way = self._ways[what]
        self.took.clear()
        self._cpu = time.process_time()

    def send(self, rate, seconds, busy):
        name, publish = self._way
        message, mark, _ = make(name)
        rate, sent, begun = float(rate), self.sent, clock()
        end = due = begun
        for index in range(max(1, int(rate * float(seconds))) if rate else STAMPS):
            mark(message, index)
            sent[index] = now = clock()
            publish(message)
            if rate:
                due += 1 / rate
                while busy == '1' and clock() < due:
                    pass
                time.sleep(max(0.0, due - clock()))
            elif now > end + float(seconds):
                break
        return {'sent': index + 1, 'begun': begun, 'took': clock() - begun}

    def result(self, expected, silence):
        arrived, last, cpu = -1, clock(), time.process_time()
        while arrived < int(expected) and clock() - last < float(silence):
            if len(self.took) > arrived:
                arrived, last, cpu = len(self.took), clock(), time.process_time()
            time.sleep(0.002)
        took = random.sample(self.took, min(len(self.took), SAMPLES))
        return {'received': max(arrived, 0), 'last': last, 'cpu': cpu - self._cpu, 'took': took}


class Direct(Player):
    """Calls a function."""

    def opened(self, name, topic, receivers, queue_size):
        note = self.noter(name)
        return note if receivers == 1 else lambda message: [note(message) for _ in range(receivers)]


class Queue(Player):
    """Hands the index over to threads: no hand-over in Python does less."""

    def opened(self, name, topic, receivers, queue_size):
        append, sent, index_of = self.took.append, self.sent, make(name)[2]
        queues = [queue.SimpleQueue() for _ in range(receivers)]

        def receive(get):
            while True:
                index = get()
                append(clock() - sent[index])

        for each in queues:
            threading.Thread(target=receive, args=(each.get,), daemon=True).start()
        return lambda message: [each.put(index_of(message)) for each in queues]


class Pharos(Player):
    """Nodes of pharos: one that publishes, and one for each receiver."""

    def __init__(self, name, options):
        import pharos

        super().__init__(name, options)
        master = pharos.Master()
        self._node = lambda each: master.create(
            pharos.BlockNode, named=f'{name}/{each}{options.get("one", "")}', domain='127.0.0.1'
        )
        self._nodes, self._heard = [], []
        self._publisher = self._node('publisher') if self.sends else None

    def begin(self, *what):
        wait_until(lambda: all(channel.connections for channel in self._heard))
        super().begin(*what)

    def opened(self, name, topic, receivers, queue_size):
        options = self.options
        ros_type = type(make(name)[0])
        for number in range(1 if self.is_one_receiver else receivers) if self.receives else ():
            self._nodes += [self._node(f'receiver{number}')] if number == len(self._nodes) else []
            modes = {'inline': 'inline' in options, 'shared': 'shared' in options}
            self._heard.append(
                self._nodes[number].interested_in(
                    topic, ros_type, self.noter(name), queue_size=queue_size, **modes
                )
            )
        if not self.sends:
            return None
        channel = self._publisher.output_channel(topic, ros_type, queue_size=queue_size)
        if not channel.wait_for_subscribers(receivers, PATIENCE):
            raise SystemExit(f'not connected: {channel!r}')
        send_to, names = self._publisher.send_to, ros_type.__slots__
        if 'send_to' in options:
            return lambda m: send_to(topic, **{each: getattr(m, each) for each in names})
        return channel.publish


class Rospy(Player):
    """rospy: the receivers are callbacks of one node, with one connection."""

    def __init__(self, name, options):
        import rospy

        super().__init__(name, options)
        self._rospy = rospy
        rospy.init_node(f'{name}_{options.get("role")}', disable_signals=True, anonymous=True)

    def opened(self, name, topic, receivers, queue_size):
        tuned = {'tcp_nodelay': True} if 'tuned' in self.options else {}
        ros_type, settings = type(make(name)[0]), {'queue_size': queue_size, **tuned}
        buffer = {'buff_size': 1 << (20 if 'role' in self.options else 24)} if tuned else {}
        if 'buffer' in self.options:
            buffer = {'buff_size': int(self.options['buffer'])}
        for _ in range(1 if self.is_one_receiver else receivers) if self.receives else ():
            self._rospy.Subscriber(topic, ros_type, self.noter(name), **settings, **buffer)
        if not self.sends:
            return None
        publisher = self._rospy.Publisher(topic, ros_type, **settings)
        connections = receivers if self.is_one_receiver else 1
        wait_until(lambda: publisher.get_num_connections() >= connections)
        return publisher.publish


def main():
    """Play until standard input ends."""
    way, name, *words = sys.argv[1:]
    answers = os.fdopen(os.dup(1), 'w')
    os.dup2(2, 1)  # an answer is not mixed with what ROS prints
    classes = {'direct': Direct, 'queue': Queue, 'pharos': Pharos, 'rospy': Rospy}
    player = classes[way](name, dict(word.partition('=')[::2] for word in words))
    for line in sys.stdin:
        command, *arguments = line.split()
        answer = getattr(player, command)(*arguments)
        print(json.dumps(answer or {}), file=answers, flush=True)
    os._exit(0)  # all that is measured is over


if __name__ == '__main__':
    main()
