"""Fields of messages: described, filled by name, and checked against what the wire takes.

genpy's own check_type and fill_message_args are not used. check_type refuses a string with 'é', and
lets 1e300 into a float32; fill_message_args puts 5 into a string, which fails when it is sent.
"""
import io
import re
import reprlib
import struct
from typing import Any, Callable, Dict, List, Optional, Tuple, Type

import genpy
from genmsg.msgs import bare_msg_type, is_builtin, parse_type
from genpy.base import SIMPLE_TYPES_DICT

from pharos.errors import MessageTypeError, PharosError, suggest
from pharos.signals import is_from_signal

MessageClass = Type[genpy.Message]

_TIMES = {'time': genpy.Time, 'duration': genpy.Duration}
# Raises where the value of a field of this type would not serialize, and is quick.
_WRITERS: Dict[str, Callable[[Any], bytes]] = {
    'string': str.encode,
    **{base: struct.Struct('<' + code).pack for base, code in SIMPLE_TYPES_DICT.items()},
}
_WHAT_FITS = {
    'bool': 'True or False',
    'string': 'a str',
    'float32': 'a number up to 3.4e38',
    'float64': 'a number',
    'time': 'a rospy.Time, such as node.ros.Time.now()',
    'duration': 'a rospy.Duration, such as node.ros.Duration(1.5)',
}


def fields_of(cls: MessageClass) -> List[Tuple[str, str]]:
    """The (name, type) of each field of a message class, of genpy.Time or genpy.Duration."""
    if issubclass(cls, genpy.TVal):
        # as genmsg has it; their _slot_types say int32 for both
        number = 'uint32' if issubclass(cls, genpy.Time) else 'int32'
        return [('secs', number), ('nsecs', number)]
    # rospy.AnyMsg has no _slot_types
    return list(zip(cls.__slots__, getattr(cls, '_slot_types', ())))


def describe_fields(cls: MessageClass) -> str:
    """The fields of a message class as a text, for example ``'linear: float32, angular:
    float32'``."""
    return ', '.join(f'{name}: {type_}' for name, type_ in fields_of(cls)) or 'no fields'


def nested_class(cls: MessageClass, type_name: str) -> Optional[MessageClass]:
    """The class that a message class's own code means by the name of a type among its fields.

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


def nested_classes(cls: MessageClass) -> List[MessageClass]:
    """The class of each field that holds messages, in a message class."""
    types = [bare_msg_type(field_type) for _, field_type in fields_of(cls)]
    nested = [nested_class(cls, type_) for type_ in types if not is_builtin(type_)]
    return [cls for cls in nested if cls]  # None for one of a class written by hand


def check_not_hidden(cls: Optional[MessageClass], filler: Any, **own: Any) -> None:
    """Raise TypeError where a field of a message has the name of a keyword that a call has for
    itself, and which it was given: it may be meant for the field.

    :param cls: None: it is not known yet
    :param filler: what fills the message beside keywords; where there is that, these are the call's
    :param own: the keywords, None: it was not given
    """
    for name, value in own.items():
        is_given = filler is None and value is not None
        if cls is not None and is_given and name in cls.__slots__:
            raise TypeError(
                f'{cls._type} has a field {name!r}, and this call a keyword {name}= of its own: give'
                f' the fields in a dict, {{{name!r}: {reprlib.repr(value)}}}, and {name}= beside it'
                ' is the keyword'
            )


def check_alone(message: genpy.Message, fields: Dict[str, Any]) -> None:
    """Raise TypeError where fields are given beside a message that is ready."""
    if fields:
        raise TypeError(
            f'a ready {message._type} is sent as it is, without {", ".join(fields)}: set that in the'
            ' message before, or give all fields as keywords instead of it'
        )


def ready_or_built(
    cls: MessageClass, filler: Any, fields: Dict[str, Any], service: str
) -> genpy.Message:
    """The request of a call: ``filler`` where it is one that is ready, else as :func:`build` has it.

    :param service: the name of the service
    :raises MessageTypeError: if it is another message
    """
    if not isinstance(filler, genpy.Message):
        return build(cls, filler, fields)
    if filler._md5sum != cls._md5sum:
        raise MessageTypeError(
            f'{service} is called with a {cls._type} ({describe_fields(cls)}), not {filler._type}'
        )
    check_alone(filler, fields)
    return filler


def build(cls: MessageClass, filler: Any, fields: Dict[str, Any]) -> genpy.Message:
    """A new message that is filled by ``filler(message)``, or by the fields in it where it is a
    dict, and then by ``fields`` by name.

    :raises MessageTypeError: for a field that does not exist, for a value in ``fields`` that does
        not fit, and for a block that returns a message of its own, or a value instead of setting
        fields
    """
    message = cls()
    if isinstance(filler, dict):
        return fill(message, {**filler, **fields})
    if filler is not None:
        try:
            made = filler(message)
        except AttributeError as error:
            explain(error, message)
            raise
        if isinstance(made, genpy.Message) and made is not message and made._type == message._type:
            raise MessageTypeError(
                f'the block returned another {message._type} than it was given, which is the one '
                'that is sent: fill the fields of that'
            )
        if made is not None and made is not message and _is_empty(message):
            raise MessageTypeError(
                f'the block returned {reprlib.repr(made)} and set no field of the {message._type}'
                f' that it was given ({describe_fields(cls)}): it is to set these'
            )
    return fill(message, fields) if fields else message


def _is_empty(message: genpy.Message) -> bool:
    """Whether no field of it has been set, and there are any."""
    try:
        return bool(message.__slots__) and message == type(message)()
    except Exception:  # numpy's arrays compare otherwise
        return False


def fill(message: genpy.Message, fields: Dict[str, Any]) -> genpy.Message:
    """Set fields of a message by name; returns the message.

    A nested message may be given as a dict of those of its fields to be set.

    :raises MessageTypeError: for a field that does not exist or a value that would not serialize;
        fields before it are set by then
    """
    return _fill(message, fields, message._type)


def check_fits(message: genpy.Message) -> None:
    """Raise `MessageTypeError`, naming field, value and what fits, if a message does not serialize.
    Slow."""
    try:
        message.serialize(io.BytesIO())
    except MemoryError as error:
        raise PharosError(
            f'no memory to serialize {type(message)._type} for subscribers elsewhere: send less at'
            ' once, or raise ulimit -v, or what a container may have'
        ) from error
    except Exception as error:
        # genpy lets AttributeError, OverflowError and UnicodeEncodeError escape too
        cls = type(message)
        for name, field_type in fields_of(cls):
            _check(cls, field_type, getattr(message, name, None), f'{cls._type}.{name}')
        raise MessageTypeError(
            f'{cls._type} does not serialize: {error}; its fields are {describe_fields(cls)}'
        ) from error


def explain(error: AttributeError, message: genpy.Message) -> None:
    """Raise `MessageTypeError` if an `AttributeError` names a field that the message, or one nested
    in it, has not."""
    no_dict = '( and no __dict__ for setting new attributes)?'  # since Python 3.13
    wrong = re.fullmatch(r"'(\w+)' object has no attribute '(\w+)'" + no_dict, str(error))
    pending = [type(message), *_TIMES.values()]
    while wrong and pending:
        cls = pending.pop(0)
        if cls.__name__ == wrong[1]:
            raise _no_field(cls, getattr(cls, '_type', cls.__name__), wrong[2]) from error
        if issubclass(cls, genpy.Message):
            pending += nested_classes(cls)


def add_fields(error: BaseException, message: Any) -> None:
    """Have the text of an `AttributeError` say which fields there are, where it names one that a
    message has not.

    :param message: what the block that raised it was run on
    """
    if isinstance(error, AttributeError):
        owner = getattr(error, 'obj', None)  # since Python 3.10
        try:
            explain(error, owner if isinstance(owner, genpy.Message) else message)
        except MessageTypeError as told:
            error.args = (f'{error}: {told}',)


def _no_field(cls: MessageClass, path: str, name: str) -> MessageTypeError:
    names = [field for field, _ in fields_of(cls)]
    known = f'its fields are {describe_fields(cls)}' if names else 'it has no fields at all'
    return MessageTypeError(f'{path} has no field {name!r}{suggest(str(name), names)}; {known}')


def _fill(message: genpy.Message, fields: Dict[str, Any], path: str) -> genpy.Message:
    cls = type(message)
    field_types = dict(fields_of(cls))
    for name, value in fields.items():
        if name not in field_types:
            raise _no_field(cls, path, name)
        field_type = field_types[name]
        fits = False
        try:
            _WRITERS[field_type](value)
            fits = True
        except Exception as error:  # it is no single number or string, or does not fit
            if is_from_signal(error):
                raise
        if not fits:
            field_path = f'{path}.{name}'
            value = _from_dicts(cls, field_type, value, field_path, getattr(message, name))
            _check(cls, field_type, value, field_path)
        setattr(message, name, value)
    return message


def _from_dicts(
    cls: MessageClass, field_type: str, value: Any, path: str, present: Any = None
) -> Any:
    """A field's value with the dicts in it made messages; one for a single message goes into the
    ``present``."""
    base, is_array, _ = parse_type(field_type)
    if base in _WRITERS:
        return value
    if is_array and isinstance(value, (list, tuple)):
        return [
            _from_dicts(cls, base, item, f'{path}[{index}]') for index, item in enumerate(value)
        ]
    if not is_array and isinstance(value, dict):
        nested = nested_class(cls, base) or type(present)
        return _fill(present if isinstance(present, nested) else nested(), value, path)
    return value


def _check(cls: MessageClass, field_type: str, value: Any, path: str) -> None:
    """Raise MessageTypeError unless genpy would serialize the value: the same struct and str calls
    decide."""
    base, is_array, length = parse_type(field_type)
    try:
        if is_array:
            _check_array(cls, base, length, value, path)
        elif base in _WRITERS:
            _WRITERS[base](value)
        else:
            nested = nested_class(cls, base) or type(value)
            for name, nested_type in fields_of(nested):
                _check(nested, nested_type, getattr(value, name), f'{path}.{name}')
    except MessageTypeError:
        raise
    except Exception as error:
        raise MessageTypeError(
            f'{path} = {reprlib.repr(value)} does not fit {field_type}: '
            f'give {_what_fits(cls, base, is_array, length)}'
        ) from error


def _check_array(
    cls: MessageClass, base: str, length: Optional[int], value: Any, path: str
) -> None:
    count = len(value) if length is None else length
    if base in ('uint8', 'char') and not isinstance(value, (list, tuple)):
        struct.pack(f'{count}s', value)
        return
    if base in SIMPLE_TYPES_DICT:
        try:
            struct.pack(f'<{count}{SIMPLE_TYPES_DICT[base]}', *value)
            return
        except Exception:
            if not isinstance(value, (list, tuple)) or len(value) != count:
                raise
    elif len(value) != count:
        raise ValueError(value)
    for index, item in enumerate(value):  # which tells the one that does not fit
        _check(cls, base, item, f'{path}[{index}]')


def _what_fits(cls: MessageClass, base: str, is_array: bool, length: Optional[int]) -> str:
    if is_array:
        items = base if length is None else f'{length} {base}'
        return f'a list of {items}' + (' or bytes' if base in ('uint8', 'char') else '')
    if base in _WHAT_FITS:
        return _WHAT_FITS[base]
    code = SIMPLE_TYPES_DICT.get(base)
    if code:
        bits = 8 * struct.calcsize(code) - code.islower()
        return f'an integer from {-2 ** bits if code.islower() else 0} to {2 ** bits - 1}'
    nested = nested_class(cls, base)
    if nested is None:  # of a class written by hand
        return f'a {base}'
    name = getattr(nested, '_type', nested.__name__).rpartition('/')[2]
    return f'a {name} or a dict of its fields ({describe_fields(nested)})'
