"""Message types as the publishers of a topic define them, for a subscriber that has no package of them."""
import time

import rosgraph

from pharos import message_types
from pharos.errors import PharosError
from pharos.private_rospy.proxies import ServerProxy
from pharos.private_rospy.registration import COMMUNICATION_ERRORS
from pharos.tcpros_connection import TcprosConnection

TIMEOUT = 2.0               # seconds that one publisher may take
CALLER_ID = '/pharos_types'    # not the node's: a publisher closes an earlier connection of the same name


def class_from_publishers(topic, type_=None):
    """The class of a topic's messages by the definition that a live publisher sends in its connection header.

    :param type_: the type name that it must have; None: any
    :returns: None if no publisher tells it
    :raises UnknownTypeError, MessageTypeError: if those who tell it give nonsense, or not what has the md5sum they give
    """
    refused = None
    for name in topic.publishers:
        try:
            header = _header(topic, topic.master._api().lookupNode(name))
        except (rosgraph.MasterException, *COMMUNICATION_ERRORS, TypeError, ValueError, OverflowError):
            continue    # the next one may answer, and as agreed
        if header.get('message_definition') and type_ in (None, header.get('type')):
            try:
                return message_types.class_from_definition(header['type'], header['message_definition'],
                                                           header.get('md5sum'))
            except PharosError as error:
                refused = type(error)('%s publishes on %s what cannot be read here: %s' % (name, topic.name, error))
                refused.__cause__ = error
    if refused:
        raise refused
    return None


def _header(topic, uri):
    """The connection header of the publisher at that URI, as a subscriber of any type gets it."""
    code, _, protocol = ServerProxy(uri, TIMEOUT).requestTopic(CALLER_ID, topic.name, [['TCPROS']])
    if code != 1:
        return {}
    _, host, port = protocol
    connection = TcprosConnection((host, port), {
        'topic': topic.name, 'callerid': CALLER_ID, 'md5sum': '*', 'type': '*', 'tcp_nodelay': '0'},
        time.monotonic() + TIMEOUT)
    connection.close()
    return connection.header
