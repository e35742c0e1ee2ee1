"""Change the class of a running node, or the code in its files; state and connections stay."""
from __future__ import annotations

import ast
import copy
import inspect
import os
import pathlib
import sys
import traceback
from types import CodeType, MethodType

from pharos.errors import PharosError
from pharos.names import check_node_class

CHANGE_LIMIT = 0.05  # seconds: for so long at most, a change keeps all other threads from running
NO_CHANGE = 'nothing has changed'
TAKES_EFFECT = 'takes effect, functions at their next call'
VALUE_TAKES_EFFECT = 'takes effect; what was made of it stays as it was'
AT_RESTART = 'takes effect at a restart'
AT_NEXT_CALL = 'takes effect at its next call; what runs of it, or was made by it, stays as it was'
#: the flags of functions with calls that may be under way on no stack
GENERATORS = inspect.CO_GENERATOR | inspect.CO_COROUTINE | inspect.CO_ASYNC_GENERATOR
NAMED = ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef


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
    undo = []  # arguments of setattr()
    trees = [(module, _parse(module.__file__)) for module in editable_modules(node)]
    stacks = map(traceback.walk_stack, sys._current_frames().values())
    running = {'__init__', *(frame.f_code.co_name for stack in stacks for frame, _ in stack)}
    interval = sys.getswitchinterval()
    # a thread sees a half of the change only if that takes longer, reads a file, or the thread waits already
    sys.setswitchinterval(CHANGE_LIMIT)
    try:
        edits = [(module, tree, _read(module, tree, notes, undo)) for module, tree in trees]
        for module, tree, changes in edits:
            module.__text__ = tree
            for line, owner, name, *rest in changes:
                effect = _change(running, owner, name, *rest)
                notes.append(f'{owner.__name__}.{name} {effect} (line {line})')
    finally:
        sys.setswitchinterval(interval)
    for failure in node._current_run.failures:
        if isinstance(failure.block, str) and not isinstance(failure.error, PharosError):
            notes.append(
                f'{failure.block} has ended: {failure.error!r}; restart {node._settings.name}'
            )
    return '\n'.join(notes) or NO_CHANGE


def _parse(file):
    """Return the statements of a file, as ast.parse() does.

    :raises PharosError: if the text is not valid
    """
    try:
        return ast.parse(pathlib.Path(file).read_bytes(), file)
    except (SyntaxError, ValueError) as error:
        raise _failure(file, getattr(error, 'lineno', 1), error) from error


def _failure(file, line, error):
    text = ''.join(traceback.format_exception_only(type(error), error)).strip()
    return PharosError(f'{file}:{line}: {text}; no function, class or value has changed')


def _read(module, tree, notes, undo):
    """Run the definitions of a module that are new; add to the notes the lines of other statements.

    The module gets new values at once, and the names that it lacks, since other definitions may use
    them. If a later one raises an exception, the former values come back.

    :param tree: the statements of the module's file; gets those that have gone, and stay in force
    :param undo: gets the former values, as arguments of setattr()
    :returns: the changes: a line, and arguments of _change()
    :raises PharosError: if a definition raises an exception
    """
    file = module.__file__
    changes, line = [], 1
    former_tree = module.__text__  # of the first reload: the bytes that remember_text() has kept
    if isinstance(former_tree, bytes):
        former_tree = ast.parse(former_tree)
    classes = {item.name: item for item in former_tree.body if isinstance(item, ast.ClassDef)}
    try:
        for item in _new_items(former_tree, tree):
            line = item.lineno
            is_new = _names(item) and vars(module).keys().isdisjoint(_names(item))
            if not (_is_definition(item) or is_new):
                notes.append(f'{file}:{line}: {AT_RESTART}')
                continue
            former_class = isinstance(item, ast.ClassDef) and classes.get(item.name)
            decorators = getattr(item, 'decorator_list', [])
            if former_class:
                if _header(item) != _header(former_class):
                    notes.append(
                        f'{file}:{line}: with its decorators and base classes {AT_RESTART}'
                    )
                item.decorator_list = []
            owner, found = module, _run(item, module)
            lines = dict.fromkeys(found, line)
            former_scope, new_scope = former_tree, tree
            if former_class:
                # the whole body has run, since its statements need each other; the new ones take effect
                item.decorator_list = decorators
                owner, found = vars(module)[item.name], dict(vars(found[item.name]))
                former_scope, new_scope = former_class, item
                _bind(found.values(), owner)
                new_items = _new_items(former_class, item)
                lines = {name: each.lineno for each in new_items for name in _names(each)}
                others = [each.lineno for each in new_items if not _names(each)]
                notes += [f'{file}:{number}: {AT_RESTART}' for number in others]
                notes += _keep(former_class, item, file)
            former_decorators, new_decorators = map(_decorators, (former_scope, new_scope))
            for name in [name for name in lines if name in found]:
                former_text = former_decorators.get(name)
                if former_text and former_text != new_decorators.get(name):
                    notes.append(f'{owner.__name__}.{name} {AT_RESTART} (line {lines[name]})')
                elif found[name] is not vars(owner).get(name):
                    _set_value(owner, name, found[name], undo)
                    changes.append((lines[name], owner, name, found[name], hasattr(item, 'names')))
        changes += _copies(module, tree, undo)
    except (Exception, SystemExit) as error:  # an imported program may end itself
        for former in reversed(undo):
            setattr(*former)
        raise _failure(file, line, error) from error
    notes += _keep(former_tree, tree, file)
    return changes


def _run(item, module):
    """Run a statement in a module, and return the names that it defines, with their values."""
    found = {}
    code = compile(ast.Module([item], []), module.__file__, 'exec', 0, True)
    exec(code, vars(module), found)
    found.pop('__annotations__', None)
    return found


def _bind(values, owner):
    """Have super() in the methods of an edited class find the class that was there.

    All methods of a class share the cell in which it looks.
    """
    for value in values:
        method = getattr(value, 'fget', getattr(value, '__func__', value))
        function = inspect.unwrap(method) if callable(method) else None
        names = getattr(getattr(function, '__code__', None), 'co_freevars', ())
        if '__class__' in names:
            function.__closure__[names.index('__class__')].cell_contents = owner


def _decorators(tree):
    """Return the decorators of the functions of a module or class: the name of each, and their text."""
    kinds = ast.FunctionDef, ast.AsyncFunctionDef
    functions = [item for item in tree.body if isinstance(item, kinds)]
    return {item.name: ''.join(map(ast.dump, item.decorator_list)) for item in functions}


def _set_value(owner, name, new, undo):
    """Give a module or class a new value, or a name that it lacks; functions change later."""
    former = vars(owner).get(name)
    if _is_field(owner, name):
        return
    if name not in vars(owner):
        setattr(owner, name, new)
    elif not (callable(former) or callable(new)):
        undo.append((owner, name, former))
        setattr(owner, name, new)


def _copies(module, tree, undo):
    """Give a module what is new in those that it imports from, and return these changes."""
    former_values = [former for _, _, former in undo]
    changes = []
    for item in [item for item in tree.body if isinstance(item, ast.ImportFrom)]:
        if former_values or _names(item) == ['*']:
            for name, new in _run(item, module).items():
                former = vars(module).get(name)
                is_changed = new is not former and any(former is each for each in former_values)
                if is_changed or name not in vars(module):  # an import of * has a new name
                    _set_value(module, name, new, undo)
                    changes.append((item.lineno, module, name, new, True))
    return changes


def _new_items(former_tree, tree):
    """Return the statements that are new, and those that are now the last to define their name."""
    known = [*map(ast.dump, former_tree.body)]
    former_texts = {name: ast.dump(item) for item in former_tree.body for name in _names(item)}
    last_items = {name: item for item in tree.body for name in _names(item)}
    return [
        item
        for item in tree.body
        if ast.dump(item) not in known
        or any(
            last_items[name] is item and former_texts[name] != ast.dump(item)
            for name in _names(item)
        )
    ]


def _keep(former_tree, tree, file):
    """Add the definitions to a tree that are in force, though they have gone; return new lines on them."""
    names = {name for item in tree.body for name in _names(item)}
    gone = [item for item in former_tree.body if _names(item) and names.isdisjoint(_names(item))]
    new_names = [name for item in gone for name in _names(item) if not hasattr(item, 'has_gone')]
    for item in map(copy.copy, gone):  # the former tree stays, if the edit of another module fails
        item.has_gone = True  # type: ignore[attr-defined]
        tree.body.append(item)
    return [f'{file}: {name} has gone; it stays in force until a restart' for name in new_names]


def _names(item):
    """Return the names that a definition gives values; none of another statement."""
    if isinstance(item, (ast.Import, ast.ImportFrom)):
        return [alias.asname or alias.name for alias in item.names]
    if isinstance(item, (ast.Assign, ast.AnnAssign)):
        targets = item.targets if isinstance(item, ast.Assign) else [item.target]
        return [target.id for target in targets if isinstance(target, ast.Name)]
    return [item.name] if isinstance(item, NAMED) else []


def _header(item):
    """Return the decorators and base classes of a class, and its other arguments."""
    return [*map(ast.dump, [*item.decorator_list, *item.bases, *item.keywords])]


def _is_definition(item):
    """True for functions, classes, imports, and a name with a value that calls nothing."""
    if not isinstance(item, (ast.Assign, ast.AnnAssign)):
        return isinstance(item, (*NAMED, ast.Import, ast.ImportFrom))
    return bool(_names(item)) and 'Call(' not in ast.dump(item)


def _is_field(owner, name):
    """True for what a class has been made of: members of an Enum or a dataclass, and slots."""
    is_enum = type(owner).__module__ == 'enum'
    return is_enum or name in ('__slots__', *getattr(owner, '__dataclass_fields__', ()))


def _change(running, owner, name, new, is_import):
    """Change a name of a module or class, functions in place; return what to say of that."""
    former = vars(owner).get(name)
    if new is former and not callable(new):
        return VALUE_TAKES_EFFECT
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
            if hasattr(former, 'cache_clear'):
                former.cache_clear()
            # functions inside of it, and calls that are under way: of generators, too
            is_maker = any(isinstance(each, CodeType) for each in code.co_consts)
            if is_maker or name in running or code.co_flags & GENERATORS:
                return AT_NEXT_CALL
            return TAKES_EFFECT
        # super() needs the class
        is_bound = new_code and (code or '__class__' in new_code.co_freevars)
        # a class in a class; reload() changes the members of those of a module one by one
        if is_bound or isinstance(former, type) or _is_field(owner, name):
            return AT_RESTART
    setattr(owner, name, new)
    return TAKES_EFFECT
