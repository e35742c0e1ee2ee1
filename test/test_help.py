"""What help() tells of a thing: all that can be asked of it."""
import inspect
import pydoc
import re

import pytest

from helpers import create
from pharos.testing import until
from programs import ROOT
import pharos


def fails(message, channel):
    """A delegate."""
    raise ValueError(message.data)


@pytest.fixture
def things(master):
    """One of each thing that users get, by the name of its class."""
    node = create(master, '/helped', pharos.Node, delegate=fails)
    heard = node.interested_in('/help', 'std_msgs/String')
    sending = node.output_channel('/help')
    offered = node.serve('~help', 'std_srvs/Empty', lambda request: None)
    sending.send(data='x')
    until(lambda: node.failures)
    script = master.load(ROOT / 'test' / 'programs' / 'talk.py')
    with master.run('rostopic', 'rostopic', 'list') as process:
        things = [
            *(master, node, heard, sending, offered, node.failures[0], node.parameter('~help')),
            *(master.topic('/help'), master.lookup_service('~help', '/helped'), master.graph()),
            *(pharos.ExternalNode(master, '/other'), script, process, pharos.Transcript),
        ]
        yield {type(thing).__name__: thing for thing in things}


def attributes_of(thing):
    """The names of what it has that is no method."""
    cls = type(thing)
    own = [name for name in dir(cls) if not inspect.isroutine(getattr(cls, name))]
    return sorted(name for name in {*vars(thing), *own} if not name.startswith('_'))


def told(cls):
    """What help() prints."""
    return pydoc.plain(pydoc.render_doc(cls))


def test_help_tells_each_attribute_in_a_line(things, transcript):
    missing = []
    for name, thing in things.items():
        text = told(type(thing))
        if isinstance(thing, pharos.Node):
            text += told(pharos.Node)
        for attribute in attributes_of(thing):
            is_variable = re.search(rf'^ \|  :ivar {attribute}: \S', text, re.MULTILINE)
            # a property, with its docstring
            if not is_variable and not re.search(rf'^ \|  {attribute}\n \|      \S', text, re.M):
                missing.append(f'{name}.{attribute}')
    assert missing == []


def test_help_of_a_node_has_its_attributes_also_where_its_class_is_the_users(master):
    class Driver(pharos.Node):
        """Drives."""

    text = told(create(master, '/helped', Driver))
    for name in 'name uri errors failures master channels soul delegate connect_timeout'.split():
        assert re.search(rf'^ \|  {name}( = .*)?$', text, re.MULTILINE), name


def test_help_of_all_exports_can_be_read():
    for name in pharos.__all__:
        export = getattr(pharos, name)
        if name != '__version__':
            lines = told(export).splitlines()
            assert len(lines) > 3, name
            # the texts are ours; signatures are Python's
            assert all(len(line) < 120 for line in lines if not re.search(r'\(.*\)', line)), name
