"""Load rospy once more for each run, with globals of its own: one process, many nodes.

Private modules have ``__builtins__`` of their own. The ``__import__`` in there finds rospy, rosgraph
and libraries written on rospy among the private modules of the run, and all other modules as usual.
``sys.modules`` has no private module, but while a ``@dataclass`` is made. :mod:`.inspecting` has inspect
find them, in the whole process, and live/private_classes.py dataclasses and importlib.
"""
import builtins
import importlib
import itertools
import os
import pathlib
import re
import sys
import threading
from contextlib import suppress
from functools import lru_cache
from importlib.machinery import PathFinder
from importlib.util import module_from_spec, resolve_name
from types import ModuleType

import rospy.exceptions
import rospy.impl.transport

from pharos.python_versions import STANDARD_MODULES

COMMON = STANDARD_MODULES.union(
    'genpy genmsg roslib rospkg rosmaster catkin catkin_pkg pharos'.split(),
    'numpy yaml matplotlib cv2 PIL'.split(),
)
#: logging: rospy takes its handlers away; smach: its classes keep the container under construction;
#: the others use sys.argv, sys.path, os.environ or threads
PRIVATE = 'logging argparse optparse subprocess concurrent pkgutil runpy smach'.split()
#: not the words from and import in a docstring
_IMPORT = re.compile(
    r'^\s*(?:from (\w+)[\w.]* import\b|import (\w+)[\w.]*\s*(?:$|[,;#]|as ))', re.M
)
SYSTEM_FOLDERS = '/usr/', '/opt/ros/', os.path.dirname(os.__file__)
MAX_FILES = 300  # of a package that could be written on rospy


class Shim:
    """A stand-in for a module, with some names replaced."""

    def __init__(self, module, **replacements):
        self.__dict__.update(replacements, _module=module)

    def __getattr__(self, name):
        return getattr(self._module, name)


def private_path() -> list:
    """Return a copy of sys.path; source folders that catkin has put in front go to the end.

    The ``__init__`` of a package in a devel space puts its source folder in front. A program that
    then imports the package anew would find the source, without the package's messages.
    """
    path = list(sys.path)
    for package in list(sys.modules.values()):
        package_folders = getattr(package, '__dict__', {}).get('__path__') or ['']
        devel_folder, *source_folders = map(os.path.dirname, package_folders)
        for folder in source_folders:
            if devel_folder in path and folder in path[: path.index(devel_folder)]:  # type: ignore
                path.remove(folder)  # type: ignore[arg-type]
                path.append(folder)  # type: ignore[arg-type]
    return path


def remember_text(module):
    """Keep the text of a module's file, for a reload; not of the system's modules, and of this package's."""
    file = getattr(module, '__file__', None)
    if not file or file.startswith(SYSTEM_FOLDERS) or module.__name__.startswith('pharos.'):
        return
    with suppress(OSError):  # it is in an archive, or gone
        vars(module).setdefault('__text__', pathlib.Path(file).read_bytes())


@lru_cache(None)
def _spec_of(name, path):
    spec = PathFinder.find_spec(name, path)
    if spec is None:
        raise ModuleNotFoundError(f'No module named {name!r}', name=name)
    return spec


@lru_cache(None)
def _code_of(loader, name, change_time):
    return loader.get_code(name)


def _find(name: str, path: tuple) -> tuple:
    """Return the spec of a module, and its code; read the code again if the file has changed.

    :raises ModuleNotFoundError: if there is no such module on the path
    """
    spec = _spec_of(name, path)
    if not spec.has_location:
        return spec, None
    change_time = 0
    if os.path.isfile(spec.origin):
        change_time = os.stat(spec.origin).st_mtime_ns
    return spec, _code_of(spec.loader, name, change_time)


def _import_shared(name: str) -> ModuleType:
    """Import a module that all nodes share: one at a time, or circular imports as scipy's fail."""
    module = sys.modules.get(name)
    spec = getattr(module, '__spec__', None)
    if spec and not getattr(spec, '_initializing', False):
        return module  # type: ignore[return-value]
    with process_lock:
        return importlib._bootstrap._gcd_import(name)  # type: ignore[attr-defined]


def source_places(top_name: str) -> tuple:
    """Return the file of a top-level module, and the folders of a package.

    :returns: ``(file, folders)``; ``(None, [])`` for a common module or one without source
    """
    spec = getattr(sys.modules.get(top_name), '__spec__', None) or PathFinder.find_spec(top_name)
    if top_name in COMMON or spec is None or not str(spec.origin).endswith('.py'):
        return None, []
    file = pathlib.Path(spec.origin)  # type: ignore[arg-type]
    folders = list(spec.submodule_search_locations or ())
    # an __init__ in a devel space of catkin names the source folder
    source = re.search(r'__extended_path = [\'"]([^\'"]*)', file.read_text(errors='replace'))
    if source:
        folders.append(f'{source[1]}/{top_name}')
    return file, folders


@lru_cache(None)
def _imports_of(top_name: str) -> set:
    """Return the top-level names that a package imports; an empty set for a large one or one in C.

    A package that contains the word rospy counts as one that imports rospy.
    """
    file, folders = source_places(top_name)
    if file is None:
        return set()
    files = (path for folder in folders for path in pathlib.Path(folder).rglob('*.py'))
    contents = [path.read_bytes() for path in itertools.islice(files, MAX_FILES + 1)]
    if len(contents) > MAX_FILES:
        return set()
    text = b'\n'.join([file.read_bytes(), *contents])
    imports = _IMPORT.findall(text.decode(errors='replace'))
    names = {name for pair in imports for name in pair if name}
    if b'rospy' in text:
        names.add('rospy')
    return names


@lru_cache(None)
def _reaches_rospy(top_name: str) -> bool:
    """True if a package names rospy, imports rosgraph or pharos, or imports a package that does."""
    seen_names = set()
    new_names = {top_name}
    while new_names and new_names.isdisjoint(('rospy', 'rosgraph', 'pharos')):
        seen_names |= new_names
        # not union(*map(...)): if a program calls gc.get_objects() meanwhile, Python raises a
        # SystemError here, since somebody else holds the tuple that it makes
        imported_names = set()
        for name in new_names:
            imported_names |= _imports_of(name)
        new_names = imported_names - seen_names
    return bool(new_names)  # else all are seen, and none is rospy


def _is_generated(name: str) -> bool:
    """True if a module has generated messages or services, which all nodes share."""
    top_name, *rest = name.split('.')
    return rest[:1] in (['msg'], ['srv']) and top_name not in ('rospy', 'rosgraph')


#: held while a module that all nodes share is imported, or sys.modules shows a private one
process_lock = threading.RLock()


class PrivateModules:
    """The private modules of one run.

    :param substitutes: names of modules -> the stand-ins that private modules import instead
    :param patch: ``patch(module)`` is called right after the code of each private module has run
    :ivar by_name: names -> private modules and stand-ins
    :ivar program_folder: the folder of a script's program, or None
    :ivar builtins: the ``__builtins__`` of all private modules
    """

    def __init__(self, substitutes, patch):
        self.by_name = {
            **substitutes,
            # one for all: ``except rospy.ROSException`` catches every node's
            'rospy.exceptions': rospy.exceptions,
            # one for all: this module numbers the connections, INTRAPROCESS and TCPROS ones
            'rospy.impl.transport': rospy.impl.transport,
        }
        self.by_name['importlib'] = Shim(importlib, import_module=self._import_module)
        self._patch = patch
        self._lock = threading.RLock()
        self.program_folder = None
        self.builtins = {
            **vars(builtins),
            '__import__': self._import,
        }

    @property
    def path(self) -> list:
        """The folders to search: the current ``sys.path`` of the node."""
        return self.by_name['sys'].path

    def _is_private(self, name: str) -> bool:
        """True if each node has a copy of the module. The first rule that fits decides::

        generated messages and services             shared
        PRIVATE                                     private
        beside a script's program                   private
        COMMON: Python's own, numpy and the like    shared
        names rospy, or imports what does           private
        in a folder that the script has added       private
        all others                                  shared

        The first question for a module of a site-packages folder that only the script has puts that
        folder into the process's sys.path.
        """
        top_name = name.partition('.')[0]
        if _is_generated(name):
            return False
        if top_name in PRIVATE:
            return True
        if self.program_folder and PathFinder.find_spec(top_name, [self.program_folder]):
            return True
        if top_name in COMMON:
            return False
        return _reaches_rospy(top_name) or self._is_added(top_name)

    def _is_added(self, top_name: str) -> bool:
        """True if a module lies in a folder that the node searches and the process does not.

        A site-packages folder is added to the process's sys.path instead.
        """
        added_folders = [folder for folder in self.path if folder not in sys.path]
        if not added_folders:
            return False
        spec = PathFinder.find_spec(top_name, [*self.path, *sys.path])
        if spec is None:
            return False
        places = spec.submodule_search_locations or [spec.origin]  # type: ignore[list-item]
        folder = os.path.dirname(places[0])  # type: ignore[type-var]
        if folder not in added_folders:
            return False
        if os.path.basename(folder) == 'site-packages':
            sys.path.append(folder)  # shared: a library such as torch cannot be loaded twice
            return False
        return True

    def load(self, name):
        """Return the module of that full name, private or not; execute a new private module.

        :raises ModuleNotFoundError: if there is no such module
        """
        parent, _, leaf = name.rpartition('.')
        # without the lock: a known name needs no rule, and may still be loading. Then the lock waits
        if name not in self.by_name and not self._is_private(name):
            module = _import_shared(name)
            if parent and self._is_private(parent):  # a package with code and messages
                setattr(self.load(parent), leaf, module)
            return module
        with self._lock:  # other threads must not see a module that is half loaded
            if name not in self.by_name:
                # folders that the process has added since the start of the run come last
                path = self.load(parent).__path__ if parent else [*self.path, *sys.path]
                if name not in self.by_name:  # the parent may have imported it
                    self._execute(name, tuple(path))
            if parent in self.by_name:
                setattr(self.by_name[parent], leaf, self.by_name[name])
            return self.by_name[name]

    def _execute(self, name: str, path: tuple) -> None:
        spec, code = _find(name, path)
        module = module_from_spec(spec)
        self.by_name[name] = module
        vars(module)['__builtins__'] = self.builtins
        try:
            if code is None and spec.loader and spec.has_location:  # an extension in C
                spec.loader.exec_module(module)
            else:
                remember_text(module)
                exec(code or '', vars(module))
        except BaseException:
            del self.by_name[name]
            raise
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
            importlib._bootstrap._handle_fromlist(module, fromlist, self.load)  # type: ignore
        if '*' in fromlist:
            return self._with_private_modules(module)
        return module

    def _with_private_modules(self, module: ModuleType) -> Shim:
        """Return a stand-in for ``import *``, with private modules among its names.

        Generated messages import sys: a star import would replace the program's stand-in for sys.
        """
        starred = Shim(module)
        for key, value in vars(module).items():
            if isinstance(value, ModuleType):
                value = self.by_name.get(value.__name__, value)
            vars(starred)[key] = value
        return starred
