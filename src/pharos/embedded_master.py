"""A ROS master of one's own, as a child process that ends with the program: see
:meth:`Master.embedded`.

Run as a module, this is that child: ``python3 -m pharos.embedded_master PORT``. It prints its URL,
and ends when its standard input does, or its parent, whose forks may hold the other end of that.
"""
import logging
import os
import select
import socket
import subprocess
import sys

import rosgraph.network

from pharos.errors import MasterUnreachableError, PortInUseError
from pharos.private_rospy.addresses import check_environment

LOOPBACK = '127.0.0.1'


def start(port):
    """Start the child; returns ``(process, URL)``.

    :raises PortInUseError: if the port is taken
    :raises ValueError: if ROS_HOSTNAME or ROS_IP cannot be an address of this host
    """
    environ = dict(os.environ, PYTHONPATH=os.pathsep.join(path for path in sys.path if path))
    if check_environment(environ) is None:
        environ['ROS_HOSTNAME'] = LOOPBACK  # for this host alone, where nothing else is said
    # Ctrl-C is the program's
    child = subprocess.Popen(
        [sys.executable, '-m', __name__, str(port)],
        env=environ,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    line = child.stdout.readline().strip()
    if line.startswith('http://'):
        return child, line
    end(child)
    if line.startswith('busy'):
        raise PortInUseError(
            f"port {port} for a master cannot be bound ({line.partition(' ')[2]}): choose another"
            " port, or 0 for any free one"
        )
    raise MasterUnreachableError(
        'a master of our own did not start: is python3-rosmaster installed?'
    )


def end(child):
    """End the child, and wait for it."""
    child.stdin.close()
    try:
        child.wait(10)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()
    child.stdout.close()


def main():
    """The child: rosmaster, with a /rosout that passes the log lines on to /rosout_agg as ROS's
    does."""
    import rosmaster.master
    from pharos.master import Master
    from pharos.node import BlockNode

    answers, sys.stdout = sys.stdout, sys.stderr  # rospy prints log lines on standard output
    # it tells of every node that just stopped
    logging.getLogger('rosmaster').addHandler(logging.NullHandler())
    ends = [sys.stdin, os.pidfd_open(os.getppid())]
    port = int(sys.argv[1])
    try:
        with socket.socket() as probe:  # rosmaster waits for ever where its port is taken
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((rosgraph.network.get_bind_address(), port))
    except OSError as error:
        print('busy', error.strerror, file=answers, flush=True)
        return
    server = rosmaster.master.Master(port=port)
    server.start()
    host = os.environ.get('ROS_HOSTNAME') or os.environ['ROS_IP']
    master = Master('http://%s:%d/' % (host, server.master_node.port))
    rosout = master.create(BlockNode, named='/rosout')
    aggregate = rosout.output_channel('/rosout_agg', 'rosgraph_msgs/Log')
    rosout.interested_in(
        '/rosout', 'rosgraph_msgs/Log', delegate=lambda message, channel: aggregate.publish(message)
    )
    # roscore tells it, too
    master.parameters['/rosdistro'] = os.environ.get('ROS_DISTRO', 'Debian')
    print(master.url, file=answers, flush=True)
    try:
        select.select(ends, [], [])
    except KeyboardInterrupt:
        pass
    rosout.stop()
    server.stop()


if __name__ == '__main__':
    main()
