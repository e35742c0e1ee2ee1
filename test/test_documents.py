"""README.md, the pages of doc/ and the examples: their links, their Python, their commands.

A block is used as its fence says. ``python`` is a program, a test, or a file if its first line names
one. ``console`` is commands, and ``text`` what the block before prints, with ``...`` for anything.
In the tutorial, ``python`` and ``debugger`` are typed into a session, which ``console`` opens.
"""
import contextlib
import re
import shutil
import signal
import subprocess
from typing import NamedTuple
from urllib.parse import unquote

import genpy
import pexpect
import pytest
import rosbag
import std_msgs.msg

import helpers
from helpers import DEFAULT_SIGNALS, PYTHON, ROOT, TIMEOUT
from pharos.testing import until

README, TUTORIAL = ROOT / 'README.md', ROOT / 'doc' / 'tutorial.md'
PAGES = [README, *sorted((ROOT / 'doc').glob('*.md')), *sorted(ROOT.glob('examples/*.md'))]
ROBOT_NODES = 'camera', 'detector', 'planner'
PROPERTY = ROOT / 'examples' / 'test_lift.py'
EXAMPLES = sorted({*(ROOT / 'examples').glob('*.py')} - {PROPERTY})
SHOW_FAILURES = ['supervisor.py']
FENCE = re.compile(r'^```(\w*)\n(.*?)^```$', re.DOTALL | re.MULTILINE)
INDENTED = re.compile(r'^(?: {4}[^\n]*\n)+', re.MULTILINE)
ESCAPES = re.compile(r'\x1b\[[0-9;?]*[A-Za-z]|\x1b[()][A-Z0-9]|\x1b[=>78]|\r')
DEBUGGER_PROMPT = r'ipdb> '


class Block(NamedTuple):
    """A block of code of a page, and where it is."""

    where: str
    kind: str
    text: str


def blocks(page, *kinds):
    """The fenced blocks of a page that are of these kinds, or all."""
    source = page.read_text()
    for found in FENCE.finditer(source):
        line = source.count('\n', 0, found.start()) + 1
        if not kinds or found[1] in kinds:
            yield Block(f'{page.name}:{line}', found[1], found[2])


def name_of(value):
    """Say which page a case is about."""
    return str(value.relative_to(ROOT))


# -- links, and code that is not run


def prose(page):
    """The text of a page without its code."""
    return INDENTED.sub('', FENCE.sub('', page.read_text()))


def anchors(page):
    """The ends of links to the headings of a page, as GitHub makes them."""
    for heading in re.findall(r'^#+ (.*)$', prose(page), re.MULTILINE):
        yield re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-')


def test_links_of_page_exist():
    for page in PAGES:
        dead = []
        for link in re.findall(r'\]\(([^)\s]+)\)', prose(page)):
            path, _, anchor = unquote(link).partition('#')
            target = page.parent / path if path else page
            if re.match(r'\w+:', link):
                continue
            if not target.exists() or anchor and anchor not in anchors(target):
                dead.append(link)
        assert dead == []


def test_python_of_pages_compiles():
    for page in PAGES:
        for block in blocks(page, 'python', 'py'):
            compile(block.text, block.where, 'exec')


def test_programs_of_pages_exist():
    texts = '\n'.join(page.read_text() for page in PAGES)
    named = set(re.findall(r'rosrun pharos ([a-z_]+(?:\.py)?)\b', texts))
    there = {path.name for folder in ('scripts', 'examples') for path in (ROOT / folder).iterdir()}
    assert named - there == set()


# -- numbers of pages that are constants of the code

UNITS = {'us': 1e-6, 'ms': 1e-3, 's': 1, 'KB': 1 << 10, 'MB': 1 << 20, 'GB': 1e9, '': 1}
QUOTED = re.compile(
    r'(\d[\d,.]*)(?: (us|ms|s|KB|MB|GB)\b)?[^()\d]{0,40}\(`?(?:\w+\.)?([a-zA-Z_]+)`?\)'
)
CONSTANT = re.compile(
    r'^ *(?:#: )?([A-Za-z_]+)(?:: \w+)? = ([\d.e_<\- ]+?) *(?:#.*)?$', re.MULTILINE
)


def test_numbers_of_pages_are_those_of_the_code():
    """A number with the name of a constant behind it, such as: 3 ms (`SLOW`)."""
    values = {}
    for path in (ROOT / 'src' / 'pharos').rglob('*.py'):
        for name, value in CONSTANT.findall(path.read_text()):
            values.setdefault(name, []).append(eval(value))
    quoted = []
    for page in [*PAGES, ROOT / 'SECURITY.md']:
        for number, unit, name in QUOTED.findall(' '.join(prose(page).split())):
            assert name in values or not name.isupper(), name
            if name in values:
                value = float(number.replace(',', '')) * UNITS[unit]
                quoted.append(name)
                assert value == pytest.approx(values[name][0]) or value in values[name], name
    assert len(quoted) > 20, quoted


# -- all pages but the tutorial: each block is a program, a test or a command

ROBOT = """#!/usr/bin/python3
import rospy
from std_msgs.msg import String
rospy.init_node('camera')
print('ready')
images = rospy.Publisher('image', String, queue_size=1)
while not rospy.core.is_shutdown_requested():
    images.publish('an image')
    rospy.rostime.wallsleep(0.1)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder of a page's reader, who has the package my_robot and tests with pharos."""
    robot = tmp_path / 'my_robot'
    robot.mkdir()
    manifest = (ROOT / 'test' / 'robot' / 'package.xml').read_text()
    (robot / 'package.xml').write_text(manifest.replace('>robot<', '>my_robot<'))
    nodes = [f'<node name="{name}" pkg="my_robot" type="{name}" />' for name in ROBOT_NODES]
    (robot / 'robot.launch').write_text(f'<launch><arg name="speed" />{"".join(nodes)}</launch>')
    for name in ROBOT_NODES:
        (robot / name).write_text(ROBOT)
        (robot / name).chmod(0o755)
    (tmp_path / 'conftest.py').write_text("pytest_plugins = ['pharos.testing']\n")
    monkeypatch.setenv('ROS_PACKAGE_PATH', str(tmp_path), prepend=':')
    monkeypatch.setenv('ROS_HOME', str(tmp_path / 'home'))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def commands_of(block, folder):
    """Save a block, and yield the commands that run it."""
    saved = re.match(r'# (\w+\.py)\n', block.text)
    if block.kind == 'console':
        yield from (line.partition(' #')[0][2:].split() for line in block.text.splitlines())
    elif saved:
        (folder / saved[1]).write_text(block.text)
    elif re.search(r'^def test_', block.text, re.MULTILINE):
        (folder / 'test_block.py').write_text(block.text)
        yield [PYTHON, '-m', 'pytest', '-q', 'test_block.py']
    else:
        (folder / 'program.py').write_text(block.text)
        yield [PYTHON, 'program.py']


def run(command, master, expected='.'):
    """Run a program until it prints what is expected; end it by Ctrl-C, and return its output."""
    with helpers.Program(command, master.url) as program:
        with contextlib.suppress(TimeoutError):  # what it printed says more
            until(
                lambda: program.poll() is not None or re.search(expected, program.output), TIMEOUT
            )
        if program.poll() is None:
            program.signal(signal.SIGINT)
        assert program.wait() in (0, -signal.SIGINT), program.output  # that is before spin()
        assert re.search(expected, program.output), program.output
        return program.output


@pytest.mark.parametrize('page', [page for page in PAGES if page != TUTORIAL], ids=name_of)
def test_page_does_what_it_says(page, master, folder):
    found = list(blocks(page))
    for block, after in zip(found, [*found[1:], None]):
        expected = pattern_of(after.text) if after and after.kind == 'text' else '.'
        for command in commands_of(block, folder) if block.kind in ('python', 'console') else ():
            run(command, master, expected)


# -- the commit that has changed a robot

ECHO = """#!/usr/bin/python3
import rospy
from std_msgs.msg import Float64
rospy.init_node('camera')
out = rospy.Publisher('out', Float64, queue_size=10)
rospy.Subscriber('in', Float64, lambda message: out.publish(message.data * 2))
rospy.spin()
"""


@pytest.mark.skipif(not shutil.which('git'), reason='there is no git')
def test_recipe_finds_the_commit(folder):
    """The third of six commits does not start, and the fifth changes what the robot does."""
    robot = folder / 'my_robot'
    (robot / 'robot.launch').write_text(
        '<launch><node name="camera" pkg="my_robot" type="camera" /></launch>'
    )
    with rosbag.Bag(str(robot / 'drive.bag'), 'w') as bag:
        bag.write('/in', std_msgs.msg.Float64(1.5), genpy.Time(100))
    page = ROOT / 'doc' / 'time.md'
    (recipe,) = (block.text for block in blocks(page) if block.text.startswith('git checkout'))
    (check,) = (block.text for block in blocks(page) if block.text.startswith('#!/bin/sh'))
    (robot / 'check.sh').write_text(check)
    (robot / 'check.sh').chmod(0o755)
    commit = 'git -c user.name=me -c user.email=me@localhost commit -qam'
    lines = ['git init -qb main', 'git add camera package.xml robot.launch']
    for number in range(7):
        text = ECHO.replace('* 2', '* 4') if number >= 5 else ECHO
        if number == 3:
            text = text.replace('out = ', 'out == ')
        (folder / f'camera{number}').write_text(f'{text}# {number}\n')
        lines.append(f'cp ../camera{number} camera && {commit} number{number}')
    lines.insert(3, 'git tag v1.0')
    recipe = re.sub('bisect run .*', 'bisect run ./check.sh', recipe)
    process = subprocess.run(
        ['bash', '-c', '\n'.join([*lines, recipe])], cwd=robot, stdout=subprocess.PIPE, text=True
    )
    assert '/out #0 data: 3.0 -> 6.0' in process.stdout  # at main
    assert re.search(r'is the first bad commit(\n.*)*number5', process.stdout), process.stdout


# -- the tutorial: a session that is typed


class Session:
    """A session of IPython in a terminal, into which the blocks of a page are typed."""

    def __init__(self, url, folder):
        self._folder = folder
        command = [*DEFAULT_SIGNALS, 'rosrun', 'pharos', 'workspace']
        environ = {
            **dict(TERM='xterm', PROMPT_TOOLKIT_NO_CPR='1', IPYTHONDIR=str(folder / 'ipython')),
            **dict(ROS_MASTER_URI=url, COLUMNS='300'),
        }
        self._process = pexpect.spawn(
            'env',
            [f'{name}={value}' for name, value in environ.items()] + command,
            dimensions=(50, 300),
            encoding='utf-8',
            cwd=folder,
        )
        self._written = ''
        self._cells = 0

    @property
    def answer(self):
        """The text that it has written since the last block was typed."""
        try:
            self._written += self._process.read_nonblocking(1 << 16, 0.02)
        except (pexpect.TIMEOUT, pexpect.EOF):
            pass
        return ESCAPES.sub('', self._written)

    def wait_for(self, pattern, what):
        try:
            until(lambda: re.search(pattern, self.answer, re.MULTILINE), TIMEOUT)
        except TimeoutError:
            pytest.fail(f'{what} is not in the answer:\n{self.answer}', pytrace=False)

    def do(self, block, number):
        """Type a block, or wait for the text that answers the last one."""
        if block.kind == 'text':
            self.wait_for(pattern_of(block.text), f'{block.where}:\n{block.text}')
        elif block.kind == 'debugger':
            self._type(block, DEBUGGER_PROMPT, *block.text.splitlines())
        else:
            path = self._folder / f'block_{number}.py'
            path.write_text(block.text)
            line = f'_typed = get_ipython().run_cell(open({path.name!r}).read())'
            self._cells += 1  # a prompt with another number is that of an earlier cell
            self._type(block, rf'In \[{self._cells}\]: ', line)

    def _type(self, block, prompt, *lines):
        self.wait_for(prompt, f'a prompt for {block.where}')
        self._written = ''
        for line in lines:
            self._process.send(line + '\r')

    def end(self):
        """Wait for its end; returns its exit status."""
        self._process.expect(pexpect.EOF, timeout=TIMEOUT)
        self._process.wait()
        return self._process.exitstatus

    def close(self):
        self._process.close(force=True)


def pattern_of(expected):
    """A pattern of the lines in their order, with others between them, and ``...`` for anything."""
    lines = [line.strip() for line in expected.splitlines() if line.strip() not in ('', '...')]
    return r'(?:.*\n)*?.*'.join(r'.*'.join(map(re.escape, line.split('...'))) for line in lines)


def test_tutorial_does_what_it_says(tmp_path):
    session = Session('http://127.0.0.1:1/', tmp_path)
    try:
        for number, block in enumerate(blocks(TUTORIAL)):
            if block.kind != 'console':  # that is how the session was opened
                session.do(block, number)
        assert session.end() == 0
    finally:
        session.close()


# -- examples


@pytest.mark.parametrize('example', EXAMPLES, ids=lambda path: path.name)
def test_example_starts_and_ends(example, master):
    output = run([PYTHON, str(example)], master)
    output = output.partition('Exception ign')[0]  # Python ignores a Ctrl-C in its exit
    # the log has the node's name before each line of a block's failure
    failures = re.findall(r'^(?:/\S+: )?Traceback', output, re.MULTILINE)
    assert not failures or example.name in SHOW_FAILURES, output


@pytest.mark.parametrize(
    'sleep, result',
    [('self.sleep(0.5)', r"script=\[\('/go', 0\), \('/stop', 0\)\]"), ('pass', '1 passed')],
    ids=['as it is', 'mended'],
)
def test_example_shrinks_what_breaks_a_property(tmp_path, sleep, result):
    """The lift without its sleep has no mistake."""
    path = tmp_path / PROPERTY.name
    path.write_text(PROPERTY.read_text().replace('self.sleep(0.5)', sleep))
    command = [PYTHON, '-m', 'pytest', '-p', 'pharos.testing', path]
    run = subprocess.run(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    assert re.search(result, run.stdout), run.stdout
