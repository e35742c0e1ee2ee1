"""Copy messages in two halves: the publisher freezes once, each receiver thaws one of its own.

A thawed message equals, in the value and type of every field, what the wire delivers. The functions
are generated for each class, as genpy generates its serializers. Three rules make them right:
numbers pass through the struct codes of the wire; only values of the very type that arrives (float,
str, bytes) are shared; a message with anything else is serialized, and so is every message of a
class that genpy did not generate in the usual way.
"""
import functools
import io
import itertools
import struct
import sys

import genpy
from genmsg.msgs import parse_type
from genpy.base import SIMPLE_TYPES_DICT as CODES

_GENERATED = {'__slots__', '_slot_types', 'serialize', 'serialize_numpy'}
_TIMES = {'time': genpy.Time, 'duration': genpy.Duration}


class _UnusualError(Exception):
    """Only genpy's serializer knows what to make of this."""


def serialize(message):
    """Return the bytes of a message on the wire, without their length."""
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


@functools.cache
def copier_for(cls):
    """Return ``freeze(message)``, which raises what ``serialize`` raises, and ``thaw(frozen)``."""
    try:
        return _generate(cls)
    except Exception:  # a class that is not understood costs time, never a wrong copy
        return serialize, lambda frozen: cls().deserialize(frozen)


def copied(message):
    """Return a copy of a message."""
    freeze, thaw = copier_for(type(message))
    return thaw(freeze(message))


@functools.cache
def thawer(sent, wanted):
    """Return the function that thaws a message of one class as one of another, such as AnyMsg."""
    thaw = copier_for(sent)[1]
    if sent is wanted:
        return thaw

    def thaw_as_wanted(frozen):
        return wanted().deserialize(serialize(thaw(frozen)))

    return thaw_as_wanted


def size_of(frozen):
    """Estimate the bytes that a message, frozen or not, holds."""
    if isinstance(frozen, genpy.Message):
        frozen = [getattr(frozen, name) for name in frozen.__slots__]
    if isinstance(frozen, (list, tuple)):
        sample = frozen[:20]
        return 8 + sum(map(size_of, sample)) * len(frozen) // (len(sample) or 1)
    return sys.getsizeof(frozen)


# -- what the generated functions call


def _sequence(value):
    if type(value) not in (list, tuple):
        if not hasattr(value, 'ravel'):  # an array of numpy
            raise _UnusualError
        value = value.ravel().tolist()
    return tuple(value)


def _text(value):
    if type(value) is not str:
        raise _UnusualError
    value.encode()
    return value


def _octets(value):
    if getattr(value, 'dtype', None) == 'uint8':
        return value.tobytes()
    return value if type(value) is bytes else bytes(_sequence(value))


def _numbers(code):
    @functools.lru_cache(128)
    def structs(count):
        packer = struct.Struct(f'<{count}{code}')
        return packer.pack, packer.unpack

    def convert(value):
        value = _sequence(value)
        if code == 'd' and set(map(type, value)) == {float}:
            return value
        pack, unpack = structs(len(value))
        return unpack(pack(*value))

    return convert


def _booleans(value, convert=_numbers('B')):
    return tuple(map(bool, convert(value)))


_SCOPE = {'new': object.__new__, 'text': _text, 'sequence': _sequence, 'Unusual': _UnusualError}
_SCOPE.update((f'{base}_array', _numbers(code)) for base, code in CODES.items())
_SCOPE.update(
    string_array=lambda value: tuple(map(_text, _sequence(value))),
    bool_array=_booleans,
    uint8_array=_octets,
    char_array=_octets,
    serialize=serialize,
)


# -- the generator


class _Source:
    """The lines of the two functions for one class."""

    def __init__(self, cls, depth):
        self.scope, self.names = dict(_SCOPE), itertools.count()
        self.reads = []
        self.builds = []
        self.values = []
        self.numbers = []  # base, field, local
        self.add_fields(cls, 'm', depth)

    def refer(self, thing):
        """Return a name for a thing in the generated code."""
        name = f'g{next(self.names)}'
        self.scope[name] = thing
        return name

    def pack_numbers(self):
        """Send all single numbers through one pack and unpack, so that they come out as the wire's."""
        bases, fields, names = zip(*self.numbers)
        codes = '<' + ''.join(CODES[base] for base in bases)
        arriving = '<' + ''.join('?' if base == 'bool' else CODES[base] for base in bases)
        self.scope.update(pack=struct.Struct(codes).pack, unpack=struct.Struct(arriving).unpack)
        self.reads.append(f'{", ".join(names)}, = unpack(pack({", ".join(fields)}))')

    def add_fields(self, cls, owner, depth):
        if cls in _TIMES.values():
            base = 'uint32' if cls is genpy.Time else 'int32'
            fields = [('secs', base), ('nsecs', base)]
        elif _GENERATED <= vars(cls).keys() and cls.__bases__ == (genpy.Message,):
            fields = list(zip(cls.__slots__, cls._slot_types))
        else:
            raise _UnusualError
        for name, type_ in fields:
            self.add_field(cls, f'{owner}.{name}', type_, depth)

    def add_field(self, cls, field, type_, depth):
        base, is_array, length = parse_type(type_)
        local = f'v{next(self.names)}'
        nested = None if base in CODES or base == 'string' else nested_class(base, cls)
        if nested and not is_array:
            self.reads.append(f'{local} = {field}')
            self.builds.append(f'{local} = {field} = new({self.refer(nested)})')
            self.add_fields(nested, local, depth + 1)
            if depth == 0 and base in _TIMES:  # genpy does so for top-level fields alone
                self.builds.append(f'{local}.canon()')
            return
        self.values.append(local)
        fresh = local
        if nested:
            freeze, thaw = map(self.refer, _generate(nested, 1))
            self.reads.append(f'{local} = tuple(map({freeze}, sequence({field})))')
            fresh = f'list(map({thaw}, {local}))'
        elif is_array:
            self.reads.append(f'{local} = {base}_array({field})')
            fresh = f'list({local})' if base in ('bool', 'string') else local
        elif base == 'string':
            self.reads.append(f'{local} = text({field})')
        else:
            self.numbers.append((base, field, local))
        if length is not None:
            self.reads.append(f'if len({local}) != {length}: raise Unusual')
        self.builds.append(f'{field} = {fresh}')


def nested_class(base, cls):
    """Return the class of a nested field; a class made at run time knows its own."""
    if base in _TIMES:
        return _TIMES[base]
    base = 'std_msgs/Header' if base == 'Header' else base
    return getattr(cls, '_classes', {}).get(base) or genpy.message.get_message_class(base)


@functools.cache
def _generate(cls, depth=0):
    source = _Source(cls, depth)
    if source.numbers:
        source.pack_numbers()
    made, values = source.refer(cls), ''.join(f'{value}, ' for value in source.values)
    reads = source.reads
    if depth == 0:  # an element of an array may be of a similar class
        reads = [
            f'if m.__class__ is not {made}: return serialize(m)',
            'try:',
            *(f'    {line}' for line in reads or ['pass']),
            'except Exception: return serialize(m)',  # which says what is wrong
        ]
    freeze = ['def freeze(m):', *reads, f'return ({values})']
    thaw = [
        'def thaw(frozen):',
        f'if type(frozen) is bytes: return {made}().deserialize(frozen)',
        f'{values or "_"} = frozen',
        f'm = new({made})',
        *source.builds,
        'return m',
    ]
    text = '\n'.join(map('\n    '.join, (freeze, thaw)))
    exec(compile(text, f'<copier of {cls.__name__}>', 'exec'), source.scope)
    return source.scope['freeze'], source.scope['thaw']
