"""The workspace: a session of IPython with a master, a node, and the names of the ROS graph.

``rosrun pharos workspace`` opens one; ``%load_ext pharos.live.workspace`` makes a notebook one.
"""
from __future__ import annotations

import atexit
import os
import pathlib
import re
from typing import Any, Sequence

import rosgraph.names
import rospkg
from genpy import Message

import pharos
from pharos import signals
from pharos.errors import PharosError
from pharos.live.text_format import message_text
from pharos.master import Master
from pharos.node import BlockNode

BANNER = """PhaROS {pharos.__version__}: {count} nodes are at the ROS master {master.url}
master is that master, me the node {me.name} of this session; all of pharos is imported.
Tab completes, x? explains x, Ctrl-C ends a line, Ctrl-D the session and its nodes.
"""
#: matches a line that ends inside a string
STRING_PATTERN = re.compile(r'.*[\'"]([\w/~]*)$', re.DOTALL)
#: matches a line that ends inside send_to('TOPIC', ... FIELD
FIELD_PATTERN = re.compile(r'.*send_to\(\s*[\'"]([\w/]+)[\'"].*,\s*(\w*)$', re.DOTALL)


def namespace(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Return the names of a session: all of pharos, ``master``, and the node ``me``.

    Starts a master if none answers.

    :param argv: ROS's remappings and private parameters, for the node
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
    names['me'] = master.create(BlockNode, named=name, argv=argv)
    return names


def completions(line: str, master: Master) -> list[str]:
    """Return the words that the last word of a line can become.

    In a string: names of the graph and types of messages. In a call of send_to: fields.
    """
    string = STRING_PATTERN.fullmatch(line)
    field = FIELD_PATTERN.fullmatch(line)
    try:
        if string:
            prefix = string[1]
            words = _graph_names(master) if prefix.startswith('/') else _type_names(prefix)
        elif field:
            prefix = field[2]
            message_class = pharos.message_class(master.topic(field[1]).type or '')
            words = [f'{name}=' for name in message_class.__slots__]
        else:
            return []
    except (PharosError, LookupError, rospkg.ResourceNotFound):
        return []  # Tab must not raise if the master, topic or package is missing
    return sorted({word for word in words if word.startswith(prefix)})


def _graph_names(master):
    """Return the names of topics, services, nodes and parameters."""
    names = list(master.parameters)
    for registrations in master.system_state():
        names += registrations
        for node_names in registrations.values():
            names += node_names
    return names


def _type_names(prefix):
    """Return the types of the package that the prefix names, or else the names of packages."""
    packages = rospkg.RosPack()
    package, slash, _ = prefix.partition('/')
    if not slash:
        return packages.list()
    files = pathlib.Path(packages.get_path(package)).glob('[ms][sr][gv]/*')
    return [f'{package}/{file.stem}' for file in files]


def load_ipython_extension(shell: Any, names: dict[str, Any] | None = None) -> None:
    """Make a session of IPython a workspace; ``%load_ext`` calls this.

    :param shell: the InteractiveShell
    :param names: default: those of :func:`namespace`
    """
    if names is None:
        names = namespace()
    master = names['master']
    shell.push(names)
    atexit.register(signals.stop_all)  # in the IPython of Debian 11, before it clears the names
    end_session = getattr(shell, '_atexit_once', lambda: None)

    def stop_nodes():
        signals.stop_all()
        end_session()  # clears the names, so that the nodes stop before

    def complete(shell, event):
        return completions(event.text_until_cursor, master)

    def print_message(message, printer, is_cycle):
        printer.text(message_text(message))

    shell._atexit_once = stop_nodes
    shell.set_hook('complete_command', complete, re_key='.*')
    formatters = shell.display_formatter.formatters
    formatters['text/plain'].for_type(Message, print_message)
    print(BANNER.format(pharos=pharos, count=len(master.nodes()), **names))
