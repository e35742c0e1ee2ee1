#!/usr/bin/python3
"""Do to nodes for minutes what the tests do to them for seconds, and print what they have survived.

Bad clients, a master that is killed over and over, peers that are, nodes that come and go, a
hundred nodes and a thousand topics, receivers too slow for images, and, as root, a link that is cut
for a minute. Status 1 if anything is lost, left behind or gone; --seed repeats what was done,
though not when.
"""
import argparse
import collections
import contextlib
import faulthandler
import os
import pathlib
import random
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import xmlrpc.client

from std_msgs.msg import String

from helpers import create
from pharos.testing import until
import load
from fuzz import Fuzz
from pharos import Master, ServiceCallError, node_registry
from programs import Program, environment

HERE = pathlib.Path(__file__).resolve().parent
PATHS = f"{HERE.parent / 'src'}:{HERE}"
RATE = 10000  # messages a second among the thousand topics
CUT = 60  # seconds that a link is down, once that has been noticed
IMAGES = 40  # of 0.9 MB, published at a time
MEMORY_LIMIT = 100e6  # bytes that the process may grow by while images pile up


class Soak:
    """What the stages share: a master, a source of chance, the counts, and the time that each
    has."""

    def __init__(self, master, seed):
        self.master, self.random = master, random.Random(seed)
        self.counts = collections.Counter()
        self._end = 0.0

    def begin(self, seconds):
        self._end = time.monotonic() + seconds

    @property
    def left(self):
        """Seconds that the stage has left."""
        return self._end - time.monotonic()

    def count(self, **counts):
        """Add to counts; a name with underscores is what the table says."""
        self.counts.update({name.replace('_', ' '): number for name, number in counts.items()})

    def sees_messages(self, sent, received):
        self.count(messages_sent=sent, messages_delivered=received, messages_lost=sent - received)
        assert sent == received, '%d messages sent, %d delivered' % (sent, received)


def resident():
    """Memory of this process in bytes."""
    with open('/proc/self/statm') as file:
        return int(file.read().split()[1]) * os.sysconf('SC_PAGESIZE')


# -- the stages


def clients(soak):
    """Mutated handshakes and calls, and clients that say nothing or not all."""
    topic = '/soak/chat'
    node, listener = create(soak.master, '/soak/victim'), create(soak.master, '/soak/listener')
    chat, heard = node.output_channel(topic, String), listener.interested_in(topic, String)
    node.serve('/soak/set', 'std_srvs/SetBool', lambda request: {'success': request.data})
    victim = [(topic, String._type, String._md5sum)], [('/soak/set', '*')]
    while soak.left > 0:
        with contextlib.ExitStack() as silent:
            for number in range(200):
                port, beginning = [(node.tcp_port, b'\0\1'), (node.xmlrpc_port, b'POST / HT')][
                    number % 2
                ]
                client = silent.enter_context(socket.create_connection(('127.0.0.1', port)))
                client.sendall(beginning[: number % 4])
            Fuzz(soak.random.randrange(1 << 32), *victim).attack(
                node.tcp_port, node.xmlrpc_port, 300
            )
            with xmlrpc.client.ServerProxy(node.uri) as proxy:
                assert proxy.getPid('/soak')[0] == 1
            load.subscribe(node, topic, String).close()
            assert (
                soak.master.lookup_service('/soak/set')
                .call(data=True, timeout=load.TIMEOUT)
                .success
            )
        chat.send(data='still there')
        soak.count(bad_clients_tried=300, silent_clients=200)
    until(lambda: heard.received == chat.sent)
    assert not node.errors
    soak.sees_messages(chat.sent, heard.received)


def master_dies(soak):
    """A master that is killed and comes back with an empty registry, while two nodes talk and a
    third comes."""
    embedded = Master.embedded()
    port, slowest = int(embedded.url.rsplit(':', 1)[1].strip('/')), 0.0
    master = Master(embedded.url)
    ours = [create(master, f'/soak/{name}') for name in ('sender', 'receiver')]
    chat, heard = ours[0].output_channel('/soak/chat', String), ours[1].interested_in(
        '/soak/chat', String
    )
    ours[1].serve('/soak/set', 'std_srvs/SetBool', lambda request: {'success': request.data})

    def registrations():
        return [
            sorted(
                (name, node.name)
                for name, users in kind.items()
                for node in ours
                if node.name in users
            )
            for kind in master.system_state()
        ]

    before = registrations()
    try:
        while soak.left > 0:
            with embedded._child as child:
                child.kill()
            for _ in range(100):
                chat.send(data='while the master is away')
            embedded = Master.embedded(port=port)
            back = time.monotonic()
            until(lambda: registrations() == before)
            slowest = max(slowest, time.monotonic() - back)
            with create(master, '/soak/late') as late:
                late.interested_in('/soak/chat', String)
                assert master.lookup_service('/soak/set').call(data=True).success
                chat.send(data='with a new peer')
            soak.count(master_restarts=1)
        assert slowest < 5.0, f'it took {slowest:.1f} s until all was registered again'
        until(lambda: heard.received == chat.sent)
        soak.sees_messages(chat.sent, heard.received)
    finally:
        for node in ours:
            node.stop()
        embedded.stop()


PEERS = [
    '''
import rospy
from std_msgs.msg import String
from std_srvs.srv import Empty
rospy.init_node('peer')
rospy.Subscriber('/soak/to_peer', String, lambda message: None)
rospy.Service('/soak/stuck', Empty, lambda request: print('called', flush=True) or rospy.sleep(3600))
publisher = rospy.Publisher('/soak/from_peer', String, latch=True, queue_size=1)
publisher.publish('hello')
rospy.spin()
''',
    '''
import threading
from pharos import BlockNode, Master, spin
node = Master().create(BlockNode, named='/peer')
node.interested_in('/soak/to_peer', 'std_msgs/String')
node.serve('/soak/stuck', 'std_srvs/Empty', lambda request: print('called', flush=True) or node.sleep(3600))
node.output_channel('/soak/from_peer', 'std_msgs/String', latch=True).send(data='hello')
spin()
''',
]


def peers_die(soak):
    """Peers, of rospy and pharos, that are killed while they publish, listen, and answer a call."""
    node, came = create(soak.master, '/soak/node'), threading.Semaphore(0)
    heard = node.interested_in('/soak/from_peer', String, lambda message, channel: came.release())
    told = node.output_channel('/soak/to_peer', String)

    def call():
        with contextlib.suppress(ServiceCallError):
            soak.master.lookup_service('/soak/stuck').call()
            failures.append('a call to a peer that was killed was answered')

    failures = []
    while soak.left > 0:
        with Program(
            soak.master.url, sys.executable, '-c', soak.random.choice(PEERS), PYTHONPATH=PATHS
        ) as peer:
            assert came.acquire(timeout=load.TIMEOUT) and told.wait_for_subscribers(1, load.TIMEOUT)
            calling = threading.Thread(target=call)
            calling.start()
            peer.wait_for('called')
            peer.end(signal.SIGKILL)
        until(lambda: not heard.connections and not told.connections)
        told.send(data='into the void')
        calling.join(load.TIMEOUT)
        assert not calling.is_alive() and not failures and not node.errors, failures or node.errors
        soak.count(peers_killed=1)


def come_and_go(soak):
    """Nodes that start and stop at random, and talk to each other."""
    while soak.left > 0:
        done = load.come_and_go(soak.master, soak.random.randrange(1 << 32), turns=50)
        soak.count(
            node_starts=done['starts'],
            calls_among_nodes_that_come_and_go=done['calls'],
            messages_among_nodes_that_come_and_go=done['delivered'],
        )


def crowd(soak):
    """A hundred nodes and a thousand topics; nothing that had room may be lost."""
    everybody = load.Crowd(soak.master)
    done = everybody.send(max(1, int(soak.left * RATE / load.TOPICS)), RATE)
    soak.sees_messages(done['sent'], done['delivered'])
    soak.counts['messages a second, among 1,000 topics'] = done['per second']


def images(soak):
    """Images from here and from another process to a receiver that does not keep up: it is to get
    the newest next."""

    def watch(seconds):
        busy = load.Busy()
        viewer, before, end = load.Viewer(soak.master, busy), resident(), soak.left - seconds
        while soak.left > end:
            viewer.ask(1)
            assert busy.wait() == 0
            viewer.ask(IMAGES)
            viewer.wait_for_all()
            busy.go_on()
            assert busy.wait() == IMAGES - 1
            busy.go_on()
            soak.count(images_sent=IMAGES + 1, images_dropped_for_newer_ones=IMAGES - 1)
            assert resident() - before < MEMORY_LIMIT, 'images pile up: %d MB' % (
                (resident() - before) / 1e6
            )
        node_registry.stop_all()

    seconds = soak.left / 2
    load.camera(soak.master, IMAGES)
    watch(seconds)
    with Program(soak.master.url, sys.executable, '-c', load.CAMERA % IMAGES, PYTHONPATH=PATHS):
        watch(seconds)


#: what is done, and how many of 300 seconds it has
STAGES = {clients: 60, master_dies: 60, peers_die: 45, come_and_go: 60, crowd: 60, images: 15}


class LinkCut:
    """A test of test_hosts.py with the package's own time limits and a longer cut; it runs beside
    the stages."""

    def __init__(self):
        self._test = subprocess.Popen(
            [
                sys.executable,
                '-m',
                'pytest',
                '-q',
                '-rs',
                '-p',
                'no:cacheprovider',
                str(HERE / 'test_hosts.py'),
                '-k',
                'silent_loss',
            ],
            env=environment('', PHAROS_TEST_CUT=str(CUT)),
            cwd=HERE.parent,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def outcome(self):
        """Wait for its end; returns whether there could be a cut, and what went wrong, if anything
        did."""
        said, _ = self._test.communicate()
        return ' passed' in said, said if self._test.returncode else None


# -- the whole


def run_stage(soak, stage, seconds):
    """Run it; returns what went wrong, if anything did, and what it left behind."""
    before, begin, failure = load.in_use(), time.monotonic(), None
    soak.begin(seconds)
    try:
        stage(soak)
    except Exception:
        failure = traceback.format_exc()
    node_registry.stop_all()
    with contextlib.suppress(AssertionError):
        until(lambda: load.in_use() == before)
    after = load.in_use()
    if failure is None and after != before:
        failure = f'{before} before, {after} after'
    return failure, (stage.__name__, time.monotonic() - begin, resident() / 1e6, after)


def print_summary(soak, rows, before):
    print(
        '\n%-14s %8s %10s %8s %8s %12s'
        % ('after', 'seconds', 'memory MB', 'threads', 'sockets', 'descriptors')
    )
    for name, seconds, memory, used in [('the beginning', 0, *before), *rows]:
        print('%-14s %8.0f %10.1f %8d %8d %12d' % (name, seconds, memory, *used.values()))
    print()
    for what, number in soak.counts.items():
        print('%-45s %12s' % (what, format(number, ',')))


def parse_arguments():
    parser = argparse.ArgumentParser(
        prog='tools/soak', description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = [stage.__name__ for stage in STAGES] + ['link']
    parser.add_argument(
        '--minutes', type=float, default=5, help='how long, about (default: %(default)s)'
    )
    parser.add_argument(
        '--seed', type=int, default=random.randrange(1, 1 << 32), help='of a run to be repeated'
    )
    parser.add_argument(
        '--only', default=','.join(names), metavar='WORD,...', help='of: %(default)s'
    )
    options = parser.parse_args()
    options.only = re.split(r'[ ,]+', options.only)
    if not set(options.only) <= set(names) or options.minutes <= 0:
        parser.error('there is no such stage, or time')
    return options


def soak_all(options, say):
    """Run the stages; returns the Soak, the rows of its table, what was there at the beginning, and
    the failures."""
    stages = {stage: share for stage, share in STAGES.items() if stage.__name__ in options.only}
    link, rows, failures = LinkCut() if 'link' in options.only else None, [], {}
    with Master.embedded() as master:
        soak = Soak(master, options.seed)
        create(master, '/soak/first').stop()  # what is loaded once per process
        node_registry.stop_all()
        until(lambda: not any('watcher' in thread.name for thread in threading.enumerate()))
        before = resident() / 1e6, load.in_use()
        for stage, share in stages.items():
            seconds = 60 * options.minutes * share / sum(stages.values())
            say('%s: %s (%d s)' % (stage.__name__, stage.__doc__, seconds))
            failure, row = run_stage(soak, stage, seconds)
            rows.append(row)
            if failure:
                failures[stage.__name__] = failure
                say(f'{stage.__name__} FAILED')
        if link:
            say('link: waiting for the end of a cut of %d s' % CUT)
            cut, failure = link.outcome()
            soak.count(**{'link cuts of %d s' % CUT: int(cut)})
            if failure:
                failures['link'] = failure
    return soak, rows, before, failures


def main():
    options, screen = parse_arguments(), sys.stdout
    # started with &, all it starts would ignore Ctrl-C
    signal.signal(signal.SIGINT, signal.default_int_handler)
    load.allow_many_descriptors()
    # if it hangs
    faulthandler.dump_traceback_later(120 * options.minutes + 240, exit=True, file=sys.stderr)
    print('seed %d' % options.seed, flush=True)
    with tempfile.TemporaryDirectory() as folder, open(os.devnull, 'w') as nowhere:
        os.environ.update(ROS_LOG_DIR=folder, ROS_HOSTNAME='127.0.0.1')
        # nodes that bad clients come to have much to say
        with contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
            soak, rows, before, failures = soak_all(
                options, lambda text: screen.isatty() and print('==', text, file=screen, flush=True)
            )
    print_summary(soak, rows, before)
    for name, failure in failures.items():
        print(f'\n{name} FAILED\n{failure}', flush=True)
    if failures:
        sys.exit(
            'tools/soak: failed: %s; --seed %d repeats it' % (', '.join(failures), options.seed)
        )


if __name__ == '__main__':
    main()
