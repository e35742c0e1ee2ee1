"""Message and service types by name, their definitions, and messages filled by name."""
from pharos.messages.building import build, convert_numpy, describe, explain, response
from pharos.messages.types import (
    class_from_definition,
    define_message,
    define_service,
    message_class,
    service_class,
)

__all__ = [
    'build',
    'class_from_definition',
    'convert_numpy',
    'define_message',
    'define_service',
    'describe',
    'explain',
    'message_class',
    'response',
    'service_class',
]
