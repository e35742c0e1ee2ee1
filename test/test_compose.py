"""master.compose: launch files whose Python nodes run in this process."""
import json
import os
import pathlib
import signal

import pytest

import pharos
from helpers import create
from pharos.compose import composition
from pharos.testing import Mailbox, TIMEOUT, until
from programs import ROOT, forget_parameters

PACKAGE = ROOT / 'test' / 'programs' / 'composed_robot'
STRING = 'std_msgs/String'


@pytest.fixture(autouse=True)
def packages(monkeypatch, tmp_path):
    """The packages of test/programs are on ROS_PACKAGE_PATH; ROS's own folder is the test's."""
    monkeypatch.setenv('ROS_PACKAGE_PATH', os.pathsep.join([str(PACKAGE.parent), '/usr/share']))
    monkeypatch.setenv('ROS_HOME', str(tmp_path))


@pytest.fixture
def compose(master):
    """``compose('chat.launch', text='hello')``: a Composition, which ends with the test."""
    begun = []

    def compose(file, **options):
        begun.append(master.compose('composed_robot', file, **options))
        return begun[-1]

    yield compose
    for each in begun:
        each.stop()
    forget_parameters(master.url)


def test_the_python_nodes_of_a_launch_file_run_in_this_process(master, compose):
    composed = compose('chat.launch')
    assert [node.name for node in composed.nodes] == ['/talker']
    assert isinstance(composed, pharos.Composition)
    assert master.node('/talker') is composed.nodes[0]


def test_the_others_run_as_roslaunch_starts_them(master, compose):
    mailbox = Mailbox(create(master, '/hearer'), '/heard', STRING)
    composed = compose('chat.launch', text='by way of C++')
    assert mailbox.next(TIMEOUT).data == 'by way of C++'
    assert isinstance(master.node('/relay'), pharos.ExternalNode)
    assert composed.process.poll() is None


def test_there_is_no_process_where_all_nodes_run_here(compose):
    assert compose('respawn.launch', delay=100).process is None


def test_a_python_node_runs_apart_where_asked_for(master, compose):
    composed = compose('chat.launch', apart=['talker'])
    assert composed.nodes == []
    assert isinstance(master.wait_for_node('/talker', TIMEOUT), pharos.ExternalNode)


def test_the_parameters_of_the_file_are_set(master, compose):
    compose('chat.launch', only=['talker'])
    assert master.parameters['/said_by'] == 'the file'
    assert master.parameters['/talker/text'] == 'hello'


def test_parameters_are_cleared_where_the_file_says_so(master, compose):
    master.parameters['/cleared/old'] = 1
    master.parameters['/kept/old'] = 1
    compose('cleared.launch')
    assert master.parameters['/cleared'] == {'new': 1}
    assert master.parameters['/kept/old'] == 1


def test_what_the_master_refuses_is_told_with_the_file(compose):
    with pytest.raises(pharos.PharosError, match='parameters.launch: Failed to clear parameter'):
        compose('parameters.launch', cleared='/')


def test_a_node_finds_what_roslaunch_would_have_given_it(master, compose):
    mailbox = Mailbox(create(master, '/hearer'), '/reflection', STRING)
    compose('mirror.launch')
    told = json.loads(mailbox.next(TIMEOUT).data)
    run_id = master.parameters['/run_id']
    log = os.path.join(os.environ['ROS_LOG_DIR'], run_id, 'deep-mirror-1.log')
    assert told['argv'] == [
        *(str(PACKAGE / 'scripts' / 'mirror.py'), 'one', 'two words'),
        *('mirrored:=/reflection', '__name:=mirror', f'__log:={log}'),
    ]
    assert told['environment']['FOR_ONE'] == '1'
    assert told['environment']['ROS_NAMESPACE'] == '/deep'
    assert told['environment']['ROS_MASTER_URI'] == master.url
    assert told['parameters'] == {'list': [1, 2]}
    assert os.path.exists(log)


def test_the_environment_of_a_node_is_its_own(compose):
    compose('mirror.launch')
    assert 'FOR_ONE' not in os.environ


@pytest.mark.parametrize('where, folder', [('node', PACKAGE / 'scripts'), ('ROS_HOME', None)])
def test_the_working_directory_of_a_node_is_its_own(master, compose, where, folder, tmp_path):
    before = os.getcwd()
    mailbox = Mailbox(create(master, '/hearer'), '/reflection', STRING)
    compose('mirror.launch', cwd=where)
    told = json.loads(mailbox.next(TIMEOUT).data)
    assert told['folder'] == str(folder or tmp_path)
    assert os.getcwd() == before


def printed_by_mirror(master, compose, output, capfd):
    """What comes on the screen, on standard output and the errors, and into its file."""
    mailbox = Mailbox(create(master, '/hearer'), '/reflection', STRING)
    composed = compose('mirror.launch', output=output)
    mailbox.next(TIMEOUT)  # printed before this
    composed.stop()
    folder = os.path.join(os.environ['ROS_LOG_DIR'], master.parameters['/run_id'])
    path = pathlib.Path(folder, 'deep-mirror-1-stdout.log')
    return (*capfd.readouterr(), path.read_text() if path.exists() else '')


def test_what_a_node_prints_goes_to_its_log_file_and_errors_to_the_screen(master, compose, capfd):
    printed, errors, logged = printed_by_mirror(master, compose, 'log', capfd)
    assert 'mirror' not in printed
    assert '[/deep/mirror] complained\n' in errors
    assert logged == 'printed by the mirror\n'


def test_what_a_node_prints_comes_on_the_screen_with_its_name(master, compose, capfd):
    printed, errors, logged = printed_by_mirror(master, compose, 'screen', capfd)
    assert printed == '[/deep/mirror] printed by the mirror\n'
    assert '[/deep/mirror] complained\n' in errors
    assert logged == ''


def test_callbacks_and_child_processes_are_in_the_working_directory_too(master, compose):
    node = create(master, '/asking')
    mailbox = Mailbox(node, '/reflection', STRING)
    compose('mirror.launch')
    mailbox.next(TIMEOUT)
    node.send_to('/deep/where', typed_as=STRING)
    assert mailbox.next(TIMEOUT).data == f"{PACKAGE / 'scripts'} {PACKAGE / 'scripts'}"


def test_a_node_that_needs_a_working_directory_runs_apart_where_it_cannot_have_one(
    compose, monkeypatch
):
    monkeypatch.setattr(pharos.working_directory, 'is_possible', lambda: False)
    composed = compose('mirror.launch')
    assert composed.nodes == []
    assert composed.process.poll() is None


@pytest.mark.leaves('the registrations of a node that was killed')
def test_the_nodes_apart_end_where_roslaunch_is_killed(master, compose):
    composed = compose('chat.launch')
    relay = master.wait_for_node('/relay', TIMEOUT)
    os.kill(composed.process.pid, signal.SIGKILL)
    until(lambda: not relay.is_alive())
    assert dict(composed.outcomes())['/relay'] == (
        'ran apart: asked to end, as roslaunch was killed'
    )


def test_a_stop_ends_all_nodes(master, compose):
    composed = compose('chat.launch')
    master.wait_for_node('/relay', TIMEOUT)
    composed.stop()
    assert not composed.nodes[0].is_running
    assert composed.process.poll() is not None
    assert dict(composed.outcomes())['/relay'] == 'ran apart, by roslaunch, which ended with 0'
    assert {node.name for node in master.nodes()} <= {'/rosout'}


def test_it_ends_with_its_block(master, compose):
    with compose('chat.launch') as composed:
        pass
    assert not composed.nodes[0].is_running


@pytest.mark.parametrize('names', [['/talker'], ['/relay'], ['/talker', '/relay']])
def test_to_wait_has_a_limit(compose, names):
    says = f"not ended within 0.1 s: {', '.join(names)}; stop"
    with pytest.raises(TimeoutError, match=says):
        compose('chat.launch', only=names).wait(0.1)


def test_a_required_node_that_ends_here_ends_all(master, compose, transcript):
    composed = compose('required.launch')
    master.wait_for_node('/relay', TIMEOUT)
    del master.parameters['/ends/stay']
    assert composed.wait(TIMEOUT) == 1
    assert not any(node.is_running for node in composed.nodes)
    assert composed.process.poll() is not None
    assert '/ends, which is required, has ended: all others end' in transcript


def test_a_required_node_that_is_restarted_has_not_ended(master, compose, transcript):
    composed = compose('required.launch', only=['ends'])
    (node,) = composed.nodes
    node.restart()
    assert node.is_running
    until(lambda: master.parameters['/ends/starts'] == 2)
    assert not composed.is_over
    assert not [line for line in transcript if 'ended' in line]
    del master.parameters['/ends/stay']
    assert composed.wait(TIMEOUT) == 1
    assert '/ends, which is required, has ended: all others end' in transcript


def test_a_required_node_that_ends_apart_ends_all(master, compose, transcript):
    composed = compose('required.launch', apart=['ends'])
    master.wait_for_node('/ends', TIMEOUT)
    del master.parameters['/ends/stay']
    assert composed.wait(TIMEOUT) == 1
    assert not any(node.is_running for node in composed.nodes)
    assert (
        'a required one of /relay, /ends, which run apart, has ended: all others end' in transcript
    )


def test_a_required_node_that_cannot_start_ends_all(compose, transcript):
    composed = compose('required_broken.launch')
    assert composed.wait(TIMEOUT) == 1
    assert not any(node.is_running for node in composed.nodes)
    assert '/broken, which is required, did not start: all others end' in transcript


def test_a_required_node_that_the_system_cannot_start_ends_all(compose, transcript):
    composed = compose('unstartable.launch', required=True)
    assert composed.wait(TIMEOUT) == 1
    assert transcript[-1] == (
        '/no_first_line, which is required, cannot be started: all others end'
    )


def test_programs_that_the_system_cannot_start_do_not_end_those_apart(master, compose, transcript):
    composed = compose('unstartable.launch')
    master.wait_for_node('/relay', TIMEOUT)
    assert composed.process.poll() is None
    until(lambda: any('/unknown_kind is not started: Unable' in line for line in transcript))


def test_a_node_that_is_to_be_started_again_is(master, compose):
    compose('respawn.launch')
    until(lambda: master.parameters.get('/ends/starts', 0) > 2)


def test_a_node_is_started_again_after_the_delay(master, compose):
    composed = compose('respawn.launch', delay=1000)
    (kept,) = composed.kept
    until(lambda: kept.outcome == 'ended with exit code 1')
    assert not composed.is_over


@pytest.mark.parametrize('how', ['stop', 'stop_all'])
def test_what_has_been_ended_is_not_started_again(compose, how):
    composed = compose('respawn.launch')
    {'stop': composed.stop, 'stop_all': pharos.node_registry.stop_all}[how]()
    until(lambda: composed.is_over)
    assert not composed.nodes[0].is_running


def test_one_that_is_ended_while_it_starts_again_has_not_failed(master, compose):
    composed = compose('once.launch')
    until(lambda: '/again' in master.parameters)
    composed.stop()
    assert composed.wait(TIMEOUT) == 0


def test_a_node_that_takes_long_to_start_does_not_keep_the_others(master, compose, monkeypatch):
    monkeypatch.setattr(composition, 'PATIENCE', 0.1)
    composed = compose('hangs.launch')
    assert [node.name for node in composed.nodes][1] == '/talker'
    master.parameters['/go'] = True
    assert isinstance(master.wait_for_node('/hangs', TIMEOUT), pharos.ScriptNode)


def test_what_cannot_be_started_is_told_and_the_others_go_on(compose, transcript):
    composed = compose('missing.launch')
    assert [node.name for node in composed.nodes if node.is_running] == ['/talker']
    package, program, syntax = transcript
    assert "missing.launch: /without_package is not started: there is no ROS package" in package
    assert 'missing.launch: /without_program is not started: Cannot locate node' in program
    assert "missing.launch: /with_syntax_error (composed_robot/broken) is not started" in syntax
    assert "'return' outside function" in syntax
