"""Programs and libraries of ROS as a node's own: they find what they would in a process of their
own."""
import builtins
import asyncio
import concurrent.futures
import importlib
import io
import logging
import os
import pathlib
import pickle
import shutil
import signal
import socket
import sys
import termios
import threading

import numpy
import pytest

import pharos
import programs
from helpers import create, ended, in_thread
from pharos.private_rospy import ownership
from pharos.testing import TIMEOUT, until
from workspaces import SPACES, build, forget

PROGRAMS = pathlib.Path(__file__).parent / 'programs'


@pytest.fixture
def node(master):
    """A node whose rospy the programs use."""
    return create(master, '/program_node')


def run(node, program, *arguments):
    """Run a program of the tests as the node's, in this thread; returns its ``__main__``."""
    path = str(PROGRAMS / program)
    node.latest_run.rospy.run_main(path, [path, *arguments])
    return node.ros_import('__main__')


@pytest.fixture(params=SPACES)
def space(request, tmp_path, monkeypatch):
    """A space with the packages of the tests, on Python's path."""
    folder = build(request.param, tmp_path)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setattr(sys, 'path', list(sys.path))  # packages of a devel space add to it
    if request.param == 'debian':
        monkeypatch.setattr(ownership, '_SITES', {*ownership._SITES, str(folder)})
    yield folder
    forget()


# -- programs


def test_a_program_is_main_and_has_its_arguments_and_the_modules_beside_it(master):
    path = 'siblings/counting.py'
    for name in '/first_program', '/second_program':
        node = create(master, name)
        with pytest.raises(SystemExit) as exit_:
            run(node, path, 'one', '--two')
        found = node.parameter('~found').value
        assert found == ['__main__', *2 * [str(PROGRAMS / path)], 'one', '--two', name]
        assert exit_.value.code == 3


def test_what_a_program_finds_in_a_folder_of_its_own_path_is_its_own(master):
    for name in '/first_program', '/second_program':
        main = run(create(master, name), 'own/adds_a_folder.py')
        assert main.plain_module.USERS == [main.sys.argv[0]]
        assert main.pharos is pharos


def test_a_module_beside_a_program_is_read_anew_when_it_has_changed(node, tmp_path):
    for text in 'before', 'after, and longer':
        (tmp_path / 'beside_it.py').write_text(f'TEXT = {text!r}')
        os.utime(tmp_path / 'beside_it.py', (len(text), len(text)))
        (tmp_path / 'program.py').write_text('from beside_it import TEXT')
        assert run(node, tmp_path / 'program.py').TEXT == text
        node.stop()
        node.start()


def test_classes_of_a_program_are_found_by_the_name_of_their_module(node):
    main = run(node, 'own/looks_itself_up.py')
    assert main.itself
    assert main.fields == ['x', 'at']
    assert isinstance(main.pose, main.Pose) and main.pose.x == 1
    assert isinstance(main.colour, main.Colour) and main.colour.red == 7
    assert main.source.startswith('class Stamp:')
    assert main.module == '__main__'
    assert main.hints['at'] is main.Stamp
    assert main.time == node.ros.Time(3, 4)
    assert [type(each) for each in main.copied] == [node.ros.Time, node.ros.Duration]


@pytest.mark.parametrize('kind', ['Time', 'Duration'])
def test_times_of_a_node_pickle(node, kind):
    time = getattr(node.ros, kind)(3, 4)
    copy = pickle.loads(pickle.dumps([time]))[0]
    assert copy == time
    assert type(copy).__module__.startswith('genpy')


def test_a_program_that_is_a_test_finds_its_tests(node):
    with pytest.raises(SystemExit) as exit_:
        run(node, 'own/unit_tests.py')
    assert exit_.value.code  # of all its tests, one fails
    result = node.ros_import('__main__').result
    assert (result.testsRun, result.failures, result.errors) == (1, [], [])


def test_children_see_the_environment_of_the_node(node):
    found = run(node, 'own/children.py').found
    assert found == {
        'getenv': 'own',
        'expandvars': 'own',
        'subprocess': '/ own\n',
        'run': 'too\n',
        'popen': 'own\n',
        'system': 0,
        'system_fails': 7,
        'spawn': 0,
        'check_call': 1,
        'child_of_child': '/ own\n',
        'multiprocessing': 'own',
        'answer': True,
        'exit_code': 0,
    }
    assert 'OWN_VARIABLE' not in os.environ
    assert os.system('test -z "$OWN_VARIABLE$OWN_VARIABLE_TOO"') == 0


def test_what_a_program_sets_is_not_the_processs(node, capsys):
    before = sys.argv, sys.path, sys.stdout, logging.getLogger().handlers, logging.getLogger().level
    copies = [list(each) for each in before[:2]]
    main = run(node, 'own/speaks.py')
    assert main.sys.stdout.getvalue() == 'own\nlogged\nlogged too\n'
    assert main.redirected.getvalue() == 'redirected\n'
    assert capsys.readouterr().out == ''
    root = logging.getLogger()
    assert before == (sys.argv, sys.path, sys.stdout, root.handlers, root.level)
    assert copies == [sys.argv, sys.path]
    assert main.root is not root


def test_arguments_are_the_programs_own_after_star_imports_too(node, master):
    main = run(node, 'own/reads_arguments.py', '--speed', '3', '/a:=/b')
    assert main.argv[1:] == ['--speed', '3', '/a:=/b']
    assert main.speed == 3
    assert main.program == 'reads_arguments.py'
    assert main.usage == 'reads_arguments.py'
    assert main.rest == ['/a:=/b']
    assert main.variable == master.url


def test_a_program_has_builtins_of_its_own_and_its_exit_closes_nothing(node, capsys, monkeypatch):
    monkeypatch.setattr(sys, 'stdin', io.StringIO('a line'))
    before = dict(vars(builtins))
    with pytest.raises(SystemExit, match='enough'):
        run(node, 'own/changes_builtins.py')
    main = node.ros_import('__main__')
    assert main.said == [('hello', 42)]
    assert main.found == 'what'
    assert vars(builtins) == before
    assert sys.stdin.read() == 'a line'


def test_rospy_is_the_nodes_in_whatever_way_it_is_imported(node):
    main = run(node, 'own/imports_rospy.py')
    assert main.names == {'/program_node'}
    assert main.same
    assert main.reloaded
    assert main.known == [True, True, True, False]
    assert main.by_file == main.by_run == main.by_code['NAME'] == '/program_node'
    assert main.examples == (0, 1)


def test_a_programs_time_limit_of_sockets_holds(node):
    try:
        main = run(node, 'own/limits_sockets.py')
        assert socket.getdefaulttimeout() == main.found == 1.5
    finally:
        socket.setdefaulttimeout(None)


@pytest.mark.parametrize('how, code', [('fork', 1), ('spawn', 0)])
def test_a_forked_child_of_a_program_is_told_that_it_cannot_be_a_node(how, code, master, capfd):
    script = master.load(str(PROGRAMS / 'own/has_a_child.py'), None, how)
    assert script.wait(TIMEOUT) == code
    assert ('which has the thread that forked alone' in capfd.readouterr().err) == bool(code)


# -- the end


def test_exit_handlers_and_those_of_signals_run_at_the_stop_and_timers_end(node):
    main = run(node, 'own/ends.py')
    assert main.known
    node.stop()
    assert main.ended == [('SIGINT', None), 'last registered', 'first registered']
    assert ended(main.timer)


def test_an_event_loop_of_a_program_hears_of_its_end(master):
    node = master.load(str(PROGRAMS / 'own' / 'loops.py'))
    main = node.ros_import('__main__')
    assert main.begun.wait(TIMEOUT)
    node.stop()
    assert node.exit_code == 0
    assert main.ended == ['by the signal']


def test_a_program_ends_as_python_ends_it_after_its_threads(node):
    main = run(node, 'own/threads.py')
    ending = in_thread(node.latest_run.rospy.exit_main)
    assert main.ended == []
    main.go_on.set()
    assert ended(ending)
    assert main.ended == ['thread', 'atexit']


def test_a_program_that_goes_on_until_a_signal_ends_with_its_node(master, capfd):
    script = master.load(str(PROGRAMS / 'own/until_signal.py'))
    until(lambda: '/until_signal/is_ready' in master.parameters)
    script.stop()
    assert script.exit_code == 5
    assert capfd.readouterr().out == 'the last\n'


@pytest.mark.parametrize(
    'how, name',
    [('timer', 'SIGALRM'), ('raise', 'SIGUSR1'), ('kill', 'SIGUSR2'), ('outside', 'SIGUSR1')],
)
def test_a_signal_calls_the_handler_of_a_program(how, name, master):
    with master.load(str(PROGRAMS / 'own/signals.py'), None, how) as script:
        main = script.ros_import('__main__')
        assert main.is_ready.wait(TIMEOUT)
        if how == 'outside':
            os.kill(os.getpid(), signal.SIGUSR1)
        assert main.came.wait(TIMEOUT)
        assert main.names[0] == name
        assert script.is_running


def test_what_a_handler_of_signals_raises_is_a_failure_of_its_node(master, transcript):
    with master.load(str(PROGRAMS / 'own/signals.py'), None, 'fail') as script:
        until(lambda: script.errors)
        assert isinstance(script.errors[0], ZeroDivisionError)
        until(lambda: 'the handler of SIGALRM of /signals' in '\n'.join(transcript))
        assert script.is_running


def test_a_handler_of_signals_that_exits_ends_its_node_alone(node, master):
    script = master.load(str(PROGRAMS / 'own/signals.py'), None, 'exit')
    script.wait(TIMEOUT)
    assert not script.errors
    assert node.is_running


def test_an_alarm_that_a_program_does_not_handle_ends_its_node_alone(node, master):
    script = master.load(str(PROGRAMS / 'own/signals.py'), None, 'unhandled')
    script.wait(TIMEOUT)
    assert 'SIGALRM' in str(script.errors[0])
    assert node.is_running


@pytest.mark.parametrize('how, code', [('interrupt', 0), ('interrupt early', -signal.SIGINT)])
def test_a_program_may_interrupt_itself_alone(how, code, node, master):
    script = master.load(str(PROGRAMS / 'own/signals.py'), None, how)
    assert script.wait(TIMEOUT) == code
    assert node.is_running


@pytest.mark.skipif(sys.version_info < (3, 11), reason='asyncio does not handle SIGINT itself')
def test_the_stop_interrupts_what_asyncio_runs(master):
    done = programs.run(master.url, sys.executable, PROGRAMS / 'stops_a_coroutine.py')
    assert done.stdout == f'in order {-signal.SIGINT}\n', done.stderr


def test_an_alarm_tells_how_much_was_left_of_the_one_before(master):
    with master.load(str(PROGRAMS / 'own/signals.py'), None, 'alarm') as script:
        main = script.ros_import('__main__')
        assert main.is_ready.wait(TIMEOUT)
        assert main.left == (0, 100)


def test_the_main_thread_of_a_program_has_an_event_loop(master):
    master.load(str(PROGRAMS / 'own/event_loop.py')).wait(TIMEOUT)
    assert master.parameters['/event_loop/said'] == 'done'


def test_a_program_that_has_ended_gets_no_signal(node):
    main = run(node, 'own/ends.py')
    main.timer.cancel()
    assert ended(main.timer)
    node.latest_run.rospy.exit_main()
    node.stop()
    assert main.ended == ['last registered', 'first registered']


def test_an_exit_handler_that_raises_or_hangs_is_told_and_the_stop_goes_on(node, transcript):
    library, go_on = node.ros_import('rospy.core'), threading.Event()
    library.atexit.register(go_on.wait)
    library.atexit.register(lambda: 1 / 0)
    node.stop()
    go_on.set()
    assert [type(error) for error in node.errors] == [ZeroDivisionError]
    assert any('/program_node left behind' in line and 'atexit' in line for line in transcript)


def test_the_threads_of_an_executor_end_with_their_node(node, transcript):
    pool = node.ros_import('concurrent.futures').ThreadPoolExecutor(1)
    worker = pool.submit(threading.current_thread).result(TIMEOUT)
    node.stop()
    assert ended(worker)
    assert transcript == []


def test_asyncio_takes_an_executor_of_a_node(node):
    pool = node.ros_import('concurrent.futures').ThreadPoolExecutor(1)

    async def main():
        loop = asyncio.get_running_loop()
        loop.set_default_executor(pool)
        return await loop.run_in_executor(None, threading.current_thread)

    assert asyncio.run(main()).name.startswith('/program_node')


def test_hooks_and_finalizers_of_a_program_run_as_in_a_process(master, tmp_path, monkeypatch):
    monkeypatch.setenv('TMPDIR', str(tmp_path))
    node = master.load(str(PROGRAMS / 'own' / 'hooks.py'))
    assert node.wait(TIMEOUT) == 1
    main = node.latest_run.rospy.import_library('__main__')
    assert main.told == [('worker', 'in vain'), ('main thread', 'in vain'), 'finalized']
    assert pathlib.Path(main.folder.name).parent == tmp_path
    assert list(tmp_path.iterdir()) == []
    assert [str(error) for error in node.errors] == ['in vain']


def test_what_pythons_library_prints_for_a_program_goes_where_that_prints(master, capsys):
    master.load(str(PROGRAMS / 'own' / 'prints.py'), output='screen', name='prints')
    printed = capsys.readouterr()
    assert printed.out == "[/prints] ['shown']\n"
    assert printed.err.splitlines()[-1] == '[/prints] ValueError: in vain'


# -- packages


@pytest.mark.parametrize('imported_first', ['messages', 'code'])
def test_messages_of_a_package_with_code_are_the_same_for_all(master, space, imported_first):
    if imported_first == 'messages':
        importlib.import_module('robot_eyes.msg')
    nodes = [create(master, name) for name in ('/left_eye', '/right_eye')]
    left, right = (each.ros_import('robot_eyes.looking') for each in nodes)
    messages = importlib.import_module('robot_eyes.msg')
    assert left is not right
    for library in left, right:
        assert library.Look is messages.Look
        assert library.Find is importlib.import_module('robot_eyes.srv').Find
        assert isinstance(library.look('red'), messages.Look)
    assert messages.Look().spots == []
    assert left.robot_eyes.SEEN == [('/left_eye', nodes[0].ros.core.sys.argv[0])]


def test_a_message_class_of_a_package_with_code_is_one_also_by_the_name_of_its_module(node, space):
    looking = node.ros_import('robot_eyes.looking')
    for name in 'msg._Look', 'srv._Find':
        assert node.ros_import(f'robot_eyes.{name}') is importlib.import_module(
            f'robot_eyes.{name}'
        )
    own_pickle = node.ros_import('pickle')
    assert isinstance(own_pickle.loads(own_pickle.dumps(looking.Look())), looking.Look)


def test_a_module_of_a_subpackage_finds_its_package(node, space):
    deep = node.ros_import('robot_eyes.nested.deep')
    assert deep.looking is node.ros_import('robot_eyes.looking')
    assert deep.Spot is importlib.import_module('robot_eyes.msg').Spot


def test_a_module_in_a_folder_without_init_is_the_nodes(node, space):
    assert node.ros_import('robot_eyes.plain.deeper').NAME == node.name


def test_a_package_that_reaches_rospy_through_another_one_is_the_nodes(master, space):
    nodes = [create(master, name) for name in ('/left_mind', '/right_mind')]
    left, right = (each.ros_import('robot_mind') for each in nodes)
    assert left is not right
    assert [mind.looking.rospy.get_name() for mind in (left, right)] == [
        '/left_mind',
        '/right_mind',
    ]
    assert left.robot_maths.Vector is right.robot_maths.Vector


def test_a_c_extension_is_shared_also_in_a_package_that_is_the_nodes(master, space):
    nodes = [create(master, name) for name in ('/left_hand', '/right_hand')]
    shutil.copy(termios.__file__, space / 'robot_eyes')
    left, right = (each.ros_import('robot_eyes.termios') for each in nodes)
    assert left is right is importlib.import_module('robot_eyes.termios')
    assert nodes[0].ros_import('numpy') is numpy


# -- threads


@pytest.fixture
def rings(node, tmp_path, monkeypatch):
    """The packages whose modules import each other in a circle."""
    monkeypatch.syspath_prepend(str(build('install', tmp_path)))
    return node


def test_threads_that_import_the_same_get_it_whole(rings):
    started = []
    rings.ros.started = started.append
    both = threading.Barrier(8)

    def get():
        both.wait(TIMEOUT)
        return rings.ros_import('robot_rings.one').two.NAME

    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        names = [each.result(TIMEOUT) for each in [pool.submit(get) for _ in range(8)]]
    assert names == ['two'] * 8
    assert sorted(started) == ['one', 'two']


def test_threads_that_import_in_a_circle_do_not_wait_for_each_other_for_ever(rings):
    both = threading.Barrier(2)
    rings.ros.started = lambda name: both.wait(TIMEOUT)
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        names = ['robot_rings.one', 'robot_rings.two']
        modules = [pool.submit(rings.ros_import, name) for name in names]
        assert [module.result(TIMEOUT).NAME for module in modules] == ['one', 'two']
    assert rings.ros_import('robot_rings.two').one is rings.ros_import('robot_rings.one')
