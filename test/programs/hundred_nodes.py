"""A hundred nodes, started and stopped; prints what there is before, meanwhile and afterwards."""
import json

from counted import count, master, timed
from pharos import BlockNode


def create(name):
    """A node on the loopback interface."""
    return master.create(BlockNode, named=name, domain='127.0.0.1')


names = ['/many/n%d' % number for number in range(100)]
create('/first').stop()  # what is loaded once per process
before, nodes = count(names), []
started = timed(lambda: nodes.extend(map(create, names)))
running = count(names)
stopped = timed(lambda: [node.stop() for node in nodes])
nodes.clear()
found = {'before': before, 'running': running, 'after': count(names)}
print(json.dumps({**found, 'started': started, 'stopped': stopped}))
