"""A program that is a rospy node itself, and has nodes of this package beside it."""
import os
import re
import signal
import sys

import pytest
import rosgraph_msgs.msg

from helpers import create, registrations
from pharos.testing import Mailbox, until
from programs import ROOT, Program, forget_parameters, run

PATROL = ROOT / 'test' / 'packages' / 'patrol'
TOWER = PATROL / 'scripts' / 'tower'
PATH = os.pathsep.join([str(ROOT / 'src'), str(PATROL / 'src')])
FLOAT = 'std_msgs/Float64'


@pytest.fixture(autouse=True)
def no_parameters_left(master):
    yield
    forget_parameters(master.url)


def tower(master, *arguments, program=(TOWER,), **variables):
    """The program, once its two nodes are there."""
    command = sys.executable, *program, *arguments
    started = Program(master.url, *command, PYTHONPATH=PATH, **variables)
    started.wait_for('the walker is here')
    return started


def names(master):
    return {node.name for node in master.nodes()}


def drives(position, length):
    """Wait until the rospy node has sent the walker to both ends of its way."""
    for end in length, 0.0:
        position.wait_for(lambda message: message.data == end)


def test_the_program_of_the_page_runs(master):
    page = (ROOT / 'doc' / 'packages.md').read_text()
    (code,) = re.findall(r'^```py\n(.*?)^```$', page, re.DOTALL | re.MULTILINE)
    with Program(master.url, sys.executable, '-c', code) as program:
        program.wait_for('who goes there?')
        assert {'/tower', '/ear'} <= names(master)
        assert program.end() == 0


@pytest.mark.parametrize('with_signal', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_both(master, with_signal):
    with tower(master) as program:
        assert {'/tower', '/walker'} <= names(master)
        assert program.end(with_signal) == 0
        printed = program.read_to_the_end()
    assert printed.count('the tower is left') == 1
    assert 'Traceback' not in printed
    for name in '/tower', '/walker':
        assert registrations(master, name) == [[], [], []]


def test_each_hears_the_other_and_has_its_own_parameters(master):
    position = Mailbox(create(master, '/ear'), '/position', FLOAT)
    with tower(master, '_period:=0.02', '_length:=0.5'):
        drives(position, 0.5)
        parameters = master.parameters
        assert parameters['/tower/length'] == parameters['/walker/length'] == 0.5


def test_the_name_that_roslaunch_gives_is_the_rospy_nodes(master):
    """Both get the same arguments, and the second used to be refused, for the first had the name."""
    position = Mailbox(create(master, '/ear'), '/hall/seen', FLOAT)
    arguments = '__name:=lookout', 'position:=seen', '_period:=0.02', '__log:=/dev/null'
    with tower(master, *arguments, ROS_NAMESPACE='hall'):
        assert {'/hall/lookout', '/hall/walker'} <= names(master)
        drives(position, 1.0)


def test_at_another_master_the_name_is_free(master):
    code = """
import sys, pharos, rospy
rospy.init_node('host')
with pharos.Master.embedded() as other:
    print('there', other.create(pharos.BlockNode, named='there', argv=sys.argv).name)
    print('here', pharos.Master().create(pharos.BlockNode, named='here', argv=sys.argv).name)
"""
    ended = run(master.url, sys.executable, '-c', code, '__name:=boss')
    assert ended.stdout.split() == ['there', '/boss', 'here', '/here'], ended.stderr


@pytest.mark.parametrize('named', ['tower', 'lookout'])
def test_it_may_itself_be_loaded_into_a_process(master, monkeypatch, named):
    """There it is a script, whose arguments have the name that it is loaded by."""
    monkeypatch.syspath_prepend(str(PATROL / 'src'))
    position = Mailbox(create(master, '/ear'), '/position', FLOAT)
    arguments = ('_period:=0.02',)
    with master.load(TOWER, None, *arguments, name=None if named == 'tower' else named):
        drives(position, 1.0)
        assert {f'/{named}', '/walker'} <= names(master)
    master.node('/walker').stop()


def test_each_says_its_lines_on_rosout_under_its_own_name(master):
    lines = Mailbox(create(master, '/ear'), '/rosout', rosgraph_msgs.msg.Log)
    whose = {
        'the walker is at an end': '/tower',
        'goes to 1 m': '/walker',
        'goes to 0 m': '/walker',
    }
    with tower(master, '_period:=0.02'):
        for text, name in whose.items():
            lines.wait_for(lambda line, text=text: line.msg == text)
    said = {(line.msg, line.name) for line in lines.all() if line.msg in whose}
    assert said == set(whose.items())


def test_rosnode_kill_of_one_of_its_nodes_leaves_the_program(master):
    with tower(master) as program:
        assert run(master.url, 'rosnode', 'kill', '/walker').returncode == 0
        until(lambda: '/walker' not in names(master))
        assert '/tower' in names(master)
        assert program.end() == 0


def test_rosnode_kill_of_the_program_ends_all_of_it(master):
    with tower(master) as program:
        assert run(master.url, 'rosnode', 'kill', '/tower').returncode == 0
        assert program.process.wait(30) == 0
    assert names(master) & {'/tower', '/walker'} == set()


@pytest.mark.parametrize('with_signal', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('first', ['rospy', 'pharos'])
def test_a_signal_ends_what_outlives_the_rospy_node(master, first, with_signal):
    """rospy's handlers keep all signals to themselves when its node has ended, and the program could
    be ended by kill -9 alone."""
    imports = ['import rospy', 'import pharos']
    code = (
        '\n'.join(imports if first == 'rospy' else imports[::-1])
        + """
rospy.init_node('host')
node = pharos.Master().create(pharos.BlockNode, named='outlives')
node.log('the walker is here')
pharos.spin()
print('ends', node.lifecycle.value)
"""
    )
    with tower(master, program=('-c', code)) as program:
        assert run(master.url, 'rosnode', 'kill', '/host').returncode == 0
        until(lambda: '/host' not in names(master))
        assert '/outlives' in names(master)
        assert program.end(with_signal) == 0
        assert 'ends stopped' in program.read_to_the_end()
