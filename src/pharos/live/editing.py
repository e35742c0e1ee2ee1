"""Change the class of a running node, or the code in its files; state and connections stay."""
from __future__ import annotations

import ast
import inspect
import os
import pathlib
import sys
import traceback
from types import MethodType

from pharos.errors import PharosError
from pharos.names import check_node_class

CHANGE_LIMIT = 0.05  # seconds: for so long at most, a change keeps all other threads from running
NO_CHANGE = 'nothing has changed'
TAKES_EFFECT = 'takes effect, functions at their next call'
AT_RESTART = 'takes effect at a restart'


def become(node, node_class, base):
    """Do the work of :meth:`Node.become`."""
    check_node_class(node_class, base)
    run = node._current_run

    def rebound(block):
        """Return the block or blocks, with methods of the node taken from the new class."""
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
    """Return the modules of a node that remember_text() gave a ``__text__``, the imported ones first."""
    modules = [sys.modules.get(type(node).__module__), *node._current_run.modules.by_name.values()]
    return [
        module
        for module in reversed(modules)
        if hasattr(module, '__text__') and os.path.exists(module.__file__)
    ]


def reload(node):
    """Do the work of :meth:`Node.reload`."""
    notes = []
    edits = [(module, *_read(module, notes)) for module in editable_modules(node)]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(CHANGE_LIMIT)  # no thread shall see a half of the change
    try:
        for module, text, changes in edits:
            module.__text__ = text
            for owner, name, *rest in changes:
                notes.append(f'{owner.__name__}.{name} {_change(owner, name, *rest)}')
    finally:
        sys.setswitchinterval(interval)
    for failure in node._current_run.failures:
        if isinstance(failure.block, str) and not isinstance(failure.error, PharosError):
            notes.append(f'{failure.block} has ended: {failure.error!r}; restart {node.name}')
    return '\n'.join(notes) or NO_CHANGE


def _read(module, notes):
    """Run the definitions in a module's file that are new; add to the notes the lines of other statements.

    Names that the module has keep their values. It gets those that it lacks, since other definitions
    may use them; they stay if a later one raises an exception.

    :returns: the text of the file, and the changes: arguments of _change()
    :raises PharosError: if the text is not valid, or a definition raises an exception
    """
    file = module.__file__
    changes, line = [], 1

    def code_of(item):
        return compile(ast.Module([item], []), file, 'exec', 0, True)

    try:
        text = pathlib.Path(file).read_bytes()
        former_items = ast.parse(module.__text__).body
        bodies = {item.name: item.body for item in former_items if isinstance(item, ast.ClassDef)}
        for item in _new_items(former_items, ast.parse(text, file).body):
            line = item.lineno
            former_body = bodies.get(getattr(item, 'name', ''))  # of a class that is there
            new_body = former_body and _new_items(former_body, item.body)
            if new_body == [] or not _is_definition(item):
                notes.append(f'{file}:{line}: {AT_RESTART}')
                continue
            owner, found = module, {}
            if new_body:
                item.decorator_list = []
            exec(code_of(item), vars(module), found)
            for name, new in found.items():
                vars(module).setdefault(name, new)
            if new_body:
                # the whole body has run, since its statements need each other; the new ones take effect
                owner = vars(module)[item.name]
                item.body = new_body
                names = code_of(item).co_consts[0].co_names
                found = {
                    name: new
                    for name, new in vars(found[item.name]).items()
                    if name in names and (callable(new) or not name.startswith('__'))
                }
            changes += [(owner, *each, hasattr(item, 'names')) for each in found.items()]
    except Exception as error:
        error_text = ''.join(traceback.format_exception_only(type(error), error)).strip()
        raise PharosError(
            f'{file}:{getattr(error, "lineno", line)}: {error_text}; {NO_CHANGE}'
        ) from error
    return text, changes


def _new_items(former_items, items):
    """Return the statements that the former ones lack."""
    former_dumps = [*map(ast.dump, former_items)]
    return [item for item in items if ast.dump(item) not in former_dumps]


def _is_definition(item):
    """True for functions, classes, imports, and a name with a value that calls nothing."""
    if not isinstance(item, ast.Assign):
        return isinstance(item, (ast.FunctionDef, ast.ClassDef, ast.Import, ast.ImportFrom))
    return isinstance(item.targets[0], ast.Name) and 'Call(' not in ast.dump(item)


def _change(owner, name, new, is_import):
    """Change a name of a module or class, functions in place; return what to say of that."""
    former = vars(owner).get(name)
    if not (is_import or new is former):
        # the functions inside of decorators, staticmethods and classmethods
        function, new_function = (
            inspect.unwrap(getattr(value, '__func__', value)) for value in (former, new)
        )
        code, new_code = (getattr(each, '__code__', None) for each in (function, new_function))
        if (
            code
            and new_code
            and (function is former) is (new_function is new)  # both have a decorator, or none has
            and code.co_freevars == new_code.co_freevars in ((), ('__class__',))
        ):
            for part in '__code__', '__defaults__', '__kwdefaults__':
                setattr(function, part, getattr(new_function, part))
            return TAKES_EFFECT
        # super() needs the class
        is_bound = new_code and (code or '__class__' in new_code.co_freevars)
        # members of an Enum would not equal the former ones
        if is_bound or isinstance(former, type) or type(owner).__module__ == 'enum':
            return AT_RESTART
    setattr(owner, name, new)
    return TAKES_EFFECT
