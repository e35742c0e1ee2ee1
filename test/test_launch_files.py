"""Launch files as compose reads them: by roslaunch, and which node is to run where."""
import os
import pathlib

import pytest

from pharos import PharosError, UnknownNodeError
from pharos.compose.launch_file import LaunchFile

PROGRAMS = pathlib.Path(__file__).with_name('programs')
MASTER = 'http://127.0.0.1:11311/'


@pytest.fixture(autouse=True)
def packages(monkeypatch):
    """The packages of test/programs are on ROS_PACKAGE_PATH."""
    monkeypatch.setenv('ROS_PACKAGE_PATH', os.pathsep.join([str(PROGRAMS), '/usr/share']))


def read(file='robot.launch', only=(), apart=(), **args):
    if file == 'robot.launch':
        args.setdefault('robot', 'r2')
    return LaunchFile(MASTER, 'composed_robot', file, args, only, apart)


def names_here(file):
    return [node.name for node in file.here]


def names_apart(file):
    return [node.name for node in file.apart]


def test_nodes_of_python_run_here():
    assert names_here(read()) == ['/r2/talker', '/r2/mirror', '/again']


def test_other_programs_prefixed_ones_and_those_that_make_nodes_themselves_run_apart():
    assert names_apart(read()) == ['relay', 'prefixed', 'shell', 'own_nodes']


def test_a_node_runs_apart_where_asked_for():
    assert names_here(read(apart=['mirror'])) == ['/r2/talker', '/again']


def test_only_the_nodes_asked_for_are_there():
    file = read(only=['/r2/talker', 'relay'])
    assert (names_here(file), names_apart(file)) == (['/r2/talker'], ['relay'])


def test_conditions_and_arguments_hold():
    assert names_here(read(with_mirror=False, robot='r3')) == ['/r3/talker', '/again']


def test_a_node_gets_the_arguments_that_roslaunch_would_give_it():
    mirror = read().here[1]
    assert mirror.args == ['one', 'two words', 'r2', 'chatter:=speech', '__name:=mirror']


def test_a_node_gets_the_environment_of_the_file():
    assert read().here[1].env == {'FOR_ALL': 'yes', 'FOR_ONE': '1'}


def test_a_node_has_its_own_folder_or_that_of_ros_as_its_working_directory(monkeypatch):
    monkeypatch.setenv('ROS_HOME', '/home/of/ros')
    talker, mirror, again = read().here
    assert mirror.cwd == str(PROGRAMS / 'composed_robot' / 'scripts')
    assert talker.cwd == '/home/of/ros'


def test_required_and_respawn_are_read():
    talker, mirror, again = read().here
    assert (talker.is_required, talker.respawn_delay) == (True, None)
    assert (again.is_required, again.respawn_delay) == (False, 0.5)


def test_roslaunch_gets_the_rest_without_what_is_done_here():
    rest = read().config_apart()
    assert [node.name for node in rest.nodes] == ['relay', 'prefixed', 'shell', 'own_nodes']
    assert (rest.params, rest.nodes_core) == ({}, [])
    assert rest.master.uri == MASTER


def test_a_file_is_given_by_its_path():
    path = str(PROGRAMS / 'composed_robot' / 'launch' / 'robot.launch')
    file = LaunchFile(MASTER, None, path, {'robot': 'r2'})
    assert names_here(file) == ['/r2/talker', '/r2/mirror', '/again']


@pytest.mark.parametrize(
    'error, match, arguments',
    [
        (UnknownNodeError, "no ROS package 'no_such_package'", ('no_such_package', 'a.launch', {})),
        (UnknownNodeError, "composed_robot has no launch file 'x'", ('composed_robot', 'x', {})),
        (UnknownNodeError, "there is no launch file '/no/such'", (None, '/no/such', {})),
        (
            PharosError,
            'broken.launch.*mismatched tag: line 3',
            ('composed_robot', 'broken.launch', {}),
        ),
        (
            PharosError,
            r'twice.launch.*multiple nodes named \[/same\]',
            ('composed_robot', 'twice.launch', {}),
        ),
        (
            PharosError,
            "robot.launch.*give it with robot:=VALUE",
            ('composed_robot', 'robot.launch', {}),
        ),
        (
            UnknownNodeError,
            r"robot.launch has no arg 'robots' \(did you mean 'robot'\?\)",
            ('composed_robot', 'robot.launch', {'robot': 1, 'robots': 2}),
        ),
        (
            UnknownNodeError,
            "no_such_include.launch needs the ROS package 'no_such_package'",
            ('composed_robot', 'no_such_include.launch', {}),
        ),
    ],
)
def test_a_file_that_cannot_be_read_is_an_error_that_names_it(error, match, arguments):
    with pytest.raises(error, match=f'(?s){match}'):
        LaunchFile(MASTER, *arguments)


@pytest.mark.parametrize(
    'argument, said',
    [
        ({'text': 'yes: 1'}, 'True in / is no text, as a name is: put it in quotes'),
        ({'text': 'deep: {1: 2}'}, '1 in /deep is no text'),
        ({'text': 'a: null'}, '/a cannot be None: the parameter server holds'),
        ({'text': 'a: 2020-01-01'}, r'/a cannot be datetime.date\(2020, 1, 1\): the parameter'),
        ({'text': 'a: 99999999999'}, '/a cannot be 99999999999: the parameter server holds'),
        ({'value': 99999999999}, 'value cannot be 99999999999: the parameter server holds'),
        ({'value': 0}, r'int\(value\)\) raised ZeroDivisionError'),
        ({'text_file': '/no/such'}, "file cannot be read: .* '/no/such'"),
    ],
)
def test_a_parameter_that_cannot_be_set_is_named_with_its_file(argument, said):
    with pytest.raises(PharosError, match=f'(?s)parameters.launch: .*{said}'):
        read('parameters.launch', **argument)


def test_a_file_that_includes_itself_is_told_in_a_few_words():
    with pytest.raises(PharosError, match='circle.launch') as raised:
        read('circle.launch')
    assert len(str(raised.value)) < 1000


@pytest.mark.parametrize('choice', ['only', 'apart'])
def test_a_node_that_is_not_in_the_file_is_an_error_that_names_those_that_are(choice):
    with pytest.raises(UnknownNodeError, match="no node 'talkr'.*it has .*/r2/mirror"):
        read(**{choice: ['talkr']})


def test_a_node_that_cannot_be_found_is_told_and_the_others_are_there():
    file = read('missing.launch')
    assert names_here(file) == ['/talker', '/with_syntax_error']
    assert [problem.name for problem in file.problems] == ['/without_package', '/without_program']
    package, program = map(str, file.problems)
    assert (
        "missing.launch: /without_package is not started: there is no ROS package 'no_such_package'"
        in package
    )
    assert 'Cannot locate node of type [no_such_program] in package [composed_robot]' in program


def test_a_script_whose_interpreter_is_missing_is_told():
    (problem,) = read().problems
    assert problem.name == '/old'
    assert problem.why.endswith('scripts/old names /usr/bin/python2.0, which is not there')


def test_what_the_system_cannot_start_is_told():
    file = read('unstartable.launch')
    assert names_apart(file) == ['relay', 'unknown_kind']
    script, prefixed, quoted = [problem.why for problem in file.problems]
    assert 'scripts/no_first_line does not begin with a line such as #!/usr/bin/python3' in script
    assert prefixed == 'its launch-prefix names no_such_prefix, which is not there'
    assert quoted == """args="'open" or launch-prefix=None: No closing quotation"""


def test_nodes_of_other_machines_run_there_and_tests_not_at_all():
    file = read('machines.launch')
    assert (names_here(file), names_apart(file), file.problems) == (['/here'], ['there'], [])
