"""Find the generated class of a type, fill messages by name, and say why one cannot be sent."""
from __future__ import annotations

import re

from catkin_pkg.package import InvalidPackage
from genmsg.msgs import parse_type
from genpy.message import Message, check_type, get_message_class, get_service_class

from pharos.errors import MessageTypeError, UnknownTypeError
from pharos.intraprocess.copier import copy_of, nested_class

_TYPE = re.compile(r'[A-Za-z][A-Za-z0-9_]{0,127}/[A-Za-z][A-Za-z0-9_]{0,127}')


def generated_class(suffix: str, type_name: str | type):
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


def fields_text(cls: type[Message]) -> str:
    """Return the fields of a message class as text."""
    fields = zip(cls.__slots__, cls._slot_types)
    return ', '.join(f'{name}: {type_}' for name, type_ in fields) or 'no fields'


def build(cls: type[Message], block: object, fields: dict) -> Message:
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
    an empty response. A list for a response whose only field is an array is that array, unless its
    first item is a list: ``[1, 2]`` and ``[[1, 2]]`` both give an array of two numbers.

    :param cls: the class of the response
    :raises MessageTypeError, TypeError: if the response cannot be sent
    """
    message = value
    has_only_list = len(cls.__slots__) == 1 and cls._slot_types[0].endswith(']')
    if value is None and not cls.__slots__:
        message = cls()
    elif type(value) is dict:
        message = _fill(cls(), value)
    elif has_only_list and type(value) is list and not (value and type(value[0]) is list):
        message = cls(value)  # the only field, and not a list of the fields
    elif type(value) in (list, tuple):
        message = cls(*value)
    elif not isinstance(value, cls):
        message = cls(value)
    return checked_copy(message)


def checked_copy(message: Message) -> Message:
    """Return a copy of the message; raise MessageTypeError if it cannot be sent."""
    try:
        return copy_of(message)
    except Exception as error:
        raise explain(message, error) from error


def _fill(message: Message, fields: dict) -> Message:
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


def explain(message: Message, error: Exception) -> MessageTypeError:
    """Return a MessageTypeError for an exception of serializing; it names the field."""
    try:
        for name, type_name in zip(message.__slots__, message._slot_types):
            _check_list(name, type_name, getattr(message, name))
        message._check_types()
    except Exception as type_error:
        error = type_error
    return MessageTypeError(f'{message._type} cannot be sent: {error}: {str(message)[:200]!r}')


def _check_list(name: str, type_name: str, value) -> None:
    """Raise an exception if a list has the wrong length or a wrong item: genpy names neither."""
    base, is_array, length = parse_type(type_name)
    if not is_array or type(value) not in (list, tuple):
        return
    if length not in (None, len(value)):
        raise MessageTypeError(f'{name} takes {length} values, not {len(value)}')
    for index, item in enumerate(value):
        check_type(f'{name}[{index}]', base, item)
