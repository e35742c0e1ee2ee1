"""Launch files, read by roslaunch itself: some of their nodes can run in this process."""
from __future__ import annotations

import os
from typing import Any, Collection, NamedTuple

import rosgraph.names
import rospkg
import roslaunch.config
import roslaunch.core
import roslaunch.launch
import roslaunch.node_args
import roslaunch.pmon
import roslaunch.xmlloader

from pharos.compose.child_process import find_launch_file, no_package
from pharos.compose.sources import forget_files, source_of, why_apart
from pharos.errors import PharosError, UnknownNodeError
from pharos.transcript import Transcript


#: a node with this private parameter belongs to the group of that name
GROUP_PARAMETER = 'pharos_group'
APART_PARAMETER = 'pharos_apart'  # a node with this private parameter True is a plain process


class Entry(NamedTuple):
    """A node of a launch file, or a program, that a composition starts.

    :ivar name: the full name
    :ivar path: the file of the program
    :ivar args: the arguments of the program, with ROS's
    :ivar roslaunch_node: roslaunch's Node; it has no name if the program has no launch file
    :ivar group: the name of the group; '' for the composition's own process
    :ivar is_here: True: in the composition's own process, whatever the program has
    :ivar log: the path of the program's logs, but for their ends
    """

    name: str
    path: str
    args: list[str]
    roslaunch_node: Any
    group: str = ''
    is_here: bool = False
    log: str = ''


class LaunchFile:
    """A launch file with all included files.

    A name of a node may lack its slash, or its namespace. The Transcript shows why a node runs
    as a plain process, or cannot start at all.

    :param url: the URL of the master
    :param package: None: ``file`` is a path
    :param args: names of the launch file's arguments -> values
    :param only: the names of the nodes that run; none: all
    :param apart: the names of nodes that are plain processes
    :param here: the names of nodes that run in this process even if they show windows
    :param groups: lists of names of nodes that run in one process each
    :param screen: True: all nodes have the output 'screen'
    :param is_node: True: roslaunch has started this process as a node; ``args`` that the file does not
        have are remappings in its scope, which hold for all nodes of the file
    :ivar config: roslaunch's configuration
    :ivar entries: an :class:`Entry` for each node of this process and of groups
    :ivar entries_apart: one for each plain process, without its program
    :raises UnknownNodeError: if there is no such package, file, argument or node
    :raises PharosError: if roslaunch cannot read the file
    """

    def __init__(
        self,
        url: str,
        package: str | None,
        file: str,
        args: dict[str, Any],
        only: Collection[str] = (),
        apart: Collection[str] = (),
        here: Collection[str] = (),
        groups: Collection[Collection[str]] = (),
        screen: bool = False,
        is_node: bool = False,
    ) -> None:
        forget_files()
        self.path = find_launch_file(package, file)
        self._read(args, is_node)
        self.config.master.uri = url
        self.entries: list[Entry] = []
        self.entries_apart: list[Entry] = []
        nodes = {
            rosgraph.names.ns_join(node.namespace, node.name): node for node in self.config.nodes
        }
        # a user may leave out the slash, or the namespace
        short_names = {name: {name, name[1:], name.rpartition('/')[2]} for name in nodes}
        given_names = [*only, *apart, *here, *(name for group in groups for name in group)]
        self._check(given_names, set().union(*short_names.values()), 'node')
        for name, node in nodes.items():
            if screen:
                node.output = 'screen'
            if not only or short_names[name] & set(only):
                is_apart = not short_names[name].isdisjoint(apart)
                is_here = not short_names[name].isdisjoint(here)
                group = self._group_of(name, short_names[name], groups)
                self._sort(name, node, is_apart, is_here, group)

    def _read(self, args: dict[str, Any], is_node: bool) -> None:
        loader = roslaunch.xmlloader.XmlLoader()
        arguments = [f'{name}:={value}' for name, value in args.items()]
        try:
            self.config = roslaunch.config.load_config_default(
                [(self.path, arguments)], None, loader=loader, verbose=False
            )
        except Exception as error:  # roslaunch's own, or any other of a substitution in the file
            raise PharosError(f'{self.path}: {error}') from error
        known_args = loader.root_context.resolve_dict.get('arg_doc', {})
        if is_node:
            remaps = [(name, args[name]) for name in args if name not in known_args]
            for node in self.config.nodes:
                node.remap_args = [*node.remap_args, *remaps]
        else:
            self._check(args, known_args, 'arg')

    def _check(self, names: Collection[str], known_names: Collection[str], role: str) -> None:
        for name in names:
            if name not in known_names:
                known_text = ', '.join(sorted(known_names)) or 'none'
                raise UnknownNodeError(f'{self.path} has no {role} {name!r}; it has {known_text}')

    def _group_of(
        self, name: str, short_names: set[str], groups: Collection[Collection[str]]
    ) -> str:
        """Return the name of the group of a node; '' if there is none."""
        for number, group in enumerate(groups, 1):
            if not short_names.isdisjoint(group):
                return f'--group {number}'
        group_name = self._private_parameter(name, GROUP_PARAMETER)
        return group_name and f'the group {group_name}' or ''

    def _private_parameter(self, name: str, parameter_name: str) -> Any:
        parameter = self.config.params.get(f'{name}/{parameter_name}')
        return parameter and parameter.value

    def _sort(self, name: str, node: Any, is_apart: bool, is_here: bool, group: str) -> None:
        """Put a node into the entries, or among those apart."""
        if is_apart or self._private_parameter(name, APART_PARAMETER):
            reason: Any = 'as --apart or pharos_apart says'
        else:
            reason = self._why_apart(node)
        try:
            if not reason:
                command = roslaunch.node_args.create_local_process_args(
                    node, node.machine, env=os.environ
                )
                reason = why_apart(command[0], is_here)
        except Exception as error:  # of roslaunch, or of a program that cannot be read
            is_known = node.package in rospkg.RosPack().list()
            reason = error if is_known else no_package(node.package)
            Transcript.show(f'{name} is not started: {reason}')
            return
        if reason:
            Transcript.show(f'{name} runs as a plain process: {reason}')
            self.entries_apart.append(Entry(name, '', [], node))
            return
        self.entries.append(Entry(name, source_of(command[0]), command[1:], node, group, is_here))

    def _why_apart(self, node: Any) -> str:
        """Return why the launch file wants a process for a node, as text; else ''."""
        if node.launch_prefix:
            return 'it has a launch-prefix'
        if node.cwd:
            return 'it has a cwd'
        if not roslaunch.core.is_machine_local(node.machine):
            return f'it belongs to the machine {node.machine.name}'
        return ''

    def set_parameters(self, run_id: str) -> None:
        """Run the commands of rosparam, and clear and set the parameters, as roslaunch does.

        :param run_id: the /run_id of the master
        :raises PharosError: if a command fails, or the master refuses a parameter
        """
        # this monitor never runs: roslaunch's own would take the signals of this program
        monitor = roslaunch.pmon.ProcessMonitor()
        runner = roslaunch.launch.ROSLaunchRunner(run_id, self.config, pmon=monitor)
        try:
            runner._launch_setup_executables()
            runner._load_parameters()
        except roslaunch.core.RLException as error:
            raise PharosError(f'{self.path}: {error}') from error

    def config_of(self, entries: list[Entry]) -> Any:
        """Return a configuration with nothing but some nodes, for a process of roslaunch."""
        config = roslaunch.config.ROSLaunchConfig()
        config.master = self.config.master
        config.machines = self.config.machines
        config.nodes = [entry.roslaunch_node for entry in entries]
        config.assign_machines()
        return config
