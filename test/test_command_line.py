"""The programs of the command line: outputs that cannot be written to, or not all characters."""
import os
import subprocess
import sys

import pytest

from helpers import create
from pharos import MasterUnreachableError, PharosError, program
from pharos.live import dot, graphviz
from pharos.testing import TIMEOUT
from programs import environment, run, script
from terminal import Terminal

ONCE = '--once', '--interval', '0.2'


def run_in_shell(master, command, **variables):
    return subprocess.run(
        command,
        shell=True,
        env=environment(master.url, TOP=script('top'), GRAPH=script('graph'), **variables),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        timeout=2 * TIMEOUT,
        check=False,
    )


@pytest.mark.parametrize('name', ['top', 'graph'])
def test_an_output_that_cannot_be_written_is_told_in_one_line(master, name):
    once = ' '.join(ONCE) if name == 'top' else ''
    for target, text in (('/dev/full', 'No space left'), ('&-', 'standard output is closed')):
        ended = run_in_shell(master, f'"${name.upper()}" {once} >{target}')
        assert ended.returncode == 1
        (line,) = ended.stderr.decode().splitlines()
        assert line.startswith(f'{name}: ') and text in line


@pytest.mark.parametrize('name', ['top', 'graph'])
def test_an_output_that_takes_no_utf_8_gets_question_marks(master, name):
    create(master, '/hearer').interested_in('/unheard', 'std_msgs/String')
    once = ' '.join(ONCE) if name == 'top' else ''
    python = {'PYTHONUTF8': '0', 'PYTHONCOERCECLOCALE': '0', 'LC_ALL': 'C'}
    ended = run_in_shell(master, f'"${name.upper()}" {once}', **python)
    assert (ended.returncode, ended.stderr) == (0, b'')
    assert b'/hearer' in ended.stdout


def test_a_program_replaces_what_its_output_cannot_encode(monkeypatch, tmp_path):
    with open(tmp_path / 'out', 'w', encoding='ascii') as output:
        monkeypatch.setattr(sys, 'stdout', output)
        assert program.run('odd', lambda: print('a…b') or 0) == 0
    assert (tmp_path / 'out').read_text() == 'a?b\n'


def test_a_program_of_nodes_needs_no_output(monkeypatch):
    monkeypatch.setattr(sys, 'stdout', None)
    assert program.run('odd', lambda: print('nowhere')) == 0


def test_a_program_tells_our_errors_in_one_line(capsys):
    def fail():
        raise MasterUnreachableError('no master')

    assert program.run('odd', fail) == 1
    assert capsys.readouterr().err == 'odd: no master\n'


@pytest.mark.parametrize('how', ['--once', '--json'])
def test_top_of_what_is_not_there_is_an_error(master, how):
    ended = run(master.url, sys.executable, script('top'), 'nosuchname', how, '--interval', '0.2')
    assert (ended.returncode, ended.stdout) == (1, '')
    assert 'top: no node or topic has nosuchname in its name: see rosnode list' in ended.stderr


def top_in_terminal(master, *variables):
    """Live top, in a terminal of which these variables say something else."""
    return Terminal(
        master.url, 'env', *variables, sys.executable, script('top'), '--interval', '0.2'
    )


@pytest.mark.parametrize('name', ['unknown', 'dumb'])
def test_top_prints_once_where_a_terminal_cannot_be_drawn_on(master, name):
    with top_in_terminal(master, f'TERM={name}') as terminal:
        terminal.wait_for('TOPIC')
        assert terminal.wait() == 0


def test_top_draws_where_the_size_is_said_to_be_none(master):
    with top_in_terminal(master, 'COLUMNS=0', 'LINES=0') as terminal:
        terminal.wait_for('pharos top')
        terminal.press('q')
        assert terminal.wait() == 0


# -- pictures in files


@pytest.mark.parametrize(
    'path, error', [(None, TypeError), (b'x.svg', TypeError), ('a\0b.svg', ValueError)]
)
def test_what_is_no_path_of_a_picture_is_named(path, error):
    with pytest.raises(error, match="a path such as 'graph.svg', not to"):
        graphviz.save('digraph {}', path)


def test_a_file_s_name_may_be_as_long_as_names_can_be(tmp_path):
    path = tmp_path / ('x' * 251 + '.dot')
    graphviz.save('digraph {}', path)
    assert os.listdir(tmp_path) == [path.name]


def test_a_name_may_be_empty_or_slashes_alone():
    for name in '', '/', '//':
        graphviz.render(f'digraph {{ a [label={dot._label(name, bold=True)}] }}', 'svg')


@pytest.mark.parametrize(
    'does, mode, text',
    [
        ('exit 0', 0o755, 'dot ended with 0'),
        ('kill -9 $$', 0o755, 'dot ended with -9'),
        (r"printf '\377odd' >&2; exit 1", 0o755, 'cannot draw it: .odd'),
        ('exit 0', 0o644, 'Permission denied.*apt-get install graphviz'),
    ],
)
def test_a_graphviz_that_fails_is_an_error_of_ours(tmp_path, monkeypatch, does, mode, text):
    (tmp_path / 'dot').write_text(f'#!/bin/sh\n{does}\n')
    (tmp_path / 'dot').chmod(mode)
    monkeypatch.setenv('PATH', str(tmp_path))
    with pytest.raises(PharosError, match=text):
        graphviz.render('digraph {}', 'svg')
