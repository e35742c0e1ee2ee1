"""Loads rospy's modules once more, with globals of their own.

``sys.modules`` stays untouched and no other thread notices: every module of the private set gets a
``__builtins__`` whose ``__import__`` resolves the private packages to the set and everything else
as usual, also for imports that rospy does inside functions later on.
"""
import builtins
import functools
import importlib.util
import pathlib
import re
import tokenize
import types
from importlib.machinery import PathFinder

from pharos.private_rospy.process_rospy import rospy

# so that ``except rospy.ROSException`` catches every node's
_SHARED = {'rospy.exceptions': rospy.exceptions}
_IMPORTS_ROSPY = re.compile(rb'^\s*(import|from)\s+rospy\b', re.MULTILINE)
_found = {}  # module name -> (spec, code), the same for all sets


class ModuleProxy:
    """A look-alike of a module: a few names of its own, everything else the real module's."""

    def __init__(self, real, **own):
        self.__dict__.update(own, _real=real)

    def __getattr__(self, name):
        return getattr(self._real, name)


def _find(name, path):
    """The spec and the compiled code of module ``name``, looked up once per process."""
    if name not in _found:
        spec = PathFinder.find_spec(name, path)
        if spec is None:
            raise ModuleNotFoundError(f'No module named {name!r}', name=name)
        _found[name] = spec, spec.loader.get_code(name)
    return _found[name]


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
        self._patch = patch
        self._builtins = dict(vars(builtins), __import__=self._import)

    def load(self, name):
        """The private module ``name``; its top-level package is private from now on."""
        self._private.add(name.partition('.')[0])
        return self._load(name)

    def run_main(self, path, argv):
        """Run the program of the file as ``__main__``, in this thread; what it raises is the
        caller's."""
        with tokenize.open(path) as text:
            code = compile(text.read(), path, 'exec')
        main = types.ModuleType('__main__')
        vars(main).update(__file__=path, __builtins__=self._builtins)
        self._substitutes['sys'].__dict__['argv'] = argv
        exec(code, vars(main))

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
            self._run(*_find(name, parent.__path__ if parent else None), self.modules)
            self._patch(self.modules[name])
        if parent:
            setattr(parent, leaf, self.modules[name])
        return self.modules[name]

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
        if top not in self._private and not _is_written_on_rospy(top):
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
