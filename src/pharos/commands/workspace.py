"""The command workspace."""
from __future__ import annotations

import argparse
import sys

from pharos.commands import argument_parser
from pharos.errors import PharosError
from pharos.live.workspace import load_ipython_extension, namespace


def workspace(arguments: list[str]) -> None:
    """Open a session of IPython with the live ROS graph: `master`, a node `me`, and all of pharos."""
    parser = argument_parser(workspace)
    parser.add_argument('script', nargs='?', metavar='SCRIPT', help='a program to run first')
    parser.add_argument('args', nargs=argparse.REMAINDER, metavar='ARGUMENT', help='its arguments')
    options = parser.parse_args(arguments)
    try:
        from IPython.terminal.ipapp import TerminalIPythonApp
    except ModuleNotFoundError:
        raise PharosError('a workspace needs IPython: apt install python3-ipython') from None
    app = TerminalIPythonApp.instance(display_banner=False)
    app_arguments = []
    if options.script:
        app_arguments = ['--', options.script, *options.args]
    app.initialize(app_arguments)
    app.force_interact = True
    load_ipython_extension(app.shell, namespace(sys.argv))
    app.start()
