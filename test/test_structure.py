"""The shape of the code, as DESIGN.md and API.md have it."""
import ast
import inspect
import pathlib
import re

import pytest

import pharos

ROOT = pathlib.Path(pharos.__file__).resolve().parent
MODULES = sorted(ROOT.rglob('*.py'))
SCRIPTS = sorted(path for path in (ROOT.parent.parent / 'scripts').iterdir() if path.is_file())

ROSPYS_INSIDE = re.compile(
    r'rospy\.impl|rospy\.(core|topics|names)\._|_topic_manager|protocol_handlers'
)
LINE_LIMIT = 460
ROOMS_BELOW = 'pharos.private_rospy', 'pharos.intraprocess', 'pharos.messages'

EXPORTS = """
    Master Node BlockNode Lifecycle ExternalNode Topic InputChannel OutputChannel Service Parameter Transcript RosProcess
    Failure message_class service_class define_message define_service spin __version__
    PharosError MasterUnreachableError NodeNameInUseError PortInUseError UnknownNodeError UnknownTopicError
    UnknownTypeError MessageTypeError UnknownServiceError ServiceTypeError ServiceCallError NodeStoppedError
""".split()


def in_module(function):
    """Run a test once for each module, and name it after it."""
    return pytest.mark.parametrize('path', MODULES, ids=lambda path: str(path.relative_to(ROOT)))(
        function
    )


def dotted(path):
    """The name under which the module at ``path`` is imported."""
    return '.'.join(path.relative_to(ROOT.parent).with_suffix('').parts).replace('.__init__', '')


def test_the_exports_are_those_of_the_contract():
    assert sorted(pharos.__all__) == sorted(EXPORTS)
    assert all(hasattr(pharos, name) for name in EXPORTS)


def test_a_star_import_gives_the_exports():
    names = {}
    exec('from pharos import *', names)
    assert set(names) - {'__builtins__'} == set(EXPORTS)


def test_the_table_of_contents_is_imports_and_all():
    source = (ROOT / '__init__.py').read_bytes()
    assert source.isascii() and b'__file__' not in source
    docstring, *statements = ast.parse(source).body
    assert isinstance(docstring, ast.Expr)
    assigned = [
        statement.targets[0].id for statement in statements if isinstance(statement, ast.Assign)
    ]
    assert assigned == ['__version__', '__all__']
    assert all(isinstance(statement, (ast.Assign, ast.ImportFrom)) for statement in statements)


@in_module
def test_only_private_rospy_touches_rospys_inside(path):
    if path.parent.name not in ('private_rospy', 'patches', 'intraprocess'):
        assert ROSPYS_INSIDE.findall(path.read_text()) == []


@in_module
def test_the_facade_takes_rospy_from_one_place(path):
    """The import of rospy leaves a mark on the host's logging, which private_rospy/process_rospy.py
    takes away again."""
    if path.name != 'process_rospy.py':
        assert (
            re.findall(r'^\s*import rospy$|^\s*from rospy import', path.read_text(), re.MULTILINE)
            == []
        )


def imports_of(path):
    """The modules of this package that the one at ``path`` imports when it is imported itself."""
    known = {dotted(other) for other in MODULES}
    # what stands in a function, or under TYPE_CHECKING, is not run by the import
    for statement in ast.parse(path.read_text()).body:
        if isinstance(statement, ast.Import):
            yield from (alias.name for alias in statement.names if alias.name in known)
        elif isinstance(statement, ast.ImportFrom) and statement.module in known:
            for alias in statement.names:
                name = f'{statement.module}.{alias.name}'
                yield name if name in known else statement.module


def test_imports_point_one_way():
    graph = {dotted(path): set(imports_of(path)) for path in MODULES}
    assert all(graph[name] for name in ('pharos', 'pharos.node', 'pharos.master'))
    while graph:  # take away what imports nothing that is left; a cycle stays
        ends = {name for name, imported in graph.items() if not imported}
        assert ends, f'these import each other: {graph}'
        graph = {name: imported - ends for name, imported in graph.items() if name not in ends}


def test_the_rooms_below_the_facade_know_nothing_of_nodes():
    """Of the facade above it, it may know what itself imports nothing of the facade."""
    graph = {
        dotted(path): {name for name in imports_of(path) if not name.startswith(ROOMS_BELOW)}
        for path in MODULES
    }
    imported = set().union(
        *(names for name, names in graph.items() if name.startswith(ROOMS_BELOW))
    )
    assert {name for name in imported if graph[name]} == set()


@pytest.mark.parametrize('path', SCRIPTS, ids=lambda path: path.name)
def test_a_script_is_run_by_debians_python(path):
    assert path.read_text().startswith('#!/usr/bin/python3\n')
    assert path.stat().st_mode & 0o111 == 0o111


@in_module
def test_a_module_fits_its_noun(path):
    assert len(path.read_text().splitlines()) <= LINE_LIMIT


@in_module
def test_a_module_and_what_is_public_in_it_have_a_docstring(path):
    module = ast.parse(path.read_text())
    public = [
        item
        for item in module.body
        if isinstance(item, (ast.ClassDef, ast.FunctionDef)) and not item.name.startswith('_')
    ]
    assert ast.get_docstring(module)
    assert [item.name for item in public if not ast.get_docstring(item)] == []


@pytest.mark.parametrize(
    'name', [name for name in EXPORTS if inspect.isclass(getattr(pharos, name))]
)
def test_an_exported_class_has_a_docstring_for_each_of_its_methods_and_properties(name):
    members = inspect.getmembers(
        getattr(pharos, name),
        lambda member: inspect.isfunction(member) or isinstance(member, property),
    )
    assert [
        own for own, member in members if not own.startswith('_') and not inspect.getdoc(member)
    ] == []


def test_setup_py_names_every_package(monkeypatch):
    given = {}
    monkeypatch.setattr('catkin_pkg.python_setup.generate_distutils_setup', lambda **named: named)
    monkeypatch.setattr('setuptools.setup', given.update)
    exec((ROOT.parent.parent / 'setup.py').read_text(), {})
    packages = [dotted(path) for path in ROOT.parent.rglob('__init__.py')]
    assert sorted(given['packages']) == sorted(packages)
