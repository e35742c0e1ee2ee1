"""The host's own rospy, whose functions a node patches in its own copy alone."""
import json

import pytest

from helpers import Program


def patched():
    """``[(module, target)]``: all that the table of patches has of ROS."""
    from pharos.private_rospy.patches import TABLE

    return [(module, target) for module in TABLE if 'ros' in module for target, _ in TABLE[module]]


HOST = """
import importlib, json, logging, operator, signal, sys, threading
import rospy

TARGETS = json.loads(sys.argv[1])

def look():
    modules = [importlib.import_module(module) for module, _ in TARGETS]
    loggers = [logging.getLogger(name) for name in (None, 'rosout', 'rospy')]
    return {
        'functions': [operator.attrgetter(each[1])(of) for of, each in zip(modules, TARGETS)],
        'modules': modules,
        'logging': [(each.level, list(each.handlers), each.propagate) for each in loggers],
        'hooks': (sys.excepthook, threading.excepthook, sys.stdout, sys.stderr),
        'signals': [signal.getsignal(number) for number in signal.valid_signals()],
        'node': (rospy.get_name(), rospy.core.is_initialized(), rospy.is_shutdown()),
    }

for number in signal.SIGINT, signal.SIGTERM, signal.SIGHUP:
    signal.signal(number, lambda number, frame: None)
import pharos
before = look()
with pharos.Master().create(pharos.BlockNode, named='/node') as node:
    node.send_to('/t', typed_as='std_msgs/String', data='x')
    node.ros_import('actionlib')
print('changed', json.dumps([what for what, now in look().items() if now != before[what]]))
"""


@pytest.fixture(scope='module')
def changed(ros_master):
    """The changes that a node made to its process, in a process of its own."""
    targets = json.dumps(patched())
    with Program(HOST, ros_master.url, targets) as program:
        assert program.wait() == 0, program.output
        return json.loads(program.output.partition('changed ')[2])


def test_node_leaves_host_unchanged(changed):
    for what in 'functions modules logging hooks signals node'.split():
        assert what not in changed
