"""Find the class of a message or service type, or make one at run time from its definition."""
from __future__ import annotations

import functools
import importlib.util
import os
import re
import threading
from typing import Any, Callable

import genmsg
import genpy.dynamic
import rospkg
from genmsg.msgs import bare_msg_type, is_builtin

from pharos.errors import MessageTypeError, UnknownTypeError

_TYPE = re.compile(r'[A-Za-z][A-Za-z0-9_]{0,127}/[A-Za-z][A-Za-z0-9_]{0,127}')
_RULE = '=' * 80
_COLOUR = 'uint8 r\nuint8 g\nuint8 b\n'
_PLACE = 'float32 x\nfloat32 y\nfloat32 theta\n'
_VELOCITY = 'float32 linear\nfloat32 angular\n'
#: the definitions of turtlesim's types as in ROS Fuerte, which the report uses; Debian has none
TURTLESIM = {
    ('msg', 'turtlesim/Color'): _COLOUR,
    ('msg', 'turtlesim/Pose'): _PLACE + '\nfloat32 linear_velocity\nfloat32 angular_velocity\n',
    ('msg', 'turtlesim/Velocity'): _VELOCITY,
    ('srv', 'turtlesim/Kill'): 'string name\n---\n',
    ('srv', 'turtlesim/SetPen'): _COLOUR + 'uint8 width\nuint8 off\n---\n',
    ('srv', 'turtlesim/Spawn'): _PLACE + 'string name\n---\nstring name\n',
    ('srv', 'turtlesim/TeleportAbsolute'): _PLACE + '---\n',
    ('srv', 'turtlesim/TeleportRelative'): _VELOCITY + '---\n',
}
_defined: dict[tuple[str, str], str] = {}
_lock = threading.RLock()  # genpy's generator is not thread-safe


def message_class(type_: str | type) -> type[genpy.Message]:
    """Return the class of a message type, such as ``'geometry_msgs/Twist'``.

    Types are sought in installed Python packages, in ``.msg`` files on ROS_PACKAGE_PATH, among those
    given to :func:`define_message`, and among turtlesim's. A message class is returned as it is.

    :raises UnknownTypeError: if the type is nowhere, or its definition cannot be read
    """
    if isinstance(type_, type) and issubclass(type_, genpy.Message):
        return type_
    return _installed('msg', type_) or _made_message(type_, text_of('msg', type_))


def service_class(type_: str | type) -> type:
    """Return the class of a service type, sought as :func:`message_class` does."""
    if hasattr(type_, '_request_class'):
        return type_
    return _installed('srv', type_) or _made_service(type_, text_of('srv', type_))


def define_message(type_: str, text: str) -> type[genpy.Message]:
    """Define a message type by the text of a ``.msg`` file, and return its class.

    Nested types follow after a line of ``=`` and ``MSG: package/Type``, if they are not known.

    :raises MessageTypeError: if the type is known already, with other fields
    """
    return _define('msg', type_, text, message_class, _made_message)


def define_service(type_: str, text: str) -> type:
    """Define a service type by the text of a ``.srv`` file, as :func:`define_message` does."""
    return _define('srv', type_, text, service_class, _made_service)


def _define(kind: str, type_: str, text: str, find: Callable, make: Callable) -> type:
    check_name(type_)
    if not isinstance(text, str):
        raise UnknownTypeError(f'the definition of {type_} is a str, not {text!r}')
    cls = make(type_, text)
    known = cls
    if (kind, type_) not in TURTLESIM:
        try:
            known = find(type_)
        except UnknownTypeError:
            pass
    if known._md5sum != cls._md5sum:
        raise MessageTypeError(f'{type_} is known with other fields: define another type')
    _defined.setdefault((kind, type_), text)
    for name, nested in _Definition(type_, text).nested.items():
        if not _installed('msg', name):
            _defined.setdefault(('msg', name), nested)
    return find(type_)


def check_name(type_: Any) -> None:
    """Raise UnknownTypeError unless it can be the name of a type."""
    if not (isinstance(type_, str) and _TYPE.fullmatch(type_)):
        raise UnknownTypeError(
            f"malformed type {type_!r}: give 'package/Type', such as 'std_msgs/String', or a class"
        )


@functools.lru_cache(None)
def _has_messages(package: str, kind: str) -> bool:
    """True if a Python package has generated messages; no other is ever imported for its name."""
    try:
        spec = importlib.util.find_spec(package)
    except ValueError:  # a module without a spec
        return False
    folders = spec and spec.submodule_search_locations or ()
    return any(os.path.isdir(os.path.join(folder, kind)) for folder in folders)


def _installed(kind: str, type_: str) -> type | None:
    check_name(type_)
    if (kind, type_) in _defined or not _has_messages(type_.partition('/')[0], kind):
        return None
    get = genpy.message.get_message_class if kind == 'msg' else genpy.message.get_service_class
    cls = get(type_)
    return cls if kind == 'msg' or hasattr(cls, '_request_class') else None


def text_of(kind: str, type_: str) -> str:
    """Return the definition of a type that has no generated class."""
    package, name = type_.split('/')
    if (kind, type_) in _defined:
        return _defined[kind, type_]
    try:
        path = f'{rospkg.RosPack().get_path(package)}/{kind}/{name}.{kind}'
        with open(path, encoding='utf-8', errors='replace') as file:
            return file.read()
    except Exception:  # there is none; or another package.xml cannot be parsed
        pass
    if (kind, type_) in TURTLESIM:
        return TURTLESIM[kind, type_]
    define = 'define_message' if kind == 'msg' else 'define_service'
    raise UnknownTypeError(
        f'unknown type {type_!r}: Python has no {package}.{kind}.{name}, there is no'
        f' {package}/{kind}/{name}.{kind} on ROS_PACKAGE_PATH ({":".join(rospkg.get_ros_paths())}),'
        f' and no definition was given; install {package} or call {define}({type_!r}, text)'
    )


class _Definition:
    """A definition with all that it nests.

    :ivar own: its text, without those that it nests
    :ivar nested: the texts of nested types, by type
    """

    def __init__(self, type_: str, text: str):
        self.type, self.nested = type_, {}
        self.context = genmsg.MsgContext.create_default()
        self.own, *parts = re.split(r'\n=+[ \t]*\nMSG: *', '\n' + text)
        self.own = self.own[1:]
        given = {part.partition('\n')[0].strip(): part.partition('\n')[2] for part in parts}
        for part in re.split(r'^---.*$', self.own, flags=re.M):  # of a service there are two
            self._add_nested(type_, part, given)

    def _add_nested(self, name: str, text: str, given: dict[str, str]) -> None:
        try:
            spec = genmsg.msg_loader.load_msg_from_string(self.context, text, name)
        except Exception as error:
            raise UnknownTypeError(
                f'{self.type}: the definition of {name} cannot be read: {error}'
            ) from error
        for field in map(bare_msg_type, spec.types):
            field = 'std_msgs/Header' if field == 'Header' else field
            if is_builtin(field) or field in self.nested:
                continue
            if field not in given:
                installed = _installed('msg', field)
                full = installed._full_text if installed else text_of('msg', field)
                given = {**given, field: re.split(r'\n=+[ \t]*\n', full)[0]}
            self.nested[field] = given[field]
            self._add_nested(field, given[field], given)

    @property
    def tail(self) -> str:
        """The nested definitions, as they follow in a full text."""
        return ''.join(f'\n{_RULE}\nMSG: {name}\n{text}' for name, text in self.nested.items())


@functools.lru_cache(None)
def _made_message(type_: str, text: str) -> type[genpy.Message]:
    with _lock:
        definition = _Definition(type_, text)
        try:
            classes = genpy.dynamic.generate_dynamic(type_, definition.own + definition.tail + '\n')
        except Exception as error:
            raise UnknownTypeError(f'{type_}: no class can be made of it: {error}') from error
        for cls in classes.values():
            cls._classes = classes  # for the copier
        return classes[type_]


class_from_definition = _made_message


@functools.lru_cache(None)
def _made_service(type_: str, text: str) -> type:
    with _lock:
        definition = _Definition(type_, text)
        try:
            spec = genmsg.msg_loader.load_srv_from_string(definition.context, definition.own, type_)
            genmsg.msg_loader.load_depends(definition.context, spec, {})
            md5sum = genmsg.compute_md5(definition.context, spec)
        except Exception as error:
            raise UnknownTypeError(f'{type_}: its definition cannot be read: {error}') from error
        request, response = (
            _made_message(f'{type_}{kind}', part.text + definition.tail)
            for kind, part in (('Request', spec.request), ('Response', spec.response))
        )
        attributes = {'_request_class': request, '_response_class': response}
        return type(spec.short_name, (), {'_type': type_, '_md5sum': md5sum, **attributes})
