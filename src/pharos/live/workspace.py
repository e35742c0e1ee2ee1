"""The workspace: IPython with a master, a node of its own, and the names of the graph at hand.

``rosrun pharos workspace`` is one; a notebook has one by ``%load_ext pharos.live.workspace``.
"""
import argparse
import os
import pathlib
import re
import sys

import rosgraph.names
import rospkg
from genpy import Message

import pharos
from pharos import live, signals
from pharos.errors import PharosError
from pharos.live import pictures
from pharos.live.words import text_of
from pharos.master import Master
from pharos.node import BlockNode

BANNER = """PhaROS {pharos.__version__}: {count} nodes are at the ROS master {master.url}
master is that master, me the node {me.name} of this session; all of pharos is imported.
Tab completes, x? explains x, Ctrl-C ends a line, Ctrl-D the session and its nodes.
"""
#: a string that a line ends in, and the field of a call of send_to that it ends in
STRING = re.compile(r'.*[\'"]([\w/~]*)$', re.DOTALL)
FIELD = re.compile(r'.*send_to\(\s*[\'"]([\w/]+)[\'"].*,\s*(\w*)$', re.DOTALL)


def namespace(argv=None):
    """Return the names of a session: all of pharos, ``master`` and ``me``, a node.

    The master is one of its own if none answers.
    """
    master = Master()
    if not master.is_reachable():
        print(f'no ROS master answers at {master.url}: this session has one of its own')
        master = Master.embedded()
        os.environ['ROS_MASTER_URI'] = master.url
    is_taken = bool(master.call('lookupNode', '/workspace'))
    name = rosgraph.names.anonymous_name('workspace') if is_taken else 'workspace'
    me = master.create(BlockNode, named=name, argv=argv)
    return {**{each: getattr(pharos, each) for each in pharos.__all__}, 'master': master, 'me': me}


def completions(line, master):
    """Return what a line can end in: names of the graph, types of messages, fields of send_to."""
    string, field = STRING.fullmatch(line), FIELD.fullmatch(line)
    words: list[str] = []
    try:
        if string and string[1].startswith('/'):
            for names in master.system_state():
                words += [*names, *(name for nodes in names.values() for name in nodes)]
            words += master.parameters
        elif string:
            package, slash, _ = string[1].partition('/')
            packages = rospkg.RosPack()
            files = pathlib.Path(packages.get_path(package)).glob('[ms][sr][gv]/*') if slash else ()
            words = [f'{package}/{file.stem}' for file in files] or packages.list()
        elif field:
            cls = pharos.message_class(master.topic(field[1]).type)
            words = [f'{name}=' for name in cls.__slots__]
    except (PharosError, LookupError, rospkg.ResourceNotFound):  # the master is away, or no such
        pass
    typed = string or field
    return sorted({word for word in words if word.startswith(typed.groups()[-1])})


def load_ipython_extension(shell, names=None):
    """Make a session of IPython a workspace."""
    names = names or namespace()
    shell.push(names)
    end = shell._atexit_once  # which clears the names
    shell._atexit_once = lambda: (signals.stop_all(), end())
    shell.set_hook(
        'complete_command',
        lambda _, event: completions(event.text_until_cursor, names['master']),
        re_key='.*',
    )
    formatters = shell.display_formatter.formatters
    formatters['image/png'].for_type(Message, pictures.png_of)
    formatters['image/png'].for_type_by_name('matplotlib.figure', 'Figure', pictures.png)
    formatters['text/plain'].for_type(
        Message, lambda message, printer, _: printer.text(text_of(message))
    )
    print(BANNER.format(pharos=pharos, count=len(names['master'].nodes()), **names))


def workspace(words):
    """Open a session of IPython with the live ROS graph: `master`, a node `me`, and all of pharos."""
    read = live.parser(workspace.__doc__)
    read.add_argument('script', nargs='?', metavar='SCRIPT', help='a program to be run first')
    read.add_argument('args', nargs=argparse.REMAINDER, metavar='ARGUMENT', help='its arguments')
    chosen = read.parse_args(words)
    try:
        from IPython.terminal.ipapp import TerminalIPythonApp
    except ModuleNotFoundError:
        raise PharosError('a workspace needs IPython: apt install python3-ipython') from None
    app = TerminalIPythonApp.instance(display_banner=False)
    app.initialize(['--', chosen.script, *chosen.args] if chosen.script else [])
    app.force_interact = True
    load_ipython_extension(app.shell, namespace(sys.argv))
    app.start()


def main():
    """Run the command."""
    return live.run(workspace)
