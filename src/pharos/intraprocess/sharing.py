"""Messages that several nodes hold at once: nothing may be written into them any more.

A channel with ``shared=True`` gets the published message itself. Whoever publishes it again, or
another message with its header, would write the next ``header.seq`` and ``_connection_header`` into
what the others hold.
"""
import copy
from typing import Any, Dict

import genpy


class Mark(Dict[str, str]):
    """The ``_connection_header`` of the messages that one publisher hands over, and of their
    headers."""

    is_used = False  # whether there is any

    def put_on(self, message: genpy.Message) -> genpy.Message:
        """Mark a message that is handed over; returns it, or a copy if it is held as another
        publisher's already."""
        if not Mark.is_used:  # each assignment would flush what the interpreter caches of the class
            Mark.is_used = True
        if is_held(message) and message._connection_header != self:
            message = _copied(message)
        message._connection_header = self
        if getattr(message, '_has_header', False):
            message.header._connection_header = self
        return message


def is_held(message: Any) -> bool:
    """Whether a message or header has been handed over, so that others hold it."""
    return type(getattr(message, '_connection_header', None)) is Mark


def with_own_header(message: genpy.Message) -> genpy.Message:
    """The message, whose header others hold, with a header of its own; a copy of it if they hold
    the message, too."""
    if is_held(message):
        message = _copied(message)
    message.header = _copied(message.header)
    return message


def _copied(message: Any) -> Any:
    """A copy with the same fields, and no mark.

    Whoever publishes one message again and again has two made each time, and ``copy`` takes five
    times as long.
    """
    if not isinstance(message, genpy.Message):
        return copy.copy(message)
    new = object.__new__(message.__class__)
    for name in message.__slots__:
        setattr(new, name, getattr(message, name))
    return new


def numbered(message: genpy.Message, seq: int) -> genpy.Message:
    """The message with that ``header.seq``, as rospy.msg.serialize_message numbers messages,
    services' among them.

    A copy if others hold it.
    """
    if getattr(message, '_has_header', False):
        if is_held(message.header):
            message = with_own_header(message)
        message.header.seq = seq
    return message
