"""What the master and other nodes ask a node: to stop, to connect, to hear of parameters."""
import contextlib

from pharos.private_rospy import registration
from pharos.private_rospy.local_link import IntraprocessHandler
from pharos.private_rospy.patches.table import addition, patch
from pharos.private_rospy.xmlrpc_server import caller, is_call_from_nearby

STOP_TIMEOUT = 5.0  # seconds that who asks the node to stop waits for that
# publishers of a topic that a call may name; a thread tries to reach each of them
PUBLISHER_LIMIT = 1000


@patch('rospy.impl.masterslave', 'ROSHandler.__init__', 'offers TCPROS alone')
def init_handler(self, name, master_uri, *, node, original):
    """Offer INTRAPROCESS first: of the protocols of a node, the first that its peer has is
    taken."""
    original(self, name, master_uri)
    self.protocol_handlers.insert(0, IntraprocessHandler(node))


@patch('rospy.impl.masterslave', 'ROSHandler._ready', 'tells no other node of this process')
def _ready(self, uri, *, node, original):
    """Be found by those who hear of the node from the master, as soon as it registers."""
    node.uri = uri
    node.connections.announce()
    original(self, uri)


@patch(
    'rospy.impl.masterslave',
    'ROSHandler._connect_topic',
    'looks for a connection long before it adds one, and so connects twice to one publisher;'
    ' asks one that is out of reach ever more rarely, and never stops',
)
def _connect_topic(self, topic, pub_uri, *, node):
    """Connect once."""
    return node.connections.connect(topic, pub_uri)


@patch(
    'rospy.impl.masterslave',
    'ROSHandler.publisherUpdate',
    'passes the list on once for each publisher in it, and so does not hear that there is none',
)
def publisherUpdate(self, caller_id, topic, publishers):
    """Pass it on once."""
    if len(publishers) > PUBLISHER_LIMIT:
        return caller().refuse(
            'publisherUpdate', f'{len(publishers)} publishers; the limit is {PUBLISHER_LIMIT}'
        )
    if self.reg_man:
        self.reg_man.publisher_update(topic, publishers)
    return 1, '', 0


@patch('rospy.impl.masterslave', 'ROSHandler.paramUpdate', 'tells its own cache alone')
def paramUpdate(self, caller_id, parameter_key, parameter_value, *, node, original):
    """Tell those who watch the parameter, too."""
    answer = -1, 'not subscribed', 0
    with contextlib.suppress(TypeError):  # the cache has a value where the key has a namespace
        answer = original(self, caller_id, parameter_key, parameter_value)
    return (1, '', 0) if node.parameters.tell(parameter_key, parameter_value) else answer


@patch(
    'rospy.impl.masterslave',
    'ROSHandler.shutdown',
    'obeys everybody, also where an earlier node at its URI was meant (ros_comm #2241)',
)
def shutdown(self, caller_id, msg='', *, node):
    """Stop where this host or the master's asks for it, or the node has lost its name."""
    # the master knows, whoever says so
    if 'new node registered with same name' in str(msg):
        if not registration.name_is_anothers(node):
            return 1, f'the name {node.name} is still this node\'s', 0
        node.has_lost_name = True
    elif not (node.allows_remote_shutdown() or is_call_from_nearby(self.masterUri)):
        return caller().refuse(
            'shutdown',
            'only this host and the master\'s may stop it, unless its allow_remote_shutdown is set',
        )
    node.request_stop(f'{caller_id} asked for it: {msg}')
    node.lifetime.silent.wait(STOP_TIMEOUT)  # whoever asked finds it gone, as with rospy
    return 1, 'shutdown', 0


@patch(
    'rospy.impl.masterslave',
    'ROSHandler.getBusStats',
    'answers with an error once more than 2 GiB have gone through a connection',
)
def getBusStats(self, caller_id, *, original):
    """Count from -2 GiB on then, as roscpp does: XML-RPC has no larger numbers."""
    code, text, stats = original(self, caller_id)
    return code, text, _in_32_bits(stats)


def _in_32_bits(stats):
    if isinstance(stats, (list, tuple)):
        return [_in_32_bits(each) for each in stats]
    is_count = type(stats) is int
    return (stats + 2**31) % 2**32 - 2**31 if is_count else stats


@addition(
    'rospy.impl.masterslave',
    'ROSHandler.pharosHealth',
    'has no words for what blocks failed at, and channels dropped',
)
def pharosHealth(self, caller_id, *, node):
    """What other processes may know of the node's health; see :func:`pharos.health.told`.

    A method more of ROS's slave API, and no service, which each node would register at its start
    for the few that are ever watched, and which `rosservice list` would show.
    """
    return 1, '', node.tell_health()
