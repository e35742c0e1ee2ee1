"""Run the nodes of a launch file that need their own processes: ``apart_program.py FILE PARENT``.

roslaunch runs them, with the configuration that is pickled in FILE. It ends as roslaunch does, with
REQUIRED_ENDED if a required node has ended, and when the process PARENT is no more.
"""
import os
import pickle
import signal
import sys
import threading
import time

import roslaunch
import roslaunch.parent
import roslaunch.pmon
import roslaunch.rlutil

REQUIRED_ENDED = 3  # the status if a required node has ended


class _Required(roslaunch.pmon.ProcessListener):
    """Hears of the nodes that end."""

    launch, has_ended = None, False

    def process_died(self, process_name, exit_code):
        """Take note; roslaunch calls this before it shuts all others down."""
        process = self.launch.pm.get_process(process_name)
        self.has_ended |= process is not None and process.required


def _end_with(parent):
    while os.getppid() == parent:
        time.sleep(1)
    os.kill(os.getpid(), signal.SIGINT)


def main(path, parent):
    """Run them; returns the exit status."""
    with open(path, 'rb') as file:
        config = pickle.load(file)
    os.unlink(path)
    threading.Thread(target=_end_with, args=[parent], daemon=True).start()
    run_id = roslaunch.rlutil.get_or_generate_uuid(None, False)
    roslaunch.configure_logging(run_id)
    required = _Required()
    required.launch = launch = roslaunch.parent.ROSLaunchParent(
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
