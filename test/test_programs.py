"""Programs and libraries of ROS as a node's own: they find what they would in a process of their
own."""
import pathlib

import pytest

from helpers import create

PROGRAMS = pathlib.Path(__file__).parent / 'programs'


@pytest.fixture
def node(master):
    """A node whose rospy the programs use."""
    return create(master, '/program_node')


def run(node, program, *arguments):
    """Run a program of the tests as the node's, in this thread."""
    path = str(PROGRAMS / program)
    node.latest_run.rospy.run_main(path, [path, *arguments])


def test_a_program_is_main_and_has_its_arguments_and_the_modules_beside_it(master):
    path = 'siblings/counting.py'
    for name in '/first_program', '/second_program':
        node = create(master, name)
        with pytest.raises(SystemExit) as exit_:
            run(node, path, 'one', '--two')
        found = node.parameter('~found').value
        assert found == ['__main__', *2 * [str(PROGRAMS / path)], 'one', '--two', name]
        assert exit_.value.code == 3
