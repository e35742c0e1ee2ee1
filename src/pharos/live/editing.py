"""Change the class of a running node, or the code in its files; state and connections stay."""
from __future__ import annotations

import ast
import enum
import inspect
import pathlib
import sys
import traceback
from types import FunctionType, MethodType

from pharos.errors import PharosError
from pharos.names import check_node_class

CHANGE_LIMIT = 0.05  # seconds that no other thread runs at most, while a change is made
DEFINITIONS = ast.FunctionDef, ast.ClassDef, ast.Import, ast.ImportFrom


def become(node, node_class, base):
    """Do the work of :meth:`Node.become`."""
    check_node_class(node_class, base)
    run = node._current_run

    def change():
        receivers = [node, *run.endpoints]
        # find all blocks before the first change: the new class may lack one
        soul = _rebind(node.soul, node, node_class)
        delegates = [_rebind(receiver.delegate, node, node_class) for receiver in receivers]
        node.__class__ = node_class
        node.soul = soul
        for receiver, delegate in zip(receivers, delegates):
            receiver.delegate = delegate

    run.callback_queue.run_exclusively(change)


def _rebind(block, node, node_class):
    """Return a block; a method of the node is replaced by the method of that name in a class.

    :param block: a block, None, or a list of blocks, which gives a list
    :raises AttributeError: if the class lacks the method
    """
    if isinstance(block, list):
        return [_rebind(item, node, node_class) for item in block]
    if getattr(block, '__self__', None) is not node:
        return block
    return MethodType(getattr(node_class, block.__name__), node)


def reload(node):
    """Do the work of :meth:`Node.reload`."""
    modules = [sys.modules.get(type(node).__module__), *node._current_run.modules.by_name.values()]
    notes = []
    edits = [
        (module, *_read(module, notes))
        for module in modules
        if '__text__' in getattr(module, '__dict__', ())
    ]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(CHANGE_LIMIT)  # no thread shall see a half of the change
    for module, text, values in edits:
        module.__text__ = text
        for name, value in values.items():
            notes.append(f'{name} is new')
            _change(module, name, value, notes)
    sys.setswitchinterval(interval)
    return '\n'.join(notes) or 'nothing has changed'


def _read(module, notes):
    """Run the definitions in a module's file that are new; the module stays as it is.

    Add to the notes the places of other statements that are new.

    :returns: the text of the file, and ``{name: value}``
    :raises PharosError: if the text is not valid, or a definition raises an exception
    """
    file = module.__file__
    text = pathlib.Path(file).read_bytes()
    former_items = [*map(ast.dump, ast.parse(module.__text__).body)]
    values, line = {}, 1
    try:
        for item in ast.parse(text).body:
            line = item.lineno
            if ast.dump(item) in former_items:
                continue
            if _is_definition(item):
                exec(compile(ast.Module([item], []), file, 'exec'), vars(module), values)
            else:
                notes.append(f'{file}:{line}: takes effect at a restart')
    except Exception as error:
        raise PharosError(
            f'{file}:{getattr(error, "lineno", line)}: {error!r}; nothing has changed'
        ) from error
    return text, values


def _is_definition(item):
    """True for functions, classes, imports, and names with literal values."""
    try:
        return isinstance(item, DEFINITIONS) or bool([ast.literal_eval(item.value)])
    except (AttributeError, ValueError):  # another statement, or another value
        return False


def _change(owner, name, new, notes):
    """Change a name of a module or class, functions and classes in place; add to the notes."""
    former = vars(owner).get(name)
    if isinstance(former, enum.EnumMeta):  # its former members would not equal the new ones
        notes.append(f'{name} takes effect at a restart')
        return
    if isinstance(former, type) and isinstance(new, type):
        for member, value in vars(new).items():
            # slots, and __dict__: they read objects of their own class alone
            if not (inspect.ismemberdescriptor(value) or inspect.isgetsetdescriptor(value)):
                _change(former, member, value, notes)
        return
    # those in decorators, staticmethods and classmethods
    function, new_function = (
        inspect.unwrap(getattr(value, '__func__', value)) for value in (former, new)
    )
    if isinstance(function, FunctionType) and isinstance(new_function, FunctionType):
        code, new_code = function.__code__, new_function.__code__
        if code.co_freevars == new_code.co_freevars in ((), ('__class__',)):
            if code.co_code != new_code.co_code and _runs(code):
                notes.append(f'{name}() takes effect when it is called again, or at a restart')
            for part in '__code__', '__defaults__', '__kwdefaults__':
                setattr(function, part, getattr(new_function, part))
            return
        notes.append(f'{name}: what holds the former function keeps it until a restart')
        if '__class__' in new_code.co_freevars:
            return  # its super() would not find the former class
    setattr(owner, name, new)


def _runs(code):
    """True if a thread runs that code."""
    return any(
        each.f_code is code
        for frame in sys._current_frames().values()
        for each, _ in traceback.walk_stack(frame)
    )
