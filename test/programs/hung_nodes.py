#!/usr/bin/python3
"""Nodes that are registered and answer nobody, as many as the argument says."""
import os
import signal
import socket
import sys

import rosgraph

listeners = [socket.create_server(('127.0.0.1', 0)) for _ in range(int(sys.argv[1]))]
for number, listener in enumerate(listeners):
    master = rosgraph.Master(f'/hung{number}', master_uri=os.environ['ROS_MASTER_URI'])
    uri = f'http://127.0.0.1:{listener.getsockname()[1]}/'
    master.registerService('/hang%d' % number, 'rosrpc' + uri[4:-1], uri)
print('registered', flush=True)
signal.pause()
