"""Launch files, read by roslaunch itself, and which of their nodes can run in this process."""
import copy
import os
import re

import rosgraph.names
import roslaunch.config
import roslaunch.core
import roslaunch.launch
import roslaunch.node_args
import roslaunch.pmon
import roslaunch.xmlloader

from pharos.compose.script import source_of
from pharos.errors import PharosError, UnknownNodeError
from pharos.ros_process import find_launch_file
from pharos.transcript import Transcript

_PYTHON = re.compile(r'#!.*\bpython(3(\.\d+)?)?\b')
_USES_PHAROS = re.compile(r'^\s*(from|import) pharos\b', re.MULTILINE)


class LaunchFile:
    """A launch file and all that it includes.

    :param args: its arguments
    :param only: the names of the nodes that are wanted; none: all
    :param apart: the names of those that are to run in processes of their own
    :ivar config: roslaunch's configuration
    :ivar here: a tuple for each node of this process: name, program, arguments, roslaunch's node
    :ivar apart: roslaunch's nodes for other processes
    :raises UnknownNodeError: if there is no such package, file, argument or node
    :raises PharosError: if roslaunch cannot read it
    """

    def __init__(self, url, package, file, args, only, apart):
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
        nodes = {
            rosgraph.names.ns_join(node.namespace, node.name): node for node in self.config.nodes
        }
        names = {name: {name, name[1:], name.rpartition('/')[2]} for name in nodes}
        self._check([*only, *apart], set().union(*names.values()), 'node')
        for name, node in nodes.items():
            if names[name] & set(only) or not only:
                self._sort(name, node, bool(names[name] & set(apart)))

    def _check(self, names, known, kind):
        for name in names:
            if name not in known:
                has = ', '.join(sorted(known)) or 'none'
                raise UnknownNodeError(f'{self.path} has no {kind} {name!r}; it has {has}')

    def _sort(self, name, node, is_apart):
        is_apart |= bool(node.launch_prefix or node.cwd)
        if is_apart or not roslaunch.core.is_machine_local(node.machine):
            return self.apart.append(node)
        try:
            command = roslaunch.node_args.create_local_process_args(
                node, node.machine, env=os.environ
            )
        except Exception as error:  # roslaunch's, or of what it asks
            return Transcript.show(f'{name} is not started: {error}')
        if not can_run_here(command[0]):
            return self.apart.append(node)
        self.here.append((name, source_of(command[0]), command[1:], node))

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


def can_run_here(path):
    """True if a program is written in Python, and does not make its nodes itself with pharos."""
    with open(path, errors='replace') as file:
        if not _PYTHON.match(file.readline(256)):
            return False
    with open(source_of(path), errors='replace') as file:
        return not _USES_PHAROS.search(file.read())
