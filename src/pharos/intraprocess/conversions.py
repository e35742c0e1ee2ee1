"""What the values of a message's fields become on the way to a receiver: the generated code of
copiers calls this."""
import functools
import struct
import sys
from typing import Any, Callable, Dict, List, Tuple

from genpy.base import SIMPLE_TYPES_DICT

STRUCT_CODES: Dict[str, str] = SIMPLE_TYPES_DICT  # primitive type -> its code on the wire
# genpy sends a bool as a number: 7 goes out, True arrives
ARRIVAL_CODES = {**STRUCT_CODES, 'bool': '?'}


class NeedsSerializer(Exception):
    """Only genpy's serializer knows what to make of this. It never leaves this module."""


def check_text(value: Any) -> str:
    """The value itself, if it is a str that UTF-8 has a form for, as it has none for a lone
    surrogate."""
    if type(value) is not str:
        raise NeedsSerializer
    value.encode('utf-8')
    return value


def check_sequence(value: Any) -> Any:
    """The value itself, if it is a list or tuple."""
    if type(value) not in (list, tuple):
        raise NeedsSerializer
    return value


def octets_of(value: Any) -> bytes:
    """The bytes that arrive in a uint8[] or char[]."""
    # bytes() itself would take more than the wire does, even an int.
    return bytes(value if type(value) in (bytes, bytearray) else check_sequence(value))


def _numbers_of(base: str) -> Callable[[Any], Any]:
    """The function that turns the value of an array of this primitive type into the tuple that
    arrives."""
    sent, arriving = STRUCT_CODES[base], ARRIVAL_CODES[base]

    @functools.lru_cache(maxsize=128)
    def structs(count: int) -> Tuple[Callable[..., bytes], Callable[[bytes], Tuple[Any, ...]]]:
        return struct.Struct(f'<{count}{sent}').pack, struct.Struct(f'<{count}{arriving}').unpack

    def numbers(value: Any) -> Any:
        if type(value) in (list, tuple):
            # a snapshot: a list could change its length between two looks at it
            value = tuple(value)
            if sent == 'd' and set(map(type, value)) == {float}:
                return value
        else:
            value, code = _from_numpy(value)
            if code == arriving:
                return tuple(value)
        pack, unpack = structs(len(value))
        return unpack(pack(*value))

    return numbers


def _from_numpy(array: Any) -> Tuple[List[Any], str]:
    """The list of a numpy array's numbers, which are plain ints or floats then, and the struct code
    of its type."""
    # not imported here: unless someone did, this is no array of it
    numpy = sys.modules.get('numpy')
    # Of other kinds, tolist() may give what the wire refuses in the array itself: an int for a
    # datetime64.
    if (
        numpy is None
        or type(array) is not numpy.ndarray
        or array.ndim != 1
        or array.dtype.kind not in 'iuf'
    ):
        raise NeedsSerializer
    return array.tolist(), array.dtype.char


#: What generated code calls; to convert an array: the function named after the type of its elements.
CONVERSIONS = {
    'NeedsSerializer': NeedsSerializer,
    'new': object.__new__,
    'check_text': check_text,
    'check_sequence': check_sequence,
}
CONVERSIONS.update((base + '_array', _numbers_of(base)) for base in STRUCT_CODES)
CONVERSIONS.update(
    string_array=lambda value: tuple(map(check_text, check_sequence(value))),
    uint8_array=octets_of,
    char_array=octets_of,
)
