"""Programs and nodes that have a device end, come back, and open it again."""
import itertools
import os
import pty
import signal
import socket
import subprocess
import tty

import pytest

import pharos
from helpers import COMPOSE, DEFAULT_SIGNALS, INIT, SPIN, TIMEOUT
from pharos.compose.composition import Composition
from pharos.compose.script import ScriptNode

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
        bench.until(lambda: bench.said().count('opened') >= 3)


@pytest.mark.parametrize('reader', READERS)
def test_stop_gives_the_device_back(bench, port, reader):
    script = bench.load(driver(port, reader))
    bench.until(lambda: bench.said() == ['begins', 'opened'])
    script.stop()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(('127.0.0.1', port))


def test_stop_of_a_main_thread_that_reads_gives_the_device_back(bench, port):
    script = bench.load(driver(port, rest='device = driver.device\nwhile True: device.recv(10)'))
    bench.until(lambda: bench.said() == ['begins', 'opened'])
    script.stop_timeout = 0.1
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
        bench.until(lambda count=count: bench.said().count('opened') == count)
        script.restart()
    os.close(device)
    os.close(program_end)


def test_restarted_script_needs_not_its_former_ports(master, bench):
    script = bench.load(SPIN)
    script.stop()
    with socket.create_server(('127.0.0.1', script.tcp_port)):
        script.start()
    assert script.is_running


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
        bench.until(lambda: bench.said().count('opened') >= 3)


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
            bench.until(lambda: len(bench.said()) > count + 3)


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
        bench.until(lambda: bench.said().count('/second') > 3)


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
            bench.until(bench.said)
            composed.stdout.close()
        count = len(bench.said())
        bench.until(lambda: len(bench.said()) > count + 4)
        composed.send_signal(signal.SIGINT)
        assert composed.wait(TIMEOUT) == 0
    finally:
        composed.kill()
        composed.wait()
