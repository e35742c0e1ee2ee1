"""Message types as the publishers of a topic define them, for a subscriber that has no package of them."""
import time

import rosgraph

from pharos import message_types
from pharos.errors import PharosError
from pharos.private_rospy.proxies import ServerProxy, deadline_in
from pharos.private_rospy.registration import COMMUNICATION_ERRORS
from pharos.tcpros_connection import CALLER_ID, publisher_header

TIMEOUT = 2.0    # seconds that one publisher may take


def class_from_publishers(topic, type_):
    """The class of a topic's messages by the definition that a live publisher sends in its connection header.

    :param type_: the type name that it must have
    :returns: None if no publisher tells it
    :raises UnknownTypeError, MessageTypeError: if those who tell it give nonsense, or not what has the md5sum they give
    """
    refused = None
    for told in _told(topic, type_, None):
        if not isinstance(told, PharosError):
            return told
        refused = told
    if refused:
        raise refused
    return None


def confirmed(topic, cls):
    """``cls`` where a live publisher defines its type alike, or none tells; else what the first of them says it is.

    All of them are given TIMEOUT together: there is a class to go on with.
    """
    first = None
    for told in _told(topic, cls._type, time.monotonic() + TIMEOUT):
        if isinstance(told, PharosError):
            continue
        if told._md5sum == cls._md5sum:
            return cls
        first = first or told
    return first or cls


def _told(topic, type_, deadline):
    """The class of that type as each live publisher defines it, or the error by which it cannot be read.

    :param deadline: by ``time.monotonic()``; None: each of them is given TIMEOUT
    """
    own = {node.name: node for node in topic.master.own_nodes()}
    for name in topic.publishers:
        if name in own:    # asked without a socket
            rospy = own[name]._rospy    # None: it is just being started
            publisher = rospy and rospy.publisher(topic.name)
            if publisher is not None and publisher.data_class._type == type_:
                yield publisher.data_class
            continue
        left = TIMEOUT if deadline is None else min(TIMEOUT, deadline - time.monotonic())
        if left <= 0:
            return
        try:
            header = _header(topic, topic.master._api(timeout=left).lookupNode(name), left)
        except (rosgraph.MasterException, *COMMUNICATION_ERRORS, TypeError, ValueError, OverflowError):
            continue    # the next one may answer, and as agreed
        if header.get('message_definition') and header.get('type') == type_:
            try:
                yield message_types.class_from_definition(type_, header['message_definition'], header.get('md5sum'))
            except PharosError as error:
                refused = type(error)('%s publishes on %s what cannot be read here: %s' % (name, topic.name, error))
                refused.__cause__ = error
                yield refused


def _header(topic, uri, timeout):
    """The connection header of the publisher at that URI, as a subscriber of any type gets it."""
    deadline = deadline_in(timeout)
    code, _, protocol = ServerProxy(uri, timeout).requestTopic(CALLER_ID, topic.name, [['TCPROS']])
    if code != 1:
        return {}
    _, host, port = protocol
    return publisher_header((host, port), topic.name, deadline)


def explain(name, refusal):
    """Why the node of that name cannot hear a publisher.

    :param refusal: a :class:`~pharos.private_rospy.refusals.Refusal`
    """
    wanted, offered = refusal.wanted, refusal.offered
    type_, md5sum = offered.get('type'), offered.get('md5sum')
    if md5sum == '*':
        theirs, advice = 'messages of any type', 'only subscribers of any type (rospy.AnyMsg) can be'
    else:
        theirs = f'{type_} [{md5sum}] ({_fields_in(offered)})'
        advice = ('have both sides use the same %s.msg' % type_.rpartition('/')[2] if type_ == wanted._type
                  else 'use one type, or another topic')
    return (f'{name} wants {refusal.topic} as {wanted._type} [{wanted._md5sum}] '
            f'({message_types.describe_fields(wanted)}), but {refusal.publisher} publishes {theirs}, and is not heard: '
            f'{advice}')


def _fields_in(header):
    """What a publisher's connection header says of the fields of its messages."""
    try:
        return message_types.describe_fields(message_types.class_from_definition(
            header.get('type'), header.get('message_definition'), header.get('md5sum')))
    except PharosError:
        return 'its fields are not known here'
