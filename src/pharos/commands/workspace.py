"""A session in which robots are programmed while they run: IPython, with the live ROS graph at hand.

  workspace                           a session at the master of ROS_MASTER_URI, or one of its own
  workspace SCRIPT [ARGUMENT ...]     the same, after a Python program has been run in it

There are `master`, a node of the session's own, `me`, and all of pharos. What blocks show, and log
lines, come above the prompt. The session ends with Ctrl-D, and the nodes that were made in it end
with it. doc/tutorial.md shows what can be done.
"""
import argparse
import sys

import rosgraph

from pharos import program
from pharos.live import workspace


def main() -> int:
    """Run a session; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('script', nargs='?', metavar='SCRIPT', help='a program to be run first')
    parser.add_argument('args', nargs=argparse.REMAINDER, metavar='ARGUMENT', help='its arguments')
    options = parser.parse_args(rosgraph.myargv()[1:])
    return program.run(
        'workspace', lambda: workspace.run(options.script, options.args, argv=sys.argv)
    )
