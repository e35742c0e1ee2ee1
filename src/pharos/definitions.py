"""Message and service types: find their classes; live/made_types.py makes those that nobody has generated."""
from __future__ import annotations

from typing import Any, Callable

from genpy.message import Message

from pharos.messages import generated_class


def message_class(type_: str | type, ask: Callable | None = None) -> type[Message]:
    """Return the class of a message type, such as ``'geometry_msgs/Twist'``.

    A type is sought in installed Python packages, then in ``.msg`` files on ROS_PACKAGE_PATH, then
    by ``ask``, but for turtlesim's. The last places are the types given to :func:`define_message`,
    and turtlesim's.

    :param type_: the name of the type; or a message class, which is returned
    :param ask: ``ask(type_)`` returns the definition that a publisher sends, or None
    :raises UnknownTypeError: if the type is not found, or its definition cannot be read
    """
    if isinstance(type_, type) and issubclass(type_, Message):
        return type_
    return generated_class('msg', type_) or _made_types().find_message(type_, ask)


def service_class(type_: Any) -> Any:
    """Return the class of a service type such as ``'std_srvs/Empty'``; see :func:`message_class`.

    :raises UnknownTypeError: if the type is not found, or its definition cannot be read
    """
    if hasattr(type_, '_request_class'):
        return type_
    return generated_class('srv', type_) or _made_types().find_service(type_)


def define_message(type_: str, text: str) -> type[Message]:
    """Define a message type by the text of a ``.msg`` file, and return its class.

    Texts of unknown nested types follow, each after a line of ``=`` and ``MSG: package/Type``.

    :raises MessageTypeError: if the type is known already, with other fields, and is not turtlesim's
    :raises UnknownTypeError: if the text cannot be read, or a nested type is not found
    """
    return _made_types().define('msg', type_, text)


def define_service(type_: str, text: str) -> Any:
    """Define a service type by the text of a ``.srv`` file, as :func:`define_message` does."""
    return _made_types().define('srv', type_, text)


def _made_types():
    """Load the maker of classes when the first one is needed."""
    from pharos.live import made_types

    return made_types
