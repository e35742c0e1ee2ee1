"""What the source says of its own structure: who imports whom, who uses whose names, how long and
how branched things are. Read by test_structure.py and by tools/architecture."""
import ast
import functools
import pathlib
from typing import Dict, Iterator, List, NamedTuple, Set, Tuple, Union

SOURCE = pathlib.Path(__file__).resolve().parent.parent / 'src'
FACADE = 'facade'
ABOVE = 'above'  # what is built on the facade
ROOMS = {
    'pharos.messages': 'messages',
    'pharos.intraprocess': 'intraprocess',
    'pharos.private_rospy': 'private_rospy',
    'pharos.__main__': ABOVE,
    'pharos.commands': ABOVE,
    'pharos.compose': ABOVE,
    'pharos.live': ABOVE,
    'pharos.new_package': ABOVE,
    'pharos.testing': ABOVE,
    'pharos_turtle': ABOVE,
}
Function = Union[ast.FunctionDef, ast.AsyncFunctionDef]
BRANCHES = ast.If, ast.For, ast.While, ast.ExceptHandler, ast.comprehension


class Module(NamedTuple):
    """A module of the source."""

    name: str
    path: pathlib.Path
    tree: ast.AST

    @property
    def room(self) -> str:
        """The room that it is in."""
        for package, room in ROOMS.items():
            if self.name == package or self.name.startswith(package + '.'):
                return room
        return FACADE


@functools.lru_cache()
def modules() -> List[Module]:
    """All of them, by their names."""
    found = []
    for path in SOURCE.rglob('*.py'):
        parts = path.relative_to(SOURCE).with_suffix('').parts
        name = '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)
        found.append(Module(name, path, ast.parse(path.read_text())))
    return sorted(found)


def _is_for_types(node: ast.AST) -> bool:
    """Whether it is an ``if TYPE_CHECKING:``, whose imports are run by type checkers alone."""
    return isinstance(node, ast.If) and ast.unparse(node.test).endswith('TYPE_CHECKING')


def _walk(tree: ast.AST, with_types: bool) -> Iterator[ast.AST]:
    yield tree
    for child in ast.iter_child_nodes(tree):
        if with_types or not _is_for_types(child):
            yield from _walk(child, with_types)


def imports(module: Module, with_types: bool) -> Set[str]:
    """The modules of this source that it imports, also within its functions.

    :param with_types: those imported for type checkers alone, too
    """
    known, found = {other.name for other in modules()}, set()
    for node in _walk(module.tree, with_types):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names} & known
        elif isinstance(node, ast.ImportFrom):
            whole = {f'{node.module}.{alias.name}' for alias in node.names}
            found |= whole & known or {str(node.module)} & known
    return found - {module.name}


def import_graph(with_types: bool) -> Dict[str, Set[str]]:
    """Module -> the modules that it imports."""
    return {module.name: imports(module, with_types) for module in modules()}


def others_private_names(module: Module) -> Iterator[str]:
    """Each underscored name that it takes from elsewhere: imported, or as an attribute that neither
    the module nor self or cls in it defines."""
    own = {
        node.attr
        for node in ast.walk(module.tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id in ('self', 'cls')
    }
    for node in ast.walk(module.tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            own.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            own.add(node.id)
    for node in ast.walk(module.tree):
        if isinstance(node, ast.ImportFrom):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.Attribute) and node.attr not in own:
            names = [node.attr]
        else:
            continue
        for name in names:
            if name.startswith('_') and not name.endswith('__'):
                yield name


def functions(tree: ast.AST, prefix: str = '') -> Iterator[Tuple[str, Function]]:
    """``(qualified name, function)`` of all functions and methods, also those within others."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield prefix + node.name, node
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            yield from functions(node, f'{prefix}{node.name}.')
        else:
            yield from functions(node, prefix)


def length(function: Function) -> int:
    """The lines of a function, without its docstring."""
    lines = int(function.end_lineno or 0) - function.lineno + 1
    if ast.get_docstring(function):
        docstring = function.body[0]
        lines -= int(docstring.end_lineno or 0) - docstring.lineno + 1
    return lines


def complexity(function: Function) -> int:
    """How many ways there are through a function, as flake8's mccabe counts: one, and one for each
    branch, also of the functions within it."""
    branches = [node for node in ast.walk(function) if isinstance(node, BRANCHES)]
    return len(branches) + 1
