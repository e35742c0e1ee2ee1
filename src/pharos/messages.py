"""Message and service types: find or make their classes, and fill messages by name."""
from __future__ import annotations

import pathlib
import re
from contextlib import suppress
from typing import Any, Callable

import rospkg
from catkin_pkg.package import InvalidPackage
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
shipped_definitions = {
    (suffix, type_name): text
    for suffix, type_name, text in re.findall(r'(\w+) (\S+)\n(.*?\n)\n', _TURTLESIM, re.S)
}
given_definitions: dict[tuple[str, str], str] = {}  #: as shipped_definitions


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
    installed_class = class_of_package('msg', type_)
    if installed_class:
        return installed_class
    from pharos.definitions import make_message

    return make_message(type_, find_definition('msg', type_, ask))


def service_class(type_: Any) -> Any:
    """Return the class of a service type such as ``'std_srvs/Empty'``; see :func:`message_class`.

    :raises UnknownTypeError: if the type is not found, or its definition cannot be read
    """
    if hasattr(type_, '_request_class'):
        return type_
    installed_class = class_of_package('srv', type_)
    if installed_class:
        return installed_class
    from pharos.definitions import make_service

    return make_service(type_, find_definition('srv', type_))


def define_message(type_: str, text: str) -> type[Message]:
    """Define a message type by the text of a ``.msg`` file, and return its class.

    Texts of unknown nested types follow, each after a line of ``=`` and ``MSG: package/Type``.

    :raises MessageTypeError: if the type is known already, with other fields
    :raises UnknownTypeError: if the text cannot be read, or a nested type is not found
    """
    from pharos.definitions import define, make_message

    return define('msg', type_, text, message_class, make_message)


def define_service(type_: str, text: str) -> Any:
    """Define a service type by the text of a ``.srv`` file, as :func:`define_message` does."""
    from pharos.definitions import define, make_service

    return define('srv', type_, text, service_class, make_service)


def class_of_package(suffix, type_name):
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


def find_definition(suffix, type_name, ask=None):
    """Return the definition of a type that has no generated class, or raise UnknownTypeError."""
    package, name = type_name.split('/')
    # there may be no file, or the package.xml of another package cannot be parsed
    with suppress(Exception):
        folder = pathlib.Path(rospkg.RosPack().get_path(package), suffix)
        return (folder / f'{name}.{suffix}').read_text('utf-8', 'replace')
    key = suffix, type_name
    if ask and key not in shipped_definitions:
        definition = ask(type_name)
        if isinstance(definition, str):
            return definition
    for definitions in given_definitions, shipped_definitions:
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
        or a ready message; or the value of the only field; or None
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
    elif block is not None and len(cls.__slots__) == 1:
        fields = {cls.__slots__[0]: block, **fields}
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
            value = _fill(nested_class(base_type, cls)(), value)
        elif type(value) is list and dict in map(type, value):
            item_class = nested_class(base_type, cls)
            value = [_fill(item_class(), each) if type(each) is dict else each for each in value]
        setattr(message, name, value)
    return message


def explain(message, error):
    """Return a MessageTypeError for an exception of serializing; genpy's check names the field."""
    try:
        message._check_types()
    except Exception as type_error:
        error = type_error
    return MessageTypeError(f'{message._type} cannot be sent: {error}: {str(message)[:200]!r}')
