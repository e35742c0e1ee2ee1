"""How a node registers with the master and hears from it."""
import http.client
import threading
import time
import xml.parsers.expat
import xmlrpc.client

import rosgraph

from pharos.errors import MasterUnreachableError, NodeNameInUseError
from pharos.private_rospy import publishing
from pharos.private_rospy.loader import Substitute
from pharos.private_rospy.proxies import ServerProxy, master_api
from pharos.private_rospy.xmlrpc_server import REFUSED, is_call_from_nearby

PING_TIMEOUT = 1.0  # seconds in which a running node answers getPid
STOP_TIMEOUT = 5.0  # seconds that who asks the node to stop waits for that
REGISTER_TIMEOUT = 1.0  # seconds that the master has at least, to register what is opened
UNREGISTER_TIMEOUT = 2.0  # seconds that it has, to unregister what is closed or stops
PUBLISHER_LIMIT = (
    1000  # publishers of a topic that a call may name; a thread tries to reach each of them
)
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
_KINDS = {'pub': 'the publisher on', 'sub': 'the subscriber to', 'srv': 'the service'}
_attempt = threading.local()  # .failure: of what this thread registers, where it waits for that


def hooks(instance):
    """The load hooks of this module, for the :class:`~.instance.PrivateRospy` given."""

    def obey_only_the_master_of_the_name(module):
        """rospy.impl.masterslave: who may end the node, and one connection per publisher."""
        handler = module.ROSHandler
        connect, lock = handler._connect_topic, threading.Lock()
        connecting = {}  # (topic, URI) -> whether it was asked for again meanwhile
        attempt = instance.connections.connecting

        def note_attempt(topic, uri, has_reached):
            subscriber = instance.subscriber(topic)
            if subscriber is not None:
                change = (
                    subscriber.out_of_reach.discard if has_reached else subscriber.out_of_reach.add
                )
                change(uri)
                publishing.notify()

        def _connect_topic(self, topic, uri):
            """rospy looks for a connection long before it adds one, and so may connect twice to one
            publisher."""
            with lock:
                if (topic, uri) in connecting:
                    connecting[topic, uri] = True
                    return 1, f'connecting to {uri} already', 0
                connecting[topic, uri] = False
            again = True
            while again:
                try:
                    attempt.topic, attempt.uri = topic, uri
                    answer = connect(self, topic, uri)
                except _NotWanted as error:
                    answer = 0, str(error), 0
                except (UnboundLocalError, TypeError, AttributeError):
                    # rospy's, where it gave up because the node stops, or the subscription or the
                    # protocols have gone
                    answer = 0, f'{self.name} or its interest in {topic} ends', 0
                except BaseException:  # else nobody would ever connect to it again
                    with lock:
                        del connecting[topic, uri]
                    raise
                with lock:
                    # asked for again: what was no publisher a moment ago may be one now
                    again = connecting[topic, uri] and answer[0] != 1
                    connecting[topic, uri] = False
                    if not again:
                        del connecting[topic, uri]
            note_attempt(topic, uri, answer[0] == 1)
            return answer

        handler._connect_topic = _connect_topic

        def wait_for_next_attempt(_):
            """rospy asks a publisher that is out of reach ever more rarely, and never stops."""
            instance.ended.wait(RETRY_DELAY)
            subscriber = instance.subscriber(attempt.topic)
            if instance.ended.is_set() or subscriber is None:
                raise _NotWanted(f'nobody is interested in {attempt.topic} any more')
            if attempt.uri not in subscriber.publishers:
                raise _NotWanted(
                    f'the master knows no publisher of {attempt.topic} at {attempt.uri}'
                )

        module.time = Substitute(time, sleep=wait_for_next_attempt)

        @module.apivalidate(-1, (module.is_topic('topic'), module.is_publishers_list('publishers')))
        def publisherUpdate(self, caller_id, topic, publishers):
            """rospy passes the list on once for each publisher in it, and so does not hear that
            there is none."""
            if len(publishers) > PUBLISHER_LIMIT:
                return (
                    -1,
                    f'{REFUSED}{len(publishers)} publishers; the limit is {PUBLISHER_LIMIT}',
                    0,
                )
            if self.reg_man:
                self.reg_man.publisher_update(topic, publishers)
            return 1, '', 0

        handler.publisherUpdate = publisherUpdate

        @module.apivalidate(0, (None,))
        def shutdown(self, caller_id, msg=''):
            # the master knows, whoever says so
            if 'new node registered with same name' in str(msg):
                # it meant an earlier owner of this URI (ros_comm #2241)
                if not _name_is_anothers(self):
                    return 1, f'the name {self.name} is still this node\'s', 0
                instance.has_lost_name = True
            elif not (instance.allows_remote_shutdown() or is_call_from_nearby(self.masterUri)):
                return (
                    -1,
                    REFUSED + 'only this host and the master\'s may stop it, unless its '
                    'allow_remote_shutdown is set',
                    0,
                )
            instance.request_stop(f'{caller_id} asked for it: {msg}')
            instance.wait_until_silent(STOP_TIMEOUT)  # whoever asked finds it gone, as with rospy
            return 1, 'shutdown', 0

        handler.shutdown = shutdown

    def register_once(module):
        """rospy.impl.registration: retries while it holds the topic lock, so that nothing can stop
        it."""
        manager = module.RegManager

        def reg_added(self, name, type_or_uri, kind):
            if instance.has_lost_name:
                return
            master, me = module.xmlrpcapi(self.master_uri), module.get_caller_id()
            call = {
                'pub': master.registerPublisher,
                'sub': master.registerSubscriber,
                'srv': master.registerService,
            }[kind]
            cause = None
            try:
                code, message, value = call(me, name, type_or_uri, self.uri)
            except COMMUNICATION_ERRORS as error:
                code, message, cause = 0, error, error
            if code != 1:
                _tell_failure(
                    module,
                    (
                        f'cannot register {_KINDS[kind]} {name} of {me} with the master '
                        f'{self.master_uri}: {message}'
                    ),
                    cause,
                )
            elif kind == 'sub':
                self.publisher_update(name, value)
            elif kind == 'pub':
                instance.connections.subscribers_at_registration[name] = value

        manager.reg_added = reg_added

        def reg_removed(self, name, type_or_uri, kind):
            """rospy's, but for what could not be registered: a master that is away is not asked
            twice."""
            if not hasattr(_attempt, 'failure'):
                remove(self, name, type_or_uri, kind)

        remove, manager.reg_removed = manager.reg_removed, reg_removed

        def publisher_update(self, topic, uris):
            subscriber = instance.subscriber(topic)
            if subscriber is not None:
                subscriber.publishers = uris
                subscriber.out_of_reach.intersection_update(uris)
            update(self, topic, uris)

        update, manager.publisher_update = manager.publisher_update, publisher_update

        def cleanup(self, reason):
            """rospy's version trips over a time-out and then closes nothing."""
            with self.cond:
                self.cond.notify_all()
            if not self.master_uri:
                return
            module.get_registration_listeners().clear()
            topics, services, me = (
                module.get_topic_manager(),
                module.get_service_manager(),
                module.get_caller_id(),
            )
            if topics.lock.acquire(timeout=UNREGISTER_TIMEOUT):
                topics.lock.release()  # what another thread was just registering is registered
            calls = xmlrpc.client.MultiCall(ServerProxy(self.master_uri, UNREGISTER_TIMEOUT))
            for name, _ in topics.get_subscriptions():
                calls.unregisterSubscriber(me, name, self.uri)
            for name, _ in topics.get_publications():
                calls.unregisterPublisher(me, name, self.uri)
            for name, uri in services.get_services():
                calls.unregisterService(me, name, uri)
            instance.parameters.unsubscribe(calls)
            try:
                calls()
            except COMMUNICATION_ERRORS as error:
                self.logger.warning(
                    'cannot unregister from the master %s: %s', self.master_uri, error
                )
            topics.close_all()
            services.unregister_all()

        manager.cleanup = cleanup

    return {
        'rospy.impl.masterslave': obey_only_the_master_of_the_name,
        'rospy.impl.registration': register_once,
    }


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


def _tell_failure(module, text, cause):
    """Tell of a registration that failed: who waits for it in :func:`registered`, or else the
    log."""
    if hasattr(_attempt, 'failure'):
        _attempt.failure = MasterUnreachableError(
            text + ': is it running? Nothing was opened: try again when it is'
        )
        _attempt.failure.__cause__ = cause
    else:
        module.logerr(text + ': this is done as soon as it answers')


class _NotWanted(Exception):
    """A publisher that is out of reach need not be reached any more."""


def _name_is_anothers(handler):
    """Whether the master gives the node's name to another node than this one."""
    try:
        return _belongs_to_another(
            master_api(handler.masterUri, handler.name, PING_TIMEOUT), handler.name, handler.uri
        )
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
