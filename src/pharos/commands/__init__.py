"""The command ``pharos``, which runs the commands of this package if rosrun does not find it.

usage: pharos COMMAND [ARGUMENT ...]
       pharos --version

  workspace       a session in IPython, with the live graph at hand
  compose         run the Python nodes of a launch file in one process
  top             a live table of nodes, processes and topics
  graph           who talks to whom, as text or as a picture
  create_package  make a catkin package with nodes and tests

'pharos COMMAND --help' tells the arguments of one.
"""
import importlib
import sys

import pharos

MODULES = {
    'workspace': 'pharos.live.workspace',
    'compose': 'pharos.commands.compose',
    'top': 'pharos.live.top',
    'graph': 'pharos.live.graph',
    'create_package': 'pharos.commands.create_package',
}


def main():
    """Run the command that the first argument names; returns its exit status."""
    command = sys.argv[1] if sys.argv[1:] else '--help'
    if command in MODULES:
        sys.argv[:2] = [f'pharos {command}']
        return importlib.import_module(MODULES[command]).main()
    print(f'pharos {pharos.__version__}' if command == '--version' else __doc__)
    return not command.startswith('-')
