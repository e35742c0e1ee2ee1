"""The workspace: a session of IPython with a master, a node, and the names of the ROS graph.

``rosrun pharos workspace`` opens one; ``%load_ext pharos.live.workspace`` makes a notebook one.
"""
from __future__ import annotations

import atexit
import os
import re
import sys
from contextlib import suppress
from typing import Any

import rosgraph.names
from genpy import Message

import pharos
from pharos import signals
from pharos.live.made_types import known_types
from pharos.errors import PharosError
from pharos.live.text_format import message_text
from pharos.master import Master
from pharos.node import BlockNode

BANNER = """PhaROS {pharos.__version__}: {count} nodes are at the ROS master {master.url}
master is that master, me the node {me.name} of this session; all of pharos is imported.
Tab completes, x? explains x, Ctrl-C ends a line, Ctrl-D the session and its nodes.
"""
#: matches a line that ends inside a string
STRING_PATTERN = re.compile(r'.*[\'"][\w/]*')
#: matches a line that ends in send_to('TOPIC', ... FIELD
FIELD_PATTERN = re.compile(r'.*send_to\(\s*[\'"]([\w/]+)[\'"].*,\s*\w*')


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


def _completions(shell, event):
    """Return words for a line of IPython: names and types for a string, fields for send_to()."""
    master = Master()
    line = event.text_until_cursor
    call = FIELD_PATTERN.fullmatch(line)
    with suppress(PharosError):  # the master has gone, or the topic has no known type
        if call:
            message_class = pharos.message_class(master.topic(call[1]).type or '')
            return [f'{field}=' for field in message_class.__slots__]
        if STRING_PATTERN.fullmatch(line):
            names = {*master.parameters, *known_types('msg'), *known_types('srv')}
            for registrations in master.system_state():
                names.update(registrations, *registrations.values())
            return sorted(names)
    return []


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
    shell.set_hook('complete_command', _completions, re_key='.*')
    formatters = shell.display_formatter.formatters
    formatters['text/plain'].for_type(Message, print_message)
    print(BANNER.format(pharos=pharos, count=len(master.nodes()), **names))
