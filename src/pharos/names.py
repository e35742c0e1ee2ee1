"""Names of nodes, topics, services and parameters, and of methods of a node's class."""
import re

import rosgraph.names

_NODE_NAME = re.compile(r'/?[A-Za-z]\w*(/[A-Za-z]\w*)*', re.ASCII)


def legal_name(name: str) -> str:
    """Return the name; raise ValueError if it is not legal for a topic, service or parameter."""
    is_text = isinstance(name, str) and name.isascii() and name.strip('/~')
    if not (is_text and rosgraph.names.is_legal_name(name)):
        raise ValueError(
            f'{name!r} cannot be a name of ROS: give one such as /robot1/pose or ~pose'
        )
    return name


def full_name(name: str) -> str:
    """Return a legal name with a slash in front, and none at the end."""
    return rosgraph.names.make_global_ns(legal_name(name)).rstrip('/')


def node_name(name: str) -> str:
    """Return the name; raise ValueError if it is not legal for a node."""
    if isinstance(name, str) and _NODE_NAME.fullmatch(name):
        return name
    raise ValueError(f'{name!r} cannot be the name of a node: give one such as /robot1/driver')


def check_node_class(node_class: type, base: type) -> None:
    """Raise TypeError if a class does not derive from Node, the base, or hides names."""
    if not (isinstance(node_class, type) and issubclass(node_class, base)):
        raise TypeError(f'a node is made of a subclass of Node, not {node_class!r}')
    # create() sets soul and delegate on the object, which would hide methods of these names
    own_names = {name for name in vars(base) if re.match('_[a-z]', name)} | {'soul', 'delegate'}
    for cls in node_class.__mro__[: node_class.__mro__.index(base)]:
        taken_names = own_names.intersection(vars(cls))
        if taken_names and not cls.__module__.startswith('pharos.'):
            raise TypeError(
                f'{cls.__name__} has {", ".join(sorted(taken_names))}, as Node has: choose another'
                ' name'
            )
