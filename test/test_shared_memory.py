"""Processes of this package on one host share memory; all others get the same by TCPROS."""
import contextlib
import errno
import os
import pathlib
import re
import shutil
import signal
import socket
import subprocess
import threading
import zlib

import numpy
import pytest

import pharos
from helpers import TIMEOUT, Gate, InProcessMaster, Peer, PharosPeer, Program, create, stop_nodes
from pharos import Master
from pharos.private_rospy.topics import HELD_BYTES
from pharos.shared_memory.receiving import MemoryReceiver, Reader
from pharos.shared_memory.sending import MAX_FILES
from pharos.testing import Mailbox, until

STRING = 'std_msgs/String'
IMAGE = 'sensor_msgs/Image'
SCAN = 'sensor_msgs/LaserScan'
LARGE = 6_220_800  # bytes of an image of 1920 x 1080
SHARED = 'SHARED_MEMORY'
RELAY = '/usr/lib/topic_tools/relay'
OTHER_USER = ['setpriv', '--reuid', '65534', '--clear-groups']

needs_other_user = pytest.mark.skipif(
    not shutil.which('setpriv') or subprocess.call([*OTHER_USER, 'test', '-r', __file__]) != 0,
    reason='needs the right to be another user',
)

#: the code of each listener: it notes what comes, but keeps no images
LISTENING = """
import zlib
channels, notes = {}, {}
def listen(topic, type_, **options):
    def note(message):
        name = message._connection_header['callerid']
        notes[topic].append((message.header.seq, len(message.data), zlib.crc32(message.data), name))
    notes[topic] = []
    channels[topic] = node.interested_in(topic, type_, note, **options)
"""
#: the code of a camera: all data of an image are its number
FILMING = f"""
def film(me):
    for number in range(100000):
        me.ros.sleep(0.02)
        out.send(data=number.to_bytes(4, 'little') * {LARGE // 4})
out = node.output_channel('/film', {IMAGE!r}, queue_size=2)
node.fork(film)
"""


class Listener(PharosPeer):
    """A node of pharos in another process, which notes the images of topics."""

    def __init__(self, url, name='listener', **options):
        super().__init__(url, name, **options)
        self.run(LISTENING)

    def listen(self, topic, **options):
        self.run(f'listen({topic!r}, {IMAGE!r}, **{options!r})')

    def notes(self, topic, count=1):
        """Wait for so many images; returns (header.seq, size, checksum, publisher) of each."""
        until(lambda: self.value(f'len(notes[{topic!r}])') >= count, TIMEOUT)
        return self.value(f'notes[{topic!r}]')

    def numbers(self, topic, count=1):
        return [note[0] for note in self.notes(topic, count)]

    def channel(self, topic, attribute):
        return self.value(f'channels[{topic!r}].{attribute}')

    def pause(self):
        """Stop the process as by Ctrl-Z, and wait until it has stopped."""
        self.process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, self.pid, os.WSTOPPED)


@pytest.fixture(scope='module')
def network():
    """A ROS master, and one listener for all tests: each test has a topic of its own."""
    ros_master = InProcessMaster()
    with Listener(ros_master.url) as listener:
        yield Master(ros_master.url), listener
    ros_master.stop()


@pytest.fixture
def listener(network):
    return network[1]


@pytest.fixture
def topic(request):
    return '/' + ''.join(letter if letter.isalnum() else '_' for letter in request.node.name)


@pytest.fixture
def master(network, listener, topic, monkeypatch):
    """The master of the network. A test leaves no node, no thread, and no file in memory."""
    master, _ = network
    monkeypatch.setenv('ROS_MASTER_URI', master.url)
    yield master
    listener.run(f'for each in list(node.channels): each.close() if {topic!r} in each.topic else 0')
    stop_nodes(master)
    for pid in os.getpid(), listener.pid:
        until(lambda pid=pid: not memory_files(pid), 10, 'the end of files in memory')
    assert not [name for name in os.listdir('/dev/shm') if 'pharos' in name]


@pytest.fixture
def node(master):
    return create(master)


def memory_files(pid):
    """Return the descriptors of a process that are files of this package in memory."""
    folder = f'/proc/{pid}/fd'
    links = []
    for number in os.listdir(folder):
        with contextlib.suppress(FileNotFoundError):  # it was closed meanwhile
            links.append(os.readlink(f'{folder}/{number}'))
    return [link for link in links if link.startswith('/memfd:pharos')]


def expected(images):
    """Return the notes of the first images of the node."""
    pairs = enumerate((bytes(image.data) for image in images), 1)
    return [(number, len(data), zlib.crc32(data), '/node') for number, data in pairs]


def send_and_wait(out, topic, datas, *listeners):
    """Send images one by one, each when all listeners have noted the one before; return them."""
    before = len(listeners[0].notes(topic, 0))
    sent = []
    for count, data in enumerate(datas, before + 1):
        sent.append(out.send(data=data))
        for each in listeners:
            each.notes(topic, count)
    return sent


# -- who gets which transport


def test_both_ends_name_the_transport(master, node, listener, topic):
    listener.listen(topic)
    out = node.output_channel(topic, IMAGE)
    until(lambda: out.connections == [('/listener', SHARED)])
    until(lambda: listener.channel(topic, 'connections') == [('/node', SHARED)])


def test_rosnode_info_names_the_transport(master, node, listener, topic):
    listener.listen(topic)
    node.output_channel(topic, IMAGE)
    for name in '/node', '/listener':
        output = subprocess.check_output(['rosnode', 'info', name], text=True, timeout=TIMEOUT)
        shown = output.split(f'topic: {topic}\n')[1].split('topic:')[0]
        assert f'transport: {SHARED}\n' in shown


@pytest.mark.skipif(not os.path.exists(RELAY), reason='needs topic-tools')
def test_other_programs_get_the_same(master, node, listener, topic):
    """rospy, rostopic and roscpp, beside a process that shares memory."""
    listener.listen(topic)
    relay = RELAY, topic, f'{topic}_relayed', '__name:=relay'
    echo = 'rostopic', 'echo', f'{topic}/height'
    with Peer(master.url, 'rospy_node') as peer, contextlib.ExitStack() as stack:
        peer.hear(topic, IMAGE)
        programs = [stack.enter_context(Program(each, master.url)) for each in (relay, echo)]
        out = node.output_channel(topic, IMAGE)
        until(lambda: len(out.connections) == 4, TIMEOUT)
        kinds = dict(out.connections)
        assert kinds.pop('/listener') == SHARED
        assert {'/rospy_node', '/relay'} < set(kinds) and set(kinds.values()) == {'TCPROS'}
        box = Mailbox(create(master, '/end'), f'{topic}_relayed', IMAGE)
        # relay advertises when the first message comes
        until(lambda: out.send(height=9) and box.channel.connections, TIMEOUT)
        image = out.send(height=9, data=os.urandom(300_000))
        box.wait_for(lambda message: message.data == image.data)
        notes = [note[1:3] for note in listener.notes(topic, out.sent)]
        heard = peer.heard(topic, out.sent)
        assert notes == [(len(each.data), zlib.crc32(each.data)) for each in heard]
        programs[1].expect('9\n---\n')


@pytest.mark.parametrize('cls', ['rospy.AnyMsg', f"numpy_msg(message_class('{SCAN}'))"])
def test_changed_classes_get_tcpros(node, listener, topic, cls):
    listener.run('from rospy.numpy_msg import numpy_msg; came = []')
    listener.run(f'subscribers.append(rospy.Subscriber({topic!r}, {cls}, came.append))')
    out = node.output_channel(topic, SCAN)
    until(lambda: out.connections == [('/listener', 'TCPROS')])
    out.send(ranges=[1.0] * 50_000)
    until(lambda: listener.value('len(came)'))
    size = 'len(getattr(came[0], "_buff", "")) or came[0].ranges.nbytes'
    assert listener.value(size) >= 200_000


@pytest.mark.parametrize('way', ['by keyword', 'here', 'there'])
def test_shared_memory_is_switched_off(master, topic, monkeypatch, way):
    off = {'PHAROS_SHARED_MEMORY': '0'}
    with Listener(master.url, 'other', **(off if way == 'there' else {})) as other:
        if way == 'here':
            monkeypatch.setenv(*off.popitem())
        plain = Master(master.url, shared_memory=False if way == 'by keyword' else None)
        other.listen(topic)
        out = create(plain).output_channel(topic, IMAGE)
        until(lambda: out.connections == [('/other', 'TCPROS')])
        until(lambda: other.channel(topic, 'connections') == [('/node', 'TCPROS')])


@needs_other_user
def test_other_user_gets_tcpros(master, node, listener, topic):
    with Listener(master.url, 'other', command=OTHER_USER, ROS_LOG_DIR='/proc/no_log') as other:
        for each in other, listener:
            each.listen(topic)
        out = node.output_channel(topic, IMAGE)
        until(lambda: dict(out.connections) == {'/other': 'TCPROS', '/listener': SHARED})
        (image,) = send_and_wait(out, topic, [os.urandom(LARGE)], other, listener)
        assert other.notes(topic) == expected([image])


def test_unreachable_socket_gives_tcpros(node, listener, topic, monkeypatch):
    """The socket of a publisher in another network namespace cannot be reached."""

    class Socket(socket.socket):
        def connect(self, address):
            if self.family == socket.AF_UNIX:
                raise ConnectionRefusedError
            super().connect(address)

    listener.run(f'out = node.output_channel({topic!r}, {IMAGE!r}, latch=True)')
    listener.run(f'image = out.send(data=bytes({LARGE}))')
    monkeypatch.setattr(socket, 'socket', Socket)
    box = Mailbox(node, topic, IMAGE)
    assert len(box.next().data) == LARGE
    until(lambda: box.channel.connections == [('/listener', 'TCPROS')])


def test_other_type_is_refused(node, listener, topic):
    listener.run(f'out = node.output_channel({topic!r}, {STRING!r})')
    node.interested_in(topic, IMAGE)
    until(lambda: node.errors)
    assert isinstance(node.errors[0], pharos.MessageTypeError)
    assert topic in str(node.errors[0]) and STRING in str(node.errors[0])


# -- messages


@pytest.mark.parametrize('size', [0, 48, 60_000, 65_537, 300_000, LARGE])
def test_images_arrive_equal_in_order(node, listener, topic, size):
    listener.listen(topic)
    out = node.output_channel(topic, IMAGE)
    images = send_and_wait(out, topic, [os.urandom(size) for _ in range(9)], listener)
    assert listener.notes(topic) == expected(images)
    assert listener.channel(topic, 'dropped') == 0


BYTES = numpy.arange(600_000).astype(numpy.uint8)
MATRIX = BYTES.reshape(600, 1000)


@pytest.mark.parametrize(
    'data', [BYTES, MATRIX, MATRIX[:, ::2], BYTES[:0], bytearray(300_000), [7] * 300_000]
)
def test_other_data_arrive_as_bytes(node, listener, topic, data):
    listener.listen(topic)
    send_and_wait(node.output_channel(topic, IMAGE), topic, [data], listener)
    wire = data.tobytes() if isinstance(data, numpy.ndarray) else bytes(data)
    assert listener.notes(topic) == [(1, len(wire), zlib.crc32(wire), '/node')]


def test_large_numbers_arrive_whole(node, listener, topic):
    ranges = [number / 4 for number in range(50_000)]
    out = node.output_channel(topic, SCAN, latch=True)
    out.send(ranges=ranges, header={'frame_id': 'laser'})
    listener.hear(topic, SCAN)
    (message,) = listener.heard(topic)
    assert (list(message.ranges) == ranges, message.header.frame_id) == (True, 'laser')
    until(lambda: out.connections == [('/listener', SHARED)])


def test_nested_images_arrive_whole(node, listener, topic):
    type_ = 'shared_memory_msgs/Pair'
    definition = 'sensor_msgs/Image left\nuint8[] first\nuint8[] second\n'
    pharos.define_message(type_, definition)
    listener.run(f'pharos.define_message({type_!r}, {definition!r})')
    listener.hear(topic, type_)
    datas = [os.urandom(size) for size in (LARGE, 200_000, 100_000)]
    fields = {'left': {'data': datas[0]}, 'first': datas[1], 'second': datas[2]}
    node.send_to(topic, typed_as=type_, **fields)
    until(lambda: listener.value(f'len(heard[{topic!r}])'), TIMEOUT)
    listener.run(f'pair, = heard[{topic!r}]')
    assert listener.value('[pair.left.data, pair.first, pair.second]') == datas


def test_messages_grow_and_shrink(node, listener, topic):
    listener.listen(topic)
    out = node.output_channel(topic, IMAGE)
    sizes = 300_000, LARGE, 300_000, 48, 2 * LARGE, 70_000, LARGE
    images = send_and_wait(out, topic, [os.urandom(size) for size in sizes], listener)
    assert listener.notes(topic) == expected(images)
    assert len(set(memory_files(listener.pid))) == 1


def test_images_flat_out_are_whole(master, node):
    torn, heard = [], threading.Event()

    def look(message):
        if message.data.count(message.data[0]) != len(message.data):
            torn.append(message)
        if message.encoding == 'last':
            heard.set()

    node.interested_in('/image', 'sensor_msgs/Image', look)
    with PharosPeer(master.url) as camera:
        camera.run("out = node.output_channel('/image', 'sensor_msgs/Image')")
        camera.run(
            'images = [bytes([n]) * (3 << 20) for n in range(20)]\n'
            'for n in range(200): out.send(data=images[n % 20])\n'
            "out.send(data=images[0], encoding='last')"
        )
        assert heard.wait(TIMEOUT)
    assert not torn


def test_shared_memory_keeps_the_order_of_sending(master, node, monkeypatch):
    heard, is_held, may_read = [], threading.Event(), threading.Event()
    take = Reader._take_messages

    def take_later(reader):
        is_held.set()
        may_read.wait(TIMEOUT)
        return take(reader)

    for topic in '/a', '/b':
        node.interested_in(topic, STRING, lambda message: heard.append(message.data))
    with PharosPeer(master.url) as peer:
        peer.run("a, b = [node.output_channel(t, 'std_msgs/String') for t in ('/a', '/b')]")
        monkeypatch.setattr(Reader, '_take_messages', take_later)
        peer.run("a.send(data='0')")
        assert is_held.wait(TIMEOUT)
        peer.run("for out, text in (a, '1'), (a, '2'), (b, '3'): out.send(data=text)")
        may_read.set()
        until(lambda: len(heard) == 4)
    assert heard == ['0', '1', '2', '3']


# -- latched messages, restarts, selections


@pytest.mark.parametrize('size', [48, LARGE])
def test_latched_message_reaches_late_reader(node, listener, topic, size):
    image = node.output_channel(topic, IMAGE, latch=True).send(data=os.urandom(size))
    listener.listen(topic)
    assert listener.notes(topic) == expected([image])
    until(lambda: listener.channel(topic, 'connections') == [('/node', SHARED)])


def test_lack_of_memory_files_gives_tcpros(master, node, topic, monkeypatch):
    """If a file cannot be had, the readers of the topic get TCPROS, and the log says so once."""
    with PharosPeer(master.url, 'ear') as ear:
        ear.hear(topic, IMAGE)
        channel = node.output_channel(topic, IMAGE)
        assert channel.connections == [('/ear', 'SHARED_MEMORY')]
        channel.send(data=b'1' * 100_000)

        def fail(*args):
            raise OSError(errno.EMFILE, 'Too many open files')

        with monkeypatch.context() as moment:
            moment.setattr(os, 'memfd_create', fail)
            channel.send(data=b'2' * 1_000_000)  # the message has grown, and needs a new file
            channel.send(data=b'3' * 1_000)
        until(lambda: channel.connections == [('/ear', 'TCPROS')])
        channel.send(data=b'4' * 1_000_000)
        until(
            lambda: ear.value(f'[message.data[:1] for message in heard[{topic!r}]]')[-1:] == [b'4']
        )


def test_restarted_nodes_connect_again(node, listener, topic):
    listener.listen(topic)
    out = node.output_channel(topic, IMAGE)
    send_and_wait(out, topic, [bytes(LARGE)], listener)
    node.stop()
    node.start()
    until(lambda: out.connections == [('/listener', SHARED)], TIMEOUT)
    send_and_wait(out, topic, [bytes(LARGE)], listener)
    listener.run('node.stop(); node.start()')
    until(lambda: out.connections == [('/listener', SHARED)], TIMEOUT)
    send_and_wait(out, topic, [bytes(LARGE)], listener)


@pytest.mark.parametrize('sizes', [[48] * 50, [LARGE], [LARGE, 48]])
def test_last_messages_survive_stop(node, listener, topic, sizes):
    """The reader is late, and gets all that a node sent before it stopped."""
    listener.listen(topic)
    out = node.output_channel(topic, IMAGE)
    send_and_wait(out, topic, [b''], listener)
    listener.pause()
    for size in sizes:
        out.send(data=bytes(size))
    stopping = threading.Thread(target=node.stop)
    stopping.start()
    until(lambda: not node.is_running)
    listener.process.send_signal(signal.SIGCONT)
    stopping.join()
    assert [note[1] for note in listener.notes(topic, 1 + len(sizes))] == [0, *sizes]


def test_slow_subscriber_of_rospy_does_not_fall_behind(node, listener, topic):
    """Without a queue_size it takes one image, and the next one when its callback has ended.

    A channel of the same topic goes on when the subscriber has gone.
    """
    listener.listen(topic)
    listener.run(
        f"""
import threading
gate, heard = threading.Semaphore(0), []
def hear(message):
    heard.append(message.header.seq)
    gate.acquire()
slow = node.ros.Subscriber({topic!r}, message_class({IMAGE!r}), hear)
"""
    )
    out = node.output_channel(topic, IMAGE, queue_size=1)
    until(lambda: out.connections == [('/listener', SHARED)], TIMEOUT)
    for count in range(1, 20):
        listener.pause()  # so its reader gets several at once
        for _ in range(3):
            out.send(data=bytes(HELD_BYTES))
        listener.process.send_signal(signal.SIGCONT)
        until(lambda count=count: listener.value('len(heard)') >= count, TIMEOUT)
        listener.run('gate.release()')
    (last,) = listener.value('heard[-1:]')
    listener.run('slow.unregister(); gate.release()')
    assert last > 3 * 19 - 3 * MAX_FILES
    for _ in range(2):
        out.send(data=b'more')
        until(lambda: listener.numbers(topic)[-1] == out.sent)


def test_publisher_is_heard_after_a_drop(master, node, listener, topic):
    """A message that waits for a slow callback, and is dropped, holds up its publisher no longer."""
    node.queue_bytes = 2 * HELD_BYTES
    names = []
    gate = threading.Semaphore(0)

    def hear(message):
        names.append(message._connection_header['callerid'])
        gate.acquire()

    subscriber = node.ros.Subscriber(topic, pharos.message_class(IMAGE), hear)
    near = create(master, '/near').output_channel(topic, IMAGE)
    listener.run(f'far = node.output_channel({topic!r}, {IMAGE!r})')
    near.send(data=bytes(HELD_BYTES))
    until(lambda: names)
    listener.run(f'far.send(data=bytes({HELD_BYTES}))')
    until(lambda: subscriber.impl.plain_inbox.messages)
    for _ in range(3):
        near.send(data=bytes(HELD_BYTES))
    assert subscriber.impl.plain_inbox.dropped
    for _ in range(9):  # not release(9): Python 3.8 has it not
        gate.release()
    listener.run(f'far.send(data=bytes({HELD_BYTES}))')
    until(lambda: '/listener' in names)


def test_from_and_to_select(master, node, listener, topic):
    listener.listen(topic, from_='/node')
    other = create(master, '/other')
    outs = [each.output_channel(topic, IMAGE) for each in (other, node)]
    with Listener(master.url, 'second') as second:
        second.listen(topic)
        until(lambda: [len(out.connections) for out in outs] == [2, 2])
        for out in outs:
            out.send(data=bytes(300_000), to='/listener')
            out.send(data=b'all')
        assert [note[1] for note in second.notes(topic, 2)] == [3, 3]
        assert [note[1] for note in listener.notes(topic, 2)] == [300_000, 3]
        assert {note[3] for note in listener.notes(topic)} == {'/node'}


# -- readers that do not read, and ends without a word


def test_stopped_reader_gets_newest(master, node, listener, topic):
    with Listener(master.url, 'stopped') as stopped:
        for each in stopped, listener:
            each.listen(topic)
        out = node.output_channel(topic, IMAGE, queue_size=1)
        images = send_and_wait(out, topic, [bytes(LARGE)], stopped, listener)
        stopped.pause()
        datas = [bytes([number]) * LARGE for number in range(1, 21)]
        images += send_and_wait(out, topic, datas, listener)
        stopped.process.send_signal(signal.SIGCONT)
        notes = expected(images)
        assert stopped.notes(topic, 3) == [notes[0], notes[1], notes[20]]
        assert stopped.channel(topic, 'dropped') == 18
        send_and_wait(out, topic, [b'last'], listener)
        stopped.notes(topic, 4)
        assert stopped.channel(topic, 'dropped') == 18
    assert listener.numbers(topic) == list(range(1, 23))


def test_large_message_behind_a_full_socket_comes(master, node, topic):
    with Listener(master.url, 'stopped') as stopped:
        stopped.listen(topic)
        out = node.output_channel(topic, IMAGE)
        send_and_wait(out, topic, [b'first'], stopped)
        for small_count in range(1, 8):  # one of them fills the socket
            stopped.pause()
            for _ in range(small_count):
                out.send(data=bytes(60_000))
            out.send(data=bytes(LARGE))
            stopped.process.send_signal(signal.SIGCONT)
            assert stopped.notes(topic, out.sent)[-1][1] == LARGE


def test_five_stopped_readers_hold_up_nobody(master, node, listener, topic):
    """Each stops at another image, so that together they hold all files."""
    with contextlib.ExitStack() as stack:
        names = [f'stopped{number}' for number in range(5)]
        stopped = [stack.enter_context(Listener(master.url, name)) for name in names]
        for each in [*stopped, listener]:
            each.listen(topic)
        out = node.output_channel(topic, IMAGE)
        send_and_wait(out, topic, [bytes(LARGE)], *stopped, listener)
        for each in stopped:
            each.pause()
            send_and_wait(out, topic, [bytes(LARGE)], listener)
        send_and_wait(out, topic, [bytes(LARGE)] * 20, listener)
        assert listener.numbers(topic) == list(range(1, 27))
        for each in stopped:
            each.process.send_signal(signal.SIGCONT)
        last = f'notes[{topic!r}][-1][1] == 4'
        until(lambda: out.send(data=b'last') and all(each.value(last) for each in stopped), TIMEOUT)
        until(lambda: [kind for _, kind in out.connections] == [SHARED] * 6)
        for each in stopped:
            numbers = each.numbers(topic)  # more of them may come
            assert numbers == sorted(set(numbers))


def test_callback_may_unregister(node, listener, topic):
    """Its connection, which waits for the end of the callback, is read no more."""
    heard = Gate()
    subscriber = node.ros.Subscriber(topic, pharos.message_class(IMAGE), heard)
    listener.run(f'node.output_channel({topic!r}, {IMAGE!r}).send()')
    assert heard.begun.wait(TIMEOUT)
    subscriber.unregister()
    heard.open.set()
    # the threads of the callbacks, and of the reader
    names = re.compile(r'\(loop\)|pharos reader')
    until(lambda: not names.search(str(threading.enumerate())))


def test_stopped_publisher_leaves_no_thread(node, listener, topic):
    listener.listen(topic)
    out = node.output_channel(topic, IMAGE)
    until(lambda: out.connections == [('/listener', SHARED)])
    node.stop()
    assert '/node (' not in str(threading.enumerate())


def test_killed_reader_leaves_nothing(master, node, listener, topic):
    listener.listen(topic)
    out = node.output_channel(topic, IMAGE)
    send_and_wait(out, topic, [bytes(LARGE)], listener)
    threads = threading.active_count()
    for _ in range(3):
        with Listener(master.url, 'doomed') as doomed:
            doomed.listen(topic)
            until(lambda: len(out.connections) == 2)
            until(lambda: out.send(data=bytes(LARGE)) and doomed.value(f'notes[{topic!r}]'))
            doomed.end()
            send_and_wait(out, topic, [bytes(LARGE)] * 5, listener)
        until(lambda: out.connections == [('/listener', SHARED)], TIMEOUT)
    assert listener.numbers(topic, out.sent) == list(range(1, out.sent + 1))
    until(lambda: threading.active_count() <= threads)
    assert len(memory_files(os.getpid())) <= 8  # four files, each a descriptor and a map


def test_killed_publisher_is_replaced(master, node):
    box = Mailbox(node, '/film', IMAGE)
    for _ in range(2):
        with PharosPeer(master.url, 'camera') as camera:
            camera.run(FILMING)
            until(lambda: box.channel.connections == [('/camera', SHARED)], TIMEOUT)
            box.wait_for(lambda message: message.header.seq > 5)
            camera.end()
            until(lambda: not box.channel.connections, TIMEOUT)
            until(lambda: not memory_files(os.getpid()), TIMEOUT)
            for message in box.all():
                data = message.data
                assert (data == data[:4] * (LARGE // 4)) is True


def test_file_of_one_large_message_is_given_back(node, listener, topic):
    listener.listen(topic)
    datas = map(bytes, (LARGE, 100_000, 100_000))
    send_and_wait(node.output_channel(topic, IMAGE), topic, datas, listener)
    paths = [f'/proc/self/fd/{number}' for number in os.listdir('/proc/self/fd')]
    files = [path for path in paths if os.path.realpath(path).startswith('/memfd:pharos')]
    assert files and all(os.stat(path).st_size < LARGE for path in files)


BROKEN = {
    'round': [(Reader, '_take_messages')],
    'call': [(Reader, 'call')],
    'end': [(MemoryReceiver, 'read'), (MemoryReceiver, 'end')],
}


@pytest.mark.parametrize('what', BROKEN)
def test_reader_outlives_an_exception(master, monkeypatch, what):
    """One that is thrown into a call of its loop."""
    heard = Mailbox(create(master, '/ear'), '/words', STRING)
    failed = set()

    def failing_once(function):
        def call(*arguments):
            if function not in failed:
                failed.add(function)
                raise RuntimeError('this look fails')
            return function(*arguments)

        return call

    with PharosPeer(master.url, 'mouth') as mouth:
        mouth.run(f"out = node.output_channel('/words', '{STRING}')")
        until(lambda: mouth.value('out.connections'))
        for owner, name in BROKEN[what]:
            monkeypatch.setattr(owner, name, failing_once(getattr(owner, name)))
        mouth.run("out.send(data='first')")
        until(lambda: len(failed) == len(BROKEN[what]))
        until(lambda: mouth.run("out.send(data='later')") or len(heard.all()) > 1)
        assert heard.all()[-1].data == 'later'


def test_descriptor_of_an_odd_packet_is_closed(master, tmp_path):
    """The connection ends, and comes back."""
    path = str(tmp_path / 'odd')
    heard = Mailbox(create(master, '/ear'), '/words', STRING)
    with PharosPeer(master.url, 'mouth') as mouth:
        mouth.run(f"out = node.output_channel('/words', '{STRING}')")
        until(lambda: mouth.value('out.connections'))
        mouth.run(f"import array, socket; odd = open({path!r}, 'w')")
        mouth.run("files = array.array('i', [odd.fileno()])")
        mouth.run('rights = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, files)]')
        mouth.run("out._publisher.connections[0]._socket.sendmsg([b'odd'], rights)")
        until(lambda: mouth.run("out.send(data='x')") or heard.all())
    files = pathlib.Path('/proc/self/fd').iterdir()
    assert path not in [os.readlink(file) for file in files if file.is_symlink()]
