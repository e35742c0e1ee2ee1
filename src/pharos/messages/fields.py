"""Fields of messages: described, filled by name, and checked against what the wire takes."""

import io
import re
import reprlib
import struct

import genpy
from genmsg.msgs import bare_msg_type, is_builtin, parse_type
from genpy.base import SIMPLE_TYPES_DICT

from pharos.errors import MessageTypeError, suggest

_TIMES = {'time': genpy.Time, 'duration': genpy.Duration}
# Raises where the value of a field of this type would not serialize, and is quick.
_WRITERS = {
    'string': str.encode,
    **{base: struct.Struct('<' + code).pack for base, code in SIMPLE_TYPES_DICT.items()},
}


def describe_fields(cls):
    """Return the fields of a message class as a text, for example ``'linear: float32, angular:
    float32'``."""
    return ', '.join('%s: %s' % field for field in _fields(cls)) or 'no fields'


def build(cls, block, fields):
    """Return a new message that ``block(message)``, if there is one, and then ``fields`` by name
    have filled.

    Raises `MessageTypeError` for a field that does not exist, for a value in ``fields`` that does
    not fit, and for a block that returns a message of its own.
    """
    message = cls()
    if block is not None:
        try:
            made = block(message)
        except AttributeError as error:
            explain(error, message)
            raise
        if isinstance(made, genpy.Message) and made is not message and made._type == message._type:
            raise MessageTypeError(
                f'the block returned another {message._type} than it was given, which is the one '
                'that is sent: fill the fields of that'
            )
    return fill(message, fields) if fields else message


def fill(message, fields):
    """Set fields of a message by name and return the message.

    A nested message may be given as a dict of those of its fields to be set. Raises
    `MessageTypeError` for a field that does not exist or a value that would not serialize; fields
    before it are set by then.
    """
    return _fill(message, fields, message._type)


def check_fits(message):
    """Raise `MessageTypeError`, naming field, value and what fits, if a message does not serialize.
    Slow."""
    try:
        message.serialize(io.BytesIO())
    except Exception as error:
        # genpy lets AttributeError, OverflowError and UnicodeEncodeError escape too
        for name, field_type in _fields(type(message)):
            _check_value(
                type(message), field_type, getattr(message, name, None), f'{message._type}.{name}'
            )
        raise MessageTypeError(
            f'{message._type} does not serialize: {error}; '
            f'its fields are {describe_fields(type(message))}'
        ) from error


def explain(error, message):
    """Raise `MessageTypeError` if an `AttributeError` names a field that the message, or one nested
    in it, has not."""
    wrong = re.match(r"'(\w+)' object has no attribute '(\w+)'", str(error))
    pending = [type(message)]
    while wrong and pending:
        cls = pending.pop(0)
        if cls.__name__ == wrong[1]:
            raise _no_field(cls, cls._type, wrong[2]) from error
        pending += nested_classes(cls)


def _fields(cls):
    if issubclass(cls, genpy.TVal):
        return [
            (name, 'uint32' if issubclass(cls, genpy.Time) else 'int32')
            for name in ('secs', 'nsecs')
        ]
    return zip(cls.__slots__, getattr(cls, '_slot_types', ()))  # rospy.AnyMsg has no _slot_types


def nested_class(cls, type_name):
    """Return the class that a message class's own code means by the name of a type among its
    fields.

    It is not always the installed class of that name: a class made at run time nests others made
    with it. None for a class written by hand that nests what is not installed.
    """
    if type_name in _TIMES:
        return _TIMES[type_name]
    if type_name == 'Header':
        type_name = 'std_msgs/Header'
    package, _, name = type_name.rpartition('/')
    package = package or cls._type.partition('/')[0]
    # of pharos.messages.definition
    made_together = getattr(cls, '_classes', {}).get(f'{package}/{name}')
    # a numpy_msg has its serialize from rospy, and these from the class that it derives from
    names = getattr(getattr(cls, 'serialize_numpy', None), '__globals__', {})
    # of genpy.dynamic, all in one module
    made_together = made_together or names.get(f'_{package}__{name}')
    imported = getattr(getattr(names.get(package), 'msg', None), name, None)
    return made_together or imported or genpy.message.get_message_class(f'{package}/{name}')


def nested_classes(cls):
    """Return the class of each field that holds messages, in a message class."""
    types = [bare_msg_type(field_type) for _, field_type in _fields(cls)]
    nested = [nested_class(cls, type_) for type_ in types if not is_builtin(type_)]
    return [cls for cls in nested if cls]  # None for one of a class written by hand


def _no_field(cls, path, name):
    names = [field for field, _ in _fields(cls)]
    return MessageTypeError(
        f'{path} has no field {name!r}{suggest(str(name), names)}; '
        f'its fields are {describe_fields(cls)}'
    )


def _fill(message, fields, path):
    field_types = dict(_fields(type(message)))
    for name, value in fields.items():
        if name not in field_types:
            raise _no_field(type(message), path, name)
        field_type = field_types[name]
        try:
            _WRITERS[field_type](value)
        except Exception:  # it is no single number or string, or does not fit
            field_path = f'{path}.{name}'
            value = _from_dicts(
                type(message), field_type, value, field_path, getattr(message, name)
            )
            _check_value(type(message), field_type, value, field_path)
        setattr(message, name, value)
    return message


def _from_dicts(cls, field_type, value, path, present=None):
    """Return a field's value with the dicts in it made messages; one for a single message goes into
    the ``present``."""
    base, is_array, _ = parse_type(field_type)
    if base in SIMPLE_TYPES_DICT or base == 'string':
        return value
    if is_array and isinstance(value, (list, tuple)):
        return [
            _from_dicts(cls, base, item, f'{path}[{index}]') for index, item in enumerate(value)
        ]
    if not is_array and isinstance(value, dict):
        nested = nested_class(cls, base) or type(present)
        return _fill(present if isinstance(present, nested) else nested(), value, path)
    return value


def _check_value(cls, field_type, value, path):
    """Raise MessageTypeError unless genpy would serialize the value: the same struct and str calls
    decide."""
    base, is_array, length = parse_type(field_type)
    code = SIMPLE_TYPES_DICT.get(base)
    try:
        if is_array:
            length = len(value) if length is None else length
            if code == 'B' and base != 'bool' and type(value) not in (list, tuple):
                struct.pack(f'{length}s', value)
            elif code:
                struct.pack(f'<{length}{code}', *value)
            else:
                if len(value) != length:
                    raise ValueError(value)
                for index, item in enumerate(value):
                    _check_value(cls, base, item, f'{path}[{index}]')
        elif code:
            struct.pack('<' + code, value)
        elif base == 'string':
            value.encode('utf-8')
        else:
            nested = nested_class(cls, base) or type(value)
            for name, nested_type in _fields(nested):
                _check_value(nested, nested_type, getattr(value, name), f'{path}.{name}')
    except MessageTypeError:
        raise
    except Exception as error:
        if code and isinstance(value, (list, tuple)):
            for index, item in enumerate(value):
                _check_value(cls, base, item, f'{path}[{index}]')
        raise MessageTypeError(
            f'{path} = {reprlib.repr(value)} does not fit {field_type}: '
            f'give {_what_fits(cls, field_type)}'
        ) from error


def _what_fits(cls, field_type):
    base, is_array, length = parse_type(field_type)
    code = SIMPLE_TYPES_DICT.get(base)
    if is_array:
        items = base if length is None else f'{length} {base}'
        return f'a list of {items}' + (' or bytes' if base in ('uint8', 'char') else '')
    if base in ('bool', 'string', 'float32', 'float64'):
        return {'bool': 'True or False', 'string': 'a str', 'float32': 'a number up to 3.4e38'}.get(
            base, 'a number'
        )
    if code:
        bits = 8 * struct.calcsize(code) - code.islower()
        return f'an integer from {-2 ** bits if code.islower() else 0} to {2 ** bits - 1}'
    nested = nested_class(cls, base)
    if nested is None:  # of a class written by hand
        return f'a {base}'
    name = getattr(nested, '_type', nested.__name__).rpartition('/')[2]
    return f'a {name} ({describe_fields(nested)})'
