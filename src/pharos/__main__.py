"""The command ``pharos``, by which those of the package are run where ``rosrun`` does not find it;
``python3 -m pharos`` is the same."""
import argparse
import importlib
import signal
import sys

import pharos

COMMANDS = {
    'workspace': 'a session in IPython, with the live graph at hand',
    'compose': 'run the Python nodes of a launch file in one process',
    'top': 'a live table of nodes, processes and topics',
    'graph': 'who talks with whom, as text or as a picture',
    'create_package': 'make a catkin package with nodes and tests',
}


def main() -> int:
    """Run the command that the arguments name; returns its exit status."""
    lines = '\n'.join(f'  {name:<16}{what}' for name, what in COMMANDS.items())
    parser = argparse.ArgumentParser(
        prog='pharos',
        description='Several ROS nodes in one process, and tools to see and change them live.',
        epilog=f"commands:\n{lines}\n\n'pharos COMMAND --help' tells the arguments of one.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('--version', action='version', version=f'pharos {pharos.__version__}')
    parser.add_argument('command', metavar='COMMAND', choices=COMMANDS, help='one of those below')
    parser.add_argument(
        'arguments', metavar='ARGUMENT', nargs=argparse.REMAINDER, help='the arguments of that one'
    )
    options = parser.parse_args(sys.argv[1:] or ['--help'])
    # what the command names itself by, and rospy reads remappings from
    sys.argv = [f'pharos {options.command}', *options.arguments]
    # Ctrl-C ends it without a word here: what is raised within an import may be lost
    handler = signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        command = importlib.import_module(f'pharos.commands.{options.command}')
    finally:
        signal.signal(signal.SIGINT, handler)
    status: int = command.main()
    return status


if __name__ == '__main__':
    sys.exit(main())
