"""The functions of rospy that are patched, and the host's own rospy, which is not."""
import ast
import hashlib
import json
import pathlib
import subprocess
import sys
import tokenize

import pytest
import rospy

from helpers import PYTHON, Program

KNOWN = pathlib.Path(__file__).with_name('patched_sources.txt')
DEBIAN = pathlib.Path(rospy.__file__).parent.parent


def patched():
    """``[(module, target)]``: all that is known here of the table of patches."""
    from pharos.private_rospy.patches import TABLE

    return [(module, target) for module in TABLE if 'ros' in module for target, _ in TABLE[module]]


def fingerprint(module, target):
    """The hash of a target's source, without comments, docstrings and layout; or 'elsewhere'.

    Of a variable of the module: of the functions that use it.
    """
    path = DEBIAN.joinpath(*module.split('.'))
    path = path / '__init__.py' if path.is_dir() else path.with_suffix('.py')
    tree = ast.parse(path.read_text())
    found = definition(tree, tree, target.split('.'))
    nodes = [found] if found else users(tree, target)
    text = ''.join(f'{word}\n' for node in nodes for word in words(path, node))
    return hashlib.sha256(text.encode()).hexdigest()[:8] if nodes else 'elsewhere'


def definition(tree, scope, path):
    """The definition in a module or class, or in a base of that class."""
    for node in scope.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and node.name == path[0]:
            return definition(tree, node, path[1:]) if path[1:] else node
    bases = [base.id for base in getattr(scope, 'bases', ()) if isinstance(base, ast.Name)]
    inherited = (definition(tree, tree, [base]) for base in bases)
    return next((definition(tree, base, path) for base in inherited if base), None)


def users(tree, name):
    """The functions of a module that use a name."""
    uses = {node for node in ast.walk(tree) if isinstance(node, ast.Name) and node.id == name}
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    return [function for function in functions if uses & {*ast.walk(function)}]


def words(path, node):
    """The tokens of a definition, decorators included."""
    first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
    docstrings = {
        (part.body[0].lineno, part.body[0].col_offset)
        for part in ast.walk(node)
        if isinstance(part, (ast.FunctionDef, ast.ClassDef)) and ast.get_docstring(part)
    }
    with open(path, 'rb') as file:
        for token in tokenize.tokenize(file.readline):
            if not first <= token.start[0] <= node.end_lineno or token.start in docstrings:
                continue
            if token.type in (tokenize.INDENT, tokenize.DEDENT):
                yield tokenize.tok_name[token.type]
            elif token.type not in (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE):
                yield token.string


def known():
    """``{target: fingerprints in the known releases}``."""
    rows = [line.split() for line in KNOWN.read_text().splitlines() if line[0] != '#']
    return {target: set(fingerprints) for target, *fingerprints in rows}


def unknown():
    """The targets whose sources are in none of the known releases."""
    return [
        f'{module}.{target}'
        for module, target in patched()
        if fingerprint(module, target) not in known().get(f'{module}.{target}', ())
    ]


def test_patched_sources_are_known():
    """After a look at what changed, ``python3 test_patches.py`` notes the installed release.

    In a process of its own: Python 3.11.2 may fail to parse while another thread formats a traceback,
    which parses, too (python/cpython#106905).
    """
    command = [PYTHON, __file__, '--unknown']
    assert subprocess.check_output(command, text=True).split() == []


HOST = """
import importlib, json, logging, operator, signal, sys, threading
import rospy

TARGETS = json.loads(sys.argv[1])

def look():
    modules = [importlib.import_module(module) for module, _ in TARGETS]
    loggers = [logging.getLogger(name) for name in (None, 'rosout', 'rospy')]
    return {
        'functions': [operator.attrgetter(each[1])(of) for of, each in zip(modules, TARGETS)],
        'modules': modules,
        'logging': [(each.level, list(each.handlers), each.propagate) for each in loggers],
        'hooks': (sys.excepthook, threading.excepthook, sys.stdout, sys.stderr),
        'signals': [signal.getsignal(number) for number in signal.valid_signals()],
        'node': (rospy.get_name(), rospy.core.is_initialized(), rospy.is_shutdown()),
    }

for number in signal.SIGINT, signal.SIGTERM, signal.SIGHUP:
    signal.signal(number, lambda number, frame: None)
import pharos
before = look()
with pharos.Master().create(pharos.BlockNode, named='/node') as node:
    node.send_to('/t', typed_as='std_msgs/String', data='x')
    node.ros_import('actionlib')
print('changed', json.dumps([what for what, now in look().items() if now != before[what]]))
"""


@pytest.fixture(scope='module')
def changed(ros_master):
    """The changes that a node made to its process, in a process of its own."""
    targets = json.dumps(patched())
    with Program(HOST, ros_master.url, targets) as program:
        assert program.wait() == 0, program.output
        return json.loads(program.output.partition('changed ')[2])


def test_node_leaves_host_unchanged(changed):
    for what in 'functions modules logging hooks signals node'.split():
        assert what not in changed


if __name__ == '__main__' and sys.argv[1:] == ['--unknown']:
    print('\n'.join(unknown()))
elif __name__ == '__main__':
    notes, text = (
        known(),
        '# The sources of the targets in the known releases: 1.15.15, 1.16.0, 1.17.0, 1.17.4.\n',
    )
    for module, target in sorted(patched()):
        found = {fingerprint(module, target)} | notes.get(f'{module}.{target}', set())
        text += f'{module}.{target} {" ".join(sorted(found))}\n'
    KNOWN.write_text(text)
