"""What a program of nodes leaves behind, counted."""
import gc
import os
import threading
import time

import pharos

LIMIT = 20  # seconds; a bound on waits for what comes

master = pharos.Master()
# threads that no Python started: some builds of numpy have a pool of them
FOREIGN = len(os.listdir('/proc/self/task')) - threading.active_count()


def resident():
    """Memory of this process in MB."""
    with open('/proc/self/statm') as file:
        return int(file.read().split()[1]) * os.sysconf('SC_PAGESIZE') / 1e6


def count(names):
    """What nodes of these names may leave behind; threads are the kernel's, not only those that
    Python knows."""
    gc.collect()
    for thread in threading.enumerate():
        if thread.name.startswith('watcher') and not pharos.node_registry.nodes():
            # it watches the master while there are nodes, and ends once it sees that there are none
            thread.join(LIMIT)
    deadline = time.monotonic() + LIMIT
    while len(os.listdir('/proc/self/task')) > threading.active_count() + FOREIGN:
        if time.monotonic() > deadline:
            break
        threading.Event().wait(0.001)  # a thread that was joined has still to leave the kernel
    open_files = []
    for descriptor in os.listdir('/proc/self/fd'):
        try:
            open_files.append(os.readlink('/proc/self/fd/' + descriptor).partition(':')[0])
        except FileNotFoundError:
            pass  # that of the listing
    return {
        'threads': len(os.listdir('/proc/self/task')),
        'sockets': open_files.count('socket'),
        'descriptors': len(open_files),
        'registrations': registrations(names),
    }


def registrations(names):
    """How often nodes of these names are registered."""
    return sum(
        nodes.count(name)
        for kind in master.system_state()
        for nodes in kind.values()
        for name in names
    )


def cpu_share():
    """The share of a core that is used while nothing happens."""
    begin = time.process_time(), time.monotonic()
    threading.Event().wait(0.5)
    return (time.process_time() - begin[0]) / (time.monotonic() - begin[1])


def timed(block):
    """The seconds that it takes."""
    begin = time.monotonic()
    block()
    return time.monotonic() - begin
