"""Calls a service thousands of times; prints what there is before and afterwards."""
import gc
import json
import os
import sys
import threading
import tracemalloc

import pharos

name, persistent, timeout, calls, pid = json.loads(sys.argv[1])
master = pharos.Master()
node = master.create(pharos.BlockNode, named='/caller', domain='127.0.0.1')
node.serve(
    '/caller/echo',
    'diagnostic_msgs/AddDiagnostics',
    lambda request: {'success': True, 'message': request.load_namespace},
)
service = master.lookup_service(name, persistent=persistent)


def call(times):
    for turn in range(times):
        assert service.call(load_namespace=str(turn), timeout=timeout).message == str(turn)


def resident(pid):
    """Memory of the process in MB."""
    with open('/proc/%s/statm' % pid) as file:
        return int(file.read().split()[1]) * os.sysconf('SC_PAGESIZE') / 1e6


def count():
    gc.collect()
    return {
        'descriptors': len(os.listdir('/proc/self/fd')),
        'threads': threading.active_count(),
        'allocated': tracemalloc.get_traced_memory()[0] / 1e6,
        'resident': resident('self'),
        "provider's descriptors": len(os.listdir('/proc/%s/fd' % pid)),
        "provider's memory": resident(pid),
    }


tracemalloc.start()
call(500)  # what is made once is there then
before = count()
call(calls)
print(json.dumps([before, count()]))
