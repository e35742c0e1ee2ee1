"""Run a group of programs in a process of their own: ``python3 -m pharos.compose.group FILE PARENT``.

A composition starts this program for each of its groups. FILE has the pickled list of entries. The
environment names the master; with PHAROS_RELOAD=1, saved files take effect at once. The program
ends when its programs have ended, when a required one has, and when the process PARENT has ended.
"""
import os
import sys
import threading

from pharos.compose.composition import Composition, leave
from pharos.compose.control import reload_on_save
from pharos.compose.roslaunch_parent import receive
from pharos.master import Master


def main(path: str, parent: int) -> int:
    """Run the group in a file, and return the exit status of its composition."""
    try:
        master = Master(share_connections=os.environ['PHAROS_SHARE_CONNECTIONS'] == '1')
        entries = receive(path, parent)
        with Composition(master, owns_process=True) as composition:
            if os.environ.pop('PHAROS_RELOAD') == '1':
                threading.Thread(target=reload_on_save, args=[composition], daemon=True).start()
            composition.start_entries(entries)
            return composition.wait()
    except KeyboardInterrupt:
        return 0


if __name__ == '__main__':
    sys.exit(leave(main(sys.argv[1], int(sys.argv[2]))))
