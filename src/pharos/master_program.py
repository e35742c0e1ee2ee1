"""The program of an embedded master: ``python3 -m pharos.master_program PORT PARENT``.

It prints its URL, or 'busy' and why. It ends when its standard input does, or the process PARENT,
whose forks may hold the other end of that.
"""
import contextlib
import logging
import os
import select
import socket
import sys

import rosgraph.network
import rosmaster.master

from pharos.master import Master
from pharos.node import BlockNode

POLL = 1.0  # seconds between two looks whether the parent is there


def main(port: int, parent: int) -> None:
    """Run rosmaster, with a /rosout that passes the log lines on to /rosout_agg as ROS's does."""
    answers, sys.stdout = sys.stdout, sys.stderr  # rospy prints log lines on standard output
    # they tell of every node that just stopped, and of each connection that was cut off
    for name in 'rosmaster', 'xmlrpc':
        logging.getLogger(name).addHandler(logging.NullHandler())
    try:
        family = socket.AF_INET6 if rosgraph.network.use_ipv6() else socket.AF_INET
        # rosmaster waits for ever where its port is taken
        socket.create_server((rosgraph.network.get_bind_address(), port), family=family).close()
    except OSError as error:
        print('busy', error.strerror, file=answers, flush=True)
        return
    server = rosmaster.master.Master(port=port)
    server.start()
    host = os.environ.get('ROS_HOSTNAME') or os.environ['ROS_IP']
    master = Master(f'http://{host}:{server.master_node.port}/')
    rosout = master.create(BlockNode, named='/rosout')
    aggregate = rosout.output_channel('/rosout_agg', 'rosgraph_msgs/Log')
    rosout.interested_in(
        '/rosout', 'rosgraph_msgs/Log', delegate=lambda message, channel: aggregate.publish(message)
    )
    # roscore tells it, too
    master.parameters['/rosdistro'] = os.environ.get('ROS_DISTRO', 'Debian')
    with contextlib.suppress(BrokenPipeError):  # Ctrl-C has ended the parent meanwhile
        print(master.url, file=answers, flush=True)
    try:
        while os.getppid() == parent and not select.select([sys.stdin], [], [], POLL)[0]:
            pass
    except KeyboardInterrupt:
        pass
    rosout.stop()
    server.stop()


if __name__ == '__main__':
    main(int(sys.argv[1]), int(sys.argv[2]))
