"""Behaviour whose loss would hurt a robot; each test fails with exactly one change of the source."""
import contextlib
import gc
import http.client
import os
import signal
import sys
import threading
import types
import weakref
import xmlrpc.client

import pytest
import rosgraph_msgs.msg
import rospy
import std_msgs.msg

import pharos
from helpers import INIT, SPIN, TIMEOUT, Gate, Peer, PharosPeer, Program, create, end, free_port
from pharos import Node, NodeNameInUseError, NodeStoppedError, PharosError
from pharos.intraprocess.callback_queues import CallbackQueue
from pharos.private_rospy.run import Run
from pharos.private_rospy.topics import PublisherOverlay
from pharos.shared_memory.receiving import Reader
from pharos.testing import Mailbox, until

STRING = 'std_msgs/String'


@pytest.fixture
def node(master):
    return create(master)


# -- what waits, and what has ended


class Hasty(pharos.BlockNode):
    stop_timeout = 0.05


def fill(master):
    """Return a node, its gate and channel, and a sender; one message is in the gate, and two wait."""
    gate, ear, mouth = Gate(), create(master, '/ear', Hasty), create(master, '/mouth')
    channel = ear.interested_in('/words', STRING, gate)
    for word in 'first', 'old', 'older':
        mouth.send_to('/words', typed_as=STRING, data=word)
    assert gate.begun.wait(TIMEOUT)
    return ear, gate, channel, mouth


def test_restarted_node_hears_no_old_message(master):
    ear, gate, _, mouth = fill(master)
    ear.stop()
    gate.open.set()
    ear.start()
    mouth.send_to('/words', data='new')
    gate.wait_for(lambda message: message.data == 'new')
    assert gate.heard == ['first', 'new']


def test_stop_drops_what_waits(master):
    ear, gate, channel, _ = fill(master)
    ear.stop_timeout = TIMEOUT
    stopping = threading.Thread(target=ear.stop)
    stopping.start()
    until(lambda: channel.callback_queue.closed)
    gate.open.set()
    stopping.join(TIMEOUT)
    assert gate.heard == ['first']


def test_closed_channel_drops_what_waits(master):
    ear, gate, channel, mouth = fill(master)
    after = Mailbox(ear, '/after', STRING)
    channel.close()
    gate.open.set()
    mouth.send_to('/after', typed_as=STRING, data='x')
    after.next()  # delegates of a node run in order
    assert gate.heard == ['first']


def test_failed_start_keeps_channels(master, node):
    box = Mailbox(node, '/words', STRING)
    node.stop()
    with create(master, '/node'):
        with pytest.raises(NodeNameInUseError):
            node.start()
    node.start()
    create(master, '/other').send_to('/words', typed_as=STRING, data='x')
    assert box.next().data == 'x'


def test_ended_soul_is_not_run_again(node):
    ran, begun = [], threading.Semaphore(0)
    node.fork(lambda me: ran.append(1)).join(TIMEOUT)
    node.fork(lambda me: (begun.release(), me.sleep(3600)))
    assert begun.acquire(timeout=TIMEOUT)
    node.restart()
    assert begun.acquire(timeout=TIMEOUT)
    assert ran == [1]


def test_stop_ends_call_of_soul(master, node, peer):
    peer.run(
        'from std_srvs.srv import Empty\ncalled = []\n'
        "hang = rospy.Service('/hang', Empty, lambda request: called.append(1) or rospy.sleep(3600))"
    )
    node.stop_timeout = TIMEOUT
    thread = node.fork(lambda me: me.wait_for_service('/hang', TIMEOUT).call())
    until(lambda: peer.value('called'))
    stopping = threading.Thread(target=node.stop, daemon=True)
    stopping.start()
    stopping.join(TIMEOUT / 3)
    assert not stopping.is_alive() and not thread.is_alive()


def test_ended_soul_leaves_its_name_alone(node):
    blocks = weakref.WeakSet()
    for number in range(30):

        def block(me):
            pass

        blocks.add(block)
        node.fork(block, name=f'job {number}').join(TIMEOUT)
    del block

    def are_gone():
        gc.collect()
        return not blocks

    until(are_gone)
    assert node.health().ended_souls == [f'job {number}' for number in range(20, 30)]


def test_sender_learns_that_its_node_stops(master):
    """A thread of the program's own sends until the stop; rospy says that the topic is closed."""
    for _ in range(10):
        node, errors = create(master, '/sender'), []

        def send(node=node, errors=errors):
            try:
                while True:
                    node.send_to('/t', typed_as=STRING, data='x')
            except PharosError as error:
                errors.append(type(error))

        thread = threading.Thread(target=send)
        thread.start()
        until(lambda: node.channels and node.channels[0].sent)
        node.stop()
        thread.join(TIMEOUT)
        assert errors == [NodeStoppedError]


def test_constructor_cannot_wait_for_a_service(master):
    class Early(Node):
        def __init__(self):
            self.wait_for_service('/clear')

    with pytest.raises(NodeStoppedError):
        create(master, node_class=Early)


def test_health_counts_souls_and_the_log_names_what_is_left(master):
    node, free = create(master, node_class=Hasty), threading.Event()
    log = Mailbox(create(master, '/ear'), '/rosout', 'rosgraph_msgs/Log')
    node.fork(lambda me: None, name='short').join(TIMEOUT)
    node.fork(lambda me: free.wait(TIMEOUT), name='stubborn')
    assert (node.health().souls, node.health().ended_souls) == (1, ['short'])
    node.stop()
    log.wait_for(lambda line: 'left behind' in line.msg and 'stubborn' in line.msg)
    assert '/node' not in str(master.system_state())
    free.set()


# -- messages


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


@pytest.mark.parametrize('library, size', [(Peer, 1 << 20), (PharosPeer, 60_000)])
def test_queue_to_a_standing_subscriber_is_bounded(master, node, library, size):
    with library(master.url) as ear:
        ear.hear('/words', STRING)
        out = node.output_channel('/words', STRING, queue_size=2)
        os.kill(ear.pid, signal.SIGSTOP)
        for number in range(100):
            out.send(data=str(number).ljust(size))
        os.kill(ear.pid, signal.SIGCONT)
        numbers = "[message.data[:3].strip() for message in heard['/words']]"
        until(lambda: ear.value(numbers)[-1:] == ['99'])
        assert len(ear.value(numbers)) < 60


def test_latched_message_goes_to_the_new_subscriber_alone(master, node):
    create(master, '/map').output_channel('/map', STRING, latch=True).send(data='map')
    first, second = [], []
    node.ros.Subscriber('/map', std_msgs.msg.String, first.append)
    until(lambda: first)
    node.ros.Subscriber('/map', std_msgs.msg.String, second.append)
    until(lambda: second)
    assert len(first) == 1


def test_closed_channel_takes_its_latched_message_along(master, node):
    channels = [node.output_channel('/map', STRING, latch=True) for _ in range(2)]
    for channel, text in zip(channels, ['old', 'new']):
        channel.send(data=text)
    channels[0].close()
    box = Mailbox(create(master, '/late'), '/map', STRING)
    assert box.next().data == 'new'
    channels[1].send(data='last')
    assert box.next().data == 'last'


def test_channels_of_a_node_get_messages_of_their_own(node, peer):
    boxes = [Mailbox(node, '/words', STRING) for _ in range(2)]
    peer.run("out = rospy.Publisher('/words', message_class('std_msgs/String'), queue_size=1)")
    until(lambda: peer.value('out.get_num_connections()'))
    peer.run("out.publish('one')")
    one, other = [box.next() for box in boxes]
    assert one == other and one is not other


# -- parameters, time, and calls from elsewhere


@pytest.mark.parametrize('value', [True, 1.0])
def test_change_of_type_is_heard(node, value):
    rate, heard = node.parameter('~rate', 1), []
    rate.on_change(heard.append)
    rate.set(value)
    until(lambda: heard)
    assert type(heard[0]) is type(value)


def test_clock_that_jumps_back_stops_no_turns(master):
    master.parameters['/use_sim_time'] = True
    node, turns = create(master), []
    clock = create(master, '/clock_of_all').output_channel('/clock', 'rosgraph_msgs/Clock')

    def tick(seconds):
        clock.publish(rosgraph_msgs.msg.Clock(rospy.Time(seconds)))
        until(lambda: node.ros.Time.now().to_sec() == seconds)

    tick(100)
    node.fork(lambda me: [turns.append(turn) for turn in me.every(1)])
    until(lambda: turns)
    for start in 100, 10:
        count = len(turns)
        for seconds in range(start + 2, start + 9, 2):
            tick(seconds)
        until(lambda count=count: len(turns) > count)
    del master.parameters['/use_sim_time']


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


# -- composed programs


def test_end_of_main_waits_for_threads_and_calls_atexit_in_reverse(bench):
    text = '''
        def work():
            over.wait()
            time.sleep(0.1)
            say('thread')
        over = threading.Event()
        rospy.init_node('program')
        threading.Thread(target=work).start()
        for text in 'first', 'second': atexit.register(say, text)
        say('main')
        over.set()
        '''
    bench.load(text).wait(TIMEOUT)
    assert bench.said() == ['main', 'thread', 'second', 'first']


def test_script_that_ignores_the_stop_gets_systemexit(bench, capfd):
    text = '''
        over = threading.Event()
        rospy.init_node('program')
        say('ready')
        try:
            while True: over.wait(0.01)
        except SystemExit:
            say('SystemExit')
        '''
    script = bench.load(text)
    until(bench.said)
    script.stop_timeout = 0.1
    script.stop()
    assert f'left behind, since it did not end in time: {script.path}' in capfd.readouterr().err
    until(lambda: bench.said() == ['ready', 'SystemExit'])


def test_last_node_can_be_stopped_and_started(master, bench):
    with master.compose(None, bench.launch_file(program=SPIN)) as composition:
        (script,) = composition.nodes
        composition.control(script, 'stop')
        with pytest.raises(TimeoutError):
            composition.wait(0.2)
        composition.control(script, 'start')
        assert script.is_running


def test_respawn_waits_for_its_delay(bench):
    bench.write(INIT + 'say(time.time())\n')
    more = 'respawn="true" respawn_delay="0.5"'
    with bench.program(bench.launch_file(f'<node pkg="bench" type="program" name="p" {more}/>')):
        until(lambda: len(bench.said()) >= 2)
    first, second, *_ = map(float, bench.said())
    assert second - first >= 0.5


def test_node_with_a_folder_runs_there(bench):
    bench.write(INIT + 'say(os.getcwd())\nrospy.spin()\n')
    xml = '<node pkg="bench" type="program" name="program" cwd="node"/>'
    with bench.program(bench.launch_file(xml)):
        until(bench.said)
    assert bench.said() == [str(bench.folder)]


def test_program_with_a_window_runs_here_if_asked(bench):
    path = bench.launch_file(program=f'import tkinter\n{INIT}say(os.getpid())\nrospy.spin()\n')
    for options in [], ['--here', 'program']:
        with bench.program(path, *options) as composed:
            until(lambda options=options: len(bench.said()) == 1 + len(options) // 2)
            is_here = bench.said()[-1] == str(composed.pid)
        assert is_here == bool(options)


def test_master_is_started_if_there_is_none(bench, monkeypatch):
    bench.master = pharos.Master(f'http://127.0.0.1:{free_port()}/')
    with bench.program(bench.launch_file(program=SPIN)) as composed:
        until(lambda: bench.said() == ['ready'])
        assert bench.master.node('/program').pid == composed.pid
        assert 'no ROS master at' in composed.output
        end(composed)
    assert not bench.master.is_reachable()


def test_soul_of_a_former_run_ends(node):
    begun, ended = [], threading.Semaphore(0)

    def watch(me):
        begun.append(me)
        try:
            if len(begun) == 1:
                me.restart()
            me.sleep(3600)
        except pharos.NodeStoppedError:
            ended.release()
            raise

    node.fork(watch)
    assert ended.acquire(timeout=TIMEOUT)
    assert len(begun) == 2 and node.health().souls == 1


# -- ends, queues and connections


def has_come_to(thread, function):
    """True if a thread stands in a function, or has ended."""
    frame = sys._current_frames().get(thread.ident)
    while frame and frame.f_code is not function.__code__:
        frame = frame.f_back
    return frame or not thread.is_alive()


def test_node_whose_own_stop_fails_is_stopped(master):
    class Careless(pharos.BlockNode):
        def stop(self):
            assert not self.is_running, 'its motor does not answer'

    node = create(master, node_class=Careless)
    node.ros.signal_shutdown('enough')
    until(lambda: node.lifecycle is pharos.Lifecycle.STOPPED)
    assert [type(error) for error in node.errors] == [AssertionError]


def test_master_that_goes_away_is_told_and_keeps_its_nodes(mortal, capfd):
    node = create(mortal.master)
    mortal.end()
    with pytest.raises(pharos.MasterUnreachableError):
        node.restart()
    assert node.is_running
    until(lambda: 'no master answers at' in capfd.readouterr().err)


def test_node_becomes_another_class_after_the_delegate(master):
    ear, gate, _, _ = fill(master)
    former_class = type(ear)
    thread = threading.Thread(target=ear.become, args=[pharos.BlockNode])
    thread.start()
    until(lambda: has_come_to(thread, CallbackQueue.run_exclusively))
    assert type(ear) is former_class
    gate.open.set()
    thread.join(TIMEOUT)
    assert type(ear) is pharos.BlockNode


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


@pytest.mark.parametrize('end', ['close', 'stop'])
def test_end_sends_what_waits(node, peer, end):
    peer.hear('/words', STRING)
    out = node.output_channel('/words', STRING)
    os.kill(peer.pid, signal.SIGSTOP)
    for number in range(10, 30):
        out.send(data=str(number).ljust(1 << 20))
    node.stop_timeout = TIMEOUT
    thread = threading.Thread(target=out.close if end == 'close' else node.stop)
    thread.start()
    until(lambda: has_come_to(thread, PublisherOverlay.flush))
    os.kill(peer.pid, signal.SIGCONT)
    until(lambda: peer.value("[message.data[:2] for message in heard['/words']]")[-1:] == ['29'])
    thread.join(TIMEOUT)
    assert out.closed


def test_end_waits_for_a_slow_program(master, bench, monkeypatch):
    monkeypatch.setattr('pharos.compose.composition.SLOW_END', 0.01)
    text = f"{INIT}rospy.on_shutdown(lambda: [time.sleep(0.5), say('stands')])\nsay('ready')\n"
    with master.compose(None, bench.launch_file(program=f'{text}rospy.spin()')):
        until(bench.said)
    assert bench.said() == ['ready', 'stands']


def test_callback_waits_for_one_on_an_earlier_message(master, node, monkeypatch):
    for limit in 'SLOW', 'TURN_LIMIT':  # both are too short for a test
        monkeypatch.setattr(f'pharos.intraprocess.callback_queues.{limit}', TIMEOUT)
    order, gate, mouth = [], Gate(), create(master, '/mouth')
    callbacks = {
        '/first': lambda message: [gate(message), order.append('first')],
        '/second': lambda message: order.append('second'),
    }
    for topic, callback in callbacks.items():
        node.ros.Subscriber(topic, std_msgs.msg.String, callback)
        mouth.send_to(topic, typed_as=STRING, data='x')
    queues = node._current_run.callback_order.queues
    until(lambda: order or gate.heard and any(queue.waits_for_turn for queue in list(queues)))
    gate.open.set()
    until(lambda: len(order) == 2)
    assert order == ['first', 'second']


def test_stop_waits_for_the_delegate(master, node):
    words, gate, mouth = [], Gate(), create(master, '/mouth')
    create(master, '/wheels').interested_in('/speed', STRING, lambda m: words.append(m.data))
    speed = node.output_channel('/speed', STRING)
    node.interested_in('/words', STRING, lambda message: [gate(message), speed.send(data='halt')])
    mouth.send_to('/words', data='x')
    assert gate.begun.wait(TIMEOUT)
    node.stop_timeout = TIMEOUT
    thread = threading.Thread(target=node.stop)
    thread.start()
    until(lambda: has_come_to(thread, CallbackQueue.close))
    gate.open.set()
    until(lambda: words or node.errors)
    thread.join(TIMEOUT)
    assert words == ['halt']


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


def test_hooks_run_in_their_order(bench):
    text = "for text in 'first', 'second': rospy.on_shutdown(lambda text=text: say(text))\n"
    script = bench.load(f"{INIT}{text}say('ready')\nrospy.spin()")
    until(bench.said)
    script.stop()
    assert bench.said() == ['ready', 'first', 'second']


def test_refused_connection_is_tried_again(node, peer):
    handler = node._current_run.ros_handler
    connect = handler._connect_topic
    answers = [(0, 'not now', 0)]
    handler._connect_topic = lambda *names: answers.pop() if answers else connect(*names)
    box = Mailbox(node, '/words', STRING)
    peer.run("out = rospy.Publisher('/words', message_class('std_msgs/String'), latch=True)")
    peer.run("out.publish('x')")
    assert box.next().data == 'x' and not answers


def test_stop_fires_no_timer(node):
    fired = []
    timer = node.ros.Timer(node.ros.Duration(3600), fired.append)
    until(lambda: has_come_to(timer, Run.sleep))
    node.stop()
    assert not fired


def test_program_whose_required_soul_has_ended_runs_again(bench):
    text = '''
        node = pharos.Master().create(pharos.BlockNode, 'program')
        if os.path.exists(SAID):
            node.fork(lambda me: [say('again') for turn in me.every(0.01)])
        else:
            say('first')
            node.fork(lambda me: None, required=True)
        pharos.spin()
        '''
    script = bench.load(text)
    assert script.wait(TIMEOUT) == 1
    script.start()
    until(lambda: bench.said().count('again') > 5 or script.exit_code is not None)
    assert script.is_running


def test_start_may_wait_for_its_delegate(master, monkeypatch):
    monkeypatch.setattr('pharos.private_rospy.run.HOLD_LIMIT', 0.1)

    class Patient(pharos.BlockNode):
        def start(self):
            super().start()
            heard = threading.Event()
            self.interested_in('/map', STRING, lambda message: heard.set())
            self.has_heard = heard.wait(TIMEOUT)

    create(master, '/maps').output_channel('/map', STRING, latch=True).send(data='map')
    assert create(master, '/patient', Patient).has_heard


@pytest.mark.parametrize('option', ['--apart', '--group'])
def test_nodes_end_with_a_killed_composition(master, bench, option):
    path = bench.launch_file(program=INIT + "say('ready')\nrospy.spin()\n")
    with bench.program(path, option, 'program') as composed:
        until(bench.said)
        os.kill(composed.pid, signal.SIGKILL)
        until(lambda: not any(master.system_state()))


def test_stop_at_a_hanging_master_closes_connections(mortal):
    node, other = create(mortal.master), create(mortal.master, '/other')
    channel = node.interested_in('/words', STRING)
    other.output_channel('/words', STRING)
    until(lambda: channel.connections)
    os.kill(mortal.pid, signal.SIGSTOP)
    other.stop()
    os.kill(mortal.pid, signal.SIGCONT)
    assert not channel.connections


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


def test_failed_import_fails_again(bench):
    bench.write('import rospy\nraise OSError("no device")', 'helper.py', '')
    text = '''
        rospy.init_node('program')
        for attempt in range(2):
            try:
                import helper
                say('imported')
            except OSError as error:
                say(error)
        '''
    assert bench.load(text).wait(TIMEOUT) == 0
    assert bench.said() == ['no device'] * 2


def test_dataclass_of_a_program_leaves_the_process_its_module(bench, monkeypatch):
    module = types.ModuleType('wheels')
    monkeypatch.setitem(sys.modules, 'wheels', module)
    text = 'import dataclasses\n@dataclasses.dataclass\nclass Wheel:\n    size: int = 1\n'
    bench.write(text, 'wheels.py', '')
    assert bench.load(f'import wheels\n{INIT}say(wheels.Wheel().size)').wait(TIMEOUT) == 0
    assert bench.said() == ['1'] and sys.modules['wheels'] is module


def test_only_program_comes_back_with_its_environment(bench):
    bench.write(INIT + "say(os.environ.get('PATH'))\n")
    xml = '<node pkg="bench" type="program" name="program" respawn="true"/>'
    with bench.program(bench.launch_file(xml)):
        until(lambda: len(bench.said()) >= 2)
    first, second, *_ = bench.said()
    assert first == second != 'None'


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


def test_thread_that_sleeps_ends_with_its_node(node):
    sleep = node.ros.rostime.wallsleep

    def work():
        with contextlib.suppress(SystemExit):
            while True:
                sleep(0.01)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    node.stop()
    thread.join(TIMEOUT)
    assert not thread.is_alive()


def test_publisher_that_has_left_is_not_connected_again(node, monkeypatch, peer):
    attempts, run = [], node._current_run
    peer.run("out = rospy.Publisher('/words', message_class('std_msgs/String'), queue_size=1)")
    channel = node.interested_in('/words', STRING)
    until(lambda: channel.connections)
    start = 'pharos.private_rospy.connections._start_connecting'
    monkeypatch.setattr(start, lambda *arguments: attempts.append(arguments))
    peer.run('out.unregister()')
    until(lambda: run.retries)
    until(lambda: not run.retries)
    assert not attempts


def test_delegate_may_close_its_channel_at_the_latched_message(master, node):
    create(master, '/maps').output_channel('/map', STRING, latch=True).send(data='map')
    channel = node.interested_in('/map', delegate=lambda message, channel: channel.close())
    until(lambda: channel.closed or node.errors)
    assert not node.errors and not channel.connections
