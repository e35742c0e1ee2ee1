"""The command workspace."""
from __future__ import annotations

import sys

from pharos.commands import argument_parser
from pharos.errors import PharosError
from pharos.live.workspace import load_ipython_extension, namespace


def workspace(arguments: list[str]) -> None:
    """Open a session of IPython with the live ROS graph: `master`, a node `me`, and all of pharos."""
    argument_parser(workspace).parse_args(arguments)
    try:
        from IPython.terminal.ipapp import TerminalIPythonApp
    except ModuleNotFoundError:
        raise PharosError('a workspace needs IPython: apt install python3-ipython') from None
    app = TerminalIPythonApp.instance(display_banner=False)
    app.initialize([])
    app.force_interact = True
    load_ipython_extension(app.shell, namespace(sys.argv))
    app.start()
