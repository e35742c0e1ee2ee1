"""Messages as text, to be read as they come."""
import collections
import itertools
from typing import Any

import genpy

LONGEST = 12  # values of an array that are shown; of longer ones, the first alone
FIRST = 3  # these many
LONGEST_TEXT = 2000  # characters of a string that are shown


class _Text:
    """A value that genpy writes as it is, and not as YAML has it."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __str__(self) -> str:
        return self._text


def text_of_message(message: genpy.Message) -> str:
    """A message as ``rostopic echo`` prints it, but for long arrays and strings: how they begin,
    and how long they are."""
    return printable(genpy.message.strify_message(cut(message)), kept='\n')


def cut(value: Any) -> Any:
    """A message, or a value of a field, with long arrays and strings cut."""
    if isinstance(value, genpy.Message):
        copy = object.__new__(type(value))
        for name in value.__slots__:
            setattr(copy, name, cut(getattr(value, name, None)))  # None: a block has deleted it
        return copy
    if isinstance(value, str) and len(value) > LONGEST_TEXT:
        return f'{value[:LONGEST_TEXT]}... {len(value)} characters in all'
    if not isinstance(value, (list, tuple, bytes, bytearray, collections.deque)):
        return value
    if len(value) > LONGEST:
        return _shortened(value)
    return bytes(value) if isinstance(value, (bytes, bytearray)) else [cut(each) for each in value]


def printable(text: str, kept: str = '') -> str:
    """The text without what would do something to a terminal: others choose their names and words.

    :param kept: characters that may stay
    """
    if text.isprintable():
        return text
    return ''.join(each if each.isprintable() or each in kept else '?' for each in text)


def _shortened(values: Any) -> Any:
    first = [cut(each) for each in itertools.islice(values, FIRST)]
    rest = f'... {len(values)} in all'
    if isinstance(values[0], (genpy.Message, genpy.TVal)):
        return [*first, _Text(rest)]
    return _Text(f"[{', '.join(map(str, first))}, {rest}]")
