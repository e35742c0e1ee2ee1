#!/usr/bin/python3
"""Plays a row of benchmark/middleware, as player.py does of benchmark/channels: systems that know
no types of messages get the same messages as bytes.

The receivers of a row are in one process, the sender in another; what else a system needs is in a
third. With --hold the receivers keep what they get, and tell by the command

    own                                 what can be done with it
"""
import contextlib
import ctypes
import json
import os
import pathlib
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import traceback
from multiprocessing.shared_memory import SharedMemory

import player
import rows

INDEX = struct.Struct('<d')  # of the stamp: the first bytes of a message
SIZES = {'twist': 48, 'image6.2': 6220800}  # bytes
HELD = 6  # messages that a receiver keeps


class Bytes:
    """A kind of message that is bytes, as :class:`player.Kind` is one of ROS's."""

    def __init__(self, name):
        self.name, self.size = name, SIZES[name]

    def make(self):
        return bytearray(self.size)

    def mark(self):
        pack_into = INDEX.pack_into
        return lambda message, index: pack_into(message, 0, index)

    def noter(self, sent, took):
        append, now, unpack = took.append, player.clock, INDEX.unpack_from

        def note(message):
            append(now() - sent[int(unpack(message)[0])])

        return note


class HeldBytes(Bytes):
    """What is received is kept: the first messages of each receiver."""

    held = []  # of each receiver: [(index when it came, message)]

    def noter(self, sent, took):
        return _holder(super().noter(sent, took), self.read)

    @staticmethod
    def read(message):
        return INDEX.unpack_from(message)[0]

    @staticmethod
    def write(message):
        INDEX.pack_into(message, 0, -1.0)


class HeldImage(player.Kind):
    """The same of ROS's messages."""

    held = HeldBytes.held

    def noter(self, sent, took):
        return _holder(super().noter(sent, took), self.read)

    @staticmethod
    def read(message):
        return message.step

    @staticmethod
    def write(message):
        message.step = -1


def _holder(note, read):
    kept = []
    HeldBytes.held.append(kept)

    def hold(message, channel=None):
        note(message)
        if len(kept) < HELD:
            kept.append((read(message), message))

    return hold


def own(self):
    """A command of players that hold: look at what was kept while others came, and write into it."""
    kind = self.kind_class
    kept = kind.held[0]
    changed = sum(kind.read(message) != index for index, message in kept)
    return {
        'type': type(kept[-1][1]).__name__,
        'held': len(kept),
        'changed': changed,
        'written': _written(kind),
    }


def _written(kind):
    """What becomes of it, in a child, for that may end there."""
    answers = {0: 'seen by no other', 1: 'seen by the others', 2: 'refused'}
    child = os.fork()
    if child == 0:
        try:
            kind.write(kind.held[0][-1][1])
            os._exit(any(kind.read(each) == -1 for kept in kind.held[1:] for _, each in kept))
        except (TypeError, BufferError):
            os._exit(2)
        except BaseException:
            traceback.print_exc()
            os._exit(3)
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        return f'{signal.Signals(os.WTERMSIG(status)).name}, process dies'
    return answers.get(os.WEXITSTATUS(status), 'failed')


class Other(player.Player):
    """What the players of these systems have in common."""

    kind_class = Bytes

    def __init__(self, options):
        super().__init__(options)
        self.folder = pathlib.Path(options.stamps).parent

    def noter(self, kind):
        """A function for one receiver, which is called with what came."""
        note = kind.noter(self.sent, self.took)
        return (lambda message: note(bytes(message))) if self.options.copied else note

    def start(self, run, *arguments):
        threading.Thread(target=run, args=arguments, daemon=True).start()

    def path(self, kind, receivers):
        """Of a socket in the file system."""
        return f'{self.folder}/{self.options.name}-{kind.name}-{receivers}'


class Shared(Other):
    """multiprocessing.shared_memory: the sender writes messages in turn into a segment, and their
    places into a socket of each receiver."""

    def opened(self, kind, topic, receivers, queue_size):
        path = self.path(kind, receivers)
        if self.receives:
            listener = socket.socket(socket.AF_UNIX)
            listener.bind(path)
            listener.listen(receivers)
            for _ in range(receivers):
                self.start(self._receive, listener, kind.size, self.noter(kind))
            return None
        size = kind.size
        self._kept = segment = SharedMemory(create=True, size=size * queue_size)
        segment.buf[:] = bytes(segment.size)  # its pages are there
        places = [segment.buf[size * at : size * (at + 1)] for at in range(queue_size)]
        sockets = [socket.socket(socket.AF_UNIX) for _ in range(receivers)]
        for each in sockets:
            each.connect(path)
            each.sendall(segment.name.encode().ljust(64))
        pack, turn = struct.Struct('<I').pack, 0

        def publish(message):
            nonlocal turn
            places[turn][:] = message
            place = pack(turn)
            for each in sockets:
                each.sendall(place)
            turn = (turn + 1) % queue_size

        return publish

    @staticmethod
    def _receive(listener, size, note):
        stream = listener.accept()[0].makefile('rb', 1 << 16)
        segment = SharedMemory(stream.read(64).decode().strip())
        unpack = struct.Struct('<I').unpack
        while True:
            (place,) = unpack(stream.read(4))
            note(segment.buf[size * place : size * (place + 1)])


class ZeroMQ(Other):
    """pyzmq: XPUB, which is told of each subscriber, and SUB, through a socket of the file
    system."""

    def opened(self, kind, topic, receivers, queue_size):
        import zmq

        path = 'ipc://' + self.path(kind, receivers)
        context = zmq.Context.instance()
        if self.receives:
            for _ in range(receivers):
                self.start(self._receive, context.socket(zmq.SUB), path, kind, queue_size)
            return None
        sender = context.socket(zmq.XPUB)
        sender.set(zmq.XPUB_VERBOSE, 1)
        sender.set(zmq.SNDHWM, queue_size)
        sender.bind(path)
        for _ in range(receivers):
            sender.recv()
        return sender.send

    def _receive(self, receiver, path, kind, queue_size):
        import zmq

        receiver.set(zmq.RCVHWM, queue_size)
        receiver.set(zmq.SUBSCRIBE, b'')
        receiver.connect(path)
        note, is_large = self.noter(kind), kind.size > zmq.COPY_THRESHOLD
        while True:  # large ones are not copied once more
            message = receiver.recv(copy=not is_large)
            note(message.buffer if is_large else message)


class Zenoh(Other):
    """eclipse-zenoh, two peers; with --provider, the sender writes large messages into zenoh's
    shared memory."""

    def __init__(self, options):
        import zenoh

        super().__init__(options)
        self._zenoh, self._kept = zenoh, []
        config = zenoh.Config()
        config.insert_json5('scouting/multicast/enabled', 'false')
        # ms; a player is stopped while others are measured
        config.insert_json5('transport/link/tx/lease', '3600000')
        way = 'listen' if self.receives else 'connect'
        config.insert_json5(f'{way}/endpoints', f'["tcp/127.0.0.1:{options.port}"]')
        self._session = zenoh.open(config)

    def opened(self, kind, topic, receivers, queue_size):
        zenoh, key = self._zenoh, topic.strip('/')
        if self.receives:
            for _ in range(receivers):
                note = self.noter(kind)
                self._kept.append(
                    self._session.declare_subscriber(
                        key, lambda sample, note=note: note(sample.payload.to_bytes())
                    )
                )
            return None
        publisher = self._session.declare_publisher(key)
        deadline = player.clock() + player.PATIENCE
        while not publisher.matching_status.matching:
            if player.clock() > deadline:
                raise SystemExit(f'not connected: {key}')
            time.sleep(0.01)
        if kind.name == 'twist' or not self.options.provider:
            return publisher.put
        shm = zenoh.shm
        provider = shm.ShmProvider.default_backend(kind.size * (queue_size + 2))
        policy = shm.BlockOn(shm.GarbageCollect())

        def publish(message):
            buffer = provider.alloc(kind.size, policy=policy)
            buffer[:] = message
            publisher.put(buffer)

        return publish


class Iceoryx(Other):
    """iceoryx2: publish and subscribe, and an event that wakes the receivers."""

    def opened(self, kind, topic, receivers, queue_size):
        import iceoryx2

        iceoryx2.set_log_level(iceoryx2.LogLevel.Fatal)
        node = iceoryx2.NodeBuilder.new().create(iceoryx2.ServiceType.Ipc)
        name = iceoryx2.ServiceName.new(f'{self.folder.name}{topic}')
        service = (
            node.service_builder(name)
            .publish_subscribe(iceoryx2.Slice[ctypes.c_uint8])
            .max_subscribers(receivers)
            .subscriber_max_buffer_size(queue_size)
            .open_or_create()
        )
        event = node.service_builder(name).event().max_listeners(receivers).open_or_create()
        self._kept = node, service, event
        if self.receives:
            for _ in range(receivers):
                self.start(self._receive, service, event, self.noter(kind))
            return None
        publisher = service.publisher_builder().initial_max_slice_len(kind.size).create()
        notifier = event.notifier_builder().create()

        def publish(message):
            sample = publisher.loan_slice_uninit(kind.size)
            sample.payload().as_memory_view().cast('B')[:] = message
            sample.assume_init().send()
            notifier.notify()

        return publish

    @staticmethod
    def _receive(service, event, note):
        import iceoryx2

        subscriber = service.subscriber_builder().create()
        listener = event.listener_builder().create()
        while True:
            with contextlib.suppress(iceoryx2.ListenerWaitError):  # it was stopped meanwhile
                listener.blocking_wait()
            sample = subscriber.receive()
            while sample is not None:
                note(sample.payload().as_memory_view())
                sample = subscriber.receive()


class Dora(Other):
    """dora-rs: two dynamic nodes of a dataflow, which a third process runs; a process of Python
    has one node, so that its receivers are inputs of it."""

    def __init__(self, options):
        super().__init__(options)
        self._notes = {}  # input -> what is called
        self._node = None
        if self.receives:
            self._run()
            self.start(self._receive)

    def opened(self, kind, topic, receivers, queue_size):
        output = f'{kind.name}-{receivers}'.replace('.', '_')
        if self.receives:
            for receiver in range(receivers):
                self._notes[f'{output}-{receiver}'] = self.noter(kind)
            return None
        import pyarrow

        self._node = self._node or self._connected('sender')
        send, size, type_ = self._node.send_output, kind.size, pyarrow.uint8()

        def publish(message):
            data = [None, pyarrow.py_buffer(message)]
            send(output, pyarrow.Array.from_buffers(type_, size, data))

        return publish

    def _run(self):
        inputs, outputs = {}, []
        for case in self.options.cases.split(','):
            message, receivers, queue_size = case.split(':')
            output = f'{message}-{receivers}'.replace('.', '_')
            outputs.append(output)
            for receiver in range(int(receivers)):
                source = {'source': f'sender/{output}', 'queue_size': int(queue_size)}
                inputs[f'{output}-{receiver}'] = source
        nodes = [
            {'id': 'sender', 'path': 'dynamic', 'outputs': outputs},
            {'id': 'receiver', 'path': 'dynamic', 'inputs': inputs},
        ]
        flow = self.folder / f'{self.options.name}.yml'
        flow.write_text(json.dumps({'nodes': nodes}))  # which is YAML, too
        # a process, for it keeps the interpreter to itself
        command = [sys.executable, '-c', 'import dora, sys; dora.run(sys.argv[1])', str(flow)]
        subprocess.Popen(command, preexec_fn=rows.end_with_parent)

    @staticmethod
    def _connected(name):
        import dora

        deadline = player.clock() + player.PATIENCE
        while True:
            try:
                return dora.Node(name)
            except RuntimeError:  # the dataflow does not run yet
                if player.clock() > deadline:
                    raise
                time.sleep(0.1)

    def _receive(self):
        for event in self._connected('receiver'):
            if event['type'] == 'INPUT':
                self._notes[event['id']](event['value'].buffers()[1])


WAYS = {
    'shared': Shared,
    'zeromq': ZeroMQ,
    'zenoh': Zenoh,
    'iceoryx': Iceoryx,
    'dora': Dora,
    'pharos': player.Pharos,
    'rospy': player.Rospy,
}


def main():
    parser = player.make_parser(WAYS, __doc__)
    parser.add_argument('--hold', action='store_true', help='keep what is received')
    parser.add_argument('--copied', action='store_true', help='have the receivers copy it')
    parser.add_argument('--provider', action='store_true', help="zenoh: send from its own memory")
    parser.add_argument('--port', type=int, help='zenoh: of TCP')
    parser.add_argument('--cases', help='dora: MESSAGE:RECEIVERS:QUEUE, all that will be opened')
    options = parser.parse_args()
    player_class = WAYS[options.way]
    if options.hold:
        kind = HeldBytes if issubclass(player_class, Other) else HeldImage
        commands = (*player_class.commands, 'own')
        members = {'kind_class': kind, 'commands': commands, 'own': own}
        player_class = type(player_class.__name__, (player_class,), members)
    player.play(player_class, options)


if __name__ == '__main__':
    main()
