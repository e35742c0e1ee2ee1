"""Names of nodes, topics, services and parameters."""
import re

import rosgraph.names

_NODE_NAME = re.compile(r'/?[A-Za-z]\w*(/[A-Za-z]\w*)*', re.ASCII)


def legal_name(name):
    """Return the name; raise ValueError if it is not legal for a topic, service or parameter."""
    is_text = isinstance(name, str) and name.isascii() and name.strip('/~')
    if not (is_text and rosgraph.names.is_legal_name(name)):
        raise ValueError(
            f'{name!r} cannot be a name of ROS: give one such as /robot1/pose or ~pose'
        )
    return name


def full_name(name):
    """Return a legal name with a slash in front, and none at the end."""
    return rosgraph.names.make_global_ns(legal_name(name)).rstrip('/')


def node_name(name):
    """Return the name; raise ValueError if it is not legal for a node."""
    if isinstance(name, str) and _NODE_NAME.fullmatch(name):
        return name
    raise ValueError(f'{name!r} cannot be the name of a node: give one such as /robot1/driver')
