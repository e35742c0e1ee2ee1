"""Where the types of messages and services are known: found before, installed, in files, or shipped
for turtlesim."""
import contextlib
import importlib.util
import os
import pathlib
import re
import reprlib
import sys
from typing import Any, Dict, List, Optional, Set, Tuple, Union

import genpy
import rospkg

from pharos.errors import UnknownTypeError, suggest
from pharos.messages.turtlesim import DEFINITIONS

MAX_TEXT = 1 << 20  # characters of a definition with those nested in it
NAME = re.compile('[A-Za-z][A-Za-z0-9_]{0,127}')
_TYPE = re.compile(f'{NAME.pattern}/{NAME.pattern}')
_KINDS = {'msg': 'message', 'srv': 'service'}

Known = Union[type, str]  # the class of a type, or the text of its definition
Key = Tuple[str, str]  # 'msg' or 'srv', and the type

found: Dict[Key, type] = {}  # answered before or defined, so that two asks give the same one
# keys of found that no package here has: to a subscriber, a live publisher knows better
provisional: Set[Key] = set()


def check_name(kind: str, type_: Any) -> None:
    """Raise UnknownTypeError unless it can be the name of a type, such as 'std_msgs/String'."""
    if not isinstance(type_, str) or not _TYPE.fullmatch(type_):
        hint = _near_types(kind, str(type_)[:99])
        raise UnknownTypeError(
            f"malformed {_KINDS[kind]} type {reprlib.repr(type_)}{hint}: give 'package/Type', in "
            f"ASCII letters, digits and _, or a class{_misplaced(type_)}"
        )


def find(kind: str, type_: str) -> Known:
    """The class of a type or, where it has none yet, the text of its definition.

    :raises UnknownTypeError: if it is not known here
    """
    known = found.get((kind, type_)) or installed(kind, type_) or file_text(kind, type_)
    if known is not None:
        return known
    if type_ in DEFINITIONS[kind]:
        provisional.add((kind, type_))
        return DEFINITIONS[kind][type_]
    package, _, name = type_.partition('/')
    other = 'srv' if kind == 'msg' else 'msg'
    if type_ in known_types(other):
        raise UnknownTypeError(
            f'unknown {_KINDS[kind]} type {type_!r}: that is the type of a {_KINDS[other]}'
        )
    define = 'define_message' if kind == 'msg' else 'define_service'
    raise UnknownTypeError(
        f'unknown {_KINDS[kind]} type {type_!r}{_near_types(kind, type_)}: Python has no'
        f' {package}.{kind}.{name}, there is no {package}/{kind}/{name}.{kind} on ROS_PACKAGE_PATH'
        f' ({os.pathsep.join(rospkg.get_ros_paths())}), and no definition was given; install the'
        f' package {package} or call {define}({type_!r}, text)'
    )


def everywhere(kind: str, type_: str) -> List[Known]:
    """Each class of a type, and each text of its definition, that is here."""
    try:
        check_name(kind, type_)
        everything = (
            found.get((kind, type_)),
            installed(kind, type_),
            file_text(kind, type_),
            DEFINITIONS[kind].get(type_),
        )
    except UnknownTypeError:
        return []
    return [known for known in everything if known is not None]


def installed(kind: str, type_: str) -> Optional[type]:
    """The class that an installed Python package has for a type, None if there is none."""
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
        cls: Optional[type] = get(type_)
        # the class of a request is in the same module as that of its service
        return cls if kind == 'msg' or hasattr(cls, '_request_class') else None
    except Exception as error:
        raise UnknownTypeError(
            f'{type_}: importing {package}.{kind} failed ({error}): reinstall it'
        ) from error


def file_text(kind: str, type_: str) -> Optional[str]:
    """The text of the type's file on ROS_PACKAGE_PATH, None if there is none."""
    package, _, name = type_.partition('/')
    # a package.xml that rospkg cannot parse must not hide the types given at run time
    with contextlib.suppress(Exception):
        path = os.path.join(rospkg.RosPack().get_path(package), kind, f'{name}.{kind}')
        with open(path, encoding='utf-8', errors='replace') as file:
            return file.read(MAX_TEXT + 1)
    return None


def known_types(kind: str) -> Set[str]:
    """The names of all types that are known here, without importing any; looks into the folders of
    all packages.

    :param kind: 'msg' or 'srv'
    """
    files = [
        file for folder in sys.path for file in pathlib.Path(folder).glob(f'*/{kind}/_[A-Za-z]*.py')
    ]
    with contextlib.suppress(Exception):  # as in file_text
        rospack = rospkg.RosPack()
        for package in rospack.list():
            files += pathlib.Path(rospack.get_path(package)).glob(f'{kind}/*.{kind}')
    names = {f"{file.parts[-3]}/{file.stem.lstrip('_')}" for file in files}
    names.update(DEFINITIONS[kind], (type_ for known_kind, type_ in [*found] if known_kind == kind))
    return names


def _misplaced(type_: Any) -> str:
    """The hint at what was given in the place of a type."""
    if hasattr(type_, '_request_class'):
        return '; this is the class of a service'
    if isinstance(type_, type) and issubclass(type_, genpy.Message):
        return '; this is the class of a message'
    if callable(type_):
        return '; a block comes after the type, or by its keyword'
    return '; it comes after the name' if str(type_).startswith('/') else ''


def _near_types(kind: str, type_: str) -> str:
    """A hint at types with the same last name or one that differs by a slip."""
    names = known_types(kind)
    last = '/' + type_.rpartition('/')[2]
    return suggest(type_, names, sorted(name for name in names if name.endswith(last))[:3])
