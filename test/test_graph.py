"""The graph: what a Master finds, and the nodes outside this process."""
import concurrent.futures
import http.server
import os
import queue
import signal
import sys
import threading

import pytest
import rosgraph

from helpers import InProcessMaster, create
from pharos.testing import TIMEOUT
import pharos
from pharos import ExternalNode, Master, UnknownNodeError, UnknownTopicError, watcher
from pharos.errors import MasterUnreachableError, UnknownServiceError
from programs import PROGRAMS, Program
from sockets import refused_url, silent_peer, unused_url

STRING = 'std_msgs/String'


def peer(master, name):
    """A rospy node of its own process: hears /to_peers, sends its name on /from_peers when ~clear
    is called."""
    program = Program(master.url, sys.executable, PROGRAMS / 'graph_peer.py', name)
    program.wait_for('is ready')
    return program


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """The masters are looked at more often: a test would wait for seconds."""
    monkeypatch.setattr(watcher, 'PERIOD', 0.05)


@pytest.fixture
def bare():
    """A master that has nothing on it."""
    ros_master = InProcessMaster()
    yield Master(ros_master.url)
    pharos.node_registry.stop_all()
    ros_master.stop()


# -- the master


def test_a_bare_master_has_nothing(bare):
    assert bare.is_reachable()
    assert bare.wait(0) is bare
    assert (bare.nodes(), bare.topics(), bare.services(), bare.topic_types()) == ([], [], [], [])
    assert bare.system_state() == ({}, {}, {})
    assert (list(bare.parameters), len(bare.parameters), '/a' in bare.parameters) == ([], 0, False)


def test_what_does_not_exist_is_said_to_be_unknown(bare):
    with pytest.raises(UnknownNodeError, match=f'no node /nobody at {bare.url}: see rosnode list'):
        bare.node('nobody')
    with pytest.raises(UnknownNodeError, match='/nobody'):
        ExternalNode(bare, '/nobody').pid
    with pytest.raises(UnknownTopicError, match='/nothing'):
        bare.topic('/nothing').type
    with pytest.raises(UnknownServiceError, match='/none'):
        bare.lookup_service('/none')
    with pytest.raises(KeyError, match='no parameter /none'):
        bare.parameters['/none']
    nothing = bare.topic('/nothing')
    assert (nothing.publishers, nothing.subscribers, nothing.channels) == ([], [], [])
    nobody = ExternalNode(bare, '/nobody')
    assert (nobody.is_alive(), nobody.publications, nobody.subscriptions, nobody.services) == (
        False,
        {},
        {},
        [],
    )


def test_near_names_are_offered(master):
    node = create(master, '/turtle_driver')
    node.output_channel('/velocity', STRING)
    node.serve('/clear', 'std_srvs/Empty', lambda request: None)
    master.parameters['/background_r'] = 1
    for name, ask in (
        ('/turtle_driver', lambda: master.node('/turtle_drivr')),
        ('/velocity', lambda: master.topic('/velocty').type),
        ('/clear', lambda: master.lookup_service('/claer')),
        ('/background_r', lambda: master.parameters['/backgruond_r']),
    ):
        with pytest.raises((pharos.PharosError, KeyError), match=f'did you mean .{name}'):
            ask()


def test_nodes_topics_and_services_are_those_that_rostopic_and_rosnode_list(master):
    node = create(master, '/here')
    node.output_channel('/out', STRING)
    node.interested_in('/in', 'std_msgs/Int32')
    node.serve('/serve', 'std_srvs/Empty', lambda request: None)
    assert [node.name for node in master.nodes()] == ['/here']
    topics = {topic.name: topic for topic in master.topics()}
    assert {'/out', '/in', '/rosout'} <= set(topics)
    assert (topics['/out'].type, topics['/out'].publishers, topics['/out'].subscribers) == (
        STRING,
        ['/here'],
        [],
    )
    assert master.topic('in') == topics['/in']
    assert topics['/in'].subscribers == ['/here']
    assert '/serve' in master.services()
    assert master.system_state()[2]['/serve'] == ['/here']


def test_the_masters_pid_is_that_of_its_process(master):
    assert master.pid == os.getpid()  # rosmaster runs in this process, in these tests


@pytest.mark.parametrize('open_', [pharos.Topic.input_channel, pharos.Topic.output_channel])
def test_a_topic_gives_channels_to_running_nodes_of_its_master_alone(master, open_):
    topic = master.topic('/given')
    node = create(master, '/taker')
    for nobody in None, '/taker', master, ExternalNode(master, '/taker'):
        with pytest.raises(TypeError, match='/given is given to a node of this process, not to'):
            open_(topic, nobody, STRING)
    with pytest.raises(ValueError, match='is at another master than /taker'):
        open_(Master('http://127.0.0.1:1/').topic('/given'), node, STRING)
    node.stop()
    with pytest.raises(pharos.NodeStoppedError, match='/taker is stopped'):
        open_(topic, node, STRING)
    assert not topic.channels
    assert '/given' not in (name for kind in master.system_state() for name in kind)


def test_parameters_that_others_have_named_oddly_are_in_the_mapping_too(bare):
    names = ['/odd name', '/1st']
    for name in names:
        bare.api().setParam(name, 5)
        with pytest.raises(ValueError, match='cannot be a parameter name'):
            bare.parameters[name] = 6
        assert name in bare.parameters
    assert {
        name: value for name, value in bare.parameters.items() if name in names
    } == dict.fromkeys(names, 5)
    for name in names:
        del bare.parameters[name]
        with pytest.raises(ValueError, match='cannot be a parameter name'):
            bare.parameters[name]


def test_parameters_are_a_mapping(bare):
    bare.parameters['/robot/name'] = 'r2'
    bare.parameters['/robot/wheels'] = {'left': 1.5, 'right': [1, 2]}
    assert bare.parameters['/robot'] == {'name': 'r2', 'wheels': {'left': 1.5, 'right': [1, 2]}}
    assert list(bare.parameters) == ['/robot/name', '/robot/wheels/left', '/robot/wheels/right']
    assert '/robot/wheels' in bare.parameters
    assert 'robot/name' in bare.parameters
    assert dict(bare.parameters)['/robot/wheels/left'] == 1.5
    assert bare.parameters.get('/none', 'default') == 'default'
    del bare.parameters['/robot/wheels']
    assert bare.parameters.pop('/robot/name') == 'r2'
    with pytest.raises(KeyError, match='no parameter /robot/wheels'):
        del bare.parameters['/robot/wheels']


@pytest.mark.parametrize(
    'question',
    [
        lambda master: master.nodes(),
        lambda master: master.node('/n'),
        lambda master: master.topics(),
        lambda master: master.topic('/t').type,
        lambda master: master.topic('/t').publishers,
        lambda master: master.services(),
        lambda master: master.system_state(),
        lambda master: master.pid,
        lambda master: master.wait(0),
        lambda master: master.lookup_service('/s'),
        lambda master: master.parameters['/p'],
        lambda master: list(master.parameters),
        lambda master: ExternalNode(master, '/n').uri,
        lambda master: ExternalNode(master, '/n').publications,
        lambda master: master.wait_for_node('/n', 0),
    ],
)
def test_without_a_master_a_question_says_so(question):
    with pytest.raises(
        MasterUnreachableError,
        match=r'no ROS master answers at .* start one with .* Master.embedded',
    ):
        question(Master(refused_url()))


def test_every_question_to_a_silent_master_has_a_time_limit():
    with silent_peer() as url, concurrent.futures.ThreadPoolExecutor(16) as side_by_side:
        master = Master(url)
        questions = [
            side_by_side.submit(question)
            for question in (
                master.nodes,
                master.topics,
                master.services,
                lambda: master.node('/n'),
                lambda: master.pid,
                lambda: master.topic('/t').type,
                lambda: master.lookup_service('/s'),
                lambda: master.parameters['/p'],
                lambda: '/p' in master.parameters,
                lambda: master.parameters.update({'/p': 1}),
                lambda: ExternalNode(master, '/n').pid,
                lambda: master.wait(1),
                lambda: master.wait_for_node('/n', 0.1),
                lambda: create(master, '/n'),
            )
        ]
        reachable = side_by_side.submit(master.is_reachable)
        for question in questions:
            assert isinstance(question.exception(TIMEOUT), MasterUnreachableError)
        assert reachable.result(TIMEOUT) is False


def test_what_answers_but_is_no_master_is_not_reachable():
    class Page(http.server.BaseHTTPRequestHandler):
        def do_POST(self):
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b'a page')

        def log_message(self, *args):
            pass

    with http.server.ThreadingHTTPServer(('127.0.0.1', 0), Page) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        assert not Master('http://127.0.0.1:%d' % server.server_port).is_reachable()
        server.shutdown()


def test_wait_returns_once_the_master_answers():
    url = unused_url()
    master = Master(url)
    assert not master.is_reachable()
    with concurrent.futures.ThreadPoolExecutor() as pool:
        waiting = pool.submit(master.wait, TIMEOUT)
        ros_master = InProcessMaster(int(url.rstrip('/').rpartition(':')[2]))
        assert waiting.result(TIMEOUT) is master
        assert master.is_reachable()
        ros_master.stop()


# -- nodes outside


def test_a_rospy_node_from_outside(master):
    with peer(master, 'outside') as program:
        node = master.node('/outside')
        assert isinstance(node, ExternalNode)
        assert node.is_alive()
        assert (node.name, node.pid, node.host) == ('/outside', program.process.pid, '127.0.0.1')
        assert node.uri.startswith('http://127.0.0.1:')
        assert (node.publications['/from_peers'], node.subscriptions) == (
            STRING,
            {'/to_peers': STRING},
        )
        assert '/outside/clear' in node.services
        node.shutdown()
        assert program.process.wait(TIMEOUT) == 0
        assert not node.is_alive()


def test_a_roscpp_node_from_outside(master, mailbox):
    receiver = create(master, '/receiver', delegate=mailbox)
    receiver.interested_in('/relayed', STRING)
    with master.run('topic_tools', 'relay', '/direct', '/relayed', name='relay') as process:
        node = master.wait_for_node('/relay', TIMEOUT)
        assert isinstance(node, ExternalNode)
        assert node.is_alive()
        assert (node.pid, node.host) == (process.pid, '127.0.0.1')
        sender = create(master, '/sender')
        while mailbox.empty():  # relay advertises only with its first message, which so is lost
            sender.send_to('/direct', typed_as=STRING, data='hello')
            threading.Event().wait(0.01)
        assert (node.publications['/relayed'], node.subscriptions['/direct']) == (STRING, STRING)
        assert '/relay/get_loggers' in node.services
        node.shutdown()
        assert process.wait(TIMEOUT) == 0


def test_each_node_is_of_its_class(master):
    inside = create(master, '/inside')
    with peer(master, 'outside'):
        found = {node.name: node for node in master.nodes()}
        assert found['/inside'] is inside
        assert type(found['/outside']) is ExternalNode
        assert master.node('/inside') is inside
        assert master.node('outside') == found['/outside']


def test_a_node_that_was_killed_is_registered_and_not_alive(master):
    with peer(master, 'killed') as program:
        program.end(signal.SIGKILL)
        node = master.node('/killed')
        assert node in master.nodes()
        assert not node.is_alive()
        assert (node.publications['/from_peers'], node.subscriptions) == (
            STRING,
            {'/to_peers': STRING},
        )
        assert '/killed/clear' in node.services
        assert node.host == '127.0.0.1'
        for ask in (lambda: node.pid), node.shutdown:
            with pytest.raises(
                UnknownNodeError, match='/killed is registered at .* but does not answer .*cleanup'
            ):
                ask()
        assert (
            create(master, '/other')
            .send_to('/to_peers', typed_as=STRING, data='does not hang')
            .data
        )
        clean_up(master, '/killed', '/to_peers', '/from_peers')


def clean_up(master, name, subscribed, published):
    """What `rosnode cleanup` does for one node, which asks the user."""
    api = rosgraph.Master(name, master_uri=master.url)
    uri = api.lookupNode(name)
    api.unregisterSubscriber(subscribed, uri)
    for topic in published, '/rosout':
        api.unregisterPublisher(topic, uri)
    for service in master.services():
        if service.startswith(name + '/'):
            api.unregisterService(service, api.lookupService(service))


def test_a_node_that_is_silent_is_not_waited_for_for_ever(master):
    with silent_peer() as uri:
        api = rosgraph.Master('/silent', master_uri=master.url)
        api.registerPublisher('/t', STRING, uri)
        node = master.node('/silent')
        assert not node.is_alive()
        with pytest.raises(UnknownNodeError, match='does not answer'):
            node.pid
        assert node.publications == {'/t': STRING}
        api.unregisterPublisher('/t', uri)


def test_from_an_external_node_alone(master, mailbox):
    with peer(master, 'one'), peer(master, 'two'):
        node = create(master, '/receiver')
        channel = node.interested_in('/from_peers', delegate=mailbox, from_=master.node('/two'))
        while len(channel.connections) < 2:
            threading.Event().wait(0.01)
        for name in '/one', '/two', '/one', '/two':
            master.lookup_service(name + '/clear').call()
        assert [message.data for message in mailbox.take(2)] == ['/two', '/two']
        assert mailbox.empty()


def test_to_an_external_node_alone(master):
    with peer(master, 'one') as one, peer(master, 'two') as two:
        node = create(master, '/sender')
        node.send_to('/to_peers', data='for two', to=master.node('/two'))
        node.send_to('/to_peers', data='for all')
        assert 'for two' in two.wait_for('heard')
        assert 'for all' in one.wait_for('heard')


# -- what comes and goes


class Changes:
    """A block for on_change that keeps what it is told."""

    def __init__(self):
        self._told = queue.SimpleQueue()

    def __call__(self, kind, name, is_there):
        self._told.put((kind, name, is_there))

    def wait_for(self, *change):
        """All up to that change."""
        told = []
        while not told or told[-1] != change:
            told.append(self._told.get(timeout=TIMEOUT))
        return told


def test_on_change_tells_what_comes_and_goes(master):
    create(master, '/there_before')
    changes = Changes()
    end = master.on_change(changes)
    node = create(master, '/comes', delegate=lambda message, channel: None)
    node.interested_in('/topic', STRING)
    node.serve('/service', 'std_srvs/Empty', lambda request: None)
    told = changes.wait_for('topic', '/topic', True)
    assert ('node', '/comes', True) in told
    assert '/there_before' not in [name for _, name, _ in told]
    with peer(master, 'outside'):
        changes.wait_for('node', '/outside', True)
    changes.wait_for('node', '/outside', False)
    node.stop()
    assert ('service', '/service', False) in changes.wait_for('topic', '/topic', False)
    end()
    end()  # harmless


def test_a_listener_misses_nothing_that_comes_right_after(bare):
    for number in range(5):
        changes = Changes()
        end = bare.on_change(changes)
        with create(bare, '/n%d' % number):
            changes.wait_for('node', '/n%d' % number, True)
        changes.wait_for('node', '/n%d' % number, False)
        end()


def test_a_listener_that_raises_stops_nothing(bare, transcript):
    def stumble(kind, name, is_there):
        raise RuntimeError('stumbled')

    bare.on_change(stumble)
    changes = Changes()
    ending = bare.on_change(changes)
    with create(bare, '/n'):
        changes.wait_for('topic', '/rosout', True)
    changes.wait_for('topic', '/rosout', False)
    ending()
    assert 'stumble for changes raised RuntimeError: stumbled' in transcript[0]
    with pytest.raises(TypeError, match='block.kind, name, is_there.'):
        bare.on_change(lambda: None)


def test_a_listener_hears_of_a_master_that_comes_later():
    url = unused_url()
    changes = Changes()
    end = Master(url).on_change(changes)
    ros_master = InProcessMaster(int(url.rstrip('/').rpartition(':')[2]))
    with create(Master(url), '/n'):
        changes.wait_for('node', '/n', True)
    end()
    ros_master.stop()


def test_wait_for_node_waits_for_one_to_come(master):
    with concurrent.futures.ThreadPoolExecutor() as pool:
        waiting = pool.submit(master.wait_for_node, '/comes', TIMEOUT)
        node = create(master, '/comes')
        assert waiting.result(TIMEOUT) is node
    assert master.wait_for_node('comes') is node


def test_wait_for_node_tells_one_that_is_gone_from_one_that_is_there(master):
    changes = Changes()
    end = master.on_change(changes)
    node = create(master, '/goes')
    changes.wait_for('node', '/goes', True)
    node.stop()
    with pytest.raises(
        UnknownNodeError, match="no node /goes came to .* within 0.2 s: is it started"
    ):
        master.wait_for_node('/goes', 0.2)
    end()


def test_no_thread_is_left_that_nobody_needs(bare):
    end = bare.on_change(Changes())
    with create(bare, '/n'):
        watching = [
            thread for thread in threading.enumerate() if thread.name == f'watcher of {bare.url}'
        ]
        assert len(watching) == 1
        assert bare.wait_for_node('/n').name == '/n'
        end()
        assert watching[0].is_alive()  # for the node
    with pytest.raises(UnknownNodeError):
        bare.wait_for_node('/other', 0.01)
    for thread in threading.enumerate():
        if thread.name == f'watcher of {bare.url}':
            thread.join(TIMEOUT)
            assert not thread.is_alive()
