"""Launch files, read by roslaunch itself, and which of their nodes can run in this process."""
import copy
import os

import rosgraph.names
import roslaunch.config
import roslaunch.core
import roslaunch.launch
import roslaunch.node_args
import roslaunch.pmon
import roslaunch.xmlloader

from pharos.compose.script import source_of, why_apart
from pharos.errors import PharosError, UnknownNodeError
from pharos.ros_process import find_launch_file
from pharos.transcript import Transcript


class LaunchFile:
    """A launch file and all that it includes.

    :param args: its arguments
    :param only: the names of the nodes that are wanted; none: all
    :param apart: the names of those that are to run in processes of their own
    :param in_here: the names of those that are to run in this process though they show windows
    :ivar config: roslaunch's configuration
    :ivar here: a tuple for each node of this process: name, program, arguments, roslaunch's node
    :ivar apart: roslaunch's nodes for other processes
    :ivar reasons: names of these -> why
    :raises UnknownNodeError: if there is no such package, file, argument or node
    :raises PharosError: if roslaunch cannot read it
    """

    def __init__(self, url, package, file, args, only=(), apart=(), in_here=()):
        self.path = find_launch_file(package, file)
        loader = roslaunch.xmlloader.XmlLoader()
        given = [f'{name}:={value}' for name, value in args.items()]
        try:
            self.config = roslaunch.config.load_config_default(
                [(self.path, given)], None, loader=loader, verbose=False
            )
        except Exception as error:  # roslaunch's, or of what it asks
            raise PharosError(f'{self.path}: {error}') from error
        self._check(args, loader.root_context.resolve_dict.get('arg_doc', {}), 'arg')
        self.config.master.uri = url
        self.here = []
        self.apart = []
        self.reasons = {}
        nodes = {
            rosgraph.names.ns_join(node.namespace, node.name): node for node in self.config.nodes
        }
        names = {name: {name, name[1:], name.rpartition('/')[2]} for name in nodes}
        self._check([*only, *apart, *in_here], set().union(*names.values()), 'node')
        for name, node in nodes.items():
            if not only or names[name] & set(only):
                is_apart = not names[name].isdisjoint(apart)
                is_here = not names[name].isdisjoint(in_here)
                self._sort(name, node, is_apart, is_here)

    def _check(self, names, known, kind):
        for name in names:
            if name not in known:
                has = ', '.join(sorted(known)) or 'none'
                raise UnknownNodeError(f'{self.path} has no {kind} {name!r}; it has {has}')

    def _sort(self, name, node, is_apart, is_here):
        try:
            reason = self._why_apart(node, is_apart)
            if not reason:
                command = roslaunch.node_args.create_local_process_args(
                    node, node.machine, env=os.environ
                )
                reason = why_apart(command[0], is_here)
        except Exception as error:  # roslaunch's, or of what it asks
            Transcript.show(f'{name} is not started: {error}')
            return
        if reason:
            self.reasons[name] = reason
            self.apart.append(node)
        else:
            self.here.append((name, source_of(command[0]), command[1:], node))

    def _why_apart(self, node, is_apart):
        """Return why the launch file or --apart wants a process for a node; '' if nothing does."""
        if is_apart:
            return 'as --apart says'
        if node.launch_prefix:
            return 'it has a launch-prefix'
        if node.cwd:
            return 'it has a cwd'
        if not roslaunch.core.is_machine_local(node.machine):
            return f'it belongs to the machine {node.machine.name}'
        return ''

    def set_parameters(self, run_id):
        """Run what is to run before, clear and set the parameters, as roslaunch does.

        :raises PharosError: if a command fails, or the master refuses
        """
        # with a monitor that never runs: roslaunch's own takes the signals of the program
        monitor = roslaunch.pmon.ProcessMonitor()
        runner = roslaunch.launch.ROSLaunchRunner(run_id, self.config, pmon=monitor)
        try:
            runner._launch_setup_executables()
            runner._load_parameters()
        except roslaunch.core.RLException as error:
            raise PharosError(f'{self.path}: {error}') from error

    def config_apart(self):
        """Return the configuration that is left for roslaunch: the nodes apart alone."""
        rest = copy.copy(self.config)
        rest.nodes, rest.nodes_core, rest.tests, rest.executables = self.apart, [], [], []
        rest.params, rest.clear_params, rest.config_errors = {}, [], []
        return rest
