"""One look at the graph: processes, hosts, connections, and nodes that do not answer."""
import contextlib
import dataclasses
import json
import os
import signal
import time
import xmlrpc.server

import pytest

from helpers import create, in_thread
from pharos import Master, MasterUnreachableError
from pharos.external_node import node_api
from pharos.live import snapshot, top
from pharos.live.answers import Count
from pharos.live.snapshot import ALIVE, DEAD, SILENT, Connection
from pharos.live.traffic import Traffic
from pharos.testing import TIMEOUT, Mailbox, until
from sockets import refused_url, silent_peer

STRING = 'std_msgs/String'


@contextlib.contextmanager
def registered(master, name, uri, topic='/snapshot_strange'):
    """A node of that name, of which the master knows this URI and that it publishes a topic."""
    master.api(name).registerPublisher(topic, STRING, uri)
    yield
    master.api(name).unregisterPublisher(topic, uri)


@contextlib.contextmanager
def answering(**methods):
    """The URI of a node that has only these methods of the slave API."""
    server = xmlrpc.server.SimpleXMLRPCServer(('127.0.0.1', 0), logRequests=False)
    for name, method in methods.items():
        server.register_function(method, name)
    thread = in_thread(server.serve_forever)
    yield 'http://127.0.0.1:%d/' % server.server_address[1]
    server.shutdown()
    server.server_close()
    thread.join(TIMEOUT)


def test_nodes_of_one_process_are_together_and_others_apart(master):
    create(master, '/snapshot_one')
    create(master, '/snapshot_two')
    with master.run(
        'topic_tools', 'relay', '/snapshot_a', '/snapshot_b', name='snapshot_cpp'
    ) as cpp:
        master.wait_for_node('/snapshot_cpp', TIMEOUT)
        seen = snapshot.take(master)
        (host,) = seen.hosts
        assert host.is_here
        assert {process.pid: process.nodes for process in host.processes} == {
            os.getpid(): ['/snapshot_one', '/snapshot_two'],
            cpp.pid: ['/snapshot_cpp'],
        }
        assert [seen.nodes[name].is_own for name in sorted(seen.nodes)] == [False, True, True]
        assert {node.state for node in seen.nodes.values()} == {ALIVE}


def test_connections_have_a_direction_and_a_transport(master):
    one, two = create(master, '/snapshot_one'), create(master, '/snapshot_two')
    sent = one.output_channel('/snapshot_a', STRING)
    two.interested_in('/snapshot_a', STRING)
    with master.run('topic_tools', 'relay', '/snapshot_a', '/snapshot_b', name='snapshot_cpp'):
        assert sent.wait_for_subscribers(2, TIMEOUT)
        seen = snapshot.take(master)
        assert seen.connections == [
            Connection('/snapshot_a', '/snapshot_one', '/snapshot_cpp', 'TCPROS'),
            Connection('/snapshot_a', '/snapshot_one', '/snapshot_two', 'INTRAPROCESS'),
        ]
        assert seen.transports == {
            ('/snapshot_a', '/snapshot_one', '/snapshot_cpp'): {'TCPROS'},
            ('/snapshot_a', '/snapshot_one', '/snapshot_two'): {'INTRAPROCESS'},
        }


def test_topics_and_services_are_those_of_the_master(master):
    node = create(master, '/snapshot_one')
    node.output_channel('/snapshot_a', STRING)
    node.interested_in('/snapshot_any', 'std_msgs/Empty')
    node.serve('/snapshot_service', 'std_srvs/Empty', lambda request: {})
    seen = snapshot.take(master)
    topic = seen.topics['/snapshot_a']
    assert (topic.type, topic.publishers, topic.subscribers) == (STRING, [node.name], [])
    assert seen.topics['/snapshot_any'].subscribers == [node.name]
    assert seen.services['/snapshot_service'].providers == [node.name]
    assert '/snapshot_a' in seen.nodes[node.name].publishes
    assert seen.nodes[node.name].hears == ['/snapshot_any']
    assert '/snapshot_service' in seen.nodes[node.name].offers


def test_a_topic_of_any_type_has_none(master):
    node = create(master, '/snapshot_one')
    node.ros.Subscriber('/snapshot_untyped', node.ros.AnyMsg)
    assert snapshot.take(master).topics['/snapshot_untyped'].type is None


def test_dead_and_silent_nodes_are_marked_and_cost_no_more_than_the_time_limit(master):
    create(master, '/snapshot_one')
    with contextlib.ExitStack() as stack:
        for number in range(10):
            silent = stack.enter_context(silent_peer())
            stack.enter_context(registered(master, f'/snapshot_silent_{number}', silent))
            stack.enter_context(registered(master, f'/snapshot_dead_{number}', refused_url()))
        before = time.monotonic()
        seen = snapshot.take(master, timeout=0.5)
        assert time.monotonic() - before < 10 * 0.5
    states = {name: node.state for name, node in seen.nodes.items() if 'snapshot' in name}
    assert states == {
        '/snapshot_one': ALIVE,
        **{f'/snapshot_silent_{number}': SILENT for number in range(10)},
        **{f'/snapshot_dead_{number}': DEAD for number in range(10)},
    }
    assert 'refused' in seen.nodes['/snapshot_dead_0'].problem
    assert seen.nodes['/snapshot_silent_0'].problem
    assert seen.nodes['/snapshot_silent_0'].pid is None
    alone = [process.nodes for process in seen.hosts[0].processes if process.pid is None]
    assert sorted(alone) == sorted([name] for name in states if name != '/snapshot_one')


def test_a_node_that_is_stopped_by_a_debugger_is_silent_and_alive_afterwards(master):
    with master.run('topic_tools', 'relay', '/snapshot_a', name='snapshot_cpp') as program:
        master.wait_for_node('/snapshot_cpp', TIMEOUT)
        os.kill(program.pid, signal.SIGSTOP)
        try:
            assert snapshot.take(master, 0.3).nodes['/snapshot_cpp'].state == SILENT
        finally:
            os.kill(program.pid, signal.SIGCONT)
        until(lambda: snapshot.take(master).nodes['/snapshot_cpp'].state == ALIVE)


def test_a_host_that_nobody_knows_is_dead_under_its_own_name(master):
    uri = 'http://nobody.invalid:1234/'
    with registered(master, '/snapshot_lost', uri):
        seen = snapshot.take(master, 5)
        assert seen.nodes['/snapshot_lost'].host == 'nobody.invalid'
        assert seen.nodes['/snapshot_lost'].state == DEAD
        assert 'nobody.invalid' in [host.name for host in seen.hosts]


def test_what_a_subscriber_alone_tells_is_a_connection_too_whatever_its_transport(master):
    node = create(master, '/snapshot_one')
    bus_info = [
        [1, node.uri, 'i', 'UDPROS', '/snapshot_a', 1],
        [2, node.uri.rstrip('/'), 'i', 'UDPROS', '/snapshot_b'],  # as older nodes tell it
        [3, node.uri, 'i', 'UDPROS', '/snapshot_c', 0],  # not connected
    ]
    methods = {'getPid': lambda caller: [1, '', 42], 'getBusInfo': lambda caller: [1, '', bus_info]}
    with answering(**methods) as uri, registered(master, '/snapshot_udp', uri):
        seen = snapshot.take(master)
        assert seen.connections == [
            Connection('/snapshot_a', node.name, '/snapshot_udp', 'UDPROS'),
            Connection('/snapshot_b', node.name, '/snapshot_udp', 'UDPROS'),
        ]
        assert seen.nodes['/snapshot_udp'].pid == 42


def test_a_node_that_answers_nonsense_is_marked_with_what_it_said(master):
    methods = {'getPid': lambda caller: [1, '', 42], 'getBusInfo': lambda caller: [-1, 'no', 0]}
    with answering(**methods) as uri, registered(master, '/snapshot_odd', uri):
        node = snapshot.take(master).nodes['/snapshot_odd']
        assert (node.pid, node.state, node.problem) == (42, SILENT, 'no')


GOOD = {'getPid': 42, 'getBusInfo': [], 'getBusStats': [[], [], []]}


@pytest.mark.parametrize(
    'odd, state',
    [
        ({'getBusInfo': [[1, 5, 'o', {'x': 1}, 7]]}, SILENT),
        ({'getBusInfo': [[1, '/x', 'o', 'TCPROS', ['/t']]]}, SILENT),
        ({'getPid': -1}, SILENT),
        ({'getBusStats': [[['/t', 'x', [[1, 'many', 'much', True]]]], [], []]}, ALIVE),
        ({'getBusStats': [[['/t', 'x', [[1, float('nan'), 5, True]]]], [], []]}, ALIVE),
        ({'pharosHealth': {'class': 'Odd'}}, ALIVE),
        ({'pharosHealth': 'text'}, ALIVE),
        ({'pharosHealth': {'class': 5, 'dropped': {'/t': 'many'}}}, ALIVE),
    ],
)
def test_a_node_with_odd_answers_harms_no_other(master, odd, state):
    create(master, '/snapshot_good')
    methods = {
        name: lambda caller, value=value: [1, '', value] for name, value in {**GOOD, **odd}.items()
    }
    with answering(**methods) as uri, registered(master, '/snapshot_odd', uri):
        seen = snapshot.take(master, counts=True, plain=set())
        odd_node = seen.nodes['/snapshot_odd']
        assert (odd_node.state, bool(odd_node.problem)) == (state, state == SILENT)
        assert seen.nodes['/snapshot_good'].state == ALIVE
        measured = top.measure(master, 0.1)
        json.dumps([dataclasses.asdict(measured), master.graph(0.1).as_dict()], allow_nan=False)
        assert '/snapshot_odd' in master.graph().text()


def test_a_node_with_an_address_that_is_none_is_dead(master):
    with registered(master, '/snapshot_odd', 'http://[broken/'):
        assert snapshot.take(master).nodes['/snapshot_odd'].state == DEAD


def test_nodes_of_another_master_are_not_in_it(master):
    create(master, '/snapshot_one')
    with Master.embedded() as other:
        create(other, '/snapshot_other')
        assert '/snapshot_other' not in snapshot.take(master).nodes
        assert snapshot.take(other).nodes['/snapshot_other'].is_own


def test_it_is_ready_for_json(master):
    node = create(master, '/snapshot_one')
    node.output_channel('/snapshot_a', STRING)
    text = json.dumps(dataclasses.asdict(snapshot.take(master)))
    assert json.loads(text)['topics']['/snapshot_a']['type'] == STRING


def test_without_a_master_it_says_so():
    with pytest.raises(MasterUnreachableError, match='roscore'):
        snapshot.take(Master(refused_url()))


def test_a_killed_node_is_dead(master):
    program = master.run('topic_tools', 'relay', '/snapshot_a', name='snapshot_cpp')
    master.wait_for_node('/snapshot_cpp', TIMEOUT)
    uri = master.uri_of('/snapshot_cpp')
    os.kill(program.pid, signal.SIGKILL)
    program.wait(TIMEOUT)
    try:
        until(lambda: snapshot.take(master).nodes['/snapshot_cpp'].state == DEAD)
    finally:
        api = master.api('/snapshot_cpp')
        publishers, subscribers, services = master.system_state()
        for topics, unregister in (publishers, api.unregisterPublisher), (
            subscribers,
            api.unregisterSubscriber,
        ):
            for topic, nodes in topics.items():
                if '/snapshot_cpp' in nodes:
                    unregister(topic, uri)
        for service, nodes in services.items():
            if '/snapshot_cpp' in nodes:
                api.unregisterService(service, api.lookupService(service))


def test_each_connection_counts_its_messages_within_the_process_and_to_cpp_and_from_it(master):
    one, two = create(master, '/snapshot_one'), create(master, '/snapshot_two')
    mailbox = Mailbox()
    two.interested_in('/snapshot_counted', STRING, mailbox)
    sent = one.output_channel('/snapshot_counted', STRING)
    two.interested_in('/snapshot_relayed', STRING, mailbox)
    arguments = '/snapshot_counted', '/snapshot_relayed'
    with master.run('topic_tools', 'relay', *arguments, name='snapshot_cpp'):
        assert sent.wait_for_subscribers(2, TIMEOUT)
        sent.send(data='the first, after which relay advertises')
        until(lambda: master.topic('/snapshot_relayed').publishers)
        until(lambda: two.channels[1].connections)
        before = snapshot.take(master, counts=True)
        for _ in range(10):
            sent.send(data='one')
        mailbox.wait_for(lambda message: message.data == 'one')
        until(lambda: two.channels[1].received >= 10)
        after = snapshot.take(master, counts=True)

    def messages(each):
        return (each.received or each.sent).messages

    former = {connection.key: connection for connection in before.connections}
    counted = {
        (each.topic, each.subscriber): (messages(each) - messages(former[each.key]), each.transport)
        for each in after.connections
    }
    assert counted == {
        ('/snapshot_counted', '/snapshot_two'): (10, 'INTRAPROCESS'),
        ('/snapshot_counted', '/snapshot_cpp'): (10, 'TCPROS'),
        ('/snapshot_relayed', '/snapshot_two'): (10, 'TCPROS'),
    }
    relayed = next(each for each in after.connections if each.topic == '/snapshot_relayed')
    for count in relayed.sent, relayed.received:
        assert count.messages >= 10 and count.bytes > 10 * len('one')


def look(seconds, **counts):
    """Connections of publishers and subscribers of one letter each, which these have counted."""
    return [
        Connection(
            '/t', '/' + ends[0], '/' + ends[1], 'TCPROS', received=Count(of, *sizes, seconds)
        )
        for ends, (of, *sizes) in counts.items()
    ]


def test_rates_are_those_of_all_publishers_whoever_hears_them():
    before = look(10.0, ax=(1, 100, 0), ay=(1, 200, 0), bx=(2, 300, 0), cx=(3, 400, 0))
    # c has connected anew, d is new
    after = look(12.0, ax=(1, 120, 0), ay=(1, 210, 0), bx=(2, 302, 0), cx=(3, 5, 0), dx=(4, 7, 0))
    traffic = Traffic(before, after)
    assert traffic.of_topic == {'/t': 10.0 + 1.0}
    assert traffic.sent == {'/a': 10.0, '/b': 1.0}
    assert traffic.received == {'/x': 10.0 + 1.0, '/y': 5.0}


def test_a_connection_made_anew_has_no_rate_though_it_has_carried_more_since():
    before = look(10.0, ax=(1, 3, 18_000_000))
    assert Traffic(before, look(11.0, ax=(2, 5, 500))).bandwidth == {}
    assert Traffic(before, look(11.0, ax=(1, 5, 18_000_500))).bandwidth == {'/t': 500}


def test_bytes_that_wrap_are_counted_on():
    before, after = look(10.0, ax=(1, 3, 2**31 - 100)), look(11.0, ax=(1, 5, 400 - 2**31))
    assert Traffic(before, after).bandwidth == {'/t': 500}


def test_a_node_that_does_not_count_is_alive_all_the_same(master):
    bus_info = [[1, 'http://elsewhere/', 'i', 'TCPROS', '/snapshot_a', 1]]
    methods = {'getPid': lambda caller: [1, '', 42], 'getBusInfo': lambda caller: [1, '', bus_info]}
    with answering(**methods) as uri, registered(master, '/snapshot_plain', uri):
        seen = snapshot.take(master, counts=True)
        assert seen.connections == [
            Connection('/snapshot_a', 'http://elsewhere/', '/snapshot_plain', 'TCPROS')
        ]
        assert seen.nodes['/snapshot_plain'].state == ALIVE


def test_the_connections_of_a_node_have_different_numbers(master):
    one, two = create(master, '/snapshot_one'), create(master, '/snapshot_two')
    for node in one, two:
        node.interested_in('/snapshot_a', STRING)
        node.output_channel('/snapshot_a', STRING)
    with master.run('topic_tools', 'relay', '/snapshot_a', name='snapshot_cpp'):
        until(lambda: len(one.channels[1].connections) == 3)
        numbers = [each[0] for each in node_api(one.uri).getBusInfo('/test')[2]]
        assert len(numbers) == 5 and len(set(numbers)) == 5


@contextlib.contextmanager
def counting(master, name, pause=lambda: None):
    """A node whose connection carries 1000 messages a second, each of 10 bytes, and which takes its
    time before it tells."""
    since = time.monotonic()

    def stats(caller):
        pause()
        count = int(1000 * (time.monotonic() - since))
        return [1, '', [[], [['/snapshot_a', [[1, 10 * count, count, -1, 1]]]], []]]

    methods = {
        'getPid': lambda caller: [1, '', 42],
        'getBusInfo': lambda caller: [1, '', [[1, 'http://x/', 'i', 'TCPROS', '/snapshot_a', 1]]],
        'getBusStats': stats,
    }
    with answering(**methods) as uri, registered(master, name, uri):
        yield


def test_rates_are_right_however_long_a_node_takes_to_answer(master):
    pauses = [0, 0.5]
    with counting(master, '/snapshot_slow', lambda: time.sleep(pauses.pop(0))):
        before, after = (snapshot.take(master, 5, counts=True) for _ in range(2))
    traffic = Traffic(before.connections, after.connections)
    assert 900 < traffic.of_topic['/snapshot_a'] < 1100
    assert 9000 < traffic.bandwidth['/snapshot_a'] < 11000


def test_the_clock_may_be_set_back_between_two_looks(master, monkeypatch):
    with counting(master, '/snapshot_slow', lambda: time.sleep(0.2)):
        before = snapshot.take(master, 5, counts=True)
        with monkeypatch.context() as patch:
            patch.setattr(snapshot.time, 'time', lambda: before.time - 5)
            after = snapshot.take(master, 5, counts=True)
    assert after.time < before.time
    assert Traffic(before.connections, after.connections).of_topic['/snapshot_a'] > 500


def test_the_uris_of_all_nodes_are_asked_for_in_one_call(master):
    calls = []
    names = [create(master, f'/snapshot_{number}').name for number in range(3)]
    real = master.api

    class Calls:
        def __init__(self, api):
            self._api, self.caller_id = api, api.caller_id

        handle = property(lambda self: calls.append(1) or self._api.handle)

    master.api = lambda *args: Calls(real(*args))
    try:
        uris = snapshot.uris_of(master, [*names, '/snapshot_gone'])
    finally:
        del master.api
    assert uris == {**{name: master.uri_of(name) for name in names}, '/snapshot_gone': None}
    assert calls == [1]
