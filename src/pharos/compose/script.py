"""Scripts: programs of rospy that run unmodified as nodes of this process."""
from __future__ import annotations

import os
import pathlib
import re
from typing import Any

from rosgraph.names import ns_join

from pharos import signals
from pharos.compose.child_process import find_program
from pharos.compose.script_run import ScriptRun
from pharos.compose.sources import forget_files, needs_process, source_of
from pharos.errors import PharosError, UnknownNodeError
from pharos.node import Node
from pharos.private_rospy.run import Lifecycle
from pharos.waiting import wait


class ScriptNode(Node):
    """A program of rospy, unmodified, as a node of this process; made by :meth:`Master.load`.

    Each start runs the program from its first line, in a thread of its own. The program's call of
    ``rospy.init_node`` registers the node. :meth:`stop` ends the program as Ctrl-C does. The node
    stops when the program has ended.

    :param params: names of private parameters -> values; set before the node is registered
    :param env: environment variables of the program: pairs, or a dict
    :ivar path: the file of the program
    :ivar args: the program's arguments, with ROS's
    :ivar exit_code: the exit status that the program's process would have; None while it runs
    """

    #: seconds that a start waits for the program to call ``rospy.init_node``, or to end
    init_timeout = 10.0
    #: seconds that :meth:`stop` waits for the program, as long as roslaunch waits after its SIGINT
    stop_timeout = 15.0
    exit_code: int | None = None
    owns_process = False  # True: the process's environment is the program's
    output_file = ''  # what the program prints goes there; '': to the terminal
    _run_class = ScriptRun
    _current_run: ScriptRun
    roslaunch_node: Any = None  # roslaunch's Node, if the program comes from a launch file
    _has_own_start = True  # the program itself opens its endpoints at each start

    def __init__(
        self, path: str, args: list[str], params: dict | None = None, env: Any = ()
    ) -> None:
        self.path = path
        self.args = args
        self.params = params or {}
        self.env = dict(env)
        self.created_names = set()  # of nodes that the program has created with pharos
        self._settings.remappings = args

    def __repr__(self) -> str:
        return f'<{type(self).__name__} {self._settings.name} {self.lifecycle.value} {self.path}>'

    def wait(self, timeout: float | None = None) -> int | None:
        """Wait until the program has ended, or Ctrl-C, and return its :attr:`exit_code`.

        :param timeout: seconds, None: without limit
        :raises TimeoutError: if the program has not ended in time
        """
        wait_for_end(lambda: self.lifecycle is Lifecycle.STOPPED, timeout, self.name)
        return self.exit_code


def wait_for_end(predicate: Any, timeout: float | None, name: str) -> None:
    """Wait until ``predicate()`` is true, or Ctrl-C.

    :param name: the name of the thing that must end, for the error
    :raises TimeoutError: if ``predicate()`` is not true within ``timeout`` seconds
    """
    with signals.QuietWait():
        has_ended = wait(predicate, timeout)
        if not has_ended:
            raise TimeoutError(f'{name} has not ended within {timeout:g} s: stop() it')


def load(
    master: Any,
    package: str,
    executable: str | None,
    args: tuple,
    name: str | None,
    namespace: str | None,
    remap: dict[str, str],
    params: dict[str, Any] | None,
    here: bool,
) -> ScriptNode:
    """Do the work of :meth:`Master.load`."""
    path = os.path.abspath(package) if executable is None else find_program(package, executable)
    if not os.path.isfile(path):
        raise UnknownNodeError(f'there is no file {path}: give a path, or a package and a program')
    forget_files()
    reason = '' if here else needs_process(path)
    if reason:
        raise PharosError(
            f'{path} needs a process of its own: {reason}. Start it by master.run(), or'
            ' load(..., here=True)'
        )
    arguments = [*map(str, args)]
    arguments += [f'{old_name}:={new_name}' for old_name, new_name in remap.items()]
    if name:
        node_name = name
        arguments.append(f'__name:={name.rpartition("/")[2]}')
    else:
        node_name = name_of_file(path)
    if namespace:
        node_name = ns_join(namespace, node_name)
    return master.create(ScriptNode, node_name, path=source_of(path), args=arguments, params=params)


def name_of_file(path: str) -> str:
    """Return the name of a program's node until the program calls ``rospy.init_node``."""
    return re.sub(r'\W|^(?=[^A-Za-z])', 'x', pathlib.Path(path).stem)
