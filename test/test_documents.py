"""README.md, the pages of doc/ and the examples: their links, their Python, their commands.

Nothing here knows the words of a page. A block is used as its fence says: ``python`` runs as a
program or in a session, ``text`` is what the block before prints, with ``...`` for anything,
``debugger`` is typed at the debugger's prompt, and ``console`` opens the session.
"""
import re
import signal
import subprocess
import sys
from typing import NamedTuple
from urllib.parse import unquote

import pexpect
import pytest
import rospkg

import helpers
from helpers import DEFAULT_SIGNALS, PYTHON, ROOT, TIMEOUT, create
from pharos.testing import until

README, TUTORIAL = ROOT / 'README.md', ROOT / 'doc' / 'tutorial.md'
PAGES = [README, *sorted((ROOT / 'doc').glob('*.md')), *sorted(ROOT.glob('examples/*.md'))]
EXAMPLES = sorted((ROOT / 'examples').glob('*.py'))
FENCE = re.compile(r'^```(\w*)\n(.*?)^```$', re.DOTALL | re.MULTILINE)
INDENTED = re.compile(r'^(?: {4}[^\n]*\n)+', re.MULTILINE)
ESCAPES = re.compile(r'\x1b\[[0-9;?]*[A-Za-z]|\x1b[()][A-Z0-9]|\x1b[=>78]|\r')
IPYTHON_PROMPT, DEBUGGER_PROMPT = r'In \[\d+\]: \Z', r'ipdb> \Z'


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
    """Say which page or block a case is about."""
    return value.where if isinstance(value, Block) else str(value.relative_to(ROOT))


def each_block(page, *kinds):
    return pytest.mark.parametrize('block', list(blocks(page, *kinds)), ids=name_of)


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


# -- README.md


@pytest.fixture
def packages(tmp_path, monkeypatch):
    """Make the packages that a block launches, with the nodes that it waits for."""

    def provide(block):
        names = re.findall(r"wait_for_node\('/?(\w+)'", block.text)
        for package, file in re.findall(r"\('(\w+)', '(\w+\.launch)'", block.text):
            if package not in rospkg.RosPack().list():
                folder = tmp_path / package
                folder.mkdir()
                manifest = f'<package><name>{package}</name><version>1.0.0</version></package>'
                (folder / 'package.xml').write_text(manifest)
                program = folder / 'program.py'
                program.write_text(
                    '#!/usr/bin/python3\nimport rospy\nrospy.init_node("x")\nrospy.spin()\n'
                )
                program.chmod(0o755)
                nodes = [
                    f'<node name="{name}" pkg="{package}" type="program.py" />' for name in names
                ]
                (folder / file).write_text(f'<launch>{"".join(nodes)}</launch>')

    monkeypatch.setenv('ROS_PACKAGE_PATH', str(tmp_path), prepend=':')
    monkeypatch.setenv('ROS_HOME', str(tmp_path / 'home'))
    return provide


def run_as_program(command, master, is_up=lambda: False, codes=(0,)):
    """Run a program until it prints something or is up, end it by Ctrl-C; return its output."""
    with helpers.Program(command, master.url) as program:
        until(lambda: program.output or program.poll() is not None or is_up(), TIMEOUT)
        if program.poll() is None:
            program.signal(signal.SIGINT)
        assert program.wait() in codes, program.output
        return program.output


@each_block(README, 'python')
def test_python_of_readme_runs(block, master, packages, monkeypatch, tmp_path):
    packages(block)
    if 'spin()' in block.text:
        (tmp_path / 'program.py').write_text(block.text)
        said = run_as_program([PYTHON, str(tmp_path / 'program.py')], master)
        assert 'Traceback' not in said
    elif re.search(r'^def test_', block.text, re.MULTILINE):
        (tmp_path / 'conftest.py').write_text("pytest_plugins = ['pharos.testing']\n")
        (tmp_path / 'test_block.py').write_text(f'from pharos import *\n\n{block.text}')
        command = [sys.executable, '-m', 'pytest', '-q', str(tmp_path)]
        ended = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        assert ended.returncode == 0, ended.stdout
    else:
        monkeypatch.setattr(sys, 'argv', ['program'])
        names = {'master': master, 'node': create(master, '/node')}
        exec(compile(f'from pharos import *\n{block.text}', block.where, 'exec'), names)


def commands_of(page):
    """The indented lines of a page that start a program of this package."""
    for block in INDENTED.findall(FENCE.sub('', page.read_text())):
        for line in block.splitlines():
            command = line.partition(' #')[0].strip()
            if re.match(r'rosrun pharos ', command):
                yield command


def test_command_of_readme_runs(master):
    """It may end by itself, with the status 1, if there is nobody to talk to."""
    for command in sorted({*commands_of(README)}):
        assert 'Traceback' not in run_as_program(command.split(), master, codes=(0, 1))


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

    @property
    def answer(self):
        """What it has written since the last block was typed."""
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
            self._type(block, IPYTHON_PROMPT, line)

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
    run_as_program([PYTHON, str(example)], master, lambda: any(master.system_state()))
