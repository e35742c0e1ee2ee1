"""README.md, the pages of doc/ and benchmark/README.md: every command in them runs, and so does the
Python of README.md and what is indented on the others; test_how_to.py and test_tutorial.py run the
Python in fences there."""
import ast
import math
import os
import pathlib
import re
import shlex
import signal
import subprocess
import sys
from typing import NamedTuple

import pytest

import pharos
from pharos import BlockNode
from pharos.testing import Mailbox, TIMEOUT, until
from programs import PROGRAMS, ROOT, Program, environment, forget_parameters, run, script

PAGES = [
    ROOT / 'README.md',
    *sorted((ROOT / 'doc').rglob('*.md')),
    ROOT / 'benchmark' / 'README.md',
]
BLOCK = re.compile(
    r'^```(\w+)\n(.*?)^```$|^(?:#[^\n]*)?\n((?: {4}[^\n]*\n|\n(?= {4}))+)', re.DOTALL | re.MULTILINE
)
#: programs that begin a line which is a command of the shell, beside those of this clone
SHELL = set(
    'rosrun roslaunch rosnode rostopic rosservice rosparam rosbag roscore apt apt-get catkin_make'
    ' catkin_test_results export source python3 /usr/bin/python3'.split()
)

#: Debian's programs alone: another python3 has no rospy
DEBIANS = '/usr/sbin:/usr/bin:/sbin:/bin'
#: what begins a command that is not run, and why
NOT_RUN = {
    'apt install ./build/packages': 'it changes the machine; tools/package try deb does it',
    'apt-get install': 'it changes the machine; tools/test installs the same packages',
    'catkin_make': 'test_packages.py builds workspaces, and runs what is in them',
    'catkin_test_results': 'it is about what catkin_make has built',
    'source devel/setup.bash': 'it is about what catkin_make has built',
    '/usr/bin/python3 -m venv': 'test_packaging.py makes one, and runs the commands in it',
    '.venv/bin/': 'the same',
    '/usr/bin/python3 -m pytest test': 'test_packages.py runs the tests of a package that was made',
    'rosrun pharos workspace': 'it wants a terminal: test_tutorial.py types into it',
    'rosrun pharos bridge http://robot': 'there are no such hosts; test_masters.py runs the bridge',
    'rosbag play': 'there is no such bag: test_examples.py plays one, by examples/replay.py',
    'rosparam set use_sim_time': 'time would stand still for all the tests after it',
    'rosrun nodelet': 'test_compose_program.py loads scripts by it, where nodelet is installed',
    'rosservice call /manager/list': 'it asks the program that the line before has started',
}
#: how an indented block begins that is neither a command nor Python: what something prints
OUTPUT = {
    'registered, master reachable since': 'node.health(), which test_health.py reads',
    '| latency at 100 Hz': 'the output of benchmark/channels on one machine',
    'p50      p95': 'the same',
    'image p50, ms': 'the output of benchmark/compose on one machine',
    'nodes, in one process (rospy': 'the output of benchmark/scale on one machine',
    'topics of one node, which': 'the same',
    'receivers of twist, 100 Hz': 'the same',
    'receivers of image6.2, 30 Hz': 'the same',
    'bytes of an image, one': 'the same',
    'limits: nodes of a chain': 'the same',
    'no thread for /scale/n65': 'the same',
    'unexpected error a message of': 'a line of the log',
    'Twist at 100 Hz, us': 'the output of benchmark/middleware on one machine',
    'written into': 'the same',
}


#: what each kind of fence is, and who looks at it
FENCES = {
    'python': 'README.md: here; the tutorial: test_tutorial.py; other pages of doc/: test_how_to.py',
    'py': 'here: a program of its own, or a file for the commands of its page',
    'text': 'what the block before prints, which the same tests compare',
    'console': 'test_tutorial.py types it',
    'debugger': 'the same',
    'ipython': 'the same',
    'mermaid': 'test_docs.py sees it drawn',
    'xml': 'here: roslaunch reads it',
}


class Block(NamedTuple):
    """A block of code of a page; `kind` is that of its fence, or '' where it is indented."""

    page: pathlib.Path
    line: int
    kind: str
    text: str

    def __str__(self):
        return f'{self.page.relative_to(ROOT)}:{self.line}'


def blocks():
    """Those of all pages, in their order."""
    for page in PAGES:
        source = page.read_text()
        for found in BLOCK.finditer(source):
            text = found[2] if found[1] else re.sub(r'^ {4}', '', found[3], flags=re.MULTILINE)
            yield Block(
                page,
                source.count('\n', 0, found.start(2 if found[1] else 3)) + 1,
                found[1] or '',
                text,
            )


def is_command(line):
    first = line.split()[0]
    return first in SHELL or first.startswith(('tools/', 'benchmark/', '.venv/bin/'))


def is_shell(block):
    lines = [line for line in block.text.splitlines() if line.strip()]
    return block.kind == '' and all(map(is_command, lines))


def is_python(block):
    if block.kind:
        return False
    try:
        return bool(ast.parse(block.text))
    except SyntaxError:
        return False


def commands():
    """``(block, line)`` of each command, without its comment."""
    for block in blocks():
        if is_shell(block):
            for line in filter(str.strip, block.text.splitlines()):
                yield block, re.sub(r'\s+# .*', '', line.strip())


def is_heavy(line):
    """Whether it is asked for its help alone: it takes minutes, or installs things."""
    return re.match(r'(python3 )?(tools|benchmark)/', line)


def is_run(line):
    return not is_heavy(line) and not line.startswith(tuple(NOT_RUN))


def file_name(block):
    """The name of the file that the block is, as its first line may say."""
    named = block.kind == 'py' and re.match(r'# (\w+\.py)\n', block.text)
    return named[1] if named else ''


def write_files(page, folder):
    """Put the files of a page there."""
    for block in blocks():
        if block.page == page and file_name(block):
            (folder / file_name(block)).write_text(block.text)


def python_of(page):
    return [block for block in blocks() if block.page == ROOT / page and block.kind == 'python']


def identify(value):
    return str(value) if isinstance(value, (Block, str)) else None


# -- what is where


@pytest.mark.parametrize('block', [each for each in blocks() if not each.kind], ids=identify)
def test_an_indented_block_is_commands_or_python_or_known_output(block):
    assert (
        is_shell(block) or is_python(block) or any(map(block.text.__contains__, OUTPUT))
    ), block.text


def test_what_is_not_run_is_there():
    lines = [line for _, line in commands()]
    gone = [start for start in NOT_RUN if not any(line.startswith(start) for line in lines)]
    assert gone == [], 'no page has it any more'


def test_a_fence_is_of_a_kind_that_a_test_looks_at():
    assert {block.kind for block in blocks()} - {''} <= FENCES.keys()


@pytest.mark.parametrize('block', [each for each in blocks() if each.kind == 'xml'], ids=identify)
def test_roslaunch_reads_lines_of_a_launch_file(block, tmp_path):
    (tmp_path / 'a.launch').write_text(f'<launch>{block.text}</launch>')
    ended = run('http://127.0.0.1:1/', 'roslaunch', '--nodes', str(tmp_path / 'a.launch'))
    assert ended.returncode == 0, ended.stderr
    assert block.text.count('<node ') == len(ended.stdout.split())


# -- commands


def heavy_commands():
    within_lines = re.findall(
        r'`((?:python3 )?(?:tools|benchmark)/[^`]+)`', '\n'.join(map(pathlib.Path.read_text, PAGES))
    )
    found = {*within_lines, *(line for _, line in commands() if is_heavy(line))}
    return sorted(line for line in found if not re.search(r'\.\w+$|/$', line))


def help_of(command):
    ended = run('http://127.0.0.1:1/', 'env', f'PATH={DEBIANS}', *command, '--help', cwd=ROOT)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


@pytest.mark.parametrize('line', heavy_commands())
def test_a_long_command_has_the_options_that_it_is_given(line):
    words = shlex.split(line)
    length = 2 if words[0] == 'python3' else 1
    if length == 1 and (ROOT / line).is_dir():
        return
    program = (
        words[:length] if os.access(ROOT / words[0], os.X_OK) else ['python3', words[length - 1]]
    )
    shown = help_of(program)
    assert {word for word in words[length:] if word.startswith('--')} <= set(
        re.findall(r'--[\w-]+', shown)
    )


@pytest.mark.parametrize(
    'name', ['nodes', 'channels', 'services', 'compose', 'scale', 'middleware']
)
def test_each_benchmark_can_be_seen_to_work_quickly(name):
    assert '--quick' in help_of(['/usr/bin/python3', f'benchmark/{name}'])


def test_nodes_is_quick():
    ended = run('http://127.0.0.1:1/', str(ROOT / 'benchmark' / 'nodes'), '--quick')
    assert ended.returncode == 0, ended.stderr
    assert '10 nodes in one process: start' in ended.stdout


@pytest.mark.parametrize(
    'text',
    sorted(
        {
            text
            for page in PAGES
            for text in re.findall(r'`(rosrun pharos [^`]+)`', page.read_text())
        }
    ),
)
def test_a_command_within_a_line_names_a_program_and_its_options(text):
    words = text.split()
    if words[2] == '...' or words[2].isupper():
        return
    shown = (ROOT / 'scripts' / words[2]).exists() and help_of([script(words[2])])
    if not shown:
        assert (ROOT / 'examples' / words[2]).exists(), text
    for option in re.findall(r'--[\w-]+', text):
        assert option in shown, option


@pytest.fixture(autouse=True)
def packages(monkeypatch):
    """This clone, and the packages that the pages take for examples, are on ROS_PACKAGE_PATH."""
    path = os.pathsep.join([str(ROOT), str(PROGRAMS / 'documented'), '/usr/share'])
    monkeypatch.setenv('ROS_PACKAGE_PATH', path)
    # nothing is built: in a workspace, roslaunch would find each launch file twice
    monkeypatch.delenv('CMAKE_PREFIX_PATH', raising=False)
    monkeypatch.setenv('PYTHONPATH', str(ROOT / 'src'))


@pytest.fixture(scope='module')
def ros_master():
    """A process of its own, for the programs."""
    with pharos.Master.embedded() as found:
        yield found


@pytest.fixture
def robot(master):
    """Who the commands ask: the nodes of README's first example, of which one is the turtle, too, and
    services."""

    def drive(me):
        for _ in me.every(0.1):
            me.send_to('/turtle1/cmd_vel', typed_as='geometry_msgs/Twist', linear={'x': 2.0})

    driver = master.create(BlockNode, named='/driver', soul=drive)
    logger = master.create(BlockNode, named='/logger', delegate=lambda *_: None)
    logger.interested_in('/turtle1/cmd_vel', 'geometry_msgs/Twist')
    logger.output_channel('/turtle1/pose', 'turtlesim/Pose')
    driver.serve('/lamp', 'std_srvs/SetBool', lambda request: (True, ''))
    driver.serve('/clear', 'std_srvs/Empty', lambda request: None)
    driver.fork()
    yield driver
    forget_parameters(master.url)


def names(master):
    users = master.system_state()
    return {node for kind in users for nodes in kind.values() for node in nodes}


RUN = [each for each in commands() if is_run(each[1])]


@pytest.mark.parametrize('block, line', RUN, ids=identify)
def test_a_command_runs(block, line, master, robot, tmp_path):
    """One that goes on has printed something, or its nodes are there, before Ctrl-C."""
    log = tmp_path / 'log'
    folder = tmp_path / 'folder'
    folder.mkdir()
    write_files(block.page, folder)
    variables = {'ROS_HOME': str(tmp_path), 'PATH': DEBIANS}
    if 'create_package' in line:
        variables['ROS_PACKAGE_PATH'] = str(ROOT)  # there is no package of that name yet

    def is_up():
        if 'pharos compose' in line:
            is_whole = '.launch' in line and '--only' not in line
            last = 'planner' if is_whole else 'detector' if 'my_robot' in line else 'listener'
            return f'/{last}' in names(master)
        # what each says when all of it has started
        if 'roslaunch pharos' in line:
            turtle = [] if 'none' in line else ['no window']
            return all(map(log.read_text().count, ['drives', 'command_velocity', *turtle]))
        if re.search('pharos (turtle|block)', line):
            started = 'no window' if 'simulator' in line else 'drives|Velocity|answered'
            return re.search(started, log.read_text())
        return log.read_text() or [*folder.iterdir()]

    with open(log, 'w') as output:
        process = subprocess.Popen(
            ['bash', '-c', line],
            env=environment(master.url, **variables),
            cwd=folder,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
        try:
            until(lambda: process.poll() is not None or is_up())
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            status = process.wait(2 * TIMEOUT)
    said = log.read_text()
    assert status in (0, 130, -signal.SIGINT, 128 + signal.SIGTERM), said
    # one that had printed all was just ending
    said = re.sub(r'Exception ignored in(.|\n)*KeyboardInterrupt', '', said)
    assert 'Traceback' not in said.replace('KeyboardInterrupt', ''), said


# -- Python


def test_the_first_example_runs_as_it_is_written(master, tmp_path):
    """It can be watched by rostopic, and moves the turtle."""
    (tmp_path / 'turtle.py').write_text(python_of('README.md')[0].text)
    picture = tmp_path / 'turtle.png'
    poses = Mailbox(master.create(BlockNode, named='/poses'), '/turtle1/pose', 'turtlesim/Pose')
    with Program(master.url, '/usr/bin/python3', str(tmp_path / 'turtle.py')) as example:
        example.wait_for('drive at 2.0')
        heard = run(master.url, 'rostopic', 'echo', '-n', '1', '/turtle1/cmd_vel')
        assert 'x: 2.0' in heard.stdout
        assert 'INTRAPROCESS' in run(master.url, 'rosnode', 'info', '/driver').stdout
        with Program(
            master.url, script('turtle_simulator'), f'_picture:={picture}', '_window:=false'
        ):
            poses.wait_for(lambda pose: math.dist((pose.x, pose.y), (5.5444, 5.5444)) > 1)
        assert example.end() == 0
    assert 'ERROR' not in example.read_to_the_end()


@pytest.mark.parametrize('block', python_of('README.md')[1:], ids=identify)
def test_three_lines_run(block, master, monkeypatch, tmp_path):
    if 'def test_' in block.text:
        (tmp_path / 'conftest.py').write_text("pytest_plugins = ['pharos.testing']\n")
        (tmp_path / 'test_it.py').write_text('from pharos import *\n\n\n' + block.text)
        ended = run(master.url, sys.executable, '-m', 'pytest', '-q', cwd=tmp_path)
        assert '1 passed' in ended.stdout, ended.stdout
        return
    monkeypatch.setattr(sys, 'argv', ['driver.py', '_speed:=3.0'])
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    shown = {'master': master, 'node': master.create(BlockNode, named='/node')}
    exec(f'from pharos import *\n{block.text}', shown)
    forget_parameters(master.url)


@pytest.mark.parametrize(
    'block',
    [each for each in blocks() if each.kind == 'py' and not file_name(each)],
    ids=identify,
)
def test_a_program_prints_something_until_it_is_told_to_end(block, master, tmp_path):
    write_files(block.page, tmp_path)
    (tmp_path / 'program.py').write_text(block.text)
    with Program(master.url, '/usr/bin/python3', 'program.py', cwd=tmp_path) as program:
        program.wait_for('')
        assert program.end() == 0
    assert 'Traceback' not in program.read_to_the_end()


@pytest.mark.parametrize('block', filter(is_python, blocks()), ids=identify)
def test_indented_python_runs(block, master, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    node = master.create(BlockNode, named='/robot')
    scan = node.output_channel('/scan', 'sensor_msgs/LaserScan', latch=True)
    scan.send(angle_max=3.0, angle_increment=0.1, range_max=9.0, ranges=[1.0] * 31)

    def drive(me):
        for _ in me.every(0.05):
            me.send_to('/cmd_vel', typed_as='geometry_msgs/Twist', linear={'x': 2.0})

    node.fork(drive)
    hearer = master.create(BlockNode, named='/hearer', delegate=lambda *_: None)
    channel = hearer.interested_in('/cmd_vel', 'geometry_msgs/Twist')
    exec(block.text, {'master': master, 'node': node, 'channel': channel})
