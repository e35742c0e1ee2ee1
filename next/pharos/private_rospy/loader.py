"""Load rospy once more, with globals of its own: one process, many nodes.

``sys.modules`` stays untouched. Each private module has a ``__builtins__`` whose ``__import__`` finds
rospy, rosgraph and what is written on rospy in the private set, and all else as usual.
"""
from __future__ import annotations

import builtins
import functools
import importlib.util
import itertools
import logging
import pathlib
import re
import sys
import threading
import types
import weakref
from importlib.machinery import PathFinder
from typing import Any, Callable

import rospy.exceptions

SHARED = set(sys.stdlib_module_names) | {
    *('genpy', 'genmsg', 'roslib', 'rospkg', 'rosmaster', 'catkin', 'catkin_pkg', 'pharos'),
    *('numpy', 'yaml', 'matplotlib', 'cv2', 'PIL'),
}
MOST_FILES = 300  # of a package that could be written on rospy


class Shim:
    """Looks like a module, with some names of our own."""

    def __init__(self, real: Any, **own: Any):
        self.__dict__.update(own, _real=real)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)


@functools.lru_cache(None)
def _find(name: str, path: tuple[str, ...] | None) -> tuple[Any, Any]:
    spec = PathFinder.find_spec(name, path)
    if spec is None:
        raise ModuleNotFoundError(f'No module named {name!r}', name=name)
    return spec, spec.loader.get_code(name) if spec.has_location else None


@functools.lru_cache(None)
def _files_of(top: str) -> list[bytes]:
    """Return the texts of a module or package of Python, [] for a large one or one in C."""
    spec = PathFinder.find_spec(top)
    if spec is None or not str(spec.origin).endswith('.py'):
        return []
    init = pathlib.Path(spec.origin).read_bytes()
    folders = list(spec.submodule_search_locations or ())
    if b'__extended_path' in init:  # catkin's devel space leads to the source
        folders += re.findall(r'__extended_path = "([^"]*)"', init.decode())
    found = (file for folder in folders for file in pathlib.Path(folder).rglob('*.py'))
    files = [file.read_bytes() for file in itertools.islice(found, MOST_FILES + 1)]
    return [] if len(files) > MOST_FILES else [init, *files]


@functools.lru_cache(None)
def _reaches_rospy(top: str, above: tuple[str, ...] = ()) -> bool:
    """True if the code of a package says rospy, or imports a package that does."""
    if top in ('rospy', 'rosgraph'):
        return True
    if top in SHARED or top in above:
        return False
    files = _files_of(top)
    if any(b'rospy' in text for text in files):
        return True
    imports = {
        name for text in files for name in re.findall(rb'^\s*(?:from|import) (\w+)', text, re.M)
    }
    return any(_reaches_rospy(name.decode(), (*above, top)) for name in sorted(imports))


def is_private(name: str) -> bool:
    """True if each node has a copy of the module. Generated messages are shared."""
    top, *rest = name.split('.')
    is_generated = rest[:1] in (['msg'], ['srv']) and top not in ('rospy', 'rosgraph')
    return not is_generated and _reaches_rospy(top)


class PrivateModules:
    """A set of private modules.

    :param substitutes: what private modules import under some names of Python's modules
    :param patch: ``patch(module)`` is called right after the code of each private module
    """

    def __init__(self, substitutes: dict[str, Any], patch: Callable[[types.ModuleType], None]):
        # one rospy.exceptions for all, so that ``except rospy.ROSException`` catches every node's
        self.modules = {**substitutes, 'rospy.exceptions': rospy.exceptions}
        self.modules['importlib'] = Shim(importlib, import_module=self._import_module)
        self._patch, self._lock = patch, threading.RLock()
        self.builtins = {**vars(builtins), '__import__': self._import}
        self.modules['logging'] = self._private_logging()

    def load(self, name: str) -> Any:
        """Return the module of that name, as private modules import it."""
        if name not in self.modules and not is_private(name):
            return importlib.import_module(name)
        parent, _, leaf = name.rpartition('.')
        with self._lock:  # or another thread would see a module that is half loaded
            if name not in self.modules:
                path = tuple(self.load(parent).__path__) if parent else None
                if name not in self.modules:  # the parent may have imported it
                    self._execute(name, path)
            if parent in self.modules:
                setattr(self.modules[parent], leaf, self.modules[name])
            return self.modules[name]

    def _execute(self, name: str, path: tuple[str, ...] | None) -> types.ModuleType:
        spec, code = _find(name, path)
        self.modules[name] = module = importlib.util.module_from_spec(spec)
        vars(module)['__builtins__'] = self.builtins
        try:
            if code is None and spec.loader and spec.has_location:
                spec.loader.exec_module(module)
            else:
                exec(code or '', vars(module))
        except BaseException:
            del self.modules[name]
            raise
        self._patch(module)
        return module

    def _import_module(self, name: str, package: str | None = None) -> Any:
        return self.load(importlib.util.resolve_name(name, package))

    def _import(self, name, globals=None, locals=None, fromlist=(), level=0):
        full = name
        if level:
            full = importlib.util.resolve_name('.' * level + name, globals['__package__'])
        top = full.partition('.')[0]
        if full not in self.modules and not is_private(full):
            module = builtins.__import__(name, globals, locals, fromlist, level)
            return module if fromlist else self.modules.get(top, module)
        module = self.load(full)
        if not fromlist:
            return module if level else self.load(top)
        for item in fromlist if hasattr(module, '__path__') else ():
            for each in getattr(module, '__all__', ()) if item == '*' else (item,):
                if not hasattr(module, each):
                    try:
                        setattr(module, each, self.load(f'{full}.{each}'))
                    except ModuleNotFoundError:
                        pass  # the import statement itself says so
        return module

    def _private_logging(self) -> types.ModuleType:
        """Make a logging module: rospy's configuration strips the process's handlers, and its
        loggers have the same names for all nodes."""
        module = types.ModuleType('logging')
        names = {name: value for name, value in vars(logging).items() if not name.startswith('__')}
        vars(module).update(names)

        class Logger(logging.Logger):
            """One with a root and a manager of its own."""

        root = logging.RootLogger(logging.WARNING)
        Logger.manager = root.manager = manager = logging.Manager(root)
        Logger.root = root.root = root
        manager.loggerClass = Logger
        module.os, module.root, module.Logger = self.modules['os'], root, Logger
        module._handlerList, module._handlers = [], weakref.WeakValueDictionary()
        module.getLogger = lambda name=None: manager.getLogger(name) if name else root
        module.setLoggerClass = manager.setLoggerClass
        module.getLoggerClass = lambda: manager.loggerClass
        self.modules['logging'] = module
        module.config = self._execute('logging.config', tuple(logging.__path__))
        return module

    def close_logging(self) -> None:
        """Close the handlers of the log."""
        root = self.modules['logging'].root
        for logger in [root, *root.manager.loggerDict.values()]:
            for handler in list(getattr(logger, 'handlers', ())):
                logger.removeHandler(handler)
                if not isinstance(handler, logging.NullHandler):
                    handler.close()
