"""The programs that rosrun starts, pharos.testing, spin() and the Transcript."""
import contextlib
import re
import signal
import subprocess
import threading

import pytest

import pharos
from helpers import PYTHON, TIMEOUT, Program, create, free_port
from pharos import BlockNode, Master, Transcript
from pharos.testing import Mailbox, until

COMMANDS = '/turtle1/command_velocity'
VELOCITY = 'turtlesim/Velocity'
STRING = 'std_msgs/String'
NEED_MASTER = [
    *('turtle_driver', 'block_subscriber', 'clear_turtle', 'turtle_simulator', 'graph'),
    'top',
]
NOWHERE = 'http://127.0.0.1:1/'  # no master is there


@contextlib.contextmanager
def running(url, name, *arguments):
    """Run a program of pharos for the block; end it by Ctrl-C, as its user would."""
    with Program(['rosrun', 'pharos', name], url, *arguments) as program:
        yield program
        if program.poll() is None:
            program.signal(signal.SIGINT)
            program.wait()


def run(url, name, *arguments):
    """Run a program of pharos to its end; returns its exit code and what it printed."""
    with Program(['rosrun', 'pharos', name], url, *arguments) as program:
        return program.wait(), program.output


# -- what is missing


@pytest.mark.parametrize('command', NEED_MASTER)
def test_missing_master_is_named(command):
    code, output = run(NOWHERE, *command.split())
    assert code == 1
    assert NOWHERE.rstrip('/') in output
    assert 'Traceback' not in output


def test_python_without_rospy_is_named():
    with Program("import sys; sys.modules['rospy'] = None; import pharos", NOWHERE) as program:
        assert program.wait() == 1
        assert f'{PYTHON} has no rospy: ' in program.output
        assert program.output.endswith('/usr/bin/python3\n')


# -- the listings of the report, with a node in the turtle's place


@pytest.fixture
def turtle(master):
    """The commands to a turtle, as a Mailbox."""
    node = create(master, '/turtlesim')
    node.output_channel('/turtle1/pose', 'turtlesim/Pose')
    return Mailbox(node, COMMANDS, VELOCITY)


def speeds(mailbox):
    """Return the speeds of the next command."""
    command = mailbox.next()
    return command.linear, command.angular


def test_turtle_driver_drives_again_and_again(master, turtle):
    with running(master.url, 'turtle_driver', '_linear:=0.5', '_angular:=-1', '_period:=0.02'):
        assert [speeds(turtle) for _ in range(3)] == 3 * [(0.5, -1.0)]
        assert master.node('/my_turtle_driver').is_alive()


def test_turtle_driver_has_address_and_port(master, turtle):
    port = free_port()
    with running(master.url, 'turtle_driver', '--domain', '127.0.0.1', '--xmlrpc-port', str(port)):
        assert speeds(turtle) == (2.0, 1.0)
        assert master.node('/my_turtle_driver').uri == f'http://127.0.0.1:{port}/'


@pytest.mark.parametrize('name', ['turtle_logger', 'block_subscriber', 'block_both'])
def test_subscriber_prints_what_it_hears(master, turtle, name):
    with running(master.url, name, '__name:=listener') as program:
        driver = create(master, '/driver').output_channel(COMMANDS, VELOCITY)
        until(lambda: '/listener' in master.topic(COMMANDS).subscribers)
        driver.wait_for_subscribers(2, TIMEOUT)
        driver.send(linear=1.25, angular=-3.5)
        program.expect('linear: 1.25')
        program.expect('angular: -3.5')


@pytest.mark.parametrize('how', [[], ['--execute']])
def test_block_publisher_sends_one_command(master, turtle, how):
    assert run(master.url, 'block_publisher', *how, '_linear:=0.25')[0] == 0
    assert speeds(turtle) == (0.25, 1.0)
    assert len(turtle.all()) == 1


def test_block_publisher_sends_in_background(master, turtle):
    with running(master.url, 'block_publisher', '--background'):
        assert [speeds(turtle) for _ in range(2)] == 2 * [(-2.0, 1.0)]


def test_block_both_hears_itself(master, turtle):
    with running(master.url, 'block_both', '_angular:=0.5') as program:
        assert speeds(turtle) == (-2.0, 0.5)
        program.expect('angular: 0.5')


@pytest.mark.parametrize('arguments', [[], ['_md5sum:=d41d8cd98f00b204e9800998ecf8427e']])
def test_clear_turtle_calls_the_service(master, arguments):
    cleared = threading.Event()
    create(master, '/turtlesim').serve('/clear', 'std_srvs/Empty', lambda _: cleared.set())
    code, output = run(master.url, 'clear_turtle', *arguments)
    assert code == 0
    assert cleared.is_set()
    assert 'std_srvs/Empty' in output


def test_clear_turtle_fails_with_wrong_md5sum(master):
    create(master, '/turtlesim').serve('/clear', 'std_srvs/Empty', lambda _: None)
    code, output = run(master.url, 'clear_turtle', '_md5sum:=0123456789abcdef0123456789abcdef')
    assert code == 1
    assert '/clear' in output and 'std_srvs/Empty' in output


def test_listing_follows_remappings(master):
    node = create(master, '/turtlesim')
    node.output_channel('/turtle2/pose', 'turtlesim/Pose')
    mailbox = Mailbox(node, '/turtle2/velocity', VELOCITY)
    with running(master.url, 'turtle_driver', f'{COMMANDS}:=/turtle2/velocity'):
        assert speeds(mailbox) == (2.0, 1.0)


@pytest.fixture(scope='module')
def drive():
    """The outcome of turtle.launch without a window, and of a second turtle."""
    with Master.embedded() as master, master.create(BlockNode, named='/ear') as ear:
        poses = Mailbox(ear, '/turtle1/pose', 'turtlesim/Pose')
        args = {'window': 'false', 'period': 0.1, 'linear': 1.5}
        with master.launch('pharos', 'turtle.launch', **args) as process:
            first = poses.next()
            driven = poses.wait_for(lambda pose: pose.theta > 0.1)
            until(lambda: 'linear: 1.5' in ''.join(process.output), TIMEOUT)
            spawned = master.lookup_service('/spawn').call(x=1.0, y=2.0, theta=0.0, name='leo')
            leo = ear.wait_for_message('/leo/pose', 'turtlesim/Pose', TIMEOUT)
            master.wait_for_node('/turtle_logger', TIMEOUT)
            names = {node.name for node in master.nodes()}
    return {'poses': [first, driven], 'spawned': spawned, 'leo': leo, 'names': names}


def test_turtle_launch_starts_all_three(drive):
    assert {'/turtlesim', '/turtle_driver', '/turtle_logger'} <= drive['names']


def test_simulated_turtle_is_driven(drive):
    first, driven = drive['poses']
    assert driven.x > first.x
    assert driven.linear_velocity == 1.5


def test_simulator_spawns_another_turtle(drive):
    assert drive['spawned'].name == 'leo'
    assert (drive['leo'].x, drive['leo'].y) == (1.0, 2.0)


def test_simulator_saves_a_picture(master, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with running(master.url, 'turtle_simulator', '_window:=false'):
        saved = master.wait_for_service('/turtlesim/save_picture', TIMEOUT).call()
        assert saved.success and saved.message == f'{tmp_path}/turtlesim.png'
        assert (tmp_path / 'turtlesim.png').read_bytes().startswith(b'\x89PNG')


# -- bridge


@pytest.fixture
def robots(master):
    """Two masters, as of two robots, with the bridge for /chat; and a node with Mailbox on each."""
    with Master.embedded() as other:
        nodes = [create(each, '/talker') for each in (master, other)]
        boxes = [Mailbox(node, '/chat', STRING) for node in nodes]
        with running(master.url, 'bridge', master.url, other.url, '/chat'):
            until(
                lambda: all(
                    '/bridge' in each.topic('/chat').subscribers for each in (master, other)
                )
            )
            yield nodes, boxes
        for node in nodes:
            node.stop()


@pytest.mark.parametrize('here, there', [(0, 1), (1, 0)])
def test_bridge_joins_two_masters(robots, here, there):
    nodes, boxes = robots
    for text in 'abc':
        nodes[here].send_to('/chat', typed_as=STRING, data=text)
    assert [boxes[there].next().data for _ in 'abc'] == ['a', 'b', 'c']
    nodes[there].send_to('/chat', typed_as=STRING, data='back')
    assert boxes[here].wait_for(lambda message: message.data == 'back')
    assert [message.data for message in boxes[here].all()] == ['a', 'b', 'c', 'back']


def test_bridge_passes_latched_messages_on(master):
    with Master.embedded() as other:
        map_server = create(master, '/map_server').output_channel('/map', STRING, latch=True)
        map_server.send(data='map')
        with running(master.url, 'bridge', master.url, other.url, '/map'):
            with other.create(BlockNode, named='/early') as early:
                assert early.wait_for_message('/map', STRING, TIMEOUT).data == 'map'
            with other.create(BlockNode, named='/late') as late:
                assert late.wait_for_message('/map', STRING, TIMEOUT).data == 'map'


def test_bridge_needs_two_masters(master):
    code, output = run(master.url, 'bridge', master.url, master.url, '/chat')
    assert code == 1
    assert master.url in output


# -- create_package


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """A package made in a workspace."""
    source = tmp_path_factory.mktemp('made') / 'src'
    source.mkdir()
    command = [
        'rosrun',
        'pharos',
        'create_package',
        'my_robot',
        '--node',
        'camera',
        'line_follower',
    ]
    subprocess.run(command, cwd=source, check=True, stdout=subprocess.PIPE)
    return source / 'my_robot'


def test_made_package_has_its_nodes(made):
    assert {'camera', 'line_follower'} <= {path.name for path in (made / 'scripts').iterdir()}


def test_made_package_passes_its_tests(made):
    done = subprocess.run(
        [PYTHON, '-m', 'pytest', '-q', 'test'], cwd=made, text=True, stdout=subprocess.PIPE
    )
    assert done.returncode == 0, done.stdout


def test_made_package_builds_and_runs(made, master):
    make = ['catkin_make', '-C', str(made.parent.parent), f'-DPYTHON_EXECUTABLE={PYTHON}']
    done = subprocess.run(make, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert done.returncode == 0, done.stdout
    setup = f'. {made.parent.parent}/devel/setup.sh && exec rosrun my_robot camera'
    with Program(['sh', '-c', setup], master.url) as program:
        assert master.wait_for_node('/camera', TIMEOUT).is_alive()
        program.signal(signal.SIGINT)
        program.wait()


# -- pharos.testing

TESTS = '''
import threading
import pytest
import rosgraph
from pharos import BlockNode, Master, Node
from pharos.testing import Mailbox, expect_failures, until

STRING = 'std_msgs/String'


class Echo(Node):
    def __init__(self, times=1):
        super().__init__()
        self.times = times

    def start(self):
        super().start()
        self.interested_in('/heard', STRING, delegate=self.repeat)

    def repeat(self, message, channel):
        if not message.data:
            raise ValueError('nothing was said')
        self.send_to('/said', typed_as=STRING, data=message.data * self.times)


@pytest.fixture
def said(create_node):
    return Mailbox(create_node(BlockNode, '/ear'), '/said', STRING)


def test_master_is_embedded(master):
    assert isinstance(master, Master) and master.is_reachable()
    assert Master().url == master.url


def test_node_is_created(create_node, said):
    create_node(Echo, times=2).send_to('/heard', typed_as=STRING, data='hey')
    assert said.next(timeout=20).data == 'heyhey'


def test_node_is_named(create_node):
    assert create_node(Echo, '/deep/echo').name == '/deep/echo'
    assert create_node(Echo).name != create_node(Echo).name


def test_mailbox_keeps_all(create_node, said):
    echo = create_node(Echo)
    for text in 'abc':
        echo.send_to('/heard', typed_as=STRING, data=text)
    assert said.wait_for(lambda message: message.data == 'b', 20).data == 'b'
    until(lambda: len(said.all()) == 3, 20)
    assert [message.data for message in said.all()] == ['a', 'b', 'c']
    assert said.next().data == 'c'


def test_mailbox_has_time_limit(said):
    with pytest.raises(TimeoutError):
        said.next(0.01)
    with pytest.raises(TimeoutError):
        said.wait_for(lambda message: True, 0.01)


def test_until_returns_value():
    values = iter([None, 0, 7])
    assert until(lambda: next(values), 20) == 7


def test_until_has_time_limit():
    with pytest.raises(TimeoutError):
        until(lambda: False, 0.01)


def test_failure_is_expected(create_node):
    expect_failures()
    echo = create_node(Echo)
    echo.send_to('/heard', typed_as=STRING, data='')
    until(lambda: echo.failures, 20)


def test_failure_fails(create_node):
    echo = create_node(Echo)
    echo.send_to('/heard', typed_as=STRING, data='')
    until(lambda: echo.failures, 20)


def test_left_node_fails(master):
    master.create(BlockNode, named='/forgotten')
'''
SLOW_TESTS = '''
import threading
import rosgraph
from pharos import testing


def test_left_thread_fails(master, monkeypatch):
    monkeypatch.setattr(testing, 'TIMEOUT', 0.1, raising=False)
    threading.Thread(target=threading.Event().wait, name='forgotten', daemon=True).start()


def test_left_registration_fails(master, monkeypatch):
    monkeypatch.setattr(testing, 'TIMEOUT', 0.1, raising=False)
    api = rosgraph.Master('/forgotten', master.url)
    api.registerPublisher('/t', 'std_msgs/String', 'http://x/')
'''
SUCCESSES = re.findall(r'def (test_\w+(?<!_fails))\(', TESTS)
FAILURES = re.findall(r'def (test_\w+_fails)\(', TESTS + SLOW_TESTS)


@pytest.fixture(scope='module')
def tested(tmp_path_factory):
    """The outcome of each test of a user's package: ``{name: [PASSED, ERROR ...]}``."""
    folder = tmp_path_factory.mktemp('tested')
    (folder / 'conftest.py').write_text("pytest_plugins = ['pharos.testing']\n")
    (folder / 'test_robot.py').write_text(TESTS)
    (folder / 'test_slow.py').write_text(SLOW_TESTS)
    command = [PYTHON, '-m', 'pytest', '-rA', '-p', 'no:cacheprovider', f'--rootdir={folder}']
    done = subprocess.run([*command, str(folder)], cwd=folder, text=True, stdout=subprocess.PIPE)
    outcomes = {}
    for outcome, name in re.findall(
        r'^(PASSED|FAILED|ERROR) \S+::(\w+)', done.stdout, re.MULTILINE
    ):
        outcomes.setdefault(name, []).append(outcome)
    return outcomes


@pytest.mark.parametrize('name', SUCCESSES)
def test_users_test_passes(tested, name):
    assert tested[name] == ['PASSED']


@pytest.mark.parametrize('name', FAILURES)
def test_users_test_fails_for_its_rest(tested, name):
    assert set(tested[name]) & {'ERROR', 'FAILED'}


# -- spin and the Transcript


def test_spin_ends_with_last_node(master):
    source = '''
from pharos import BlockNode, Master, spin
nodes = [Master().create(BlockNode, named=name) for name in ('/one', '/two')]
nodes[0].stop()
nodes[1].soul = lambda me: me.stop()
nodes[1].fork()
spin()
print('over')
'''
    with Program(source, master.url) as program:
        assert program.wait() == 0
        assert program.output == 'over\n'


def test_spin_waits_for_nodes(master):
    source = '''
from pharos import BlockNode, Master, spin
node = Master().create(BlockNode, named='/node')
node.serve('/end', 'std_srvs/Empty', lambda request: node.fork(lambda me: me.stop()) and None)
spin()
'''
    with Program(source, master.url) as program:
        with contextlib.suppress(pharos.ServiceCallError):  # the stop may overtake the response
            master.wait_for_service('/end', TIMEOUT).call()
        assert program.wait() == 0


def test_spin_names_the_node_whose_soul_nobody_runs(master):
    source = '''
from pharos import BlockNode, Master, spin
Master().create(BlockNode, '/busy', soul=lambda me: me.sleep(60)).fork()
Master().create(BlockNode, '/idle', soul=lambda me: me.sleep(60))
spin()
'''
    with Program(source, master.url) as program:
        program.expect('/idle: nobody runs the soul')
        program.signal(signal.SIGINT)
        program.wait()  # with either status: the signal may come before the wait of spin()
    assert program.output.count('nobody runs') == 1


def test_transcript_shows_on_standard_output(master, capsys):
    Transcript.show('a line')
    Transcript.show(42)
    assert capsys.readouterr().out == 'a line\n42\n'


def test_transcript_shows_a_message(capsys):
    Transcript.show(pharos.message_class(STRING)('text'))
    assert capsys.readouterr().out == 'data: "text"\n'


def test_transcript_is_redirected(capsys):
    lines = []
    keep = lines.append
    before = Transcript.on_show(keep)
    Transcript.show('kept')
    assert Transcript.on_show(before) is keep
    Transcript.show('shown')
    assert lines == ['kept']
    assert capsys.readouterr().out == 'shown\n'


def test_transcript_keeps_lines_whole(capsys):
    threads = [
        threading.Thread(target=lambda: [Transcript.show('x' * 100) for _ in range(100)])
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(TIMEOUT)
    assert capsys.readouterr().out == 400 * ('x' * 100 + '\n')
