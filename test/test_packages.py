"""Packages of users that are built on this one: by catkin, in the devel and the install space, on the
devel and the install space of this one."""
import os
import re
import shutil
import signal
import subprocess
import xml.etree.ElementTree

import pytest

from pharos import PharosError
from pharos.testing import Mailbox, TIMEOUT, until
from helpers import create
from programs import ROOT, Program, environment, forget_parameters

PATROL = ROOT / 'test' / 'packages' / 'patrol'
NODES = 'camera', 'controller'
LIMIT = 250  # seconds for a build
BUILD = {
    'catkin_make': 'catkin_make --no-color -DPYTHON_EXECUTABLE=/usr/bin/python3 install',
    'catkin_make_isolated': 'catkin_make_isolated --no-color --install'
    ' -DPYTHON_EXECUTABLE=/usr/bin/python3',
}
#: the space of this package on which each builds: between them they have all there is
BENEATH = {'catkin_make': 'devel', 'catkin_make_isolated': 'install'}
SPACES = {
    'devel': 'catkin_make',
    'install': 'catkin_make',
    'devel_isolated': 'catkin_make_isolated',
    'install_isolated': 'catkin_make_isolated',
}

pytestmark = pytest.mark.skipif(
    not (shutil.which('catkin_make') and shutil.which('rosrun')), reason='needs catkin and rosbash'
)


class Workspace:
    """A catkin workspace, beside that of this package, with the package patrol and one that
    create_package has made."""

    def __init__(self, path, command):
        self.path = path
        self.beneath = BENEATH[command]
        (path / 'src').mkdir()
        shutil.copytree(PATROL, path / 'src' / 'patrol')
        nodes = ' '.join(NODES)
        self.shell(
            f'rosrun pharos create_package my_robot --directory src --node {nodes}',
            BUILD[command],
        )

    def words(self, *lines, setup=None):
        """A command: a shell with the environment of a user who has sourced the setup file."""
        setup = setup or f'$ws/{self.beneath}/setup.bash'
        script = [
            'set -e',
            f'source {ROOT}/tools/workspace.sh',
            'build_workspace install',  # is done already, but where this test runs by itself
            f'source "{setup}"',
            f'cd {self.path}',
            *lines,
        ]
        return 'bash', '-c', '\n'.join(script)

    def shell(self, *lines, setup=None):
        """Run lines of bash; returns what they printed."""
        ended = subprocess.run(
            self.words(*lines, setup=setup),
            env=environment(''),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=LIMIT,
            check=False,
        )
        assert ended.returncode == 0, ended.stdout
        return ended.stdout

    def in_space(self, space, *lines):
        """Run lines of bash where that space is in use; returns what they printed."""
        return self.shell(*lines, setup=self.path / space / 'setup.bash')

    def launch(self, master, space, *arguments):
        """roslaunch, as a program that goes on running."""
        variables = f'export ROS_MASTER_URI={master.url} ROS_LOG_DIR={os.environ["ROS_LOG_DIR"]}'
        command = ' '.join(['exec roslaunch --screen', *arguments])
        setup = self.path / space / 'setup.bash'
        return Program(master.url, *self.words(variables, command, setup=setup))


@pytest.fixture(scope='session')
def workspace(tmp_path_factory):
    """The workspace that was built by that command, once for all tests."""
    built = {}

    def of(command):
        if command not in built:
            built[command] = Workspace(tmp_path_factory.mktemp(command), command)
        return built[command]

    return of


@pytest.fixture(autouse=True)
def own_parameters(ros_master):
    """Those that roslaunch or a node sets outlive it on the master, which other files have, too."""
    forget_parameters(ros_master.url)
    yield
    forget_parameters(ros_master.url)


def pid_of(master, name):
    """Of the process of a node; None where it is not there."""
    try:
        return master.node(name).pid
    except (PharosError, OSError):
        return None


# -- a package with all that others have


@pytest.mark.parametrize('space', SPACES)
def test_it_is_launched_respawned_and_ended(master, workspace, space):
    """Namespaces, groups, remappings, parameters, two nodes of one process, one of them rospy's,
    respawn, required."""
    ear = create(master, '/ear')
    hall = Mailbox(ear, '/hall/position', 'std_msgs/Float64')
    yard = Mailbox(ear, '/yard/whereabouts', 'std_msgs/Float64')
    tower = Mailbox(ear, '/tower/seen', 'std_msgs/Float64')
    built = workspace(SPACES[space])
    with built.launch(master, space, 'patrol patrol.launch length:=1.0') as launched:
        for end in 1.0, 0.0:  # the guard of the same process has another length than the yard's
            hall.wait_for(lambda message, end=end: message.data == end)
        yard.wait_for(lambda message: message.data == 2.0)
        assert {message.data % 0.25 for message in yard.all()} == {0}
        names = {node.name for node in master.nodes()}
        assert {'/hall/walker', '/hall/guard', '/yard/walker', '/yard/guard', '/shift'} <= names
        assert master.parameters['/hall/guard/length'] == 1.0
        tower.wait_for(lambda message: message.data == 0.5)
        assert pid_of(master, '/tower/lookout') == pid_of(master, '/tower/walker')
        assert pid_of(master, '/hall/walker') == pid_of(master, '/hall/guard')

        killed = pid_of(master, '/yard/walker')
        os.kill(killed, signal.SIGKILL)
        until(lambda: pid_of(master, '/yard/walker') not in (None, killed))
        yard.wait_for(lambda message: message.data == 0.0)  # it is new, and begins anew
        yard.wait_for(lambda message: message.data == 2.0)  # and its guard has found it

        ear.send_to('/relieved', typed_as='std_msgs/Empty')
        printed = launched.read_to_the_end()
        assert 'the shift is over' in printed
        assert 'REQUIRED process [shift' in printed
        assert 'Traceback' not in printed
    until(lambda: [node.name for node in master.nodes()] == ['/ear'])


@pytest.mark.parametrize('space', SPACES)
def test_its_code_and_this_packages_are_those_of_the_spaces_in_use(workspace, space):
    built = workspace(SPACES[space])
    own, ours = built.in_space(
        space,
        'python3 -c "import patrol.walker, pharos.node as node; '
        'print(patrol.walker.__file__); print(node.__file__)"',
    ).split()
    is_installed = space.startswith('install')
    assert own.startswith(str(built.path / (space if is_installed else 'src')))
    assert ('/.ws/install/' in ours) == (built.beneath == 'install')


def test_catkin_runs_its_tests_and_its_rostest(workspace):
    """pytest with pharos.testing; and a rostest whose test is a rospy node that has nodes of this
    package beside itself."""
    built = workspace('catkin_make')
    built.shell('catkin_make --no-color run_tests')
    assert ', 0 errors, 0 failures' in built.shell('catkin_test_results build/test_results')
    results = built.path / 'build' / 'test_results'
    expected = {'my_robot/pytest.xml': 2, 'patrol/pytest.xml': 2}
    if 'patrol/rosunit-beside.xml' in found_in(results):  # not without librostest-dev
        expected['patrol/rosunit-beside.xml'] = 2
    assert {file: passed(results / file) for file in expected} == expected


def found_in(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob('*.xml')}


def passed(path):
    """How many tests that file says have passed."""
    cases = list(xml.etree.ElementTree.parse(path).iter('testcase'))
    return sum(not case.findall('*') for case in cases)


@pytest.mark.skipif(not shutil.which('catkin_lint'), reason='needs catkin_lint')
def test_catkin_lint_has_nothing_to_say_to_it():
    ended = subprocess.run(
        ['catkin_lint', '-W2', '--strict', '--offline', str(PATROL)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert 'checked 1 packages and found 0 problems' in ended.stdout, ended.stdout


# -- a package that create_package has made


def has_heard_three(message):
    """Whether a node says that it has heard as many messages, or more of them by then."""
    return int(message.data.split()[-1]) >= 3


@pytest.mark.parametrize('space', ['devel', 'install', 'install_isolated'])
def test_a_created_package_is_launched(master, workspace, space):
    ear = create(master, '/ear')
    said = Mailbox(ear, '/controller/output', 'std_msgs/String')
    built = workspace(SPACES[space])
    with built.launch(master, space, 'my_robot my_robot.launch period:=0.1') as launched:
        # the last node hears what the first one says
        said.wait_for(has_heard_three)
        printed = launched.wait_for("heard 'heard 0'")
        assert launched.end() == 0, printed
    until(lambda: [node.name for node in master.nodes()] == ['/ear'])


def test_all_nodes_of_a_created_package_run_in_one_process(master, workspace):
    ear = create(master, '/ear')
    said = Mailbox(ear, '/controller/output', 'std_msgs/String')
    built = workspace('catkin_make')
    command = f'export ROS_MASTER_URI={master.url}\nexec rosrun my_robot all_in_one _period:=0.1'
    setup = built.path / 'install' / 'setup.bash'
    with Program(master.url, *built.words(command, setup=setup)) as program:
        said.wait_for(has_heard_three)
        assert pid_of(master, '/camera') == pid_of(master, '/controller')
        assert program.end() == 0


def test_the_page_about_packages_names_both_nodes_of_a_process(master, workspace, tmp_path):
    """And gives each its parameter; what it says of args holds, too."""
    page = (ROOT / 'doc' / 'packages.md').read_text()
    (block,) = re.findall('^```xml\n(.*?)^```$', page, re.DOTALL | re.MULTILINE)
    (args,) = re.findall('`(args="[^`]*")`', page)
    other = re.sub(' output="screen"', f' {args}', block).replace('robot1', 'robot2')
    file = tmp_path / 'page.launch'
    file.write_text(f'<launch>{block}{other}</launch>')
    ear = create(master, '/ear')
    said = Mailbox(ear, '/said', 'std_msgs/String')
    with workspace('catkin_make').launch(master, 'devel', str(file)):
        said.wait_for(has_heard_three)
        for name in '/robot1/camera', '/robot1/controller', '/robot2/camera', '/robot2/pilot':
            master.wait_for_node(name, TIMEOUT)
        # rospy sets what is in args after it has registered the node
        until(lambda: '/robot2/pilot/period' in master.parameters)
    periods = {name: value for name, value in master.parameters.items() if 'period' in name}
    assert periods == {
        '/robot1/camera/period': 0.1,
        '/robot1/controller/period': 0.5,
        '/robot2/camera/period': 0.1,
        '/robot2/controller/period': 0.5,  # that of the launch file
        '/robot2/pilot/period': 0.5,
    }


# -- at the prompt


@pytest.mark.parametrize(
    'words, completed', [('pharos create_', 'create_package'), ('my_robot all', 'all_in_one')]
)
def test_rosrun_completes_what_there_is(workspace, words, completed):
    """With rosbash's own function, as bash calls it when Tab is pressed; it looks into no hidden
    folder, in which the workspace of this package is."""
    completions = workspace('catkin_make').in_space(
        'devel',
        'source /usr/share/bash-completion/completions/rosbash',
        f'export ROS_PACKAGE_PATH={ROOT}:$ROS_PACKAGE_PATH',
        f'COMP_WORDS=(rosrun {words}) COMP_CWORD=2',
        'set +e; _roscomplete_exe; echo "completes: ${COMPREPLY[*]}"',
    )
    found = re.search('^completes: (.*)$', completions, re.MULTILINE)
    assert found and set(found[1].split()) == {completed}, completions
