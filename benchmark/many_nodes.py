"""What nodes cost the process they live in, measured in a fresh one; prints its findings as JSON.
See benchmark/nodes.

usage: many_nodes.py COUNT, at the master of ROS_MASTER_URI
"""
import json
import os
import sys
import time

import pharos


def resident():
    """Memory of this process in MB."""
    with open('/proc/self/statm') as file:
        return int(file.read().split()[1]) * os.sysconf('SC_PAGESIZE') / 1e6


def count(what):
    """How many entries /proc has for this process: 'task' for threads, 'fd' for descriptors."""
    return len(os.listdir('/proc/self/' + what))


def create(master, name):
    """One more node."""
    return master.create(pharos.BlockNode, named=name, domain='127.0.0.1')


def main():
    master, names = pharos.Master(), ['/many/n%d' % number for number in range(int(sys.argv[1]))]
    create(master, '/first').stop()  # what is loaded once per process
    before = resident(), count('task'), count('fd')
    begin, each = time.perf_counter(), []
    nodes = []
    for name in names:
        nodes.append(create(master, name))
        each.append(time.perf_counter())
    started = time.perf_counter()
    after = resident(), count('task'), count('fd')
    registered = {
        name for kind in master.system_state() for nodes in kind.values() for name in nodes
    }
    assert registered >= set(names), 'not all nodes are registered'
    stopping = time.perf_counter()
    for node in nodes:
        node.stop()
    stopped = time.perf_counter()
    times = [later - earlier for earlier, later in zip([begin, *each], each)]
    memory, threads, descriptors = [(now - then) / len(names) for now, then in zip(after, before)]
    print(
        json.dumps(
            {
                'start': started - begin,
                'stop': stopped - stopping,
                'time': sorted(times)[len(times) // 2],
                'slowest': max(times),
                'memory': memory,
                'threads': threads,
                'descriptors': descriptors,
            }
        )
    )


if __name__ == '__main__':
    main()
