"""Numbers in messages, by the paths of their fields: 'linear.x', 'ranges[0]', 'header.stamp'."""
import re
from typing import Any, Callable, Iterator, List, NoReturn, Optional, Tuple, Type

import genmsg.msgs
import genpy

from pharos.errors import MessageTypeError, suggest
from pharos.messages.fields import fields_of, nested_class

MessageClass = Type[genpy.Message]
LISTED = 12  # fields that an error names
DEPTH = 6  # messages within messages that are looked through for these
_PART = re.compile(r'(\w+)(?:\[(-?\d+)\])?')


def numeric_field(cls: MessageClass, path: str) -> Callable[[genpy.Message], Optional[float]]:
    """What takes the number at a path from a message of a class: seconds of a time, None where an
    array is too short.

    :raises TypeError: if the path is no text
    :raises MessageTypeError: if there is no such field, or it is no number
    """
    if not isinstance(path, str):
        raise TypeError(f"a field is given by its path, such as 'linear.x', not as {path!r}")
    steps: List[Tuple[str, Optional[int]]] = []
    inner: Optional[MessageClass] = cls
    for part in path.split('.'):
        match = _PART.fullmatch(part)
        types = dict(fields_of(inner)) if inner else {}
        if match is None or match.group(1) not in types:
            _refuse(cls, path, 'there is no such field')
        name, index = match.groups()
        type_, is_array, _ = genmsg.msgs.parse_type(types[name])
        if is_array and index is None:
            _refuse(cls, path, f'{name} is an array: name one of it, as {name}[0]')
        if not is_array and index is not None:
            _refuse(cls, path, f'{name} is no array')
        steps.append((name, None if index is None else int(index)))
        inner = _inner(inner, type_)
    if not _is_number(type_):
        _refuse(cls, path, f'it is a {type_}, and no number')
    return lambda message: _number(message, steps)


def _number(message: Any, steps: List[Tuple[str, Optional[int]]]) -> Optional[float]:
    value = message
    for name, index in steps:
        value = getattr(value, name)
        if index is not None:
            try:
                value = value[index]
            except IndexError:
                return None
    return float(value.to_sec() if isinstance(value, genpy.TVal) else value)


def _is_number(type_: str) -> bool:
    return genmsg.msgs.is_builtin(type_) and type_ != 'string'


def _inner(cls: Optional[MessageClass], type_: str) -> Optional[MessageClass]:
    """The class of a field's values, None where these are no messages."""
    if cls is None or (genmsg.msgs.is_builtin(type_) and type_ not in ('time', 'duration')):
        return None
    return nested_class(cls, type_)


def numeric_paths(cls: MessageClass, depth: int = DEPTH) -> Iterator[str]:
    """The paths of the numbers in messages of a class; of arrays, those of the first value."""
    for name, field_type in fields_of(cls):
        type_, is_array, _ = genmsg.msgs.parse_type(field_type)
        path = f'{name}[0]' if is_array else name
        inner = _inner(cls, type_)
        if _is_number(type_):
            yield path
        elif inner is not None and depth:
            yield from (f'{path}.{rest}' for rest in numeric_paths(inner, depth - 1))


def _refuse(cls: MessageClass, path: str, why: str) -> NoReturn:
    paths = list(numeric_paths(cls))
    listed = ', '.join(paths[:LISTED]) or 'none'
    more = f' and {len(paths) - LISTED} more' if len(paths) > LISTED else ''
    raise MessageTypeError(
        f'{path!r} of {cls._type} cannot be plotted: {why}{suggest(path, paths)}; its numbers are'
        f' {listed}{more}'
    )
