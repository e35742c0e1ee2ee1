"""Format messages as text."""
import genpy

MAX_LINES = 50  # of a message that are shown
MAX_LENGTH = 200  # characters of a line


def message_text(message: genpy.Message) -> str:
    """Return a message as ``rostopic echo`` prints it, with long lines and long messages cut."""
    lines = genpy.message.strify_message(message).splitlines()
    texts = [_short_line(line) for line in lines[:MAX_LINES]]
    if len(lines) > MAX_LINES:
        texts.append(f'... {len(lines)} lines')
    return '\n'.join(texts)


def _short_line(line):
    return line if len(line) <= MAX_LENGTH else f'{line[:MAX_LENGTH]} ... {len(line)} characters'
