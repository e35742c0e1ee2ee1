"""Load rospy once more, with globals of its own: one process, many nodes.

``sys.modules`` is as before afterwards. Each private module has a ``__builtins__`` whose ``__import__`` finds
rospy, rosgraph and what is written on rospy in the private set, and all else as usual.
"""
import builtins
import importlib
import inspect
import itertools
import linecache
import os
import pathlib
import re
import sys
import threading
import weakref
from contextlib import suppress
from functools import cache
from importlib.machinery import PathFinder
from importlib.util import module_from_spec, resolve_name
from types import ModuleType

import rospy.exceptions
import rospy.impl.transport

SHARED = sys.stdlib_module_names.union(
    'genpy genmsg roslib rospkg rosmaster catkin catkin_pkg pharos'.split(),
    'numpy yaml matplotlib cv2 PIL'.split(),
)
#: logging: rospy takes its handlers away; smach: it keeps what is being built in its classes;
#: the others use sys.argv, sys.path, os.environ or threads
PRIVATE = 'logging argparse optparse subprocess concurrent pkgutil smach'.split()
MOST_FILES = 300  # of a package that could be written on rospy


class Shim:
    """Looks like a module, with some names of our own."""

    def __init__(self, real, **own):
        self.__dict__.update(own, _real=real)

    def __getattr__(self, name):
        return getattr(self._real, name)


def own_path():
    """Return a copy of sys.path, with the source folders that catkin put in front of it at its end.

    The ``__init__`` of a package in a devel space puts its source folder in front. Whoever then
    imports the package anew would find it there, without its messages.
    """
    path = list(sys.path)
    for package in list(sys.modules.values()):
        folders = getattr(package, '__dict__', {}).get('__path__') or ['']
        home, *others = map(os.path.dirname, folders)
        for folder in others:
            if home in path and folder in path[: path.index(home)]:
                path.remove(folder)
                path.append(folder)
    return path


@cache
def _spec_of(name, path):
    spec = PathFinder.find_spec(name, path)
    if spec is None:
        raise ModuleNotFoundError(f'No module named {name!r}', name=name)
    return spec


@cache
def _code_of(loader, name, changed):
    return loader.get_code(name)


def _find(name, path):
    """Return the spec of a module, and its code, which is read again if the file has changed."""
    spec = _spec_of(name, path)
    if not spec.has_location:
        return spec, None
    changed = os.stat(spec.origin).st_mtime_ns if os.path.isfile(spec.origin) else 0
    return spec, _code_of(spec.loader, name, changed)


def home_of(top):
    """Return the file of a top-level module of Python, and its folders if it is a package."""
    spec = getattr(sys.modules.get(top), '__spec__', None) or PathFinder.find_spec(top)
    if top in SHARED or spec is None or not str(spec.origin).endswith('.py'):
        return None, []
    file = pathlib.Path(spec.origin)
    folders = list(spec.submodule_search_locations or ())
    # catkin's devel space leads to the source
    source = re.search(r'__extended_path = [\'"]([^\'"]*)', file.read_text(errors='replace'))
    if source:
        folders.append(f'{source[1]}/{top}')
    return file, folders


@cache
def _imports_of(top):
    """Return what a module or package of Python imports; nothing of a large one or one in C."""
    file, folders = home_of(top)
    if file is None:
        return set()
    init = file.read_bytes()
    found = (file for folder in folders for file in pathlib.Path(folder).rglob('*.py'))
    files = [file.read_bytes() for file in itertools.islice(found, MOST_FILES + 1)]
    text = b'\n'.join([init, *files]) if len(files) <= MOST_FILES else b''
    names = re.findall(r'^\s*(?:from|import) (\w+)', text.decode(errors='replace'), re.M)
    return {'rospy', *names} if b'rospy' in text else set(names)


@cache
def _reaches_rospy(top):
    """True if the code of a package says rospy, or imports a package that does, and so on.

    A package that uses pharos does, too.
    """
    names, new = set(), {top}
    while new and new.isdisjoint(('rospy', 'rosgraph', 'pharos')):
        names |= new
        found = set()
        for name in new:
            found |= _imports_of(name)
        new = found - names
    return bool(new)


def _is_generated(name):
    """True for generated messages, which are shared."""
    top, *rest = name.split('.')
    return rest[:1] in (['msg'], ['srv']) and top not in ('rospy', 'rosgraph')


def is_private(name):
    """True if each node has a copy of the module."""
    top = name.partition('.')[0]
    if top in PRIVATE:
        return True
    return top not in SHARED and not _is_generated(name) and _reaches_rospy(top)


#: class of a private module -> its PrivateModules, as a weak reference
_owners = weakref.WeakKeyDictionary()


def _private_module(thing):
    """Return the private module of a class, function, method or frame; None if it has none."""
    if inspect.isclass(thing):
        name = thing.__module__
        owner = None
        with suppress(TypeError):  # its metaclass has no hash
            owner = _owners.get(thing, lambda: None)()
    else:
        names = getattr(thing, 'f_globals', None) or getattr(thing, '__globals__', None) or {}
        name = names.get('__name__')
        own_builtins = names.get('__builtins__')
        has_dict = type(own_builtins) is dict  # that of __main__ is a module
        owner = getattr(own_builtins.get('__import__'), '__self__', None) if has_dict else None
    return owner.modules.get(name) if isinstance(owner, PrivateModules) else None


def _getmodule(thing, _filename=None, original=inspect.getmodule):
    """Find private modules, too: inspect looks through all of sys.modules, in vain, each time."""
    return _private_module(thing) or original(thing, _filename)


def _getfile(thing, original=inspect.getfile):
    """Find the files of private modules' classes, too: inspect looks for them in sys.modules."""
    module = inspect.isclass(thing) and _private_module(thing)
    return getattr(module, '__file__', None) or original(thing)


def _getsourcefile(thing, original=inspect.getsourcefile):
    """Take the file of a frame as read: each look at the disk lets another thread have the interpreter."""
    if inspect.isframe(thing) and thing.f_code.co_filename in linecache.cache:
        return thing.f_code.co_filename
    return original(thing)


inspect.getmodule = _getmodule
inspect.getfile = _getfile
inspect.getsourcefile = _getsourcefile


class PrivateModules:
    """A set of private modules.

    :param substitutes: what private modules import under some names of Python's modules
    :param patch: ``patch(module)`` is called right after the code of each private module
    """

    def __init__(self, substitutes, patch):
        self.modules = {
            **substitutes,
            # one for all, so that ``except rospy.ROSException`` catches every node's
            'rospy.exceptions': rospy.exceptions,
            # it numbers the connections, INTRAPROCESS and TCPROS ones
            'rospy.impl.transport': rospy.impl.transport,
        }
        self.modules['importlib'] = Shim(importlib, import_module=self._import_module)
        self._patch = patch
        self._lock = threading.RLock()
        self.folder = None  # of the program, if this is one
        self.builtins = {
            **vars(builtins),
            '__import__': self._import,
            '__build_class__': self._build_class,
        }

    @property
    def path(self):
        """The folders that are searched, as the program's ``sys.path`` has them now."""
        return self.modules['sys'].path

    def _is_private(self, name):
        """True also for what lies beside the program, or in folders that it has put on sys.path."""
        if _is_generated(name):
            return False
        top = name.partition('.')[0]
        if is_private(name) or self.folder and PathFinder.find_spec(top, [self.folder]):
            return True
        return top not in SHARED and self._is_added(top)

    def _is_added(self, top):
        """True if a module lies in a folder that the process does not search."""
        added = [folder for folder in self.path if folder not in sys.path]
        spec = PathFinder.find_spec(top, [*self.path, *sys.path]) if added else None
        if spec is None:
            return False
        places = spec.submodule_search_locations or [spec.origin]
        folder = os.path.dirname(places[0])
        if folder not in added:
            return False
        if (
            os.path.basename(folder) == 'site-packages'
        ):  # such as torch, which cannot be loaded twice
            sys.path.append(folder)
            return False
        return True

    def load(self, name):
        """Return the module of that name, as private modules import it."""
        parent, _, leaf = name.rpartition('.')
        if name not in self.modules and not self._is_private(name):
            module = importlib.import_module(name)
            if parent and self._is_private(parent):  # of a package with code and messages
                setattr(self.load(parent), leaf, module)
            return module
        with self._lock:  # or another thread would see a module that is half loaded
            if name not in self.modules:
                # what the process has searched since the start of the run comes last
                path = self.load(parent).__path__ if parent else [*self.path, *sys.path]
                if name not in self.modules:  # the parent may have imported it
                    self._execute(name, tuple(path))
            if parent in self.modules:
                setattr(self.modules[parent], leaf, self.modules[name])
            return self.modules[name]

    def _execute(self, name, path):
        spec, code = _find(name, path)
        self.modules[name] = module = module_from_spec(spec)
        vars(module)['__builtins__'] = self.builtins
        is_added = sys.modules.setdefault(name, module) is module  # @dataclass looks there
        try:
            if code is None and spec.loader and spec.has_location:
                spec.loader.exec_module(module)
            else:
                exec(code or '', vars(module))
        except BaseException:
            del self.modules[name]
            raise
        finally:
            if is_added:
                del sys.modules[name]
        self._patch(module)

    def _build_class(self, function, name, *bases, **options):
        cls = builtins.__build_class__(function, name, *bases, **options)
        if not str(function.__module__).startswith(
            'rospy'
        ):  # of these, sys.modules has the same files
            with suppress(TypeError):  # its metaclass has no hash
                _owners[cls] = weakref.ref(self)
        return cls

    def _import_module(self, name, package=None):
        return self.load(resolve_name(name, package))

    def _import(self, name, globals=None, locals=None, fromlist=(), level=0):
        if level:
            name = resolve_name('.' * level + name, globals['__package__'])
        module = self.load(name)
        if not fromlist:
            return self.load(name.partition('.')[0])
        if hasattr(module, '__path__'):
            importlib._bootstrap._handle_fromlist(module, fromlist, self.load)
        if '*' in fromlist:  # generated messages bring sys, which is to be the program's
            starred = Shim(module)
            for key, value in vars(module).items():
                name = isinstance(value, ModuleType) and value.__name__
                vars(starred)[key] = self.modules.get(name, value)
            return starred
        return module
