"""A provider of services, written with rospy or with this package: KIND NAME PORT."""
import sys
import threading

import std_srvs.srv
from diagnostic_msgs.srv import AddDiagnostics

kind, name, port = sys.argv[1], sys.argv[2], int(sys.argv[3])
if kind == 'rospy':
    import rospy

    rospy.init_node(name.strip('/'), tcpros_port=port)
    serve, spin = rospy.Service, rospy.spin
else:
    import pharos

    node = pharos.Master().create(pharos.BlockNode, named=name, domain='127.0.0.1', tcp_port=port)
    serve, spin = node.serve, pharos.spin

gate = threading.Event()


def echo(request):
    return {'success': True, 'message': request.load_namespace}


def fail(request):
    raise RuntimeError('no room for %s' % request.load_namespace)


def wait(request):
    # at once: print writes the end apart
    sys.stdout.write('called by %s\n' % request.load_namespace)
    sys.stdout.flush()
    gate.wait()
    return echo(request)


def open_gate(request):
    gate.set() if request.data else gate.clear()
    return {'success': True}


for block in echo, fail, wait:
    serve(name + '/' + block.__name__, AddDiagnostics, block)
serve(name + '/gate', std_srvs.srv.SetBool, open_gate)
print('ready', flush=True)
spin()
