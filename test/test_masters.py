"""Masters: what they know of the graph, embedded ones, programs, and nodes outside this process."""
import contextlib
import os
import signal
import socket
import threading
import xmlrpc.client

import psutil
import pytest

from helpers import TIMEOUT, InProcessMaster, Program, create, free_port, stop_nodes
import pharos
from pharos import BlockNode, ExternalNode, Master, Node, RosProcess
from pharos.testing import Mailbox, until

STRING = 'std_msgs/String'
MANIFEST = """<package format="2"><name>small_robot</name><version>0.0.0</version>
<description>d</description><maintainer email="a@b.org">m</maintainer><license>BSD</license>
</package>"""
PRINTS_ARGUMENTS = 'for a in "$@"; do echo "<$a>"; done'
TALKER = """#!/usr/bin/python3
import rospy, std_msgs.msg
rospy.init_node('talker')
sent = rospy.Publisher('talk', std_msgs.msg.String, queue_size=1, latch=True)
sent.publish(rospy.get_param('~text', 'nothing'))
rospy.spin()
"""
EMBEDDING = """
import os, sys, threading, pharos
master = pharos.Master.embedded()
print('master', master.url, master.pid, flush=True)
"""


@pytest.fixture
def masters(master):
    """The ROS masters of two robots, in this process."""
    second = InProcessMaster()
    yield [master, Master(second.url)]
    stop_nodes()
    second.stop()


@pytest.fixture
def robot(tmp_path, monkeypatch):
    """``robot(name, text)`` writes a program of the package small_robot and returns its name."""
    folder = tmp_path / 'src' / 'small_robot'
    (folder / 'scripts').mkdir(parents=True)
    (folder / 'launch').mkdir()
    (folder / 'package.xml').write_text(MANIFEST)
    monkeypatch.setenv('ROS_PACKAGE_PATH', f'{tmp_path / "src"}:/usr/share')
    monkeypatch.setenv('ROS_HOME', str(tmp_path / 'home'))

    def write(name, text):
        path = folder / ('launch' if name.endswith('.launch') else 'scripts') / name
        path.write_text(text if text[0] in '#<' else f'#!/bin/sh\n{text}\n')
        path.chmod(0o755)
        return name

    return write


@pytest.fixture
def unreachable():
    """A master at a port that nobody listens on."""
    with socket.create_server(('127.0.0.1', 0)) as server:
        port = server.getsockname()[1]
    return Master(f'http://127.0.0.1:{port}/')


def port_of(master):
    return int(master.url.rstrip('/').rpartition(':')[2])


def has_ended(pid):
    """True if there is no such process any more; a zombie has ended."""
    with contextlib.suppress(psutil.NoSuchProcess):
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    return True


def names(nodes):
    return [node.name for node in nodes]


# -- a master and its URL


def test_master_makes_no_connection_yet():
    with socket.create_server(('127.0.0.1', 0)) as server:
        server.setblocking(False)
        Master('http://127.0.0.1:%d/' % server.getsockname()[1])
        with pytest.raises(BlockingIOError):
            server.accept()


def test_master_url_comes_from_environment(monkeypatch):
    monkeypatch.setenv('ROS_MASTER_URI', 'http://127.0.0.1:12345/')
    assert Master() == Master('http://127.0.0.1:12345/')


def test_master_url_defaults_to_roscore(monkeypatch):
    monkeypatch.delenv('ROS_MASTER_URI', raising=False)
    assert Master() == Master('http://localhost:11311/')


def test_malformed_url_raises_value_error():
    for url in [
        'robot',
        'robot:11311',
        'http://',
        'http://robot:port/',
        'http://robot:99999/',
        'ftp://robot:11311/',
        'http://a robot:11311/',
    ]:
        with pytest.raises(ValueError):
            Master(url)


def test_name_that_begins_as_localhost_is_kept():
    url = 'http://localhost.localdomain:11311/'
    assert pharos.Master(url).url == url


def test_malformed_environment_raises_value_error(monkeypatch):
    monkeypatch.setenv('ROS_MASTER_URI', 'robot')
    with pytest.raises(ValueError):
        Master()


def test_masters_of_one_address_are_equal():
    for other, are_one in [
        ('http://127.0.0.1:11311', True),
        ('http://localhost:11311/', True),
        ('HTTP://LOCALHOST:11311/', True),
        ('http://127.0.0.1:11312/', False),
        ('http://127.0.0.2:11311/', False),
    ]:
        master = Master('http://127.0.0.1:11311/')
        assert (master == Master(other)) is are_one
        assert (len({master, Master(other)}) == 1) is are_one


def test_own_node_keeps_under_other_spelling(master):
    node = create(master, '/own')
    assert Master(master.url.replace('127.0.0.1', 'localhost')).node('/own') is node


def test_spellings_of_one_master_share_intraprocess(master):
    box = Mailbox(create(master, '/hearer'), '/spelt', STRING)
    other = Master(master.url.replace('127.0.0.1', 'localhost'))
    channel = create(other, '/speaker').output_channel('/spelt', STRING)
    channel.send(data='next door')
    assert box.next().data == 'next door'
    assert channel.connections == [('/hearer', 'INTRAPROCESS')]


# -- what it knows


def test_nodes_are_own_and_external(master, peer):
    node = create(master, '/own')
    assert names(master.nodes()) == ['/own', '/peer']
    assert master.node('/own') is node
    assert isinstance(master.node('/peer'), ExternalNode)


def test_unknown_node_raises_its_error(master):
    with pytest.raises(pharos.UnknownNodeError):
        master.node('/nobody')


def test_starting_node_is_found(master):
    class Asking(Node):
        def start(self):
            super().start()
            found.append(self.master.node(self.name))

    def look():
        while not found:
            with contextlib.suppress(pharos.UnknownNodeError):
                found.append(master.node('/asking'))

    found, thread = [], threading.Thread(target=look, daemon=True)
    thread.start()
    node = create(master, '/asking', Asking)
    thread.join(TIMEOUT)
    assert set(found) == {node}


def test_connections_have_own_numbers(master, peer):
    """They are those that rosnode info shows, of a node in a process that has made few others."""
    create_node = 'pharos.Master().create(pharos.BlockNode, named=name)'
    peer.run(f'import pharos; talker, *hearers = [{create_node} for name in "tabc"]')
    node = create(master, '/node')
    for topic in '/one', '/two', '/three':
        peer.run(f'talker.output_channel({topic!r}, {STRING!r})')
        peer.run(f'for hearer in hearers: hearer.interested_in({topic!r})')
        node.interested_in(topic)
    ask = xmlrpc.client.ServerProxy(peer.value('talker.uri')).getBusInfo
    until(lambda: len(ask('/test')[2]) == 12)
    numbers, _, _, transports, *_ = zip(*ask('/test')[2])
    assert set(transports) == {'INTRAPROCESS', 'SHARED_MEMORY'}
    assert len(set(numbers)) == 12


def test_system_state_lists_users_by_name(master):
    node = create(master, '/n')
    node.output_channel('/out', STRING)
    node.interested_in('/in', STRING)
    node.serve('/clear', 'std_srvs/Empty', lambda request: None)
    publishers, subscribers, services = master.system_state()
    assert publishers['/out'] == subscribers['/in'] == services['/clear'] == ['/n']


def test_pid_is_that_of_rosmaster(master):
    assert master.pid == os.getpid()


def test_reachable_master_is_waited_for(master):
    master.wait(TIMEOUT)
    assert master.is_reachable()


def test_wait_lasts_until_master_comes(mortal):
    mortal.end()
    master, waited = Master(mortal.url), threading.Event()
    assert not master.is_reachable()
    thread = threading.Thread(target=lambda: (master.wait(TIMEOUT), waited.set()))
    thread.start()
    mortal.come_back()
    assert waited.wait(TIMEOUT)
    thread.join(TIMEOUT)


def test_unreachable_master_raises_its_error(unreachable):
    for question in [
        lambda master: master.nodes(),
        lambda master: master.node('/n'),
        lambda master: master.topics(),
        lambda master: master.topic('/t').type,
        lambda master: master.topic('/t').publishers,
        lambda master: master.services(),
        lambda master: master.system_state(),
        lambda master: master.pid,
        lambda master: master.wait(0.01),
        lambda master: master.wait_for_node('/n', 0.01),
        lambda master: master.lookup_service('/s'),
        lambda master: master.create(BlockNode, named='/n'),
        lambda master: master.graph(),
    ]:
        with pytest.raises(pharos.MasterUnreachableError, match=str(port_of(unreachable))):
            question(unreachable)


def test_unreachable_master_is_not_reachable(unreachable):
    assert not unreachable.is_reachable()


def test_wait_for_node_finds_own_node(master):
    node = create(master, '/n')
    assert master.wait_for_node('/n', TIMEOUT) is node


def test_wait_for_node_until_it_comes(master):
    found = []
    thread = threading.Thread(target=lambda: found.append(master.wait_for_node('/late', TIMEOUT)))
    thread.start()
    node = create(master, '/late')
    thread.join(TIMEOUT)
    assert found == [node]


def test_wait_for_node_ends_after_timeout(master):
    with pytest.raises(pharos.UnknownNodeError):
        master.wait_for_node('/nobody', 0.05)


# -- several masters


def test_two_masters_have_one_name(masters):
    nodes = [create(master, '/same') for master in masters]
    assert [master.node('/same') for master in masters] == nodes
    nodes[0].stop()
    assert masters[0].nodes() == []
    assert masters[1].nodes() == [nodes[1]]


def test_topics_of_masters_stay_apart(masters):
    boxes = [Mailbox(create(master, '/hearer'), '/t', STRING) for master in masters]
    speakers = [create(master, '/speaker') for master in masters]
    for text in 'said', 'end':
        for number, speaker in enumerate(speakers):
            speaker.send_to('/t', typed_as=STRING, data=f'{text} {number}')
    for number, box in enumerate(boxes):
        box.wait_for(lambda message: message.data.startswith('end'))
        assert [message.data for message in box.all()] == [f'said {number}', f'end {number}']


def test_services_of_masters_stay_apart(masters):
    for master, text in zip(masters, ('one', 'two')):
        create(master, '/n').serve('/who', 'std_srvs/Trigger', lambda _, text=text: (True, text))
    answers = [master.lookup_service('/who').call().message for master in masters]
    assert answers == ['one', 'two']


def test_delegate_joins_two_masters(masters):
    box = Mailbox(create(masters[1], '/hearer'), '/map', STRING)
    there = create(masters[1], '/bridge').output_channel('/map', STRING)
    here = create(masters[0], '/bridge', delegate=lambda message, _: there.publish(message))
    here.interested_in('/map', STRING)
    create(masters[0], '/speaker').send_to('/map', data='across')
    assert box.next().data == 'across'


def test_dead_master_leaves_other_nodes_alone(master):
    box = Mailbox(create(master, '/n'), '/t', STRING)
    with Master.embedded() as other:
        create(other, '/n')
        os.kill(other.pid, signal.SIGKILL)
        create(master, '/speaker').send_to('/t', data='still here')
        assert box.next().data == 'still here'


# -- embedded


def test_embedded_master_serves_real_nodes():
    with Master.embedded() as master:
        assert master.pid != os.getpid()
        create(master, '/n')
        with Program(['rosnode', 'list'], master.url) as program:
            assert program.wait() == 0
            assert {'/n', '/rosout'} <= set(program.output.split())
        stop_nodes(master)


def test_embedded_master_has_wanted_port():
    port = free_port()
    with Master.embedded(port=port) as master:
        assert port_of(master) == port
        assert master.is_reachable()


def test_embedded_master_refuses_busy_port():
    with socket.create_server(('127.0.0.1', 0)) as server:
        with pytest.raises(pharos.PortInUseError):
            Master.embedded(port=server.getsockname()[1])


def test_stop_ends_embedded_master():
    master = Master.embedded()
    pid = master.pid
    master.stop()
    master.stop()  # harmless
    assert has_ended(pid)
    assert not master.is_reachable()


def test_with_block_ends_embedded_master():
    with pytest.raises(RuntimeError), Master.embedded() as master:
        pid = master.pid
        raise RuntimeError
    assert has_ended(pid)


@pytest.mark.parametrize(
    'ending, code',
    [
        ('', 0),
        ('sys.exit(3)', 3),
        ('raise RuntimeError', 1),
        ('os._exit(4)', 4),
        ('os.kill(os.getpid(), 9)', -signal.SIGKILL),
    ],
    ids='end exit exception _exit killed'.split(),
)
def test_embedded_master_ends_with_its_program(ending, code):
    with Program(EMBEDDING + ending, 'http://127.0.0.1:1/') as program:
        assert program.wait() == code
        pid = int(program.output.split()[2])
        until(lambda: has_ended(pid), TIMEOUT)


# -- programs


def test_run_starts_node_of_package(master, robot):
    with master.run('small_robot', robot('talker', TALKER), '__name:=robot7') as process:
        assert isinstance(process, RosProcess)
        assert process.poll() is None
        Mailbox(create(master, '/ear'), '/talk', 'std_msgs/String').next()  # all is registered
        assert master.node('/robot7').pid == process.pid
    assert process.poll() is not None
    assert '/robot7' not in names(master.nodes())


def test_run_starts_installed_c_program(master):
    with master.run('topic_tools', 'relay', '/from', '/to', '__name:=relay'):
        until(lambda: '/relay' in master.topic('/from').subscribers, TIMEOUT)
    assert master.topic('/from').subscribers == []


@pytest.mark.parametrize('way', ['run', 'launch', 'load', 'compose'])
def test_unknown_package_is_named(master, way):
    with pytest.raises(pharos.UnknownNodeError, match="no package 'lab_robt'"):
        getattr(master, way)('lab_robt', 'robot.launch')


def test_run_gives_arguments_unchanged(master, robot):
    shows = robot('shows', PRINTS_ARGUMENTS)
    with master.run('small_robot', shows, 'two words', 3, '--flag') as process:
        assert process.wait(TIMEOUT) == 0
        assert process.output.splitlines() == ['<two words>', '<3>', '<--flag>']


def test_run_gives_masters_uri(master, robot, monkeypatch):
    monkeypatch.setenv('ROS_MASTER_URI', 'http://127.0.0.1:1/')
    with master.run('small_robot', robot('tells', 'echo $ROS_MASTER_URI')) as process:
        process.wait(TIMEOUT)
        assert Master(process.output.strip()) == master


def test_run_returns_exit_status(master, robot):
    with master.run('small_robot', robot('fails', 'exit 7')) as process:
        assert process.wait(TIMEOUT) == 7 == process.poll()


def test_run_keeps_output_and_errors(master, robot):
    with master.run('small_robot', robot('tells', 'echo said; echo complained >&2')) as process:
        process.wait(TIMEOUT)
        assert process.output.split() == ['said', 'complained']


def test_send_writes_to_standard_input(master, robot):
    asks = robot('asks', 'read name; echo "hello $name"')
    with master.run('small_robot', asks) as process:
        process.send('bob\n')
        assert process.wait(TIMEOUT) == 0
        assert 'hello bob' in process.output


def test_terminate_ends_program_for_good(master, robot):
    process = master.run('small_robot', robot('sleeps', 'exec sleep 1000'))
    process.terminate()
    process.terminate()  # harmless
    assert process.poll() is not None
    assert has_ended(process.pid)


@pytest.mark.parametrize('way', ['run', 'launch'])
@pytest.mark.parametrize('package', ['no_such_robot', 'small_robot'])
def test_missing_program_raises_pharos_error(master, robot, way, package):
    with pytest.raises(pharos.PharosError):
        getattr(master, way)(package, 'missing.launch' if way == 'launch' else 'missing')


@pytest.mark.parametrize('ending, code', [('', 0), ('raise RuntimeError', 1)], ids=repr)
def test_program_ends_with_its_starter(master, robot, ending, code):
    source = f"""
import pharos
print(pharos.Master().run('small_robot', {robot('sleeps', 'exec sleep 1000')!r}).pid)
{ending}
"""
    with Program(source, master.url) as program:
        assert program.wait() == code
        pid = int(program.output.split()[0])
        until(lambda: has_ended(pid), TIMEOUT)


LAUNCH = '<launch><arg name="to" default="0"/><param name="/launched" value="$(arg to)"/></launch>'


def test_launch_starts_file_of_package(master, robot):
    with master.launch('small_robot', robot('sets.launch', LAUNCH)) as process:
        assert process.wait(2 * TIMEOUT) == 0, process.output
    assert master.parameters['/launched'] == 0


def test_launch_starts_nodes_of_file(master, robot, tmp_path):
    """By its path, with an argument."""
    robot('talker', TALKER)
    node = '<node name="launched" pkg="small_robot" type="talker"/>'
    file = tmp_path / 'own.launch'
    file.write_text(LAUNCH.replace('</launch>', node + '</launch>'))
    with master.launch(None, str(file), to='it'):
        Mailbox(create(master, '/ear'), '/talk', 'std_msgs/String').next()  # all is registered
        assert master.parameters['/launched'] == 'it'
    assert '/launched' not in names(master.nodes())


# -- nodes outside this process


def test_external_node_tells_who_it_is(master, peer):
    node = master.node('/peer')
    assert (node.name, node.pid, node.host) == ('/peer', peer.pid, '127.0.0.1')
    assert node.uri == peer.value('rospy.get_node_uri()')
    assert node.is_alive()


def test_external_node_tells_what_it_uses(master, peer):
    peer.hear('/in', STRING)
    peer.run(
        "publisher = rospy.Publisher('/out', message_class('std_msgs/Int32'), queue_size=1)\n"
        'import std_srvs.srv\n'
        "service = rospy.Service('/clear', std_srvs.srv.Empty, lambda request: {})"
    )
    node = master.node('/peer')
    assert node.subscriptions['/in'] == STRING
    assert node.publications['/out'] == 'std_msgs/Int32'
    assert '/clear' in node.services


def test_external_node_is_shut_down(master, peer):
    node = master.node('/peer')
    node.shutdown()
    until(lambda: '/peer' not in names(master.nodes()), TIMEOUT)
    assert not node.is_alive()


def test_dead_external_node_stays_known(master, peer):
    peer.end()
    node = master.node('/peer')
    assert not node.is_alive()
    assert node.publications['/rosout'] == 'rosgraph_msgs/Log'
    for question in (lambda: node.pid, node.shutdown):
        with pytest.raises(pharos.PharosError):
            question()
    with Program(['sh', '-c', 'echo y | rosnode cleanup'], master.url) as program:
        assert program.wait() == 0, program.output
    with pytest.raises(pharos.UnknownNodeError):
        node.uri
