"""A ROS master that counts what it is asked, and tells it by a call of ``counts(caller_id)``. See
benchmark/scale.

What is asked as '/scale', by those who measure, is not counted.

usage: counting_master.py PORT
"""
import signal
import sys
import time
import xmlrpc.server

import rosmaster.master
import rosmaster.master_api

counts = {'requests': 0, 'bytes': 0}


def count_dispatches():
    """Have the servers of this process count the requests that they answer, and the bytes of both,
    of long answers those that go over the wire."""
    dispatcher = xmlrpc.server.SimpleXMLRPCDispatcher
    dispatch, compress = dispatcher._marshaled_dispatch, xmlrpc.server.gzip_encode

    def counted(self, data, *options):
        answer = dispatch(self, data, *options)
        if b'<string>/scale</string>' not in data:
            counts['requests'] += 1
            counts['bytes'] += len(data) + len(answer)
        return answer

    def compressed(answer):
        sent = compress(answer)
        counts['bytes'] -= len(answer) - len(sent)
        return sent

    dispatcher._marshaled_dispatch = counted
    xmlrpc.server.gzip_encode = compressed


def tell(handler, caller_id):
    """The counts so far, and the seconds of a processor."""
    return 1, 'counts', {**counts, 'cpu': time.process_time()}


if __name__ == '__main__':
    count_dispatches()
    rosmaster.master_api.ROSMasterHandler.counts = tell
    rosmaster.master.Master(port=int(sys.argv[1])).start()
    signal.pause()
