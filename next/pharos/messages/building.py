"""Fill messages by name, and explain what cannot be sent."""
from __future__ import annotations

from typing import Any, Callable

import genpy

from pharos.errors import MessageTypeError
from pharos.intraprocess.copier import copier_for, nested_class

_OCTETS = 'uint8[', 'char['


def describe(cls: type) -> str:
    """Return the fields of a message class as text."""
    types = getattr(cls, '_slot_types', ())
    return ', '.join(f'{name}: {type_}' for name, type_ in zip(cls.__slots__, types)) or 'no fields'


def build(cls: type, filler: Callable | dict | genpy.Message | None, fields: dict) -> genpy.Message:
    """Return a message that ``filler(message)`` and keywords fill, or ``filler``, if it is one.

    Dicts fill nested messages, and a list of dicts an array of them. numpy arrays are taken for
    arrays of numbers.

    :raises MessageTypeError: for a field that does not exist
    """
    if isinstance(filler, genpy.Message):
        if fields:
            raise MessageTypeError(
                f'a ready {filler._type} is sent as it is: set {", ".join(fields)} in it before'
            )
        return filler
    message = cls()
    if isinstance(filler, dict):
        fields = {**filler, **fields}
    elif callable(filler):
        made = filler(message)
        if isinstance(made, genpy.Message) and made is not message:
            raise MessageTypeError('the block is to fill the message that it gets, not another one')
    elif filler is not None:
        raise MessageTypeError(
            f'{cls._type} is filled by a block, a dict or keywords, or is a message; not {filler!r}'
        )
    return _fill(message, fields)


def response(cls: type, value: Any) -> genpy.Message:
    """Return the response for what the block of a service returned: a response, a dict, tuple or
    list of its fields, or its only field; None if it has no fields.

    :raises MessageTypeError: if it does not fit
    """
    names = cls.__slots__
    if isinstance(value, genpy.Message) and value._md5sum == cls._md5sum:
        made = value
    elif isinstance(value, dict):
        made = _fill(cls(), value)
    elif value is None and not names:
        made = cls()
    elif len(names) == 1 and not _is_row(value, cls._slot_types[0]):
        made = _fill(cls(), {names[0]: value})
    elif isinstance(value, (tuple, list)) and len(value) == len(names):
        made = _fill(cls(), dict(zip(names, value)))
    else:
        raise MessageTypeError(f'{cls._type} has {describe(cls)}; {value!r} does not fit')
    try:
        copier_for(cls)[0](made)
    except Exception as error:
        raise explain(made, error) from error
    return made


def _is_row(value: Any, type_: str) -> bool:
    """True if it is a tuple or list with the only field, not the field itself."""
    is_one = isinstance(value, (tuple, list)) and len(value) == 1
    return is_one and not (type_.endswith(']') and not isinstance(value[0], (tuple, list)))


def _fill(message: genpy.Message, fields: dict) -> genpy.Message:
    cls = type(message)
    for name, value in fields.items():
        if name not in cls.__slots__:
            raise MessageTypeError(f'{cls._type} has no field {name!r}; it has {describe(cls)}')
        if type(value) is dict:
            value = _fill(type(getattr(message, name))(), value)
        elif type(value) is list and value and type(value[0]) is dict:
            base = _type_of(cls, name).partition('[')[0]
            value = [_fill(nested_class(base, cls)(), each) for each in value]
        elif hasattr(value, 'tolist'):
            value = _from_numpy(value, _type_of(cls, name))
        setattr(message, name, value)
    return message


def _type_of(cls: type, name: str) -> str:
    return cls._slot_types[cls.__slots__.index(name)]


def _from_numpy(value: Any, type_: str) -> Any:
    if type_.startswith(_OCTETS):
        return value.astype(
            'uint8', casting='same_kind' if value.dtype != bool else 'safe'
        ).tobytes()
    return value.ravel().tolist() if type_.endswith(']') else value.tolist()


def convert_numpy(message: genpy.Message) -> bool:
    """Replace numpy arrays among the fields by what the wire takes; True if there were any."""
    found = False
    for name, type_ in zip(message.__slots__, getattr(message, '_slot_types', ())):
        value = getattr(message, name)
        if hasattr(value, 'tolist') and type_.startswith(_OCTETS):
            setattr(message, name, _from_numpy(value, type_))
            found = True
        elif isinstance(value, genpy.Message):
            found = convert_numpy(value) or found
    return found


def explain(message: genpy.Message, error: Exception) -> MessageTypeError:
    """Return our error for what serializing a message raised, with the path of the field."""
    path, reason = _wrong_field(message) or ('', error)
    where = f'.{path}' if path else ''
    return MessageTypeError(f'{message._type}{where} cannot be sent: {reason}')


def _wrong_field(message: genpy.Message) -> tuple[str, Any] | None:
    for name, type_ in zip(message.__slots__, message._slot_types):
        value = getattr(message, name, None)
        if isinstance(value, genpy.Message):
            found = _wrong_field(value)
            if found:
                return f'{name}.{found[0]}', found[1]
            continue
        try:
            genpy.message.check_type(name, type_, value)
        except genpy.SerializationError as error:
            return name, f'expected {type_}, got {str(value)[:80]!r} ({error})'
        except Exception as error:
            return name, error
    return None
