"""Programs in one process get devices, children, environments and hooks as in their own."""
import itertools
import os
import pty
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import tty
import types

import psutil
import pytest

import pharos
from helpers import COMPOSE, DEFAULT_SIGNALS, INIT, PYTHON, SPIN, TIMEOUT, Program, create, end
from pharos.compose.composition import Composition
from pharos.compose.control import control, reload_on_save
from pharos.compose.script import ScriptNode
from pharos.compose.sources import sets_environment, why_apart
from pharos.live.editing import editable_modules
from pharos.testing import Mailbox, until

STRING = 'std_msgs/String'

# -- drivers come back

OTHER_USER = ['setpriv', '--reuid', '65534', '--clear-groups']
needs_other_user = pytest.mark.skipif(
    not shutil.which('setpriv') or subprocess.call([*OTHER_USER, 'true']) != 0,
    reason='needs the right to be another user',
)
READERS = {
    'nobody': '',
    'loop': 'def read(device):\n    while True: time.sleep(0.01)\n',
    'socket': 'def read(device):\n    device.recv(10)\n',
}
DRIVER = '''
import fcntl, socket
{reader}
class Driver:
    def __init__(self):
        self.device = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.device.bind(('127.0.0.1', {port}))
        self.lock = open(SAID)
        fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self.subscriber = rospy.Subscriber('/wheels', String, self.drive)
        self.timer = rospy.Timer(rospy.Duration(0.01), self.look)
        if {has_reader}:
            threading.Thread(target=read, args=[self.device], daemon=True).start()
    def drive(self, message): pass
    def look(self, event): pass
rospy.init_node('program')
say('begins')
driver = Driver()
say('opened')
{rest}
'''
ENDS = {'exit': 'sys.exit(1)', 'exception': "raise RuntimeError('USB has gone')"}


def driver(port, reader='nobody', rest='rospy.spin()'):
    text = READERS[reader]
    return DRIVER.format(port=port, reader=text, has_reader=bool(text), rest=rest)


@pytest.fixture
def port():
    """A free port for UDP."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(('127.0.0.1', 0))
        return sock.getsockname()[1]


@pytest.mark.parametrize('reader', READERS)
@pytest.mark.parametrize('rest', ENDS.values(), ids=ENDS)
def test_driver_respawns_and_opens_its_device_again(bench, port, reader, rest):
    bench.write(driver(port, reader, rest))
    launch = bench.launch_file('<node pkg="bench" type="program" name="program" respawn="true"/>')
    with bench.program(launch):
        until(lambda: bench.said().count('opened') >= 3)


@pytest.mark.parametrize('reader', READERS)
def test_stop_gives_the_device_back(bench, port, reader):
    script = bench.load(driver(port, reader))
    until(lambda: bench.said() == ['begins', 'opened'])
    script.stop()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(('127.0.0.1', port))


def test_serial_driver_restarts_while_its_thread_reads(bench):
    pytest.importorskip('serial')
    device, program_end = pty.openpty()
    tty.setraw(program_end)
    text = f'''
        import serial
        def read(port):
            while True: port.read(1)
        rospy.init_node('program')
        port = serial.Serial({os.ttyname(program_end)!r}, exclusive=True)  # waits for ever
        threading.Thread(target=read, args=[port], daemon=True).start()
        say('opened')
        rospy.spin()
        '''
    script = bench.load(text)
    for count in 1, 2, 3:
        until(lambda count=count: bench.said().count('opened') == count)
        script.restart()
    os.close(device)
    os.close(program_end)


def test_thread_that_blocks_for_ever_is_told(bench, transcript):
    reading_end, writing_end = os.pipe()
    text = f'''
        rospy.init_node('program')
        threading.Thread(target=os.read, args=[{reading_end}, 1], name='blocked', daemon=True).start()
        rospy.spin()
        '''
    bench.load(text).stop()
    os.close(writing_end)
    os.close(reading_end)
    (line,) = [line for line in transcript if 'leaves threads' in line]
    assert line.endswith('with what they use: blocked')


def test_restarted_script_needs_not_its_former_ports(master, bench):
    script = bench.load(SPIN)
    script.stop()
    with socket.create_server(('127.0.0.1', script.tcp_port)):
        script.start()
    assert script.is_running


@pytest.mark.parametrize('rest', ['rospy.spin()', 'rospy.sleep(0.5)'])
def test_child_is_interrupted_at_the_end(bench, rest):
    text = f'''
        import subprocess
        rospy.init_node('program')
        child = subprocess.Popen(['sh', '-c', 'trap "exit 3" INT; sleep 60 & wait'])
        say(child.pid)
        {rest}
        '''
    script = bench.load(text)
    until(bench.said)
    child = psutil.Process(int(bench.said()[0]))
    if 'spin' in rest:
        script.stop()
    script.wait(TIMEOUT)
    until(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE)


# -- plain processes, and groups of one


def check(tmp_path, question, texts, expected):
    """Ask a question about programs of these texts; the answer has the expected text, or is ''."""
    for text in texts.split('|'):
        (tmp_path / 'program').write_text(text)
        found = question(str(tmp_path / 'program'))
        assert expected in found and bool(expected) == bool(found), (text, found)


def test_first_line_may_name_another_python(tmp_path):
    right = '#!/usr/bin/python3|#!/usr/bin/env python3|#!/usr/bin/env -S python3 -u'
    check(tmp_path, why_apart, f'{right}|#!/usr/bin/python3.{sys.version_info.minor}', '')
    check(tmp_path, why_apart, '#!/usr/bin/python3.2|#!/home/me/venv/bin/python', 'names /')
    check(tmp_path, why_apart, '#!/usr/bin/env python2|#!/bin/sh', 'not a program of Python 3')


def test_program_may_need_a_plain_process(tmp_path):
    head = '#!/usr/bin/python3\n'
    needs = f'{head}reactor.run()|{head}import matplotlib.pyplot as p|{head}import pylab'
    check(tmp_path, why_apart, f'{needs}|{head}from matplotlib import cm, pyplot', 'needs one')
    check(tmp_path, why_apart, f'{head}import matplotlib.figure|{head}self.reactor.running()', '')


def test_program_may_need_an_environment(tmp_path):
    sets = "os.environ['GPU'] = '1'|os.environ.setdefault('OMP_NUM_THREADS', '1')|env = os.environ"
    sets += "|os.environ.update(TZ='UTC')|os.putenv('TZ', 'UTC')|os.environ[name] = value"
    sets += "|os.environ.pop('TZ')|del os.environ['TZ']"
    check(tmp_path, sets_environment, sets, 'env')
    reads = "os.environ['ROS_NAMESPACE'] = ''|os.environ['TZ'] == 'UTC'|print(os.environ['TZ'])"
    check(tmp_path, sets_environment, f'{reads}|subprocess.run(command, env=os.environ)', '')


APART = '<node pkg="bench" type="program" name="program">{}</node>'
SAYS_PROCESS = INIT + "say(f'{os.getppid()} {sys.argv[0]}')\nrospy.spin()\n"


@pytest.mark.parametrize('how', ['option', 'parameter'])
def test_node_apart_is_a_plain_process(master, bench, how):
    path = bench.write(SAYS_PROCESS)
    inside = '<param name="pharos_apart" value="true"/>' if how == 'parameter' else ''
    apart = ['--apart', 'program'] if how == 'option' else []
    with bench.program(bench.launch_file(APART.format(inside)), *apart) as composed:
        until(bench.said)
        parent, program = bench.said()[0].split()
        assert program == path
        assert 'roslaunch_parent.py' in ' '.join(psutil.Process(int(parent)).cmdline())
        process = psutil.Process(master.node('/program').pid)
        assert not any('pharos' in each.path for each in process.memory_maps())
        assert process.cmdline()[1] == path
    assert '/program runs as a plain process: as --apart or pharos_apart says' in composed.output


SAYS_GPU = '''
import ctypes
rospy.init_node('program')
getenv = ctypes.CDLL(None).getenv
getenv.restype = ctypes.c_char_p
os.system('echo shell $GPU >> ' + SAID)
say(f'C {getenv(b"GPU")}')
rospy.spin()
'''
ENVIRONMENTS = {
    'launch file': ('<env name="GPU" value="1"/>', '', 'its environment has GPU=1'),
    'program': ('', "os.environ['GPU'] = '1'\n", '/program has "environ[\'GPU\'] ="'),
}


@pytest.mark.parametrize('xml, first, reason', ENVIRONMENTS.values(), ids=ENVIRONMENTS)
def test_environment_reaches_c_code_and_shells(master, bench, xml, first, reason):
    bench.write(first + SAYS_GPU)
    with bench.program(bench.launch_file(APART.format(xml), other=SPIN)) as composed:
        until(lambda: {'shell 1', "C b'1'"} <= set(bench.said()))
        assert master.wait_for_node('/program', TIMEOUT).pid != composed.pid
        assert master.wait_for_node('/other', TIMEOUT).pid == composed.pid
    assert f'/program runs in a group of its own: {reason}' in composed.output


SAYS_WHERE = '''
rospy.init_node('program')
variable = os.popen('echo $GPU').read()
say(f'{rospy.get_name()} {os.getpid()} {variable}')
rospy.spin()
'''


def where(bench, count):
    """Wait until so many nodes have said where they run; return {name: (PID, $GPU of a child)}."""
    until(lambda: len([line for line in bench.said() if line]) >= count)
    rows = [line.split(' ') for line in bench.said() if line]
    return {name: (int(pid), variable) for name, pid, variable in rows}


def test_nodes_of_one_environment_share_this_process(master, bench):
    """An <env> at the top of the file holds for all."""
    scripts = {name: SAYS_WHERE for name in ('one', 'two', 'three')}
    path = bench.launch_file('<env name="GPU" value="1"/>', **scripts)
    with bench.program(path) as composed:
        places = where(bench, 3)
        assert set(places.values()) == {(composed.pid, '1')}
    assert 'runs in' not in composed.output


def test_each_environment_is_one_process(master, bench):
    env = '<env name="GPU" value="{}"/>'
    bench.write(SAYS_WHERE)
    node = '<node pkg="bench" type="program" name="{}">{}</node>'
    names = {'a': '', 'b': '', 'c': env.format(1), 'd': env.format(1), 'e': env.format(2)}
    xml = ''.join(node.format(name, variable) for name, variable in names.items())
    with bench.program(bench.launch_file(xml)) as composed:
        places = where(bench, 5)
        assert [places[f'/{name}'][1] for name in 'abcde'] == ['', '', '1', '1', '2']
        pids = [places[f'/{name}'][0] for name in 'abcde']
        assert pids[0] == pids[1] == composed.pid
        assert pids[2] == pids[3] and len(set(pids)) == 3


def test_group_has_no_variable_of_this_process(master, bench):
    bench.write(SAYS_WHERE)
    node = '<node pkg="bench" type="program" name="{}">{}</node>'
    env = '<env name="GPU" value="1"/>'
    xml = node.format('a', env) + node.format('b', env) + node.format('c', '')
    with bench.program(bench.launch_file(xml)) as composed:
        places = where(bench, 3)
        assert places['/a'] == places['/b'] == (composed.pid, '1')
        assert places['/c'][1] == ''


def test_composition_gives_the_environment_back(master, bench):
    path = bench.launch_file('<env name="GPU" value="1"/>', one=SPIN)
    with master.compose(None, path):
        assert os.environ['GPU'] == '1'
    assert 'GPU' not in os.environ


def test_only_program_has_the_environment_of_the_process(master, bench):
    path = bench.write("os.environ['GPU'] = '1'\n" + SAYS_GPU)
    with bench.program('--script', path) as composed:
        until(lambda: {'shell 1', "C b'1'"} <= set(bench.said()))
        assert master.node('/program').pid == composed.pid


def test_only_program_comes_back_with_its_environment(bench):
    bench.write(INIT + "say(os.environ.get('PATH'))\n")
    xml = '<node pkg="bench" type="program" name="program" respawn="true"/>'
    with bench.program(bench.launch_file(xml)):
        until(lambda: len(bench.said()) >= 2)
    first, second, *_ = bench.said()
    assert first == second != 'None'


# -- crashes are told

CRASH = '''
import ctypes
rospy.init_node('program')
say(os.getpid())
while not rospy.get_param('/crash', False): time.sleep(0.01)
rospy.delete_param('/crash')
ctypes.string_at(0)
'''
GROUP = '<param name="pharos_group" value="g"/>'


@pytest.mark.parametrize('ending', ['SIGSEGV', 'SIGKILL'])
def test_crash_of_a_group_is_told_and_its_node_respawns(master, bench, ending):
    bench.write(CRASH)
    bench.write(SPIN.replace("'program'", "'beside'"), 'beside')
    xml = f'<node pkg="bench" type="program" name="program" respawn="true">{GROUP}</node>'
    xml += f'<node pkg="bench" type="beside" name="beside">{GROUP}</node>'

    def process_ids():
        return [int(line) for line in bench.said() if line.isdigit()]

    with bench.program(bench.launch_file(xml)) as composed:
        for count in 1, 2:
            until(lambda count=count: len(process_ids()) == count)
            master.wait_for_node('/program', TIMEOUT)
            if ending == 'SIGKILL':
                os.kill(process_ids()[-1], signal.SIGKILL)
            else:
                master.parameters['/crash'] = True
            until(lambda count=count: len(process_ids()) == count + 1)
            until(lambda: '/beside' not in [each.name for each in master.nodes()])
        assert end(composed) == 1
    assert f'/program: {ending} has ended their process' in composed.output
    assert '/program: back in a new process' in composed.output
    if ending == 'SIGSEGV':
        assert 'bench/program", line' in composed.output


def test_crash_of_a_group_with_a_required_node_ends_all(master, bench):
    bench.write(CRASH)
    xml = f'<node pkg="bench" type="program" name="program" required="true">{GROUP}</node>'
    with bench.program(bench.launch_file(xml, other=SPIN)) as composed:
        until(lambda: 'ready' in bench.said() and len(bench.said()) == 2)
        master.parameters['/crash'] = True
        assert composed.wait() == 1
    assert not any(master.system_state())


def test_nodes_of_a_killed_roslaunch_end_or_respawn(master, bench):
    bench.write(INIT + "say(os.getpid())\nrospy.spin()\n")
    xml = ''.join(
        f'<node pkg="bench" type="program" name="{name}" respawn="{respawn}"/>'
        for name, respawn in [('one', 'true'), ('two', 'false')]
    )
    with bench.program(bench.launch_file(xml), '--apart', 'one', 'two') as composed:
        until(lambda: len(bench.said()) == 2)
        for name in 'one', 'two':
            master.wait_for_node(f'/{name}', TIMEOUT)
        two = master.node('/two')
        os.kill(psutil.Process(two.pid).ppid(), signal.SIGKILL)
        until(lambda: len(bench.said()) == 3)
        assert master.wait_for_node('/one', TIMEOUT).is_alive()
        until(lambda: '/two' not in [each.name for each in master.nodes()])
        assert end(composed) == 1
    until(lambda: not any(psutil.pid_exists(int(pid)) for pid in bench.said()))


def test_interrupt_while_roslaunch_starts_ends_its_nodes(master, bench):
    # not in Python, which may lose a KeyboardInterrupt while it imports: roslaunch waits 15 s then
    bench.write(f'#!/bin/sh\necho $$ >> {bench.folder}/said\nexec sleep 1000\n', head='')
    names = [f'node{number}' for number in range(6)]
    xml = ''.join(f'<node pkg="bench" type="program" name="{name}"/>' for name in names)
    with bench.program(bench.launch_file(xml), '--apart', *names) as composed:
        until(lambda: 'process[node0' in composed.output)
        begin = time.monotonic()
        end(composed)
        assert time.monotonic() - begin < 10
    assert not any(psutil.pid_exists(int(pid)) for pid in bench.said())


def assert_ends_within(bench, seconds, text):
    """In one of three runs, Ctrl-C ends the program so soon: the computer may be busy."""
    for run in range(1, 4):
        with bench.program('--script', bench.write(text)) as composed:
            until(lambda run=run: bench.said().count('ready') == run)
            begin = time.monotonic()
            end(composed)
            duration = time.monotonic() - begin
        if duration < seconds:
            return composed.output
    pytest.fail(f'it ends after {duration} s')


def test_end_waits_for_no_thread_that_blocks_and_for_no_lock_of_the_main_loop(bench):
    text = '''
        import queue
        lock = threading.Lock()
        rospy.init_node('program')
        rospy.on_shutdown(lambda: [lock.acquire(), lock.release()])
        threading.Thread(target=queue.Queue().get, daemon=True).start()
        rospy.loginfo('begins')
        say('ready')
        while not [lock.acquire(), rospy.is_shutdown(), lock.release()][1]: sum(range(10**5))
        '''
    output = assert_ends_within(bench, 10, text)
    (line,) = [line for line in output.splitlines() if 'begins' in line]
    assert line.count('program') == 1 and 'leaves' not in output


def test_end_waits_for_no_thread_of_a_library(bench):
    text = '''
        import socket, socketserver
        class Handler(socketserver.BaseRequestHandler):
            def handle(self): self.request.recv(100)
        rospy.init_node('program')
        server = socketserver.ThreadingTCPServer(('127.0.0.1', 0), Handler)
        rospy.on_shutdown(server.shutdown)
        client = socket.create_connection(server.server_address)
        threading.Thread(target=lambda: [time.sleep(0.1), say('ready')], daemon=True).start()
        server.serve_forever()
        '''
    assert_ends_within(bench, 5, text)


def test_slow_end_is_told(bench):
    text = "rospy.init_node('program')\nrospy.on_shutdown(lambda: time.sleep(4))\n"
    text += "rospy.sleep(0.5)\n" + SPIN
    with bench.program('--script', bench.write(text)) as composed:
        until(lambda: 'ready' in bench.said())
        end(composed)
    assert 'the end waits for /program; a further Ctrl-C ends all at once' in composed.output


@pytest.mark.parametrize('option', ['--apart', '--group'])
def test_nodes_end_with_a_killed_composition(master, bench, option):
    path = bench.launch_file(program=INIT + "say('ready')\nrospy.spin()\n")
    with bench.program(path, option, 'program') as composed:
        until(bench.said)
        os.kill(composed.pid, signal.SIGKILL)
        until(lambda: not any(master.system_state()))


# -- as rospy, and as Python


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


def test_program_chooses_its_master(master, bench):
    with pharos.Master.embedded() as other:
        script = bench.load(f"os.environ['ROS_MASTER_URI'] = '{other.url}'\n" + SPIN)
        assert script.master == other
        assert '/program' in [each.name for each in other.nodes()]
        assert not any(master.system_state())
        script.stop()


def test_system_default_of_sigint_ends_at_once(bench):
    text = '''
        rospy.init_node('program')
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        rospy.on_shutdown(lambda: say('hook'))
        atexit.register(lambda: say('atexit'))
        say('ready')
        while True: time.sleep(0.01)
        '''
    script = bench.load(text)
    until(lambda: bench.said() == ['ready'])
    script.stop()
    assert bench.said() == ['ready']


def test_hooks_for_exceptions_are_called(bench):
    text = '''
        sys.excepthook = lambda kind, error, trace: say(f'main {kind.__name__}')
        threading.excepthook = lambda args: say(f'{args.thread.name} {args.exc_type.__name__}')
        rospy.init_node('program')
        thread = threading.Thread(target=lambda: 1 / 0, name='worker')
        thread.start()
        thread.join()
        raise RuntimeError
        '''
    assert bench.load(text).wait(TIMEOUT) == 1
    assert bench.said() == ['worker ZeroDivisionError', 'main RuntimeError']


LOADERS = {
    'spec': "spec = importlib.util.spec_from_file_location('plug', path)\n"
    'm = importlib.util.module_from_spec(spec)\nspec.loader.exec_module(m)',
    'loader': "m = importlib.machinery.SourceFileLoader('plug', path).load_module()",
    'imp': "import warnings; warnings.simplefilter('ignore')\n"
    "import imp; m = imp.load_source('plug', path)",
    'runpy': 'import runpy, types; m = types.SimpleNamespace(**runpy.run_path(path))',
}
PLUG = "import rospy\ndef name(): return rospy.get_name()\n"


@pytest.mark.parametrize('how', LOADERS)
def test_loaded_plugin_has_the_rospy_of_its_node(bench, how):
    if how == 'imp' and sys.version_info >= (3, 12):
        pytest.skip('Python has no imp any more')
    path = bench.write(PLUG, 'plugins/plug.py', '')
    head = f'import importlib.machinery, importlib.util\npath = {path!r}\n'
    assert bench.load(f'{INIT}{head}{LOADERS[how]}\nsay(m.name())').wait(TIMEOUT) == 0
    assert bench.said() == ['/program']


def test_shared_module_is_imported_by_one_thread_at_a_time(bench, tmp_path, monkeypatch):
    """Two modules that import each other fail if two threads begin with one each, as in Python."""
    for one, other in ('a', 'b'), ('b', 'a'):
        text = f'import time\ntime.sleep(0.3)\nimport circle_{other}\ncircle_{other}.__file__, 1\n'
        (tmp_path / f'circle_{one}.py').write_text(text + f'value = "{one}"\n')
    monkeypatch.setenv('PYTHONPATH', f'{tmp_path}:{os.environ["PYTHONPATH"]}')
    begin = 'from circle_{0} import value\nrospy.init_node("{0}")\nsay(value)\n'
    launch = bench.launch_file(**{name: begin.format(name) for name in 'ab'})
    with bench.program(launch) as composed:
        assert composed.wait() == 0
    assert sorted(bench.said()) == ['a', 'b']


def test_forked_child_ends_nothing_of_its_parents(master, bench):
    text = '''
        rospy.init_node('program')
        pid = os.fork()
        if not pid: os._exit(5)
        say(os.waitpid(pid, 0)[1] >> 8)
        rospy.spin()
        '''
    script = bench.load(text)
    until(lambda: bench.said() == ['5'])
    assert script.is_running and '/program' in [each.name for each in master.nodes()]


def test_traceback_has_the_frames_of_the_program(bench, capfd):
    with pytest.raises(pharos.PharosError):
        bench.load('def read():\n    import no_such_module\nread()')
    lines = [line for line in capfd.readouterr().err.splitlines() if 'File "' in line]
    assert len(lines) == 2 and all('bench/program' in line for line in lines)


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


# -- on the command line


def test_scripts_start_side_by_side_with_arguments(master, bench):
    waits = 'while not os.path.exists(SAID): time.sleep(0.01)\n'
    slow = bench.write(f'{waits}{INIT}rospy.spin()', 'slow')
    quick = bench.write(
        "rospy.init_node('quick')\nsay(rospy.get_param('~rate'))\nrospy.spin()", 'quick'
    )
    with bench.program('--script', slow, quick, '_rate:=5', '__ns:=/left') as composed:
        until(lambda: bench.said() == ['5'])
        assert master.wait_for_node('/left/program', TIMEOUT)
        assert master.node('/left/quick').pid == composed.pid


@pytest.mark.parametrize('text, status', [('sys.exit(3)', 3), ('1 / 0', 1), ('', 0)])
def test_status_is_that_of_the_only_program(bench, text, status):
    with bench.program(bench.write(INIT + text, 'program.py')) as composed:
        assert composed.wait() == status


def test_without_arguments_its_usage_is_shown(master):
    with Program(COMPOSE, master.url) as composed:
        assert composed.wait() == 2
    assert 'usage: compose' in composed.output


@pytest.mark.parametrize(
    'output, option, is_shown',
    [('', '', False), ('output="screen"', '', True), ('', '--screen', True)],
)
def test_output_is_as_with_roslaunch(bench, output, option, is_shown):
    bench.write(INIT + "print('printed')\nrospy.loginfo('logged')\nrospy.logwarn('warned')")
    xml = f'<node pkg="bench" type="program" name="program" {output}/>'
    with bench.program(bench.launch_file(xml), *filter(None, [option])) as composed:
        composed.wait()
    assert 'warned' in composed.output
    files = (bench.folder.parent / 'log').rglob('program-1-stdout.log')
    text = composed.output if is_shown else next(files).read_text()
    assert 'printed' in text and 'logged' in text
    assert ('printed' in composed.output) == ('logged' in composed.output) == is_shown


# -- control


def test_silent_client_keeps_no_other_out(master, bench):
    with master.compose(None, bench.launch_file(program=SPIN)) as composition:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as silent:
            silent.connect(f'\0pharos-compose-{os.getpid()}')
            control('restart', '/program', master)
        assert composition.nodes[0].is_running


def test_name_is_free_if_another_node_has_its_uri(master):
    other = create(master, '/other')
    master.call('registerPublisher', '/words', STRING, other.uri, caller_id='/talker')
    assert master.call('lookupNode', '/talker') == other.uri
    assert create(master, '/talker').is_running
    assert other.is_running


def test_program_is_controlled_by_the_names_of_its_nodes(master, bench):
    bench.write(
        """
        master = pharos.Master()
        for name in 'arm', 'hand': master.create(pharos.BlockNode, name)
        say('ready')
        pharos.spin()
        """
    )
    launch = bench.launch_file('<node pkg="bench" type="program" name="program"/>')
    with master.compose(None, launch) as composition:
        until(lambda: bench.said() == ['ready'])
        assert control('stop', '/hand', master) == '/program'
        assert not composition.nodes[0].is_running
        assert control('start', '/arm', master) == '/program'
        until(lambda: bench.said() == ['ready'] * 2)


@pytest.mark.parametrize(
    'name, text, said',
    [
        ('helper.py', 'import rospy\nx = = 1\n', r'helper\.py:2: '),
        ('program', 'def', 'cannot be read as Python 3'),
    ],
)
def test_restart_keeps_a_node_that_cannot_be_read(master, bench, name, text, said):
    bench.write('import rospy\n', 'helper.py', '')
    with master.compose(None, bench.launch_file(program='import helper\n' + SPIN)) as composition:
        until(lambda: bench.said() == ['ready'])
        bench.write(text, name, '')
        with pytest.raises(pharos.PharosError, match=said):
            composition.control(composition.nodes[0], 'restart')
        assert composition.nodes[0].is_running


OWN_DRIVER = '''
import socket
class Driver(pharos.Node):
    def start(self):
        super().start()
        self.device = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.device.bind(('127.0.0.1', {port}))
        say('opened')
        self.fork(Driver.work, required=True)
    def work(self):
        self.sleep(0.1)
        1 / 0
master = pharos.Master()
master.create(Driver, 'driver', argv=sys.argv)
master.create(pharos.BlockNode, 'beside', argv=sys.argv)
pharos.spin()
'''


def test_driver_of_pharos_respawns_and_opens_its_device_again(bench, port):
    bench.write(OWN_DRIVER.format(port=port))
    launch = bench.launch_file('<node pkg="bench" type="program" name="program" respawn="true"/>')
    with bench.program(launch):
        until(lambda: bench.said().count('opened') >= 3)


# -- looks that fail, and lines that cannot be printed

RESPAWNS = '<node pkg="bench" type="program" name="{}" respawn="true"/>'
LOOKS = {
    'look': (Composition, '_look'),
    'ended': (Composition, '_look_at_ended'),
    'respawn': (Composition, '_respawn'),
    'over': (Composition, 'is_over'),
    'start': (ScriptNode, '_start_held'),
    'line': (type(pharos.Transcript), 'show'),
}


def fail_each_second_time(monkeypatch, owner, name):
    """Have a method or property raise an exception; the first time, too."""
    original, count = getattr(owner, name), itertools.count()
    is_property = isinstance(original, property)

    def fail(*args, **kwargs):
        if next(count) % 2 == 0:
            raise RuntimeError('this look fails')
        return (original.fget if is_property else original)(*args, **kwargs)

    monkeypatch.setattr(owner, name, property(fail) if is_property else fail)


@pytest.mark.parametrize('what', LOOKS)
def test_failed_look_ends_no_respawn(master, bench, monkeypatch, what):
    bench.write(INIT + "say('here')\n")
    with master.compose(None, bench.launch_file(RESPAWNS.format('program'))):
        with monkeypatch.context() as moment:
            fail_each_second_time(moment, *LOOKS[what])
            count = len(bench.said())
            until(lambda: len(bench.said()) > count + 3)


def test_failed_look_costs_no_other_program(master, bench, monkeypatch):
    bench.write("rospy.init_node('program')\nsay(rospy.get_name())\n")
    xml = RESPAWNS.format('first') + RESPAWNS.format('second')
    look = Composition._look_at_ended

    def fail_for_first(composition, node):
        if node.name == '/first':
            raise RuntimeError('this look fails')
        look(composition, node)

    monkeypatch.setattr(Composition, '_look_at_ended', fail_for_first)
    with master.compose(None, bench.launch_file(xml)):
        until(lambda: bench.said().count('/second') > 3)


@pytest.mark.parametrize('output', ['reader gone', 'full disk'])
def test_respawn_goes_on_without_output(master, bench, output):
    """As with `| tee` that is killed, or a lost ssh."""
    bench.write(INIT + "say('here')\n")
    path = bench.launch_file(RESPAWNS.format('program'))
    with open('/dev/full', 'w') as full:
        stdout = full if output == 'full disk' else subprocess.PIPE
        composed = subprocess.Popen(
            [*DEFAULT_SIGNALS, *COMPOSE, path], stdout=stdout, stderr=subprocess.STDOUT
        )
    try:
        if composed.stdout:
            until(bench.said)
            composed.stdout.close()
        count = len(bench.said())
        until(lambda: len(bench.said()) > count + 4)
        composed.send_signal(signal.SIGINT)
        assert composed.wait(TIMEOUT) == 0
    finally:
        composed.kill()
        composed.wait()


EDITED = '''
def word(): return '{}'
rospy.init_node('program')
last = ''
while not rospy.is_shutdown():
    if word() != last:
        last = word()
        say(last)
    time.sleep(0.01)
'''


@pytest.mark.parametrize('what', ['editable_modules', '_answer', 'Transcript'])
def test_failed_look_at_files_is_made_again(master, bench, monkeypatch, what):
    failed, may_fail = threading.Event(), threading.Event()

    def failing_once(function):
        def call(*args, **kwargs):
            if may_fail.is_set() and not failed.is_set():
                failed.set()
                raise RuntimeError('this look fails')
            return function(*args, **kwargs)

        return call

    module = 'pharos.compose.control'
    if what == 'editable_modules':
        monkeypatch.setattr(f'{module}.editable_modules', failing_once(editable_modules))
    elif what == '_answer':
        monkeypatch.setattr(f'{module}._answer', failing_once(pharos.compose.control._answer))
    else:
        monkeypatch.setattr(type(pharos.Transcript), 'show', failing_once(lambda *things: None))
    with master.compose(None, bench.launch_file(program=EDITED.format('first'))) as composition:
        thread = threading.Thread(target=reload_on_save, args=[composition])
        thread.start()
        until(lambda: bench.said() == ['first'])
        # nothing sees a save before the first look
        until(lambda: bench.write(EDITED.format('second')) and len(bench.said()) > 1)
        may_fail.set()
        bench.write(EDITED.format('the third'))
        assert failed.wait(TIMEOUT)
        bench.write(EDITED.format('the fourth'))
        until(lambda: bench.said()[-1] == 'the fourth')
    thread.join(TIMEOUT)


def test_failed_accept_ends_no_control(master, bench, monkeypatch):
    accept, failed = socket.socket.accept, threading.Event()

    def fail_once(sock):
        if sock.family == socket.AF_UNIX and not failed.is_set():
            failed.set()
            raise ValueError('odd')
        return accept(sock)

    with master.compose(None, bench.launch_file(program=SPIN)):
        monkeypatch.setattr(socket.socket, 'accept', fail_once)
        control('restart', '/program', master)
        assert failed.wait(TIMEOUT)
        assert control('restart', '/program', master) == '/program'


TAKES_NAME = '''
import socket, sys, threading
sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
sock.bind('\\0pharos-compose-' + sys.argv[1])
sock.listen()
print('taken', flush=True)
threading.Event().wait()
'''


@needs_other_user
def test_control_name_that_another_user_has_is_told(master, bench, transcript):
    """The name has the number of this process: the nodes of the composition cannot be controlled."""
    command = [*OTHER_USER, PYTHON, '-c', TAKES_NAME, str(os.getpid())]
    with Program(command, master.url) as thief:
        thief.expect('taken')
        with master.compose(None, bench.launch_file(program=SPIN)):
            until(bench.said)
        thief.signal(signal.SIGKILL)
    (line,) = [line for line in transcript if 'control name' in line]
    assert 'user' in line
