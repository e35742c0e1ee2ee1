"""Runs the Python nodes of a launch file, or several programs, unmodified, in one process, where
messages go from one to the other without a socket.

  compose PKG FILE.launch [arg:=value ...]     as roslaunch; what is not Python runs apart, as there
  compose FILE.launch [arg:=value ...]         the same, by its path
  compose --script PKG/EXECUTABLE ...          programs, as rosrun finds them
  compose                                      none at first

Programs that use pharos themselves make their nodes by themselves, and run apart.

It is a node, /compose by default (__name:= names it otherwise), with the services of a nodelet
manager: `rosrun nodelet nodelet load PKG/EXECUTABLE compose __name:=talker` loads one more. It ends
when all nodes have ended, or by Ctrl-C, which ends all of them. What the nodes share and what to keep
apart says doc/compose.md.
"""
import argparse
import os
import signal
import sys
from typing import Any, Dict, List, Optional, Tuple

import rosgraph.names
import rosgraph.network

from pharos import Composition, Master, NodeNameInUseError, PharosError, UnknownTypeError, spin
from pharos.compose.container import Container
from pharos.compose.launch_file import LaunchedNode, LaunchFile, Problem
from pharos.compose.output import SCREEN
from pharos.compose.programs import find_program, uses_pharos
from pharos.compose.progress import PrintedProgress


def read_arguments(
    argv: List[str],
) -> Tuple[argparse.Namespace, Dict[str, object], List[str]]:
    """``(what argparse makes of the options, {launch argument: value}, ROS's arguments)``."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        'file', nargs='*', metavar='PKG FILE.launch', help='a launch file, or its path alone'
    )
    parser.add_argument(
        '--script', nargs='+', metavar='PKG/EXECUTABLE', default=[], help='programs to run'
    )
    parser.add_argument(
        '--only', nargs='+', metavar='NODE', default=[], help='of the file, these nodes alone'
    )
    parser.add_argument(
        '--apart', nargs='+', metavar='NODE', default=[], help='these in processes of their own'
    )
    parser.add_argument(
        '--share-connections',
        action='store_true',
        help='have the nodes share one connection to each publisher elsewhere, which then has one'
        ' subscriber (see doc/compose.md)',
    )
    parser.add_argument(
        '--allow-remote-load',
        action='store_true',
        help="have any host load programs, not only this one and the master's",
    )
    words = [word for word in argv if ':=' not in word]
    mappings = [word for word in argv if ':=' in word]
    options = parser.parse_args(words)
    if len(options.file) > 2 or options.file and options.script:
        parser.error('give one launch file, by package and name or by its path, or --script')
    if (options.only or options.apart) and not options.file:
        parser.error('--only and --apart choose among the nodes of a launch file: give one')
    if not options.file:
        return options, {}, mappings
    launch = [word for word in mappings if not word.startswith('_')]
    args: Dict[str, object] = {}
    for word in launch:
        name, _, args[name] = word.partition(':=')
    return options, args, [word for word in mappings if word not in launch]


def find_master(progress: PrintedProgress) -> Tuple[Master, Optional[Master]]:
    """The master of the environment, or one of our own where there is none, as roslaunch has it."""
    master = Master()
    if master.is_reachable():
        return master, None
    host, port = rosgraph.network.parse_http_host_and_port(master.url)
    if not rosgraph.network.is_local_address(host):
        raise PharosError(f'no ROS master answers at {master.url}: is ROS_MASTER_URI right?')
    own = Master.embedded(port)
    progress.tell(f'no ROS master at {master.url}: started one, which ends with this')
    os.environ['ROS_MASTER_URI'] = own.url
    return own, own


def create_container(
    master: Master, composition: Composition, ros_arguments: List[str], allow_remote_load: bool
) -> Container:
    """The node with nodelet's services; beside another one it has a name of its own."""
    settings: Dict[str, Any] = {'argv': ros_arguments, 'composition': composition}
    settings['allow_remote_load'] = allow_remote_load
    try:
        return master.create(Container, 'compose', **settings)
    except NodeNameInUseError:
        if any(word.startswith('__name:=') for word in ros_arguments):
            raise
        return master.create(Container, rosgraph.names.anonymous_name('compose'), **settings)


def script(text: str) -> LaunchedNode:
    """What --script names."""
    package, _, executable = text.partition('/')
    if not (os.path.isfile(text) or package and executable):
        raise PharosError('it is neither PACKAGE/EXECUTABLE nor the path of a file')
    path = find_program(text) if os.path.isfile(text) else find_program(package, executable)
    return LaunchedNode('script', text, path, output=SCREEN, takes_own_name=True)


def launch(composition: Composition, options: argparse.Namespace, args: Dict[str, object]) -> None:
    """Start what the options name."""
    if options.file:
        package = options.file[0] if len(options.file) == 2 else None
        composition.launch(
            LaunchFile(
                composition.master.url, package, options.file[-1], args, options.only, options.apart
            )
        )
    scripts = []
    for text in options.script:
        try:
            launched = script(text)
        except PharosError as error:
            composition.refuse(Problem(text, '', str(error)))
            continue
        if uses_pharos(launched.path):
            composition.run_apart(launched)
        else:
            scripts.append(launched)
    composition.start(scripts)


def main() -> int:
    """Start, wait, and tell what has become of each."""
    options, args, ros_arguments = read_arguments(sys.argv[1:])
    progress = PrintedProgress(sys.stderr)
    own_master = composition = container = None
    status = 0
    try:
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        master, own_master = find_master(progress)
        master.share_connections = options.share_connections
        composition = Composition(master, progress)
        try:
            container = create_container(
                master, composition, ros_arguments, options.allow_remote_load
            )
        except UnknownTypeError as error:
            progress.tell(f'without the services of a nodelet manager: {error}')
        launch(composition, options, args)
        if options.file or options.script or container is None:
            status = composition.wait()
        else:
            spin()
    except KeyboardInterrupt:
        pass
    except (PharosError, ValueError) as error:
        progress.tell(f'compose: {error}')
        status = 1
    finally:
        if composition is not None:
            composition.stop()
            for name, outcome in composition.outcomes():
                progress.tell(f'{name}: {outcome}')
        if container is not None:
            container.stop()
        if own_master is not None:
            own_master.stop()
    return status
