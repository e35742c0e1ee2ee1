"""Registering with the master: once, within a time limit, and not while it holds a lock for
ever."""
import contextlib
import time
import xmlrpc.client

from pharos.private_rospy import registration
from pharos.private_rospy.deadlines import deadline_in
from pharos.private_rospy.patches.table import addition, patch
from pharos.private_rospy.proxies import ServerProxy

_KINDS = {
    'pub': ('registerPublisher', 'the publisher on'),
    'sub': ('registerSubscriber', 'the subscriber to'),
    'srv': ('registerService', 'the service'),
}


@patch(
    'rospy.impl.registration',
    'RegManager.reg_added',
    'retries while it holds the lock of all topics, so that nothing can stop it',
)
def reg_added(self, resolved_name, data_type_or_uri, reg_type, *, node, module):
    """Try once; the watcher repairs what failed."""
    if node.has_lost_name or registration.is_awaited() and not registration.keeps_name(node):
        return
    method, kind = _KINDS[reg_type]
    register = getattr(module.xmlrpcapi(self.master_uri), method)
    cause = None
    try:
        code, message, value = register(node.name, resolved_name, data_type_or_uri, self.uri)
    except registration.COMMUNICATION_ERRORS as error:
        code, message, cause = 0, error, error
    if code != 1:
        uri = data_type_or_uri if reg_type == 'srv' else self.uri
        node.unsure.add(('un' + method, resolved_name, uri))
        text = (
            f'cannot register {kind} {resolved_name} of {node.name} with the master'
            f' {self.master_uri}: {message}'
        )
        if registration.is_awaited():
            registration.note_failure(text, cause)
        else:
            module.logerr(f'{text}: this is done as soon as it answers')
    elif reg_type == 'sub':
        self.publisher_update(resolved_name, value)
    elif reg_type == 'pub':
        node.connections.subscribers_at_registration[resolved_name] = value


@addition('rospy.core', '_LockedServerProxy.close_if_idle', 'keeps its connection for ever')
def close_if_idle(self):
    """Give it back: it is a descriptor here, and one and a thread of the master's; the next call
    makes another."""
    if self._lock.acquire(blocking=False):
        try:
            self('close')()
        finally:
            self._lock.release()


@patch(
    'rospy.impl.registration',
    'RegManager.reg_removed',
    'asks a master that is away, and has not registered it, a second time',
)
def reg_removed(self, resolved_name, data_type_or_uri, reg_type, *, original):
    """Leave out what could not be registered."""
    if not registration.is_awaited():
        original(self, resolved_name, data_type_or_uri, reg_type)


@patch('rospy.impl.registration', 'RegManager.publisher_update', 'forgets who publishes')
def publisher_update(self, resolved_name, uris, *, node):
    """Note whom the master named, and connect to each in a thread of its own."""
    subscriber = node.subscriber(resolved_name)
    if subscriber is not None:
        subscriber.publishers = uris
        subscriber.out_of_reach.intersection_update(uris)
        node.refusals.publishers_changed(subscriber)
    for uri in () if node.ended.is_set() else uris:  # each by itself: one may not answer
        node.start_thread(self._connect_topic_thread, (resolved_name, uri), 'connecting')


@patch(
    'rospy.impl.registration',
    'RegManager.run',
    'is a thread of each node that looks twice a second, and ends where it cannot start another',
)
def run(self):
    """Leave it to publisher_update, and to the departures of all nodes."""


@patch(
    'rospy.impl.registration', 'RegManager.cleanup', 'trips over a time-out and then closes nothing'
)
def cleanup(self, reason, *, node, module):
    """Unregister within a time limit, and close in any case."""
    with self.cond:
        self.cond.notify_all()
    if not self.master_uri:
        return
    topics, services = module.get_topic_manager(), module.get_service_manager()
    master = ServerProxy(self.master_uri, registration.UNREGISTER_TIMEOUT)
    calls = xmlrpc.client.MultiCall(master)
    with contextlib.ExitStack() as locks:
        # what another thread was just registering, or unregistering, is, and nothing more will be
        for manager in topics, services:
            if manager.lock.acquire(timeout=registration.UNREGISTER_TIMEOUT):
                locks.callback(manager.lock.release)
        module.get_registration_listeners().clear()
        for name, _ in topics.get_subscriptions():
            calls.unregisterSubscriber(node.name, name, self.uri)
        for name, _ in topics.get_publications():
            calls.unregisterPublisher(node.name, name, self.uri)
        for name, uri in services.get_services():
            calls.unregisterService(node.name, name, uri)
    node.parameters.unsubscribe(calls)
    try:
        calls()
        _take_back(node, master)
    except registration.COMMUNICATION_ERRORS as error:
        self.logger.warning('cannot unregister from the master %s: %s', self.master_uri, error)
    topics.close_all()
    services.unregister_all()


def _take_back(node, master):
    """Unregister what could not be registered in time: a master that goes on may come to that call
    after those that were made later."""
    deadline = deadline_in(registration.LATE)
    for unregister, name, uri in tuple(node.unsure):
        while not getattr(master, unregister)(node.name, name, uri)[2]:
            if time.monotonic() > deadline:
                return
            time.sleep(registration.LATE / 20)
