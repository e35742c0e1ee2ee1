"""Register a run's topics and services, and connect its subscriptions; try again after failures.

One thread of this process, the watcher, looks after all runs.
"""
import functools
import socket
import threading
from contextlib import suppress
from time import monotonic  # by name: real, also in a simulation

from pharos.errors import MasterUnreachableError, NodeNameInUseError
from pharos.intraprocess.links import link_topic, runs, runs_lock
from pharos.private_rospy.sharing import share_of
from pharos.private_rospy.xmlrpc import CALLER_ID, UNREACHABLE, ServerProxy
from pharos.transcript import attempt

NAME_LIMIT = 1.0  # seconds for the question whether another node has the name
RETRY_DELAY = 1.0  # seconds until the next attempt to connect
WATCH_PERIOD = 0.5  # seconds between two looks of the watcher
LOOKS_PER_MASTER = 4  # looks of the watcher for each one at the masters
#: rospy's names of registries, in the order of the master's system state -> methods of the master
_REGISTER_METHODS = {
    'pub': 'registerPublisher',
    'sub': 'registerSubscriber',
    'srv': 'registerService',
}
_watch_end = None  # an Event, which ends the watcher
#: (URL of the master, name) -> the run of this process that starts or runs with the name
_names = {}


def enter(run):
    """Enter a run into ``links.runs``; the first one starts the watcher."""
    global _watch_end
    with runs_lock:
        if not runs:
            _watch_end = threading.Event()  # another one: the former watcher may not have ended yet
            threading.Thread(target=_watch, args=[_watch_end], daemon=True).start()
        runs[run.uri] = run


def leave(run):
    """Take a run out of ``links.runs``; the last one ends the watcher."""
    with runs_lock:
        for key in [key for key, owner in _names.items() if owner is run]:
            del _names[key]
        if runs.pop(run.uri, None) and not runs:
            _watch_end.set()  # type: ignore[union-attr]


def take_name(run):
    """Take the name of a run.

    :raises NodeNameInUseError: if a node of this name answers within NAME_LIMIT, or is of this process
    """
    with runs_lock:
        namesake = _names.setdefault((run.master.url, run.name), run)
    if namesake is not run:
        raise NodeNameInUseError(
            f'{run.name} is running already in this process: {namesake.node!r}; choose another name for'
            f' {run.node!r}'
        )
    uri = run.master.call('lookupNode', run.name)
    if not uri:
        return
    name = None
    with suppress(*UNREACHABLE):
        proxy = ServerProxy(uri, NAME_LIMIT)
        proxy.getPid(CALLER_ID)  # raises if the URI is dead
        name = run.name
        # another node may have the URI; roscpp raises
        name = proxy.getName(CALLER_ID)[2]  # type: ignore
    if name == run.name:
        raise NodeNameInUseError(
            f'{name} is running already, at {uri}: choose another name, or end that one'
        )


def register(run, registry, name, data):
    """Register a topic or service at the master; try once, since the watcher repairs the rest.

    :param registry: rospy's name of the registry: 'pub', 'sub' or 'srv'
    :param data: the name of the topic's type, or the URI of the service
    """
    with suppress(MasterUnreachableError):
        publishers = run.master.call(
            _REGISTER_METHODS[registry], name, data, run.uri, caller_id=run.name
        )
        if registry == 'sub' and publishers is not None:
            run.topic_manager.subs[name].publisher_uris = publishers
    if registry == 'pub':
        connect_subscribers(run, name)


def connect_subscribers(run, topic):
    """Have all nodes of this process connect to a new publisher: sooner than by the master's call."""
    for subscriber in list(runs.values()):
        subscription = subscriber.topic_manager.subs.get(topic)
        if subscription and subscriber.master.url == run.master.url:
            _connect(subscription, run.uri)


def connect_all(subscription):
    """Connect a subscription to its publishers, from the last list of the master.

    Link those of this process in this thread, and connect to others in threads.
    """
    for uri in subscription.publisher_uris:
        if uri in runs:
            _connect(subscription, uri)
        else:
            _start_connecting(subscription, uri)


def _connect(subscription, uri):
    """Connect a subscription to a publisher, by a link or a socket.

    Do nothing if they are connected, or if another thread connects them already.

    :param uri: the URI of the publisher's node
    """
    run = subscription.run
    if run.stopping.is_set() or subscription.closed or subscription.has_connection(uri):
        return
    this_attempt = object()
    if subscription.attempts.setdefault(uri, this_attempt) is not this_attempt:
        return
    try:
        publisher_run = runs.get(uri)
        share = share_of(subscription, uri)
        if publisher_run:
            link_topic(publisher_run, run, subscription.resolved_name)
        elif share:
            with share.lock:  # one connects, and the others join
                if not share.join(subscription):
                    _negotiate(subscription, uri)
        else:
            _negotiate(subscription, uri)
    except Exception as error:  # told by the watcher, which tries again
        connect_later(subscription, uri, repr(error))
    finally:
        del subscription.attempts[uri]


def _negotiate(subscription, uri):
    """Have rospy offer the protocols of Run.make_findable() and TCPROS, and connect by one."""
    try:
        code, _, _ = subscription.run.ros_handler._connect_topic(subscription.resolved_name, uri)
    except (AttributeError, UnboundLocalError):
        return  # rospy raises these if the subscription is closed meanwhile
    except RuntimeError as error:  # no thread is left, but rospy has added the connection
        for connection in subscription.connections:
            if connection.endpoint_id == uri:
                subscription.remove_connection(connection)
        connect_later(subscription, uri, str(error))
        return
    if code != 1:
        connect_later(subscription, uri)


def connect_later(subscription, uri, reason=''):
    """Have the watcher connect after RETRY_DELAY, if the master still names the publisher.

    :param reason: the text of the last error, for the log, or ''
    """
    subscription.retries[uri] = monotonic() + RETRY_DELAY, reason


def _retry_connections(run):
    for subscription in list(run.topic_manager.subs.values()):
        for uri, (retry_time, reason) in list(subscription.retries.items()):
            if monotonic() < retry_time:
                continue
            del subscription.retries[uri]
            if uri not in subscription.publisher_uris:
                continue
            if reason:
                topic = subscription.resolved_name
                run.troubles.add(f'{topic}: no connection to {uri}, it is tried again: {reason}')
            _start_connecting(subscription, uri)


def _start_connecting(subscription, uri):
    """Connect in a thread, or later if the system has none left."""
    if not subscription.run.start_thread(functools.partial(_connect, subscription, uri)):
        connect_later(subscription, uri)


# -- the watcher


def _watch(end: threading.Event) -> None:
    """Look after all runs until the last one ends; every two seconds, compare with the masters."""
    look_count = 0
    while not end.wait(WATCH_PERIOD):
        look_count += 1
        for run in list(runs.values()):
            for look in _LOOKS:
                attempt(look, run)
        run = None  # type: ignore[assignment] # else a stopped run would live until the next look
        if look_count % LOOKS_PER_MASTER == 0:
            _ask_masters()


def _check_peers(run):
    """Drop peers that have left (ros_comm #927)."""
    run.topic_manager.check_all()


def _start_threads(run):
    """Start the threads of callback queues that the system had no thread for.

    Only the publisher of its first message starts a new one: in virtual time that has a turn for it.
    """
    for queue in list(run.callback_queue.order.queues):
        if queue.thread is None:
            queue.request_thread()


def _check_clock(run):
    """Tell that a clock stands still; the log has equal texts once a minute."""
    if monotonic() > run.clock_deadline:
        rostime = run.ros.rostime
        if not (rostime.is_wallclock() or rostime.get_time()):
            run.troubles.add('time stands still: /use_sim_time is set, and no /clock comes')


def _close_silent_clients(run):
    """Shut the sockets of clients whose time is over, which wakes the threads that read."""
    for sock, deadline in list(run.deadlines.items()):
        if monotonic() > deadline:
            run.deadlines.pop(sock, None)
            with suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)


def _tell_troubles(run):
    while run.troubles:
        run.ros.logwarn_throttle_identical(60, run.troubles.pop())


_LOOKS = (
    _check_peers,
    _retry_connections,
    _start_threads,
    _check_clock,
    _tell_troubles,
    _close_silent_clients,
)


def _ask_masters() -> None:
    """Ask each master for its system state, and have the runs register again what is missing."""
    live_runs = [run for run in list(runs.values()) if not run.stopping.is_set()]
    for url in {run.master.url for run in live_runs}:
        attempt(_ask_master, url, [run for run in live_runs if run.master.url == url])


def _ask_master(url, url_runs):
    # noted before the question: what is registered meanwhile, the answer may lack
    entries = {run: attempt(_entries_of, run) or set() for run in url_runs}
    try:
        state = ServerProxy(url).getSystemState(CALLER_ID)[2]  # type: ignore[index]
    except UNREACHABLE as error:
        # one line is enough
        url_runs[0].troubles.add(f'no master answers at {url}, it is asked again: {error}')
        return
    for run in url_runs:
        attempt(_register_missing, run, entries[run], state)


def _entries_of(run):
    """Return the topics and services of a run: a set of (registry, name, data of register())."""
    topics = run.topic_manager
    getters = topics.get_publications, topics.get_subscriptions, run.service_manager.get_services
    return {
        (registry, *entry)
        for registry, get_entries in zip(_REGISTER_METHODS, getters)
        for entry in get_entries()
    }


def _register_missing(run, entries, state):
    """Register those of a run's entries that it has still, and that the master's system state lacks.

    If the master knows nothing of the node, set its parameters anew, too.

    :param state: lists of (name, nodes) for publishers, subscribers and services
    """
    registered = {
        (registry, name)
        for registry, rows in zip(_REGISTER_METHODS, state)
        for name, nodes in rows
        if run.name in nodes
    }
    # locked, or a topic closed meanwhile would be registered again
    with run.topic_manager.lock, run.service_manager.lock:
        for registry, name, data in entries & _entries_of(run):
            if (registry, name) in registered or run.stopping.is_set():
                continue
            # not if a namesake of another process has the name now: the master ends this node
            if run.master.call('lookupNode', run.name) in (None, run.uri):
                register(run, registry, name, data)
                if registry == 'sub':
                    connect_all(run.topic_manager.subs[name])
    if not registered and not run.stopping.is_set():  # this is a new master
        # all values before any is set or reported: each such time all of them are read
        for parameter in run.node._parameters:
            parameter.restore()
        # not those that a parameter has restored: its value may be another one by now
        for name, value in run.ros.client.load_command_line_node_params(run.argv).items():
            run.master.parameters.setdefault(f'{run.name}/{name}', value)
        for parameter in run.node._parameters:
            parameter.subscribe()
