"""Format numbers and messages as text."""
import genpy

MAX_ITEMS = 12  # items of an array, and lines of a text, that are shown
LINE_LENGTH = 80


def short_number(value: float) -> str:
    """Return a number in at most five characters: 9.9, 120, 1.2k, 35M."""
    for unit in '', 'k', 'M':
        if abs(value) < 999.5:
            if value > 99 or value == int(value):
                return f'{value:.0f}{unit}'
            return f'{value:.1f}{unit}'
        value /= 1000
    return f'{value:.1f}G'


def message_text(message: genpy.Message) -> str:
    """Return a message as ``rostopic echo`` prints it, with long arrays and texts cut."""
    return genpy.message.strify_message(_short_value(message))


def _short_value(value):
    """Return a copy of a message, or of a value in one, that is short enough to be shown."""
    if isinstance(value, genpy.Message):
        message = object.__new__(type(value))  # skips the default values of __init__
        for field in value.__slots__:
            setattr(message, field, _short_value(getattr(value, field)))
        return message
    max_length = MAX_ITEMS * LINE_LENGTH
    if isinstance(value, str) and len(value) > max_length:
        return f'{value[:max_length]} ... {len(value)} in all'
    if isinstance(value, (bytes, list, tuple)) and len(value) > MAX_ITEMS:
        first_items = ', '.join(str(_short_value(item)) for item in value[:3])
        return _PlainText(f'[{first_items}, ... {len(value)} in all]')
    return value


class _PlainText:
    """A text that genpy writes without quotes, since it is not a str."""

    def __init__(self, text):
        self._text = text

    def __str__(self):
        return self._text
