"""Change the class of a running node, or the code in its files; state and connections stay."""
from __future__ import annotations

import ast
import inspect
import pathlib
import sys
from types import FunctionType, MethodType

from pharos.errors import PharosError
from pharos.names import check_node_class

CHANGE_LIMIT = 0.05  # seconds: for so long at most, a change keeps all other threads from running
DEFINITIONS = ast.FunctionDef, ast.ClassDef, ast.Import, ast.ImportFrom


def become(node, node_class, base):
    """Do the work of :meth:`Node.become`."""
    check_node_class(node_class, base)
    run = node._current_run

    def rebound(block):
        """Return a block, None or a list of blocks; a method of the node is that of the new class."""
        if isinstance(block, list):
            return [*map(rebound, block)]
        if getattr(block, '__self__', None) is not node:
            return block
        return MethodType(getattr(node_class, block.__name__), node)

    def change():
        # find all blocks before the first change: the new class may lack one
        soul = rebound(node.soul)
        delegates = {each: rebound(each.delegate) for each in (node, *run.endpoints)}
        node.__class__ = node_class
        node.soul = soul
        for receiver, delegate in delegates.items():
            receiver.delegate = delegate

    run.callback_queue.run_exclusively(change)


def editable_modules(node):
    """Return the modules of a node with a ``__text__``, by remember_text() of the loader."""
    modules = [sys.modules.get(type(node).__module__), *node._current_run.modules.by_name.values()]
    return [module for module in modules if hasattr(module, '__text__')]


def reload(node):
    """Do the work of :meth:`Node.reload`."""
    notes = []
    edits = [(module, *_read(module, notes)) for module in editable_modules(node)]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(CHANGE_LIMIT)  # no thread shall see a half of the change
    try:
        for module, text, values in edits:
            module.__text__ = text
            for name, value in values.items():
                notes.append(f'{name} takes effect, functions at their next call')
                _change(module, name, value, notes)
    finally:
        sys.setswitchinterval(interval)
    return '\n'.join(notes) or 'nothing has changed'


def _read(module, notes):
    """Run the definitions in a module's file that are new; the module stays as it is.

    Of a class that is there, run the members that are new. Add to the notes the places of other
    statements that are new.

    :returns: the text of the file, and ``{name: value}``
    :raises PharosError: if the text is not valid, or a definition raises an exception
    """
    file = module.__file__
    values, line = {}, 1
    try:
        text = pathlib.Path(file).read_bytes()
        former_items = ast.parse(module.__text__).body
        members = {item.name: item.body for item in former_items if isinstance(item, ast.ClassDef)}
        for item in _new_items(former_items, ast.parse(text).body):
            line = item.lineno
            if not _is_definition(item):
                notes.append(f'{file}:{line}: takes effect at a restart')
                continue
            if isinstance(item, ast.ClassDef) and item.name in members:
                item.body = _new_items(members[item.name], item.body) or [ast.Pass()]
                item.decorator_list = []
            code = compile(ast.fix_missing_locations(ast.Module([item], [])), file, 'exec', 0, True)
            exec(code, vars(module), values)
    except Exception as error:
        raise PharosError(
            f'{file}:{getattr(error, "lineno", line)}: {error!r}; nothing has changed'
        ) from error
    return text, values


def _new_items(former_items, items):
    """Return the statements that the former ones lack."""
    former_dumps = [*map(ast.dump, former_items)]
    return [item for item in items if ast.dump(item) not in former_dumps]


def _is_definition(item):
    """True for functions, classes, imports, and a name with a literal value."""
    if not isinstance(item, ast.Assign):
        return isinstance(item, DEFINITIONS)
    try:
        ast.literal_eval(item.value)
    except ValueError:
        return False
    return isinstance(item.targets[0], ast.Name)


def _change(owner, name, new, notes):
    """Change a name of a module or class, functions and classes in place; add to the notes."""
    former = vars(owner).get(name)
    if former is new:  # imported once more
        return
    are_classes = isinstance(former, type) and isinstance(new, type)
    is_same_class = are_classes and former.__module__ == new.__module__
    # those in decorators, staticmethods and classmethods
    function, new_function = (
        inspect.unwrap(getattr(value, '__func__', value)) for value in (former, new)
    )
    code, new_code = (getattr(each, '__code__', None) for each in (function, new_function))
    if is_same_class and type(former) is type:
        for member, value in vars(new).items():
            is_own = isinstance(value, FunctionType) or not member.startswith('__')
            if is_own and not inspect.ismemberdescriptor(value):  # a slot reads its own class alone
                _change(former, member, value, notes)
    elif (
        code
        and new_code
        and code.co_filename == new_code.co_filename  # else it is imported
        and code.co_freevars == new_code.co_freevars in ((), ('__class__',))
    ):
        for part in '__code__', '__defaults__', '__kwdefaults__':
            setattr(function, part, getattr(new_function, part))
    # members of an Enum would not equal the former ones; super() needs the class
    elif is_same_class or new_code and (code or '__class__' in new_code.co_freevars):
        notes.append(f'{name}: only at a restart')
    else:
        setattr(owner, name, new)
