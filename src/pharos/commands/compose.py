"""The command compose."""
from __future__ import annotations

import contextlib
import os
import pathlib
import sys
import tempfile
import threading
import time
import urllib.parse
from typing import Any

import rospkg

from pharos import Master, PharosError
from pharos.commands import argument_parser, run_command
from pharos.compose.composition import Composition, leave
from pharos.compose.control import reload_on_save
from pharos.compose.launch_file import LaunchFile

# of the start: both change to what the robot needs
FOLDER = os.getcwd()
ENVIRONMENT = dict(os.environ)
SMALL = 0.01  # a tolerance; smaller differences may hide a larger one that comes later
#: options that take names -> help
NAMES = {
    'script': 'programs to run',
    'only': 'of the file, these nodes alone',
    'apart': 'these as plain processes',
    'here': 'these here, though they show windows',
    'topics': 'of the bag, these topics alone',
}
#: options that take a bag -> help
BAGS = {
    'bag': 'virtual time: play this',
    'record': 'in virtual time: write what nodes publish to this bag',
    'expect': 'in virtual time: show what differs from this recording',
}
#: options without a value -> help
SWITCHES = {
    'own-connections': 'nodes that hear one topic of one process have a connection each',
    'reload': 'saved files take effect at once',
    'screen': "all nodes have output='screen'",
}


def compose(arguments: list[str]) -> int:
    """Run the Python nodes of a launch file, or several programs, unmodified, in one process.

      compose PKG FILE.launch [arg:=value ...]     as roslaunch; nodes that are not Python run apart
      compose FILE.launch [arg:=value ...]         the same, by its path
      compose --script PKG/EXECUTABLE ... [_rate:=5 old:=new ...]    programs, as rosrun runs them
      compose talker.py ...                        the same, by paths
      compose --bag drive.bag --record out.bag PKG FILE.launch    in virtual time, as fast as it goes
      compose --at 12.3 PKG FILE.launch            a prompt at this second, while the robot stands still

    Programs with windows, and those with a state that a process has but once, run as plain processes; a line
    says which and why. It ends when all nodes have ended, or by Ctrl-C.

    --for and --at count from the begin: programs start shortly after it, so a beat each second comes shortly
    after each second.
    """
    options = _parse(arguments)
    mappings = [each for each in sys.argv if ':=' in each]
    # roslaunch has started this as a node; its programs have names and logs of their own
    options.is_node = any(each.startswith('__log:=') for each in mappings)
    if options.is_node:
        mappings = [each for each in mappings if not each.startswith(('__name:=', '__log:='))]
    with contextlib.ExitStack() as stack:
        status = _run(stack, options, mappings)
    return status


def _parse(arguments):
    parser = argument_parser(compose)
    parser.add_argument('file', nargs='*', help='PKG FILE.launch, or its path alone')
    for name, text in NAMES.items():
        parser.add_argument(f'--{name}', nargs='+', default=[], help=text)
    parser.add_argument(
        '--group', nargs='+', action='append', default=[], help='these in one other process'
    )
    for name, text in SWITCHES.items():
        parser.add_argument(f'--{name}', action='store_true', help=text)
    for name, text in BAGS.items():
        parser.add_argument(f'--{name}', type=os.path.abspath, help=text)  # type: ignore
    parser.add_argument(
        '--for', type=float, dest='seconds', help='in virtual time: end at this second; no bag'
    )
    parser.add_argument('--at', type=float, help='in virtual time: a prompt at this second')
    parser.add_argument(
        '--tolerance',
        type=float,
        default=0.0,
        help='with --expect: numbers and times may differ so',
    )
    parser.add_argument(
        '--seed', type=int, default=0, help='in virtual time: other delays, by chance'
    )
    parser.add_argument(
        '--jitter',
        type=float,
        default=0.03,
        help='with a seed: seconds that a sleep is late at most',
    )
    options = parser.parse_args(arguments)
    if options.file and options.file[0].endswith('.py'):
        options.script = options.file
        options.file = []
    names_nodes = options.only or options.apart or options.group
    if not (options.file or options.script):
        parser.error('give a launch file, or programs')
    if options.script and (options.file or names_nodes) or len(options.file) > 2:
        parser.error('give one launch file, by package and name or by its path, first; or --script')
    if options.at is not None and (options.expect or options.seconds):
        parser.error('--at opens a prompt: leave out --for and --expect, or --at')
    return options


def _run(stack, options, mappings):
    """Run as the options say, and return the exit status; the stack ends all."""
    master = Master(share_connections=not options.own_connections)
    simulation = None
    if options.bag or options.seconds or options.at is not None:
        _fix_hashes(options.seed)
        # at a master of its own: a robot that runs at the usual one must not hear this
        master = stack.enter_context(Master.embedded())
        os.environ['ROS_MASTER_URI'] = master.url
        # before the composition, whose locks are to be virtual, too
        simulation = _begin_simulation(stack, master, options)
    elif options.record or options.expect or options.seed:
        raise ValueError('--record, --expect and --seed go with --bag, --for or --at')
    elif not master.is_reachable():
        port: Any = urllib.parse.urlsplit(master.url).port
        print(f'no ROS master at {master.url}: it is started here')
        stack.enter_context(Master.embedded(port))
    composition = stack.enter_context(Composition(master, owns_process=True))
    if options.reload:  # also what is saved while the programs start
        composition.reloads = True
        threading.Thread(target=reload_on_save, args=[composition], daemon=True).start()
    if options.file:
        composition.launch(_read_launch_file(master.url, options, mappings))
    else:
        composition.run_scripts(options.script, mappings, options.here)
    if not simulation:
        return composition.wait()
    if options.at is None:
        _simulate(simulation, options)
    else:
        _open_prompt(simulation, options, stack.close)
    deadlocks = simulation.deadlocks()
    for text in deadlocks:
        print(f'waits for a lock for ever: {text}')
    composition.stopping.set()  # its wait() returns at once, with the status
    status = composition.wait() or int(bool(deadlocks))
    if options.expect and _show_differences(simulation, options):
        return 1
    return status


def _show_differences(simulation, options):
    """Show what the run has published otherwise than a recording; return True if there is something."""
    from pharos.simulation import open_bag
    from pharos.simulation.comparing import differences

    def lines_of(tolerance):
        begin, end = simulation.begin / 1e9, simulation.seconds
        return differences(options.expect, options.record, begin, tolerance, end)

    lines = lines_of(options.tolerance)
    if lines:
        print('\n'.join(lines))
        left = lines_of(max(SMALL, options.tolerance))
        if not left:
            print(f'none by --tolerance {SMALL}')
        elif left != lines:
            print(f'the first by --tolerance {SMALL}: {left[0]}')
        if simulation.lost:
            print(f'this run was not exact, since {simulation.lost} lost the turn: run it again')
        return True
    with open_bag(options.expect) as bag:
        topics = bag.get_type_and_topic_info()[1]
        print(f'as {options.expect}: {bag.get_message_count()} messages of {len(topics)} topics')
    return False


def _fix_hashes(seed):
    """Start this command anew, unless the order of its sets of texts is that of the seed."""
    number = str(seed % 2**32)
    if ENVIRONMENT.get('PYTHONHASHSEED') != number:
        ENVIRONMENT['PYTHONHASHSEED'] = number
        _start_again()


def _start_again(*options):
    """Start this command anew, in this process, with options after those that it has."""
    command = pathlib.Path('/proc/self/cmdline').read_bytes().split(b'\0')[:-1]
    os.chdir(FOLDER)
    os.execve(sys.executable, [*command, *options], ENVIRONMENT)


def _begin_simulation(stack, master, options):
    """Make the time virtual, and return the Simulation.

    The time begins a second before the bag: the programs have started at its first message.
    """
    from pharos.simulation import Simulation, open_bag

    simulation = Simulation(master)
    options.end_progress = threading.Event()
    if sys.stderr.isatty():  # a thread from before takes no part
        arguments = simulation, options.end_progress
        threading.Thread(target=_show_progress, args=arguments, daemon=True).start()
    stack.enter_context(simulation)
    stack.callback(options.end_progress.set)
    simulation.seed(options.seed, options.jitter)
    if options.bag:
        with open_bag(options.bag) as bag:
            # at least 1 s: a ROS time of 0 is one that is not set
            simulation.nanoseconds = round((max(2, bag.get_start_time()) - 1) * 10**9)
    simulation.begin = simulation.nanoseconds
    if options.expect:
        if not os.path.isfile(options.expect):
            raise ValueError(f'there is no {options.expect}: make it by --record {options.expect}')
        if not options.record:
            folder = stack.enter_context(tempfile.TemporaryDirectory())
            options.record = f'{folder}/actual.bag'
    if options.record:
        if options.record in (options.bag, options.expect):
            raise ValueError(f'{options.record} is read: record to another file')
        simulation.record_to(options.record)
        stack.callback(simulation.close_record)
    return simulation


def _show_progress(simulation, ended):
    """Show the time on the terminal, in one line, unless it stands still at a prompt."""
    while not ended.wait(1):
        seconds = simulation.seconds
        has_ended = ended.wait(0.05)
        if simulation.seconds > seconds and not has_ended:
            print(f'{seconds:.0f} s of ROS time', end='\r', file=sys.stderr)


def _simulate(simulation, options):
    """Play the bag, or let the time go by; show how long the command has computed."""
    if options.bag:
        simulation.play(options.bag, options.topics)
    else:
        simulation.at(options.seconds)
    simulation.close_record()
    print(
        f'{simulation.seconds:.1f} s of ROS time took {time.process_time():.1f} s of CPU;'
        f' lost: {simulation.lost}'
    )


def _open_prompt(simulation, options, close):
    """Go to a time, and open a prompt."""
    from pharos.simulation.time_travel import Prompt

    def play():
        try:
            simulation.play(options.bag, options.topics)
        except PharosError as error:
            simulation.fail(error)

    def go_back(seconds):
        close()
        _start_again('--at', str(seconds))

    if options.bag:
        threading.Thread(target=play, daemon=True).start()
    simulation.at(max(options.at, simulation.seconds))  # the start may have taken some time
    options.end_progress.set()
    Prompt(simulation, go_back).interact()


def _read_launch_file(url, options, mappings):
    """Return the launch file; its nodes run in the folder where roslaunch runs them."""
    args = dict(each.split(':=', 1) for each in mappings if not each.startswith('_'))
    package = options.file[0] if len(options.file) == 2 else None
    names = options.only, options.apart, options.here, options.group
    launch_file = LaunchFile(
        url, package, options.file[-1], args, *names, options.screen, options.is_node
    )
    home = rospkg.get_ros_home()
    os.makedirs(home, exist_ok=True)
    os.chdir(home)
    return launch_file


if __name__ == '__main__':
    sys.exit(leave(run_command('compose')))
