"""The documentation: it is built without a warning, nothing is missing in it, and no link is dead."""
import pathlib
import re
import subprocess
import sys
import zlib
from urllib.parse import unquote

import pytest

import pharos
from programs import ROOT

#: the packages that nothing else here needs
BUILT_BY = 'furo', 'python3-myst-parser', 'python3-sphinx', 'python3-sphinxcontrib.programoutput'
PAGES = [
    *ROOT.glob('*.md'),
    *(ROOT / 'doc').rglob('*.md'),
    ROOT / 'benchmark' / 'README.md',
    ROOT / 'examples' / 'README.md',
]


def without_code(text):
    """The text of a page without its blocks of code, which are fenced or indented."""
    text = re.sub(r'^(```+).*?^\1$', '', text, flags=re.DOTALL | re.MULTILINE)
    return re.sub(r'^    .*$', '', text, flags=re.MULTILINE)


def links(page):
    """``(target, anchor)`` of each link and picture of a page, but for those to the web."""
    for target in re.findall(r'\]\(([^)\s]+)\)', without_code(page.read_text())):
        if not re.match(r'\w+:', target):
            path, _, anchor = unquote(target).partition('#')
            yield path, anchor


def anchors(page):
    """What links to the headings of a page end in, on GitHub as in the pages that are built."""
    for heading in re.findall(r'^#+ (.*)$', without_code(page.read_text()), flags=re.MULTILINE):
        yield re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-')


@pytest.mark.parametrize('page', PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_no_link_of_a_page_is_dead(page):
    dead = []
    for path, anchor in links(page):
        target = page.parent / path if path else page
        if not target.exists() or anchor and anchor not in anchors(target):
            dead.append(f'{path}#{anchor}')
    assert dead == []


@pytest.fixture(scope='session')
def html():
    """The folder of the pages, built by tools/doc, which fails at the first warning."""
    if subprocess.run(['dpkg-query', '-W', *BUILT_BY], capture_output=True).returncode:
        pytest.skip('what tools/doc installs is not installed here')
    ended = subprocess.run(
        [ROOT / 'tools' / 'doc'], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert ended.returncode == 0, ended.stdout
    said = re.search(r'the pages are built: (\S+)/index\.html\Z', ended.stdout.strip())
    assert said, ended.stdout
    return ROOT / said[1]


def test_the_documentation_is_built_without_a_warning_and_begins_where_it_says(html):
    first = re.search(r'url=(\S+)"', (html / 'index.html').read_text())[1]
    assert '<h1>' in (html / first).read_text()


def test_the_reference_has_all_that_pharos_exports(html):
    lines = zlib.decompress((html / 'objects.inv').read_bytes().split(b'\n', 4)[4]).decode()
    shown = {line.split(' ')[0].rpartition('.')[2] for line in lines.splitlines()}
    missing = set(pharos.__all__) - shown - {'__version__'}
    assert missing == set(), 'say where in doc/reference'


def test_the_reference_shows_what_each_program_says_to_help(html):
    page = (html / 'doc' / 'reference' / 'programs.html').read_text()
    usages = set(re.findall(r'usage: (\w+)', page))
    assert usages == {path.name for path in (ROOT / 'scripts').iterdir() if path.is_file()}


def test_flowcharts_are_drawn(html):
    assert '<svg' in (html / 'doc' / 'architecture.html').read_text() or list(
        (html / '_images').glob('graphviz-*.svg')
    )


def test_the_pictures_of_the_benchmarks_show_the_figures_of_their_tables(tmp_path):
    pytest.importorskip('matplotlib')
    command = [sys.executable, ROOT / 'benchmark' / 'picture', '--output', tmp_path]
    drawn = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.split()
    assert len(drawn) == 6
    for path in map(pathlib.Path, drawn):
        assert texts(path) == texts(ROOT / 'doc' / path.name), 'benchmark/picture --output doc'


def texts(picture):
    """What is written in a picture, but for the marks of its axes, which depend on matplotlib."""
    found = re.findall(r'<text [^>]*>([^<]+)</text>', picture.read_text())
    assert {'direct call', 'six processes', 'zenoh', 'pharos', 'pharos default'} & set(found)
    return [text for text in found if not re.fullmatch(r'[\d.]+', text) or '.' in text]


def test_an_unknown_argument_of_tools_doc_is_refused():
    ended = subprocess.run([ROOT / 'tools' / 'doc', '--pdf'], stderr=subprocess.PIPE, text=True)
    assert ended.returncode == 2
    assert ended.stderr.startswith('usage: tools/doc')
