"""What others install: the wheel, Debian's package, and the versions and dependencies that these have."""
import importlib.util
import pathlib
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree
import zipfile

import catkin_pkg.changelog
import pytest

import pharos
from pharos.__main__ import COMMANDS, main
from pharos.testing import TIMEOUT
from programs import ROOT, environment

MANIFEST = xml.etree.ElementTree.parse(ROOT / 'package.xml').getroot()
#: what setup.py reads, beside the modules
READ_BY_SETUP = 'package.xml', 'setup.py', 'setup.cfg', 'pyproject.toml', 'MANIFEST.in', 'LICENSE'


@pytest.fixture(scope='module')
def wheel(tmp_path_factory):
    """The path of a wheel, built of a copy, in which nothing else is; and without the network."""
    if not importlib.util.find_spec('pip'):  # not imported: it gets into setuptools' way
        pytest.skip('no python3-pip here')
    source, target = tmp_path_factory.mktemp('source'), tmp_path_factory.mktemp('wheel')
    shutil.copytree(ROOT / 'src', source / 'src', ignore=shutil.ignore_patterns('__pycache__'))
    for name in READ_BY_SETUP:
        shutil.copy(ROOT / name, source)
    options = '--no-index', '--no-build-isolation', '--no-deps', '--wheel-dir'
    run(sys.executable, '-m', 'pip', 'wheel', *options, target, source)
    (path,) = target.iterdir()
    return path


@pytest.fixture(scope='module')
def venv(wheel, tmp_path_factory):
    """The folder of a virtual environment with the wheel and Debian's packages, such as rospy."""
    folder = tmp_path_factory.mktemp('venv')
    run(sys.executable, '-m', 'venv', '--system-site-packages', '--without-pip', folder)
    python = folder / 'bin' / 'python3'
    run(sys.executable, '-m', 'pip', '--python', python, 'install', '--no-index', wheel)
    return folder


def run(*command, master_url='http://127.0.0.1:1/'):
    """Run a program that does not find the clone's modules; returns what it printed, once it has
    ended well."""
    ended = subprocess.run(
        list(map(str, command)),
        cwd='/',
        env=environment(master_url, PYTHONPATH='', PYTHONNOUSERSITE='1'),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        timeout=4 * TIMEOUT,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


# -- the wheel


def test_the_wheel_has_all_modules_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if '.dist-info/' not in name}
    sources = [*(ROOT / 'src').rglob('*.py'), ROOT / 'src' / 'pharos' / 'py.typed']
    assert names == {str(path.relative_to(ROOT / 'src')) for path in sources}


def test_the_wheel_has_the_version_of_the_manifest(wheel):
    assert wheel.name == f'pharos-{MANIFEST.findtext("version")}-py3-none-any.whl'


def test_the_wheel_is_imported_from_where_it_was_installed(venv):
    where = run(venv / 'bin' / 'python3', '-c', 'import pharos; print(pharos.__file__)')
    assert venv in pathlib.Path(where).parents


@pytest.mark.parametrize('program', [['pharos'], ['python3', '-m', 'pharos']])
def test_the_wheel_s_command_shows_the_live_graph(program, venv, master):
    with master.create(pharos.BlockNode, named='/seen_by_command'):
        command = venv / 'bin' / program[0], *program[1:]
        assert '/seen_by_command' in run(*command, 'graph', master_url=master.url)
        tables = run(*command, 'top', '--json', '--interval', '0.1', master_url=master.url)
        assert '"/seen_by_command"' in tables


# -- the command


@pytest.mark.parametrize('command', COMMANDS)
def test_each_command_tells_its_own_arguments(command, capsys, monkeypatch):
    monkeypatch.setattr(sys, 'argv', ['pharos', command, '--help'])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    module = importlib.import_module(f'pharos.commands.{command}')
    said = capsys.readouterr().out
    assert said.startswith(f'usage: pharos {command} ')
    assert module.__doc__ in said


def test_every_command_has_a_script_and_a_line_of_help(capsys, monkeypatch):
    modules = {path.stem for path in (ROOT / 'src' / 'pharos' / 'commands').glob('[!_]*.py')}
    assert modules == set(COMMANDS) <= {path.name for path in (ROOT / 'scripts').iterdir()}
    monkeypatch.setattr(sys, 'argv', ['pharos'])
    with pytest.raises(SystemExit):
        main()
    said = capsys.readouterr().out
    assert re.findall(r'^  ([a-z_]+)  ', said, re.MULTILINE) == list(COMMANDS)


def test_a_command_passes_on_how_it_has_ended(capsys, monkeypatch):
    monkeypatch.setenv('ROS_MASTER_URI', 'http://127.0.0.1:1/')
    monkeypatch.setattr(sys, 'argv', ['pharos', 'graph'])
    assert main() == 1
    assert re.fullmatch('graph: no ROS master answers at .*\n', capsys.readouterr().err)


def test_a_command_that_is_none_is_told_with_those_there_are(capsys, monkeypatch):
    monkeypatch.setattr(sys, 'argv', ['pharos', 'tob'])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert "invalid choice: 'tob' (choose from " in capsys.readouterr().err


# -- Debian's package

CONTROL = (ROOT / 'debian' / 'control').read_text()
#: the package in Debian of each key of package.xml that is not called after it
IN_DEBIAN = {'graphviz': 'graphviz', 'ipython3': 'python3-ipython'}


def in_debian(key):
    """The package in Debian of a key of package.xml."""
    by_rule = key if key.startswith('python3-') else 'python3-' + key.replace('_', '-')
    return IN_DEBIAN.get(key, by_rule)


def relation(field):
    """The packages that debian/control names there, but for what debhelper fills in."""
    found = re.search(rf'^{field}:\n((?: .*\n)+)', CONTROL, re.MULTILINE)
    names = [line.strip(' ,').partition(' ')[0] for line in found.group(1).splitlines()]
    assert names == sorted(names, key=lambda name: (name[0] != '$', name))
    return {name for name in names if not name.startswith('$')}


def test_debians_package_needs_what_the_manifest_says():
    needed = {in_debian(element.text) for element in MANIFEST.iter('exec_depend')}
    # rosbash has rosrun, which a catkin package has no need to name
    assert relation('Depends') | relation('Recommends') == needed | {'rosbash'}
    assert relation('Depends') & relation('Recommends') == set()


def test_debians_package_comes_with_all_that_importing_pharos_loads():
    source = 'import sys, pharos; print(*{name.partition(".")[0] for name in sys.modules})'
    loaded = {in_debian(name) for name in run_here(sys.executable, '-c', source).stdout.split()}
    # numpy is loaded by genpy, where it is there
    assert relation('Recommends') & loaded <= {'python3-numpy'}


def test_the_manual_page_names_every_command():
    page = (ROOT / 'debian' / 'pharos.1').read_text()
    found = re.findall(r'^\.TP\n\.B ([a-z_]+)\n(.*)', page, re.MULTILINE)
    assert dict(found) == COMMANDS


def run_here(*command):
    """Run a program with the modules of the clone; returns what it printed and its status."""
    return subprocess.run(
        command,
        env=environment('http://127.0.0.1:1/'),
        stdout=subprocess.PIPE,
        text=True,
        timeout=2 * TIMEOUT,
        check=True,
    )


# -- versions


def test_the_version_is_the_same_everywhere():
    debians = re.match(r'pharos \((\S+)\) ', (ROOT / 'debian' / 'changelog').read_text())
    assert pharos.__version__ == MANIFEST.findtext('version') == debians.group(1)


def test_the_changelog_tells_of_this_version_with_its_date_and_then_of_those_before():
    changelog = catkin_pkg.changelog.get_changelog_from_path(str(ROOT), 'pharos')
    released = [version for version, _, _ in changelog.foreach_version(reverse=True)]
    assert released == sorted(released, key=lambda text: [*map(int, text.split('.'))], reverse=True)
    assert released[0] == pharos.__version__
    dates = [changelog.get_date_of_version(version) for version in released]
    assert dates == sorted(dates, reverse=True)
