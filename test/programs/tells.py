"""Two nodes that log and fail; with 'redirect', what the Transcript gets is counted."""
import sys

import pharos

shown = []
if 'redirect' in sys.argv:
    pharos.Transcript.on_show(shown.append)
master = pharos.Master()
first, second = (
    master.create(pharos.BlockNode, named=name, domain='127.0.0.1')
    for name in ('/first', '/robot/second')
)
first.log('hello')
second.ros.logwarn('careful')
first.soul = lambda me: int('one')
second.serve('/fails', 'std_srvs/Empty', lambda request: int('two'))
try:
    first.fork().join()
    master.lookup_service('/fails').call()
except pharos.ServiceCallError:
    pass
for node in first, second:
    node.stop()
print(f'the Transcript was given {len(shown)}')
