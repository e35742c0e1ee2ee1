"""Programs in one process do what each of them does in a process of its own."""
import collections
import contextlib
import gc
import io
import itertools
import os
import signal
import sys
import textwrap
import threading
import time
import types

import pytest
import rosnode

import pharos
from helpers import COMPOSE, HEAD, INIT, PYTHON, ROOT, SPIN, TIMEOUT, Program, create, end
from pharos.compose.control import control
from pharos.compose.script_run import NamedLines
from pharos.testing import Mailbox, until

STRING = 'std_msgs/String'


def text_of(name, *values, **named):
    """The text of a program in test/programs, with values for its braces if it has some."""
    text = (ROOT / 'test' / 'programs' / name).read_text()
    return text.format(*values, **named) if values or named else text


WORK = 'end = time.monotonic() + 1\n        while time.monotonic() < end: pass'
DRIVES = {
    'hook': dict(hook='', wait='rospy.Rate(100).sleep()', disable=False),
    'long hook': dict(hook='rospy.sleep(0.3)', wait='rospy.sleep(0.01)', disable=False),
    'interrupt': dict(hook='', wait='while not time.sleep(0.01): go(0.2)', disable=True),
    'busy': dict(hook='', wait=WORK, disable=False),
}
#: what a loop waits in, without a look at Python's signals
LOOP_WAITS = {
    'camera': 'select.select([silent], [], [], 0.002)',
    'computes': 'sum(number for number in range(50_000))',
    'serial port': 'os.read(device, 1)',
}
CALL = "rospy.ServiceProxy('/brake', Empty)()"
HOOKS = [
    ('camera', 'pass', 'Ctrl-C'),
    ('camera', 'time.sleep(4)', 'Ctrl-C'),
    ('serial port', 'time.sleep(0.5)', 'rosnode kill'),
    ('computes', 'rospy.sleep(0.5)', 'restart'),
    ('serial port', f'{CALL}; time.sleep(0.5)', 'required'),
    ('computes', f'time.sleep(0.5); {CALL}', 'rosnode kill'),
]
OTHER = '''
rospy.init_node('other')
while not (rospy.is_shutdown() or rospy.has_param('/go')): rospy.sleep(0.01)
'''
STOPS = {
    'timed': (['hook True', 'main True', 'atexit True'], 0),
    'serve': (['interrupted'], 0),
    'handler_after': (['handler'], 7),
    'handler_before': (['handler'], 7),
    'daemon': ([], 0),
}
FAIL = INIT + 'def fail(event=None): raise ValueError("in vain")\n'
FAILS = [
    'rospy.on_shutdown(fail)',
    'threading.Thread(target=fail).start()',
    'rospy.Timer(rospy.Duration(0.01), fail, oneshot=True)',
]
SLOW = {'slow_script': [*COMPOSE, '--script'], 'slow_node': [PYTHON]}
IDIOMS = 'inspect asyncio argparse star_import stdout subprocess rosparam message_filters'.split()
VALUES = 'class Pose:', 42, 'idioms', '/idioms', 'kept\n', 'hello\n', 7, True
HELPER = 'import inspect, rospy\nclass Lonely: pass\ndef look(): return inspect.stack()[0]\n'
FINDS = [
    ('inspect.getfile(Empty) == __file__ == inspect.stack()[0].filename', 'True'),
    ('inspect.getsource(Empty)', 'class Empty: pass'),
    ('inspect.getmodule(Empty) is sys.modules["__main__"]', 'True'),
    ('inspect.getmodule(inspect.stack()[0].frame).__name__', '__main__'),
    ('inspect.getfile(helper.Lonely) == helper.__file__ == helper.look().filename', 'True'),
    ('inspect.getsource(helper.Lonely)', 'class Lonely: pass'),
    ('inspect.getmodule(helper.Lonely) is helper', 'True'),
    ('inspect.getmodule(helper.look().frame) is helper', 'True'),
    ('asyncio.get_event_loop().run_until_complete(answer())', '42'),
]
FOLDERS = [
    "sys.path.append(os.path.join(os.path.dirname(__file__), '..', 'lib'))",
    "sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)) + '/../lib')",
    "import rospkg; sys.path.append(rospkg.RosPack().get_path('bench') + '/lib')",
]
TEXTS = {
    'early': "def read(): open('/no/such.yaml')\nread()",
    'ticks': f'{FAIL}{FAILS[1]}\n{FAILS[2]}\nrospy.spin()',
    'dots': INIT + "sys.stdout.write('half'); sys.stdout.flush(); rospy.spin()",
    'ends': INIT + "sys.stderr.write('last words')",
    'window': f'def show():\n    import tkinter\n{INIT}rospy.spin()',
}
RESPAWNED = '<node pkg="bench" type="dies" name="dies" respawn="true"/>'
SHOWN = [
    '/ticks starts',
    f'bench/early", line {HEAD.count(chr(10)) + 1}, in read',
    "[/early] FileNotFoundError: [Errno 2] No such file or directory: '/no/such.yaml'",
    '/window runs as a plain process: it has',
    '[/dots] half',
    '[/ends] last words',
    '/dies has ended, with exit code 4',
    '/dies comes back',
]
WINDOWS = [
    ('cv2.imshow("x", image)', '', 'imshow'),
    ('from tkinter import Tk', '', 'tkinter'),
    ('loop.add_signal_handler(2, end)', '', 'add_signal_handler'),
    ('web.run_app(app)', '', 'run_app'),
    ('uvicorn.run(app)', '', 'uvicorn'),
    ('pass  # cv2.imshow("x", image)', '', ''),
    ('import os, helper', 'def show(x):\n    cv2.imshow("x", x)\n', 'imshow'),
    ('from helper import (\n    show,\n)', 'def show(x):\n    cv2.imshow("x", x)\n', 'imshow'),
    ('import helper', '# cv2.imshow("x", x)\n', ''),
]


@pytest.mark.parametrize('way', ['Ctrl-C', 'stop', 'kill'])
@pytest.mark.parametrize('drive', DRIVES)
def test_robot_stands_at_end(master, peer, bench, drive, way):
    """The base, another process, hears the zero last."""
    peer.hear('/cmd_vel', 'geometry_msgs/Twist')
    with contextlib.ExitStack() as stack:
        path = bench.write(text_of('drive', **DRIVES[drive]))
        if way == 'Ctrl-C':
            stack.enter_context(bench.program('--script', path))
        else:
            stack.callback(master.load(path).stop)
        assert peer.heard('/cmd_vel')[-1].linear.x == 0.2
        if way == 'kill':
            with Program(['rosnode', 'kill', '/program'], master.url):
                until(lambda: not master.own_nodes())
    until(lambda: not peer.value('subscribers[0].get_num_connections()'))
    assert peer.heard('/cmd_vel')[-1].linear.x == 0.0
    assert bench.said()[-1] == 'main'
    assert drive == 'busy' or bench.said()[0] == 'True'  # in the main thread


@pytest.mark.parametrize('wait, hook, way', HOOKS)
def test_hook_has_the_last_word(master, peer, bench, wait, hook, way):
    """The loop's messages beside the hook are dropped: a process would not have sent them."""
    peer.hear('/cmd', 'std_msgs/Float64')
    peer.run('from std_srvs.srv import Empty; rospy.Service("/brake", Empty, lambda request: [])')
    text = text_of('hook', wait=LOOP_WAITS[wait], hook=hook)
    xml = '<node pkg="bench" type="other" name="other" required="true"/>'
    bench.write(OTHER, 'other')
    with bench.program(bench.launch_file(xml, program=text)) as composed:
        assert len(peer.heard('/cmd', 5)) >= 5
        if way == 'Ctrl-C':
            composed.signal(signal.SIGINT)
        elif way == 'rosnode kill':
            rosnode.kill_nodes(['/program'])
        elif way == 'restart':
            control('restart', '/program', master)
        else:
            master.parameters['/go'] = True
        bench.until(lambda: 'hook' in bench.said())
        until(lambda: not peer.value('subscribers[0].get_num_connections()'))
    commands = [message.data for message in peer.heard('/cmd')]
    assert set(commands[commands.index(0.0) :]) == {0.0}


def test_handler_has_the_last_word(peer, bench):
    peer.hear('/cmd', 'std_msgs/Float64')
    with bench.program('--script', bench.write(text_of('last_handler'))) as composed:
        assert len(peer.heard('/cmd', 5)) >= 5
        composed.signal(signal.SIGINT)
        until(lambda: not peer.value('subscribers[0].get_num_connections()'))
    commands = [message.data for message in peer.heard('/cmd')]
    assert set(commands[commands.index(0.0) :]) == {0.0}


@pytest.mark.parametrize('name', STOPS)
def test_stop_does_as_signal(bench, name):
    script = bench.load(text_of(name))
    bench.until(lambda: bench.said() == ['ready'])
    begin = time.monotonic()
    script.stop()
    assert (bench.said()[1:], script.exit_code) == STOPS[name]
    assert time.monotonic() - begin < script.stop_timeout / 2


@pytest.mark.parametrize('line', FAILS)
def test_error_beside_main_is_failure(bench, line):
    script = bench.load(f'{FAIL}{line}\nrospy.spin()')
    until(lambda: script.failures or 'shutdown' in line)
    script.stop()
    assert [str(error) for error in script.errors] == ['in vain']


def test_shutdown_in_callback_runs_hooks(bench):
    text = '''
        def shut_down(message):
            rospy.signal_shutdown('enough')
            say('returned')
        rospy.init_node('program')
        rospy.on_shutdown(lambda: say('hook'))
        rospy.Subscriber('/words', String, shut_down)
        rospy.Publisher('/words', String, queue_size=1, latch=True).publish('x')
        rospy.spin()
        '''
    assert bench.load(text).wait(TIMEOUT) == 0
    assert bench.said() == ['hook', 'returned']


@pytest.mark.parametrize('last', ['os._exit(6)', 'exit(6)', 'quit(6)', 'sys.exit(6)'])
def test_exit_ends_one_script(master, bench, monkeypatch, last):
    """Its neighbour can still read the standard input."""
    monkeypatch.setattr('sys.stdin', io.StringIO('line'))
    waits = "while not rospy.has_param('/go'): time.sleep(0.01)\nsay(sys.stdin.readline())"
    neighbour = master.load(bench.write("rospy.init_node('other')\n" + waits, 'other'))
    assert bench.load(INIT + last).wait(TIMEOUT) == 6
    master.parameters['/go'] = True
    assert neighbour.wait(TIMEOUT) == 0
    assert bench.said() == ['line']


@pytest.mark.parametrize('name', SLOW)
def test_quick_signals_are_one(master, bench, name):
    with Program([*SLOW[name], bench.write(text_of(name, 0.5, 0))], master.url) as running:
        running.until(lambda: 'ready' in bench.said())
        begin = time.monotonic()
        running.signal(signal.SIGINT)
        running.until(lambda: 'closing' in bench.said())
        if time.monotonic() - begin < 0.8:  # else this computer is too busy for two
            running.signal(signal.SIGINT)
        running.wait()
    assert bench.said() == ['ready', 'closing', 'closed']
    assert not any(master.system_state())


@pytest.mark.parametrize('name', SLOW)
def test_late_signal_ends_at_once(mortal, bench, name):
    with Program([*SLOW[name], bench.write(text_of(name, 1.2, 60))], mortal.url) as running:
        running.until(lambda: 'ready' in bench.said())
        running.signal(signal.SIGINT)
        running.until(lambda: 'closed' in bench.said())
        assert end(running) in (-signal.SIGINT, 128 + signal.SIGINT)


@pytest.mark.parametrize('last, code', [('', 0), ('sys.exit(3)', 3), ('1 / 0', 1)])
def test_end_of_main_ends_node(master, peer, bench, last, code):
    """A publisher in another process does not hold it up; required and respawn see it."""
    peer.run(f"camera = rospy.Publisher('/camera', message_class('{STRING}'), latch=True)")
    peer.run("camera.publish('image')")
    assert bench.load(text_of('once') + last).wait(TIMEOUT) == code
    node = '<node pkg="bench" type="program" name="program" {}="true"/>'
    with master.compose(None, bench.launch_file(node.format('required'))) as composition:
        assert composition.wait(TIMEOUT) == 1
    with master.compose(None, bench.launch_file(node.format('respawn'))):
        until(lambda: len(bench.said()) >= 4)


@pytest.mark.parametrize('name, value', zip(IDIOMS, VALUES))
def test_script_uses_idioms(master, bench, name, value):
    script = master.load('robot', 'idioms', name)
    assert (script.wait(TIMEOUT), script.errors) == (0, [])
    assert master.parameters['/idioms/said'] == value


@pytest.mark.parametrize('expression, found', FINDS)
def test_script_finds_itself(bench, expression, found):
    bench.write(HELPER, 'helper.py', '')
    text = 'class Empty: pass\nasync def answer(): return 42\n'
    script = bench.load(f'import helper\n{text}{INIT}say({expression})')
    assert script.wait(TIMEOUT) == 0
    assert bench.said()[0] == found


@pytest.mark.parametrize('line', FOLDERS)
def test_folders_on_path_are_searched(master, bench, line):
    bench.write('NAME = 1', 'lib/wheel_math.py', '')
    bench.write('NAME = 2', 'scripts/beside_it.py', '')
    text = f'{line}\nimport wheel_math, beside_it\n{INIT}sys.exit(wheel_math.NAME + beside_it.NAME)'
    assert master.load(bench.write(text, 'scripts/program')).wait(TIMEOUT) == 3


@pytest.mark.parametrize('order', itertools.permutations(['detector', 'camera']))
def test_devel_space_has_all_modules(master, bench, order):
    """catkin spreads code, messages and cfg of a package over two folders."""
    text = '''
        import sys
        from pkgutil import extend_path
        sys.path.insert(0, '{}/src')
        __path__ = extend_path(__path__, __name__)
        '''
    bench.write(text.format(bench.folder), 'devel/lab/__init__.py', '')
    bench.write('class Blob: pass', 'devel/lab/msg/__init__.py', '')
    bench.write('import rospy\nclass Config: pass', 'devel/lab/cfg/__init__.py', '')
    bench.write('', 'src/lab/__init__.py', '')
    bench.write('import rospy', 'src/lab/util.py', '')
    bench.write('from lab.msg import Blob\nfrom lab import util\n' + SPIN, 'detector')
    bench.write('from lab.cfg import Config\n' + SPIN.replace("'program'", "'camera'"), 'camera')
    text = '''
        import sys
        sys.path.insert(0, '{0}/devel')
        from pharos import BlockNode, Master
        scripts = [Master().load('{0}/' + name) for name in {1}]
        for script in scripts: script.restart()
        node = Master().create(BlockNode, 'plain')
        print(node.ros_import('lab.util').rospy is node.ros, node.ros_import('lab.msg').Blob)
        '''
    with Program(textwrap.dedent(text).format(bench.folder, order), master.url) as running:
        running.expect("True <class 'lab.msg.Blob'>")
        assert running.wait() == 0


def test_edited_helper_is_read_anew(bench):
    helper = bench.write('VERSION = 1', 'helper_of_test.py', '')
    script = bench.load(f'import helper_of_test\nsay(helper_of_test.VERSION)\n{SPIN}')
    bench.write('VERSION = 2', 'helper_of_test.py', '')
    os.utime(helper, (1, 1))
    script.restart()
    assert bench.said()[0::2][:2] == ['1', '2']


def test_script_has_roslaunchs_arguments(bench):
    text = INIT + 'for each in [os.getcwd(), *sys.argv[1:]]: say(each)'
    with bench.program(bench.launch_file(program=text)) as composed:
        composed.wait()
    folder, name, log = bench.said()
    assert (folder, name) == (str(bench.folder.parent / 'home'), '__name:=program')
    assert log.startswith('__log:=')
    assert os.path.exists(log[7:])


def test_callback_waits_for_constructor(master, bench):
    mailbox = Mailbox(create(master, '/ear'), '/map_out', STRING)
    bench.load(
        f"{INIT}rospy.Publisher('/map', String, latch=True, queue_size=1).publish('m')\nrospy.spin()"
    )
    text = '''
        class Relay:
            def __init__(self):
                rospy.Subscriber('/map', String, self.relay)
                self.out = rospy.Publisher('/map_out', String, queue_size=1, latch=True)
            def relay(self, message):
                self.out.publish(message)
        rospy.init_node('relay')
        Relay()
        rospy.spin()
        '''
    for number in range(10):
        with master.load(bench.write(text, 'relay'), name=f'relay{number}') as relay:
            assert mailbox.next().data == 'm'
            assert not relay.errors


@pytest.fixture(params=['here', 'another process'])
def talk(peer, bench, request):
    """``talk(topic)`` publishes 50 messages to one subscriber, by a script or by the peer."""

    def talk(topic):
        text = f'''out = rospy.Publisher('{topic}', String, queue_size=100)
while not out.get_num_connections(): rospy.sleep(0.01)
for _ in range(50): out.publish('x')'''
        if request.param == 'here':
            bench.master.load(bench.write("rospy.init_node('talker')\n" + text, 'talker')).wait(
                TIMEOUT
            )
        else:
            peer.run(f"String = message_class('{STRING}')\n{text}")

    return talk


def test_subscription_has_one_thread(bench, talk):
    bench.load(
        '''
        threads = {'/a': [], '/b': []}
        def hear(message, topic):
            threads[topic].append(threading.get_ident())
            if len(threads[topic]) == 50: say(len(set(threads[topic])))
        rospy.init_node('program')
        for topic in threads: rospy.Subscriber(topic, String, hear, topic)
        rospy.spin()
        '''
    )
    talk('/a')
    talk('/b')
    bench.until(lambda: bench.said() == ['1', '1'])


def test_subscription_is_switched_on_again(bench, talk):
    bench.load(
        '''
        from rospy.impl.registration import get_topic_manager
        rospy.init_node('program')
        heard = rospy.Subscriber('/a', String, lambda message: say('off'))
        kind, name = heard.reg_type, heard.resolved_name
        heard.unregister()
        heard.impl = get_topic_manager().acquire_impl(kind, name, String)
        heard.impl.add_callback(lambda message: say('on'), None)
        rospy.spin()
        '''
    )
    talk('/a')
    bench.until(lambda: bench.said() == ['on'] * 50)


def test_blocking_delegate_holds_nobody_up(master):
    steps = threading.Barrier(2, timeout=TIMEOUT)
    slow = create(master, '/slow')
    slow.interested_in(
        '/tick', STRING, lambda message: message.data == '20' and [steps.wait(), steps.wait()]
    )
    other = Mailbox(create(master, '/other'), '/tick', STRING)
    channel = create(master, '/talker').output_channel('/tick', STRING)
    until(lambda: len(channel.connections) == 2)
    for number in range(1, 21):
        channel.send(data=str(number))
        other.next()
    steps.wait()
    channel.send(data='21')
    assert other.next(5).data == '21'
    steps.wait()


def test_terminal_tells_of_each_node(bench):
    bench.write("rospy.init_node('dies')\nsys.exit(4)", 'dies')
    with bench.program(bench.launch_file(RESPAWNED, **TEXTS), '--screen') as composed:
        for text in SHOWN:
            composed.expect(text)
        composed.until(lambda: composed.output.count('ValueError: in vain') >= 2)
        end(composed)
    vain = [line for line in composed.output.splitlines() if 'in vain' in line]
    assert all(line.startswith('[/ticks]') for line in vain), vain


@pytest.mark.parametrize('order', itertools.permutations(['good', 'bad']))
def test_status_is_independent_of_order(bench, order):
    texts = {'good': SPIN, 'bad': 'import no_such_module'}
    with bench.program(bench.launch_file(**{name: texts[name] for name in order})) as composed:
        composed.expect('/bad cannot run')
        bench.until(lambda: bench.said())
        assert end(composed) in (0, 130)  # 130: it still starts


@pytest.mark.parametrize('line, helper, why', WINDOWS)
def test_windows_need_own_process(bench, line, helper, why):
    text = f'def show():\n    {line}\n{INIT}rospy.spin()'
    bench.write(helper, 'helper.py', '')
    if why:
        with pytest.raises(pharos.PharosError, match=f'needs a process of its own.*{why}'):
            bench.load(text)
    assert bench.load(text, here=bool(why)).is_running


def check_runs(master, bench, mailbox, names):
    """Yield each time that the program talker runs and its talker says its gain; all has ended at last."""
    for runs in 1, 2:
        bench.until(lambda: bench.said().count('ready') == runs)
        assert mailbox.next().data == '7'
        assert {each.name for each in master.nodes()} == {'/ear', *names}
        yield runs
    assert {each.name for each in master.nodes()} == {'/ear'}
    assert bench.said() == ['ready', 'over'] * 2


def test_loaded_program_creates_nodes(master, bench):
    mailbox = Mailbox(create(master, '/ear'), '/speech', STRING)
    settings = {'name': 'arm', 'namespace': '/left', 'params': {'gain': 7}}
    script = master.load(bench.write(text_of('talker')), remap={'words': '/speech'}, **settings)
    for runs in check_runs(master, bench, mailbox, ['/left/arm', '/left/two']):
        script.restart() if runs == 1 else script.stop()
    assert script.exit_code == 0


def test_launched_program_creates_nodes(master, bench):
    """It comes back, as respawn says, when its nodes have ended; and ends at Ctrl-C."""
    bench.write(text_of('talker'))
    node = create(master, '/ear')
    mailbox, channel = Mailbox(node, '/speech', STRING), node.output_channel('/end', STRING)
    with bench.program(bench.launch_file(text_of('rig.xml'))) as composed:
        for runs in check_runs(master, bench, mailbox, ['/rig/boss', '/rig/two']):
            assert master.node('/rig/boss').pid == composed.pid
            channel.wait_for_subscribers(1, TIMEOUT)
            channel.send(data='') if runs == 1 else end(composed)


# -- threads


def test_chain_of_timers_keeps_its_program(bench):
    """Its main thread has ended; each timer is made by the one before."""
    text = '''
        def tick(count):
            say(f'{count} {rospy.is_shutdown()}')
            if count < 5: threading.Timer(0.05, tick, [count + 1]).start()
        rospy.init_node('program')
        tick(1)
        '''
    assert bench.load(text).wait(TIMEOUT) == 0
    assert bench.said() == [f'{count} False' for count in range(1, 6)]


@pytest.mark.parametrize('daemon', [True, False])
def test_thread_of_a_thread_is_a_daemon_like_it(bench, daemon):
    """The program's end waits for a thread that is not a daemon."""
    text = f'''
        def work():
            for _ in range(20):
                if rospy.is_shutdown(): return
                time.sleep(0.01)
            say('worked')
        rospy.init_node('program')
        outer = threading.Thread(target=lambda: threading.Thread(target=work).start(), daemon={daemon})
        outer.start()
        outer.join()
        '''
    assert bench.load(text).wait(TIMEOUT) == 0
    assert bench.said() == ([] if daemon else ['worked'])


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


# -- asyncio


ASYNC = '''
import asyncio
async def serve():
    loop = asyncio.get_running_loop()
    server = await asyncio.start_server(lambda reader, writer: writer.close(), '127.0.0.1', 0)
    say('up')
    try:
        async with server: await server.serve_forever()
    finally:
        say('cleaned')
rospy.init_node('program', disable_signals=True)
try:
    {}
except KeyboardInterrupt:
    say('interrupted')
'''
FOREVER = "loop = asyncio.new_event_loop(); loop.call_soon(say, 'up'); loop.run_forever()"


@pytest.mark.parametrize(
    'run, said',
    [('asyncio.run(serve())', ['up', 'cleaned', 'interrupted']), (FOREVER, ['up', 'interrupted'])],
    ids=['run', 'run_forever'],
)
def test_idle_loop_of_asyncio_is_interrupted(bench, run, said):
    with bench.program('--script', bench.write(ASYNC.format(run))) as composed:
        bench.until(bench.said)
        end(composed)
    assert bench.said() == said
    assert 'the end waits' not in composed.output


def test_further_start_prints_no_traceback(master, bench):
    text = '''
import pharos
for _ in range(4):
    script = pharos.Master().load({!r})
    script.stop()
'''
    path = bench.write("import rospy\nrospy.init_node('program')\nrospy.spin()\n", head='')
    with Program(text.format(path), master.url) as program:
        assert program.wait() == 0
    assert 'Exception ignored' not in program.output


def descriptors():
    """Return the number of open files of this process."""
    return len(os.listdir('/proc/self/fd'))


def test_program_without_asyncio_has_no_loop(bench):
    bench.load(
        "say(len(os.listdir('/proc/self/fd')))"
    )  # a process has some of its own from then on
    count = descriptors()
    bench.load("say(len(os.listdir('/proc/self/fd')))")
    assert int(bench.said()[-1]) == count


def test_loop_that_was_asked_for_is_closed(bench):
    text = (
        f'loop = asyncio.get_event_loop()\n{INIT}say(loop.run_until_complete(asyncio.sleep(0, 7)))'
    )
    bench.load(INIT).wait(TIMEOUT)
    gc.collect()
    count = descriptors()
    script = bench.load(text)
    assert script.wait(TIMEOUT) == 0
    script.stop()
    assert bench.said() == ['7']
    until(lambda: descriptors() == count)


# -- what is the process's


TIMED = '''
import socket, urllib.request
rospy.init_node('timed')
socket.setdefaulttimeout(0.2)
say(socket.getdefaulttimeout())
say(socket.socket().gettimeout())
device = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
device.bind(('127.0.0.1', 0))
try:
    device.recv(10)
except socket.timeout:
    say('nothing came')
server = socket.create_server(('127.0.0.1', 0))
try:
    urllib.request.urlopen(f'http://127.0.0.1:{server.getsockname()[1]}/')
except OSError as error:
    say(error)
rospy.set_param('/timed', True)
rospy.spin()
'''
BESIDE = '''
import socket
rospy.init_node('beside')
while not rospy.has_param('/timed'): time.sleep(0.01)
say(socket.socket().gettimeout())
rospy.spin()
'''


def test_default_timeout_is_the_programs_own(bench):
    """It holds for its sockets and for libraries that it uses, and for no other program."""
    with bench.program(bench.launch_file(timed=TIMED, beside=BESIDE)):
        bench.until(lambda: len(bench.said()) == 5)
    assert bench.said() == ['0.2', '0.2', 'nothing came', 'timed out', 'None']


POOL = '''
import concurrent.futures, math
def double(number): return 2 * number
if __name__ == '__main__':
    rospy.init_node('pool')
    with concurrent.futures.ProcessPoolExecutor(2) as pool:
        say(list(pool.map({}, [4, 9])))
    say('over')
'''


@pytest.mark.parametrize('function, values', [('math.sqrt', '[2.0, 3.0]'), ('double', '[8, 18]')])
def test_pool_of_processes_computes(bench, function, values):
    """In this process, or in one of its own."""
    with bench.program(bench.launch_file(pool=POOL.format(function), beside=SPIN)):
        bench.until(lambda: len(bench.said()) == 3)
    assert sorted(bench.said()) == sorted(['ready', values, 'over'])


RAISES = {
    'SIGUSR1': 'os.kill(os.getpid(), signal.SIGUSR1)',
    'SIGUSR2': 'os.kill(os.getpid(), signal.SIGUSR2)',
    'SIGHUP': 'os.kill(os.getpid(), signal.SIGHUP)',
    'SIGCHLD': "subprocess.call(['true'])",
    'SIGALRM': "subprocess.call(['kill', '-ALRM', str(os.getpid())])",
}
HANDLED = '''
import subprocess
rospy.init_node('handler')
signal.signal(signal.{}, lambda number, frame: say(signal.Signals(number).name))
{}
while not (rospy.is_shutdown() or rospy.has_param('/go')): time.sleep(0.01)
say('lives')
rospy.spin()
'''


@pytest.mark.parametrize('how', ['scripts', 'launch file'])
@pytest.mark.parametrize('name', RAISES)
def test_handler_of_a_signal_is_called(master, bench, name, how):
    """In this process, or in one of its own; nobody else ends."""
    text = HANDLED.format(name, RAISES[name])
    words = ['--script', bench.write(text, 'handler'), bench.write(SPIN)]
    if how == 'launch file':
        words = [bench.launch_file(handler=text, program=SPIN)]
    with bench.program(*words) as composed:
        bench.until(lambda: {'ready', name} <= {*bench.said()})
        master.parameters['/go'] = True
        bench.until(lambda: 'lives' in bench.said())
        assert composed.node('/program').is_alive()
        end(composed)
    assert sorted(bench.said()) == sorted(['ready', name, 'lives'])


@pytest.mark.parametrize(
    'line', ['sys.stdout.close()', 'sys.stdout.detach()', 'sys.stderr.close()'], ids=str
)
def test_closed_output_silences_no_other(master, bench, line):
    closes = f"rospy.init_node('closes')\n{line}\nrospy.set_param('/closed', True)\nrospy.spin()"
    waits = "while not rospy.has_param('/closed'): time.sleep(0.01)\n"
    prints = "print('still heard')\nprint('still told', file=sys.stderr)\nrospy.logwarn('still logged')\n"
    beside = f"rospy.init_node('beside')\n{waits}{prints}say('printed')\nrospy.spin()"
    paths = bench.write(closes, 'closes'), bench.write(beside, 'beside')
    with bench.program('--script', *paths) as composed:
        bench.until(lambda: 'printed' in bench.said())
        end(composed)
    for text in 'still heard', 'still told', 'still logged':
        assert text in composed.output


def test_closed_output_keeps_what_was_written_before(bench, capfd):
    text = '''
        sys.stdout.write('half a line')
        sys.stdout.close()
        try: print('more')
        except ValueError as error: say(error)
        '''
    bench.load(text).wait(TIMEOUT)
    assert 'half a line' in capfd.readouterr().out
    assert bench.said() == ['I/O operation on closed file.']


def stream(is_terminal=False, flush=lambda: None):
    """Return a stream that keeps texts, and the list of these."""
    texts = []
    methods = {'write': texts.append, 'flush': flush, 'isatty': lambda: is_terminal}
    return types.SimpleNamespace(**methods), texts


def lines_of(name, screen):
    return NamedLines(screen, types.SimpleNamespace(name=name))


def test_colour_ends_with_its_line():
    """rospy's log ends it after the end of the line."""
    screen, texts = stream()
    lines_of('/me', screen).write('\x1b[31m[ERROR] in vain\n\x1b[0m')
    assert texts == ['[/me] \x1b[31m[ERROR] in vain\x1b[0m\n']


PROGRESS = {
    True: '[/me] ..\n[/me] \rspeed 1\rspeed 2\n[/other] hello\n[/me] done\n',
    False: '[/me] .\n[/me] .\n[/me] \n[/me] \rspeed 1\n[/me] \rspeed 2\n[/other] hello\n[/me] done\n',
}


@pytest.mark.parametrize('is_terminal', PROGRESS)
def test_progress_stays_in_its_line_on_a_terminal(is_terminal):
    screen, texts = stream(is_terminal)
    mine, others = lines_of('/me', screen), lines_of('/other', screen)
    for text in '.', '.', '\n', '\rspeed 1', '\rspeed 2':
        print(text, end='', file=mine, flush=True)
    print('hello', file=others)
    print('done', file=mine)
    assert ''.join(texts) == PROGRESS[is_terminal]


def test_open_line_of_a_terminal_leaves_files_alone():
    screen, _ = stream(is_terminal=True)
    file, texts = stream()
    print('50 %', end='', file=lines_of('/me', screen), flush=True)
    print('hello', file=lines_of('/me', file))
    assert texts == ['[/me] hello\n']


def test_flush_beside_other_threads_loses_nothing():
    screen, texts = stream(flush=lambda: time.sleep(0))
    lines = lines_of('/me', screen)

    def write():
        for _ in range(1000):
            print('x', file=lines)
            print('y', end='', file=lines, flush=True)

    threads = [threading.Thread(target=write) for _ in range(4)]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval)
    counts = collections.Counter(''.join(texts))
    assert counts['x'] == counts['y'] == 4000


def test_reopened_output_is_written(bench):
    """A usual cure for an error of encoding, in two programs."""
    text = '''
        import io
        sys.stdout = io.TextIOWrapper(sys.stdout.detach(), encoding='utf-8', line_buffering=True)
        rospy.init_node('{0}')
        print('{0} says ✓')
        say('printed')
        rospy.spin()
        '''
    paths = [bench.write(text.format(name), name) for name in ('one', 'two')]
    with bench.program('--script', *paths) as composed:
        bench.until(lambda: len(bench.said()) == 2)
        end(composed)
    assert 'one says ✓' in composed.output and 'two says ✓' in composed.output


def test_script_that_ignores_the_stop_gets_systemexit(bench, capfd):
    # it computes: Python 3.9 tells a thread that waits of the exception only when another one has waited
    # for the interpreter, if a further thread gets one at that moment
    text = '''
        rospy.init_node('program')
        try:
            say('ready')
            while True: sum(range(1000))
        except SystemExit:
            say('SystemExit')
        '''
    script = bench.load(text)
    until(bench.said)
    script.stop_timeout = 0.1
    script.stop()
    assert f'left behind, since it did not end in time: {script.path}' in capfd.readouterr().err
    until(lambda: bench.said() == ['ready', 'SystemExit'])


def test_hooks_run_in_their_order(bench):
    text = "for text in 'first', 'second': rospy.on_shutdown(lambda text=text: say(text))\n"
    script = bench.load(f"{INIT}{text}say('ready')\nrospy.spin()")
    until(bench.said)
    script.stop()
    assert bench.said() == ['ready', 'first', 'second']


# -- as rospy


def test_frame_id_none_is_sent_as_in_rospy(master, bench):
    text = '''
        from sensor_msgs.msg import Imu
        rospy.init_node('program')
        imu = rospy.Publisher('/imu', Imu, queue_size=1)
        message = Imu()
        message.header.frame_id = None
        imu.publish(message)
        say(message.header.frame_id)
        '''
    assert bench.load(text).wait(TIMEOUT) == 0
    assert bench.said() == ['0']


def test_wrong_message_passes_while_nobody_hears_it(master, bench):
    text = '''
        from std_msgs.msg import Int32
        rospy.init_node('program')
        numbers = rospy.Publisher('/numbers', Int32, queue_size=1)
        numbers.publish('seven')
        say('passed')
        while not numbers.get_num_connections(): time.sleep(0.01)
        try: numbers.publish('seven')
        except rospy.ROSSerializationException: say('refused')
        '''
    script = bench.load(text)
    Mailbox(create(master, '/ear'), '/numbers', 'std_msgs/Int32')
    assert script.wait(TIMEOUT) == 0
    assert bench.said() == ['passed', 'refused']


def test_relay_of_any_message_passes_headers(master, bench):
    text = '''
        import roslib.message
        def relay(message):
            if not outputs:
                type_ = roslib.message.get_message_class(message._connection_header['type'])
                outputs.append(rospy.Publisher('/out', type_, queue_size=10, latch=True))
            outputs[0].publish(message)
        outputs = []
        rospy.init_node('program')
        rospy.Subscriber('/in', rospy.AnyMsg, relay)
        rospy.spin()
        '''
    bench.load(text)
    node = create(master, '/mouth')
    node.send_to('/in', typed_as='std_msgs/Header', frame_id='map')
    assert Mailbox(node, '/out', 'std_msgs/Header').next().frame_id == 'map'
