"""The arguments that rosrun and roslaunch give to one node, shared out among the nodes of a
process.

``__name:=``, ``__ns:=``, remappings and private parameters are for the node that is the whole
program. Here the first node takes the name, which is the program itself where it is a rospy node or
a script, else the first that is created with them; all else is for all. What is for one alone says
so as in ROS 2: ``detector:image:=/camera/image``.
"""
import os
import re
import threading
from typing import List

import rosgraph.names
from rosgraph.rosenv import get_master_uri

from pharos.private_rospy.addresses import is_same_master
from pharos.private_rospy.process_rospy import rospy

_FOR_ONE = re.compile(r'([A-Za-z]\w*):(?!=)(.*)', re.ASCII | re.DOTALL)
_MISTYPED = re.compile(r'\d[\w/]*:=', re.ASCII)  # rosgraph ignores it, and nobody hears of that
_lock = threading.Lock()  # guards what follows


class Taker:
    """The node that takes the ``__name`` in the arguments of a program, for good, since nodes start
    again.

    :param node: the full name that it has without it
    """

    def __init__(self, master_url, arguments, node):
        self._master_url, self._arguments, self.node = master_url, arguments, node
        self._is_told = False

    def is_of(self, master_url, arguments):
        """Whether it is that of these arguments at that master."""
        return self._arguments == arguments and is_same_master(self._master_url, master_url)

    def note(self, name):
        """What to tell one of the others where it has given up its own name for ``name``; nothing
        where that was told before."""
        own = self.node.rpartition('/')[2]
        with _lock:
            if own == name or self._is_told:
                return ''
            self._is_told = True
        return (
            f'__name:={name}, which roslaunch or the command line gave this program, has named the'
            f' node that it creates first, {own!r}, and the others keep theirs: write <node'
            f' name="{own}"> for that one to keep its own, too (doc/packages.md, "Two nodes of a'
            ' process in a launch file")'
        )


_takers: List[Taker] = []


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


def taker_of_name(master_url, arguments, name, node):
    """The :class:`Taker` of the ``__name`` in the arguments, which is the node if it is the first that
    asks; None where the program is a rospy node itself, which has that name then.

    :param name: that ``__name``
    :param node: the full name that the node has without it
    """
    if _is_name_of_program(name, master_url):
        return None
    arguments = tuple(arguments)
    with _lock:
        for taker in _takers:
            if taker.is_of(master_url, arguments):
                return taker
        _takers.append(Taker(master_url, arguments, node))
        return _takers[-1]


def _is_name_of_program(name, master_url):
    return (
        rospy.core.is_initialized()
        and rospy.names.get_mappings().get('__name') == name
        and is_same_master(get_master_uri(), master_url)
    )


def _forget():
    """In a process that was forked, when another thread may have held the lock."""
    global _lock
    _lock = threading.Lock()


os.register_at_fork(after_in_child=_forget)
