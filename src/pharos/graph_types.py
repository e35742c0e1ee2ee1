"""Message types as the publishers of a topic define them, for a subscriber that has no package of
them."""
import rosgraph

from pharos import messages
from pharos.errors import PharosError
from pharos.private_rospy.proxies import ServerProxy, deadline_in
from pharos.private_rospy.registration import COMMUNICATION_ERRORS
from pharos.private_rospy.tcpros_connection import CALLER_ID, publisher_header

TIMEOUT = 2.0  # seconds that one publisher may take


def class_from_publishers(topic, type_):
    """The class of a topic's messages by the definition that a live publisher sends in its
    connection header.

    :param type_: the type name that it must have
    :returns: None if no publisher tells it
    :raises UnknownTypeError, MessageTypeError: if those who tell it give nonsense, or not what has
        the md5sum they give
    """
    own = classes_here(topic, type_)
    if own:
        return own[0]
    refused = None
    for name in topic.publishers:
        try:
            header = _header(topic, topic.master._api().lookupNode(name))
        except (
            rosgraph.MasterException,
            *COMMUNICATION_ERRORS,
            TypeError,
            ValueError,
            OverflowError,
        ):
            continue  # the next one may answer, and as agreed
        if header.get('message_definition') and header.get('type') == type_:
            try:
                return messages.class_from_definition(
                    type_, header['message_definition'], header.get('md5sum')
                )
            except PharosError as error:
                refused = type(error)(
                    f'{name} publishes on {topic.name} what cannot be read here: {error}'
                )
                refused.__cause__ = error
    if refused:
        raise refused
    return None


def classes_here(topic, type_):
    """The classes with which nodes of this process publish that type on the topic."""
    # None: it is just being started
    instances = [node._rospy for node in topic.master.local_nodes() if node._rospy]
    publishers = [
        publisher
        for publisher in (instance.publisher(topic.name) for instance in instances)
        if publisher
    ]
    return [publisher.data_class for publisher in publishers if publisher.data_class._type == type_]


def agree_with_publishers(channel, refusals):
    """Have an input channel take the definition of a publisher elsewhere, where none suits it as it
    is.

    A publisher that is only asked for its definition takes that for a subscriber, and sends to
    nobody. So the channel subscribes with the definition that is known here, and one who refuses is
    believed.

    :param refusals: a list that grows with each that comes; of those in it afterwards is to be told
    """
    instance, topic = channel.node._rospy, channel.topic
    instance.wait_until(
        lambda: instance.connections.has_heard_from_publishers(topic), channel.node.connect_timeout
    )
    if instance.connections.hears(topic):
        return
    for refusal in list(refusals):
        offered = refusal.offered
        if offered.get('type') == channel.type:
            try:
                cls = messages.class_from_definition(
                    channel.type, offered.get('message_definition'), offered.get('md5sum')
                )
            except PharosError:
                continue  # it is told as one that cannot be heard
            refusals.clear()  # those whom this does not suit either refuse again
            channel._subscribe_as(cls)
            return


def _header(topic, uri):
    """The connection header of the publisher at that URI, as a subscriber of any type gets it."""
    deadline = deadline_in(TIMEOUT)
    code, _, protocol = ServerProxy(uri, TIMEOUT).requestTopic(CALLER_ID, topic.name, [['TCPROS']])
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
        theirs, advice = (
            'messages of any type',
            'only subscribers of any type (rospy.AnyMsg) can be',
        )
    else:
        theirs = f'{type_} [{md5sum}] ({_fields_in(offered)})'
        advice = (
            f"have both sides use the same {type_.rpartition('/')[2]}.msg"
            if type_ == wanted._type
            else 'use one type, or another topic'
        )
    return (
        f'{name} wants {refusal.topic} as {wanted._type} [{wanted._md5sum}]'
        f' ({messages.describe_fields(wanted)}), but {refusal.publisher} publishes {theirs},'
        f' and is not heard: {advice}'
    )


def _fields_in(header):
    """What a publisher's connection header says of the fields of its messages."""
    try:
        return messages.describe_fields(
            messages.class_from_definition(
                header.get('type'), header.get('message_definition'), header.get('md5sum')
            )
        )
    except PharosError:
        return 'its fields are not known here'
