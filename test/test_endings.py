"""One life at a time: a node is known here first, its stop() runs once, and what waits for it ends
with it."""
import socket
import threading
import time

import pytest

from helpers import create, ended
from pharos.testing import TIMEOUT, Mailbox, until
from pharos import (
    BlockNode,
    ExternalNode,
    Lifecycle,
    Master,
    Node,
    NodeNameInUseError,
    NodeStoppedError,
    node_registry,
)
from pharos import message_class
from pharos.private_rospy import acceptor, lifetime, local_services, proxies
from pharos.private_rospy.patches import xmlrpc_server
from sockets import refused_url, silent_peer


def in_thread(function, *arguments):
    """Run it in a thread; returns the thread, and a list of what came of it: a value, or an
    exception."""
    outcome = []

    def run():
        try:
            outcome.append(function(*arguments))
        except Exception as error:
            outcome.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread, outcome


# -- known here before the master knows it


def test_a_node_that_starts_or_stops_is_never_one_of_another_process(master):
    seen, over = [], threading.Event()

    def look():
        while not over.is_set():
            seen.extend(node for node in master.nodes() if node.name == '/flickering')

    thread, _ = in_thread(look)
    for _ in range(20):
        with create(master, '/flickering'):
            pass
    over.set()
    assert ended(thread)
    assert {type(node) for node in seen} == {BlockNode}


def test_a_node_that_starts_while_the_master_is_asked_is_one_of_this_process(master, monkeypatch):
    def ask():
        create(master, '/sudden')
        return Master(master.url).system_state()

    with monkeypatch.context() as patch:
        patch.setattr(master, 'system_state', ask)
        found = master.nodes()
    assert [type(node) for node in found if node.name == '/sudden'] == [BlockNode]


def test_a_node_that_is_waited_for_runs(master):
    thread, found = in_thread(master.wait_for_node, '/awaited', TIMEOUT)
    node = create(master, '/awaited')
    assert ended(thread)
    assert found == [node]
    assert node.is_running


def test_of_threads_that_create_a_node_of_one_name_one_wins(master):
    go = threading.Barrier(4)

    def start():
        go.wait(TIMEOUT)
        return create(master, '/contested')

    threads, outcomes = zip(*(in_thread(start) for _ in range(4)))
    assert all(map(ended, threads))
    nodes = [outcome for outcome, in outcomes if isinstance(outcome, BlockNode)]
    errors = [outcome for outcome, in outcomes if isinstance(outcome, NodeNameInUseError)]
    assert (len(nodes), len(errors)) == (1, 3)
    assert all(
        '/contested' in str(error) and 'node of this process' in str(error) for error in errors
    )
    assert nodes[0].is_running
    assert master.node('/contested') is nodes[0]


def test_a_name_is_free_again_when_the_start_has_failed(master):
    with pytest.raises(Exception, match='no ROS master answers'):
        create(Master(refused_url()), '/unlucky')
    assert node_registry.nodes() == []
    assert create(master, '/unlucky').is_running


# -- stop() runs once, to its end


class Careful(Node):
    """Its stop() goes on after super().stop(), until it may end."""

    def __init__(self):
        self.calls, self.begun, self.may_end = [], threading.Event(), threading.Event()

    def stop(self):
        self.calls.append('begun')
        super().stop()
        self.begun.set()
        assert self.may_end.wait(TIMEOUT)
        self.calls.append('ended')


def test_an_overridden_stop_runs_once_and_others_wait_for_its_end(master):
    node = create(master, '/careful', Careful)
    first, _ = in_thread(node.stop)
    assert node.begun.wait(TIMEOUT)
    others = [
        in_thread(ask)[0]
        for ask in (node.stop, node_registry.stop_all, node_registry.spin, lambda: node.__exit__())
    ]
    until(lambda: len(node_registry._waiting) == 3)
    assert all(thread.is_alive() for thread in (first, *others))
    node.may_end.set()
    assert all(map(ended, (first, *others)))
    node.stop()
    assert node.calls == ['begun', 'ended']


def test_an_overridden_stop_runs_once_for_each_start(master):
    node = create(master, '/careful', Careful)
    node.may_end.set()
    node.stop()
    node.start()
    with node:
        node.stop()
    assert node.calls == ['begun', 'ended'] * 2


@pytest.mark.parametrize('how', ['delegate', 'soul', 'rosnode kill'])
def test_a_stop_that_comes_from_the_node_itself_is_waited_for(master, how):
    node = create(master, '/careful', Careful)
    if how == 'delegate':
        node.interested_in(
            '/careful_end', 'std_msgs/Empty', delegate=lambda message, channel: node.stop()
        )
        node.send_to('/careful_end')
    elif how == 'soul':
        node.fork(lambda me: me.stop())
    else:
        ExternalNode(master, '/careful').shutdown()
    assert node.begun.wait(TIMEOUT)
    thread, _ = in_thread(node.stop)
    until(lambda: node_registry._waiting)
    assert thread.is_alive()
    node.may_end.set()
    assert ended(thread)
    assert node.calls == ['begun', 'ended']


def test_a_stop_may_be_a_hook_of_rospys(master, transcript):
    """rospy runs the other hooks, which close the servers, only afterwards."""
    node = create(master, '/hooked')
    node.ros.on_shutdown(node.stop)
    node.ros.signal_shutdown('done')
    until(lambda: node.lifecycle is Lifecycle.STOPPED)
    assert transcript == []  # nothing was left behind


def test_a_mixins_stop_runs_once_too(master):
    class Mixin:
        calls = 0

        def stop(self):
            super().stop()
            Mixin.calls += 1
            self.stop()

    class Mixed(Mixin, BlockNode):
        pass

    node = create(master, '/mixed', Mixed)
    node.stop()
    node.stop()
    assert Mixin.calls == 1


def test_each_of_several_overriding_stops_runs_once_in_order(master):
    calls = []

    class Middle(Node):
        def stop(self):
            calls.append('middle')
            super().stop()
            calls.append(self.lifecycle)

    class Last(Middle):
        def stop(self):
            super().stop()
            calls.append('last')

    create(master, '/layered', Last).stop()
    assert calls == ['middle', Lifecycle.STOPPED, 'last']


@pytest.mark.parametrize('fails', [True, False], ids=['raises', 'forgets super().stop()'])
def test_a_node_is_stopped_when_its_stop_has_ended_however(master, fails):
    class Clumsy(Node):
        def stop(self):
            if fails:
                raise ZeroDivisionError

    node = create(master, '/clumsy', Clumsy)
    if fails:
        with pytest.raises(ZeroDivisionError):
            node.stop()
    else:
        node.stop()
    assert node.lifecycle is Lifecycle.STOPPED
    assert '/clumsy' not in [each.name for each in master.nodes()]


def test_a_node_is_stopped_whatever_a_part_of_that_raises(master, monkeypatch):
    def log(self, text):
        raise ZeroDivisionError

    release = threading.Event()
    node = create(master, '/clumsy', type('Clumsy', (Node,), {'log': log}))
    node.fork(lambda me: release.wait(TIMEOUT))
    monkeypatch.setattr(type(node), 'stop_timeout', None)
    with pytest.raises(TypeError, match='level'):  # as it tells of the soul that does not end
        node.stop()
    release.set()
    create(master, '/clumsy')


def test_nodes_that_stop_each_other_do_not_wait_for_ever(master):
    both = threading.Barrier(2)

    class Partner(Node):
        def stop(self):
            both.wait(TIMEOUT)
            self.other.stop()
            super().stop()

    first, second = create(master, '/partner', Partner), create(master, '/partner_too', Partner)
    first.other, second.other = second, first
    begin = time.monotonic()
    node_registry.stop_all()
    assert time.monotonic() - begin < node_registry.STOP_LIMIT / 2
    assert first.lifecycle is second.lifecycle is Lifecycle.STOPPED


def test_a_stop_that_does_not_end_is_given_up(master, monkeypatch):
    monkeypatch.setattr(node_registry, 'STOP_LIMIT', 0.2)
    node = create(master, '/careful', Careful)
    thread, _ = in_thread(node.stop)
    assert node.begun.wait(TIMEOUT)
    node_registry.spin()
    node_registry.stop_all()
    assert thread.is_alive()
    node.may_end.set()
    assert ended(thread)


def test_a_node_may_start_again_at_the_end_of_its_stop(master):
    class Phoenix(Node):
        def stop(self):
            super().stop()
            if not hasattr(self, 'rose'):
                self.rose = True
                self.start()

    node = create(master, '/phoenix', Phoenix)
    node.stop()
    assert node.is_running
    assert master.node('/phoenix') is node
    node.stop()
    assert not node.is_running


def test_a_soul_in_spin_ends_with_its_node(master, monkeypatch):
    has_nodes, spinning = node_registry._has_nodes_to_wait_for, threading.Event()
    monkeypatch.setattr(
        node_registry, '_has_nodes_to_wait_for', lambda: spinning.set() or has_nodes()
    )
    node, other = create(master, '/node'), create(master, '/other')
    soul = node.fork(lambda me: node_registry.spin())
    assert spinning.wait(TIMEOUT)
    node.stop()
    assert not soul.is_alive()
    assert other.is_running


# -- stop() during the start


def test_what_a_start_opens_is_not_for_a_later_run(master):
    """It opened a second channel there, and each message came twice."""
    slow, go_on = threading.Event(), threading.Event()

    class Slow(Node):
        def start(self):
            super().start()
            if not slow.is_set():
                slow.set()
                assert go_on.wait(TIMEOUT)
            self.interested_in('/t', 'std_msgs/String')

    starting, outcome = in_thread(create, master, '/slow', Slow)
    assert slow.wait(TIMEOUT)
    (node,) = node_registry.nodes()
    node.stop()
    node.start()
    go_on.set()
    assert ended(starting)
    assert isinstance(outcome[0], NodeStoppedError)
    assert node.is_running
    assert len(node.channels) == 1


def test_a_stop_during_the_start_ends_it(master, monkeypatch):
    from pharos.private_rospy import registration

    claim, claiming, go_on = registration.claim_name, threading.Event(), threading.Event()

    def claim_name(*arguments):
        claim(*arguments)
        claiming.set()
        assert go_on.wait(TIMEOUT)

    monkeypatch.setattr(registration, 'claim_name', claim_name)
    starting, outcome = in_thread(create, master, '/premature')
    assert claiming.wait(TIMEOUT)
    (node,) = node_registry.nodes()
    assert node.lifecycle is Lifecycle.STARTING
    stop, _ = in_thread(node.stop)
    until(lambda: node_registry._waiting)
    go_on.set()
    assert ended(starting)
    assert ended(stop)
    assert isinstance(outcome[0], NodeStoppedError)
    assert '/premature' in str(outcome[0])
    assert node.lifecycle is Lifecycle.NEW
    assert node_registry.nodes() == []
    assert '/premature' not in [each.name for each in master.nodes()]
    monkeypatch.undo()
    node.start()
    assert node.is_running


def test_stops_at_any_time_of_the_start_leave_nothing(master):
    """At 30 times spread over the start."""
    begin = time.perf_counter()
    create(master, '/premature').stop()
    duration = time.perf_counter() - begin
    for turn in range(30):
        starting, outcome = in_thread(create, master, '/premature')
        until(lambda: node_registry.nodes() or outcome)
        threading.Event().wait(duration * turn / 30)
        node_registry.stop_all()
        assert ended(starting)
        assert isinstance(outcome[0], (NodeStoppedError, BlockNode))
        assert node_registry.nodes() == []
        assert '/premature' not in [each.name for each in master.nodes()]


def test_a_node_stopped_before_it_accepts_anybody_ends_its_threads(master, monkeypatch):
    """A socket that is shut and then told to listen would listen for ever."""
    late, accept = threading.Event(), acceptor.Acceptor.accept

    def accept_late(self, listener, serve):
        late.wait(TIMEOUT)
        accept(self, listener, serve)

    monkeypatch.setattr(acceptor.Acceptor, 'accept', accept_late)
    node = master.create(BlockNode, named='/late', domain='127.0.0.1')
    accepting = [thread for thread in threading.enumerate() if thread.name.startswith('/late')]

    def shutdown_and_tell(sock):
        shutdown_socket(sock)
        late.set()

    shutdown_socket = xmlrpc_server.shutdown_socket
    monkeypatch.setattr(xmlrpc_server, 'shutdown_socket', shutdown_and_tell)
    stopping = threading.Thread(target=node.stop, daemon=True)
    stopping.start()
    stopping.join(TIMEOUT)
    assert not stopping.is_alive()
    assert not any(thread.is_alive() for thread in accepting)


def test_a_connection_that_is_closed_before_it_connects_ends_quietly(master):
    node = create(master, '/node')
    tcpros = node.ros.impl.tcpros_pubsub
    subscription = tcpros.TCPROSSub('/t', message_class('std_msgs/String'))
    connection = tcpros.TCPROSTransport(subscription, '/t')
    connection.close()  # by the stop of the node
    tcpros.robust_connect_subscriber(connection, '127.0.0.1', node.tcp_port, node.uri, print, '/t')


def test_a_stop_ends_a_start_at_a_master_that_says_nothing():
    with silent_peer() as url:
        starting, outcome = in_thread(create, Master(url), '/premature')
        until(node_registry.nodes)
        node_registry.stop_all()
        assert ended(starting)
        assert isinstance(outcome[0], NodeStoppedError)
        assert node_registry.nodes() == []


def test_what_a_block_starts_while_all_nodes_are_stopped_is_stopped_too(master):
    worker, supervisor = create(master, '/worker'), create(master, '/supervisor')
    supervisor.stop_timeout = TIMEOUT

    def supervise(me):
        until(lambda: not worker.is_running)
        worker.restart()

    soul = supervisor.fork(supervise)
    node_registry.stop_all()
    assert ended(soul)
    assert node_registry.nodes() == [] and not supervisor.errors


# -- what waits ends with the node


def loop(me):
    channel = me.output_channel('/nobody', 'std_msgs/Empty')
    while not channel.wait_for_subscribers(timeout=TIMEOUT):
        pass


def silent():
    """The URL of something that never answers."""
    listener = socket.create_server(('127.0.0.1', 0))
    LISTENERS.append(listener)
    return 'http://127.0.0.1:%d/' % listener.getsockname()[1]


LISTENERS = []
WAITS = {
    'wait_for_subscribers': lambda me: me.output_channel(
        '/nobody', 'std_msgs/Empty'
    ).wait_for_subscribers(),
    'wait_for_subscribers in a loop': loop,
    'wait_for_node': lambda me: me.master.wait_for_node('/nobody'),
    'Master.wait': lambda me: Master(refused_url()).wait(),
    'Master.wait for one that says nothing': lambda me: Master(silent()).wait(),
    'an offer, of one that says nothing': lambda me: Master(silent()).wait_for_service('/s'),
    'wait_for_node, of one that says nothing': lambda me: Master(silent()).wait_for_node('/n'),
    'a subscriber that says nothing': lambda me: me.output_channel('/mute', 'std_msgs/Empty'),
    'the type of a topic': lambda me: me.interested_in('/untold', wait=TIMEOUT),
    'a publisher that does not connect': lambda me: me.interested_in('/slow', 'std_msgs/Empty'),
    'a subscriber that does not connect': lambda me: me.send_to('/fast', typed_as='std_msgs/Empty'),
    'a service': lambda me: me.master.lookup_service('/sleep').call(timeout=TIMEOUT),
    'a service elsewhere': lambda me: me.master.lookup_service('/sleep_elsewhere').call(),
}


@pytest.fixture
def waiting(master, monkeypatch):
    """Peers that do not connect, and services that do not answer; returns an event set when one is
    waited for."""
    peer, waiting, over = create(master, '/slow_peer'), threading.Event(), threading.Event()
    peer.output_channel('/slow', 'std_msgs/Empty')
    peer.interested_in('/fast', 'std_msgs/Empty')
    mute = silent()
    master.api('/mute_one').registerSubscriber('/mute', 'std_msgs/Empty', mute)
    monkeypatch.setattr('pharos.master_calls.PING_TIMEOUT', TIMEOUT)
    monkeypatch.setattr('pharos.master_calls.TIMEOUT', TIMEOUT)

    def sleep(request):
        waiting.set()
        over.wait(TIMEOUT)

    peer.serve('/sleep', 'std_srvs/Empty', sleep)
    peer.serve('/sleep_elsewhere', 'std_srvs/Empty', sleep)
    monkeypatch.setattr(
        'pharos.private_rospy.connections.Connections.sends_to', lambda self, name, topic: False
    )
    monkeypatch.setattr('pharos.output_channel.OutputChannel.connections', [])
    monkeypatch.setattr(
        'pharos.private_rospy.local_services.find',
        lambda name, *rest, find=local_services.find: (
            find(name, *rest) if name == '/sleep' else None
        ),
    )
    yield waiting
    over.set()
    master.api('/mute_one').unregisterSubscriber('/mute', mute)
    while LISTENERS:
        LISTENERS.pop().close()


# a delegate is told, and must end itself
@pytest.mark.parametrize(
    'where, name',
    [
        (where, name)
        for where in ('soul', 'executed soul', 'delegate')
        for name in WAITS
        if (where, name) != ('delegate', 'wait_for_subscribers in a loop')
    ],
)
def test_what_waits_ends_with_the_node(master, waiting, monkeypatch, where, name):
    node, waiter = create(master, '/waiter'), []
    node.connect_timeout = node.stop_timeout = TIMEOUT

    def run(me):
        waiter.append(threading.get_ident())
        if 'service' not in name:  # there, it is the peer who knows
            monkeypatch.setattr(lifetime.Interruption, '__enter__', enter)
            monkeypatch.setattr('pharos.topic.POLL', TIMEOUT)
            if 'type' in name:
                waiting.set()
        WAITS[name](me)
        me.sleep(0)

    def enter(self, really=lifetime.Interruption.__enter__):
        if threading.get_ident() in waiter:  # others wait, too, while the node opens its channel
            waiting.set()
        return really(self)

    if where == 'delegate':
        sender = create(master, '/sender').output_channel('/go', 'std_msgs/Empty', latch=True)
        sender.publish(message_class('std_msgs/Empty')())
        node.delegate = lambda message, channel: run(node)
        thread, _ = in_thread(node.interested_in, '/go', 'std_msgs/Empty')
    elif where == 'soul':
        thread = node.fork(run)
    else:
        node.soul = run
        thread, _ = in_thread(node.execute)
    assert waiting.wait(TIMEOUT)
    begin = time.monotonic()
    node.stop()
    assert ended(thread)
    assert time.monotonic() - begin < TIMEOUT / 2
    assert not [thread for thread in threading.enumerate() if thread.name.startswith('/waiter ')]
    assert not node.errors


@pytest.mark.parametrize(
    'wait',
    [
        lambda me: me.master.wait_for_service('/nobodys'),
        lambda me: me.master.wait_for_node('/nobody'),
        lambda me: Master(refused_url()).wait(),
        lambda me: me.wait_for_message('/nobodys', 'std_msgs/Empty'),
    ],
    ids=['service', 'node', 'master', 'message'],
)
def test_a_wait_without_limit_that_begins_after_the_stop_has_begun_ends(master, wait):
    """The last words of a soul may wait for something, but not for ever."""
    node = create(master, '/late')
    stops = node.latest_run.rospy.ended
    ended_by = Mailbox()

    def soul(me):
        assert stops.wait(TIMEOUT)
        try:
            wait(me)
        except NodeStoppedError as error:
            ended_by(error, None)

    node.stop_timeout = TIMEOUT
    soul_thread = node.fork(soul)
    node.stop()
    assert ended(soul_thread)
    assert ended_by.next()


class StartsSlowly(threading.Event):
    """The event by which a thread tells that it has begun: it has an identity long before."""

    def __init__(self):
        super().__init__()
        self.reached, self.allowed = threading.Event(), threading.Event()

    def set(self):
        self.reached.set()
        assert self.allowed.wait(TIMEOUT)
        super().set()


def test_a_thread_that_is_only_just_beginning_is_not_waited_for():
    life = lifetime.Lifetime('/slow')
    thread = life.Thread(target=lambda: None)
    thread._started = started = StartsSlowly()
    starter, _ = in_thread(thread.start)
    assert started.reached.wait(TIMEOUT)
    assert thread.ident is not None
    assert life.finish_shutdown() == []
    started.allowed.set()
    assert ended(starter)


def test_a_part_of_a_wait_that_begins_after_the_stop_began_ends_too():
    life, woken, parts = lifetime.Lifetime('/node'), threading.Event(), threading.Event()
    with life.interrupts_waits(), lifetime.Interruption(woken.set):
        life.begin_shutdown()
        with lifetime.Interruption(parts.set) as part:
            assert woken.is_set()
            assert parts.is_set()
            assert part.came
    with life.interrupts_waits(), lifetime.Interruption(parts.set) as last_words:
        assert not last_words.came


def test_a_call_that_is_ended_before_it_has_connected_is_not_waited_for():
    with silent_peer() as url:
        proxy = proxies.ServerProxy(url, 10 * TIMEOUT)
        connected = threading.Event()

        class Shutting(proxies._Connection):
            """What another thread may do just before there is a socket."""

            def connect(self):
                proxy('transport').shut()
                connected.set()
                super().connect()

        address = url[len('http://') : -1]
        proxy('transport')._connection = address, Shutting(address, proxy('transport')._limits)
        with pytest.raises(OSError):
            proxy.getPid('/caller')
        assert connected.is_set()
