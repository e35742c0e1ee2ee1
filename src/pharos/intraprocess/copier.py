"""Copies of ROS messages in two halves: frozen once by the publisher, thawed by each receiver.

What a receiver gets equals, in value and in the Python type of every field, what the wire would
have delivered::

    copier = copier_for(PointStamped)
    frozen = copier.freeze(message)     # a snapshot: a tuple of immutable values
    message = copier.thaw(frozen)       # a fresh message, as often as there are receivers

The work is done by two functions generated for each class, as genpy generates its serializers
(``copier.source``)::

    def freeze_fields(message):
        header_0 = message.header
        frame_id_7 = header_0.frame_id
        if type(frame_id_7) is not str or not frame_id_7.isascii(): frame_id_7 = check_text(frame_id_7)
        point_8 = message.point
        x_10 = point_8.x
        ...
        seq_2, secs_5, nsecs_6, = unpack(pack(header_0.seq, stamp_3.secs, stamp_3.nsecs))
        if not (type(x_10) is type(y_11) is type(z_12) is float):
            x_10, y_11, z_12, = unpack_floats(pack_floats(x_10, y_11, z_12))
        return (seq_2, secs_5, nsecs_6, frame_id_7, x_10, y_11, z_12, )

    def thaw_fields(frozen):
        seq_2, secs_5, nsecs_6, frame_id_7, x_10, y_11, z_12, = frozen
        message = new(PointStamped_13)
        header_0 = message.header = new(Header_1)
        ...

The copies equal the wire's by three rules. Numbers pass through the struct codes of the wire, which
round, convert and refuse alike; only what is of the very type that arrives (float, str, bytes) is
shared as it is. A message with anything else in it is serialized: what is frozen then is bytes, and
the errors are the wire's own. So is every message of a class that genpy did not make in the usual
way (AnyMsg, numpy_msg, one written by hand).
"""
import io
import itertools
import struct
from typing import Any, Callable, Dict, Iterator, List, NamedTuple, Optional, Tuple, Union

import genpy
from genmsg.msgs import parse_type

from pharos.intraprocess.conversions import (
    ARRIVAL_CODES,
    CONVERSIONS,
    STRUCT_CODES,
    NeedsSerializer,
)
from pharos.messages import fields_of, nested_class

#: what is kept of a message until receivers get theirs
Frozen = Union[Tuple[Any, ...], bytes]
SMALL = 64  # bytes that a message is taken to have beside its texts and arrays
FEW = 1024  # bytes; messages that all have one size, of so many, are not worth counting
# What a value raises that is not copied as it should be. Others are of a handler of signals, which may
# run at any moment, and of what a value runs that is an object of the user's own.
UNFIT = (
    *(NeedsSerializer, struct.error, AttributeError, TypeError, ValueError),
    *(ArithmeticError, LookupError),
)


class Copier(NamedTuple):
    """The functions that copy the messages of one class. Where it is always serialized, two of them
    are missing."""

    freeze: Callable[
        [Any], 'Frozen'
    ]  # message -> tuple or bytes; raises what message.serialize() raises
    thaw: Callable[['Frozen'], Any]  # tuple or bytes -> fresh message
    # message -> about how many bytes it has on the wire; None: always a few
    size: Optional[Callable[[Any], int]]
    # message -> tuple; raises where freeze would serialize
    freeze_fields: Optional[Callable[[Any], Tuple[Any, ...]]] = None
    thaw_fields: Optional[
        Callable[[Tuple[Any, ...]], Any]
    ] = None  # tuple -> message, its times not canonized
    source: str = ''  # of all but the first two, to be read when debugging


def copier_for(cls: Any) -> Copier:
    """The Copier of a message class, made at the first call."""
    copier: Optional[Copier] = vars(cls).get('_pharos_copier')
    if copier is None:
        try:
            copier = _generate(cls)
        except Exception:  # a class not understood costs time, never a wrong copy
            copier = Copier(serialized, lambda frozen: cls().deserialize(frozen), _estimated_size)
        # Kept in the class itself: a registry here would keep classes made at run time alive for
        # ever.
        cls._pharos_copier = copier
    return copier


def thawer(publisher_cls: Any, receiver_cls: Any) -> Callable[[Frozen], Any]:
    """The function that thaws, as a receiver_cls, what the copier of publisher_cls has frozen."""
    copier = copier_for(publisher_cls)
    if receiver_cls is publisher_cls:
        return copier.thaw

    def thaw_as_receiver(frozen: Frozen) -> Any:
        if not isinstance(frozen, bytes):
            assert copier.thaw_fields  # only these make tuples
            frozen = serialized(copier.thaw_fields(frozen))
        return receiver_cls().deserialize(frozen)

    return thaw_as_receiver


def _estimated_size(message: genpy.Message) -> int:
    """The size of a message of any class, such as rospy's AnyMsg or one with numpy arrays."""
    values: List[Any] = [getattr(message, name, None) for name in message.__slots__]
    sized = [value for value in values if hasattr(value, '__len__')]
    return SMALL + sum(getattr(value, 'nbytes', 0) or len(value) for value in sized)


def serialized(message: genpy.Message) -> bytes:
    """The message's bytes on the wire, without the length that precedes them there."""
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


def _generate(cls: Any) -> Copier:
    """The Copier of a class that genpy made; any exception for another."""
    writer = _Writer()
    writer.add_object(cls, 'message')
    # The wire canonizes the times that are the message's own, not those of its header or of other
    # messages in it.
    canon = [
        f'message.{name}.canon()'
        for name, type_name in _fields(cls)
        if type_name in ('time', 'duration')
    ]
    freeze, build = list(writer.freeze_lines()), list(writer.thaw_lines(cls))
    size = writer.size()
    source = '\n'.join(
        [
            'def freeze_fields(message):',
            *_indented(freeze),
            '',
            'def thaw_fields(frozen):',
            *_indented(build),
            '    return message',
            '',
            'def size(message):',
            f'    return {size}',
            '',
            # Each of these again with all of it in one function: one call, and fewer cache misses
            # where messages come rarely.
            'def freeze(message):',
            '    if type(message) is cls:',
            '        try:',
            *_indented(_indented(_indented(freeze))),
            '        except unfit:',
            '            pass',
            '    return serialized(message)',
            '',
            'def thaw(frozen):',
            '    if type(frozen) is bytes: return cls().deserialize(frozen)',
            *_indented([*build, *canon]),
            '    return message',
            '',
        ]
    )
    scope = {**writer.scope, 'cls': cls, 'serialized': serialized, 'unfit': UNFIT}
    exec(compile(source, f'<copier of {cls.__name__}>', 'exec'), scope)
    return Copier(
        scope['freeze'],
        scope['thaw'],
        scope['size'] if size else None,
        scope['freeze_fields'],
        scope['thaw_fields'],
        source,
    )


def _indented(lines: List[str]) -> List[str]:
    return ['    ' + line for line in lines]


def _fields(cls: Any) -> List[Tuple[str, str]]:
    """The (name, type) pairs of a class that genpy made, or of Time or Duration."""
    # A numpy_msg derives from another message, AnyMsg has no types: neither serializes as its
    # fields would say.
    made_by_genpy = {'__slots__', '_slot_types', 'serialize', 'serialize_numpy'} <= vars(cls).keys()
    if cls not in (genpy.Time, genpy.Duration) and (
        not made_by_genpy
        or cls.__bases__ != (genpy.Message,)
        or len(cls.__slots__) != len(cls._slot_types)
    ):
        raise NeedsSerializer
    return fields_of(cls)


class _Writer:
    """Writes the bodies of freeze_fields and thaw_fields, field by field.

    Objects and values are in local variables, named alike in both; in between, the values are the
    frozen tuple.
    """

    def __init__(self) -> None:
        self.scope: Dict[str, Any] = dict(CONVERSIONS)  # the globals of the generated code
        self._count = itertools.count()
        self._reads: List[str] = []  # lines of freeze_fields
        self._builds: List[str] = []  # lines of thaw_fields
        self._values: List[str] = []  # the variables in the frozen tuple
        self._floats: List[str] = []  # those of them that are float64
        # other numbers: (primitive type, where it is read, variable)
        self._numbers: List[Tuple[str, str, str]] = []
        self._sizes: List[str] = []  # expressions of size, where it varies,
        self._fixed_size = SMALL  # and what does not

    def add_object(self, cls: Any, owner: str, path: str = 'message') -> None:
        """Add the fields of the object of class cls that is in the variable owner, and at that path
        in a message."""
        for name, type_name in _fields(cls):
            base, is_array, length = parse_type(type_name)
            field, local = f'{owner}.{name}', self._unique(name)
            self._add_size(cls, base, is_array, length, f'{path}.{name}')
            if is_array:
                self._add_array(cls, base, length, field, local)
            elif base in STRUCT_CODES or base == 'string':
                self._add_scalar(base, field, local)
            else:
                nested = nested_class(cls, base)
                self._reads.append(f'{local} = {field}')
                self._builds.append(f'{local} = {field} = new({self._refer(nested)})')
                self.add_object(nested, local, f'{path}.{name}')

    def _add_size(
        self, cls: Any, base: str, is_array: bool, length: Optional[int], path: str
    ) -> None:
        """Add what may make a message large: an array or a text, unless that names a frame."""
        if not is_array:
            if base == 'string' and not path.endswith('frame_id'):
                self._sizes.append(f'len({path})')
        elif base == 'string':
            self._sizes.append(f'sum(map(len, {path}))')
        elif base in STRUCT_CODES:
            self._add_items(length, struct.calcsize('<' + STRUCT_CODES[base]), path)
        else:
            size = copier_for(nested_class(cls, base)).size
            if size:
                self._sizes.append(f'sum(map({self._refer(size)}, {path}))')
            else:
                self._add_items(length, SMALL, path)

    def _add_items(self, length: Optional[int], size: int, path: str) -> None:
        """Add an array of items that have that size each; ``length`` is None where it varies."""
        if length is None:
            self._sizes.append(f'len({path}) * {size}')
        else:
            self._fixed_size += length * size

    def size(self) -> Optional[str]:
        """The expression of a message's size; None: always a few bytes."""
        if not self._sizes and self._fixed_size <= FEW:
            return None
        return ' + '.join([str(self._fixed_size), *self._sizes])

    def _add_scalar(self, base: str, field: str, local: str) -> None:
        self._add_value(field, local, fresh=local)
        if base == 'float64':
            self._reads.append(f'{local} = {field}')
            self._floats.append(local)
        elif base == 'string':
            self._reads += [
                f'{local} = {field}',
                f'if type({local}) is not str or not {local}.isascii(): {local} = check_text({local})',
            ]
        else:
            self._numbers.append((base, field, local))

    def _add_array(
        self, cls: Any, base: str, length: Optional[int], field: str, local: str
    ) -> None:
        if base in STRUCT_CODES or base == 'string':
            convert = f'{local} = {base}_array({local})'
            if base in ('uint8', 'char'):
                convert = f'if type({local}) is not bytes: {convert}'  # images are bytes
            self._reads += [f'{local} = {field}', convert]
            self._add_value(
                field, local, fresh=f'list({local})' if base in ('bool', 'string') else local
            )
        else:
            element = copier_for(nested_class(cls, base))
            if element.freeze_fields is None:
                raise NeedsSerializer
            freeze, thaw = self._refer(element.freeze_fields), self._refer(element.thaw_fields)
            self._reads.append(f'{local} = tuple(map({freeze}, check_sequence({field})))')
            self._add_value(field, local, fresh=f'list(map({thaw}, {local}))')
        if length is not None:
            self._reads.append(f'if len({local}) != {length}: raise NeedsSerializer')

    def _add_value(self, field: str, local: str, fresh: str) -> None:
        self._values.append(local)
        self._builds.append(f'{field} = {fresh}')

    def _unique(self, name: str) -> str:
        """A variable named after what is in it. Whatever is not ours in the generated code comes
        through here."""
        if not name.isidentifier():
            raise NeedsSerializer
        return f'{name}_{next(self._count)}'

    def _refer(self, thing: Any) -> str:
        """A name by which the generated code can use a class or function."""
        name = self._unique(thing.__name__)
        self.scope[name] = thing
        return name

    def freeze_lines(self) -> Iterator[str]:
        """The body of freeze_fields."""
        yield from self._reads
        if self._numbers:
            bases, fields, variables = zip(*self._numbers)
            sent = ''.join(STRUCT_CODES[base] for base in bases)
            arriving = ''.join(ARRIVAL_CODES[base] for base in bases)
            self.scope['pack'] = struct.Struct('<' + sent).pack
            self.scope['unpack'] = struct.Struct('<' + arriving).unpack
            yield f'{", ".join(variables)}, = unpack(pack({", ".join(fields)}))'
        if self._floats:
            floats, names = struct.Struct(f'<{len(self._floats)}d'), ', '.join(self._floats)
            self.scope.update(pack_floats=floats.pack, unpack_floats=floats.unpack)
            yield f'if not ({" is ".join(f"type({local})" for local in self._floats)} is float):'
            yield f'    {names}, = unpack_floats(pack_floats({names}))'
        yield f'return ({"".join(f"{local}, " for local in self._values)})'

    def thaw_lines(self, cls: Any) -> Iterator[str]:
        """The body of thaw_fields."""
        if self._values:
            yield f'{", ".join(self._values)}, = frozen'
        yield f'message = new({self._refer(cls)})'
        yield from self._builds
