"""Parameters: subscriptions that rospy makes for itself are known, and none is made late."""
from pharos.private_rospy.deadlines import time_limit
from pharos.private_rospy.parameters import changing
from pharos.private_rospy.patches.table import patch
from pharos.private_rospy.registration import COMMUNICATION_ERRORS

ASKED_BY_LOG = '/rosout_disable_topics_generation'  # by each line, until it is known
LOG_TIMEOUT = 1.0  # seconds that the master may hold up a line of the log


@patch('rospy.impl.paramserver', 'ParamServerCache.set', 'never lets go what it subscribed to')
def set_cached(self, key, value, *, node, original):
    """Note what get_param_cached subscribes to, as a line of the log does."""
    node.parameters.cached.add(key)
    original(self, key, value)


@patch(
    'rospy.msproxy',
    'MasterProxy.get_param_cached',
    'subscribes for each line of the log, which registers anew a node that stops, or has lost its'
    ' name to a newer one',
)
def get_param_cached(self, key, *, node, original, module):
    """Subscribe once, and only while the node runs; no line of the log is lost, or waits for long,
    for want of the master."""
    name, parameters = module.rospy.names.resolve_name(key), node.parameters
    if name in parameters.cached:
        return module.rospy.impl.paramserver.get_param_server_cache().get(name)
    if name == ASKED_BY_LOG:
        try:
            with time_limit(LOG_TIMEOUT):
                return parameters.subscribe_for_rospy(name, lambda: original(self, key))
        except COMMUNICATION_ERRORS:
            raise KeyError(key) from None
    if parameters.may_subscribe():
        return parameters.subscribe_for_rospy(name, lambda: original(self, key))
    return self[key]


@patch(
    'rospy.msproxy',
    'MasterProxy.__setitem__',
    'tells what nodes of the process keep of it by the master alone, which is later, and never tells'
    ' who sets it',
)
def set_item(self, key, val, *, original, module):
    """Have the nodes of this process ask anew for what they have kept of it."""
    with changing(module.rospy.names.resolve_name(key)):
        original(self, key, val)


@patch('rospy.msproxy', 'MasterProxy.__delitem__', 'tells nobody but the master')
def delete_item(self, key, *, original, module):
    """Have the nodes of this process ask anew for what they have kept of it."""
    with changing(module.rospy.names.resolve_name(key)):
        original(self, key)
