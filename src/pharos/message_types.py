"""Types of messages and services, for what is built on the facade: their names and their fields."""
from pharos.messages import fields_of, known_types, message_class, nested_class

__all__ = ['fields_of', 'known_types', 'message_class', 'nested_class']
