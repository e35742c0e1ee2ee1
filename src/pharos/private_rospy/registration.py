"""How a node registers with the master and hears from it."""
import http.client
import threading
import xml.parsers.expat
import xmlrpc.client

import rosgraph

from pharos.errors import MasterUnreachableError, NodeNameInUseError
from pharos.private_rospy.proxies import ServerProxy, master_api

PING_TIMEOUT = 1.0  # seconds in which a running node answers getPid
REGISTER_TIMEOUT = 1.0  # seconds that the master has at least, to register what is opened
UNREGISTER_TIMEOUT = 2.0  # seconds that it has, to unregister what is closed or stops
RETRY_DELAY = (
    2.0  # seconds between attempts to reach a publisher, for as long as the master knows it
)
# the last where something answers that does not speak XML-RPC
COMMUNICATION_ERRORS = (
    OSError,
    xmlrpc.client.Error,
    http.client.HTTPException,
    xml.parsers.expat.ExpatError,
)
_attempt = threading.local()  # .failure: of what this thread registers, where it waits for that


def registered(make, undo):
    """What ``make()`` returns, a rospy Publisher, Subscriber or Service that is registered with the
    master.

    rospy itself does not say that it could not register one: whoever uses it plainly gets one that
    the watcher registers when the master is back, and a line in the log.

    :raises MasterUnreachableError: where that failed; ``undo(what was made)`` has been called
    """
    _attempt.failure = None
    try:
        made = make()
        if _attempt.failure is not None:
            undo(made)
            raise _attempt.failure
        return made
    finally:
        del _attempt.failure


def is_awaited():
    """Whether this thread is in :func:`registered`."""
    return hasattr(_attempt, 'failure')


def note_failure(text, cause):
    """Have :func:`registered` raise for a registration that failed in it."""
    _attempt.failure = MasterUnreachableError(
        text + ': is it running? Nothing was opened: try again when it is'
    )
    _attempt.failure.__cause__ = cause


def name_is_anothers(node):
    """Whether the master gives the name of the node, a PrivateRospy, to another one."""
    try:
        master = master_api(node.settings.master_url, node.name, PING_TIMEOUT)
        return _belongs_to_another(master, node.name, node.uri)
    except Exception:  # there is no master, which then did not call either
        return False


def claim_name(master_url, name, timeout):
    """Make sure that no running node has ``name``; what a dead one left with the master goes.

    :raises MasterUnreachableError: if no master answers
    :raises NodeNameInUseError: if a running node has the name, or one that cannot be told from it
    """
    master = master_api(master_url, name, timeout)
    try:
        uri = master.lookupNode(name)
    except rosgraph.MasterError:  # unknown to the master, as it should be
        return
    except COMMUNICATION_ERRORS as error:
        raise MasterUnreachableError(
            f'no ROS master answers at {master_url} ({error}): start one with roscore or'
            ' Master.embedded(), or set ROS_MASTER_URI'
        ) from error
    try:
        ServerProxy(uri, PING_TIMEOUT).getPid(name)
    except ConnectionRefusedError:
        unregister_all(master, name, uri)  # nobody is left at that URI
    except COMMUNICATION_ERRORS as error:
        raise NodeNameInUseError(
            f'the node name {name} is taken by a node at {uri} that does not answer ({error}):'
            ' choose another name, or run rosnode cleanup if that node is gone'
        ) from error
    else:
        raise NodeNameInUseError(
            f'the node name {name} is taken by a running node at {uri}: choose another name, or'
            f' stop that node (rosnode kill {name})'
        )


def unregister_all(master, name, uri):
    """Remove the registrations of a node that is gone; rosnode's own function asks the
    environment's master."""
    publishers, subscribers, services = master.getSystemState()
    for names, unregister in (publishers, master.unregisterPublisher), (
        subscribers,
        master.unregisterSubscriber,
    ):
        for topic, nodes in names:
            if name in nodes:
                unregister(topic, uri)
    for service, nodes in services:
        if name in nodes:
            master.unregisterService(service, master.lookupService(service))


def _belongs_to_another(master, name, uri):
    """Whether another node than the one at that URI has the name."""
    try:
        return master.lookupNode(name) != uri
    except rosgraph.MasterError:  # unknown to the master
        return False


def repair(instance, handler, topics, services, state, was_away):
    """Register again what the master has forgotten of a node: a restarted one knows nothing,
    another a part.

    :param state: ``(publishers, subscribers, services)`` of the master, each ``{name: [node
        names]}``
    :param was_away: whether the master was out of reach: what it had to say of publishers then is
        asked for again, and what the node closed then is unregistered
    :returns: whether it had forgotten the node altogether
    """
    name, uri, master = (
        instance.name,
        instance.uri,
        master_api(instance.settings.master_url, instance.name),
    )
    kinds = [
        (topics.get_publications, state[0], master.registerPublisher, master.unregisterPublisher),
        (
            topics.get_subscriptions,
            state[1],
            master.registerSubscriber,
            master.unregisterSubscriber,
        ),
    ]
    # every node offers this from its start on; a channel may have been opened with a restarted
    # master already
    forgotten = name not in state[2].get(instance.rospy.resolve_name('~get_loggers'), ())
    # A service that another node offers by now is that node's, as in ROS; both would take it back
    # for ever.
    lost_services = [
        (service, service_uri)
        for service, service_uri in services.get_services()
        if not state[2].get(service)
    ]
    offered = [
        (topics.get_publications(), state[0]),
        (topics.get_subscriptions(), state[1]),
        (lost_services, state[2]),
    ]
    is_whole = all(name in theirs.get(each, ()) for ours, theirs in offered for each, _ in ours)
    if not is_whole and _belongs_to_another(master, name, uri):
        # To register again would take the name back, and end the newer node.
        instance.has_lost_name = True
        instance.request_stop('another node has taken its name')
        return False
    for ours, theirs, register, unregister in kinds:
        for topic, type_ in ours():
            if name not in theirs.get(topic, ()) or was_away and ours == topics.get_subscriptions:
                publishers = register(topic, type_, uri)
                if instance.ended.is_set() or topic not in dict(ours()):
                    unregister(topic, uri)  # closed while we registered it
                elif ours == topics.get_subscriptions:
                    handler.reg_man.publisher_update(topic, publishers)
        if was_away:
            for topic, nodes in theirs.items():
                if name in nodes and topic not in dict(ours()):
                    unregister(topic, uri)
    for service, service_uri in lost_services:
        master.registerService(service, service_uri, uri)
        if instance.ended.is_set() or services.get_service(service) is None:
            master.unregisterService(service, service_uri)
    if was_away:
        for service, nodes in state[2].items():
            if name in nodes and services.get_service(service) is None:
                # one URI for all of them
                master.unregisterService(service, services.get_services()[0][1])
    return forgotten
