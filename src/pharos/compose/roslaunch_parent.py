"""Run the nodes of a launch file that need their own processes: ``roslaunch_parent.py FILE PID``.

roslaunch runs these nodes. FILE has roslaunch's configuration, pickled. The program ends as
roslaunch does, and also if its parent, the process PID, has ended.
"""
import os
import pickle
import signal
import sys
import threading
import time
from typing import Any


PARENT_PERIOD = 1.0  # seconds between two looks at the parent


def receive(path: str, parent: int) -> Any:
    """Return the object that the parent has pickled in a file, and delete the file.

    From now on, SIGINT and the end of the parent end this process, as Ctrl-C does.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_PERIOD)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=watch, daemon=True).start()
    with open(path, 'rb') as file:
        os.remove(path)
        parcel = pickle.load(file)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])  # the parent has blocked it
    return parcel


def main(path: str, parent: int) -> int:
    """Run the nodes, and return the exit status.

    :param path: the file with the pickled configuration
    :param parent: the number of the parent process
    """
    interrupts = []
    signal.signal(signal.SIGINT, lambda *_: interrupts.append(True))
    import roslaunch.parent
    import roslaunch.rlutil

    config = receive(path, parent)
    run_id = roslaunch.rlutil.get_or_generate_uuid(None, False)
    roslaunch.configure_logging(run_id)
    launch = roslaunch.parent.ROSLaunchParent(run_id, [], show_summary=False)
    launch.config = config
    # roslaunch's own handler waits 20 s for a lock that the start may hold
    roslaunch.pmon._sig_initialized = True
    try:
        if not interrupts:
            launch.start()
        signal.signal(signal.SIGINT, roslaunch.pmon.rl_signal)
        if not interrupts:
            launch.spin()
    except roslaunch.RLException as error:
        print(f'roslaunch: {error}', file=sys.stderr)
        return 1
    finally:
        launch.shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
