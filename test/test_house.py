"""The house: which file imports which, and the numbers that stand in several places."""
import fnmatch
import re
import runpy

from helpers import ROOT

SOURCE = ROOT / 'src' / 'pharos'
FILES = {str(path.relative_to(SOURCE))[:-3]: path for path in sorted(SOURCE.rglob('*.py'))}
ROOMS = [name for name in FILES if name.endswith('/__init__')]  # empty, but for commands


def floors():
    """The floors of architecture.md, the lowest first, as {file: number}."""
    text = (ROOT / 'doc' / 'architecture.md').read_text()
    table = text[text.index('| floor |') : text.index('| file |')].replace('\\', '')
    numbers = {}
    for number, row in enumerate(table.splitlines()[2:]):
        for pattern in row.rpartition('|')[0].rpartition('|')[2].split():
            numbers.update({name: number for name in fnmatch.filter(FILES, pattern)})
    return numbers


HINTS = re.compile(r'^if TYPE_CHECKING:\n(?: .*\n|\n)+', re.M)
IMPORT = re.compile(r'^ *(?:from (pharos[\w.]*) import (\([^)]*|.*)|import (pharos[\w.]*))', re.M)


def imports_of(path):
    """The files that a file imports, also in a function, but for hints alone."""
    for module, names, whole in IMPORT.findall(HINTS.sub('', path.read_text())):
        for name in re.findall(r'\w+', re.sub(r' as \w+|#.*', '', names)) or ['']:
            choices = f'{module}.{name}', module or whole  # a module of a package, or a name in one
            files = [re.sub('^pharos/', '', choice.replace('.', '/')) for choice in choices]
            files = ['__init__' if file == 'pharos' else file for file in files]
            yield from [file for file in files if file in FILES.keys() - ROOMS][:1]


def test_no_file_imports_a_floor_above():
    numbers = floors()
    assert FILES.keys() - ROOMS <= numbers.keys()
    wrong = [
        (name, imported)
        for name in FILES.keys() - ROOMS
        for imported in imports_of(FILES[name])
        if numbers[imported] > numbers[name]
    ]
    assert wrong == []


def test_no_files_import_each_other():
    left = {name: set(imports_of(FILES[name])) - {name} for name in FILES.keys() - ROOMS}
    while free := {name for name, imported in left.items() if not imported & left.keys()}:
        left = {name: left[name] for name in left.keys() - free}
    assert left == {}


def test_clock_is_read_as_an_attribute_unless_it_is_to_be_real():
    """A simulation replaces the functions of the modules time and threading."""
    by_name = re.compile(r'^ *from (?:time|threading|_thread) import (.*)', re.M)
    for path in FILES.values():
        for names in by_name.findall(path.read_text()):
            if re.search(r'monotonic|perf_counter|sleep|[Ll]ock|Event|Condition', names):
                is_simulation = path.parent.name == 'simulation'
                assert is_simulation or names.endswith('# by name: real, also in a simulation')


def test_table_of_contributing_has_all_files():
    """It names each file of tests, and no file that is not there."""
    text = (ROOT / 'CONTRIBUTING.md').read_text()
    begin, end = text.index('| to change |'), text.index('## Layout')
    names = set(re.findall(r'`([\w/]+\.py)`', text[begin:end]))
    tests = {path.name for path in (ROOT / 'test').glob('test_*.py')}
    assert {name for name in names if name.startswith('test_')} == tests
    assert [name for name in names - tests if not (SOURCE / name).exists()] == []


def test_versions_are_equal():
    places = {
        'package.xml': r'<version>([\d.]+)<',
        'src/pharos/__init__.py': r"__version__ = '([\d.]+)'",
        'debian/changelog': r'pharos \(([\d.]+)-',
        'packaging/robostack/recipe.yaml': r'version: ([\d.]+)\n',
        'CITATION.cff': r'\nversion: ([\d.]+)\n',
        'CHANGELOG.rst': r'\n([\d.]+) \(20',
    }
    versions = {
        re.search(pattern, (ROOT / name).read_text())[1] for name, pattern in places.items()
    }
    assert len(versions) == 1


def test_read_the_docs_has_what_the_pages_need():
    """tools/package may install nothing there."""
    tool = (ROOT / 'tools' / 'package').read_text()
    needed = re.search(r'doc\)\n\s+install_packages (.*?[^\\])\n', tool, re.S)[1]
    config = (ROOT / '.readthedocs.yaml').read_text()
    assert set(needed.replace('\\', '').split()) == set(
        re.findall(r'\n    - ([\w-]+)(?=\n)', config)
    )


def test_each_change_of_mutate_can_be_made():
    """A row that names what the source has no more ends tools/mutate."""
    mutate = runpy.run_path(str(ROOT / 'tools' / 'mutate'))
    assert list(mutate['read_rows'](''))
