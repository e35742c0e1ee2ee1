"""What a type checker, and so an editor, knows of a user's program."""
import importlib.util
import os
import re
import subprocess
import sys

import pytest

from pharos.testing import TIMEOUT
from programs import ROOT

PROGRAMS = ROOT / 'test' / 'programs'
PLAIN, PLUGIN = '# mistake', '# with the plugin'


def lines_of(program, marks):
    """What stands for the lines of a program that have one of the marks."""
    lines = program.read_text().splitlines()
    marked = (number for number, line in enumerate(lines, 1) if any(mark in line for mark in marks))
    return [f'{program.name}:{number}' for number in marked]


@pytest.mark.skipif(not importlib.util.find_spec('mypy'), reason='needs mypy')
@pytest.mark.parametrize('has_plugin', [False, True], ids=['plain', 'plugin'])
def test_mypy_finds_the_mistakes_in_a_users_program_and_none_in_a_right_one(tmp_path, has_plugin):
    programs = [PROGRAMS / 'right_keywords.py', PROGRAMS / 'wrong_keyword.py']
    config = tmp_path / 'mypy.ini'
    config.write_text('[mypy]\n' + 'plugins = pharos.mypy_plugin\n' * has_plugin)
    command = [sys.executable, '-m', 'mypy', '--config-file', config, '--cache-dir', tmp_path]
    imports = ['--ignore-missing-imports', '--follow-imports', 'silent']
    source = str(ROOT / 'src')
    ended = subprocess.run(
        [*command, *imports, '--no-error-summary', '--hide-error-context', *programs],
        env={**os.environ, 'MYPYPATH': source, 'PYTHONPATH': source},
        stdout=subprocess.PIPE,
        text=True,
        timeout=2 * TIMEOUT,
        check=False,
    )
    # once for each line, of which some mypys say two things
    found = list(dict.fromkeys(re.findall(r'(\w+\.py:\d+): error', ended.stdout)))
    mistakes = lines_of(programs[1], [PLAIN, PLUGIN] if has_plugin else [PLAIN])
    assert found == mistakes, ended.stdout
