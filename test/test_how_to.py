"""The how-to pages of doc/: each block of Python in them, run by itself at a master, prints what
stands below it."""
import io
import re
import sys
from typing import NamedTuple

import pytest

import pharos
from pharos.testing import until
from programs import ROOT, run

BLOCK = re.compile(r'^```python\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?', re.DOTALL | re.MULTILINE)
PYTEST = sys.executable, '-m', 'pytest', '-q', '-p', 'pharos.testing'


class Block(NamedTuple):
    """A block of Python, and what stands below it."""

    where: str
    text: str
    printed: str


def blocks():
    """Those of all pages but the tutorial, which is a session that test_tutorial.py types."""
    for page in sorted((ROOT / 'doc').glob('*.md')):
        source = page.read_text()
        for found in BLOCK.finditer(source if page.name != 'tutorial.md' else ''):
            line = source.count('\n', 0, found.start()) + 1
            yield Block(f'{page.name}:{line}', found[1], found[2] or '')


def pattern_of(printed):
    """What matches it: its lines in their order, between which others may be, with ``...`` for
    anything."""
    lines = [r'.*'.join(map(re.escape, line.split('...'))) for line in printed.splitlines()]
    return re.compile(r'^' + r'$(?:.*\n)*?^'.join(lines) + r'$', re.MULTILINE)


class Printed(io.TextIOBase):
    """Standard output that threads write to while another one reads what there is so far, of which
    pytest's own can crash."""

    def __init__(self):
        self._parts = []

    def write(self, text):
        self._parts.append(text)

    def __str__(self):
        return ''.join(self._parts)


@pytest.mark.parametrize('block', blocks(), ids=lambda block: block.where)
def test_a_block_of_a_page_does_what_it_says(block, master, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    if re.search(r'^def test_', block.text, re.MULTILINE):
        (tmp_path / 'test_page.py').write_text(block.text)
        ended = run(master.url, *PYTEST, cwd=tmp_path)
        assert ended.returncode == 0, ended.stdout
        return
    pattern, printed = pattern_of(block.printed), Printed()
    monkeypatch.setattr(sys, 'stdout', printed)

    def is_printed():
        return pattern.search(str(printed))

    # what spin() waits for, Ctrl-C, comes when all is printed
    monkeypatch.setattr(pharos, 'spin', lambda: until(is_printed, what=block.printed))
    exec(compile(block.text, block.where, 'exec'), {'__name__': '__main__'})
    assert is_printed(), f'{printed}\nis printed, and not\n{block.printed}'
