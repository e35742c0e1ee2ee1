"""rosrun pharos create_package: what it makes is in order, and what cannot be is refused."""
import ast
import importlib
import importlib.util
import keyword
import os
import queue
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree

import pytest
from catkin_pkg.package import parse_package_string
from hypothesis import HealthCheck, given, settings, strategies as st

from helpers import create
from pharos import PharosError
from pharos.new_package import creation
from pharos.new_package.creation import NAME, create_package
from pharos.new_package.files import Package, files_of
from pharos.testing import TIMEOUT, until
from programs import ROOT, script

SCRIPT = script('create_package')
NODES = ['camera', 'line_follower']
LICENSE = 'BSD-3-Clause'


def run(*command, cwd, **variables):
    """Run a program there to its end; returns its status and all that it printed."""
    environ = {**os.environ, 'PYTHONPATH': str(ROOT / 'src'), **variables}
    environ.pop('PYTEST_ADDOPTS', None)
    ended = subprocess.run(
        command,
        cwd=cwd,
        env=environ,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=6 * TIMEOUT,  # mypy reads all that the package imports
        check=False,
    )
    return ended.returncode, ended.stdout


def python(module, *arguments, cwd):
    """Run a module of Python on a package, as its maker would; returns what that complains of."""
    if not importlib.util.find_spec(module):
        pytest.skip(f'needs {module}')
    path = os.pathsep.join([str(ROOT / 'src'), str(cwd / 'src')])
    status, printed = run(sys.executable, '-m', module, *arguments, cwd=cwd, MYPYPATH=path)
    return printed if status else ''


@pytest.fixture
def source(tmp_path):
    """The src of a workspace in which there is nothing yet."""
    folder = tmp_path / 'ws' / 'src'
    folder.mkdir(parents=True)
    return folder


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """A package with two nodes, and what was said when it was made."""
    source = tmp_path_factory.mktemp('made') / 'ws' / 'src'
    source.mkdir(parents=True)
    status, printed = run(SCRIPT, 'my_robot', '--node', *NODES, cwd=source)
    assert status == 0, printed
    return source / 'my_robot', printed


def programs_of(package):
    return sorted(str(path) for path in (package / 'scripts').iterdir())


# -- what it makes


def test_it_says_what_it_has_made_and_what_to_do_next(made):
    package, printed = made
    files = {str(path.relative_to(package)) for path in package.rglob('*') if path.is_file()}
    for file in 'package.xml', 'launch/my_robot.launch', 'scripts/camera', 'test/test_camera.py':
        assert file in files
        assert f'  {file}\n' in printed
    make = 'catkin_make -DPYTHON_EXECUTABLE=/usr/bin/python3'
    assert f'  cd {package.parent.parent}\n  {make} && source devel/setup.bash\n' in printed
    assert f'    {make}\n' in (package / 'README.md').read_text()
    assert '  roslaunch my_robot my_robot.launch\n' in printed


def test_its_tests_pass_in_the_clone_with_nothing_built(made):
    package, _ = made
    status, printed = run(sys.executable, '-m', 'pytest', '-q', 'test', cwd=package)
    assert status == 0, printed
    assert re.search('^2 passed in ', printed, re.MULTILINE), printed  # and no warnings


def test_a_test_may_be_added_to_its_own_that_is_written_as_that_of_the_readme(made, tmp_path):
    package = shutil.copytree(made[0], tmp_path / 'my_robot')
    (block,) = re.findall(
        '```python\n(def test_.*?)```', (ROOT / 'README.md').read_text(), re.DOTALL
    )
    test = package / 'test' / 'test_readme.py'
    test.write_text(f'from pharos import BlockNode\n\n\n{block}')
    status, printed = run(sys.executable, '-m', 'pytest', '-q', test, cwd=package)
    assert status == 0, printed


def test_its_node_follows_its_parameter(made, master, monkeypatch):
    package, _ = made
    monkeypatch.syspath_prepend(package / 'src')
    camera = importlib.import_module('my_robot.camera')
    slept = queue.SimpleQueue()

    class Camera(camera.Camera):
        def sleep(self, seconds):
            slept.put(seconds)
            super().sleep(0.001)

    create(master, '/camera', Camera)
    assert slept.get(timeout=TIMEOUT) == 1.0
    master.parameters['/camera/period'] = 7
    until(lambda: slept.get(timeout=TIMEOUT) == 7)


@pytest.mark.parametrize('program', [*NODES, 'all_in_one'])
def test_its_programs_say_what_they_are_for_and_what_is_wrong(made, program):
    package, _ = made
    path = os.pathsep.join([str(ROOT / 'src'), str(package / 'src')])
    variables = {'PYTHONPATH': path, 'ROS_MASTER_URI': 'http://127.0.0.1:1/'}
    status, printed = run(package / 'scripts' / program, '--help', cwd=package, **variables)
    assert status == 0
    assert re.match('Runs .* until Ctrl-C', printed)
    status, printed = run(package / 'scripts' / program, cwd=package, **variables)
    assert status == 1
    assert re.fullmatch(f'{program}: .*127.0.0.1:1.*\n', printed)


def test_black_flake8_and_mypy_have_nothing_to_say(made):
    package, _ = made
    black = '--check', '-q', '-l', '100', '-S', '-t', 'py38'
    assert not python('black', *black, '.', *programs_of(package), cwd=package)
    assert not python('flake8', '--max-line-length=100', '.', *programs_of(package), cwd=package)
    mypy = '--strict', '--ignore-missing-imports', '--scripts-are-modules', '--no-error-summary'
    cache = f'--cache-dir={package.parent.parent}/mypy'
    assert not python('mypy', *mypy, cache, 'src', 'test', *programs_of(package), cwd=package)


@pytest.mark.skipif(not shutil.which('catkin_lint'), reason='needs catkin_lint')
def test_catkin_lint_has_nothing_to_say(made):
    package, _ = made
    options = '-W2', '--strict', '--offline', '--quiet'
    status, printed = run('catkin_lint', *options, '.', cwd=package)
    assert (status, printed) == (0, '')


def test_without_a_node_it_has_one_that_is_called_like_the_package(source):
    status, printed = run(SCRIPT, 'rover', cwd=source)
    assert status == 0, printed
    assert programs_of(source / 'rover') == [str(source / 'rover' / 'scripts' / 'rover_node')]


def test_it_goes_where_it_is_told_to(source, tmp_path):
    status, printed = run(SCRIPT, 'rover', '--directory', source, cwd=tmp_path)
    assert status == 0, printed
    assert (source / 'rover' / 'package.xml').is_file()


def test_it_says_how_to_get_a_package_into_a_workspace_that_is_in_none(tmp_path):
    status, printed = run(SCRIPT, 'rover', cwd=tmp_path)
    assert status == 0, printed
    assert f'{tmp_path} is not the src of a catkin workspace' in printed
    assert f'mv {tmp_path}/rover ~/catkin_ws/src/' in printed


def test_help_says_what_it_is_for_and_how_it_is_called(tmp_path):
    status, printed = run(SCRIPT, '--help', cwd=tmp_path)
    assert status == 0
    assert 'rosrun pharos create_package my_robot --node camera controller' in printed
    assert 'two letters or more' in ' '.join(printed.split())


# -- who maintains it


def maintainer(source, tmp_path, name, email):
    """``(name, address)`` in the package.xml of a user with that in git's configuration, and what
    was said."""
    config = tmp_path / 'gitconfig'
    for key, value in ('name', name), ('email', email):
        subprocess.run(['git', 'config', '--file', config, f'user.{key}', value], check=True)
    variables = {'GIT_CONFIG_GLOBAL': str(config), 'GIT_CONFIG_NOSYSTEM': '1', 'LOGNAME': 'ada'}
    status, printed = run(SCRIPT, 'rover', cwd=source, **variables)
    assert status == 0, printed
    package = parse_package_string((source / 'rover' / 'package.xml').read_text(encoding='utf-8'))
    (person,) = package.maintainers
    return person.name, person.email, printed


needs_git = pytest.mark.skipif(not shutil.which('git'), reason='needs git')


@needs_git
def test_the_maintainer_is_the_one_that_git_knows(source, tmp_path):
    known = 'Ada <"Countess"> & Björn', 'ada@engines.example.org'
    name, email, printed = maintainer(source, tmp_path, *known)
    assert (name, email) == known
    assert 'Who maintains it' not in printed


@needs_git
@pytest.mark.parametrize('email', ['', 'ada@localhost', 'ada'])
def test_an_address_that_catkin_refuses_is_not_written_and_that_is_said(source, tmp_path, email):
    name, email, printed = maintainer(source, tmp_path, 'Ada', email)
    assert (name, email) == ('Ada', 'ada@users.noreply.example.org')
    assert 'write yours into package.xml' in printed


# -- what is refused


@pytest.mark.parametrize(
    'name, text',
    [
        ('My-Robot', r"did you mean 'my_robot'\?"),
        ('myRobot', r"did you mean 'my_robot'\?"),
        ('my__robot', r"did you mean 'my_robot'\?"),
        ('9', 'begins with a small letter'),
        ('', 'begins with a small letter'),
        ('é', 'begins with a small letter'),
        ('robot\n', 'begins with a small letter'),
        ('../robot', r"did you mean 'robot'\?"),
        ('x', 'two letters or more'),
        ('class', 'a word of Python'),
        ('json', 'would hide that module of Python|would hide .*json'),
        ('os', 'would hide that module of Python|would hide .*os'),
        ('sys', 'would hide that module of Python'),
        ('pharos', r'would hide .*pharos.*__init__\.py'),
        ('rospy', r'would hide .*rospy.*__init__\.py'),
    ],
)
def test_what_cannot_be_the_name_of_a_package_is_refused(source, name, text):
    with pytest.raises(ValueError, match=text):
        create_package(name, [], source, LICENSE)
    assert list(source.iterdir()) == []


@pytest.mark.parametrize(
    'nodes, text',
    [
        (['Camera'], r"node \(did you mean 'camera'\?\)"),
        (['a/b'], r"did you mean 'a_b'\?"),
        (['import'], 'a word of Python'),
        (['none'], 'its class would be None'),
        (['keyboard_interrupt'], 'its class would be KeyboardInterrupt'),
        (['one', 'two', 'one'], "'one' and 'one' would both be the class One"),
        (['arm_1', 'arm1'], "'arm_1' and 'arm1' would both be the class Arm1"),
        (['all_in_one', 'other'], 'is the program that runs all nodes'),
    ],
)
def test_what_cannot_be_the_name_of_a_node_is_refused(source, nodes, text):
    with pytest.raises(ValueError, match=text):
        create_package('rover', nodes, source, LICENSE)
    assert list(source.iterdir()) == []


def test_the_name_of_a_package_on_the_path_is_refused(source, tmp_path, monkeypatch):
    other = tmp_path / 'other' / 'rover'
    other.mkdir(parents=True)
    (other / 'package.xml').write_text('<package><name>rover</name></package>')
    monkeypatch.setenv('ROS_PACKAGE_PATH', str(other))
    with pytest.raises(ValueError, match=f'would hide {other}'):
        create_package('rover', [], source, LICENSE)


def test_what_is_left_of_a_package_that_was_removed_hinders_nobody(source, monkeypatch):
    built = source.parent / 'devel' / 'lib' / 'rover_that_was'
    built.mkdir(parents=True)
    (built / '__init__.py').write_text('')
    monkeypatch.syspath_prepend(str(built.parent))
    create_package('rover_that_was', [], source, LICENSE)


def test_a_folder_that_is_there_is_kept_and_told_in_a_line(source):
    (source / 'rover').mkdir()
    (source / 'rover' / 'mine').write_text('mine')
    status, printed = run(SCRIPT, 'rover', cwd=source)
    assert status == 1
    assert printed == (
        f'create_package: {source}/rover is there already: choose another name, or another'
        ' --directory\n'
    )
    assert (source / 'rover' / 'mine').read_text() == 'mine'


def test_a_package_is_not_made_where_catkin_would_not_find_it(source):
    create_package('rover', [], source, LICENSE)
    with pytest.raises(PharosError, match=f'{source}/rover is a package'):
        create_package('other', [], source / 'rover' / 'src', LICENSE)


def test_a_folder_that_is_missing_is_not_made(source):
    with pytest.raises(PharosError, match='there is no folder .*/stack: make it, by mkdir -p'):
        create_package('rover', [], source / 'stack', LICENSE)


def test_a_file_in_the_place_of_a_folder_is_told(source):
    (source / 'notes').write_text('mine')
    with pytest.raises(PharosError, match='/notes is a file: give a folder as --directory'):
        create_package('rover', [], source / 'notes', LICENSE)


def test_what_cannot_be_written_leaves_nothing(source):
    with pytest.raises(PharosError, match='cannot be written to .*/rover: .*File name too long'):
        create_package('rover', ['n' * 300], source, LICENSE)
    assert list(source.iterdir()) == []


def test_what_ctrl_c_cuts_off_leaves_nothing(source, monkeypatch):
    write = creation._write

    def write_some(path, text, is_program):
        write(path, text, is_program)
        if path.name == 'package.xml':
            raise KeyboardInterrupt

    monkeypatch.setattr(creation, '_write', write_some)
    with pytest.raises(KeyboardInterrupt):
        create_package('rover', [], source, LICENSE)
    assert list(source.iterdir()) == []


def test_what_another_program_makes_meanwhile_stays(source, monkeypatch):
    def check_before_it_is_made(path):
        path.mkdir()
        (path / 'theirs').touch()

    monkeypatch.setattr(creation, '_check_folder', check_before_it_is_made)
    with pytest.raises(PharosError, match='cannot be written to .*/rover: .*File exists'):
        create_package('rover', [], source, LICENSE)
    assert [each.name for each in (source / 'rover').iterdir()] == ['theirs']


# -- any names

names = st.from_regex(r'[a-z][a-z0-9]{0,5}(_[a-z0-9]{1,5}){0,2}', fullmatch=True).filter(
    lambda name: not keyword.iskeyword(name)
)
texts = st.text().map(lambda text: ''.join(filter(str.isprintable, text)))


@settings(max_examples=50, deadline=None, suppress_health_check=list(HealthCheck), database=None)
@given(names, st.lists(names, min_size=1, max_size=3, unique=True), texts, texts)
def test_whatever_the_names_the_files_can_be_read(name, nodes, author, license_name):
    files = files_of(Package(name, nodes, author, 'ada@example.org', license_name))
    assert NAME.fullmatch(name)
    for path, text in files.items():
        if path.endswith('.py') or path.startswith('scripts/'):
            ast.parse(text)
    manifest = xml.etree.ElementTree.fromstring(files['package.xml'])
    assert manifest.findtext('name') == name
    assert manifest.findtext('author') == author
    assert manifest.findtext('license') == license_name
    launched = xml.etree.ElementTree.fromstring(files[f'launch/{name}.launch']).iter('node')
    assert [node.get('type') for node in launched] == nodes
    listed = [line.strip() for line in files['CMakeLists.txt'].splitlines()]
    assert all(f'scripts/{node}' in listed for node in nodes)


def test_nothing_stands_for_something_else_any_more():
    for text in files_of(Package('rover', NODES, 'Ada', 'ada', LICENSE)).values():
        assert '@' not in text
