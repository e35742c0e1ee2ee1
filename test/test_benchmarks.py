"""The programs of benchmark/: what they refuse, what ends them, and what their tables tell."""
import importlib.machinery
import importlib.util
import signal
import sys

import psutil
import pytest

from pharos.testing import TIMEOUT, until
from programs import ROOT, Program, run

NOWHERE = 'http://127.0.0.1:1/'
BENCHMARK = ROOT / 'benchmark'


@pytest.fixture
def module(monkeypatch):
    """A function that imports what has this name in benchmark/, with or without a suffix."""
    before = set(sys.modules)
    monkeypatch.syspath_prepend(str(BENCHMARK))

    def imported(name):
        loader = importlib.machinery.SourceFileLoader(name, str(BENCHMARK / name))
        found = importlib.util.module_from_spec(importlib.util.spec_from_loader(name, loader))
        loader.exec_module(found)
        return found

    yield imported
    for name in set(sys.modules) - before:
        if str(BENCHMARK) in str(getattr(sys.modules[name], '__file__', '')):
            del sys.modules[name]


@pytest.mark.parametrize(
    'words, said',
    [
        ('channels --receivers 0', "'0' is not a list as 1,10 of whole numbers from 1 to 1e9"),
        ('channels --rounds -1', "'-1' is not a whole number from 1 to 1e9"),
        ('channels --rows rospy,rosjava', "no 'rosjava' in any of: direct call; "),
        ('channels --messages twist,pose', "no 'pose': of twist, string, image0.9, image6.2"),
        ('channels --skip all', "no 'all': of busy, sharing, short"),
        ('middleware --receivers 5', '--receivers takes 1, 10 or 1,10'),
        ('middleware --rows ros2', "no 'ros2' in any of: pharos, 1 process, inline; "),
        ('middleware --seconds 0', "'0' is not a number of seconds above 0"),
        ('scale --sizes 6MB', "'6MB' is not a list as 1,10 of whole numbers from 1 to 1e9"),
        ('scale --nodes 10,many', "'10,many' is not a list as 1,10 of whole numbers from 1 to 1e9"),
        ('services --seconds -1', "'-1' is not a number of seconds above 0"),
        ('nodes --rounds -1', "'-1' is not a whole number from 1 to 1e9"),
        ('scale threads', 'no section threads: of nodes, topics'),
        ('picture no_such_file', 'cannot read no_such_file'),
        ('picture /bin/true', 'cannot read /bin/true'),
        ('picture --output no_such_folder', 'no folder no_such_folder'),
        ('picture CHANGELOG.rst', 'CHANGELOG.rst has no table of channels, compose, scale'),
    ],
)
def test_what_cannot_be_meant_is_refused_with_what_can(words, said):
    program, *arguments = words.split()
    if program == 'picture':
        pytest.importorskip('matplotlib')
    ended = run(NOWHERE, str(BENCHMARK / program), *arguments, cwd=ROOT)
    assert said in ' '.join(ended.stderr.split())
    assert 'Traceback' not in ended.stderr
    assert ended.returncode != 0


def test_a_whole_name_of_a_row_gives_that_row_alone(module):
    chosen = module('argument_types.py').some_of(('pharos, 1 process', 'rospy, 1 process', 'zenoh'))
    assert chosen('pharos, 1 process') == ['pharos, 1 process']
    assert chosen('PROCESS,zen') == ['pharos, 1 process', 'rospy, 1 process', 'zenoh']


def test_a_table_of_channels_fits_a_terminal_and_is_read_for_its_picture(module, capsys):
    pytest.importorskip('matplotlib')
    rows = module('rows.py')
    slices = {
        (('twist', 1, 'paced'), 'rospy, 1 process, tuned'): [rows.Slice([3e-3] * 9, 100, 44, 1, 1)],
        (('twist', 1, 'flat'), 'rospy, 1 process, tuned'): [rows.Slice([1e-6], 1000, 750, 1, 1)],
    }
    module('tables.py').print_ways(['rospy, 1 process, tuned'], ['twist'], [1], slices)
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= 120
    assert '56% lost' in printed
    found = module('picture').read_channels(printed)
    assert found == {('twist', 1): {'rospy, 1 process, tuned': (3000.0, 750.0, 25.0)}}


def test_a_benchmark_that_is_ended_leaves_no_process_and_no_file(tmp_path):
    command = str(BENCHMARK / 'scale'), 'nodes', '--nodes', '2', '--idle', '600'
    with Program(NOWHERE, *command, TMPDIR=str(tmp_path)) as program:
        own = psutil.Process(program.process.pid)

        def commands_of_children():
            return [' '.join(child.cmdline()) for child in own.children(recursive=True)]

        until(lambda: any('scaling.py' in command for command in commands_of_children()))
        children = own.children(recursive=True)
        assert any('counting_master.py' in command for command in commands_of_children())
        assert program.end(signal.SIGTERM) == 128 + signal.SIGTERM
    gone, alive = psutil.wait_procs(children, TIMEOUT)
    assert alive == []
    assert list(tmp_path.iterdir()) == []


def test_what_ends_in_the_midst_is_named_and_the_others_are_measured(tmp_path):
    (tmp_path / 'bin').mkdir()
    (tmp_path / 'iceoryx2.py').write_text('# is there, and does nothing\n')
    interpreter = tmp_path / 'bin' / 'python3'
    interpreter.write_text(
        f'#!/bin/sh\nPYTHONPATH={tmp_path}:$PYTHONPATH exec /usr/bin/python3 "$@"\n'
    )
    interpreter.chmod(0o755)
    words = '--quick', '--into', str(tmp_path), '--rows', 'iceoryx2,shared_memory'
    ended = run(NOWHERE, str(BENCHMARK / 'middleware'), *words, '--receivers', '1', '--skip', 'own')
    assert ended.returncode == 0, ended.stderr
    said = ' '.join(ended.stdout.split())
    assert "module 'iceoryx2' has no attribute 'set_log_level'" in said
    (measured,) = [
        line for line in ended.stdout.splitlines() if line.startswith('shared_memory   ')
    ]
    assert '-' not in measured


def test_a_limit_is_told_by_its_name_and_the_others_go_on():
    ended = run(NOWHERE, str(BENCHMARK / 'scale'), '--quick', 'limits')
    assert ended.returncode == 0, ended.stderr
    printed = ' '.join(ended.stdout.split())
    descriptors, threads = printed.split(' ulimit -u, 20 more than the user has: ')
    assert 'Too many open files (64 is the limit of this process)' in descriptors
    assert 'NoThreadError: no thread for /scale/n' in threads
    assert 'What allows no more is ulimit -u (' in threads
    assert printed.count('; the others go on') == 3
