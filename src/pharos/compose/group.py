"""Run a group of programs in a process of their own: ``python3 -m pharos.compose.group FILE PARENT``.

A composition starts this program for each of its groups. FILE has a pickled Group. The program ends
when its programs have ended, when a required one has, and when the process PARENT has ended.
"""
import os
import pickle
import sys

from pharos.compose.composition import SWITCH_INTERVAL, Composition
from pharos.compose.roslaunch_parent import end_with
from pharos.master import Master


def main(path: str, parent: int) -> int:
    """Run the group in a file, which is removed, and return the exit status of its composition."""
    sys.setswitchinterval(SWITCH_INTERVAL)
    with open(path, 'rb') as file:
        group = pickle.load(file)
    os.unlink(path)
    end_with(parent)
    try:
        master = Master(group.url, group.share_connections, group.shared_memory)
        with Composition(master) as composition:
            composition.start_entries(group.entries)
            return composition.wait()
    except KeyboardInterrupt:
        return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
