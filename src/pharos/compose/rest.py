"""What of a launch file roslaunch does: its parameters, and the nodes that run apart."""
import contextlib
import os
import pickle
import signal
import subprocess
import sys
import tempfile
from typing import TYPE_CHECKING, Any, List

import rosgraph.names
import roslaunch.core
import roslaunch.launch
import roslaunch.pmon

from pharos.compose import rest_program
from pharos.errors import PharosError
from pharos.external_node import ExternalNode
from pharos.ros_process import RosProcess
from pharos.transcript import Transcript

if TYPE_CHECKING:
    from pharos.master import Master

END_TIMEOUT = 5.0  # seconds that roslaunch may take to end its nodes in its own manner


def run_id_of(master: 'Master') -> str:
    """The identifier that all launches at a master have in common, and their folder of logs."""
    parameters = master.parameters
    if '/run_id' not in parameters:
        parameters['/run_id'] = roslaunch.core.generate_run_id()
    return str(parameters['/run_id'])


class ParameterSetter(roslaunch.launch.ROSLaunchRunner):
    """roslaunch's runner, which sets the parameters of a configuration and starts nothing."""

    def __init__(self, run_id: str, config: Any) -> None:
        # a monitor of its own, that never runs: roslaunch's takes the signals of the program
        super().__init__(run_id, config, pmon=roslaunch.pmon.ProcessMonitor())

    def set_all(self) -> None:
        """Run what is to run before (rosparam's delete and dump), clear and set the parameters.

        :raises roslaunch.core.RLException: if a command fails, or the master refuses
        """
        self._launch_setup_executables()
        self._load_parameters()


def start_rest(master: 'Master', config: Any) -> RosProcess:
    """Have roslaunch run a configuration, in a process of its own."""
    with tempfile.NamedTemporaryFile('wb', suffix='.launch', delete=False) as file:
        pickle.dump(config, file)
    # as a file and not as a module: PYTHONPATH is for the nodes as it is
    command = [sys.executable, rest_program.__file__, file.name, str(os.getpid())]
    return RosProcess(command, master, Transcript.show)


def stop_rest(process: RosProcess) -> None:
    """End it as Ctrl-C does, which ends its nodes in order, and else as every RosProcess."""
    if process.poll() is None:
        os.kill(process.pid, signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(END_TIMEOUT)
    process.terminate()


def shut_down(master: 'Master', names: List[str]) -> None:
    """Ask nodes to end, as rosnode kill does."""
    for name in names:
        with contextlib.suppress(PharosError):  # it is none, or is gone
            ExternalNode(master, name).shutdown()


def names_of(config: Any) -> List[str]:
    """The full names of the nodes of a configuration."""
    return [rosgraph.names.ns_join(node.namespace, node.name) for node in config.nodes]
