"""Loads rospy's modules once more, with globals of their own.

``sys.modules`` stays untouched and no other thread notices: every module of the private set gets a
``__builtins__`` whose ``__import__`` resolves the private packages to the set and everything else
as usual, also for imports that rospy does inside functions later on.
"""
import builtins
import collections
import contextlib
import importlib.util
import os
import pickle
import sys
import threading
import types
from importlib.machinery import SourceFileLoader
from typing import Any, Dict, Tuple

from pharos.private_rospy import ownership
from pharos.private_rospy.module_proxy import ModuleProxy, twin
from pharos.private_rospy.process_rospy import rospy

# so that ``except rospy.ROSException`` catches every node's
_SHARED = {'rospy.exceptions': rospy.exceptions}
# Those of Python's modules with functions that look modules up by name, and what each set has of
# them. An own copy of what they import would have other classes.
_TWINS: Dict[str, Dict[str, Any]] = {
    'dataclasses': {},
    'doctest': {},
    'inspect': {'modulesbyfile': {}, '_filesbymodname': {}},
    'pkgutil': {},
    'typing': {},
}
# Modules of Python's of which a node's program has its own, and rospy does with the process's: those
# would slow the start of each node down.
_OWN_OF_PROGRAMS = 'pickle', 'traceback'
_ROSPYS = 'rospy', 'rosgraph', 'logging'
# file -> (its time of modification, code), the same for all sets
_codes: Dict[str, Tuple[Any, Any]] = {}


class PrivateImports:
    """A set of private modules: rospy, rosgraph, and whatever they, a program or :meth:`load`
    import that is a node's own, as :mod:`.ownership` says.

    ``sys``, ``os`` and others stand in for Python's from the beginning: see :mod:`.own_process`.

    :param patch: ``patch(module)``, called right after the code of every private module, before any
        other module can import names from it
    """

    def __init__(self, patch):
        #: name -> module: what private modules import under that name
        self.modules = {}
        self._patch = patch
        self._changed = threading.Condition()  # guards these
        self._loading = {}  # name of a module -> the thread that loads it
        self._awaited = {}  # thread -> name of the module that it waits for
        self._folder = None  # the program's
        own_builtins = types.ModuleType('builtins', builtins.__doc__)
        self.builtins = vars(own_builtins)
        self.builtins.update(
            vars(builtins), __import__=self._import, print=self._print, exit=_exit, quit=_exit
        )
        self.system = ModuleProxy(
            sys, path=list(sys.path), modules=collections.ChainMap(self.modules, sys.modules)
        )
        # pickle without this is written in Python, and looks modules up in the set
        accelerator = types.ModuleType('_pickle')
        accelerator.PickleBuffer = pickle.PickleBuffer
        util = ModuleProxy(
            importlib.util,
            module_from_spec=self._module_from_spec,
            find_spec=self._find_spec,
        )
        self.modules.update(
            builtins=own_builtins,
            sys=self.system,
            _pickle=accelerator,
            importlib=ModuleProxy(
                importlib, import_module=self._import_module, reload=self._reload, util=util
            ),
        )
        self.modules['importlib.util'] = util

    def import_library(self, name):
        """The module ``name`` as private modules import it."""
        path = self.system.path
        path += [folder for folder in sys.path if folder not in path]
        ownership.look_again()
        return self.load(name)

    def run_main(self, path, argv):
        """Run the file as a program of the set, in this thread: what it raises, SystemExit too, comes
        through.

        :param argv: its ``sys.argv``, whole
        """
        self._folder = os.path.dirname(os.path.realpath(path))
        self.system.argv, self.system.path = argv, [self._folder, *sys.path]
        ownership.look_again()
        loader = SourceFileLoader('__main__', path)
        main = types.ModuleType('__main__')
        vars(main).update(
            __file__=path,
            __loader__=loader,
            __cached__=None,
            __builtins__=self.modules['builtins'],
        )
        self.modules['__main__'] = main
        exec(loader.source_to_code(loader.get_data(path), path), vars(main))

    def twin(self, real, **own):
        """A copy of one of Python's modules that has other objects under some names, and whose
        functions see these, and the private modules."""
        imported = {
            name: self._own(value)
            for name, value in vars(real).items()
            if isinstance(value, types.ModuleType)
        }
        return twin(real, **{**imported, '__builtins__': self.builtins, **own})

    def load_single(self, name, path):
        """A private copy of one module of a package that is otherwise shared."""
        return self._run(*_find(name, tuple(path)))

    def load(self, name):
        """The module of that full name, for private modules."""
        me = threading.get_ident()
        if name not in self.modules or self._loading.get(name, me) != me:
            if name in _TWINS:
                own = {name: value.copy() for name, value in _TWINS[name].items()}
                self.modules[name] = self.twin(importlib.import_module(name), **own)
            elif not self._is_private(name.partition('.')[0]):
                return importlib.import_module(name)
            else:
                self._load(name)
        if self.modules[name] is None:
            raise ModuleNotFoundError(f'{name!r} is None in sys.modules', name=name)
        return self.modules[name]

    def _is_private(self, top):
        return ownership.is_own(top, tuple(self.system.path), self._folder)

    def _load(self, name):
        parent_name, _, leaf = name.rpartition('.')
        parent = self.load(parent_name) if parent_name else None
        if parent and not hasattr(parent, '__path__'):
            raise ModuleNotFoundError(
                f'No module named {name!r}; {parent_name!r} is not a package', name=name
            )
        self._claim(name)
        try:
            if name in self.modules:  # another thread loaded it, or the parent's code imported it
                return
            spec, code = _find(name, tuple(parent.__path__ if parent else self.system.path))
            module = _SHARED.get(name) or _shared(spec)
            if module:
                self.modules[name] = module
            else:
                self._run(spec, code, parent)
            if parent:
                setattr(parent, leaf, self.modules[name])
        finally:
            with self._changed:
                if self._loading.get(name) == threading.get_ident():
                    del self._loading[name]
                self._changed.notify_all()

    def _claim(self, name):
        """Have this thread load the module, after another one that does already.

        Where threads wait for each other in a circle, this goes on with a module half loaded, as in
        Python.
        """
        me = threading.get_ident()
        with self._changed:
            while self._loading.setdefault(name, me) != me:
                thread = self._loading[name]
                while thread in self._awaited:
                    thread = self._loading.get(self._awaited[thread])
                if thread == me:
                    return
                self._awaited[me] = name
                self._changed.wait()
                del self._awaited[me]

    def _run(self, spec, code, parent=None):
        """Run the code of a module, which is found before: rospy's import each other in circles."""
        name = spec.name
        module = self.modules[name] = self._module_from_spec(spec)
        if parent:
            setattr(parent, name.rpartition('.')[2], module)
        try:
            if code:
                exec(code, vars(module))
            elif spec.loader:
                spec.loader.exec_module(module)
            if name.partition('.')[0] in ownership.OWN_OF_PYTHONS:
                _join_kinds(module)
            self._patch(module)
        except BaseException:
            del self.modules[name]
            raise
        return module

    def _import(self, name, globals=None, locals=None, fromlist=(), level=0):
        """What an import statement of a private module calls."""
        absolute = name
        if level:
            absolute = importlib.util.resolve_name('.' * level + name, globals['__package__'])
        top = absolute.partition('.')[0]
        user = (globals or {}).get('__name__', '').partition('.')[0]
        if top in _OWN_OF_PROGRAMS and user in _ROSPYS:
            return builtins.__import__(name, globals, locals, fromlist, level)
        module = self.load(absolute)
        if not fromlist:
            return module if level else self.load(top)
        if hasattr(module, '__path__'):
            for item in fromlist:
                for each in getattr(module, '__all__', ()) if item == '*' else (item,):
                    self._load_item(module, f'{absolute}.{each}', each)
        is_private = vars(module).get('__builtins__') is self.builtins
        return self._starred(module) if '*' in fromlist and not is_private else module

    def _load_item(self, package, name, item):
        if not hasattr(package, item):
            try:
                module = self.load(name)
            except ModuleNotFoundError as error:
                if error.name != name:
                    raise
                # the import statement itself says what is missing
            else:
                vars(package).setdefault(item, module)

    def _starred(self, module):
        """What a star import takes its names from: with them come modules that the other one
        imported."""
        names = getattr(module, '__all__', None)
        if names is None:
            names = [name for name in vars(module) if not name.startswith('_')]
        view = types.ModuleType(module.__name__)
        vars(view).update({name: self._own(getattr(module, name)) for name in names})
        view.__all__ = list(names)
        return view

    def _own(self, value):
        """The set's module instead of Python's."""
        if isinstance(value, types.ModuleType):
            return self.modules.get(value.__name__, value)
        return value

    # -- functions of Python's, as private modules have them

    def _import_module(self, name, package=None):
        """``importlib.import_module``."""
        return self.load(importlib.util.resolve_name(name, package))

    def _find_spec(self, name, package=None):
        """``importlib.util.find_spec``."""
        name = importlib.util.resolve_name(name, package)
        if self.modules.get(name) is not None:
            return self.modules[name].__spec__
        parent = name.rpartition('.')[0]
        path = self.load(parent).__path__ if parent else self.system.path
        return ownership.find_spec(name, tuple(path)) or importlib.util.find_spec(name)

    def _module_from_spec(self, spec):
        """``importlib.util.module_from_spec``."""
        module = importlib.util.module_from_spec(spec)
        vars(module)['__builtins__'] = self.builtins
        return module

    def _reload(self, module):
        """``importlib.reload``; what stands in for one of Python's modules stays as it is."""
        spec = getattr(module, '__spec__', None)
        if spec is not None and self.modules.get(spec.name) is module:
            exec(_code(spec), vars(module))
        return module

    def _print(self, *values, file=None, **options):
        """``print``, to the ``sys.stdout`` of the set."""
        print(*values, file=self.system.stdout if file is None else file, **options)


def _exit(code=None):
    """``exit()``; Python's closes standard input, which nodes share."""
    raise SystemExit(code)


def _find(name, path):
    """The spec and the compiled code of a module."""
    spec = ownership.find_spec(name, path)
    if spec is None:
        raise ModuleNotFoundError(f'No module named {name!r}', name=name)
    return spec, _code(spec)


def _code(spec):
    """The compiled code of a module, read once per process, and when its file has changed; None for
    a C extension, and a package without a file."""
    if not spec.has_location:
        return None
    try:
        modified = os.stat(spec.origin).st_mtime_ns
    except OSError:
        modified = None  # it is in an archive
    if _codes.get(spec.origin, ('',))[0] != modified:
        _codes[spec.origin] = modified, spec.loader.get_code(spec.name)
    return _codes[spec.origin][1]


def _shared(spec):
    """The process's own module, for what there is one of; None for all else, and where Python finds
    another one."""
    if ownership.is_one_for_all(spec):
        with contextlib.suppress(ModuleNotFoundError):
            module = importlib.import_module(spec.name)
            if module.__spec__.origin == spec.origin:
                return module
    return None


def _join_kinds(module):
    """Have a copy of one of Python's modules raise and catch the same as the others, and its
    executors be such for asyncio."""
    real = importlib.import_module(module.__name__)
    for name, value in vars(real).items():
        if isinstance(value, type) and issubclass(value, BaseException):
            vars(module)[name] = value
    if module.__name__ == 'concurrent.futures.thread':
        module.ThreadPoolExecutor.__bases__ = (real.ThreadPoolExecutor,)
