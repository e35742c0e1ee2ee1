"""Run the Python nodes of a launch file, or several programs, unmodified, in one process.

  compose PKG FILE.launch [arg:=value ...]     as roslaunch; nodes that are not Python run apart
  compose FILE.launch [arg:=value ...]         the same, by its path
  compose --script PKG/EXECUTABLE ...          programs, as rosrun finds them
  compose                                      none at first

Programs with windows run in processes of their own. It is a node, /compose by default (__name:= names it
otherwise), with the services of a nodelet manager: `rosrun nodelet nodelet load PKG/EXECUTABLE
compose __name:=talker` loads one more. It ends when all nodes have ended, or by Ctrl-C.
"""
import argparse
import contextlib
import functools
import os
import sys

import rospkg
from rosgraph.names import anonymous_name

from pharos import Master, NodeNameInUseError, PharosError, spin
from pharos.compose.composition import SWITCH_INTERVAL, Composition
from pharos.compose.container import Container
from pharos.compose.launch_file import LaunchFile


def main(argv=None):
    """Start, wait, and return the exit status."""
    sys.setswitchinterval(SWITCH_INTERVAL)
    options, mappings = _parse(sys.argv[1:] if argv is None else argv)
    with contextlib.ExitStack() as stack:
        try:
            return _run(stack, options, mappings)
        except (PharosError, ValueError) as error:
            print(f'compose: {error}', file=sys.stderr)
            return 1
        except KeyboardInterrupt:
            return 0


def _parse(arguments):
    """Return the options, and the arguments of the form name:=value."""
    parser = argparse.ArgumentParser(
        'compose', description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('file', nargs='*', help='PKG FILE.launch, or its path alone')
    parser.add_argument('--script', nargs='+', default=[], help='programs to run')
    parser.add_argument('--only', nargs='+', default=[], help='of the file, these nodes alone')
    parser.add_argument('--apart', nargs='+', default=[], help='these in processes of their own')
    parser.add_argument(
        '--here', nargs='+', default=[], help='these here, though they show windows'
    )
    parser.add_argument(
        '--group', nargs='+', action='append', default=[], help='these in one other process'
    )
    parser.add_argument(
        '--share-connections', action='store_true', help='one connection to each other publisher'
    )
    options = parser.parse_args([each for each in arguments if ':=' not in each])
    mappings = [each for each in arguments if ':=' in each]
    needs_file = options.file or options.only or options.apart or options.group
    if needs_file and (options.script or len(options.file) not in (1, 2)):
        parser.error('give one launch file, by package and name or by its path, first; or --script')
    return options, mappings


def _run(stack, options, mappings):
    """Run as the options say, and return the exit status; the stack ends all."""
    master = Master(share_connections=options.share_connections)
    if not master.is_reachable():
        port = int(master.url.rstrip('/').rpartition(':')[2])
        print(f'no ROS master at {master.url}: it is started here', file=sys.stderr)
        os.environ['ROS_MASTER_URI'] = stack.enter_context(Master.embedded(port)).url
    composition = Composition(master)
    ros_arguments = [each for each in mappings if each.startswith('_') or not options.file]
    create = functools.partial(
        master.create, Container, argv=ros_arguments, composition=composition
    )
    try:
        container = create(named='compose')
    except NodeNameInUseError:
        container = create(named=anonymous_name('compose'))
    stack.enter_context(container)
    stack.enter_context(composition)
    if options.file:
        composition.launch(_read_launch_file(master.url, options, mappings))
        return composition.wait()
    if options.script:
        composition.run_scripts(options.script, options.here)
        return composition.wait()
    spin()
    return 0


def _read_launch_file(url, options, mappings):
    """Return the launch file; its nodes run in the folder where roslaunch runs them."""
    args = dict(each.split(':=', 1) for each in mappings if not each.startswith('_'))
    package = options.file[0] if len(options.file) == 2 else None
    names = options.only, options.apart, options.here, options.group
    launch_file = LaunchFile(url, package, options.file[-1], args, *names)
    home = rospkg.get_ros_home()
    os.makedirs(home, exist_ok=True)
    os.chdir(home)
    return launch_file
