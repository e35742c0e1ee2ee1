"""Loads rospy's modules once more, with globals of their own.

``sys.modules`` stays untouched and no other thread notices: every module of the private set gets a
``__builtins__`` whose ``__import__`` resolves the private packages to the set and everything else
as usual, also for imports that rospy does inside functions later on.
"""
import builtins
import collections
import functools
import importlib.util
import os
import pathlib
import re
import sys
import types
from importlib.machinery import PathFinder, SourceFileLoader

from pharos.private_rospy.process_rospy import rospy

# so that ``except rospy.ROSException`` catches every node's
_SHARED = {'rospy.exceptions': rospy.exceptions}
_IMPORTS_ROSPY = re.compile(rb'^\s*(import|from)\s+rospy\b', re.MULTILINE)
_found = {}  # (module name, path) -> (spec, code), the same for all sets


class ModuleProxy:
    """A look-alike of a module: a few names of its own, everything else the real module's."""

    def __init__(self, real, **own):
        self.__dict__.update(own, _real=real)

    def __getattr__(self, name):
        return getattr(self._real, name)


def _find(name, path):
    """The spec and the compiled code of module ``name``, looked up once per process."""
    key = name, path and tuple(path)
    if key not in _found:
        spec = PathFinder.find_spec(name, path)
        if spec is None:
            raise ModuleNotFoundError(f'No module named {name!r}', name=name)
        _found[key] = spec, spec.loader.get_code(name)
    return _found[key]


@functools.lru_cache(maxsize=None)
def _is_written_on_rospy(package):
    """Whether a package imports rospy in one of its files: its copy for a node must then be that
    node's own too."""
    spec = PathFinder.find_spec(package)
    if spec is None:  # it is built into Python
        return False
    files = [pathlib.Path(spec.origin)] if spec.origin else []
    for folder in spec.submodule_search_locations or ():
        files += pathlib.Path(folder).glob('*.py')
    return any(_IMPORTS_ROSPY.search(file.read_bytes()) for file in files if file.suffix == '.py')


class PrivateImports:
    """A set of private modules: rospy, rosgraph, and whatever they or :meth:`load` import that is
    written on rospy.

    :param substitutes: ``{module name: object}`` that private modules get when they import that
        name
    :param patch: ``patch(module)``, called right after the code of every private module, before any
        other module can import names from it
    """

    def __init__(self, substitutes, patch):
        self.modules = {}
        self._private = {'rospy', 'rosgraph'}
        self._substitutes = substitutes
        substitutes['sys'].modules = collections.ChainMap(self.modules, sys.modules)
        self._patch = patch
        self._folders = []  # of the programs of the set: what is in them is theirs alone
        self._builtins = dict(vars(builtins), __import__=self._import)

    def load(self, name):
        """The private module ``name``; its top-level package is private from now on."""
        self._private.add(name.partition('.')[0])
        return self._load(name)

    def run_main(self, path, argv):
        """Run the file as a program of the set, in this thread: what it raises, SystemExit too, comes
        through.

        :param argv: its ``sys.argv``, whole
        """
        folder = os.path.dirname(os.path.realpath(path))
        self._folders.insert(0, folder)
        system = self._substitutes['sys']
        system.argv, system.path = argv, [folder, *system.path]
        loader = SourceFileLoader('__main__', path)
        main = types.ModuleType('__main__')
        vars(main).update(
            __file__=path, __loader__=loader, __cached__=None, __builtins__=self._builtins
        )
        self.modules['__main__'] = main
        exec(loader.source_to_code(loader.get_data(path), path), vars(main))

    def load_single(self, name, path):
        """A private copy of one module of a package that is otherwise shared."""
        return self._run(*_find(name, path), {})

    def _load(self, name):
        if name in self.modules:
            return self.modules[name]
        parent_name, _, leaf = name.rpartition('.')
        parent = self._load(parent_name) if parent_name else None
        if name in self.modules:  # the parent's code imported it
            return self.modules[name]
        if name in _SHARED:
            self.modules[name] = _SHARED[name]
        else:
            path = parent.__path__ if parent else self._substitutes['sys'].path
            self._run(*_find(name, path), self.modules)
            self._patch(self.modules[name])
        if parent:
            setattr(parent, leaf, self.modules[name])
        return self.modules[name]

    def _is_private(self, top):
        if top in self._private or top in self.modules:
            return True
        if PathFinder.find_spec(top, self._folders):
            return True
        return _is_written_on_rospy(top)

    def _run(self, spec, code, modules):
        """Run the code of a module, which is among ``modules`` before: rospy's import each other in
        circles."""
        module = modules[spec.name] = importlib.util.module_from_spec(spec)
        vars(module)['__builtins__'] = self._builtins
        try:
            exec(code, vars(module))
        except BaseException:
            del modules[spec.name]
            raise
        return module

    def _import(self, name, globals=None, locals=None, fromlist=(), level=0):
        absolute = (
            importlib.util.resolve_name('.' * level + name, globals['__package__'])
            if level
            else name
        )
        top = absolute.partition('.')[0]
        if top in self._substitutes:
            real = builtins.__import__(name, globals, locals, fromlist, level)
            return self._substitutes.get(absolute, real) if fromlist else self._substitutes[top]
        if not self._is_private(top):
            return builtins.__import__(name, globals, locals, fromlist, level)
        module = self._load(absolute)
        if not fromlist:
            return module if level else self._load(top)
        if hasattr(module, '__path__'):
            for item in fromlist:
                if item != '*' and not hasattr(module, item):
                    try:
                        self._load(f'{absolute}.{item}')
                    except ModuleNotFoundError:
                        pass  # the import statement itself says what is missing
        return module
