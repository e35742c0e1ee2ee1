"""How nodes and their programs end: by a signal, by themselves, killed, forked or spawned."""
import http.client
import re
import signal
import threading
import xmlrpc.client

import pytest
import rosgraph
import rosnode

from helpers import PYTHON, TIMEOUT, Peer, Program, create, registrations
from pharos import BlockNode
from pharos.testing import Mailbox, until

# seconds; make it 3600 when a second Ctrl-C ends at once (API.md): now, the stop goes on
STOP_TIMEOUT = 2

SIGNALS = pytest.mark.parametrize(
    'number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda number: number.name
)
PREPARED = """
import multiprocessing, os, signal, sys, threading
threading.Thread.isAlive = threading.Thread.is_alive  # the rospy of Debian 11 calls it at its end
import pharos
from pharos import BlockNode, Master

class Careful(BlockNode):
    def stop(self):
        os.write(1, b'begun\\n')
        super().stop()
        threading.Event().wait(0.2)
        os.write(1, b'ended\\n')

def create(name='/program', node_class=BlockNode, **kwargs):
    return Master().create(node_class, named=name, **kwargs)

def ready():
    os.write(1, b'ready\\n')

def ready_when_asleep():
    '''Tell when the main thread has come to its wait.'''
    def look():
        pause, main, same, before = threading.Event(), threading.main_thread().ident, 0, None
        while same < 5:
            frame = sys._current_frames()[main]
            now = id(frame), frame.f_lasti
            same, before = same + 1 if now == before else 0, now
            del frame
            pause.wait(0.02)
        ready()
    threading.Thread(target=look, daemon=True).start()
"""


def counts(running):
    """How often a program has printed each of the lines of Careful."""
    # a traceback may stand before one in its line
    return running.output.count('begun\n'), running.output.count('ended\n')


def ended_by(number):
    """Return the exit status of a program that the signal ended in code of its own."""
    return -number if number == signal.SIGINT else 128 + number


@pytest.fixture
def program(master):
    """Run code as a program, wait until it is ready; nothing of it may stay registered."""
    started = []

    def start(code, command=(), wait_for='ready'):
        started.append(Program([*command, PYTHON, '-u', '-c', PREPARED + code], master.url))
        if wait_for:
            started[-1].expect(wait_for)
        return started[-1]

    yield start
    for each in started:
        each.__exit__()
    assert not any(node.name.startswith('/program') for node in master.nodes())


WAITS = {
    'spin': 'pharos.spin()',
    'every': 'for _ in me.every(3600): pass',
    'sleep': 'me.sleep(3600)',
    'execute': 'me.soul = lambda me: me.sleep(3600); me.execute()',
}
PLAIN = {'event': 'threading.Event().wait()', 'busy loop': 'ready()\nwhile True: pass'}
BEGIN = """
me, other = create(node_class=Careful), create('/program_too')
me.interested_in('/a', 'std_msgs/String')
"""


ENDINGS = [(signal.SIGINT, wait) for wait in WAITS]
ENDINGS += [(signal.SIGTERM, 'spin'), (signal.SIGHUP, 'spin'), (signal.SIGTERM, 'every')]


@pytest.mark.parametrize('number, wait', ENDINGS)
def test_wait_ends_and_program_goes_on(program, number, wait):
    running = program(
        f'{BEGIN}ready_when_asleep()\n{WAITS[wait]}\npharos.spin()\n'
        'print("went on", me.lifecycle.value, other.lifecycle.value)'
    )
    running.signal(number)
    assert running.wait() == 0
    assert 'went on stopped stopped' in running.output
    assert counts(running) == (1, 1)


@SIGNALS
@pytest.mark.parametrize('busy', PLAIN)
def test_plain_code_ends_as_without_nodes(program, number, busy):
    look = '' if 'ready' in PLAIN[busy] else 'ready_when_asleep()\n'
    running = program(BEGIN + look + PLAIN[busy])
    running.signal(number)
    assert running.wait() == ended_by(number)
    assert counts(running) == (1, 1)


def test_soul_says_farewell(program, master):
    heard = Mailbox(create(master, '/wheels'), '/speed', 'std_msgs/Float32')
    running = program(
        """
def drive(me):
    try:
        for _ in me.every(3600):
            me.send_to('/speed', data=1.0)
    finally:
        me.send_to('/speed', data=0.0)
create(soul=drive).fork()
ready_when_asleep()
pharos.spin()
"""
    )
    assert heard.next().data == 1.0
    running.signal(signal.SIGINT)
    assert heard.next().data == 0.0
    assert running.wait() == 0


def test_main_loop_ends_at_its_sleep(program):
    """While the stop waits for a soul, a loop in the main thread does not spin."""
    running = program(
        """
me = create(soul=lambda me: threading.Event().wait(1))
me.fork()
turns = 0
ready_when_asleep()
try:
    while True:
        me.send_to('/speed', typed_as='std_msgs/Float32', data=1.0)
        turns += not me.is_running
        me.sleep(0.1)
except pharos.NodeStoppedError:
    print('turns in the stop:', turns)
"""
    )
    running.signal(signal.SIGINT)
    assert running.wait() == 0
    turns = int(running.output.rpartition('turns in the stop: ')[2])
    assert turns <= 2


HANDLER = 'signal.signal(signal.SIGINT, lambda *_: asked.set())'


@pytest.mark.parametrize('order', [[HANDLER, BEGIN], [BEGIN, HANDLER]], ids=['before', 'after'])
def test_own_handler_is_kept(program, order):
    running = program(
        'asked = threading.Event()\n' + '\n'.join(order) + '\nready()\n'
        'while not asked.wait(0.05): pass\n'
        'print("asked", me.is_running)'
    )
    running.signal(signal.SIGINT)
    assert running.wait() == 0
    assert 'asked True' in running.output


def test_ignored_hangup_stays_ignored(program):
    """As nohup has it."""
    command = 'env', '--ignore-signal=HUP'
    running = program(BEGIN + 'ready_when_asleep()\nthreading.Event().wait()', command)
    running.signal(signal.SIGHUP)
    running.signal(signal.SIGTERM)
    assert running.wait() == ended_by(signal.SIGTERM)


def test_ignored_interrupt_is_taken(program):
    """As rospy does: a shell's & has SIGINT ignored."""
    command = 'env', '--ignore-signal=INT'
    running = program(BEGIN + 'ready_when_asleep()\nthreading.Event().wait()', command)
    running.signal(signal.SIGINT)
    assert running.wait() == ended_by(signal.SIGINT)


def test_loop_in_the_manner_of_rospy_ends_by_its_condition(program):
    text = '''
ready_when_asleep()
while not me.ros.is_shutdown():
    me.sleep(3600)
    while me.lifecycle is not pharos.Lifecycle.STOPPED:  # the end of a long turn
        threading.Event().wait(0.01)
print('motors are off')'''
    running = program(BEGIN + text)
    running.signal(signal.SIGINT)
    assert running.wait() == 0, running.output
    assert 'motors are off' in running.output


def test_second_ctrl_c_ends_the_program(program, master):
    """A soul ignores the stop, which would wait for it."""
    running = program(
        f"""
def ignore(me):
    try:
        me.sleep(3600)
    finally:
        print('stopping', flush=True)
        threading.Event().wait()
me = create(soul=ignore)
me.stop_timeout = {STOP_TIMEOUT}
me.fork()
ready_when_asleep()
pharos.spin()
"""
    )
    running.signal(signal.SIGINT)
    running.expect('stopping')
    running.signal(signal.SIGINT)
    running.wait()
    create(master, '/program').stop()  # takes over what is still registered


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name)
def test_spin_ends_beside_rospys_own_node(program, number):
    """rospy's handlers keep the signal to themselves."""
    running = program(
        'import rospy; rospy.init_node("program_itself")\nme = create()\nready_when_asleep()\n'
        'pharos.spin()\nprint("went on", me.is_running)'
    )
    running.signal(number)
    assert running.wait() == 0
    assert 'went on False' in running.output


def test_node_of_another_thread_is_stopped(program):
    """By Ctrl-C: only the main thread can take other signals."""
    running = program(
        """
thread = threading.Thread(target=create, args=('/program', Careful))
thread.start()
thread.join()
ready_when_asleep()
threading.Event().wait()
"""
    )
    running.signal(signal.SIGINT)
    assert running.wait() == ended_by(signal.SIGINT)
    assert counts(running)[1] == 1


EXITS = {
    '': 0,
    'sys.exit(3)': 3,
    '1 / 0': 1,
    'me.fork(lambda me: [None for _ in me.every(3600)])': 0,
    'me.ros.Timer(me.ros.Duration(0.001), lambda event: None)': 0,
    'threading.Thread(target=me.sleep, args=(3600,), daemon=True).start()': 0,
}


@pytest.mark.parametrize('end', EXITS)
def test_program_without_stop_unregisters(program, end):
    running = program(f'{BEGIN}ready()\n{end}')
    assert running.wait() == EXITS[end]
    assert ('Traceback' in running.output) == (end == '1 / 0')
    assert counts(running)[1] == 1


ENDS = {
    'spin': "ready_when_asleep()\npharos.spin()",
    'wait': "ready_when_asleep()\nthreading.Event().wait()",
    'end of the program': "ready()",
}


@pytest.mark.parametrize('end', ENDS)
def test_nodes_stop_side_by_side(program, end):
    """Each of them waits for its soul."""
    running = program(
        f"""
for number in range(8):
    me = create(f'/program{{number}}', Careful, soul=lambda me: threading.Event().wait())
    me.stop_timeout = 0.5
    me.fork()
{ENDS[end]}
"""
    )
    if end != 'end of the program':
        running.signal(signal.SIGINT)
    running.wait()
    assert re.findall('begun|ended', running.output) == ['begun'] * 8 + ['ended'] * 8


FORK = """
me = create()
back = me.output_channel('/back', 'std_msgs/String')
if os.fork() == 0:
    try:
        me.send_to('/back', data='from the child')
    except Exception:
        print('refused', flush=True)
    {child}
os.wait()
print('child ended', me.is_running, len(me.master.nodes()), flush=True)
back.send(data='from the parent')
"""


@pytest.mark.parametrize('child', ['sys.exit()', 'os._exit(0)', 'me.stop(); sys.exit()'])
def test_forked_child_has_no_nodes(program, master, child):
    heard = Mailbox(create(master, '/tester'), '/back', 'std_msgs/String')
    running = program(FORK.format(child=child), wait_for='child ended True 2')
    assert heard.next().data == 'from the parent'
    assert running.wait() == 0
    assert 'refused' in running.output


SPAWN = """
def child():
    create('/child').send_to('/back', typed_as='std_msgs/String', data='from the child')

if __name__ == '__main__':
    me = create()
    process = multiprocessing.get_context('spawn').Process(target=child)
    process.start()
    process.join()
    me.send_to('/back', typed_as='std_msgs/String', data=f'from the parent {process.exitcode}')
"""


def test_spawned_child_has_its_own_nodes(master, tmp_path):
    heard = Mailbox(create(master, '/tester'), '/back', 'std_msgs/String')
    (tmp_path / 'spawn.py').write_text(PREPARED + SPAWN)
    with Program([PYTHON, str(tmp_path / 'spawn.py')], master.url) as running:
        assert running.wait() == 0, running.output
    assert [heard.next().data for _ in '12'] == ['from the child', 'from the parent 0']


# -- shutdown from outside


def test_rosnode_kill_stops_the_node(master):
    node, other = create(master), create(master, '/other')
    assert rosnode.kill_nodes(['/node']) == (['/node'], [])
    until(lambda: not node.is_running)
    assert other.is_running
    until(lambda: registrations(master, '/node') == [[], [], []])


def test_namesake_from_elsewhere_stops_the_node(master):
    """Another process takes the name: the master tells the node, which ends without a quarrel."""
    node = create(master, '/peer')
    with Peer(master.url) as peer:
        until(lambda: not node.is_running)
        until(lambda: rosnode.rosnode_ping('/peer', max_count=1))
        assert peer.value('rospy.is_shutdown()') is False


def test_namesake_keeps_the_name_while_the_node_stops(master):
    """A node that stops slowly does not register again what the namesake has taken."""
    free = threading.Event()
    uri = 'http://127.0.0.1:1/'  # of the namesake

    class Slow(BlockNode):
        def stop(self):
            free.wait(TIMEOUT)
            super().stop()

    create(master, '/node', node_class=Slow)
    other = create(master, '/other')
    other.output_channel('/topic', 'std_msgs/String')
    rosgraph.Master('/node', master.url).registerService('/service', 'rosrpc://127.0.0.1:1', uri)
    rosgraph.Master('/other', master.url).unregisterPublisher('/topic', other.uri)
    until(lambda: master.topic('/topic').publishers == ['/other'])  # it is registered again
    assert master.call('lookupNode', '/node') == uri
    rosgraph.Master('/node', master.url).unregisterService('/service', 'rosrpc://127.0.0.1:1')
    free.set()


@pytest.mark.parametrize('obeys', [False, True])
def test_other_hosts_stop_a_node_if_it_allows_that(master, monkeypatch, obeys):
    monkeypatch.setattr('pharos.private_rospy.patches.is_local_address', lambda host: False)
    node = create(master)
    node.allow_remote_shutdown = obeys

    class Elsewhere(xmlrpc.client.Transport):
        def make_connection(self, host):
            return http.client.HTTPConnection(host, source_address=('127.0.0.2', 0))

    with xmlrpc.client.ServerProxy(node.uri, Elsewhere()) as proxy:
        code, _, _ = proxy.shutdown('/elsewhere', 'end')
    assert code == int(obeys)
    if obeys:
        until(lambda: not node.is_running)


def test_interrupted_stop_is_done_all_the_same(master):
    text = '''
import threading, pharos
over = threading.Event()
def linger(me):
    try:
        me.sleep(3600)
    finally:
        print('lingers')
        over.wait()
me = pharos.Master().create(pharos.BlockNode, 'me', soul=linger)
me.stop_timeout = 3600
me.fork()
try:
    me.stop()
except KeyboardInterrupt:
    over.set()
'''
    with Program(text, master.url) as running:
        running.expect('lingers')
        running.signal(signal.SIGINT)
        assert running.wait() == 0
    assert not any(master.system_state())


def test_ctrl_c_in_a_soul_of_the_main_thread_ends_the_program(master):
    text = '''
import threading, pharos
me = pharos.Master().create(pharos.BlockNode, 'me')
me.soul = lambda me: [print('ready'), threading.Event().wait()]
me.execute()
print('went on')
'''
    with Program(text, master.url) as running:
        running.expect('ready')
        running.signal(signal.SIGINT)
        assert running.wait() == -signal.SIGINT
    assert 'went on' not in running.output


def test_spin_lasts_while_the_only_node_restarts(master):
    text = '''
import threading, time, pharos
class Slow(pharos.BlockNode):
    def start(self):
        time.sleep(0.2)
        super().start()
node = pharos.Master().create(Slow, 'me')
threading.Thread(target=lambda: [node.restart(), print('restarted'), node.stop()]).start()
pharos.spin()
print('over')
'''
    with Program(text, master.url) as running:
        assert running.wait() == 0
    assert running.output.split() == ['restarted', 'over']
