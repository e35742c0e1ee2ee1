"""Master.run and Master.launch: ROS programs as processes of this one."""
import os
import pathlib
import queue
import re
import shutil
import signal
import subprocess
import sys
import threading
import time

import genpy
import pytest
import rosbag
from std_msgs.msg import String

from pharos.testing import Mailbox, TIMEOUT, until
from pharos import PharosError, BlockNode, ExternalNode, RosProcess, UnknownNodeError
from programs import PROGRAMS, Program
from sockets import wait_for_end

MANIFEST = """<package format="2"><name>%s</name><version>0.0.0</version><description>d</description>
<maintainer email="a@b.org">m</maintainer><license>BSD</license></package>"""


def write(path, text, mode=0o644):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(mode)


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A folder of a ROS package, fake_robot, in a workspace's source space."""
    folder = tmp_path / 'src' / 'fake_robot'
    write(folder / 'package.xml', MANIFEST % 'fake_robot')
    write(folder / 'scripts' / 'talker', (PROGRAMS / 'talk.py').read_text(), 0o755)
    monkeypatch.setenv('ROS_PACKAGE_PATH', str(tmp_path / 'src'))
    return folder


def program(package, name, text):
    """A shell program of the package."""
    write(package / 'scripts' / name, '#!/bin/sh\n' + text, 0o755)
    return name


# -- finding them


def test_a_program_of_the_source_space_is_run(master, package):
    with master.run('fake_robot', 'talker') as process:
        node = master.wait_for_node('/talker', TIMEOUT)
        assert isinstance(process, RosProcess)
        assert process.poll() is None
        assert isinstance(node, ExternalNode)
        assert node.pid == process.pid
    assert process.poll() is not None
    assert not node.is_alive()


@pytest.mark.parametrize('space', ['devel', 'install'])
def test_a_program_of_a_catkin_space_is_run(master, tmp_path, monkeypatch, space):
    prefix, source = tmp_path / space, tmp_path / 'src' / 'fake_robot'
    write(source / 'package.xml', MANIFEST % 'fake_robot')
    write(prefix / '.catkin', str(tmp_path / 'src') if space == 'devel' else '')
    write(prefix / 'lib' / 'fake_robot' / 'tell', '#!/bin/sh\necho "$0"\n', 0o755)
    if space == 'install':
        write(prefix / 'share' / 'fake_robot' / 'package.xml', MANIFEST % 'fake_robot')
    monkeypatch.setenv('CMAKE_PREFIX_PATH', str(prefix))
    monkeypatch.setenv(
        'ROS_PACKAGE_PATH', str(tmp_path / 'src' if space == 'devel' else prefix / 'share')
    )
    with master.run('fake_robot', 'tell') as process:
        assert process.wait(TIMEOUT) == 0
        assert process.output == str(prefix / 'lib' / 'fake_robot' / 'tell')


def test_a_program_of_debians_is_run_though_it_has_no_manifest(master):
    with master.run('topic_tools', 'relay', '/untyped', '/b', name='passes_on'):
        while '/passes_on' not in master.topic('/untyped').subscribers:  # then it heeds Ctrl-C
            threading.Event().wait(0.01)
        # a master never forgets a type
        assert master.node('/passes_on').subscriptions == {'/untyped': None}


def test_an_unknown_package_or_program_is_said(master, package):
    with pytest.raises(
        UnknownNodeError, match="no ROS package 'no_such_robot' on ROS_PACKAGE_PATH"
    ):
        master.run('no_such_robot', 'talker')
    with pytest.raises(
        UnknownNodeError, match="fake_robot has no program 'listener'.*rosrun fake_robot <Tab>"
    ):
        master.run('fake_robot', 'listener')
    with pytest.raises(UnknownNodeError, match="topic_tools has no program 'relai': see"):
        master.run('topic_tools', 'relai')
    with pytest.raises(UnknownNodeError, match="no ROS package 'no_such_robot'"):
        master.launch('no_such_robot', 'a.launch')
    with pytest.raises(UnknownNodeError, match="fake_robot has no launch file 'b.launch': is it"):
        master.launch('fake_robot', 'b.launch')


@pytest.mark.parametrize('start', ['run', 'load'])
def test_a_program_that_may_not_be_executed_is_said(master, package, start):
    write(package / 'nodes' / 'listener.py', '#!/usr/bin/python3', 0o644)
    with pytest.raises(
        UnknownNodeError,
        match=r"no program 'listener.py', but .* not executable: chmod \+x /.*nodes/listener.py$",
    ):
        getattr(master, start)('fake_robot', 'listener.py')


@pytest.mark.parametrize(
    'given',
    [
        lambda path: [str(path)],
        lambda path: [path],
        lambda path: [None, str(path)],
        lambda path: [None, path],
        lambda path: [os.path.relpath(path)],
        lambda path: ['fake_robot', path.name],
    ],
    ids=['text', 'Path', 'file', 'file as a Path', 'relative', 'in a package'],
)
def test_a_launch_file_is_given_by_its_path_or_by_its_package(master, package, given):
    path = package / 'launch' / 'only_sets.launch'
    write(path, '<launch><arg name="to"/><param name="/launched" value="$(arg to)"/></launch>')
    master.parameters.pop('/launched', None)
    process = master.launch(*given(path), to='it')
    assert process.wait(2 * TIMEOUT) == 0
    assert 'only_sets.launch' in repr(process)
    assert master.parameters['/launched'] == 'it'


@pytest.mark.parametrize(
    'given, error, says',
    [
        (['/no/such/robot.launch'], UnknownNodeError, "no launch file '/no/such/robot.launch': is"),
        (['robot.launch'], UnknownNodeError, "by two names: 'robot.launch', and that of the file"),
        ([pathlib.Path('/usr')], UnknownNodeError, "'/usr' is a folder: give the path of a launch"),
        ([None], ValueError, 'or by its path alone, not by None'),
        ([b'/a.launch'], ValueError, "or by its path alone, not by b'/a.launch'"),
        (['fake_robot', pathlib.Path('a.launch')], ValueError, "by its name, not PosixPath"),
    ],
)
@pytest.mark.parametrize('how', ['launch', 'compose'])
def test_what_is_no_launch_file_is_said(master, package, how, given, error, says):
    with pytest.raises(error, match=says):
        getattr(master, how)(*given)


def test_an_argument_of_a_launch_file_that_is_none_is_refused(master, package):
    write(package / 'launch' / 'empty.launch', '<launch/>')
    with pytest.raises(TypeError, match="texts or numbers, not None: {'to': None}"):
        master.launch('fake_robot', 'empty.launch', to=None)


def test_a_broken_manifest_of_another_package_is_named(master, tmp_path, monkeypatch):
    broken = tmp_path / 'src' / 'broken' / 'package.xml'
    write(broken, (MANIFEST % 'broken').replace('a@b.org', 'nobody'))
    write(tmp_path / 'devel' / '.catkin', str(tmp_path / 'src'))
    monkeypatch.setenv('CMAKE_PREFIX_PATH', str(tmp_path / 'devel'))
    monkeypatch.setenv('ROS_PACKAGE_PATH', str(tmp_path / 'src'))
    with pytest.raises(PharosError, match=f'^broken/talker cannot be looked up: .*{broken}'):
        master.run('broken', 'talker')


@pytest.mark.parametrize('given', [('', ''), (None, 'talker'), ('fake_robot', None), (5, 'talker')])
def test_what_is_no_name_of_a_package_or_program_is_refused(master, package, given):
    with pytest.raises(ValueError, match='are given by their names, not'):
        master.run(*given)


@pytest.mark.parametrize(
    'given, error, says',
    [
        ({'params': [1]}, TypeError, r'params is a dict by name, not \[1\]'),
        ({'remap': 'a:=b'}, TypeError, "remap is a dict by name, not 'a:=b'"),
        ({'params': {'1st': 2}}, ValueError, "'1st' cannot be a parameter name"),
        ({'params': {'/rate': 2}}, ValueError, "'/rate' is not private to the node: set it by"),
        ({'remap': {'talk': 'a b'}}, ValueError, "'a b' cannot be a remapped name"),
        ({'remap': {'1': '/b'}}, ValueError, "'1' cannot be a remapped name"),
        ({'name': '/ns/talker'}, ValueError, "'/ns/talker' cannot be a node name"),
    ],
)
def test_names_that_cannot_be_any_are_refused_before_it_starts(master, package, given, error, says):
    with pytest.raises(error, match=says):
        master.run('fake_robot', 'talker', **given)


def test_a_namespace_is_given_as_a_remapping(master, package):
    with master.run('fake_robot', 'talker', remap={'__ns': '/robots'}):
        master.wait_for_node('/robots/talker', TIMEOUT)


@pytest.mark.parametrize('argument', [None, ['a', 'b'], b'a', {'a': 1}])
def test_an_argument_that_is_none_is_refused(master, package, argument):
    with pytest.raises(TypeError, match=f'texts or numbers, not {re.escape(repr(argument))}'):
        master.run('fake_robot', 'talker', argument)


@pytest.mark.parametrize('text', ['#!/nowhere/python3\n', 'no first line\n', ''], ids=repr)
def test_what_the_system_cannot_start_is_told(master, package, text):
    write(package / 'scripts' / 'broken', text, 0o755)
    with pytest.raises(PharosError, match='scripts/broken cannot be started .*#!/usr/bin/python3'):
        master.run('fake_robot', 'broken', params={'a': 1})
    with pytest.raises(UnknownNodeError, match="topic_tools has no program '/'"):
        master.run('topic_tools', '/')


# -- what they are told, and what they tell


def test_name_remappings_and_parameters_reach_it(master, package):
    mailbox = Mailbox()
    master.create(BlockNode, named='/listener', delegate=mailbox).interested_in(
        '/said', 'std_msgs/String'
    )
    params = {'~text': 'two words'}
    with master.run('fake_robot', 'talker', name='robot7', remap={'talk': '/said'}, params=params):
        assert mailbox.next().data == 'two words'
        assert master.wait_for_node('/robot7', TIMEOUT).publications['/said'] == 'std_msgs/String'
        assert master.parameters.pop('/robot7/text') == 'two words'


def test_arguments_reach_it_as_they_are(master, package):
    show = program(package, 'show', 'for a in "$@"; do echo "<$a>"; done')
    with master.run('fake_robot', show, 'two words', 3, '--flag') as process:
        process.wait(TIMEOUT)
        assert process.output.splitlines() == ['<two words>', '<3>', '<--flag>']


def test_it_runs_at_this_master(master, package):
    tell = program(package, 'tell', 'echo $ROS_MASTER_URI')
    with master.run('fake_robot', tell) as process:
        process.wait(TIMEOUT)
        assert process.output == master.url


def test_each_line_goes_to_the_block_as_it_is_printed(master, package):
    lines = queue.SimpleQueue()
    with master.run('fake_robot', 'talker', on_line=lines.put):
        # while it runs on: not held back for a full block
        assert lines.get(timeout=TIMEOUT) == '/talker talks'


def test_lines_go_to_a_nodes_log(master, package):
    mailbox = Mailbox()
    master.create(BlockNode, named='/listener', delegate=mailbox).interested_in(
        '/rosout', 'rosgraph_msgs/Log'
    )
    node = master.create(BlockNode, named='/starter')
    while not node.latest_run.rospy.publisher('/rosout').get_num_connections():
        node.latest_run.rospy.ended.wait(0.01)
    with master.run(
        'fake_robot', program(package, 'grumble', 'echo first; echo second >&2'), on_line=node.log
    ):
        assert take(mailbox, '/starter', 2) == ['first', 'second']


def take(mailbox, name, count):
    """The next log lines of that node."""
    lines = []
    while len(lines) < count:
        message = mailbox.next()
        if message.name == name:
            lines.append(message.msg)
    return lines


def test_a_block_that_raises_does_not_end_the_program_or_its_output(master, package, transcript):
    def stumble(line):
        raise RuntimeError('stumbled over ' + line)

    with master.run(
        'fake_robot', program(package, 'two', 'echo one; echo two'), on_line=stumble
    ) as process:
        assert process.wait(TIMEOUT) == 0
        assert process.output == 'one\ntwo'
    assert len(transcript) == 2
    assert 'RuntimeError: stumbled over one' in transcript[0]
    with pytest.raises(TypeError, match='on_line.text.'):
        master.run('fake_robot', 'two', on_line=lambda: None)


# -- keys and lines that are typed


def key_program(package, language):
    """A program that reads keys from its terminal."""
    keys = package / 'scripts' / 'keys'
    if language == 'Python':
        shutil.copy(PROGRAMS / 'keys.py', keys)
    else:
        build(PROGRAMS / 'keys.cpp', keys)
    return keys.name


def build(source, program):
    """Compile a program written with roscpp."""
    if not (shutil.which('g++') and os.path.exists('/usr/include/ros/ros.h')):
        pytest.skip('needs g++ and the headers of roscpp')
    libraries = 'roscpp', 'rosconsole', 'rostime', 'roscpp_serialization', 'pthread'
    linked = [f'-l{library}' for library in libraries]
    subprocess.run(['g++', '-O0', source, '-o', program, *linked], check=True)


@pytest.mark.parametrize('language', ['Python', 'C++'])
def test_a_program_that_reads_keys_is_driven(master, package, language, monkeypatch):
    monkeypatch.setenv('PYTHONUNBUFFERED', '')  # it prints as it does at a terminal
    pressed, lines = Mailbox(), queue.SimpleQueue()
    master.create(BlockNode, named='/listener', delegate=pressed).interested_in(
        '/pressed', 'std_msgs/String'
    )
    with master.run('fake_robot', key_program(package, language), on_line=lines.put) as process:
        while 'key' not in lines.get(timeout=TIMEOUT):
            pass
        for key in 'w', 'a':
            process.send(key)
            assert pressed.next().data == key
            assert 'pressed' in lines.get(timeout=TIMEOUT)
        process.send('sdq')
        assert process.wait(TIMEOUT) == 3
        printed = [line for line in process.output.split('\n') if 'pressed' in line]
        quotes = "'" if language == 'Python' else ''
        assert printed == [f'pressed {quotes}{key}{quotes}' for key in 'wasd']
        assert not any(character in process.output for character in '\r\x1b')
        with pytest.raises(PharosError, match='keys has ended, and reads nothing any more: run it'):
            process.send('w')


def test_the_space_bar_pauses_rosbag_play(master, tmp_path):
    with rosbag.Bag(str(tmp_path / 'said.bag'), 'w') as bag:
        for number in range(100):
            bag.write('/said', String(str(number)), genpy.Time(100 + number // 10))
    with master.run('rosbag', 'play', tmp_path / 'said.bag') as process:
        until(lambda: '[RUNNING]' in process.output)
        process.send(' ')
        until(lambda: '[PAUSED ]' in process.output)
        process.send(' ')
        until(lambda: '[RUNNING]' in process.output.rpartition('[PAUSED ]')[2])


def test_a_program_that_reads_lines_gets_what_is_sent_and_prints_no_echo_of_it(master, package):
    echo = program(
        package, 'echo', 'while read line; do echo "<$line>"; done; printf "the "; echo end'
    )
    with master.run('fake_robot', echo) as process:
        process.send('one\ntw')
        process.send('o\nÄöü\n' + 4000 * 'x' + '\n')
        with pytest.raises(ValueError, match='a line of more than 4095 bytes'):
            process.send(4096 * 'x')
        with pytest.raises(TypeError, match="is a text, not b'x'"):
            process.send(b'x')
        process.send('\x04')
        assert process.wait(TIMEOUT) == 0
        assert process.output.split('\n') == [
            '<one>',
            '<two>',
            '<Äöü>',
            f"<{4000 * 'x'}>",
            'the end',
        ]


def test_the_beginning_of_a_line_is_in_the_output(master, package):
    asks = program(package, 'asks', 'printf "name? "; read name; echo "hello $name"')
    with master.run('fake_robot', asks) as process:
        until(lambda: process.output == 'name? ')
        process.send('bob\n')
        assert process.wait(TIMEOUT) == 0
        assert process.output == 'name? hello bob'


def test_a_program_that_does_not_read_is_sent_no_more_than_it_could(master, package):
    """Who sends waits, until the program ends."""
    raised = queue.SimpleQueue()
    process = master.run('fake_robot', program(package, 'deaf', 'stty raw; echo up; sleep 1000'))
    until(lambda: process.output == 'up')

    def send():
        try:
            process.send(1000000 * 'x')
        except PharosError as error:
            raised.put(str(error))

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    process.terminate()
    assert raised.get(timeout=TIMEOUT).endswith('reads nothing any more: run it again')
    thread.join(TIMEOUT)


def test_output_has_no_colours_and_no_carriage_returns(master, package):
    colourful = (
        'tput setaf 1 2>/dev/null; printf "\\033[31mred\\033[0m\\r\\nplain\\n"; echo >&2 $TERM'
    )
    lines = queue.SimpleQueue()
    with master.run(
        'fake_robot', program(package, 'colourful', colourful), on_line=lines.put
    ) as process:
        assert process.wait(TIMEOUT) == 0
        assert process.output.split('\n') == ['red', 'plain', 'dumb']
    assert [lines.get(timeout=TIMEOUT) for _ in range(3)] == ['red', 'plain', 'dumb']


def test_a_program_of_c_prints_at_once(master, package, tmp_path):
    if not shutil.which('gcc'):
        pytest.skip('needs gcc')
    source = tmp_path / 'prints.c'
    source.write_text(
        '#include <stdio.h>\nint main(void) { puts("up"); getchar(); puts("ends"); return 0; }\n'
    )
    prints, lines = package / 'scripts' / 'prints', queue.SimpleQueue()
    subprocess.run(['gcc', source, '-o', prints], check=True)
    with master.run('fake_robot', 'prints', on_line=lines.put) as process:
        assert lines.get(timeout=TIMEOUT) == 'up'
        process.send('\n')
        assert process.wait(TIMEOUT) == 0
        assert process.output == 'up\nends'


def test_much_output_is_whole(master, package):
    with master.run('fake_robot', program(package, 'much', 'seq 200000')) as process:
        assert process.wait(TIMEOUT) == 0
        until(lambda: process.output.endswith('\n200000'))
        assert process.output.split('\n') == [str(number) for number in range(190001, 200001)]


# -- parameters


VALUES = {
    'integer': 7,
    'number': 2.0,
    'large': 1e20,
    'truth': True,
    'text': 'two words',
    'digits': '1',
    'yes': 'true',
    'nothing': '',
    'blank': ' x ',
    'list': [1, '1', 2.5, [True]],
    'dict': {'p': 1, 'q': {'r': '2'}},
}


@pytest.mark.parametrize('namespace', [None, '/robots'])
def test_parameters_keep_their_types(master, package, namespace):
    for name in None, 'robot7':
        remap = {'__ns': namespace} if namespace else None
        with master.run('fake_robot', 'talker', name=name, remap=remap, params=VALUES):
            node = f"{namespace or ''}/{name or 'talker'}"
            master.wait_for_node(node, TIMEOUT)
            found = master.parameters.pop(node)
            assert found == VALUES
            assert [type(value) for value in found.values()] == [
                type(VALUES[name]) for name in found
            ]


def test_parameters_of_a_program_that_reads_no_yaml_keep_their_types_or_are_refused(master):
    relay = 'topic_tools', 'relay', '/untyped', '/b'
    with master.run(*relay, name='passes_on', params=VALUES):
        master.wait_for_node('/passes_on', TIMEOUT)
        assert master.parameters.pop('/passes_on') == VALUES
    plain = {name: VALUES[name] for name in ('integer', 'number', 'large', 'truth', 'text')}
    with master.run(*relay, remap={'__name': 'passes_on'}, params=plain):
        master.wait_for_node('/passes_on', TIMEOUT)
        assert master.parameters.pop('/passes_on') == plain
    for name in VALUES.keys() - plain:
        with pytest.raises(ValueError, match=f'the parameter {name} of .*relay cannot be given as'):
            master.run(*relay, params={name: VALUES[name]})
    with pytest.raises(ValueError, match='~bad cannot be <object'):
        master.run(*relay, params={'bad': object()})


# -- statuses


def test_its_exit_status_is_told(master, package):
    with master.run('fake_robot', program(package, 'fail', 'exit 7')) as process:
        assert process.wait(TIMEOUT) == 7 == process.poll()
        assert repr(process).endswith('fail, ended with 7>')
    with master.run('fake_robot', program(package, 'sleep', 'exec sleep 1000')) as process:
        assert process.poll() is None
        assert repr(process).endswith('sleep, pid %d>' % process.pid)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.01)
        assert process.terminate() == -signal.SIGINT
        assert process.terminate() == -signal.SIGINT  # harmless


def test_a_roscpp_node_unregisters_when_it_is_ended(master):
    with master.run('topic_tools', 'relay', '/untyped', '/b', name='passes_on'):
        while '/passes_on' not in master.topic('/untyped').subscribers:  # then it heeds Ctrl-C
            threading.Event().wait(0.01)
    with pytest.raises(UnknownNodeError):
        master.node('/passes_on')


NO_HANDLER = """#!/usr/bin/python3
import signal, sys, rospy, std_msgs.msg
signal.signal(signal.SIGINT, signal.%s)
rospy.init_node('robot', disable_signals=True)
sent = rospy.Publisher('robot_says', std_msgs.msg.String, queue_size=1, latch=True)
print('up', flush=True)
while %s:
    rospy.rostime.wallsleep(0.05)
"""

NO_HANDLER_IN_ROSCPP = """
#include <ros/ros.h>
#include <roscpp/Empty.h>
#include <cstdio>
static bool answer(roscpp::Empty::Request&, roscpp::Empty::Response&) { return true; }
int main(int argc, char** argv) {
  ros::init(argc, argv, "robot", ros::init_options::NoSigintHandler);
  ros::NodeHandle node;
  ros::ServiceServer server = node.advertiseService("robot_serves", answer);
  puts("up"), fflush(stdout);
  ros::spin();
}
"""


def names_registered(master):
    return {name for kind in master.system_state() for names in kind.values() for name in names}


@pytest.mark.parametrize(
    'obeys', ['not rospy.is_shutdown()', 'True'], ids=['obeys ROS', 'obeys nobody']
)
@pytest.mark.parametrize('handler', ['SIG_DFL', 'SIG_IGN'])
def test_nothing_of_a_node_without_handlers_stays_registered(master, package, handler, obeys):
    """As turtlesim: it ends at a signal without unregistering."""
    write(package / 'scripts' / 'robot', NO_HANDLER % (handler, obeys), 0o755)
    lines = queue.SimpleQueue()
    process = master.run('fake_robot', 'robot', on_line=lines.put)
    assert lines.get(timeout=TIMEOUT) == 'up'
    assert '/robot' in names_registered(master)
    status = process.terminate(timeout=3)
    assert (status == 0) == (obeys != 'True')
    assert '/robot' not in names_registered(master)
    with pytest.raises(UnknownNodeError):
        master.wait_for_node('/robot', 0.1)


def test_a_roscpp_node_without_handlers_is_ended_through_ros(master, package, tmp_path):
    source, robot = tmp_path / 'robot.cpp', package / 'scripts' / 'robot'
    source.write_text(NO_HANDLER_IN_ROSCPP)
    build(source, robot)
    lines = queue.SimpleQueue()
    process = master.run('fake_robot', 'robot', on_line=lines.put)
    assert lines.get(timeout=TIMEOUT) == 'up'
    master.wait_for_node('/robot', TIMEOUT)
    assert process.terminate() == 0
    assert '/robot' not in names_registered(master)
    assert '/robot_serves' not in master.services()


def test_the_nodes_of_a_launch_file_are_ended_through_ros(master, package):
    write(package / 'scripts' / 'robot', NO_HANDLER % ('SIG_DFL', 'not rospy.is_shutdown()'), 0o755)
    write(
        package / 'robots.launch',
        """<launch><node name="a" pkg="fake_robot" type="robot" />
        <node name="b" pkg="fake_robot" type="robot" respawn="true" /></launch>""",
    )
    process = master.launch('fake_robot', 'robots.launch')
    for name in '/a', '/b':
        master.wait_for_node(name, TIMEOUT)
    process.terminate()
    assert not {'/a', '/b'} & names_registered(master)


def test_a_node_registered_with_a_port_that_cannot_be_keeps_no_program_from_ending(master):
    liar, uri = master.api('/liar'), 'http://127.0.0.1:99999/'
    liar.registerPublisher('/lies', 'std_msgs/String', uri)
    try:
        process = master.run('topic_tools', 'relay', '/untyped', '/b', name='passes_on')
        master.wait_for_node('/passes_on', TIMEOUT)
        process.terminate()
        assert names_registered(master) >= {'/liar'}
        assert '/passes_on' not in names_registered(master)
    finally:
        liar.unregisterPublisher('/lies', uri)


def test_other_nodes_are_not_ended_with_a_program(master, package):
    write(package / 'scripts' / 'robot', NO_HANDLER % ('SIG_DFL', 'not rospy.is_shutdown()'), 0o755)
    ours = master.create(BlockNode, named='/ours')
    with master.run('fake_robot', 'robot', name='other'):
        other = master.wait_for_node('/other', TIMEOUT)
        with master.run('fake_robot', 'robot'):
            master.wait_for_node('/robot', TIMEOUT)
        assert ours.is_running
        assert other.is_alive()


def test_a_node_that_is_registered_and_dead_is_not_waited_for_in_vain(master, package):
    write(package / 'scripts' / 'robot', NO_HANDLER % ('SIG_DFL', 'True'), 0o755)
    for _ in range(2):
        process = master.run('fake_robot', 'robot')
        node = master.wait_for_node('/robot', TIMEOUT)
        assert node.pid == process.pid  # and not the one before
        os.kill(process.pid, signal.SIGKILL)
        process.wait(TIMEOUT)
    with pytest.raises(UnknownNodeError, match='/robot'):
        master.wait_for_node('/robot', 0.3)
    master.create(BlockNode, named='/robot').stop()


def test_a_program_that_ignores_ctrl_c_is_terminated(master, package):
    lines = queue.SimpleQueue()
    deaf = program(
        package, 'deaf', 'trap "" INT; trap "exit 5" TERM; echo up; while :; do sleep 0.1; done'
    )
    process = master.run('fake_robot', deaf, on_line=lines.put)
    lines.get(timeout=TIMEOUT)
    assert process.terminate(timeout=1) == 5


def test_nodes_that_do_not_answer_are_waited_for_no_longer_than_asked(master, package):
    """Each took a second to be asked, and one more to be looked for afterwards."""
    shutil.copy(PROGRAMS / 'hung_nodes.py', package / 'scripts' / 'hung')
    lines = queue.SimpleQueue()
    process = master.run('fake_robot', 'hung', 6, on_line=lines.put)
    assert lines.get(timeout=TIMEOUT) == 'registered'
    begun = time.monotonic()
    assert process.terminate(timeout=1) == -signal.SIGINT
    assert time.monotonic() - begun < 6  # seconds; 12 without a limit for all of them together
    left = names_registered(master)
    master_api = {name: master.api(name) for name in left if name.startswith('/hung')}
    for name, api in master_api.items():
        service = '/hang' + name[len('/hung') :]
        api.unregisterService(service, api.lookupService(service))


@pytest.mark.parametrize('timeout', ['x', float('nan')])
def test_a_limit_that_is_no_number_of_seconds_is_refused(master, package, timeout):
    with master.run('fake_robot', 'talker') as process:
        for wait in process.wait, process.terminate:
            with pytest.raises(ValueError, match='timeout is a number of seconds, not'):
                wait(timeout)


# -- the end


@pytest.mark.parametrize(
    'how',
    [
        'sleep 1000 & echo $!; wait',
        'setsid sleep 1000 & echo $!; wait',
        'trap "" INT TERM; sh -c "trap \'\' INT TERM; echo \\$\\$; while :; do sleep 1; done"',
        'sleep 1000 </dev/null >/dev/null 2>&1 & echo $!; exit',
    ],
    ids=['a child', 'a child with a session', 'both ignore the signals', 'left behind'],
)
def test_what_it_has_started_ends_with_it(master, package, how):
    lines = queue.SimpleQueue()
    process = master.run('fake_robot', program(package, 'parent', how), on_line=lines.put)
    child = int(lines.get(timeout=TIMEOUT))
    process.terminate(timeout=0.2)
    assert wait_for_end(child, TIMEOUT)


@pytest.mark.parametrize(
    'end',
    ['', 'raise RuntimeError', 'os.kill(os.getpid(), signal.SIGTERM)'],
    ids=['end', 'exception', 'SIGTERM'],
)
def test_nothing_is_left_behind_when_the_program_ends(master, package, end):
    code = f"""
import os, queue, signal
from pharos import BlockNode, Master
Master().create(BlockNode, named='/n')
lines = queue.SimpleQueue()
process = Master().run('fake_robot', {program(package, 'parent', 'sleep 1000 & echo $!; wait')!r},
                       on_line=lines.put)
print('PIDS', process.pid, lines.get(), flush=True)
{end}
"""
    with Program(master.url, sys.executable, '-c', code) as started:
        pids = started.wait_for('PIDS').split()[1:]
        started.process.wait(TIMEOUT)
        assert all(wait_for_end(int(pid), TIMEOUT) for pid in pids)


@pytest.mark.parametrize('second', [signal.SIGINT, signal.SIGTERM])
def test_nothing_is_left_behind_when_ctrl_c_comes_while_it_is_ended(master, package, second):
    code = """
import queue, threading
from pharos import Master
lines = queue.SimpleQueue()
process = Master().run('fake_robot', %r, on_line=lines.put)
print('PIDS', process.pid, lines.get(), flush=True)
threading.Thread(target=lambda: print(lines.get(), flush=True), daemon=True).start()
process.terminate(timeout=4)
""" % (
        program(
            package,
            'deaf',
            'trap "echo heard" INT; trap "" TERM; echo $$; while :; do sleep 0.1; done',
        )
    )
    with Program(master.url, sys.executable, '-c', code) as started:
        pids = started.wait_for('PIDS').split()[1:]
        started.wait_for('heard')
        started.process.send_signal(second)
        started.process.wait(TIMEOUT)
        assert all(wait_for_end(int(pid), TIMEOUT) for pid in pids)


def test_a_program_may_be_ended_by_the_block_for_its_output(master, package):
    ended, started = queue.SimpleQueue(), threading.Event()

    def end(text):
        started.wait(TIMEOUT)
        ended.put((process.terminate(), process.wait()))

    talks = program(package, 'talks', 'echo enough; exec sleep 1000')
    process = master.run('fake_robot', talks, on_line=end)
    started.set()
    assert ended.get(timeout=TIMEOUT) == (-signal.SIGINT, -signal.SIGINT)


def test_a_program_that_ended_long_ago_is_not_signalled_again(master, package, monkeypatch):
    with master.run('fake_robot', program(package, 'ends', 'exit 0')) as process:
        process.wait(TIMEOUT)
        process._reader.join(TIMEOUT)
        monkeypatch.setattr(os, 'killpg', None)  # its number may be another's by now


# -- launch files

LAUNCH = """<launch>
  <arg name="who" /><arg name="text" default="hello" />
  <node name="$(arg who)" pkg="fake_robot" type="talker" output="screen">
    <param name="text" value="$(arg text)" /></node>
  <node name="second" pkg="fake_robot" type="talker"><remap from="talk" to="talk2" /></node>
</launch>"""


def test_a_launch_file_is_started_and_ended_with_all_its_nodes(master, package):
    write(package / 'launch' / 'robot.launch', LAUNCH)
    mailbox = Mailbox()
    master.create(BlockNode, named='/listener', delegate=mailbox).interested_in(
        '/talk', 'std_msgs/String'
    )
    lines = queue.SimpleQueue()
    with master.launch(
        'fake_robot', 'robot.launch', on_line=lines.put, who='robot7', text='two words'
    ) as process:
        assert mailbox.next().data == 'two words'
        nodes = [master.wait_for_node(name, TIMEOUT) for name in ('/robot7', '/second')]
        pids = [node.pid for node in nodes]
        while '/robot7 talks' not in lines.get(timeout=TIMEOUT):
            pass
    assert process.poll() is not None
    assert all(wait_for_end(pid, TIMEOUT) for pid in pids)
    master.parameters.pop('/robot7')
    assert not any(node.is_alive() for node in nodes)


def test_what_a_launch_file_cannot_do_is_told(master, package):
    write(package / 'launch' / 'robot.launch', LAUNCH)
    with master.launch('fake_robot', 'robot.launch') as process:
        assert process.wait(TIMEOUT) != 0
        assert "requires the 'who' arg" in process.output


def test_launched_nodes_that_ignore_the_end_are_ended(master, package):
    program(
        package, 'stubborn', 'trap "" INT TERM; echo "stubborn pid $$"; while :; do sleep 1; done'
    )
    write(
        package / 'stubborn.launch',
        '<launch><node name="s" pkg="fake_robot" type="stubborn" output="screen"/></launch>',
    )
    lines = queue.SimpleQueue()
    process = master.launch('fake_robot', 'stubborn.launch', on_line=lines.put)
    told = None
    # not at the beginning of the line: roslaunch sets the terminal's title, without a line's end
    while not told:
        told = re.search(r'stubborn pid (\d+)', lines.get(timeout=TIMEOUT))
    process.terminate(timeout=0.2)
    assert wait_for_end(int(told.group(1)), TIMEOUT)
