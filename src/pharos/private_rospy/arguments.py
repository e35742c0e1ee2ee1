"""The arguments that rosrun and roslaunch give to one node, shared out among the nodes of a
process.

``__name:=``, ``__ns:=``, remappings and private parameters are for the node that is the whole
program. Here the first node takes the name, which is the program itself where it is a rospy node or
a script, else the first that is created with them; all else is for all. What is for one alone says
so as in ROS 2: ``detector:image:=/camera/image``.
"""
import re
import threading
from typing import Any, List

import rosgraph.names
from rosgraph.rosenv import get_master_uri

from pharos.private_rospy.addresses import is_same_master
from pharos.private_rospy.process_rospy import rospy

_FOR_ONE = re.compile(r'([A-Za-z]\w*):(?!=)(.*)', re.ASCII | re.DOTALL)
_MISTYPED = re.compile(r'\d[\w/]*:=', re.ASCII)  # rosgraph ignores it, and nobody hears of that
# (master URL, arguments, node that takes the __name in them): for good, since nodes start again
_takers: List[Any] = []
_lock = threading.Lock()  # guards it


def mappings_for(arguments, node):
    """``({left: right} for all nodes, {left: right} for that one alone)`` of the ``left:=right``
    among the arguments.

    What is no such mapping is ignored, as by rosgraph.

    :param node: the last part of the name that the program gives it
    :raises TypeError: if the arguments are no list of strings
    :raises ValueError: if a mapping has several right sides, or a left one that begins with a digit
    """
    # an iterator is empty when the next one looks at it
    is_list = isinstance(arguments, (list, tuple))
    if not is_list or not all(isinstance(argument, str) for argument in arguments):
        raise TypeError(
            f"argv is a list of strings, such as sys.argv or ['__name:=eye'], not {arguments!r}"
        )
    for_all, for_one = {}, {}
    for argument in arguments:
        mappings = for_all
        match = _FOR_ONE.fullmatch(argument)
        if match:
            if match.group(1) != node:
                continue
            mappings, argument = for_one, match.group(2)
        if _MISTYPED.match(argument):
            raise ValueError(f'{argument!r} in argv maps no name: a name begins with a letter')
        if not rosgraph.names.is_legal_remap(argument):
            continue
        left, right, *more = (side.strip() for side in argument.split(rosgraph.names.REMAP))
        if more:
            raise ValueError(
                f'{argument!r} in argv maps to several names or values: there is to be one :='
            )
        if left and right:
            mappings[left] = right
    return for_all, for_one


def takes_name(master_url, arguments, name, node):
    """Whether the ``__name`` in the arguments is for the node: it is for the first that asks, now
    and later, but where the program is a rospy node itself, which has it then.

    :param name: that ``__name``
    :param node: the full name that the node has without it
    """
    if _is_name_of_program(name, master_url):
        return False
    arguments = tuple(arguments)
    with _lock:
        for url, others, taker in _takers:
            if others == arguments and is_same_master(url, master_url):
                return taker == node
        _takers.append((master_url, arguments, node))
        return True


def _is_name_of_program(name, master_url):
    return (
        rospy.core.is_initialized()
        and rospy.names.get_mappings().get('__name') == name
        and is_same_master(get_master_uri(), master_url)
    )
