"""The program that runs what of a launch file is not for this process: ``apart_program.py FILE
PARENT``.

roslaunch runs it, with the configuration that is pickled in FILE, of which its own loader has read
the launch file. It ends as roslaunch does, with REQUIRED_ENDED where a required node has, and when
the process PARENT is no more.
"""
import os
import pickle
import signal
import sys
import threading
import time
from typing import Any

import roslaunch
import roslaunch.launch
import roslaunch.parent
import roslaunch.pmon
import roslaunch.rlutil

POLL = 1.0  # seconds between two looks whether the parent is there
REQUIRED_ENDED = 3  # the status where a required node has ended


class _Required(roslaunch.pmon.ProcessListener):
    """Hears of the nodes that end."""

    def __init__(self) -> None:
        self.launch: Any = None
        self.has_ended = False

    def process_died(self, process_name: str, exit_code: int) -> None:
        """Called by roslaunch, before it shuts all others down."""
        process = self.launch.pm.get_process(process_name)
        self.has_ended = self.has_ended or process is not None and process.required


class _Runner(roslaunch.launch.ROSLaunchRunner):
    """roslaunch's, for which a program that the system cannot start is no reason to start no other."""

    def launch_node(self, node: Any, core: bool = False) -> Any:
        """See roslaunch; its monitor finds the process dead, and ends all if it is required."""
        try:
            return super().launch_node(node, core)
        except roslaunch.pmon.FatalProcessLaunch as error:
            print(f'{node.namespace}{node.name} is not started: {error}', file=sys.stderr)
            return node.name, False


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(POLL)
    os.kill(os.getpid(), signal.SIGINT)


def main(path: str, parent: int) -> int:
    """Run it; returns the exit status."""
    with open(path, 'rb') as file:
        config = pickle.load(file)
    os.unlink(path)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    run_id = roslaunch.rlutil.get_or_generate_uuid(None, False)
    roslaunch.configure_logging(run_id)
    roslaunch.launch.ROSLaunchRunner = _Runner
    required = _Required()
    launch = required.launch = roslaunch.parent.ROSLaunchParent(
        run_id, [], process_listeners=[required], show_summary=False
    )
    launch.config = config
    try:
        launch.start()
        launch.spin()
    except roslaunch.RLException as error:
        print(f'roslaunch: {error}', file=sys.stderr)
        return 1
    return REQUIRED_ENDED if required.has_ended else 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
