"""benchmark/middleware, as far as it goes with nothing installed by pip."""
import sys

import pytest

from programs import ROOT, run

ROWS = 'shared_memory,iceoryx2,rospy,1 process'


@pytest.fixture(scope='module')
def printed(tmp_path_factory):
    """What it says in a quick run, in which pip has installed nothing."""
    nothing = tmp_path_factory.mktemp('nothing')
    command = str(ROOT / 'benchmark' / 'middleware'), '--quick', '--into', str(nothing)
    ended = run('http://127.0.0.1:1/', sys.executable, *command, '--rows', ROWS, '--receivers', '1')
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def line_of(printed, words):
    (found,) = [line for line in printed.splitlines() if words in line]
    return found


def test_what_is_not_installed_is_named_with_what_to_do(printed):
    said = line_of(printed, 'without iceoryx2')
    assert "No module named 'iceoryx2'" in said
    assert '--install has pip put it into' in said
    assert printed.count('iceoryx2') == said.count('iceoryx2')


def test_rows_that_need_nothing_are_measured(printed):
    for name in ('shared_memory', 'shared_memory, copied', 'rospy', 'pharos, 1 process'):
        _, *figures = line_of(printed, f'{name:26}|').split('|')
        assert len(figures) == 3
        assert all(float(figure.replace(',', '').split()[0]) > 0 for figure in figures)


def test_it_says_what_receivers_own_as_it_was_seen(printed):
    assert line_of(printed, '  pharos, 1 process   ').split('  ')[-1].strip() == 'it stays'
    assert 'seen by no other' in line_of(printed, '  pharos, 1 process   ')
    assert 'seen by the others' in line_of(printed, '  rospy   ')
    assert 'change' in line_of(printed, '  shared_memory   ')
    assert 'refused' in line_of(printed, '  shared_memory, copied   ')
