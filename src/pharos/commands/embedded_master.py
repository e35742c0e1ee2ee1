"""The program of an embedded master: ``python3 -m pharos.commands.embedded_master PORT``.

The program prints the URL of its master, unless the port is taken. The end of its standard input
ends the program.
"""
import logging
import os
import socket
import sys

import rosgraph.network
import rosmaster.master
from rosgraph_msgs.msg import Log

from pharos import BlockNode, Master


def main(port):  # pragma: no cover: os._exit() drops the data of this process
    """Run rosmaster, and a node /rosout that passes log lines on to /rosout_agg, as roscore does.

    :param port: the port of the master; 0: any free one
    """
    answers = sys.stdout
    sys.stdout = sys.stderr  # rosmaster prints, and the URL must come alone
    logging.disable()  # rosmaster complains of every node that stops
    try:  # rosmaster waits for ever if its port is taken
        socket.create_server((rosgraph.network.get_bind_address(), port)).close()
    except OSError:
        return
    server = rosmaster.master.Master(port=port)
    server.start()
    master = Master(server.uri)
    rosout = master.create(BlockNode, named='/rosout')
    aggregate = rosout.output_channel('/rosout_agg', Log)
    rosout.interested_in('/rosout', Log, delegate=aggregate.send)
    print(master.url, file=answers, flush=True)
    sys.stdin.read()
    os._exit(0)  # /rosout needs no unregistering: its master ends, too


if __name__ == '__main__':
    main(int(sys.argv[1]))
