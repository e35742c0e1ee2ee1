"""How programs with nodes end: by Ctrl-C, by SIGTERM, or by themselves; nothing stays
registered."""
import signal
import sys
import threading

import pytest
import rosmaster.master_api

from pharos.testing import Mailbox, TIMEOUT
from helpers import create
from pharos import BlockNode
from programs import PROGRAMS, Program

SIGNALS = pytest.mark.parametrize(
    'with_signal', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda number: number.name
)

HANDLED_BY_ROSPY = pytest.mark.parametrize(
    'with_signal', [signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name
)

PREPARED = (PROGRAMS / 'prepared.py').read_text()


@pytest.fixture
def program(master):
    """Runs the code given as a program; afterwards, nothing of it may be registered."""
    started = []

    def start(code, wait_for='ready'):
        started.append(Program(master.url, sys.executable, '-c', PREPARED + code))
        if wait_for:
            started[-1].wait_for(wait_for)
        return started[-1]

    yield start
    for each in started:
        each.end(signal.SIGKILL)
    assert [
        name
        for kind in master.system_state()
        for names in kind.values()
        for name in names
        if name.startswith('/program')
    ] == []


def ended_by(with_signal):
    """The exit status of a program that the signal ended while it did something of its own."""
    return -signal.SIGINT if with_signal == signal.SIGINT else 128 + with_signal


# -- signals

WAITS = {
    'spin': 'pharos.spin()',
    'every': 'for _ in me.every(3600): pass',
    'sleep': 'me.sleep(3600)',
    'a soul': 'me.soul = lambda me: me.sleep(3600); me.execute()',
}


@SIGNALS
@pytest.mark.parametrize('wait', WAITS.values(), ids=WAITS)
def test_a_wait_of_ours_ends_and_the_program_goes_on(program, with_signal, wait):
    running = program(
        'me, other = node(), node("/program_too")\nready_in_wait()\n'
        + wait
        + '\npharos.spin()\nprint("went on", me.lifecycle.value, other.lifecycle.value)'
    )
    assert running.end(with_signal) == 0
    assert 'went on stopped stopped' in running.read_to_the_end()


LOOKS = {
    'describe': 'other.describe(3600)',
    'graph': 'me.master.graph(3600)',
    'top': 'importlib.import_module("pharos.live.top").measure(me.master, 3600)',
}
LOOKING = """
import importlib
me, other = node(), node("/program_too")
other.interested_in("/looked_at", "std_msgs/String")
me.output_channel("/looked_at", "std_msgs/String")
ready_in_wait()
"""


@SIGNALS
@pytest.mark.parametrize('look', LOOKS.values(), ids=LOOKS)
def test_a_look_is_ended_as_plain_code(program, with_signal, look):
    running = program(LOOKING + look)
    assert running.end(with_signal) == ended_by(with_signal)


@HANDLED_BY_ROSPY
def test_a_look_ends_where_the_program_is_a_rospy_node_itself(program, with_signal):
    running = program('import rospy; rospy.init_node("program_itself")' + LOOKING + LOOKS['graph'])
    # rospy keeps Ctrl-C to itself: the look ends with a NodeStoppedError then
    assert running.end(with_signal) == (1 if with_signal == signal.SIGINT else 128 + with_signal)


@HANDLED_BY_ROSPY
@pytest.mark.parametrize('first', ['rospy', 'pharos'])
def test_spin_ends_where_the_program_is_a_rospy_node_itself(program, with_signal, first):
    """rospy's handlers of signals keep Ctrl-C to themselves."""
    begin = ['rospy.init_node("program_itself")', 'me = node()']
    running = program(
        'import rospy\n'
        + '\n'.join(begin if first == 'rospy' else begin[::-1])
        + '\nready_in_wait()\npharos.spin()\nprint("went on", me.lifecycle.value)'
    )
    assert running.end(with_signal) == 0
    assert 'went on stopped' in running.read_to_the_end()


@SIGNALS
@pytest.mark.parametrize('busy', ['wait_for(threading.Event())', 'while True: pass'])
def test_plain_code_is_ended_as_without_nodes(program, with_signal, busy):
    running = program('me = node()\nready()\n' + busy)
    assert running.end(with_signal) == ended_by(with_signal)


@pytest.mark.parametrize(
    'line',
    [
        'ready()\n    wait_for(threading.Event())',
        'ready_in_wait()\n    me.sleep(3600)',
        'ready_in_wait()\n    me.execute()',
        'ready_in_wait()\n    pharos.spin()',
        'ready_in_wait()\n    me.master.graph(3600)',
    ],
)
def test_ctrl_c_at_the_prompt_ends_the_line_and_no_node(program, line):
    """It was silent, and all nodes were gone, when a line was mistyped and given up."""
    running = program(
        f"""
sys.ps1 = '>>> '
me = node(soul=lambda me: [None for _ in me.every(3600)])
try:
    {line}
except KeyboardInterrupt:
    print('interrupted', me.lifecycle.value, flush=True)
"""
    )
    running.process.send_signal(signal.SIGINT)
    running.wait_for('interrupted running')
    assert running.process.wait(TIMEOUT) == 0


def test_ctrl_c_at_the_prompt_ends_each_line_though_what_was_said_of_the_last_one_comes_late(
    program,
):
    """What ends a line is said to the main thread again and again, and may be said for the last time
    as the line ends, after which IPython ignores Ctrl-C until the next one: that of the next line was
    lost."""
    running = program(
        """
sys.ps1 = '>>> '
me = node()
kill, asked, next_line, killed = signal.pthread_kill, *(threading.Event() for _ in range(3))
def kill_late(*arguments):
    asked.set()
    next_line.wait()
    kill(*arguments)
    killed.set()
signal.pthread_kill = kill_late
def line(wait):
    try:
        with pharos.signals.held():
            signal.raise_signal(signal.SIGINT)
            wait()
    except KeyboardInterrupt:
        print('interrupted', flush=True)
line(asked.wait)
handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
next_line.set()
killed.wait()
signal.signal(signal.SIGINT, handler)
line(lambda: None)
""",
        wait_for=None,
    )
    assert running.read_to_the_end().split() == ['interrupted'] * 2
    assert running.process.wait(TIMEOUT) == 0


def test_sigterm_at_the_prompt_ends_spin_and_the_nodes(program):
    running = program(
        """
sys.ps1 = '>>> '
me = node()
ready_in_wait()
pharos.spin()
print('went on', me.lifecycle.value)
"""
    )
    assert running.end(signal.SIGTERM) == 0
    assert 'went on stopped' in running.read_to_the_end()


@SIGNALS
def test_a_signal_before_the_first_node_is_pythons(program, with_signal):
    running = program('ready(); wait_for(threading.Event())')
    assert running.end(with_signal) == -with_signal


@SIGNALS
def test_a_soul_says_farewell(program, master, with_signal):
    heard = Mailbox()
    with master.create(BlockNode, named='/wheels', domain='127.0.0.1', delegate=heard) as wheels:
        wheels.interested_in('/speed', 'std_msgs/Float32')
        running = program(
            """
def drive(me):
    try:
        for _ in me.every(3600):
            me.send_to('/speed', data=1.0)
    finally:
        me.send_to('/speed', data=0.0)
node(soul=drive).fork()
pharos.spin()
""",
            wait_for=None,
        )
        assert heard.next().data == 1.0
        assert running.end(with_signal) == 0
        assert heard.next().data == 0.0


def test_a_handler_that_the_program_had_before_is_kept(program):
    running = program(
        """
asked = threading.Event()
signal.signal(signal.SIGINT, lambda *signal: asked.set())
me = node()
ready()
wait_for(asked)
print('asked', me.lifecycle.value)
"""
    )
    assert running.end(signal.SIGINT) == 0
    assert 'asked running' in running.read_to_the_end()


def test_a_handler_that_the_program_sets_afterwards_is_kept(program):
    running = program(
        """
me, asked = node(), threading.Event()
signal.signal(signal.SIGTERM, lambda *signal: asked.set())
node('/program_too')
ready()
wait_for(asked)
print('asked', me.lifecycle.value)
"""
    )
    assert running.end(signal.SIGTERM) == 0
    assert 'asked running' in running.read_to_the_end()


def test_a_signal_that_the_program_ignores_stays_ignored(program):
    """As nohup and a shell's & have it."""
    running = program(
        """
signal.signal(signal.SIGINT, signal.SIG_IGN)
me = node()
ready_in_wait()
pharos.spin()
"""
    )
    running.process.send_signal(signal.SIGINT)
    assert running.end(signal.SIGTERM) == 0


def test_a_node_of_another_thread_leaves_the_signals_alone(program):
    """Only the main thread may set handlers; spin() stops the nodes all the same on Ctrl-C."""
    running = program(
        """
thread = threading.Thread(target=node)
thread.start()
thread.join()
assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
ready_in_wait()
pharos.spin()
"""
    )
    assert running.end(signal.SIGINT) == 0


@SIGNALS
def test_a_node_of_another_thread_is_stopped(program, with_signal):
    running = program(
        """
thread = threading.Thread(target=node)
thread.start()
thread.join()
ready()
wait_for(threading.Event())
"""
    )
    assert running.end(with_signal) == ended_by(with_signal)


@SIGNALS
def test_a_signal_after_the_last_node_is_pythons(program, with_signal):
    running = program('node().stop(); ready(); wait_for(threading.Event())')
    assert running.end(with_signal) == -with_signal


def test_sighup_is_ignored_as_nohup_has_it(program):
    running = program(
        """
import os
os.execv(sys.executable, [sys.executable, '-c', 'import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN); '
    'import pharos; me = pharos.Master().create(pharos.BlockNode, "/program"); '
    'print("ready", flush=True); pharos.spin()'])
"""
    )
    running.process.send_signal(signal.SIGHUP)
    assert running.end(signal.SIGTERM) in (0, ended_by(signal.SIGTERM))  # in spin(), or just before


@SIGNALS
def test_what_a_signal_has_ended_is_not_kept(program, with_signal):
    running = program(
        """
import weakref

class Thing:
    pass

def work():
    node()
    thing = Thing()
    kept.append(weakref.ref(thing))
    ready()
    wait_for(threading.Event())

kept = []
try:
    work()
except (KeyboardInterrupt, SystemExit):
    pass
print('freed' if kept[0]() is None else 'kept')
"""
    )
    assert running.end(with_signal) == 0
    assert 'freed' in running.read_to_the_end()


CAREFUL = """
import os
class Careful(pharos.Node):
    def stop(self):
        os.write(1, b'\\nbegun\\n')    # at once, and on a line of its own, beside a traceback of the main thread
        super().stop()
        threading.Event().wait(0.3)    # other threads go on meanwhile
        os.write(1, b'\\nended\\n')
me = Master().create(Careful, named='/program', domain='127.0.0.1')
"""
CAREFUL_ENDS = {
    **WAITS,
    'plain code': 'ready(); wait_for(threading.Event())',
    'its own with block': 'with me: ready(); wait_for(threading.Event())',
    'a stop by itself': (
        'threading.Thread(target=lambda: (me.latest_run.rospy.ended.wait(), ready())).start(); '
        'me.stop()'
    ),
    'a stop of a soul': 'me.fork(lambda me: (ready(), me.stop())); pharos.spin()',
}


@SIGNALS
@pytest.mark.parametrize('end', CAREFUL_ENDS.values(), ids=CAREFUL_ENDS)
def test_an_overridden_stop_runs_once_to_its_end(program, with_signal, end):
    running = program(CAREFUL + ('ready_in_wait()\n' if end in WAITS.values() else '') + end)
    assert running.end(with_signal) in (0, ended_by(with_signal))
    printed = running.read_to_the_end().split('\n')  # by lines: a traceback may show the code, too
    assert (printed.count('begun'), printed.count('ended')) == (1, 1)


def test_an_overridden_stop_runs_to_its_end_when_the_program_ends(program):
    running = program(
        CAREFUL + 'me.fork(lambda me: me.stop()); me.latest_run.rospy.ended.wait(); ready()'
    )
    assert running.process.wait(60) == 0
    printed = running.read_to_the_end().split('\n')  # by lines: a traceback may show the code, too
    assert (printed.count('begun'), printed.count('ended')) == (1, 1)


@SIGNALS
def test_a_signal_ends_a_start(program, with_signal):
    """At a master that says nothing, which takes seconds."""
    running = program(
        """
import socket
silent = socket.create_server(('127.0.0.1', 0))
def tell():
    silent.accept()
    ready()
    threading.Event().wait()
threading.Thread(target=tell, daemon=True).start()
Master('http://127.0.0.1:%d' % silent.getsockname()[1]).create(BlockNode, named='/program')
"""
    )
    assert running.end(with_signal) == ended_by(with_signal)


def test_a_second_ctrl_c_while_the_nodes_stop_does_no_harm(program):
    running = program(
        """
me = node(soul=lambda me: threading.Event().wait(60))
me.stop_timeout = 0.5
me.fork()
threading.Thread(target=lambda: (me.latest_run.rospy.ended.wait(), print('stopping', flush=True)), daemon=True).start()
ready_in_wait()
pharos.spin()
"""
    )
    running.process.send_signal(signal.SIGINT)
    running.wait_for('stopping')
    assert running.end(signal.SIGINT) == 0


@SIGNALS
@pytest.mark.parametrize(
    'busy', ['', 'wait_for(threading.Event())'], ids=['at its end', 'ended by a signal']
)
def test_signals_while_the_program_ends_cut_nothing_off(program, with_signal, busy):
    running = program(
        f"""
def goes_on():
    while not pharos.signals._holds:    # the main thread may be on its way to the end still
        threading.Event().wait(0.001)
    print('stopping', flush=True)
    wait_for(go_on)
    print('stopped', flush=True)
go_on = threading.Event()
me = node()
me.ros.on_shutdown(goes_on)
pharos.node_registry.at_end(lambda: print('other ended', flush=True))
def go():
    while pharos.signals._coming is None:
        threading.Event().wait(0.001)
    print('kept', flush=True)
    go_on.set()
threading.Thread(target=go, daemon=True).start()
ready()
{busy}
"""
    )
    if busy:
        running.process.send_signal(with_signal)
    running.wait_for('stopping')
    running.process.send_signal(with_signal)
    running.wait_for('kept')
    running.wait_for('other ended')
    running.end(signal.SIGCONT)
    printed = running.read_to_the_end()
    assert 'stopped' in printed.split('\n')
    assert 'atexit' not in printed


def test_a_signal_that_wakes_nobody_is_handled_while_the_program_ends(program):
    """Python handles it in the main thread, which goes on waiting where another thread got it, or
    where it came just before the wait."""
    running = program(
        """
pharos.node_registry.STOP_LIMIT = 3600
def goes_on():
    while not pharos.signals._holds:    # the main thread may be on its way to the end still
        threading.Event().wait(0.001)
    signal.pthread_kill(threading.get_ident(), signal.SIGTERM)
    while pharos.signals._coming is None:
        threading.Event().wait(0.001)
    print('handled', flush=True)
me = node()
me.ros.on_shutdown(goes_on)
ready()
"""
    )
    running.wait_for('handled')
    assert running.process.wait(TIMEOUT) == 0


def test_a_signal_that_wakes_nobody_ends_a_wait_for_subscribers(program):
    running = program(
        """
me = node()
channel = me.output_channel('/wakes_nobody', 'std_msgs/Empty')
def end():
    while not me.latest_run.rospy.lifetime.interruptions:
        threading.Event().wait(0.001)
    signal.pthread_kill(threading.get_ident(), signal.SIGTERM)
threading.Thread(target=end, daemon=True).start()
ready()
channel.wait_for_subscribers()
"""
    )
    assert running.process.wait(TIMEOUT) in (0, ended_by(signal.SIGTERM))


def test_what_else_is_to_end_with_the_program_does_though_one_cannot(program):
    running = program(
        """
pharos.node_registry.at_end(lambda: print('other ended', flush=True))
pharos.node_registry.at_end(lambda: 1 / 0)
ready()
"""
    )
    running.wait_for('other ended')
    assert 'ZeroDivisionError' in running.read_to_the_end()


# -- while the main thread runs a block

BLOCKS = {
    'a soul': 'me.soul = lambda me: busy()\nme.execute()',
    'a delegate': """
me.interested_in('/busy', 'std_msgs/Empty', delegate=lambda message, channel: busy(), inline=True)
me.send_to('/busy')""",
    'a service block': """
me.serve('/busy', 'std_srvs/Empty', lambda request: busy())
me.master.lookup_service('/busy').call()""",
    'a service of rospy': """
me.ros.Service('/busy', pharos.service_class('std_srvs/Empty'), lambda request: busy())
me.master.lookup_service('/busy').call()""",
    'a parameter block': 'me.parameter("~busy").on_change(lambda value: busy())\nme.parameter("~busy").set(1)',
    'a receiver': 'pharos.Transcript.on_show(lambda text: busy())\npharos.Transcript.show("it")',
}
BUSY = '''
def busy():
    ready()
    while True: pass
me = node()
'''


@SIGNALS
@pytest.mark.parametrize('block', BLOCKS.values(), ids=BLOCKS)
def test_a_signal_ends_the_program_out_of_a_block(program, with_signal, block):
    assert program(BUSY + block).end(with_signal) == ended_by(with_signal)


@pytest.mark.parametrize('block', BLOCKS.values(), ids=BLOCKS)
def test_what_a_handler_of_the_programs_own_raises_ends_it_out_of_a_block(program, block):
    handled = BUSY + 'signal.signal(signal.SIGTERM, lambda *signal: sys.exit(3))\n'
    assert program(handled + block).end(signal.SIGTERM) == 3


def test_ctrl_c_as_python_has_it_ends_a_block(program):
    handled = BUSY + 'signal.signal(signal.SIGINT, signal.default_int_handler)\n'
    running = program(handled + 'me.soul = lambda me: busy()\nme.execute()')
    assert running.end(signal.SIGINT) == -signal.SIGINT


def test_a_block_that_raises_what_a_signal_would_ends_nothing(program):
    running = program(
        """
def block(*args):
    raise KeyboardInterrupt
me = node(soul=block, delegate=block)
me.execute()
me.interested_in('/interrupts', 'std_msgs/Empty', inline=True)
me.send_to('/interrupts')
print('went on', *map(type, me.errors))
ready()
"""
    )
    assert running.read_to_the_end().count("<class 'KeyboardInterrupt'>") == 2
    assert running.process.wait(60) == 0


# -- ends without a signal


@pytest.mark.parametrize(
    'code, status',
    [
        ('', 0),
        ('sys.exit(3)', 3),
        ('1 / 0', 1),
        ('pharos.Transcript.show("done")', 0),
        ('me.stop()', 0),
        ('me.fork(lambda me: [None for _ in me.every(3600)])', 0),
        ('me.fork(lambda me: me.send_to("/a", data="x", typed_as="std_msgs/String"))', 0),
        ('me.ros_import("actionlib")', 0),
        ('me.ros.Timer(me.ros.Duration(0.001), lambda event: None)', 0),
        ('threading.Thread(target=me.sleep, args=(3600,), daemon=True).start()', 0),
    ],
)
def test_a_script_ends_with_its_nodes_running(program, code, status):
    running = program(
        """
me, other = node(), node('/program_too')
me.interested_in('/a', 'std_msgs/String')
other.serve('/b', 'std_srvs/Empty', lambda request: None)
ready()
"""
        + code
    )
    printed = running.read_to_the_end()
    assert running.process.wait(60) == status
    assert ('Traceback' in printed) == (status == 1)


def test_spin_without_nodes_returns_at_once(program):
    assert program('pharos.spin(); ready()').process.wait(60) == 0


def test_spin_returns_when_the_last_node_has_stopped(program):
    running = program(
        """
me, other = node(), node('/program_too')
me.stop()
other.fork(lambda other: (ready(), other.ros.signal_shutdown('done')))
pharos.spin()
"""
    )
    running.read_to_the_end()
    assert running.process.wait(60) == 0


# -- while the main thread runs code of ours

CALLS = {
    'asks for the nodes': 'me.master.nodes()',
    'logs': 'me.log("it")',
}


@SIGNALS
@pytest.mark.parametrize('call', CALLS.values(), ids=CALLS)
def test_a_signal_leaves_no_lock_held(program, with_signal, call):
    """It comes when the main thread has taken a lock, and has not yet begun what releases it."""
    running = program(
        f"""
class Lock:
    def __init__(self, lock):
        self.lock = lock
        self.release = lock.release
    def acquire(self, *args):
        taken = self.lock.acquire(*args)
        global is_armed
        if is_armed and threading.current_thread() is threading.main_thread():
            is_armed = False
            signal.raise_signal({int(with_signal)})
        return taken
    def __enter__(self):
        return self.acquire()
    def __exit__(self, *error):
        self.release()
    def __getattr__(self, name):
        return getattr(self.lock, name)
is_armed = False
me = node()
pharos.node_registry.changed = Lock(pharos.node_registry.changed)
for handler in me.ros.impl.rosout.logging.getLogger('rosout').handlers:
    handler.lock = Lock(handler.lock)
ready()
is_armed = True
while True:
    {call}
"""
    )
    assert running.process.wait(TIMEOUT) == ended_by(with_signal)


OPENERS = {
    'registerPublisher': "me.output_channel('/torn', 'std_msgs/Empty')",
    'registerSubscriber': "me.interested_in('/torn', 'std_msgs/Empty')",
    'registerService': "me.serve('/torn', 'std_srvs/Empty', print)",
}


@SIGNALS
@pytest.mark.parametrize('call', OPENERS)
def test_a_signal_tears_up_no_registration(program, monkeypatch, with_signal, call):
    asked, go_on = threading.Event(), threading.Event()
    register = getattr(rosmaster.master_api.ROSMasterHandler, call)

    def wait_and_register(self, caller_id, name, *arguments):
        if name == '/torn':
            asked.set()
            go_on.wait(TIMEOUT)
        return register(self, caller_id, name, *arguments)

    monkeypatch.setattr(rosmaster.master_api.ROSMasterHandler, call, wait_and_register)
    running = program(
        f"""
me = node()
me.ros.on_shutdown(lambda: print('stopping', flush=True))
ready()
{OPENERS[call]}
threading.Event().wait()
"""
    )
    assert asked.wait(TIMEOUT)
    running.process.send_signal(with_signal)
    running.wait_for('stopping')
    go_on.set()
    assert running.process.wait(TIMEOUT) == ended_by(with_signal)


@SIGNALS
def test_a_signal_is_not_lost_in_a_finalizer(program, with_signal):
    """Python drops what is raised there."""
    running = program(
        f"""
class Finalized:
    def __del__(self):
        signal.raise_signal({int(with_signal)})
me = node()
def block(text):
    Finalized()
pharos.Transcript.on_show(block)
ready()
pharos.Transcript.show('it')
threading.Event().wait()
"""
    )
    assert running.process.wait(TIMEOUT) == ended_by(with_signal)


def test_what_a_handler_of_the_program_raises_in_an_inline_delegate_reaches_who_publishes(
    master,
):
    class TimeIsUp(Exception):
        """What the program ends a call with."""

    def ring(number, frame):
        raise TimeIsUp

    channel = create(master, '/sender').output_channel('/alarm', 'std_msgs/Empty')
    receiver = create(master, '/receiver')
    receiver.interested_in(
        '/alarm', delegate=lambda *_: signal.raise_signal(signal.SIGALRM), inline=True
    )
    before = signal.signal(signal.SIGALRM, ring)
    try:
        with pytest.raises(TimeIsUp):
            channel.send()
    finally:
        signal.signal(signal.SIGALRM, before)
    assert not receiver.errors
