"""Which packages each node has for itself, and which are the whole process's.

A package is a node's own if it reaches rospy: if one of its files imports rospy, or a package that
does. So nothing that is shared holds anything of a node's. Also its own is what lies in the folder
of its program, or in one that only the program has put on ``sys.path``.
"""
import functools
import os
import re
import site
import sys
from importlib.machinery import EXTENSION_SUFFIXES, ModuleSpec, PathFinder

#: what a node's copies are made for; rosunit reads the arguments of the program
_ROOTS = {'rospy', 'rosgraph', 'rosunit'}
#: message classes are made of these, and this package makes the nodes
_SHARED = {'genpy', 'genmsg', 'pharos'}
#: modules of Python's that act for the program that they are in (its arguments, output, threads and
#: child processes), or that look modules up by name
OWN_OF_PYTHONS = {
    'argparse',
    'concurrent',
    'contextlib',
    'fileinput',
    'gettext',
    'multiprocessing',
    'optparse',
    'pickle',
    'pprint',
    'runpy',
    'shelve',
    'subprocess',
    'tempfile',
    'traceback',
    'unittest',
    'weakref',
}
_IMPORT = re.compile(
    rb'(?:^|[;:])[ \t]*(?:from[ \t]+(\w+)|import[ \t]+(\w[\w., \t]*))'
    rb'|(?:import_module|__import__)\([ \t]*[\'"](\w+)',
    re.MULTILINE,
)
_NAMES_ROOT = re.compile('|'.join(_ROOTS).encode())
#: in the file that catkin puts into a devel space for a package
_EXTENDED_PATH = re.compile(rb'^__extended_path = [\'"](.*)[\'"]\.split', re.MULTILINE)
_GENERATED = re.compile(rb'(\s*from \._\w+ import \*)+\s*')
_PYTHONS_FOLDER = os.path.dirname(os.__file__)
_specs = {}  # (module name, path) -> spec, the same for all nodes
_decided = {}  # (module name, path, folder) -> whether it is a node's own
_SITES = {*site.getsitepackages(), site.getusersitepackages()}


def find_spec(name, path):
    """The spec of a module on the path, a tuple of folders; None where there is none yet."""
    if (name, path) not in _specs:
        try:
            spec = PathFinder.find_spec(name, path)
        except KeyError:  # for a folder without __init__.py, Python looks for its parent's module
            spec = ModuleSpec(name, None, is_package=True)
        if spec is None:
            return None
        if spec.origin is None and spec.submodule_search_locations is not None:
            places = [os.path.join(folder, name.rpartition('.')[2]) for folder in path]
            spec.submodule_search_locations = [place for place in places if os.path.isdir(place)]
        # catkin's file in a devel space, once imported, puts what it stands for before itself
        known = getattr(sys.modules.get(name), '__spec__', None)
        is_relayed = known is not None and _home(spec) in _relayed(known)
        _specs[name, path] = known if is_relayed else spec
    return _specs[name, path]


def is_own(name, path, folder):
    """Whether the top-level package or module that is found on the path is a node's own.

    :param path: a tuple of folders
    :param folder: the node's program's; None: it has no program
    """
    key = name, path, folder
    if key not in _decided:
        _decided[key] = _is_own(name, path, folder)
    return _decided[key]


def look_again():
    """Find packages that were not there before."""
    for key in [key for key, decision in _decided.items() if decision is None]:
        _decided.pop(key, None)


def _is_own(name, path, folder):
    """The same; None where there is no such package."""
    if name in _ROOTS or name in OWN_OF_PYTHONS:
        return True
    if name in _SHARED or name in sys.builtin_module_names:
        return False
    spec = find_spec(name, path)
    if spec is None:
        return None
    if _is_pythons(spec):
        return _home(spec) == folder
    is_known_to_process = _home(spec) in (entry or os.getcwd() for entry in sys.path)
    return _home(spec) == folder or not is_known_to_process or _reaches_rospy(name, path)


def is_one_for_all(spec):
    """Whether a module of a package that is a node's own cannot be so: a C extension, or classes that
    are to be the same for all, such as generated messages and, for asyncio, futures."""
    if spec.origin is None:
        return False
    if spec.origin.endswith(tuple(EXTENSION_SUFFIXES)) or spec.name == 'concurrent.futures._base':
        return True
    if re.fullmatch(r'\w+\.(msg|srv)(\._\w+)?', spec.name):
        package = os.path.join(os.path.dirname(spec.origin), '__init__.py')
        return _GENERATED.fullmatch(_text(package)) is not None
    return False


@functools.lru_cache(maxsize=None)
def _reaches_rospy(name, path):
    """Whether a package imports rospy, or one that does."""
    waiting, seen = [name], set(_SHARED)
    while waiting:
        name = waiting.pop()
        spec = None if name in seen else find_spec(name, path)
        seen.add(name)
        if spec is not None and not _is_pythons(spec):
            imported = _imports(name, path)
            if imported & _ROOTS:
                return True
            waiting += imported
    return False


@functools.lru_cache(maxsize=None)
def _imports(name, path):
    """The names of the top-level packages that the files of a package import.

    Of Python libraries that are installed and no packages of ROS, only whether they import rospy:
    they are many, and large.
    """
    spec = find_spec(name, path)
    share = os.path.join(_home(spec), '..', '..', '..', 'share')
    is_followed = _home(spec) not in _SITES or os.path.exists(
        os.path.join(share, name, 'package.xml')
    )
    found = set()
    for file in _files(spec):
        text = _text(file)
        if is_followed or _NAMES_ROOT.search(text):
            for after_from, after_import, called in _IMPORT.findall(text):
                for each in (after_from or called or after_import).split(b','):
                    found.add(re.match(rb'\s*(\w*)', each).group(1).decode())
    return found if is_followed else found & _ROOTS


def _files(spec):
    """The source files of a package or module, but for generated messages."""
    folders = list(spec.submodule_search_locations or ())
    if not folders and spec.origin.endswith('.py'):
        yield spec.origin
    for source in _relayed(spec):
        folders.append(os.path.join(source, spec.name))
        if os.path.isfile(folders[-1] + '.py'):
            yield folders[-1] + '.py'
    for top in folders:
        for folder, subfolders, files in os.walk(top):
            if folder == top:
                subfolders[:] = set(subfolders) - {'msg', 'srv'}
            for file in files:
                if file.endswith('.py'):
                    yield os.path.join(folder, file)


def _relayed(spec):
    """The folders where the code is for which catkin's file in a devel space stands."""
    if not spec.submodule_search_locations or not spec.has_location:
        return []
    extended = _EXTENDED_PATH.search(_text(spec.origin))
    return os.fsdecode(extended.group(1)).split(';') if extended else []


def _text(path):
    """What is in a file; nothing, if it is in an archive."""
    if not os.path.isfile(path):
        return b''
    with open(path, 'rb') as file:
        return file.read()


def _home(spec):
    """The entry of the path in which a package or module lies."""
    folders = spec.submodule_search_locations
    return os.path.dirname(list(folders)[0] if folders else spec.origin)


def _is_pythons(spec):
    if spec.origin is None or not spec.has_location:
        return not spec.submodule_search_locations  # else it is a package without __init__.py
    home = _home(spec)
    return home.startswith(_PYTHONS_FOLDER) and not home.endswith('-packages')
