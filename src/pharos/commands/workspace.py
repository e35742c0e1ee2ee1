"""The command workspace."""
from __future__ import annotations

from IPython.terminal.ipapp import TerminalIPythonApp

from pharos.commands import argument_parser
from pharos.live.workspace import load_ipython_extension


def workspace(arguments: list[str]) -> None:
    """Open a session of IPython with the live ROS graph: `master`, a node `me`, and all of pharos."""
    argument_parser(workspace).parse_args(arguments)
    app = TerminalIPythonApp.instance(display_banner=False)
    app.initialize([])
    app.force_interact = True
    load_ipython_extension(app.shell)
    app.start()
