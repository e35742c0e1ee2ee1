"""The command compose."""
from __future__ import annotations

import contextlib
import faulthandler
import os
import sys
import urllib.parse
from typing import Any

import rospkg

from pharos import Master
from pharos.commands import argument_parser, run_command
from pharos.compose.composition import SWITCH_INTERVAL, Composition, leave
from pharos.compose.launch_file import LaunchFile


def main() -> int:
    """Run the command, and return the exit status."""
    return leave(run_command('compose'))


def compose(arguments: list[str]) -> int:
    """Run the Python nodes of a launch file, or several programs, unmodified, in one process.

      compose PKG FILE.launch [arg:=value ...]     as roslaunch; nodes that are not Python run apart
      compose FILE.launch [arg:=value ...]         the same, by its path
      compose --script PKG/EXECUTABLE ... [_rate:=5 old:=new ...]    programs, as rosrun runs them
      compose talker.py ...                        the same, by paths

    Programs with windows, and those with a state that a process has but once, run as plain processes; a line
    says which and why. It ends when all nodes have ended, or by Ctrl-C.
    """
    faulthandler.enable(all_threads=False)  # a crash in C says where in Python it was
    sys.setswitchinterval(SWITCH_INTERVAL)
    options = _parse(arguments)
    mappings = [each for each in sys.argv if ':=' in each]
    with contextlib.ExitStack() as stack:
        status = _run(stack, options, mappings)
    return status


def _parse(arguments):
    parser = argument_parser(compose)
    parser.add_argument('file', nargs='*', help='PKG FILE.launch, or its path alone')
    parser.add_argument('--script', nargs='+', default=[], help='programs to run')
    parser.add_argument('--only', nargs='+', default=[], help='of the file, these nodes alone')
    parser.add_argument('--apart', nargs='+', default=[], help='these as plain processes')
    parser.add_argument(
        '--here', nargs='+', default=[], help='these here, though they show windows'
    )
    parser.add_argument(
        '--group', nargs='+', action='append', default=[], help='these in one other process'
    )
    parser.add_argument('--screen', action='store_true', help="all nodes have output='screen'")
    options = parser.parse_args(arguments)
    if options.file and options.file[0].endswith('.py'):
        options.script = options.file
        options.file = []
    if not (options.file or options.script):
        parser.error('give a launch file, or programs')
    names_nodes = options.only or options.apart or options.group
    if options.script and (options.file or names_nodes) or len(options.file) > 2:
        parser.error('give one launch file, by package and name or by its path, first; or --script')
    return options


def _run(stack, options, mappings):
    """Run as the options say, and return the exit status; the stack ends all."""
    master = Master()
    if not master.is_reachable():
        port: Any = urllib.parse.urlsplit(master.url).port
        print(f'no ROS master at {master.url}: it is started here', file=sys.stderr)
        os.environ['ROS_MASTER_URI'] = stack.enter_context(Master.embedded(port)).url
    composition = stack.enter_context(Composition(master, owns_process=True))
    if options.file:
        composition.launch(_read_launch_file(master.url, options, mappings))
    else:
        composition.run_scripts(options.script, mappings, options.here)
    return composition.wait()


def _read_launch_file(url, options, mappings):
    """Return the launch file; its nodes run in the folder where roslaunch runs them."""
    args = dict(each.split(':=', 1) for each in mappings if not each.startswith('_'))
    package = options.file[0] if len(options.file) == 2 else None
    names = options.only, options.apart, options.here, options.group
    launch_file = LaunchFile(url, package, options.file[-1], args, *names, options.screen)
    home = rospkg.get_ros_home()
    os.makedirs(home, exist_ok=True)
    os.chdir(home)
    return launch_file
