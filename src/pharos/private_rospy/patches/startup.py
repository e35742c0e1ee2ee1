"""Start and stop: registering takes no longer than it must, and loops hear early of the stop."""
import sys
import threading
import time
import traceback

import rosgraph.names

from pharos.private_rospy.names import unique_name
from pharos.private_rospy.module_proxy import ModuleProxy
from pharos.private_rospy.patches.table import patch, substitute
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.settings import check_private_parameters


@substitute('rospy.impl.init', 'time', 'waits in steps of 0.1 s, as long as the master takes')
def time_of_init(*, node):
    """Wait in short steps, and not for ever."""
    return ModuleProxy(time, sleep=node.wait_for_registration)


@patch('rospy.client', 'init_node', 'knows nothing of the nodes that a process has beside it')
def init_node(
    name,
    argv=None,
    anonymous=False,
    log_level=None,
    disable_rostime=False,
    disable_rosout=False,
    disable_signals=False,
    xmlrpc_port=0,
    tcpros_port=0,
    *,
    node,
    original,
    module,
):
    """Start the node of a script, which names it by this call."""
    as_given = name
    options = log_level, disable_rostime, disable_rosout
    named, is_first = isinstance(name, str) and name and '/' not in name, not module._init_node_args
    if not (node.on_init_node and named and is_first):
        original(name, argv, anonymous, *options, disable_signals, xmlrpc_port, tcpros_port)
        return
    if argv is not None:
        check_private_parameters(argv)
        module.rospy.names.reload_mappings(argv)
    given = module.rospy.names.get_mappings().get('__name')
    if anonymous and not given:
        name = unique_name(name)
    resolved = rosgraph.names.resolve_name(given or name, module.rospy.core.get_caller_id())

    def register(xmlrpc_port, tcpros_port):
        # signals are for the threads of the process, which the script does not run in
        original(name, argv, False, *options, True, xmlrpc_port, tcpros_port)

    if not disable_signals:
        node.leave_signals_to_rospy()
    node.on_init_node(resolved, register, xmlrpc_port, tcpros_port)
    # what a second call has to give
    argv = module.sys.argv if argv is None else argv
    module._init_node_args = as_given, argv, anonymous, *options[:2], disable_signals


@patch(
    'rospy.core', 'is_shutdown', 'holds at the end of the stop, which waits for loops until then'
)
def is_shutdown(*, node, original):
    """Hold from the beginning of the stop, but in hooks of on_shutdown, as ever."""
    if original():
        return True
    return node.ended.is_set() and node.lifetime.hooks_thread != threading.get_ident()


@patch('rospy.topics', 'is_shutdown', 'keeps a soul that ends from sending its last messages')
def is_shutdown_of_topics(*, node):
    """Hold only at the end of the stop."""
    return node.module.core._shutdown_flag


@substitute('rospy.core', 'traceback', 'stops half way where what a hook raised cannot be printed')
def traceback_of_hooks(*, node):
    """Report what a hook of rospy.on_shutdown raised."""
    return ModuleProxy(traceback, print_exc=lambda: node.on_failure(sys.exc_info()[1]))


@substitute(
    'rospy.service', 'ServiceException', 'is a class per node: no except clause catches all'
)
def service_exception():
    """Have one for all nodes."""
    return rospy.ServiceException
