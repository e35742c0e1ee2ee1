"""Load: receivers that are too slow, many nodes and topics, nodes that come and go. tools/soak has
more of each."""
import contextlib
import gc
import json
import os
import random
import struct
import subprocess
import sys
import tracemalloc

import pytest
from sensor_msgs.msg import Image

from helpers import create
from pharos.testing import Mailbox, TIMEOUT
from load import CAMERA, IMAGE_SIZE, TOPICS, Busy, Viewer, camera, image, subscribe
from pharos.intraprocess import inbox
from programs import ROOT, PROGRAMS, Program, environment

COUNT = 40  # images, 37 MB: several times what fits into the buffers of a connection
MARGIN = 10  # images that may be under way, beyond those in queues
PATHS = f"{ROOT / 'src'}:{ROOT / 'test'}"


@contextlib.contextmanager
def few_images_held(count):
    """Within this, no more than so many images' bytes, and the margin, are held at a time."""
    gc.collect()
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < (count + MARGIN) * IMAGE_SIZE
    finally:
        tracemalloc.stop()


# -- a receiver that is too slow


@pytest.fixture(params=['here', 'pharos', 'rospy'])
def receiving(request, master):
    """``receiving(queue_size)`` -> a delegate busy with its first image, and the channel that has
    got COUNT more.

    They come from a node here, or from a pharos or rospy node of another process.
    """

    def receive(queue_size):
        busy = Busy()
        viewer = Viewer(master, busy, queue_size)
        viewer.ask(1)
        assert busy.wait() == 0
        viewer.ask(COUNT)
        viewer.wait_for_all()
        return busy, viewer.channel

    with contextlib.ExitStack() as peers:
        if request.param == 'here':
            camera(master, COUNT)
        else:
            commands = {
                'pharos': ['-c', CAMERA % COUNT],
                'rospy': [PROGRAMS / 'rospy_camera.py', str(COUNT)],
            }
            command = sys.executable, *commands[request.param]
            peers.enter_context(Program(master.url, *command, PYTHONPATH=PATHS))
        yield receive


def test_a_slow_receiver_gets_the_newest_image_next(receiving):
    """With rospy and queue_size=1, it gets each of the 40, the oldest first (ros_comm #536, #1901).

    Its thread does not read from the socket meanwhile, and of what one read brings later, the queue
    keeps the last.
    """
    busy, channel = receiving(queue_size=1)
    busy.go_on()
    assert busy.wait() == COUNT - 1
    busy.go_on()
    assert channel.dropped == COUNT - 1


def test_images_for_a_slow_receiver_do_not_pile_up(receiving):
    with few_images_held(5):
        busy, channel = receiving(queue_size=5)
        assert channel.dropped == COUNT - 5
    for number in range(COUNT - 5, COUNT):
        busy.go_on()
        assert busy.wait() == number
    busy.go_on()


def test_a_receiver_that_turns_slow_gets_an_old_image_once_at_the_most(master, monkeypatch):
    """As long as it is quick, the thread that reads from the socket runs its delegate."""
    monkeypatch.setattr(inbox, 'FAST_CALLBACK', TIMEOUT)
    quick = Mailbox()
    with Program(master.url, sys.executable, '-c', CAMERA % COUNT, PYTHONPATH=PATHS):
        viewer = Viewer(master, quick)
        for _ in range(inbox.FAST_STREAK):
            viewer.ask(1)
            quick.next()
        monkeypatch.setattr(inbox, 'FAST_CALLBACK', 0.0)
        viewer.channel.delegate = busy = Busy()
        viewer.ask(COUNT)
        assert busy.wait() == 0
        busy.go_on()
        if busy.wait() < COUNT - 1:
            viewer.wait_for_all()
            busy.go_on()
            assert busy.wait() == COUNT - 1
        busy.go_on()


# -- a receiver that does not read


def test_a_receiver_that_did_not_read_for_long_gets_the_newest_image(master):
    """What it has missed is dropped here, the oldest first, but for what was with the socket."""
    sender = create(master, '/sender')
    images = sender.output_channel('/load/unread', Image, queue_size=1)
    with subscribe(sender, '/load/unread', Image) as unread, few_images_held(2):
        assert images.wait_for_subscribers(1, TIMEOUT)
        for number in range(COUNT):
            images.publish(image(number))
        numbers = [-1]
        while numbers[-1] < COUNT - 1:
            numbers.append(
                Image().deserialize(unread.read(*struct.unpack('<I', unread.read(4)))).step
            )
        assert len(numbers) < COUNT / 2


# -- many of everything


def run(master, what):
    """What a function of load.py returns, in a process of its own; ``master`` there is a Master
    too."""
    code = f'import json, load, pharos; master = pharos.Master(); print(json.dumps({what}))'
    done = subprocess.run(
        [sys.executable, '-c', code],
        env=environment(master.url, PYTHONPATH=PATHS),
        timeout=6 * TIMEOUT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_nothing_is_lost_among_a_hundred_nodes_and_a_thousand_topics(master):
    counts = run(master, 'load.crowd(master, rounds=5)')
    assert counts['sent'] == counts['delivered'] == 5 * TOPICS
    assert counts['dropped'] == 0


def test_nodes_that_come_and_go_leave_nothing(master):
    seed = int(os.environ.get('PHAROS_LOAD_SEED', 0)) or random.randrange(1, 1 << 32)
    counts = run(master, 'load.come_and_go(master, %d, turns=60)' % seed)
    assert counts['starts'] > 20
    assert counts['calls'] > 5
    assert counts['delivered'] > 50
