"""Logging: each line once, under the node's name, with the caller's file and line; the host's
logging untouched."""
import inspect
import logging
import os
import pathlib
import re
import subprocess
import sys

import pytest

from helpers import create
from pharos.testing import Mailbox, TIMEOUT
import pharos
from programs import PROGRAMS, environment


def hear(master):
    """What goes to /rosout, as the node that listens hears it, without the chatter about itself."""
    lines = Mailbox()
    create(master, '/auditor', delegate=lines).interested_in(
        '/rosout', 'rosgraph_msgs/Log', from_=None
    )
    return lines


def test_each_line_is_on_rosout_once_with_name_file_and_line(master):
    lines = hear(master)
    nodes = [create(master, '/robot%d/talker' % i) for i in range(3)]
    for node in nodes:
        node.log(f'{node.name} says 100% hello', level='warn')
        line = inspect.currentframe().f_lineno - 1
        node.ros.loginfo('and through rospy')
    heard = [lines.next() for _ in range(6)]
    for node in nodes:
        own, through_rospy = [log for log in heard if log.name == node.name]
        assert own.msg == f'{node.name} says 100% hello'
        assert own.level == own.WARN
        assert (os.path.basename(own.file), own.line) == (os.path.basename(__file__), line)
        assert own.function.endswith('test_each_line_is_on_rosout_once_with_name_file_and_line')
        assert (through_rospy.msg, through_rospy.line) == ('and through rospy', line + 2)
    assert lines.empty()


def test_a_node_that_is_not_started_logs_to_the_transcript(master, transcript):
    node = create(master)
    node.stop()
    node.log('after all', 'warning')
    assert transcript == ['[WARNING] /node: after all']


def test_a_log_level_is_set_per_node(master):
    lines = hear(master)
    quiet, normal = create(master, '/quiet'), create(master, '/normal')
    levels = master.lookup_service('/quiet/set_logger_level').call(
        logger='rosout', level='error', timeout=10
    )
    assert levels is not None
    for node in quiet, normal:
        node.log('a detail')
    assert lines.next().name == '/normal'
    assert lines.empty()


def test_each_node_has_a_log_file(master):
    create(master, '/robot1/filed').log('to the file')
    path = pathlib.Path(os.environ['ROS_LOG_DIR']) / 'robot1_filed.log'
    assert 'to the file' in path.read_text()


def test_the_hosts_logging_is_untouched(master):
    root = logging.getLogger()
    before = list(root.handlers), root.level, logging.getLoggerClass(), set(logging._handlers)
    node = create(master, '/guest')
    node.log('not for the host')
    assert (list(root.handlers), root.level, logging.getLoggerClass()) == before[:3]
    node.stop()
    assert (list(root.handlers), root.level, logging.getLoggerClass()) == before[:3]


def test_a_host_that_is_a_rospy_node_itself_stays_one(master):
    """Its name, its log lines and its subscription are its own, beside two nodes of ours."""
    result = subprocess.run(
        [sys.executable, PROGRAMS / 'rospy_node_with_others.py'],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=dict(os.environ, PYTHONPATH=str(pathlib.Path(pharos.__file__).parent.parent)),
        timeout=60,
        check=False,
    )
    assert result.returncode == 0, result.stdout
    assert result.stdout.count('the host speaks') == 1
    assert result.stdout.count('node a speaks') == 1
    assert 'caught' in result.stdout


@pytest.mark.parametrize('closed', ['>&-', '2>&-', '>&- 2>&-', '<&- >&- 2>&-'])
def test_a_program_started_without_a_screen_logs_all_the_same(master, tmp_path, closed):
    code = """
import sys
from pharos import BlockNode, Master, Transcript
me = Master().create(BlockNode, named='/screenless', domain='127.0.0.1')
me.log('line')
me.log('line', 'error')
Transcript.show('line')
me.stop()
open(sys.argv[1], 'w').write('went on')
"""
    told = tmp_path / 'told'
    status = subprocess.run(
        ['sh', '-c', f'exec "$0" "$@" {closed}', sys.executable, '-c', code, told],
        env=environment(master.url),
        check=False,
        timeout=TIMEOUT,
    ).returncode
    assert (status, told.read_text()) == (0, 'went on')


def test_a_node_whose_log_file_finds_the_disk_full_stops_and_starts_again(
    master, monkeypatch, tmp_path, capsys
):
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path))
    (tmp_path / 'unwritten.log').symlink_to('/dev/full')
    node = create(master, '/unwritten')
    for _ in range(2):
        node.log('line')
        node.stop()
        node.start()
    assert node.is_running


# -- on the screen


def told(master, *arguments, **variables):
    """What the program prints, on standard output and error: of each line what it ends with."""
    process = subprocess.run(
        [sys.executable, PROGRAMS / 'tells.py', *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT if variables.pop('one_screen', True) else subprocess.PIPE,
        text=True,
        env=environment(master.url, **variables),
        timeout=2 * TIMEOUT,
        check=True,
    )
    return process.stdout, process.stderr or ''


def test_lines_on_the_screen_name_the_node(master):
    printed, _ = told(master)
    assert re.search(r'^\[INFO\] \[[\d.]+\]: /first: hello$', printed, re.M)
    assert re.search(r'^\[WARN\] \[[\d.]+\]: /robot/second: careful$', printed, re.M)


def test_a_format_of_ones_own_says_what_a_line_on_the_screen_has(master):
    printed, _ = told(master, ROSCONSOLE_FORMAT='${severity} of ${node}: ${message}')
    assert 'INFO of /first: hello\n' in printed
    assert 'WARN of /robot/second: careful\n' in printed
    printed, _ = told(master, ROSCONSOLE_FORMAT='${message}')
    assert {'hello', 'careful'} <= set(printed.splitlines())


def test_a_failure_is_told_once_where_the_log_and_the_transcript_come_on_one_screen(master):
    printed, _ = told(master)
    for what in 'soul <lambda> of /first raised', 'service /fails <lambda> of /robot/second raised':
        assert printed.count(what) == 1
    assert printed.count('Traceback') == 2


def test_a_failure_is_told_by_the_log_and_the_transcript_where_they_go_apart(master):
    printed, errors = told(master, one_screen=False)
    for text in printed, errors:
        assert text.count('soul <lambda> of /first raised ValueError') == 1
        assert text.count('service /fails <lambda> of /robot/second raised ValueError') == 1
    assert (printed.count('Traceback'), errors.count('Traceback')) == (0, 2)


def test_a_receiver_of_the_transcript_gets_what_is_on_the_screen(master):
    printed, _ = told(master, 'redirect')
    assert printed.endswith('the Transcript was given 2\n')
    assert printed.count('raised ValueError') == 2


def test_a_failure_is_told_where_the_log_shows_nothing_on_the_screen(master, tmp_path):
    """As where a logging configuration of one's own has files alone."""
    configuration = tmp_path / 'logging.conf'
    configuration.write_text(
        '[loggers]\nkeys=root\n[handlers]\nkeys=\n[formatters]\nkeys=\n'
        '[logger_root]\nlevel=INFO\nhandlers=\n'
    )
    printed, _ = told(master, ROS_PYTHON_LOG_CONFIG_FILE=str(configuration))
    assert printed.count('raised ValueError') == 2
    assert 'hello' not in printed


def test_a_log_that_cannot_be_opened_is_told_as_that(master, tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path))
    (tmp_path / 'without_log.log').mkdir()
    with pytest.raises(pharos.PharosError, match='without_log.log cannot be opened .* ROS_LOG_DIR'):
        create(master, '/without_log')
