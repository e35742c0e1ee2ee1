"""Where the types of messages and services are known: found before, installed, in files, or shipped
for turtlesim."""

import importlib.util
import os
import re
import reprlib
import sys

import genpy
import rospkg

from pharos.errors import UnknownTypeError, suggest
from pharos.messages.turtlesim import DEFINITIONS

MAX_TEXT = 1 << 20  # characters of a definition with those nested in it
NAME = re.compile('[A-Za-z][A-Za-z0-9_]{0,127}')
_TYPE = re.compile(f'{NAME.pattern}/{NAME.pattern}')
_KINDS = {'msg': 'message', 'srv': 'service'}

found = {}  # (kind, type): class answered before or defined, so that two asks give the same one
# keys of found that no package here has: to a subscriber, a live publisher knows better
provisional = set()


def check_name(kind, type_):
    """Raise UnknownTypeError unless it can be the name of a type, such as 'std_msgs/String'."""
    if not isinstance(type_, str) or not _TYPE.fullmatch(type_):
        hint = _near_types(kind, str(type_)[:99])
        raise UnknownTypeError(
            f"malformed {_KINDS[kind]} type {reprlib.repr(type_)}{hint}: give 'package/Type', in "
            "ASCII letters, digits and _, or a class"
        )


def find(kind, type_, must=True):
    """Return the class of a type or, where it has none yet, the text of its definition."""
    for look in _LOOKS:
        known = look(kind, type_)
        if known is not None:
            if look is _shipped:
                provisional.add((kind, type_))
            return known
    if not must:
        return None
    package, _, name = type_.partition('/')
    define = 'define_message' if kind == 'msg' else 'define_service'
    raise UnknownTypeError(
        f'unknown {_KINDS[kind]} type {type_!r}{_near_types(kind, type_)}: Python has no'
        f' {package}.{kind}.{name}, there is no {package}/{kind}/{name}.{kind} on ROS_PACKAGE_PATH'
        f' ({os.pathsep.join(rospkg.get_ros_paths())}), and no definition was given; install the'
        f' package {package} or call {define}({type_!r}, text)'
    )


def everywhere(kind, type_):
    """Return each class of a type, and each text of its definition, that is here."""
    try:
        check_name(kind, type_)
        everything = [look(kind, type_) for look in _LOOKS]
    except UnknownTypeError:
        return []
    return [known for known in everything if known is not None]


def _found_before(kind, type_):
    return found.get((kind, type_))


def installed(kind, type_):
    """Return the class that an installed Python package has for a type, None if there is none."""
    package = type_.partition('/')[0]
    if f'{package}.{kind}' not in sys.modules:
        # The name may come from the network: import no module that is not a package of messages.
        try:
            spec = importlib.util.find_spec(package)
        except ValueError:  # a module without __spec__
            return None
        folders = spec and spec.submodule_search_locations or ()
        if not any(os.path.isdir(os.path.join(folder, kind)) for folder in folders):
            return None
    get = genpy.message.get_message_class if kind == 'msg' else genpy.message.get_service_class
    try:
        return get(type_)
    except Exception as error:
        raise UnknownTypeError(
            f'{type_}: importing {package}.{kind} failed ({error}): reinstall it'
        ) from error


def file_text(kind, type_):
    """Return the text of the type's file on ROS_PACKAGE_PATH, None if there is none."""
    package, _, name = type_.partition('/')
    try:
        path = os.path.join(rospkg.RosPack().get_path(package), kind, f'{name}.{kind}')
        with open(path, encoding='utf-8', errors='replace') as file:
            return file.read(MAX_TEXT + 1)
    except Exception:
        # a package.xml that rospkg cannot parse must not hide the types given at run time
        return None


def _shipped(kind, type_):
    return DEFINITIONS[kind].get(type_)


_LOOKS = _found_before, installed, file_text, _shipped


def _near_types(kind, type_):
    """Return a hint at types with the same last name or one that differs by a slip."""
    import glob  # rospy does not load it, and most programs never come here

    rospack = rospkg.RosPack()
    folders = [os.path.join(glob.escape(folder), '*', kind, '_[A-Za-z]*.py') for folder in sys.path]
    try:
        folders += [
            os.path.join(glob.escape(rospack.get_path(name)), kind, '*.' + kind)
            for name in rospack.list()
        ]
    except Exception:  # as in file_text
        pass
    paths = [
        os.path.splitext(path)[0].split(os.sep) for folder in folders for path in glob.iglob(folder)
    ]
    names = {f"{path[-3]}/{path[-1].lstrip('_')}" for path in paths}
    names.update(
        DEFINITIONS[kind], (known for known_kind, known in list(found) if known_kind == kind)
    )
    last = '/' + type_.rpartition('/')[2]
    return suggest(type_, names, sorted(name for name in names if name.endswith(last))[:3])
