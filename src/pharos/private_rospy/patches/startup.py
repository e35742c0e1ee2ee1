"""Start and stop: registering takes no longer than it must, and loops hear early of the stop."""
import sys
import time
import traceback

from pharos.private_rospy.loader import ModuleProxy
from pharos.private_rospy.patches.table import patch, substitute
from pharos.private_rospy.process_rospy import rospy


@substitute('rospy.impl.init', 'time', 'waits in steps of 0.1 s, as long as the master takes')
def time_of_init(*, node):
    """Wait in short steps, and not for ever."""
    return ModuleProxy(time, sleep=node.wait_for_registration)


@patch(
    'rospy.core', 'is_shutdown', 'holds at the end of the stop, which waits for loops until then'
)
def is_shutdown(*, node, original):
    """Hold from the beginning of the stop."""
    return original() or node.ended.is_set()


@patch('rospy.topics', 'is_shutdown', 'keeps a soul that ends from sending its last messages')
def is_shutdown_of_topics(*, node):
    """Hold only at the end of the stop."""
    return node.rospy.core._shutdown_flag


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
