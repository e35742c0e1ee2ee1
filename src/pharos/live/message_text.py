"""Messages as text, to be read as they come."""
from typing import Any

import genpy

LONGEST = 12  # values of an array that are shown; of longer ones, the first alone
FIRST = 3  # these many


class _Text:
    """A value that genpy writes as it is, and not as YAML has it."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __str__(self) -> str:
        return self._text


def text_of_message(message: genpy.Message) -> str:
    """A message as ``rostopic echo`` prints it, but for long arrays: the first values, and how many
    there are."""
    return str(genpy.message.strify_message(cut(message)))


def cut(value: Any) -> Any:
    """A message, or a value of a field, with long arrays cut."""
    if isinstance(value, genpy.Message):
        copy = object.__new__(type(value))
        for name in value.__slots__:
            setattr(copy, name, cut(getattr(value, name)))
        return copy
    if not isinstance(value, (list, tuple, bytes)):
        return value
    if len(value) > LONGEST:
        return _shortened(value)
    return value if isinstance(value, bytes) else [cut(each) for each in value]


def _shortened(values: Any) -> Any:
    first = [cut(each) for each in values[:FIRST]]
    rest = f'... {len(values)} in all'
    if isinstance(values[0], (genpy.Message, genpy.TVal)):
        return [*first, _Text(rest)]
    return _Text(f"[{', '.join(map(str, first))}, {rest}]")
