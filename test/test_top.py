"""What rosrun pharos top tells, from a program: pharos.live.top."""
import dataclasses
import json
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from helpers import create, speak_tcpros_only
from pharos import ExternalNode, Master, MasterUnreachableError
from pharos.external_node import node_api
from pharos.live import answers, top
from pharos.testing import TIMEOUT, until
from programs import PROGRAMS, Program, environment

RATE = 40  # messages a second
SIZE = 1000  # bytes of each


@pytest.fixture
def sender(master):
    """A node that publishes all the time, to one of its own process."""
    with create(master, '/sender') as node, create(master, '/hearer') as hearer:
        channel = node.output_channel('/traffic', 'std_msgs/String')
        hearer.interested_in('/traffic')

        def soul(me):
            for _ in me.every(1 / RATE):
                channel.send(data='x' * SIZE)

        node.fork(soul)
        yield node


def rows(kind):
    """The rows of a list, by their names."""
    return {row.name: row for row in kind}


def is_about(value, expected):
    """Whether it is, as far as a busy machine can tell."""
    return expected / 10 < value < expected * 2


def test_nodes_are_told_with_what_comes_and_goes(master, sender):
    found = top.measure(master, 1)
    assert found.master == master.url
    assert 0.9 < found.seconds < TIMEOUT
    row, hearer = (rows(found.nodes)[name] for name in ('/sender', '/hearer'))
    assert (row.state, row.pid, row.class_name) == ('alive', os.getpid(), 'BlockNode')
    assert is_about(row.sent, RATE)
    assert is_about(hearer.received, RATE)
    # no byte goes through a socket
    assert (row.bytes_sent, row.intraprocess, row.tcpros) == (0, 1, 0)
    assert (row.dropped, row.failures, row.souls, hearer.souls) == (0, 0, 1, 0)
    assert row.threads > 0


def test_topics_are_told_with_rate_bytes_and_transport(master, sender):
    create(master, '/apart').interested_in('/unused', 'std_msgs/Bool')
    with Program(master.url, 'rostopic', 'echo', '/traffic'):
        until(lambda: len(sender.channels[0].connections) == 2)
        found = rows(top.measure(master, 1).topics)
    row = found['/traffic']
    assert (row.type, row.publishers) == ('std_msgs/String', ['/sender'])
    assert '/hearer' in row.subscribers and len(row.subscribers) == 2
    assert (row.intraprocess, row.tcpros, row.dropped) == (1, 1, 0)
    assert is_about(row.rate, RATE)
    assert is_about(row.bandwidth, RATE * SIZE)
    assert (found['/unused'].rate, found['/unused'].bandwidth) == (None, None)


def test_processes_are_told_with_cpu_and_memory(master, sender):
    row = next(row for row in top.measure(master, 1).processes if row.pid == os.getpid())
    assert {'/sender', '/hearer'} <= set(row.nodes)
    assert row.cpu >= 0
    assert 1e6 < row.memory < 1e10
    assert row.threads >= threading.active_count() / 2
    assert is_about(row.sent, RATE)
    assert row.failures == 0


def test_a_first_look_has_no_rates(master, sender):
    with top.Meter(master) as meter:
        first, second = meter.measure(), meter.measure()
    assert first.seconds is None and second.seconds > 0
    assert rows(first.nodes)['/sender'].sent is None
    assert rows(second.nodes)['/sender'].sent is not None
    assert all(row.cpu is None for row in first.processes)


def test_failures_and_drops_of_another_process_are_told(master):
    with Program(master.url, sys.executable, str(PROGRAMS / 'in_trouble.py')) as program:
        program.wait_for('in trouble')
        until(lambda: rows(top.measure(master, 0.1).topics)['/trouble'].dropped == 3)
        found = top.measure(master, 0.1)
    row = rows(found.nodes)['/in_trouble']
    assert row.pid == program.process.pid
    assert (row.class_name, row.failures, row.dropped) == ('Troubled', 1, 3)
    process = next(row for row in found.processes if row.pid == program.process.pid)
    assert (process.failures, process.dropped) == (1, 3)
    assert process.memory > 1e6


def test_a_rospy_node_is_told_as_far_as_ros_tells(master):
    with Program(
        master.url, sys.executable, str(PROGRAMS / 'publishes.py'), '/traffic', str(RATE), str(SIZE)
    ) as program, create(master, '/hearer') as hearer:
        program.wait_for('publishing')
        until(lambda: master.topic('/traffic').publishers)
        channel = hearer.interested_in('/traffic')
        until(lambda: channel.received)
        found = top.measure(master, 1)
    row = next(row for row in found.nodes if row.pid == program.process.pid)
    assert is_about(row.sent, RATE)
    assert is_about(row.bytes_sent, RATE * SIZE)
    assert (row.class_name, row.failures, row.dropped, row.threads) == (None,) * 4


def test_a_cpp_node_is_told_as_far_as_ros_tells(master, sender):
    with Program(master.url, 'rosrun', 'topic_tools', 'relay', '/traffic', '/again'):
        with create(master, '/listener') as listener:
            channel = listener.interested_in('/again', 'std_msgs/String')
            until(lambda: channel.received)
            found = top.measure(master, 1)
    row = next(row for row in found.nodes if 'relay' in row.name)
    assert is_about(row.received, RATE) and is_about(row.sent, RATE)
    assert is_about(row.bytes_received, RATE * SIZE)
    assert row.failures is None
    assert is_about(rows(found.topics)['/again'].rate, RATE)


def test_measured_topics_are_those_that_nobody_hears_too(master):
    with Program(
        master.url, sys.executable, str(PROGRAMS / 'publishes.py'), '/unheard', str(RATE), str(SIZE)
    ) as program:
        program.wait_for('publishing')
        until(lambda: master.topic('/unheard').publishers)
        assert rows(top.measure(master, 0.5).topics)['/unheard'].rate is None
        found = top.measure(master, 1, names=['/unheard'], probes=True)
    assert found.is_measured
    row = rows(found.topics)['/unheard']
    assert is_about(row.rate, RATE)
    assert is_about(row.bandwidth, RATE * SIZE)
    assert (row.subscribers, row.tcpros) == ([], 0)  # the one that measures is none
    assert not [row for row in found.nodes if 'pharos_looks' in row.name]


def test_names_choose_nodes_topics_and_their_processes(master, sender):
    found = top.measure(master, 0.1, names=['/send', '/tra*'])
    assert [row.name for row in found.nodes] == ['/sender']
    assert [row.name for row in found.topics] == ['/traffic']
    assert [row.nodes for row in found.processes] == [['/sender']]


def test_all_of_it_is_plain_values(master, sender):
    found = dataclasses.asdict(top.measure(master, 0.1))
    assert json.loads(json.dumps(found)) == found


@pytest.mark.parametrize('seconds', [0, -1, 'long', None])
def test_seconds_that_are_none_are_refused(master, seconds):
    with pytest.raises(ValueError, match='seconds is a number of seconds above 0'):
        top.measure(master, seconds)


def test_without_a_master_there_is_an_error_that_names_it():
    with pytest.raises(MasterUnreachableError, match='http://127.0.0.1:1/'):
        top.measure(Master('http://127.0.0.1:1'), 0.1)


def test_a_node_that_was_killed_is_told_as_dead(mortal_master):
    master = Master(mortal_master.url)
    program = Program(
        master.url, sys.executable, str(PROGRAMS / 'publishes.py'), '/x', '9', '__name:=killed'
    )
    master.wait_for_node('/killed', TIMEOUT)
    program.end(signal.SIGKILL)
    row = rows(top.measure(master, 0.1).nodes)['/killed']
    assert (row.state, row.pid, row.sent) == ('dead', None, None)


def test_a_node_that_starts_or_ends_meanwhile_disturbs_nothing(master, sender):
    with top.Meter(master) as meter:
        meter.measure()
        with create(master, '/short') as short:
            short.interested_in('/traffic')
            row = rows(meter.measure().nodes)['/short']
            assert (row.received, row.intraprocess) == (None, 1)  # not known before
        assert '/short' not in rows(meter.measure().nodes)


def test_others_than_nodes_of_pharos_are_asked_for_their_health_once(master, monkeypatch):
    asked = []
    real = answers.node_api

    class Api:
        def __init__(self, uri, timeout):
            self._uri, self._api = uri, real(uri, timeout)

        def __getattr__(self, method):
            asked.append((method, self._uri))
            return getattr(self._api, method)

    monkeypatch.setattr(answers, 'node_api', Api)
    with Program(master.url, sys.executable, str(PROGRAMS / 'publishes.py'), '/x', '9') as program:
        program.wait_for('publishing')
        with top.Meter(master) as meter:
            for _ in range(3):
                meter.measure()
        (uri,) = [node.uri for node in master.nodes() if isinstance(node, ExternalNode)]
    assert asked.count(('getBusStats', uri)) == 3
    assert asked.count(('pharosHealth', uri)) == 1


def test_more_than_2_gib_through_a_connection_are_counted_on(master, sender):
    speak_tcpros_only(sender)
    with create(master, '/late') as late:
        late.interested_in('/traffic')
        impl = sender.latest_run.rospy.publisher('/traffic')
        socket = until(
            lambda: next(
                (each for each in impl.connections if each.transport_type == 'TCPROS'), None
            )
        )
        with impl.c_lock, socket._changed:  # nothing is counted meanwhile
            socket._connection.stat_bytes = impl.message_data_sent = 2**31 - 10
        node_api(sender.uri).getBusStats('/test')
        until(lambda: socket.stat_bytes > 2**31)
        _, _, (published, _, _) = node_api(sender.uri).getBusStats('/test')
        topic, _, connections = next(each for each in published if each[0] == '/traffic')
        assert min(count for _, count, *_ in connections) < 0  # as roscpp counts
        found = top.measure(master, 1, names=['/late'])
    # neither below 0, nor by 4 GiB too much
    assert 0 < rows(found.nodes)['/late'].bytes_received < 100 * RATE * SIZE


def test_nodes_are_asked_for_their_health_by_top_and_no_other_look(master, sender):
    told, real = [], sender.latest_run.rospy.tell_health
    sender.latest_run.rospy.tell_health = lambda: told.append(1) or real()
    master.graph(seconds=0.1)
    sender.describe(0)
    assert told == []
    with top.Meter(master) as meter:
        meter.measure()
    assert told == [1]
    node_api(sender.uri).pharosHealth('/test')
    assert told == [1, 1]


def test_the_clock_may_be_set_back_between_two_looks(master, sender, monkeypatch):
    with top.Meter(master) as meter:
        first = meter.measure()
        with monkeypatch.context() as patch:
            patch.setattr(time, 'time', lambda: first.time - 5)
            assert 0 < meter.measure().seconds < TIMEOUT


def test_looking_from_a_soul_ends_with_its_node(master):
    raised, began = [], threading.Event()

    def soul(me):
        began.set()
        try:
            top.measure(me.master, 100)
        except Exception as error:
            raised.append(type(error).__name__)

    node = create(master, soul=soul)
    thread = node.fork()
    assert began.wait(TIMEOUT)
    node.stop()
    thread.join(TIMEOUT)
    assert raised == ['NodeStoppedError']


# -- rosrun pharos top


def run_top(master_url, *arguments, **variables):
    """What the program prints and how it ends, where there is no terminal."""
    return subprocess.run(
        [str(PROGRAMS.parent.parent / 'scripts' / 'top'), *arguments],
        env=environment(master_url, **variables),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        timeout=2 * TIMEOUT,
        check=False,
    )


@pytest.mark.parametrize('arguments', [['--once'], []], ids=['once', 'piped'])
def test_without_a_terminal_all_tables_are_printed_once(master, sender, arguments):
    ended = run_top(master.url, '--interval', '0.5', *arguments)
    assert (ended.returncode, ended.stderr) == (0, '')
    tables = [block.splitlines() for block in ended.stdout.strip().split('\n\n')]
    assert [block[0].split()[0] for block in tables] == ['NODE', 'PID', 'TOPIC']
    line = next(line.split() for line in tables[0] if line.startswith('/sender '))
    assert line[1] == 'BlockNode'
    assert is_about(float(line[5]), RATE)
    assert any('/hearer /sender' in line and '%' in line for line in tables[1])
    assert any(line.startswith('/traffic std_msgs/String ') for line in tables[2])
    assert '\x1b' not in ended.stdout


def test_json_is_printed_for_scripts_and_as_help_says(master, sender):
    ended = run_top(master.url, '--json', '--interval', '0.5', 'sender', 'traffic', '__name:=top')
    assert (ended.returncode, ended.stderr) == (0, '')
    found = json.loads(ended.stdout)
    assert [row['name'] for row in found['nodes']] == ['/sender']
    assert [row['name'] for row in found['topics']] == ['/traffic']
    text = run_top(master.url, '--help').stdout
    kinds = top.Measurement, top.NodeRow, top.ProcessRow, top.TopicRow
    fields = {field.name for kind in kinds for field in dataclasses.fields(kind)}
    assert [field for field in fields if field not in text] == []


def test_what_is_wrong_is_told_in_one_line(master, tmp_path):
    (tmp_path / 'rich').mkdir()
    (tmp_path / 'rich' / '__init__.py').write_text("raise ModuleNotFoundError(name='rich')")
    without_rich = f"{tmp_path}:{environment('')['PYTHONPATH']}"
    for url, arguments, path, status, text in (
        ('http://127.0.0.1:1', ['--once'], None, 1, 'top: no ROS master answers at http://127'),
        ('http://127.0.0.1:1', ['--json'], None, 1, 'top: no ROS master answers at http://127'),
        ('nonsense', ['--once'], None, 1, 'top: ROS_MASTER_URI'),
        (master.url, ['--once'], without_rich, 1, 'sudo apt-get install python3-rich'),
        (master.url, ['--interval', '0'], None, 2, '--interval is a number of seconds above 0'),
    ):
        ended = run_top(url, *arguments, **({'PYTHONPATH': path} if path else {}))
        assert (ended.returncode, ended.stdout) == (status, ''), ended.stderr
        assert text in ended.stderr
        assert 'Traceback' not in ended.stderr
    ended = run_top(master.url, '--json', '--interval', '0.1', PYTHONPATH=without_rich)
    assert ended.returncode == 0


def test_who_reads_no_more_ends_it_quietly(master, sender):
    command = [str(PROGRAMS.parent.parent / 'scripts' / 'top'), '--json', '--interval', '0.1']
    with subprocess.Popen(
        command, env=environment(master.url), stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        process.stdout.close()
        assert process.stderr.read() == b''
    assert process.returncode == 0
