"""What a type checker, and so an editor, knows of a user's program."""
import importlib.util
import os
import re
import subprocess
import sys

import pytest

from pharos.testing import TIMEOUT
from programs import ROOT

PROGRAM = ROOT / 'test' / 'programs' / 'wrong_keyword.py'


@pytest.mark.skipif(not importlib.util.find_spec('mypy'), reason='needs mypy')
def test_mypy_finds_the_mistakes_in_a_users_program(tmp_path):
    command = [sys.executable, '-m', 'mypy', '--config-file', os.devnull, '--cache-dir', tmp_path]
    imports = ['--ignore-missing-imports', '--follow-imports', 'silent']
    ended = subprocess.run(
        [*command, *imports, '--no-error-summary', '--hide-error-context', PROGRAM],
        env={**os.environ, 'MYPYPATH': str(ROOT / 'src')},
        stdout=subprocess.PIPE,
        text=True,
        timeout=TIMEOUT,
        check=False,
    )
    found = re.findall(r'wrong_keyword\.py:(\d+): error', ended.stdout)
    lines = PROGRAM.read_text().splitlines()
    mistakes = [str(number) for number, line in enumerate(lines, 1) if '# mistake' in line]
    assert found == mistakes, ended.stdout
