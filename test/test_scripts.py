"""master.load: rospy programs, unmodified, as nodes of this process."""
import json
import os
import pathlib
import re
import shutil
import signal
import sys

import pytest

import pharos
from helpers import create, ended, in_thread, registrations
from pharos import node_registry, program_files
from pharos.private_rospy import registration
from pharos.testing import Mailbox, until
from pharos.watcher import watcher_of
from programs import ROOT, Program, run
from sockets import refused_url
from std_msgs.msg import String

TALKING = ROOT / 'test' / 'programs' / 'talking'
TALKER, REPORTER, WORKER = (TALKING / f'{name}.py' for name in ('talker', 'reporter', 'worker'))


def report_of(master, *args, **options):
    """What the reporter, loaded so, says of its start; it has ended then."""
    listener = create(master, '/listener_of_reports')
    mailbox = Mailbox(listener, options.pop('topic', '/report'), 'std_msgs/String')
    with master.load(REPORTER, None, *args, **options):
        report = json.loads(mailbox.next().data)
    listener.stop()
    return report


def test_a_script_is_a_node(master):
    with master.load(TALKER, name='greeter') as node:
        assert node.name == '/greeter'
        assert isinstance(node, pharos.ScriptNode)
        assert registrations(master, '/greeter')[0] == ['/chatter', '/rosout']
        assert master.node('/greeter') is node
        assert node in master.nodes()


def test_a_scripts_messages_arrive(master):
    mailbox = Mailbox(create(master, '/hearer'), '/chatter', 'std_msgs/String')
    with master.load(TALKER, name='greeter'):
        assert mailbox.next().data == 'hello from /greeter'


def test_a_script_shows_how_many_topics_it_has_for_it_has_no_channels(master, mailbox):
    create(master, '/hearer').interested_in('/chatter', 'std_msgs/String', mailbox)
    with master.load(TALKER, name='greeter') as script:
        mailbox.next()
        assert '/greeter running, 1 topic: ' in repr(script)
    assert repr(script) == '<ScriptNode /greeter stopped>'


def test_a_script_without_a_name_given_has_its_own(master):
    with master.load(WORKER, None, 'spin') as node:
        assert node.name == '/worker'


def test_scripts_that_ask_for_anonymous_names_have_different_ones(master):
    with master.load(TALKER) as one, master.load(TALKER) as other:
        assert one.name.startswith('/talker_')
        assert other.name.startswith('/talker_')
        assert one.name != other.name


def test_the_stop_of_a_node_ends_its_script(master):
    node = master.load(TALKER, name='ended')
    node.stop()
    assert node.wait(0) == 0
    assert registrations(master, '/ended') == [[], [], []]


def test_a_script_gets_its_whole_command_line(master):
    report = report_of(master, '--mode', 'fast', name='teller', remap={'image': '/camera/image'})
    assert report['argv'] == [
        *(str(REPORTER), '--mode', 'fast', 'image:=/camera/image', '__name:=teller')
    ]
    assert report['mode'] == 'fast'
    assert report['topic'] == '/camera/image'


def test_a_script_is_in_the_namespace_given(master):
    report = report_of(master, namespace='/robot1', topic='/robot1/report')
    assert report['name'] == '/robot1/reporter'


def test_a_script_is_in_the_namespace_of_its_arguments(master):
    report = report_of(master, '__ns:=/robot2', name='teller', topic='/robot2/report')
    assert report['name'] == '/robot2/teller'


def test_a_script_may_give_arguments_of_its_own_to_init_node(master):
    with master.load(WORKER, None, 'own argv', name='worker') as node:
        assert node.name == '/called_by_itself'
        assert node.ros.resolve_name('image') == '/camera'


def test_a_script_has_the_log_level_that_it_asks_for(master):
    with master.load(REPORTER):
        answer = master.lookup_service('/reporter/get_loggers').call()
    levels = {logger.name: logger.level for logger in answer.loggers}
    assert levels['rosout'] == 'WARN'


def test_a_script_may_do_without_ros_time(master):
    master.parameters['/use_sim_time'] = True
    try:
        with master.load(REPORTER, name='without'), master.load(WORKER, None, 'spin', name='with'):
            hears_clock = [node.name for node in master.local_nodes() if _hears(node, '/clock')]
    finally:
        del master.parameters['/use_sim_time']
    assert hears_clock == ['/with']


def _hears(node, topic):
    return topic in registrations(node.master, node.name)[1]


def test_a_script_finds_its_private_parameters(master):
    assert report_of(master, params={'rate': {'high': [1.5, 'x']}})['rate'] == {'high': [1.5, 'x']}


def test_a_script_is_the_main_program(master):
    report = report_of(master)
    assert report['main'] == '__main__'
    assert report['file'] == str(REPORTER)
    assert report['helper'] == 'talking'


def test_a_script_that_is_restarted_runs_again_from_its_first_line(master):
    mailbox = Mailbox(create(master, '/listener_of_reports'), '/report', 'std_msgs/String')
    with master.load(REPORTER, name='teller') as node:
        waiting = in_thread(node.wait)
        mailbox.next()
        first = node.latest_run
        node.restart()
        assert json.loads(mailbox.next().data)['calls'] == 1
        assert node.latest_run is not first
        assert waiting.is_alive()  # for its end, which a restart is not
    assert ended(waiting)


def test_a_script_with_an_anonymous_name_is_restarted(master):
    node = master.load(TALKER)
    before = node.name
    node.restart()
    assert node.is_running
    assert node.name.startswith('/talker_')
    assert [each.name for each in master.local_nodes()] == [node.name]
    assert before == node.name or before not in [each.name for each in master.nodes()]
    node.stop()


def test_a_script_that_failed_to_start_at_a_restart_is_stopped(master, tmp_path):
    path = tmp_path / 'edited.py'
    path.write_text(TALKER.read_text())
    node = master.load(path, name='edited')
    waiting = in_thread(node.wait)
    path.write_text('1 / 0\n')
    with pytest.raises(pharos.PharosError, match='ZeroDivisionError'):
        node.restart()
    assert ended(waiting)
    assert not node.is_running
    path.write_text(TALKER.read_text())
    node.restart()
    assert node.is_running
    node.stop()


def test_each_run_of_a_script_loads_its_modules_anew(master):
    mailbox = Mailbox(create(master, '/listener_of_reports'), '/report', 'std_msgs/String')
    first = master.load(REPORTER, name='first')
    second = master.load(REPORTER, name='second')
    messages = mailbox.take(2)
    first.stop()
    first.start()
    messages += mailbox.take(1)
    assert [json.loads(message.data)['calls'] for message in messages] == [1, 1, 1]
    second.stop()


@pytest.mark.parametrize(
    'how, code',
    [
        ('return', 0),
        ('exit', 0),
        ('exit 3', 3),
        ('exit -1', 255),
        ('exit text', 1),
        ('exit unprintable', 1),
        ('raise', 1),
    ],
)
def test_a_script_that_ends_stops_its_node(how, code, master):
    node = master.load(WORKER, None, how)
    assert node.wait(30) == code
    assert not node.is_running
    assert registrations(master, '/worker') == [[], [], []]


def test_what_a_script_raises_is_a_failure_of_its_node(master, transcript):
    node = master.load(WORKER, None, 'raise')
    node.wait(30)
    assert isinstance(node.errors[0], ZeroDivisionError)
    assert 'return 1 / 0' in node.failures[0].traceback
    assert transcript == [
        f"script {str(WORKER)!r} of /worker raised ZeroDivisionError: division by zero"
    ]


def test_a_script_that_never_names_its_node_runs_to_its_end(master):
    assert master.load(WORKER, None, 'nameless').exit_code == 0
    assert master.load(WORKER, None, 'nameless exit 4').exit_code == 4


RELAY = """#!/usr/bin/python3
# generated from catkin/cmake/template/script.py.in for a devel space
import sys
python_script = {source!r}
"""


def test_a_program_and_catkins_wrapper_of_it_are_one(master, tmp_path, monkeypatch):
    package, wrappers = tmp_path / 'wrapped', tmp_path / 'wrapped' / 'wrappers'
    wrappers.mkdir(parents=True)
    (package / 'package.xml').write_text('<package><name>wrapped</name></package>')
    program = pathlib.Path(shutil.copy(WORKER, package))
    wrapper = wrappers / program.name
    wrapper.write_text(RELAY.format(source=str(program)))
    for file in program, wrapper:
        file.chmod(0o755)
    monkeypatch.setenv('ROS_PACKAGE_PATH', str(tmp_path))
    assert len(program_files.find('wrapped', program.name)) == 2
    with master.load('wrapped', program.name, 'spin') as node:
        assert node.path == str(program)


@pytest.mark.parametrize('how', ['spin', 'sleep', 'nameless sleep', 'loop'])
def test_what_spins_or_sleeps_ends_with_its_node(how, master):
    pharos.ScriptNode.init_timeout, before = 0.5, pharos.ScriptNode.init_timeout
    node = master.load(WORKER, None, how)
    pharos.ScriptNode.init_timeout = before
    node.stop_timeout = 0.2
    node.stop()
    # its sleeps are cut off when the time is up
    codes = {0, -signal.SIGTERM, -signal.SIGINT} if how != 'spin' else {0}
    assert node.exit_code in codes


@pytest.mark.parametrize('how', ['interrupted', 'nameless interrupted'])
def test_the_stop_is_ctrl_c_to_a_script_that_has_rospy_handle_no_signals(
    how, master, tmp_path, monkeypatch
):
    monkeypatch.setattr(pharos.ScriptNode, 'init_timeout', 0.5)
    node = master.load(WORKER, None, how, tmp_path / 'said')
    node.stop()
    assert (tmp_path / 'said').read_text() == 'interrupted\n'
    assert node.exit_code == 0


def test_a_script_that_ctrl_c_would_end_has_not_failed(master):
    node = master.load(WORKER, None, 'interrupted loop')
    node.stop()
    assert node.exit_code == -signal.SIGINT
    assert not node.errors


def test_a_script_that_ignores_its_end_is_named_and_left_behind(master, tmp_path):
    logged = Mailbox(create(master, '/reader'), '/rosout', 'rosgraph_msgs/Log')
    node = master.load(WORKER, None, 'ignore', tmp_path / 'end')
    node.stop_timeout = 0.1
    node.stop()
    assert logged.wait_for(lambda line: 'left behind' in line.msg).msg == (
        'left behind, for it did not end within 0.1 s of the stop: /worker script. A script ends by'
        ' itself if it spins, sleeps, or loops while not rospy.is_shutdown(); one that cannot is'
        ' better a process of its own: master.run()'
    )
    assert node.exit_code is None
    assert registrations(master, '/worker') == [[], [], []]
    (tmp_path / 'end').touch()


def test_a_script_that_would_be_a_node_after_its_stop_takes_no_name(master, tmp_path, monkeypatch):
    monkeypatch.setattr(pharos.ScriptNode, 'init_timeout', 0.1)
    node = master.load(WORKER, None, 'nameless late', tmp_path / 'end')
    node.stop_timeout = 0.1
    node.stop()
    (tmp_path / 'end').touch()
    until(lambda: not node.latest_run.rospy.thread_count)
    monkeypatch.undo()
    with master.load(WORKER, None, 'spin') as another:
        assert another.name == '/worker'
    assert not node.errors


def test_a_script_may_do_its_last_things_after_the_stop_has_begun(master, tmp_path):
    node = master.load(WORKER, None, 'last words', tmp_path / 'said')
    node.stop()
    assert (tmp_path / 'said').read_text() == 'put away\n'
    assert node.exit_code == 0


def test_a_scripts_own_sleep_is_as_long_as_it_says_also_when_its_node_stops(master, tmp_path):
    node = master.load(WORKER, None, 'sleep long', tmp_path / 'said')
    until((tmp_path / 'said').exists)
    node.stop()
    assert (tmp_path / 'said').read_text() == 'opened\nclosed in time: True\n'
    assert node.exit_code == 0


@pytest.mark.parametrize('how', ['daemon', 'daemon alone'])
def test_what_sleeps_in_a_daemon_when_a_script_ends_does_nothing_more(how, master, tmp_path, capfd):
    node = master.load(WORKER, None, how, tmp_path / 'said')
    until((tmp_path / 'said').exists)
    node.stop()
    assert (tmp_path / 'said').read_text() == 'armed\n'
    assert 'Traceback' not in capfd.readouterr().err


@pytest.mark.parametrize('how, times', [('thread', 1), ('timer', 1), ('executor', 2)])
def test_a_script_ends_with_its_threads(how, times, master, tmp_path):
    node = master.load(WORKER, None, how, tmp_path / 'said')
    node.wait(30)
    assert (tmp_path / 'said').read_text() == times * 'done\n'


def test_a_hook_of_on_shutdown_sleeps_as_long_as_it_says(master, tmp_path):
    node = master.load(WORKER, None, 'hook', tmp_path / 'said')
    until(lambda: '/last_words' in registrations(master, '/worker')[0])
    node.stop()
    assert (tmp_path / 'said').read_text() == 'slept True, is_shutdown False\n'


def test_what_a_hook_of_on_shutdown_publishes_arrives(master, tmp_path):
    mailbox = Mailbox(create(master, '/hearer'), '/last_words', 'std_msgs/String')
    echo = 'rostopic', 'echo', '-n1', '/last_words'
    node = master.load(WORKER, None, 'hook', tmp_path / 'said')
    with Program(master.url, *echo) as program:
        until(lambda: len(master.topic('/last_words').subscribers) == 2)
        publisher = node.latest_run.rospy.publisher('/last_words')
        until(lambda: publisher.get_num_connections() == 2)
        node.stop()
        program.wait_for('data: "stopping"')
    assert mailbox.next().data == 'stopping'


@pytest.mark.parametrize('how, is_shutdown', [('handles', False), ('nameless handles', True)])
def test_what_a_handler_of_signals_raises_ends_the_script(how, is_shutdown, master, tmp_path):
    said = tmp_path / 'said'
    node = master.load(WORKER, None, how, said)
    until(lambda: said.exists() and 'ready' in said.read_text())
    node.stop()
    assert said.read_text() == f'ready\nis_shutdown {is_shutdown}\nfinally\n'
    assert node.exit_code == 4


def test_the_stop_runs_hooks_before_the_script_ends(master, tmp_path):
    said = tmp_path / 'said'
    node = master.load(WORKER, None, 'order', said)
    until(lambda: node.ros.core._client_shutdown_hooks)
    node.stop()
    assert said.read_text().split() == ['hook', 'main', 'atexit']


def test_a_hook_of_on_shutdown_may_end_what_the_script_waits_for(master, capsys):
    node = master.load(WORKER, None, 'queue')
    node.stop_timeout = 0
    until(lambda: node.ros.core._client_shutdown_hooks)
    node.stop()
    assert node.exit_code == 0
    assert 'left behind' not in capsys.readouterr().err


def test_a_hook_of_on_shutdown_may_call_a_service_of_its_node(master, tmp_path):
    said = tmp_path / 'said'
    node = master.load(WORKER, None, 'calls itself', said)
    until(lambda: node.ros.core._client_shutdown_hooks)
    node.stop()
    assert said.read_text() == 'GetLoggersResponse\n'


def test_a_callback_of_a_script_may_stop_its_node(master, tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_MASTER_URI', master.url)
    said = tmp_path / 'said'
    node = master.load(WORKER, None, 'stops itself', said)
    publisher = create(master, '/asks').output_channel('/stop', 'std_msgs/String')
    publisher.wait_for_subscribers()
    publisher.publish(String('now'))
    assert node.wait(30) == 0
    until(said.exists)
    until(lambda: not node.latest_run.rospy.thread_count)


def test_a_script_goes_on_after_its_signal_shutdown_for_as_long_as_it_takes(master, tmp_path):
    node = master.load(WORKER, None, 'late', tmp_path / 'end')
    node.stop_timeout = 0
    until(node.ros.is_shutdown)
    with pytest.raises(TimeoutError):
        node.wait(0.2)
    (tmp_path / 'end').touch()
    assert node.wait(30) == 3


@pytest.mark.parametrize('when', ['starts', 'ends'])
def test_nobody_registers_a_script_that_is_half_registered(when, master, monkeypatch):
    repaired, seen = [], []
    monkeypatch.setattr(registration, 'repair', lambda node, *more: repaired.append(node.name))

    def look(*reason):
        if not seen:
            seen.append('looked')
            del repaired[:]
            watcher_of(master)._look()
            seen.extend(repaired)
        return False

    with create(master, '/another'):
        if when == 'starts':
            monkeypatch.setattr(registration, 'is_awaited', look)
        node = master.load(WORKER, None, 'spin')
        if when == 'ends':
            node.ros.core.add_preshutdown_hook(look)
            node.ros.signal_shutdown('enough')
        node.stop()
    assert 'looked' in seen
    assert '/worker' not in seen


def test_who_loads_a_script_is_told_that_another_has_stopped_it(master, tmp_path):
    refused = []

    def load():
        with pytest.raises(
            pharos.NodeStoppedError, match='was stopped before it was a node'
        ) as error:
            master.load(WORKER, None, 'nameless late', tmp_path / 'end')
        refused.append(error)

    loading = in_thread(load)
    until(lambda: [node for node in node_registry.nodes() if node.latest_run.rospy.thread_count])
    (node,) = node_registry.nodes()
    node.stop_timeout = 0
    node.stop()
    (tmp_path / 'end').touch()
    assert ended(loading)
    assert refused


def test_signal_shutdown_ends_the_node(master):
    node = master.load(WORKER, None, 'signal_shutdown')
    assert node.wait(30) == 0
    assert registrations(master, '/worker') == [[], [], []]


def test_rosnode_kill_ends_a_script(master):
    node = master.load(WORKER, None, 'spin')
    assert 'killed' in run(master.url, 'rosnode', 'kill', '/worker').stdout
    assert node.wait(30) == 0


def test_a_script_starts_again_from_its_first_line(master, tmp_path):
    node = master.load(WORKER, None, 'runs', tmp_path / 'said')
    until((tmp_path / 'said').exists)
    node.stop()
    node.start()
    until(lambda: (tmp_path / 'said').read_text() == '1\n1\n')
    assert master.node('/worker') is node
    node.stop()


def test_wait_says_when_the_time_is_up(master):
    node = master.load(WORKER, None, 'spin')
    with pytest.raises(TimeoutError, match='^/worker has not ended within 0.1 s: stop'):
        node.wait(0.1)


def test_the_node_of_another_script_is_told_that_a_script_is_not_there_yet(master, monkeypatch):
    monkeypatch.setattr(pharos.ScriptNode, 'init_timeout', 0.1)
    node = master.load(WORKER, None, 'nameless sleep', name='late')
    assert node.is_running
    with pytest.raises(pharos.UnknownNodeError):
        master.wait_for_node('/late', 0)


def test_lines_on_the_screen_carry_the_name_of_the_node(master, capsys):
    master.load(WORKER, None, 'speak', output='screen', name='left', namespace='eye').wait(30)
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    logged = [line for line in lines if 'logged' in line]
    assert [line for line in lines if line not in logged] == [
        *('[/eye/left] two', '[/eye/left] lines', '[/eye/left] one more', '[/eye/left] no enddead')
    ]
    assert len(logged) == 1
    assert re.match(r'\[/eye/left\] \[INFO\] \[.*\]: logged$', logged[0])
    assert printed.err == '[/eye/left] aside\n'


def test_a_script_may_print_by_a_stream_of_its_own_and_close_it(master, capsys):
    node = master.load(TALKING / 'wrapping.py', name='wrapping', output='screen')
    assert node.exit_code == 0
    assert not sys.stdout.closed
    assert capsys.readouterr().out == '[/wrapping] wrapped: ü\n'


@pytest.mark.parametrize('how', ['close', 'detach', 'wrap'])
def test_a_script_that_closes_what_it_prints_to_closes_it_for_nobody_else(how, master, capsys):
    node = master.load(TALKING / 'closing.py', None, how)
    assert node.exit_code == 0
    print('goes on')
    print('goes on', file=sys.stderr)
    assert capsys.readouterr() == ('printed\ngoes on\n', 'goes on\n')


def test_what_a_script_prints_is_as_it_is_unless_asked_for(master, capsys):
    master.load(WORKER, None, 'speak').wait(30)
    assert 'two\nlines\none more\n' in capsys.readouterr().out


@pytest.mark.parametrize(
    'output, error', [('', pharos.PharosError), ('/', pharos.PharosError), (1, TypeError)]
)
def test_an_output_that_can_be_none_is_refused(master, output, error):
    """A number was taken for the open file of that number, which was closed at the end."""
    with pytest.raises(error, match="output.* 'screen'|output='screen'"):
        master.load(WORKER, None, 'speak', output=output)
    os.fstat(1)
    assert master.local_nodes() == []


def test_what_a_script_prints_goes_to_a_file(master, capsys, tmp_path):
    node = master.load(WORKER, None, 'speak', output=tmp_path / 'printed')
    node.wait(30)
    node.start()
    node.wait(30)
    printed = (tmp_path / 'printed').read_text()
    assert printed.count('two\nlines\none more\n') == 2
    assert printed.endswith('no enddead\n')
    printed = capsys.readouterr()
    assert 'lines' not in printed.out
    assert printed.err == '[/worker] aside\n' * 2


# -- bad input


def test_a_file_that_is_not_there_is_named(master):
    with pytest.raises(pharos.UnknownNodeError, match='there is no file /nowhere/talker.py: to'):
        master.load('/nowhere/talker.py')


def test_a_package_that_is_not_there_is_named(master):
    with pytest.raises(pharos.UnknownNodeError, match="no ROS package 'nowhere' on ROS_PACKAGE"):
        master.load('nowhere', 'talker.py')


def test_a_program_that_a_package_has_not_is_named(master):
    with pytest.raises(pharos.UnknownNodeError, match="std_msgs has no program 'talker.py': see"):
        master.load('std_msgs', 'talker.py')


def test_programs_of_one_name_are_named(master, tmp_path, monkeypatch):
    package = tmp_path / 'doubled'
    for folder in 'nodes', 'scripts':
        (package / folder).mkdir(parents=True)
        shutil.copy(WORKER, package / folder)
    (package / 'package.xml').write_text('<package><name>doubled</name></package>')
    monkeypatch.setenv('ROS_PACKAGE_PATH', str(tmp_path))
    with pytest.raises(pharos.UnknownNodeError, match='several programs') as caught:
        master.load('doubled', WORKER.name)
    assert str(package / 'nodes' / WORKER.name) in str(caught.value)
    assert str(package / 'scripts' / WORKER.name) in str(caught.value)


def test_a_compiled_program_is_refused(master):
    with pytest.raises(pharos.PharosError, match='relay is no Python program but a compiled one'):
        master.load('topic_tools', 'relay')


def test_a_syntax_error_is_told_with_file_and_line(master):
    with pytest.raises(pharos.PharosError, match='mistyped is no Python 3 program') as caught:
        master.load(TALKING / 'mistyped')
    assert 'line 3' in str(caught.value)
    assert isinstance(caught.value.__cause__, SyntaxError)


def test_what_a_script_raises_before_it_is_a_node_is_the_callers(master):
    with pytest.raises(pharos.PharosError, match='ended before it was one: ZeroDiv') as caught:
        master.load(WORKER, None, 'nameless raise', name='early')
    assert f'{WORKER}, to be the node /early' in str(caught.value)
    assert isinstance(caught.value.__cause__, ZeroDivisionError)
    assert master.local_nodes() == []


def test_two_scripts_of_one_name_are_refused_before_the_second_runs(master, tmp_path):
    with master.load(WORKER, None, 'spin', name='one'):
        with pytest.raises(pharos.NodeNameInUseError, match='/one is taken by a running node'):
            master.load(WORKER, None, 'runs', tmp_path / 'said', name='one')
    assert not (tmp_path / 'said').exists()


def test_a_script_that_takes_the_name_of_another_is_refused(master):
    with master.load(WORKER, None, 'spin') as first:
        with pytest.raises(pharos.NodeNameInUseError, match='/worker is taken') as caught:
            master.load(WORKER, None, 'spin')
        assert str(WORKER) in str(caught.value)
        assert first.is_running


def test_a_script_may_not_take_the_name_of_a_node_elsewhere(master):
    with Program(master.url, sys.executable, WORKER, 'spin'):
        master.wait_for_node('/worker', 30)
        with pytest.raises(pharos.NodeNameInUseError, match='/worker is taken by a running node'):
            master.load(WORKER, None, 'spin')


def test_init_node_may_be_called_again_with_the_same_arguments(master):
    node = master.load(WORKER, None, 'again')
    assert node.wait(30) == 0


def test_init_node_with_other_arguments_is_rospys_own_error(master):
    node = master.load(WORKER, None, 'other name')
    assert node.wait(30) == 1
    assert 'has already been called with different arguments' in str(node.errors[0])


def test_without_a_master_a_script_is_not_loaded():
    with pytest.raises(pharos.MasterUnreachableError, match=f'{WORKER.name}, to be the node /lost'):
        pharos.Master(refused_url()).load(WORKER, None, 'spin', name='lost')


@pytest.mark.parametrize(
    'options, text',
    [
        ({'name': 'no name'}, "'no name' cannot be a node name"),
        ({'namespace': 'n s', 'name': 'x'}, "'n s/x' cannot be a node name"),
        ({'params': {'rate': object()}}, '~rate cannot be <object'),
        ({'params': {'a b': 1}}, "'a b' cannot be a parameter name"),
        ({'params': {1: 1}}, 'a parameter name is a string, not 1'),
        ({'params': {'': 1}}, "a parameter name is one such as '/robot1/rate', not ''"),
        ({'params': {'/rate': 1}}, r"'/rate' is not private to the node: set it by master.param"),
        ({'remap': {'': 'a'}}, "a remapped name is one such as '/robot1/image', not ''"),
        ({'remap': {'a': 'b c'}}, "'b c' cannot be a remapped name"),
    ],
)
def test_what_cannot_be_given_to_a_script_is_refused(options, text, master):
    with pytest.raises(ValueError, match=text):
        master.load(WORKER, None, 'spin', **options)
    assert master.local_nodes() == []


@pytest.mark.parametrize(
    'options, text',
    [
        ({'params': [1]}, r'params is a dict by name, not \[1\]'),
        ({'namespace': 5}, 'namespace is a name, not 5'),
        ({'package': 42}, 'by its package and its name, or by its path, not 42'),
        ({'package': None}, 'by its package and its name, or by its path, not None'),
    ],
)
def test_what_is_of_a_type_that_cannot_be_is_refused(options, text, master):
    with pytest.raises(TypeError, match=text):
        master.load(**{'package': WORKER, **options})
    assert master.local_nodes() == []


@pytest.mark.parametrize(
    'argument, text',
    [
        ('_rate:=[1', r"'_rate:=\[1' sets no private parameter, for its value is no YAML"),
        ('__master:=http://127.0.0.1:1/', '__master:=http://127.0.0.1:1/ is not obeyed'),
    ],
)
def test_what_an_argument_cannot_ask_for_is_said(argument, text, master):
    with pytest.raises(ValueError, match=text):
        master.load(WORKER, None, 'spin', argument)
    assert master.local_nodes() == []


def test_what_a_script_gives_to_init_node_and_is_no_yaml_is_said(master):
    with pytest.raises(pharos.PharosError, match=r"'_rate:=\[1' sets no private parameter"):
        master.load(WORKER, None, 'bad argv')


def test_the_master_that_it_has_anyway_may_be_among_the_arguments(master):
    with master.load(WORKER, None, 'spin', f'__master:={master.url}') as node:
        assert node.name == '/worker'


def test_scripts_are_loaded_from_several_threads_at_once(master):
    nodes = []
    names = [f'worker_{number}' for number in range(5)]
    threads = [
        in_thread(lambda name: nodes.append(master.load(WORKER, None, 'spin', name=name)), name)
        for name in names
    ]
    assert all(ended(thread) for thread in threads)
    assert sorted(node.name for node in nodes) == ['/' + name for name in names]
    assert {'/' + name for name in names} <= {node.name for node in master.nodes()}


# -- within a program

LOADS = ROOT / 'test' / 'programs' / 'loads.py'


@pytest.mark.parametrize('how', ['spin', 'wait'])
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_scripts_of_a_program(how, number, master):
    with Program(master.url, sys.executable, LOADS, how, WORKER, 'spin') as program:
        program.wait_for('loaded /worker')
        # 0 where it waited already
        assert program.end(number) in (0, 128 + number, -number)
    assert registrations(master, '/worker') == [[], [], []]


def test_ctrl_c_ends_a_script_that_is_being_loaded(master, tmp_path):
    command = LOADS, 'spin', WORKER, 'nameless runs', tmp_path / 'said'
    with Program(master.url, sys.executable, *command) as program:
        until((tmp_path / 'said').exists)
        program.end(signal.SIGINT)
        assert 'loaded' not in program.read_to_the_end()


def test_the_end_of_a_program_ends_its_scripts(master):
    with Program(master.url, sys.executable, LOADS, 'end', WORKER, 'spin') as program:
        program.wait_for('ends')
        assert program.process.wait(30) == 0
    assert registrations(master, '/worker') == [[], [], []]


def test_the_exit_code_is_there_when_a_script_has_ended(master):
    with Program(master.url, sys.executable, LOADS, 'wait', WORKER, 'exit text') as program:
        program.wait_for('exit code 1')
        assert 'cannot go on\n' in program.printed


def test_a_nameless_script_is_called_after_its_file(master):
    assert master.load(WORKER, None, 'nameless').name.startswith('/worker_')
