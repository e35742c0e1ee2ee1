"""rosrun pharos compose, as a user runs it, and its services of a nodelet manager."""
import contextlib
import os
import pty
import signal
import subprocess
import sys

import pytest

from helpers import create
from pharos import Master, ServiceCallError
from pharos.testing import Mailbox, TIMEOUT, until
from programs import ROOT, Program, environment, forget_parameters, run, script

PACKAGES = ROOT / 'test' / 'programs'
STRING = 'std_msgs/String'
NODELET = '/usr/lib/nodelet/nodelet'  # where rosrun finds it in Debian
LOAD = [NODELET, 'load', 'composed_robot/talker', 'compose', '__name:=talker']


@pytest.fixture(autouse=True)
def packages(monkeypatch, tmp_path):
    """The packages of test/programs are on ROS_PACKAGE_PATH; ROS's own folder is the test's."""
    monkeypatch.setenv('ROS_PACKAGE_PATH', os.pathsep.join([str(PACKAGES), '/usr/share']))
    monkeypatch.setenv('ROS_HOME', str(tmp_path))


@pytest.fixture
def compose(master):
    """``compose('composed_robot', 'chat.launch')``: the program, which ends with the test."""
    begun = []

    def compose(*arguments, url=master.url):
        begun.append(Program(url, sys.executable, script('compose'), *arguments))
        return begun[-1]

    yield compose
    for program in begun:
        program.end()
    forget_parameters(master.url)


def nodes(master):
    return {node.name for node in master.nodes()} - {'/rosout', '/pharos'}


def test_a_launch_file_is_composed_until_ctrl_c(master, compose):
    program = compose('composed_robot', 'chat.launch', 'text:=from the terminal')
    mailbox = Mailbox(create(master, '/hearer'), '/heard', STRING)
    assert mailbox.next(TIMEOUT).data == 'from the terminal'
    assert master.wait_for_node('/talker', TIMEOUT).pid == program.process.pid
    assert program.end(signal.SIGINT) == 0
    assert nodes(master) == {'/hearer'}


def test_nodes_share_connections_where_asked_for(master, compose):
    compose('--share-connections', 'composed_robot', 'mirrors.launch')
    sender = create(master, '/sender').output_channel('/where', STRING)
    boxes = [Mailbox(sender.node, f'/{side}/mirrored', STRING) for side in ('left', 'right')]
    for box in boxes:
        box.next(TIMEOUT)  # what it says when it has started
    until(lambda: all(hears(master, f'/{side}/mirror', sender) for side in ('left', 'right')))
    assert len(sender.connections) == 1
    sender.send(data='?')
    folders = [box.next(TIMEOUT).data for box in boxes]
    assert folders[0] == folders[1]


def hears(master, name, channel):
    return any(uri == channel.node.uri for _, uri, *_ in master.bus_info(name) or ())


def test_it_tells_how_far_it_has_come_and_what_has_become_of_each(compose):
    program = compose('composed_robot', 'missing.launch')
    program.wait_for('with_syntax_error (composed_robot/broken) is not started')
    program.end(signal.SIGINT)
    printed = program.read_to_the_end().splitlines()
    assert 'starting 1 of 2: /talker' in printed
    failed = '/with_syntax_error', '/without_package', '/without_program'
    assert printed[-4:] == ['/talker: stopped', *(f'{name}: did not start' for name in failed)]


def test_it_says_which_nodes_run_apart_and_why(master, compose):
    chosen = '--only', 'talker', 'relay', 'shell', 'prefixed', 'own_nodes', 'again'
    program = compose('composed_robot', 'robot.launch', 'robot:=r2', *chosen, '--apart', 'again')
    program.wait_for('starting 1 of 1: /r2/talker')
    lines = [line for line in program.printed if line.startswith('run apart: ')]
    assert lines == [
        'run apart: /r2/relay, /shell (not written in Python, or for another one than this)\n',
        'run apart: /prefixed (with a launch-prefix)\n',
        'run apart: /own_nodes (programs that use pharos make their nodes themselves; for one process'
        ' with all of them, write a program that makes these beside master.compose(), as'
        ' doc/compose.md says)\n',
        'run apart: /again (as asked for)\n',
    ]


def test_it_ends_when_all_nodes_have_ended(master, compose):
    program = compose('--script', 'composed_robot/talker', 'composed_robot/no_such_program')
    program.wait_for("composed_robot has no program 'no_such_program'")
    (talker,) = [name for name in until_nodes(master, 2) if name.startswith('/talker_')]
    assert run(master.url, 'rosnode', 'kill', talker).returncode == 0
    assert program.process.wait(TIMEOUT) == 0


def test_a_script_without_package_or_without_name_is_told_and_the_others_go_on(compose):
    program = compose('--script', 'composed_robot', 'composed_robot/talker')
    program.wait_for('composed_robot is not started: it is neither PACKAGE/EXECUTABLE nor')
    program.wait_for('started /talker')


@pytest.mark.parametrize('what', ['no_such_package/talker', 'composed_robot/broken'])
def test_the_status_says_that_nothing_could_be_started(compose, what):
    assert compose('--script', what).process.wait(TIMEOUT) == 1


def test_a_program_that_is_no_node_is_told_as_such(compose, tmp_path):
    path = tmp_path / 'never'
    path.write_text('print("no node")')
    program = compose('--script', str(path))
    assert program.process.wait(TIMEOUT) == 0
    assert f'{path} has run, and never called rospy.init_node' in program.read_to_the_end()


def test_a_script_that_makes_its_nodes_itself_is_a_process_of_its_own(master, compose):
    own = 'composed_robot/own_nodes'
    program = compose('--script', own, 'composed_robot/talker')
    program.wait_for(f'run apart: {own} (programs that use pharos make their nodes themselves;')
    program.wait_for('started /talker')
    pid = master.wait_for_node('/own_node', TIMEOUT).pid
    assert pid != program.process.pid
    assert program.end(signal.SIGINT) == 0
    printed = program.read_to_the_end()
    assert f'{own}: ran apart, and ended with 0' in printed
    assert 'rospy.init_node' not in printed
    assert nodes(master) == set()


def test_nodes_are_chosen_of_a_file_alone(compose):
    assert compose('--only', 'talker').process.wait(TIMEOUT) == 2


def test_ctrl_c_while_it_imports_ends_it_without_a_word(master):
    path = os.pathsep.join([str(PACKAGES / 'interrupting'), str(ROOT / 'src')])
    with Program(master.url, sys.executable, script('compose'), PYTHONPATH=path) as program:
        assert program.process.wait(TIMEOUT) == -signal.SIGINT
        assert program.read_to_the_end() == ''


def test_of_two_scripts_of_one_name_the_first_runs(master, compose):
    program = compose('--script', 'composed_robot/mirror.py', 'composed_robot/mirror.py')
    line = program.wait_for('is not started')
    assert line.startswith('composed_robot/mirror.py is not started: ')
    assert 'the node name /mirror is taken' in line
    assert '/mirror' in nodes(master)


def until_nodes(master, count):
    until(lambda: len(nodes(master)) == count)
    return nodes(master)


def test_a_required_node_that_ends_is_told_and_is_the_status(master, compose):
    program = compose('composed_robot', 'required.launch')
    master.wait_for_node('/ends', TIMEOUT)
    del master.parameters['/ends/stay']
    program.wait_for('/ends, which is required, has ended: all others end')
    assert program.process.wait(TIMEOUT) == 1


@pytest.mark.leaves('the registrations of the nodes in it')
def test_the_nodes_apart_end_where_it_is_killed(master, compose):
    program = compose('composed_robot', 'chat.launch')
    relay = master.wait_for_node('/relay', TIMEOUT)
    assert program.end(signal.SIGKILL) == -signal.SIGKILL
    until(lambda: not relay.is_alive())


def test_on_a_terminal_the_last_line_alone_says_how_far_it_has_come(master):
    shown = on_terminal(master.url, 'hangs.launch', until_shown='/hangs: started, but no node yet')
    assert b'\r\x1b[Kstarting 1 of 2: /hangs\r\x1b[K/hangs has not started within 2 s' in shown
    assert b'\r\x1b[Kstarting 2 of 2: /talker\r\x1b[K' in shown
    assert shown.count(b'\n') == 2 + 2  # one that hangs, told twice, and what has become of each


def on_terminal(url, file, until_shown):
    """What compose shows on a terminal of its own; it is ended by Ctrl-C once that is shown."""
    ours, theirs = pty.openpty()
    command = [sys.executable, script('compose'), 'composed_robot', file]
    process = subprocess.Popen(
        command, env=environment(url), stdin=theirs, stdout=theirs, stderr=theirs
    )
    os.close(theirs)
    shown = b''
    with contextlib.suppress(OSError):  # the other end is closed
        while True:
            shown += os.read(ours, 4096)
            if until_shown.encode() in shown:
                process.send_signal(signal.SIGINT)
                until_shown = '\0'
    os.close(ours)
    assert process.wait(TIMEOUT) == 0
    return shown


@pytest.mark.parametrize(
    'arguments, said',
    [
        (['no_such_package', 'a.launch'], "no ROS package 'no_such_package'"),
        (['composed_robot', 'a.launch'], "composed_robot has no launch file 'a.launch'"),
        (['/no/such.launch'], "there is no launch file '/no/such.launch'"),
        (['composed_robot', 'broken.launch'], 'broken.launch: Invalid roslaunch XML syntax'),
        (
            ['composed_robot', 'twice.launch'],
            'twice.launch: roslaunch file contains multiple nodes',
        ),
        (['composed_robot', 'chat.launch', 'texd:=x'], "chat.launch has no arg 'texd'"),
        (['composed_robot', 'chat.launch', '--only', 'x'], "chat.launch has no node 'x'"),
    ],
)
def test_what_cannot_be_composed_is_one_line_and_the_status(compose, arguments, said):
    program = compose(*arguments)
    assert program.process.wait(TIMEOUT) == 1
    (line,) = [line for line in program.read_to_the_end().splitlines() if line]
    assert said in line


def test_a_master_is_started_where_there_is_none(compose):
    port = free_port()
    program = compose('composed_robot', 'respawn.launch', url=f'http://127.0.0.1:{port}/')
    program.wait_for(f'no ROS master at http://127.0.0.1:{port}/: started one')
    program.wait_for('started /ends')
    assert program.end() == 0
    assert not Master(f'http://127.0.0.1:{port}/').is_reachable()


def free_port():
    with Master.embedded() as master:
        return int(master.url.rstrip('/').rpartition(':')[2])


def test_two_of_them_go_side_by_side(master, compose):
    compose()
    master.wait_for_node('/compose', TIMEOUT)
    compose()
    assert len(until_nodes(master, 2)) == 2


# -- a nodelet manager


def test_nodelet_loads_a_program_which_ends_with_it(master, compose):
    compose()
    mailbox = Mailbox(create(master, '/hearer'), '/said', STRING)
    with Program(master.url, *LOAD, 'chatter:=said', '_text:=loaded'):
        assert mailbox.next(TIMEOUT).data == 'loaded'
        assert '/talker' in run(master.url, 'rosservice', 'call', '/compose/list').stdout
    until(lambda: nodes(master) == {'/compose', '/hearer'})


def test_a_program_is_loaded_by_a_relative_name(master, compose):
    compose('__name:=manager', '__ns:=/robot')
    until(lambda: '/robot/manager/list' in master.services())
    load = master.lookup_service('/robot/manager/load_nodelet')
    assert load.call(name='relative', type='composed_robot/talker').success
    listed = master.lookup_service('/robot/manager/list').call().nodelets
    assert listed == ['/robot/relative']
    assert '/robot/relative' in nodes(master)
    assert master.lookup_service('/robot/manager/unload_nodelet').call(name='relative').success
    assert nodes(master) == {'/robot/manager'}


def test_a_program_that_makes_its_nodes_itself_is_not_loaded(master, compose):
    compose()
    load = master.wait_for_service('/compose/load_nodelet', TIMEOUT)
    with pytest.raises(ServiceCallError, match='own_nodes makes its nodes itself, with pharos'):
        load.call(name='own', type='composed_robot/own_nodes')


def test_a_program_that_is_unloaded_ends_and_nodelet_with_it(master, compose):
    compose()
    loaded = master.wait_for_service('/compose/list', TIMEOUT)
    unload = master.wait_for_service('/compose/unload_nodelet', TIMEOUT)
    with Program(master.url, *LOAD) as loader:
        until(lambda: '/talker' in loaded.call().nodelets)
        assert unload.call(name='/talker').success
        assert loader.process.wait(TIMEOUT) == 0
    until(lambda: nodes(master) == {'/compose'})


@pytest.mark.leaves('the registrations of the loader')
def test_a_program_whose_loader_is_killed_ends(master, compose):
    compose()
    with Program(master.url, *LOAD) as loader:
        master.wait_for_node('/talker_in_compose', TIMEOUT)
        loader.end(signal.SIGKILL)
    until(lambda: not master.is_node_alive('/talker_in_compose'))


def test_a_launch_file_of_nodelets_loads_programs(master, compose):
    compose()
    mailbox = Mailbox(create(master, '/hearer'), '/said', STRING)
    with master.launch('composed_robot', 'nodelet.launch'):
        assert mailbox.next(TIMEOUT).data == 'loaded'


@pytest.mark.parametrize(
    'what, said',
    [
        ('composed_robot/../talker', 'names no program'),
        ('/bin/sh', 'names no program'),
        ('no_such_package/talker', "no ROS package 'no_such_package'"),
        ('composed_robot/broken', "'return' outside function"),
    ],
)
def test_what_cannot_be_loaded_is_said_to_who_asked(master, compose, what, said):
    program = compose()
    until(lambda: '/compose/load_nodelet' in master.services())
    request = f'{{name: /x, type: "{what}"}}'
    answer = run(master.url, 'rosservice', 'call', '/compose/load_nodelet', request)
    assert said in answer.stderr
    program.end()
    assert 'Traceback' not in program.read_to_the_end()
