"""Load rospy once more, with globals of its own: one process, many nodes.

``sys.modules`` is as before afterwards. Each private module has a ``__builtins__`` whose ``__import__`` finds
rospy, rosgraph and what is written on rospy in the private set, and all else as usual.
"""
import builtins
import importlib
import itertools
import pathlib
import re
import sys
import threading
from functools import cache
from importlib.machinery import PathFinder
from importlib.util import module_from_spec, resolve_name
from types import ModuleType

import rospy.exceptions

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


@cache
def _find(name, path):
    spec = PathFinder.find_spec(name, path)
    if spec is None:
        raise ModuleNotFoundError(f'No module named {name!r}', name=name)
    return spec, spec.loader.get_code(name) if spec.has_location else None


@cache
def _imports_of(top):
    """Return what a module or package of Python imports; nothing of a large one or one in C."""
    spec = PathFinder.find_spec(top)
    if top in SHARED or spec is None or not str(spec.origin).endswith('.py'):
        return set()
    init = pathlib.Path(spec.origin).read_bytes()
    folders = list(spec.submodule_search_locations or ())
    # catkin's devel space leads to the source
    source = re.search(r'__extended_path = [\'"]([^\'"]*)', init.decode(errors='replace'))
    folders += [f'{source[1]}/{top}'] if source else []
    found = (file for folder in folders for file in pathlib.Path(folder).rglob('*.py'))
    files = [file.read_bytes() for file in itertools.islice(found, MOST_FILES + 1)]
    text = b'\n'.join([init, *files]) if len(files) <= MOST_FILES else b''
    names = re.findall(r'^\s*(?:from|import) (\w+)', text.decode(errors='replace'), re.M)
    return {'rospy', *names} if b'rospy' in text else set(names)


@cache
def _reaches_rospy(top):
    """True if the code of a package says rospy, or imports a package that does, and so on."""
    names, new = set(), {top}
    while new and new.isdisjoint(('rospy', 'rosgraph')):
        names |= new
        new = set().union(*map(_imports_of, new)) - names
    return bool(new)


def is_private(name):
    """True if each node has a copy of the module. Generated messages are shared."""
    top, *rest = name.split('.')
    is_generated = rest[:1] in (['msg'], ['srv']) and top not in ('rospy', 'rosgraph')
    return top in PRIVATE or not is_generated and _reaches_rospy(top)


class PrivateModules:
    """A set of private modules.

    :param substitutes: what private modules import under some names of Python's modules
    :param patch: ``patch(module)`` is called right after the code of each private module
    """

    def __init__(self, substitutes, patch):
        # one rospy.exceptions for all, so that ``except rospy.ROSException`` catches every node's
        self.modules = {**substitutes, 'rospy.exceptions': rospy.exceptions}
        self.modules['importlib'] = Shim(importlib, import_module=self._import_module)
        self._patch, self._lock = patch, threading.RLock()
        self.path = None  # a program's sys.path, which begins with its own folder
        self.builtins = {**vars(builtins), '__import__': self._import}

    def _is_private(self, name):
        """True also for what lies in the folder of the program."""
        top = name.partition('.')[0]
        return is_private(name) or self.path and PathFinder.find_spec(top, self.path[:1])

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
                path = self.load(parent).__path__ if parent else self.path
                if name not in self.modules:  # the parent may have imported it
                    self._execute(name, path and tuple(path))
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
