"""The workspace: a session of IPython with a master, a node, and the names of the ROS graph.

``rosrun pharos workspace`` opens one; ``%load_ext pharos.live.workspace`` makes a notebook one.
"""
from __future__ import annotations

import atexit
import os
import sys
from typing import Any

import rosgraph.names
from genpy import Message

import pharos
from pharos import signals
from pharos.live.text_format import message_text
from pharos.master import Master
from pharos.node import BlockNode

BANNER = """PhaROS {pharos.__version__}: {count} nodes are at the ROS master {master.url}
master is that master, me the node {me.name} of this session; all of pharos is imported.
Tab completes, x? explains x, Ctrl-C ends a line, Ctrl-D the session and its nodes.
"""


def namespace() -> dict[str, Any]:
    """Return the names of a session: all of pharos, ``master``, and the node ``me``.

    Starts a master if none answers. The node gets ROS's remappings and private parameters of the
    program.
    """
    master = Master()
    if not master.is_reachable():
        print(f'no ROS master answers at {master.url}: this session has one of its own')
        master = Master.embedded()
        os.environ['ROS_MASTER_URI'] = master.url
    name = 'workspace'
    if master.call('lookupNode', '/workspace'):
        name = rosgraph.names.anonymous_name('workspace')
    names = {each: getattr(pharos, each) for each in pharos.__all__}
    names['master'] = master
    names['me'] = master.create(BlockNode, named=name, argv=sys.argv)
    return names


def load_ipython_extension(shell: Any) -> None:
    """Make a session of IPython a workspace; ``%load_ext`` calls this.

    :param shell: the InteractiveShell
    """
    names = namespace()
    master = names['master']
    shell.push(names)
    atexit.register(signals.stop_all)  # in the IPython of Debian 11, before it clears the names
    end_session = getattr(shell, '_atexit_once', lambda: None)

    def stop_nodes():
        signals.stop_all()
        end_session()  # clears the names, so that the nodes stop before

    def print_message(message, printer, is_cycle):
        printer.text(message_text(message))

    shell._atexit_once = stop_nodes
    formatters = shell.display_formatter.formatters
    formatters['text/plain'].for_type(Message, print_message)
    print(BANNER.format(pharos=pharos, count=len(master.nodes()), **names))
