"""Message and service types: find or make their classes, and fill messages by name."""
from __future__ import annotations

import functools
import pathlib
import re
import threading
from contextlib import suppress
from typing import Any, Callable

import genmsg
import rospkg
from catkin_pkg.package import InvalidPackage
from genmsg.msg_loader import load_depends, load_msg_from_string, load_srv_from_string
from genmsg.msgs import bare_msg_type, is_builtin
from genpy.dynamic import generate_dynamic
from genpy.message import Message, get_message_class, get_service_class
from rospy.impl.tcpros_service import convert_return_to_response

from pharos.errors import MessageTypeError, UnknownTypeError
from pharos.intraprocess.copier import copy_of, nested_class

_TYPE = re.compile(r'[A-Za-z][A-Za-z0-9_]{0,127}/[A-Za-z][A-Za-z0-9_]{0,127}')
#: turtlesim's types as in ROS Fuerte, which the report uses; Debian has none
_TURTLESIM = '''
msg turtlesim/Color
uint8 r
uint8 g
uint8 b

msg turtlesim/Pose
float32 x
float32 y
float32 theta
float32 linear_velocity
float32 angular_velocity

msg turtlesim/Velocity
float32 linear
float32 angular

srv turtlesim/Kill
string name
---

srv turtlesim/SetPen
uint8 r
uint8 g
uint8 b
uint8 width
uint8 off
---

srv turtlesim/Spawn
float32 x
float32 y
float32 theta
string name
---
string name

srv turtlesim/TeleportAbsolute
float32 x
float32 y
float32 theta
---

srv turtlesim/TeleportRelative
float32 linear
float32 angular
---

'''
#: (suffix, type) -> definition; the suffix is msg or srv
_shipped_definitions = {
    (suffix, type_name): text
    for suffix, type_name, text in re.findall(r'(\w+) (\S+)\n(.*?\n)\n', _TURTLESIM, re.S)
}
_given_definitions = {}
_lock = threading.RLock()  # genpy's generator is not thread-safe


def message_class(type_: str | type, ask: Callable | None = None) -> type[Message]:
    """Return the class of a message type, such as ``'geometry_msgs/Twist'``.

    A type is sought in installed Python packages, then in ``.msg`` files on ROS_PACKAGE_PATH, then
    by ``ask``. The last places are the types given to :func:`define_message`, and turtlesim's.

    :param type_: the name of the type; or a message class, which is returned
    :param ask: ``ask(type_)`` returns the definition that a publisher sends, or None
    :raises UnknownTypeError: if the type is not found, or its definition cannot be read
    """
    if isinstance(type_, type) and issubclass(type_, Message):
        return type_
    installed_class = _installed_class('msg', type_)
    if installed_class:
        return installed_class
    return _make_message(type_, _find_definition('msg', type_, ask))


def service_class(type_: Any) -> Any:
    """Return the class of a service type such as ``'std_srvs/Empty'``; see :func:`message_class`.

    :raises UnknownTypeError: if the type is not found, or its definition cannot be read
    """
    if hasattr(type_, '_request_class'):
        return type_
    installed_class = _installed_class('srv', type_)
    if installed_class:
        return installed_class
    return _make_service(type_, _find_definition('srv', type_))


def define_message(type_: str, text: str) -> type[Message]:
    """Define a message type by the text of a ``.msg`` file, and return its class.

    Texts of unknown nested types follow, each after a line of ``=`` and ``MSG: package/Type``.

    :raises MessageTypeError: if the type is known already, with other fields
    :raises UnknownTypeError: if the text cannot be read, or a nested type is not found
    """
    return _define('msg', type_, text, message_class, _make_message)


def define_service(type_: str, text: str) -> Any:
    """Define a service type by the text of a ``.srv`` file, as :func:`define_message` does."""
    return _define('srv', type_, text, service_class, _make_service)


def _define(suffix, type_name, text, find_class, make_class):
    new_class = make_class(type_name, text)
    key = suffix, type_name
    with suppress(UnknownTypeError):
        known_class = find_class(type_name)
        is_shipped = key in _shipped_definitions  # a real turtlesim may have other fields
        if _checksums(known_class) != _checksums(new_class) and not is_shipped:
            raise MessageTypeError(f'{type_name} is known with other fields: define another type')
    _given_definitions.setdefault(key, text)
    return find_class(type_name)


def _checksums(cls):
    """Return the md5sums of a class, and of a service's request: equal for equal fields."""
    return cls._md5sum, getattr(cls, '_request_class', cls)._md5sum


def _installed_class(suffix, type_name):
    """Return the class of a type that an installed Python package has, or None."""
    if not (isinstance(type_name, str) and _TYPE.fullmatch(type_name)):
        raise UnknownTypeError(
            f"malformed type {type_name!r}: give 'package/Type', such as 'std_msgs/String', or a class"
        )
    get_class = get_message_class if suffix == 'msg' else get_service_class
    try:
        return get_class(type_name)
    except InvalidPackage:  # genpy cannot read package.xml; the package may still have a .msg file
        return None


def _find_definition(suffix, type_name, ask=None):
    """Return the definition of a type that has no generated class, or raise UnknownTypeError."""
    package, name = type_name.split('/')
    # there may be no file, or the package.xml of another package cannot be parsed
    with suppress(Exception):
        folder = pathlib.Path(rospkg.RosPack().get_path(package), suffix)
        return (folder / f'{name}.{suffix}').read_text('utf-8', 'replace')
    key = suffix, type_name
    if ask and key not in _shipped_definitions:
        definition = ask(type_name)
        if isinstance(definition, str):
            return definition
    for definitions in _given_definitions, _shipped_definitions:
        if key in definitions:
            return definitions[key]
    function_name = 'define_message' if suffix == 'msg' else 'define_service'
    raise UnknownTypeError(
        f'unknown type {type_name!r}: Python has no {package}.{suffix}.{name}, there is no'
        f' {package}/{suffix}/{name}.{suffix} on ROS_PACKAGE_PATH'
        f' ({":".join(rospkg.get_ros_paths())}), and no definition was given; install {package} (on'
        f' Debian python3-{package.replace("_", "-")}), source its workspace, or call'
        f' {function_name}(type, text)'
    )


class _Definition:
    """A definition as genmsg reads it, with the definitions of all nested types.

    :ivar context: genmsg's context, with all types
    :ivar text: the text of the type alone
    :ivar nested_texts: names of nested types -> their texts
    """

    def __init__(self, type_name, text):
        self.context = genmsg.MsgContext.create_default()
        self.nested_texts = {}
        own_text, *parts = re.split(r'\n=+[ \t]*\nMSG: *', f'\n{text}')
        self.text = own_text[1:]
        self._given_texts = {}
        for part in parts:
            name, _, nested_text = part.partition('\n')
            self._given_texts[name.strip()] = nested_text
        for part in re.split(r'^---.*$', own_text, flags=re.M):  # a service has two parts
            self._add_nested(type_name, part)

    def _add_nested(self, type_name, text):
        """Read the text of a type, and add the types of its fields, and those nested in them."""
        spec = load_msg_from_string(self.context, text, type_name)
        for field_type in map(bare_msg_type, spec.types):
            name = 'std_msgs/Header' if field_type == 'Header' else field_type
            if is_builtin(name) or name in self.nested_texts:
                continue
            nested_text = self._given_texts.get(name)
            if nested_text is None:
                nested_text = _nested_definition(name)
            self.nested_texts[name] = nested_text
            # other types may nest this one without its definition
            _given_definitions.setdefault(('msg', name), nested_text)
            self._add_nested(name, nested_text)

    @property
    def nested_part(self):
        """The texts of the nested types, as they follow in a full definition."""
        texts = self.nested_texts.items()
        return ''.join(f'\n{"=" * 80}\nMSG: {name}\n{text}' for name, text in texts)


def _nested_definition(type_name):
    """Return the definition of a nested type, without the texts of further nested types."""
    installed_class = _installed_class('msg', type_name)
    if installed_class:
        text = installed_class._full_text
    else:
        text = _find_definition('msg', type_name)
    return re.split(r'\n=+[ \t]*\n', text)[0]


def _once(make_class):
    """Return a function that runs once for the same arguments, in one thread at a time.

    Each exception becomes an UnknownTypeError.
    """
    cached_function = functools.lru_cache(None)(make_class)

    def make_once(type_name, text):
        try:
            with _lock:
                return cached_function(type_name, text)
        except Exception as error:
            raise UnknownTypeError(f'{type_name}: no class can be made of it: {error}') from error

    return make_once


@_once
def _make_message(type_name, text):
    definition = _Definition(type_name, text)
    full_text = definition.text + definition.nested_part
    classes = generate_dynamic(type_name, f'{full_text}\n')
    cls = classes[type_name]
    cls._full_text = full_text
    cls._classes = classes  # for the copier
    for name in definition.nested_texts:  # genpy has made classes of these, too
        known_class = message_class(name)
        if known_class._md5sum == classes[name]._md5sum:
            classes[name] = known_class
            # genpy's deserialize() makes nested messages of this name
            cls.serialize.__globals__['_' + name.replace('/', '__')] = known_class
    return cls


@_once
def _make_service(type_name, text):
    definition = _Definition(type_name, text)
    spec = load_srv_from_string(definition.context, definition.text, type_name)
    load_depends(definition.context, spec, {})
    nested_part = definition.nested_part
    attributes = {
        '_type': type_name,
        '_md5sum': genmsg.compute_md5(definition.context, spec),
        '_request_class': _make_message(f'{type_name}Request', spec.request.text + nested_part),
        '_response_class': _make_message(f'{type_name}Response', spec.response.text + nested_part),
    }
    return type(spec.short_name, (), attributes)


# -- filling


def fields_text(cls):
    """Return the fields of a message class as text."""
    fields = zip(cls.__slots__, cls._slot_types)
    return ', '.join(f'{name}: {type_}' for name, type_ in fields) or 'no fields'


def build(cls, block, fields):
    """Return a message that is filled by a block and by keywords, or a ready message.

    Dicts fill nested messages, and a list of dicts fills an array of them. numpy arrays may stand
    for arrays of numbers.

    :param cls: the message class
    :param block: ``block(message)`` fills the message or returns another one; or a dict of fields;
        or a ready message; or None
    :param fields: a dict of fields, which are set last
    :raises MessageTypeError: for a field that does not exist, or another kind of block
    """
    message = cls()
    if isinstance(block, Message):
        message = block
    elif isinstance(block, dict):
        fields = {**block, **fields}
    elif callable(block):
        returned_value = block(message)
        if isinstance(returned_value, Message):
            message = returned_value
    elif block is not None:
        raise MessageTypeError(
            f'{cls._type} is filled by a block, a dict or keywords, or is a message; not {block!r}'
        )
    return _fill(message, fields)


def response(cls, value):
    """Return the response for the value that the block of a service returned.

    The value is a response, a dict, tuple or list of its fields, or its only field. None stands for
    an empty response.

    :param cls: the class of the response
    :raises MessageTypeError: if the response cannot be sent
    """
    names = cls.__slots__
    if value is None and not names:
        value = {}
    elif len(names) == 1 and type(value) is list and cls._slot_types[0].endswith(']'):
        has_fields = value and type(value[0]) is list  # a list of fields, or the only field
        if not has_fields:
            value = {names[0]: value}
    if type(value) is dict:
        return checked_copy(_fill(cls(), value))
    return checked_copy(convert_return_to_response(value, cls))


def checked_copy(message):
    """Return a copy of the message; raise MessageTypeError if it cannot be sent."""
    try:
        return copy_of(message)
    except Exception as error:
        raise explain(message, error) from error


def _fill(message, fields):
    cls = type(message)
    types = dict(zip(cls.__slots__, cls._slot_types))
    for name, value in fields.items():
        if name not in types:
            raise MessageTypeError(f'{cls._type} has no field {name!r}; it has {fields_text(cls)}')
        base_type = types[name].partition('[')[0]
        if type(value) is dict:
            value = _fill(_class_of_field(base_type, cls)(), value)
        elif type(value) is list and value and type(value[0]) is dict:
            value = [_fill(_class_of_field(base_type, cls)(), item) for item in value]
        setattr(message, name, value)
    return message


def _class_of_field(base_type, cls):
    """Return the class of a nested field; genpy.dynamic has these classes in one module."""
    made_class = cls.serialize.__globals__.get('_' + base_type.replace('/', '__'))
    return made_class or nested_class(base_type, cls)


def explain(message, error):
    """Return a MessageTypeError for an exception of serializing; genpy's check names the field."""
    try:
        message._check_types()
    except Exception as type_error:
        error = type_error
    return MessageTypeError(f'{message._type} cannot be sent: {error}: {str(message)[:200]!r}')
