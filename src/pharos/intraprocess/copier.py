"""Copy messages in two halves: the publisher freezes once, each receiver thaws one of its own.

A thawed message equals the one that the wire delivers, in the value and type of every field. The
functions are generated for each class, as genpy generates its serializers. Three rules keep the
copies equal. Numbers pass through the struct codes of the wire. Only values of the very type that
arrives (float, str, bytes) are shared. A message with anything else is serialized, and so is every
message of a class that genpy did not generate in the usual way.

A frozen message is a tuple with the values of all fields, or the bytes of a serialized message.
"""
from __future__ import annotations

import functools
import io
import itertools
import struct
import sys
from typing import Any, Callable

import genpy
from genmsg.msgs import parse_type
from genpy.base import SIMPLE_TYPES_DICT as CODES

_GENERATED = {'__slots__', '_slot_types', 'serialize', 'serialize_numpy'}
_TIMES = {'time': genpy.Time, 'duration': genpy.Duration}


class _UnusualError(Exception):
    """A class or value that only genpy's serializer handles."""


#: what genpy raises for a message that it cannot serialize; not what the handler of a signal raises
SERIALIZE_ERRORS = (
    genpy.SerializationError,
    struct.error,
    TypeError,
    ValueError,
    AttributeError,
    LookupError,
    ArithmeticError,
)


def serialize(message: genpy.Message) -> bytes:
    """Return the bytes of a message on the wire, without their length."""
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


@functools.lru_cache(None)
def copier_for(cls: type[genpy.Message]) -> tuple[Callable, Callable]:
    """Return two functions for a message class: ``freeze(message)`` and ``thaw(frozen)``.

    ``freeze`` raises the exceptions of ``serialize``.
    """
    try:
        return _generate(cls)  # type: ignore[arg-type]
    except Exception:  # serializing is slower, but right for every class
        return serialize, lambda frozen: cls().deserialize(frozen)


def copy_of(message: genpy.Message) -> genpy.Message:
    """Return a copy of a message; raise the exceptions of ``serialize``."""
    freeze, thaw = copier_for(type(message))  # type: ignore[arg-type]
    return thaw(freeze(message))


@functools.lru_cache(None)
def thaw_function(
    sent_class: type[genpy.Message], wanted_class: type[genpy.Message]
) -> Callable[[Any], genpy.Message]:
    """Return the function that thaws a message of one class as one of another, such as AnyMsg."""
    _, thaw = copier_for(sent_class)  # type: ignore[arg-type]
    if sent_class is wanted_class:
        return thaw

    def thaw_as_wanted(frozen: Any) -> genpy.Message:
        return wanted_class().deserialize(serialize(thaw(frozen)))

    return thaw_as_wanted


def size_of(frozen: Any) -> int:
    """Estimate the memory of a message, frozen or not, in bytes; sample 20 items of each list."""
    if isinstance(frozen, genpy.Message):
        frozen = [getattr(frozen, name) for name in frozen.__slots__]
    if isinstance(frozen, (list, tuple)):
        sample = frozen[:20]
        sample_size = sum(map(size_of, sample))
        return 8 + sample_size * len(frozen) // max(1, len(sample))
    return sys.getsizeof(frozen)


# -- functions that the generated ones call


def _sequence(value: Any) -> tuple:
    if type(value) not in (list, tuple):
        if not getattr(value, 'ndim', 0):  # no array of numpy
            raise _UnusualError
        value = value.ravel().tolist()
    return tuple(value)


def _text(value: Any) -> str:
    if type(value) is not str:
        raise _UnusualError
    value.encode()
    return value


def _octets(value: Any) -> bytes:
    if getattr(value, 'dtype', None) == 'uint8':
        return value.tobytes()
    if type(value) is bytes:
        return value
    return bytes(_sequence(value))


def _number_converter(code: str) -> Callable[[Any], tuple]:
    """Return a function that passes a sequence of numbers through a code of struct."""

    @functools.lru_cache(128)
    def struct_for(count: int) -> struct.Struct:
        return struct.Struct(f'<{count}{code}')

    def convert(value: Any) -> tuple:
        numbers = _sequence(value)
        if code == 'd' and set(map(type, numbers)) == {float}:
            return numbers
        number_struct = struct_for(len(numbers))
        return number_struct.unpack(number_struct.pack(*numbers))

    return convert


_bytes_of_booleans = _number_converter('B')


def _booleans(value: Any) -> tuple[bool, ...]:
    return tuple([*map(bool, _bytes_of_booleans(value))])


_GLOBALS = {
    'new': object.__new__,
    'text': _text,
    'sequence': _sequence,
    'Unusual': _UnusualError,
    'refused': (_UnusualError, *SERIALIZE_ERRORS),
}
_GLOBALS.update((f'{base}_array', _number_converter(code)) for base, code in CODES.items())
_GLOBALS.update(
    string_array=lambda value: tuple([*map(_text, _sequence(value))]),
    bool_array=_booleans,
    uint8_array=_octets,
    char_array=_octets,
    serialize=serialize,
)


# -- the generator


class _Source:
    """The lines of ``freeze`` and ``thaw`` for one class. In them, ``m`` is the message.

    :param is_whole: True for a message of its own, which is checked and has its times made canonical;
        False for a nested message or an element of an array
    :ivar namespace: the names that the functions use -> their values
    :ivar freeze_lines: read the fields into variables
    :ivar thaw_lines: set the fields of a new message
    :ivar variables: the parts of a frozen message
    """

    def __init__(self, cls: type[genpy.Message], is_whole: bool) -> None:
        self.namespace: dict[str, Any] = dict(_GLOBALS)
        self.freeze_lines = []
        self.thaw_lines = []
        self.variables = []
        self._numbers = []  # (base type, field, variable) of single numbers
        self._counter = itertools.count()
        self._add_fields(cls, 'm', is_whole)
        if self._numbers:
            self._pack_numbers()

    def name_for(self, thing: Any) -> str:
        """Return a name for a thing in the generated code."""
        name = f'g{next(self._counter)}'
        self.namespace[name] = thing
        return name

    def _pack_numbers(self) -> None:
        """Pass all single numbers through one pack and unpack, to make them those of the wire."""
        bases, fields, variables = zip(*self._numbers)
        sent_codes = ''.join(CODES[base] for base in bases)
        received_codes = ''.join('?' if base == 'bool' else CODES[base] for base in bases)
        self.namespace['pack'] = struct.Struct(f'<{sent_codes}').pack
        self.namespace['unpack'] = struct.Struct(f'<{received_codes}').unpack
        self.freeze_lines.append(f'{", ".join(variables)}, = unpack(pack({", ".join(fields)}))')

    def _add_fields(self, cls: type[genpy.Message], owner: str, is_whole: bool) -> None:
        if cls in _TIMES.values():
            base = 'uint32' if cls is genpy.Time else 'int32'
            fields = [('secs', base), ('nsecs', base)]
        elif _GENERATED <= vars(cls).keys() and cls.__bases__ == (genpy.Message,):
            fields = list(zip(cls.__slots__, cls._slot_types))
        else:
            raise _UnusualError
        for name, type_name in fields:
            self._add_field(cls, f'{owner}.{name}', type_name, is_whole)

    def _add_field(
        self, cls: type[genpy.Message], field: str, type_name: str, is_whole: bool
    ) -> None:
        base, is_array, length = parse_type(type_name)
        variable = f'v{next(self._counter)}'
        is_nested = base not in CODES and base != 'string'
        if is_nested and not is_array:
            self._add_message(nested_class(base, cls), field, variable, is_whole)
            return
        self.variables.append(variable)
        new_value = variable
        if is_nested:
            freeze, thaw = map(self.name_for, _generate(nested_class(base, cls), False))  # type: ignore
            # not tuple(map(...)): gc.get_objects() of another thread makes Python raise a SystemError
            self.freeze_lines.append(f'{variable} = tuple([*map({freeze}, sequence({field}))])')
            new_value = f'list(map({thaw}, {variable}))'
        elif is_array:
            self.freeze_lines.append(f'{variable} = {base}_array({field})')
            if base in ('bool', 'string'):
                new_value = f'list({variable})'
        elif base == 'string':
            self.freeze_lines.append(f'{variable} = text({field})')
        else:
            self._numbers.append((base, field, variable))
        if length is not None:
            self.freeze_lines.append(f'if len({variable}) != {length}: raise Unusual')
        self.thaw_lines.append(f'{field} = {new_value}')

    def _add_message(
        self, cls: type[genpy.Message], field: str, variable: str, is_whole: bool
    ) -> None:
        """Add the fields of a nested message."""
        self.freeze_lines.append(f'{variable} = {field}')
        self.thaw_lines.append(f'{variable} = {field} = new({self.name_for(cls)})')
        self._add_fields(cls, variable, False)
        if is_whole and cls in _TIMES.values():  # genpy canonizes top-level fields alone
            self.thaw_lines.append(f'{variable}.canon()')


def nested_class(base: str, cls: type[genpy.Message]) -> type[genpy.Message]:
    """Return the class of a nested field.

    :param base: the type's name, such as 'std_msgs/Header' or 'time'
    :param cls: the message class with the field
    """
    if base in _TIMES:
        return _TIMES[base]
    base = 'std_msgs/Header' if base == 'Header' else base
    # genpy makes a class of a definition in a module with the classes of all its fields
    made_class = cls.serialize.__globals__.get('_' + base.replace('/', '__'))
    return made_class or genpy.message.get_message_class(base)


@functools.lru_cache(None)
def _generate(cls: type[genpy.Message], is_whole: bool = True) -> tuple[Callable, Callable]:
    """Return ``freeze`` and ``thaw`` for a class; those of an element of an array are not whole."""
    source = _Source(cls, is_whole)
    class_name = source.name_for(cls)
    variables = ''.join(f'{variable}, ' for variable in source.variables)
    freeze_lines = [*source.freeze_lines, f'return ({variables})']
    if is_whole:  # an element of an array may be of a similar class
        freeze_lines = [
            f'if m.__class__ is not {class_name}: return serialize(m)',
            'try:',
            *(f'    {line}' for line in freeze_lines),
            'except refused: pass',
            'return serialize(m)',  # whose exception names the error
        ]
    freeze = ['def freeze(m):', *freeze_lines]
    thaw = [
        'def thaw(frozen):',
        f'if type(frozen) is bytes: return {class_name}().deserialize(frozen)',
        f'{variables or "_"} = frozen',
        f'm = new({class_name})',
        *source.thaw_lines,
        'return m',
    ]
    text = '\n'.join(['\n    '.join(freeze), '\n    '.join(thaw)])
    exec(compile(text, f'<copier of {cls.__name__}>', 'exec'), source.namespace)
    return source.namespace['freeze'], source.namespace['thaw']
