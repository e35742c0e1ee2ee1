"""The shape of the code, as doc/architecture.md has it.

What does not hold yet is in structure_exceptions.txt, whose lines may only become fewer: a line that
is needed no longer fails here, too, and ``test/test_structure.py`` as a program removes such lines.
"""
import ast
import inspect
import os
import pathlib
import re
import subprocess
import sys
from types import SimpleNamespace

import pharos
import structure

ROOT = pathlib.Path(__file__).resolve().parent.parent
PACKAGE = ROOT / 'src' / 'pharos'
EXCEPTIONS = pathlib.Path(__file__).with_name('structure_exceptions.txt')
PATH = {**os.environ, 'PYTHONPATH': str(ROOT / 'src')}
MODULES = structure.modules()

LINES = 400  # of a module
FUNCTION_LINES = 59  # of a function, without its docstring
COMPLEXITY = 11  # of a function

#: room -> the rooms that it may import from, as doc/architecture.md draws the arrows. The transport
#: copies messages, and what classes their fields are of only messages/ knows.
ARROWS = {
    'above': {'facade', 'messages'},
    'facade': {'messages', 'private_rospy', 'intraprocess'},
    'private_rospy': {'intraprocess'},
    'intraprocess': {'messages'},
    'messages': set(),
}
BELOW = {'private_rospy', 'intraprocess', 'messages'}
#: the underscored names that ROS's own classes have for others: those of messages, services, and of
#: rospy's and rosgraph's modules, which private_rospy alone touches
ROS_NAMES = {
    *('_type', '_md5sum', '_connection_header', '_request_class', '_response_class'),
    *('_slot_types', '_full_text', '_has_header', '_buff'),
}
ROSPYS_NAMES = {
    *(
        '_base_logger',
        '_in_shutdown',
        '_is_owned',
        '_ros_signal',
        '_shutdown_flag',
        '_client_shutdown_hooks',
        '_shutdown_hooks',
        '_shutdown_lock',
        '_TopicImpl',
    ),
    *('_handlerList', '_handlers', '_marshaled_dispatch', '_tcp_server_callback', '_shutdown'),
    *('_xmlrpc_cache', '_init_node_args', '_preshutdown_hooks', '_signalChain'),
}
ROSPYS_INSIDE = re.compile(
    r'rospy\.impl|rospy\.(core|topics|names)\._|_topic_manager|protocol_handlers'
)

EXPORTS = """
    Master Node BlockNode ScriptNode Lifecycle ExternalNode Topic InputChannel OutputChannel Service
    Parameter Transcript RosProcess Composition Graph Failure message_class
    service_class define_message define_service spin __version__
    PharosError MasterUnreachableError NodeNameInUseError PortInUseError UnknownNodeError UnknownTopicError
    UnknownTypeError MessageTypeError UnknownServiceError ServiceTypeError ServiceCallError NodeStoppedError
""".split()

#: what is loaded only when it is used: modules of this package, and libraries
ON_DEMAND = (
    *('pharos.compose', 'pharos.live', 'pharos.messages.numeric_field', 'pharos.probe'),
    *('pharos.testing', 'IPython', 'PIL', 'jedi', 'matplotlib', 'prompt_toolkit', 'pytest'),
    *('pharos.mypy_plugin', 'pharos.new_package', 'mypy', 'rich'),
)

# -- what the source breaks of the rules; each culprit is a line of text, without numbers of lines


def wrong_arrows():
    """Imports from one room into another against the arrows; also within functions, and for type
    checkers alone, but for the facade's of what it loads on demand. What itself imports nothing of
    the facade, such as the errors, all may use."""
    graph = structure.import_graph(with_types=True)
    at_run_time = structure.import_graph(with_types=False)
    rooms = {module.name: module.room for module in MODULES}
    for name, imported in graph.items():
        for other in imported:
            allowed = {rooms[name], *ARROWS[rooms[name]]}
            if rooms[name] == structure.FACADE and other not in at_run_time[name]:
                allowed.add(structure.ABOVE)
            imports_facade = any(rooms[third] == structure.FACADE for third in graph[other])
            if rooms[other] not in allowed and (rooms[other] in BELOW or imports_facade):
                yield f'{name} imports {other}'


def cycles():
    """Modules that import each other, also within functions, and what imports these."""
    graph = structure.import_graph(with_types=False)
    while graph:  # take away what imports nothing that is left; a cycle stays
        ends = {name for name, imported in graph.items() if not imported}
        if not ends:
            break
        graph = {name: imported - ends for name, imported in graph.items() if name not in ends}
    for name, imported in graph.items():
        yield f'{name} is in a cycle of imports, or above one, with {", ".join(sorted(imported))}'


def imports_within_functions():
    """Imports of this package that stand in functions, where they are overlooked."""
    for module in MODULES:
        for name, function in structure.functions(module.tree):
            if structure.imports(module._replace(tree=function), with_types=False):
                yield f'{module.name} {name}() imports in its body'


def nodes_known_below():
    """Names below the facade that speak of a channel, which is the facade's."""
    for module in MODULES:
        names = (
            getattr(node, attribute, None)
            for node in ast.walk(module.tree)
            for attribute in ('id', 'attr', 'arg')
        )
        if module.room in BELOW and {'channel', 'channels'} & set(names):
            yield f'{module.name} knows a channel'


def private_names_of_others():
    """Underscored names of other modules' that a module uses."""
    for module in MODULES:
        allowed = ROS_NAMES | (ROSPYS_NAMES if module.room == 'private_rospy' else set())
        for name in structure.others_private_names(module):
            if name not in allowed:
                yield f'{module.name} uses {name}'


def rospys_inside():
    """Modules that touch rospy's inside, and are not of private_rospy; or that import rospy
    themselves, which leaves a mark on the host's logging that process_rospy takes away again."""
    for module in MODULES:
        text = module.path.read_text()
        if module.room != 'private_rospy' and ROSPYS_INSIDE.search(text):
            yield f"{module.name} touches rospy's inside"
        imports_rospy = re.search(r'^\s*import rospy$|^\s*from rospy import', text, re.MULTILINE)
        if imports_rospy and module.name != 'pharos.private_rospy.process_rospy':
            yield f'{module.name} imports rospy'


def too_large():
    """Modules and functions that are too long, or too branched."""
    for module in MODULES:
        if len(module.path.read_text().splitlines()) > LINES:
            yield f'{module.name} has more than {LINES} lines'
        for name, function in structure.functions(module.tree):
            if structure.length(function) > FUNCTION_LINES:
                yield f'{module.name} {name}() has more than {FUNCTION_LINES} lines'
            if structure.complexity(function) > COMPLEXITY:
                yield f'{module.name} {name}() has a complexity of more than {COMPLEXITY}'


def undocumented():
    """Modules, and public functions and classes in them, without a docstring."""
    for module in MODULES:
        if not ast.get_docstring(module.tree):
            yield f'{module.name} has no docstring'
        for item in module.tree.body:
            if isinstance(item, (ast.ClassDef, ast.FunctionDef)) and not item.name.startswith('_'):
                if not ast.get_docstring(item):
                    yield f'{module.name} {item.name} has no docstring'


RULES = (
    wrong_arrows,
    cycles,
    imports_within_functions,
    nodes_known_below,
    private_names_of_others,
    rospys_inside,
    too_large,
    undocumented,
)


def exceptions():
    """What is known to break the rules."""
    lines = EXCEPTIONS.read_text().splitlines()
    return {line for line in lines if line and not line.startswith('#')}


def check(rule):
    """Assert that nothing breaks the rule but what is known to."""
    assert sorted({*rule()} - exceptions()) == [], rule.__doc__


def test_imports_go_along_the_arrows():
    check(wrong_arrows)


def test_no_modules_import_each_other():
    graph = structure.import_graph(with_types=False)
    assert all(graph[name] for name in ('pharos', 'pharos.node', 'pharos.master'))  # it finds them
    check(cycles)


def test_imports_stand_at_the_top():
    check(imports_within_functions)


def test_the_rooms_below_the_facade_know_no_channel():
    check(nodes_known_below)


def test_no_module_uses_anothers_private_names():
    check(private_names_of_others)


def test_only_private_rospy_touches_rospys_inside():
    check(rospys_inside)


def test_modules_and_functions_fit_on_a_screen_or_a_few():
    check(too_large)


def test_modules_and_what_is_public_in_them_have_a_docstring():
    check(undocumented)


def test_every_exception_is_needed():
    unneeded = exceptions() - {culprit for rule in RULES for culprit in rule()}
    assert sorted(unneeded) == [], 'run PYTHONPATH=src python3 test/test_structure.py'


def test_the_exports_are_those_of_the_contract():
    assert sorted(pharos.__all__) == sorted(EXPORTS)
    assert [name for name in EXPORTS if not hasattr(pharos, name)] == []


def test_a_star_import_gives_the_exports():
    names = {}
    exec('from pharos import *', names)
    assert set(names) - {'__builtins__'} == set(EXPORTS)


def test_the_table_of_contents_is_imports_and_all():
    source = (PACKAGE / '__init__.py').read_bytes()
    assert source.isascii()
    assert b'__file__' not in source
    docstring, *statements = ast.parse(source).body
    assert isinstance(docstring, ast.Expr)
    assigned = [
        statement.targets[0].id for statement in statements if isinstance(statement, ast.Assign)
    ]
    assert assigned == ['__version__', '__all__']
    for_types = [each for each in statements if isinstance(each, ast.If)]
    assert [ast.unparse(each.test) for each in for_types] == ['TYPE_CHECKING']
    kinds = {type(statement) for statement in statements}
    assert kinds - {ast.If} == {ast.Assign, ast.ImportFrom}


def test_what_is_loaded_on_demand_is_not_loaded_before():
    source = 'import sys, pharos; print(*dir(pharos)); print(*sys.modules)'
    printed = subprocess.check_output([sys.executable, '-c', source], env=PATH, text=True)
    names, modules = (line.split() for line in printed.splitlines())
    assert {'Composition', 'Graph', 'ScriptNode'} <= {*names}
    assert [name for name in modules if name.startswith(ON_DEMAND)] == []


def test_the_facade_loads_modules_by_on_demand_alone():
    loading = [
        module.name
        for module in MODULES
        if module.room == structure.FACADE and 'import_module(' in module.path.read_text()
    ]
    assert loading == ['pharos.on_demand']


def programs():
    """What rosrun runs."""
    scripts = [path for path in (ROOT / 'scripts').iterdir() if path.is_file()]
    return [*scripts, *(ROOT / 'examples').glob('*.py')]


def test_rosrun_finds_each_script_once():
    """In a devel space it looks through the whole source, and asks which one is meant."""
    names = {path.name for path in programs()}
    found = subprocess.run(
        [
            'find',
            ROOT,
            '-path',
            ROOT / 'build',
            '-prune',
            '-o',
            '-type',
            'f',
            '-perm',
            '/111',
            '-print',
        ],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    ).stdout.splitlines()
    paths = [path for path in map(pathlib.Path, found) if path.name in names]
    assert sorted(paths) == sorted(programs())


def test_scripts_are_run_by_debians_python():
    for path in programs():
        assert path.read_text().startswith('#!/usr/bin/python3\n'), path
        assert path.stat().st_mode & 0o111 == 0o111, path


def test_the_methods_and_properties_of_exported_classes_have_docstrings():
    undocumented = [
        f'{name}.{own}'
        for name in EXPORTS
        for own, member in inspect.getmembers(getattr(pharos, name))
        if inspect.isclass(getattr(pharos, name))
        and (inspect.isfunction(member) or isinstance(member, property))
        and not own.startswith('_')
        and not inspect.getdoc(member)
    ]
    assert undocumented == []


def test_setup_py_names_every_package(monkeypatch):
    given = {}
    monkeypatch.setattr('catkin_pkg.python_setup.generate_distutils_setup', lambda **named: named)
    # not setuptools itself, which cannot be imported once distutils have been
    monkeypatch.setitem(sys.modules, 'setuptools', SimpleNamespace(setup=given.update))
    exec((ROOT / 'setup.py').read_text(), {})
    packages = [module.name for module in MODULES if module.path.name == '__init__.py']
    assert sorted(given['packages']) == packages


def test_the_picture_of_the_architecture_is_current():
    tool = ROOT / 'tools' / 'architecture'
    ended = subprocess.run([sys.executable, tool, '--check'], check=False)
    assert ended.returncode == 0, 'run tools/architecture'


if __name__ == '__main__':
    needed = {culprit for rule in RULES for culprit in rule()}
    lines = EXCEPTIONS.read_text().splitlines(keepends=True)
    kept = [line for line in lines if line.startswith('#') or line.strip() in needed]
    EXCEPTIONS.write_text(''.join(kept))
