"""Master.embedded: a ROS master of the program's own, which ends with it."""
import os
import signal
import socket
import struct
import subprocess
import sys

import pytest

from pharos.testing import Mailbox, TIMEOUT
import pharos
from pharos import BlockNode, Master, PharosError, PortInUseError
from pharos.errors import MasterUnreachableError
from programs import PROGRAMS, Program, environment, run
from sockets import listening, refused_url, wait_for_end


@pytest.fixture
def embedded():
    with Master.embedded() as master:
        yield master


def is_refused(url):
    host, port = url[len('http://') :].rstrip('/').split(':')
    with socket.socket() as client:
        return client.connect_ex((host, int(port))) != 0


def test_it_is_a_master_of_its_own(embedded):
    assert embedded.is_reachable()
    assert embedded.pid != os.getpid()
    assert [node.name for node in embedded.nodes()] == ['/rosout']
    assert embedded.parameters['/rosdistro']
    assert run(embedded.url, 'rosnode', 'list').stdout == '/rosout\n'


def test_it_is_there_where_ros_uses_ipv6(monkeypatch):
    monkeypatch.setenv('ROS_IPV6', 'on')
    for variable in 'ROS_HOSTNAME', 'ROS_IP':
        monkeypatch.delenv(variable, raising=False)
    with Master.embedded() as master:
        assert [node.name for node in master.nodes()] == ['/rosout']


def test_nodes_of_this_process_and_others_meet_there(embedded):
    mailbox = Mailbox()
    embedded.create(BlockNode, named='/receiver', delegate=mailbox).interested_in(
        '/t', 'std_msgs/String'
    )
    with Program(embedded.url, 'rostopic', 'pub', '/t', 'std_msgs/String', 'data: from outside'):
        assert mailbox.next().data == 'from outside'


def test_a_connection_that_is_cut_off_is_not_told_of_on_the_screen(capfd):
    with Master.embedded() as master:
        host, port = master.url[len('http://') :].rstrip('/').split(':')
        with socket.create_connection((host, int(port))) as client:
            client.sendall(b'POST /RPC2 HTTP/1.0')
            reset = struct.pack('ii', 1, 0)
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, reset)
        assert master.is_reachable()
    assert capfd.readouterr().err == ''


def test_rosout_agg_gets_each_line_once(embedded):
    mailbox = Mailbox()
    embedded.create(BlockNode, named='/listener', delegate=mailbox).interested_in(
        '/rosout_agg', 'rosgraph_msgs/Log'
    )
    speaker = embedded.create(BlockNode, named='/speaker')
    while not any(name == '/rosout' for name, _ in speaker_connections(speaker)):
        speaker.latest_run.rospy.ended.wait(0.01)
    for number in range(10):
        speaker.log('line %d' % number)
    speaker.log('the end')
    lines = []
    while not lines or lines[-1] != 'the end':
        message = mailbox.next()
        if message.name == '/speaker':
            lines.append(message.msg)
    assert lines == ['line %d' % number for number in range(10)] + ['the end']


def speaker_connections(node):
    """The node's connections on /rosout, where rospy itself publishes."""
    return [
        (connection.endpoint_id, None)
        for connection in node.latest_run.rospy.publisher('/rosout').connections
    ]


def test_it_listens_on_loopback_alone(embedded):
    addresses = listening(embedded.pid)
    assert {address for address, _ in addresses} == {'127.0.0.1'}
    assert int(embedded.url.rstrip('/').rpartition(':')[2]) in {port for _, port in addresses}


def test_stop_ends_it_and_this_processs_nodes_there():
    master = Master.embedded()
    pid, node = master.pid, master.create(BlockNode, named='/n')
    master.stop()
    assert not node.is_running
    assert wait_for_end(pid, 0)
    assert is_refused(master.url)
    master.stop()  # harmless
    assert not master.is_reachable()


def test_the_end_of_a_with_block_ends_it():
    with pytest.raises(RuntimeError), Master.embedded() as master:
        raise RuntimeError
    assert is_refused(master.url)


def test_it_comes_back_on_the_same_port_and_a_taken_one_is_said():
    with Master.embedded() as master:
        port = int(master.url.rstrip('/').rpartition(':')[2])
        with pytest.raises(
            PortInUseError, match='port %d for a master .*another port, or 0' % port
        ):
            Master.embedded(port)
    with Master.embedded(port) as again:
        assert again.url == master.url
        assert again.is_reachable()


def test_two_of_them_know_nothing_of_each_other():
    with Master.embedded() as one, Master.embedded() as two:
        one.create(BlockNode, named='/n')
        assert one.url != two.url
        assert [node.name for node in two.nodes()] == ['/rosout']


def test_it_outlives_its_own_murder(embedded):
    node = embedded.create(BlockNode, named='/n')
    os.kill(embedded.pid, signal.SIGKILL)
    embedded._child.wait(TIMEOUT)
    with pytest.raises(MasterUnreachableError):
        embedded.nodes()
    node.stop()  # says nothing but a warning in the log
    embedded.stop()


def embedding(code=''):
    """A program with a master of its own, which then runs that code."""
    return Program(refused_url(), sys.executable, PROGRAMS / 'embedding.py', code)


@pytest.mark.parametrize(
    ('code', 'status'),
    [
        ('', 0),
        ('sys.exit(3)', 3),
        ('raise RuntimeError', 1),
        ('os._exit(4)', 4),
        ('os.abort()', -signal.SIGABRT),
        ('os.kill(os.getpid(), signal.SIGTERM)', 128 + signal.SIGTERM),
    ],
    ids=['end', 'exit', 'exception', '_exit', 'abort', 'SIGTERM'],
)
def test_it_ends_with_the_program(code, status):
    with embedding(code) as program:
        url, pid = program.wait_for('URL').split()[1:]
        assert program.process.wait(TIMEOUT) == status
        assert wait_for_end(int(pid), TIMEOUT)
        assert is_refused(url)


def test_it_is_gone_when_a_program_has_ended_properly():
    with embedding() as program:
        url = program.wait_for('URL').split()[1]
        program.process.wait(TIMEOUT)
        assert is_refused(url)  # so that the next program can have the port


def test_it_says_nothing_of_nodes_that_stop():
    with embedding(
        """
nodes = [master.create(BlockNode, named='/n%d' % number) for number in range(10)]
for node in nodes:
    node.interested_in('/t', 'std_msgs/String')
    node.output_channel('/t', 'std_msgs/String')
"""
    ) as program:
        program.process.wait(TIMEOUT)
        assert len(program.read_to_the_end().splitlines()) == 1  # the URL


@pytest.mark.parametrize(
    'code',
    [
        'signal.pause()',
        """
if os.fork() == 0:
    print('FORK', os.getpid(), flush=True)
signal.pause()
""",
    ],
    ids=['alone', 'with a fork that lives on'],
)
def test_it_ends_with_a_program_that_is_killed(code):
    with embedding(code) as program:
        url, pid = program.wait_for('URL').split()[1:]
        fork = int(program.wait_for('FORK').split()[1]) if 'fork' in code else None
        program.process.kill()
        try:
            assert wait_for_end(int(pid), TIMEOUT)
            assert is_refused(url)
        finally:
            if fork:
                os.kill(fork, signal.SIGKILL)


def test_ctrl_c_is_the_programs_own():
    with embedding(
        """
try:
    print('PAUSES', flush=True)
    while True:
        time.sleep(0.01)  # pause() would not end by a signal that comes just before it
except KeyboardInterrupt:
    print('STILL THERE' if master.is_reachable() else 'GONE', flush=True)
"""
    ) as program:
        program.wait_for('PAUSES')
        os.killpg(program.process.pid, signal.SIGINT)  # as a terminal sends it to all of a program
        assert program.wait_for('THERE')


def test_it_says_nothing_where_ctrl_c_came_before_it_was_there():
    read, write = os.pipe()
    os.close(read)  # as the program's end does
    with subprocess.Popen(
        [sys.executable, '-m', 'pharos.master_program', '0', str(os.getpid())],
        env=environment(refused_url()),
        stdin=subprocess.DEVNULL,
        stdout=write,
        stderr=subprocess.PIPE,
        text=True,
    ) as child:
        os.close(write)
        assert child.communicate(timeout=TIMEOUT)[1] == ''


def test_only_an_embedded_one_is_stopped(master):
    with pytest.raises(PharosError, match='not embedded in this program'):
        master.stop()
    with master:
        pass
    assert master.is_reachable()


def test_without_a_master_the_error_names_it(monkeypatch):
    monkeypatch.setenv('ROS_MASTER_URI', refused_url())
    with pytest.raises(
        MasterUnreachableError, match=r'start one with roscore or Master.embedded\(\)'
    ):
        Master().create(BlockNode, named='/n')
    assert pharos.node_registry.nodes() == []
    ended = run(refused_url(), sys.executable, '-c', 'from pharos import Master; Master().nodes()')
    assert 'Master.embedded()' in ended.stderr.splitlines()[-1]


def test_an_address_of_the_environment_that_nobody_would_reach_is_named(monkeypatch):
    monkeypatch.setenv('ROS_HOSTNAME', 'http://127.0.0.1')
    with pytest.raises(ValueError, match='^ROS_HOSTNAME cannot be'):
        Master.embedded()


def test_an_empty_address_of_the_environment_is_none(monkeypatch):
    monkeypatch.setenv('ROS_HOSTNAME', '')
    with Master.embedded() as master:
        assert master.url.startswith('http://127.0.0.1:')
        assert master.is_reachable()
