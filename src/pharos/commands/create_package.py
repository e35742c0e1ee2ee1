"""Makes a catkin package whose nodes are written with pharos, and that can be built, launched and
tested as it is.

  cd ~/catkin_ws/src
  rosrun pharos create_package my_robot                            with a node my_robot_node
  rosrun pharos create_package my_robot --node camera controller   with these

Each node is a class in a module, with a program in scripts/ and a test. A node hears texts, counts
them, and says at a pace how many came: what it shall do goes in place of that. The launch file starts
them all, each hearing what the one before says. The maintainer is the one that git knows.
"""
import argparse
import pathlib
from typing import List

import rosgraph

from pharos import program
from pharos.new_package.creation import create_package


def read_arguments(words: List[str]) -> argparse.Namespace:
    """What argparse makes of the options."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        'name', metavar='NAME', help='the package: two letters or more; small letters, digits and _'
    )
    parser.add_argument(
        '--node',
        nargs='+',
        action='extend',
        metavar='NAME',
        default=[],
        help='its nodes; by default one, called as the package, with _node',
    )
    parser.add_argument(
        '--directory',
        type=pathlib.Path,
        default=pathlib.Path(),
        metavar='FOLDER',
        help='where it goes: the src of a catkin workspace; by default the current folder',
    )
    parser.add_argument(
        '--license', default='BSD-3-Clause', help='for package.xml; BSD-3-Clause by default'
    )
    return parser.parse_args(words)


def run(options: argparse.Namespace) -> int:
    """Make it, and say what is to be done next; returns the exit status."""
    print(create_package(options.name, options.node, options.directory, options.license))
    return 0


def main() -> int:
    """Run the command; returns the exit status."""
    options = read_arguments(rosgraph.myargv()[1:])
    return program.run('create_package', lambda: run(options))
