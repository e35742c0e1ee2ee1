"""Message and service types by their names: looked up, defined, filled, checked.

- classes: the class of a type, by name or from a definition that is given
- lookup: where types are sought: installed packages, files, those that turtlesim has
- definition: a class made from the text of a definition
- fields: what a message holds: described, filled by name, checked
- numeric_field: what takes a number out of a message, by its path; loaded only when used
- from_publishers: the class of a topic's messages as its publishers define it
- turtlesim: the definitions of turtlesim's types
"""
from pharos.messages.classes import (
    class_from_definition,
    define_message,
    define_service,
    describe_service,
    is_provisional,
    known_service_classes,
    message_class,
    service_class,
)
from pharos.messages.fields import (
    add_fields,
    build,
    check_alone,
    check_fits,
    check_not_hidden,
    describe_fields,
    explain,
    fields_of,
    fill,
    nested_class,
    ready_or_built,
)
from pharos.messages.from_publishers import (
    class_from_publishers,
    class_of_header,
    explain_refusal,
)
from pharos.messages.lookup import known_types

__all__ = [
    'add_fields',
    'build',
    'check_alone',
    'check_fits',
    'check_not_hidden',
    'class_from_definition',
    'class_from_publishers',
    'class_of_header',
    'define_message',
    'define_service',
    'describe_fields',
    'describe_service',
    'explain',
    'explain_refusal',
    'fields_of',
    'fill',
    'is_provisional',
    'known_service_classes',
    'known_types',
    'message_class',
    'nested_class',
    'ready_or_built',
    'service_class',
]
