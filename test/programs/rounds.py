"""A node that is used, stopped and started again, as often as the argument says; prints what each
round left."""
import json
import queue
import random
import socket
import sys
import threading

from counted import LIMIT, count, cpu_share, master, resident, timed
from pharos import BlockNode


def free_port():
    """One that the system gives to nobody else while the node is stopped."""
    with open('/proc/sys/net/ipv4/ip_local_port_range', encoding='ascii') as file:
        below = int(file.read().split()[0])
    while True:
        port = random.randrange(10000, below)
        try:
            socket.create_server(('127.0.0.1', port)).close()
            return port
        except OSError:
            pass  # it is taken


rounds = int(sys.argv[1])
received, turned = queue.SimpleQueue(), threading.Event()
node = master.create(
    BlockNode,
    named='/round',
    domain='127.0.0.1',
    tcp_port=free_port(),
    xmlrpc_port=free_port(),
    delegate=lambda message, channel: received.put(message.data),
)
ports = node.tcp_port, node.xmlrpc_port


def soul(me):
    for _ in me.every(0.01):
        turned.set()


node.interested_in('/in', 'std_msgs/Int32')
node.serve('/double', 'roscpp/GetLoggers', lambda request: [])
node.output_channel('/out', 'std_msgs/Int32')
stops, counts, memory = [], [], []
for number in range(rounds):
    turned.clear()
    node.fork(soul)
    node.send_to('/out', data=number)
    assert received.get(timeout=LIMIT) == 7  # from the other process, latched
    assert turned.wait(LIMIT)
    master.lookup_service('/double', '/round').call(timeout=LIMIT)
    stops.append(timed(node.stop))
    assert not node.errors, node.errors
    counts.append(count(['/round']))
    memory.append(resident())
    assert (node.tcp_port, node.xmlrpc_port) == ports
    if number < rounds - 1:
        node.start()
stopped_cpu = cpu_share()
node.start()
running_cpu = cpu_share()
node.stop()
found = {'counts': counts, 'stops': stops, 'memory': memory, 'cpu': [stopped_cpu, running_cpu]}
print(json.dumps(found))
