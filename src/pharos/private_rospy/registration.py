"""How a node registers with the master and hears from it."""
import http.client
import threading
import xml.parsers.expat
import xmlrpc.client
from typing import Callable, NamedTuple

import rosgraph

from pharos.errors import MasterUnreachableError, NodeNameInUseError
from pharos.private_rospy.deadlines import time_limit
from pharos.private_rospy.proxies import ServerProxy, master_api

PING_TIMEOUT = 1.0  # seconds in which a running node answers getPid
REGISTER_TIMEOUT = 1.0  # seconds that the master has at least, to register what is opened
UNREGISTER_TIMEOUT = 2.0  # seconds that it has, to unregister what is closed or stops
LATE = 0.5  # seconds after which it is not expected to come to a call that timed out before
# seconds between attempts to reach a publisher, for as long as the master knows it
RETRY_DELAY = 2.0
# the last where something answers that does not speak XML-RPC
COMMUNICATION_ERRORS = (
    OSError,
    xmlrpc.client.Error,
    http.client.HTTPException,
    xml.parsers.expat.ExpatError,
)
_attempt = threading.local()  # .failure: of what this thread registers, where it waits for that


def registered(make, undo, timeout):
    """What ``make()`` returns, a rospy Publisher, Subscriber or Service that is registered with the
    master.

    rospy itself does not say that it could not register one: whoever uses it plainly gets one that
    the watcher registers when the master is back, and a line in the log.

    :param timeout: seconds that the master may take
    :raises MasterUnreachableError: where that failed; ``undo(what was made)`` has been called
    """
    _attempt.failure = None
    try:
        with time_limit(max(REGISTER_TIMEOUT, timeout)):
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


def keeps_name(node):
    """Whether the node, a PrivateRospy, may register: that would take the name back, and end the
    newer node, where another one has it by now. Then this one stops, as ROS has it."""
    if not node.has_lost_name and name_is_anothers(node):
        node.has_lost_name = True
        node.request_stop('another node has taken its name')
    return not node.has_lost_name


def unreachable(master_url: str, error: Exception) -> MasterUnreachableError:
    """What one of the COMMUNICATION_ERRORS at a master is to users."""
    if isinstance(error, xmlrpc.client.Fault):
        return MasterUnreachableError(
            f'what answers at {master_url} is no ROS master ({error.faultString}): give the URL of'
            ' one, not that of a node'
        )
    return MasterUnreachableError(
        f'no ROS master answers at {master_url} ({error}): start one with roscore or'
        ' Master.embedded(), or set ROS_MASTER_URI'
    )


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
        raise unreachable(master_url, error) from error
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

    def unregister_service(service, _):
        master.unregisterService(service, master.lookupService(service))

    unregistering = master.unregisterPublisher, master.unregisterSubscriber, unregister_service
    for users, unregister in zip(master.getSystemState(), unregistering):
        for topic, nodes in users:
            if name in nodes:
                unregister(topic, uri)


def _belongs_to_another(master, name, uri):
    """Whether another node than the one at that URI has the name."""
    try:
        return master.lookupNode(name) != uri
    except rosgraph.MasterError:  # unknown to the master
        return False


class _Kind(NamedTuple):
    """What a node registers of one kind, and what the master knows of that."""

    ours: Callable  # ours() returns [(name, type or URI of a service)]
    theirs: dict  # {name: [node names]}
    register: Callable
    unregister: Callable
    uri: str  # with which it is unregistered

    def lost(self, node):
        """What the master does not know of the node.

        A service that another node offers by now is that node's, as in ROS: both would take it back
        for ever.
        """
        return [
            (name, value)
            for name, value in self.ours()
            if not self.theirs.get(name)
            or self.uri == node.uri
            and node.name not in self.theirs[name]
        ]

    def repair(self, node, was_away):
        """Make the master know what the node has, and where it was away, what it has not any
        more."""
        is_subscribing = self.ours == node.topics.get_subscriptions
        handler = node.handler
        for name, value in self.ours() if was_away and is_subscribing else self.lost(node):
            publishers = self.register(name, value, node.uri)
            if node.ended.is_set() or name not in dict(self.ours()):
                self.unregister(name, self.uri)  # closed while we registered it
            elif is_subscribing and handler:
                handler.reg_man.publisher_update(name, publishers)
        for failed in [each for each in node.unsure if each[0] == self.unregister.__name__]:
            _, name, uri = failed
            if name not in dict(self.ours()):
                self.unregister(name, uri)
            node.unsure.discard(failed)
        if was_away:
            ours = dict(self.ours())
            for name, nodes in self.theirs.items():
                if node.name in nodes and name not in ours:
                    self.unregister(name, self.uri)


def repair(node, state, was_away):
    """Register again what the master has forgotten of a node: a restarted one knows nothing,
    another a part.

    :param node: a PrivateRospy
    :param state: ``(publishers, subscribers, services)`` of the master, each ``{name: [node
        names]}``
    :param was_away: whether the master was out of reach: what it had to say of publishers then is
        asked for again, and what the node closed then is unregistered

    Where the master had forgotten the node altogether, its ``was_forgotten`` is set.
    """
    master = master_api(node.settings.master_url, node.name)
    publishers, subscribers, services = state
    get_services = node.service_manager.get_services
    node.services_of_others = {
        name for name, _ in get_services() if node.name not in services.get(name, [node.name])
    }
    service_uri = next((uri for _, uri in get_services()), None)  # one for all of them
    kinds = (
        _Kind(
            node.topics.get_publications,
            publishers,
            master.registerPublisher,
            master.unregisterPublisher,
            node.uri,
        ),
        _Kind(
            node.topics.get_subscriptions,
            subscribers,
            master.registerSubscriber,
            master.unregisterSubscriber,
            node.uri,
        ),
        _Kind(
            get_services, services, master.registerService, master.unregisterService, service_uri
        ),
    )
    # every node offers this from its start on; a channel may have been opened with a restarted
    # master already
    is_forgotten = node.name not in services.get(node.module.resolve_name('~get_loggers'), ())
    if any(kind.lost(node) for kind in kinds) and not keeps_name(node):
        return
    node.was_forgotten = node.was_forgotten or is_forgotten
    for kind in kinds:
        kind.repair(node, was_away)
