"""Nodes that are started until the system gives no more threads; prints what was said, and whether
those that run go on.

What they lack is addresses for their stacks, which are large here, so that there are enough for all
else.
"""
import ctypes
import json
import os
import resource
import threading

from counted import master
from pharos import BlockNode, PharosError
from pharos.testing import TIMEOUT

STACK = 256 << 20  # bytes
THREADS = 20  # for which there is room
M_ARENA_MAX = -8


def create(number):
    return master.create(BlockNode, named=f'/limited/n{number}', domain='127.0.0.1')


heard = threading.Event()
nodes = [create(0), create(1)]
nodes[1].interested_in('/limited/t', 'std_msgs/Int32', lambda message, channel: heard.set())
nodes[0].send_to('/limited/t', data=1)
assert heard.wait(TIMEOUT)
heard.clear()
ctypes.CDLL(None).mallopt(M_ARENA_MAX, 1)  # else each thread takes addresses for its memory, too
threading.stack_size(STACK)
with open('/proc/self/statm') as file:
    taken = int(file.read().split()[0]) * os.sysconf('SC_PAGESIZE')
limit = taken + THREADS * STACK + STACK // 2
resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
try:
    while len(nodes) < 500:
        nodes.append(create(len(nodes)))
    said = None
except PharosError as error:
    said = str(error)
count = len(nodes)
state = str(master.system_state())
nodes[0].send_to('/limited/t', data=2)
goes_on = heard.wait(TIMEOUT)
nodes.pop().stop()
nodes.append(create(count))  # what was stopped has left its threads to this one
running = all(node.is_running for node in nodes)
for node in nodes:
    node.stop()
found = {'said': said, 'count': count, 'goes on': goes_on and running}
print(json.dumps({**found, 'is left': f'/limited/n{count}/' in state}))
