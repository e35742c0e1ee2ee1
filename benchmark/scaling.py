"""What many nodes, topics and receivers cost, and where they end, measured in a fresh process;
prints its findings as JSON. benchmark/scale starts it, at a counting_master.py.

usage: scaling.py nodes pharos|rospy COUNT SECONDS
       scaling.py topics pharos|rospy COUNT SECONDS
       scaling.py limit nodes|topics WHAT LIMIT COUNT
       scaling.py receivers RATE COUNT
       scaling.py size BYTES
"""
import collections
import contextlib
import ctypes
import json
import os
import pathlib
import re
import resource
import signal
import subprocess
import sys
import threading
import time
import xmlrpc.client

from std_msgs.msg import Int32

clock = time.perf_counter
PATIENCE = 60.0  # seconds for all to be there
# of the clocks of a process, that of what it computes, which /proc has in ticks of 10 ms
CPU_CLOCK = 2
# Who has limits, where this runs as root: a user of no other process, also of none in other containers,
# which the kernel counts and /proc does not show.
NOBODY = 60000 + os.getpid() % 5000
PR_SET_DUMPABLE = 4
QUEUE = 10  # messages that wait for a receiver


def wait_until(holds, what):
    """Look a hundred times a second."""
    deadline = clock() + PATIENCE
    while not holds():
        if clock() > deadline:
            raise SystemExit(f'not in time: {what}')
        time.sleep(0.01)


def master_counts():
    """What the master has been asked so far."""
    return xmlrpc.client.ServerProxy(os.environ['ROS_MASTER_URI']).counts('/scale')[2]


class Use:
    """What processes use, as /proc tells: MB of memory (what they share is divided), threads,
    descriptors, seconds of a processor."""

    def __init__(self, pids):
        self.memory = self.threads = self.descriptors = self.cpu = 0
        for pid in pids:
            folder = pathlib.Path('/proc', str(pid))
            share = re.search(r'^Pss: *(\d+) kB', (folder / 'smaps_rollup').read_text(), re.M)
            self.memory += int(share[1]) / 1e3
            self.threads += len(os.listdir(folder / 'task'))
            self.descriptors += len(os.listdir(folder / 'fd'))
            self.cpu += time.clock_gettime(~pid << 3 | CPU_CLOCK)


def measure(pids, begun, before, asked, seconds):
    """What there is of processes that have just come to rest, and what they do while idle.

    :param begun: when they began to start
    :param before: the Use of what was there before
    :param asked: the counts of the master then
    """
    started, now = clock() - begun, master_counts()
    time.sleep(2.5)  # connections to the master are given back
    use, counts, since = Use(pids), master_counts(), clock()
    time.sleep(seconds)
    later, idle, lasted = Use(pids), master_counts(), clock() - since
    return {
        'start': started,
        'asked to start': now['requests'] - asked['requests'],
        'memory': use.memory - before.memory,
        'threads': use.threads - before.threads,
        'descriptors': use.descriptors,  # all, for there is a limit on them
        'cpu': 100 * (later.cpu - use.cpu) / lasted,
        'requests': (idle['requests'] - counts['requests']) / lasted,
        'bytes': (idle['bytes'] - counts['bytes']) / lasted / 1e3,
        'master': 100 * (idle['cpu'] - counts['cpu']) / lasted,
    }


# -- nodes: a chain, in which each hears its predecessor


def link_of_chain(master, number, heard=None):
    """One more node of pharos."""
    import pharos

    node = master.create(pharos.BlockNode, named=f'/scale/n{number}', domain='127.0.0.1')
    node.output_channel(f'/scale/t{number + 1}', Int32)
    node.interested_in(f'/scale/t{number}', Int32, heard or (lambda message, channel: None))
    return node


def nodes_of_pharos(count, seconds):
    """That many nodes of this process."""
    import pharos

    master = pharos.Master()
    link_of_chain(master, 0).stop()  # what is loaded once per process
    alone, asked, begun = Use([os.getpid()]), master_counts(), clock()
    nodes = [link_of_chain(master, number + 1) for number in range(count)]
    found = measure([os.getpid()], begun, Use([]), asked, seconds)
    added = found['memory'] - alone.memory
    kinds, begun = kinds_of_threads(), clock()
    for node in nodes:
        node.stop()
    return {**found, 'stop': clock() - begun, 'kinds': kinds, 'added': added}


def kinds_of_threads():
    """``{what the threads do: how many}``."""
    names = (re.sub(r'^/\S* |[-\d]*\d', '', thread.name) for thread in threading.enumerate())
    return dict(collections.Counter(names))


def nodes_of_rospy(count, seconds):
    """That many processes, each with a node; all start at once."""
    from rows import end_with_parent

    asked, begun, processes = master_counts(), clock(), []
    try:
        for number in range(count):
            command = [sys.executable, __file__, 'node', str(number)]
            processes.append(
                subprocess.Popen(command, stdout=subprocess.PIPE, preexec_fn=end_with_parent)
            )
        for process in processes:
            # it is registered; all but the last are heard, too
            for _ in range(1 if process is processes[-1] else 2):
                if not process.stdout.readline():
                    raise SystemExit('a node of rospy has ended')
        pids = [process.pid for process in processes]
        found = measure(pids, begun, Use([]), asked, seconds)
    finally:
        begun = clock()
        for process in processes:
            process.send_signal(signal.SIGINT)
        for process in processes:
            process.wait()
    return {**found, 'stop': clock() - begun}


def node_of_rospy(number):
    """One of them, until Ctrl-C; prints a line when it is registered, and one when it is heard."""
    import rospy

    class Heard(rospy.SubscribeListener):
        def peer_subscribe(self, *_):
            print('heard', flush=True)

    rospy.init_node(f'scale_n{number}')
    publisher = rospy.Publisher(
        f'/scale/t{number + 1}', Int32, queue_size=QUEUE, subscriber_listener=Heard()
    )
    rospy.Subscriber(f'/scale/t{number}', Int32, lambda message: None)
    print('registered', flush=True)
    rospy.spin()
    publisher.unregister()


# -- topics: one node publishes on each of them, and hears it


def topics(way, count, seconds):
    """Open so many topics of a node, send a message on each, and see what they cost."""
    heard, all_heard = set(), threading.Event()

    def hear(message, *_):
        heard.add(message.data)
        if len(heard) == count:
            all_heard.set()

    opened, stop = {'pharos': topics_of_pharos, 'rospy': topics_of_rospy}[way]()
    opened(count, lambda *_: None)  # what is loaded once per process
    before, asked, begun = Use([os.getpid()]), master_counts(), clock()
    publishers = [opened(number, hear) for number in range(count)]
    wait_until(lambda: all(map(connections, publishers)), 'connections')
    found = measure([os.getpid()], begun, before, asked, seconds)
    begun = clock()
    for number, publisher in enumerate(publishers):
        publisher.publish(Int32(number))
    if not all_heard.wait(PATIENCE):
        raise SystemExit('not in time: a message on each topic')
    found['round'] = clock() - begun
    begun = clock()
    stop()
    return {**found, 'stop': clock() - begun}


def connections(publisher):
    """How many a channel of pharos, or a Publisher of rospy, has."""
    try:
        return len(publisher.connections)
    except AttributeError:
        return publisher.get_num_connections()


def topics_of_pharos(name='/scale/topics'):
    """``opened(number, heard)``, which returns a Publisher or channel that is heard, and ``stop()``."""
    import pharos

    node = pharos.Master().create(pharos.BlockNode, named=name, domain='127.0.0.1')

    def opened(number, heard=None):
        if heard is not None:
            node.interested_in(f'/scale/t{number}', Int32, heard)
        return node.output_channel(f'/scale/t{number}', Int32)

    return opened, node.stop


def topics_of_rospy():
    """The same."""
    import rospy

    rospy.init_node('scale_topics', disable_signals=True)

    def opened(number, heard):
        rospy.Subscriber(f'/scale/t{number}', Int32, heard)
        return rospy.Publisher(f'/scale/t{number}', Int32, queue_size=QUEUE)

    return opened, lambda: rospy.signal_shutdown('measured')


# -- limits: what happens where there is no more


def limit(kind, what, value, count):
    """Have one more node, or topic of another process, until that cannot be; what was said, and
    whether the others go on."""
    what, value, heard = getattr(resource, f'RLIMIT_{what}'), int(value), threading.Event()
    one_more, send, stop = {'nodes': chain, 'topics': topics_elsewhere}[kind](count, heard)
    if what == resource.RLIMIT_NPROC:
        if os.geteuid() == 0:
            os.setuid(NOBODY)  # root has no such limit
            ctypes.CDLL(None).prctl(PR_SET_DUMPABLE, 1)  # what /proc tells of it stays its own
        value += threads_of_user()
    resource.setrlimit(what, (value, value))
    reached, said = 0, None
    try:
        while reached < count:
            one_more(reached)
            reached += 1
    except Exception as error:
        said = f'{type(error).__name__}: {error}'
    if not reached:
        raise SystemExit(f'not one: {said}')
    own = Use([os.getpid()])
    send()
    goes_on = heard.wait(PATIENCE)
    stop()
    return {
        'reached': reached,
        'said': said,
        'goes on': goes_on,
        'threads': own.threads,
        'descriptors': own.descriptors,
    }


def chain(count, heard):
    """``one_more(number)`` adds a node, ``send()`` has the first be heard, ``stop()`` ends all."""
    import pharos

    master, nodes = pharos.Master(), []

    def one_more(number):
        nodes.append(link_of_chain(master, number, lambda *_: heard.set()))

    def stop():
        for node in nodes:
            node.stop()

    return one_more, lambda: nodes[0].send_to('/scale/t1', data=1), stop


def topics_elsewhere(count, heard):
    """The same of topics that another process publishes, and one node hears."""
    import pharos

    from rows import end_with_parent

    publisher = subprocess.Popen(
        [sys.executable, __file__, 'publisher', str(count)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        preexec_fn=end_with_parent,
    )
    publisher.stdout.readline()
    node = pharos.Master().create(pharos.BlockNode, named='/scale/hearer', domain='127.0.0.1')

    def one_more(number):
        node.interested_in(f'/scale/t{number}', Int32, lambda *_: heard.set())
        wait_until(lambda: node.channels[-1].connections, f'connection {number}')

    def stop():
        node.stop()
        publisher.stdin.close()
        publisher.wait()

    def send():
        publisher.stdin.write(b'\n')
        publisher.stdin.flush()

    return one_more, send, stop


def publish_topics(count):
    """Publish on so many topics; on the first one for each line that comes."""
    _, descriptors = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (descriptors, descriptors))
    opened, stop = topics_of_pharos('/scale/publisher')
    first, *_ = [opened(number) for number in range(count)]
    print('ready', flush=True)
    for _ in sys.stdin:
        first.publish(Int32(1))
    stop()


def threads_of_user():
    """How many threads this user's processes have, to all of which a limit of them is set."""
    count = 0
    for folder in pathlib.Path('/proc').glob('[0-9]*'):
        with contextlib.suppress(OSError):  # it has ended
            if folder.stat().st_uid == os.getuid():
                count += len(os.listdir(folder / 'task'))
    return count


# -- receivers: as many as keep up


def receivers(rate, count):
    """Send to so many nodes for two seconds, and see what is dropped, and who says so."""
    import pharos

    master = pharos.Master()
    sender = master.create(pharos.BlockNode, named='/scale/sender', domain='127.0.0.1')
    channels = [
        master.create(
            pharos.BlockNode, named=f'/scale/r{number}', domain='127.0.0.1'
        ).interested_in('/scale/crowd', Int32, lambda message, channel: None, queue_size=QUEUE)
        for number in range(count)
    ]
    publish = sender.output_channel('/scale/crowd', Int32).publish
    began = due = clock()
    for number in range(2 * rate):
        publish(Int32(number))
        due += 1 / rate
        time.sleep(max(0.0, due - clock()))
    took = clock() - began
    time.sleep(0.5)  # for what waits in the queues
    received, dropped = (
        sum(getattr(each, name) for each in channels) for name in ('received', 'dropped')
    )
    worst = max(channels, key=lambda each: each.dropped)
    said = f'{worst.node.name}: {worst.node.health()}'
    return {
        'sent': 2 * rate,
        'took': took,
        'received': received,
        'dropped': dropped,
        'said': said,
    }


# -- sizes: what is too large


def size(count):
    """Send images of so many bytes, and of 4 GiB, in process; what is said of them."""
    from sensor_msgs.msg import Image

    import pharos

    master, arrived = pharos.Master(), threading.Event()
    sender = master.create(pharos.BlockNode, named='/scale/sender', domain='127.0.0.1')
    heard = master.create(pharos.BlockNode, named='/scale/receiver', domain='127.0.0.1')
    heard.interested_in('/scale/large', Image, lambda *_: arrived.set())
    channel = sender.output_channel('/scale/large', Image)
    said = []
    for number in count, 2**32:
        arrived.clear()
        try:
            channel.publish(Image(data=bytes(number)))
            what = 'arrived' if arrived.wait(PATIENCE) else 'did not arrive'
        except pharos.PharosError as error:
            what = f'{type(error).__name__}: {error}'
        said.append(f'{number} bytes in process: {what}')
    return said


def main():
    """Do as the arguments say."""
    if sys.argv[1] == 'node':
        node_of_rospy(int(sys.argv[2]))
        return
    if sys.argv[1] == 'publisher':
        publish_topics(int(sys.argv[2]))
        return
    answers = os.fdopen(os.dup(1), 'w')
    os.dup2(2, 1)  # what ROS prints is no answer
    what, *words = sys.argv[1:]
    if what == 'nodes':
        found = {'pharos': nodes_of_pharos, 'rospy': nodes_of_rospy}[words[0]](
            int(words[1]), float(words[2])
        )
    elif what == 'topics':
        found = topics(words[0], int(words[1]), float(words[2]))
    elif what == 'limit':
        found = limit(words[0], words[1], int(words[2]), int(words[3]))
    elif what == 'size':
        found = size(int(words[0]))
    else:
        found = receivers(int(words[0]), int(words[1]))
    print(json.dumps(found), file=answers, flush=True)
    os._exit(0)  # all that is measured is over


if __name__ == '__main__':
    main()
