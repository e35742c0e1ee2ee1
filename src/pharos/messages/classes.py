"""Message and service classes by type name, made at run time where no generated code is installed.

A class made here works with rospy's topics and services like an installed one. Every function may
be called from any thread.
"""
import os
import threading
from typing import Any, Dict, List, Optional, Union

import genpy

from pharos.errors import MessageTypeError, UnknownTypeError
from pharos.messages import definition, lookup
from pharos.messages.fields import MessageClass, describe_fields

_lock = threading.RLock()
_given: Dict[lookup.Key, type] = {}  # classes from define_message or define_service


def message_class(type_or_class: Union[str, MessageClass]) -> MessageClass:
    """The class of a message type, ``'package/Type'`` or ``'Header'``; a message class is returned
    as it is.

    Sought in this order: installed Python packages, ``.msg`` files on ROS_PACKAGE_PATH, what
    :func:`define_message` was given, and what this package ships for turtlesim. A subscriber asks
    the live publishers of its topic before it takes one of the last two.

    :raises UnknownTypeError: if it is not found, or what is found cannot be read
    """
    if isinstance(type_or_class, type) and issubclass(type_or_class, genpy.Message):
        if type_or_class is not genpy.Message:
            return type_or_class
    return _class('msg', 'std_msgs/Header' if type_or_class == 'Header' else type_or_class)


def is_provisional(cls: MessageClass) -> bool:
    """Whether the class is that of its type here, but of no package: given at run time, or shipped
    for turtlesim."""
    key = 'msg', cls._type
    return key in lookup.provisional and lookup.found.get(key) is cls


def service_class(type_or_class: Union[str, type]) -> Any:
    """The class of a service type, ``'package/Type'``, as :func:`message_class` does with ``.srv``
    files."""
    if isinstance(type_or_class, type) and hasattr(type_or_class, '_request_class'):
        return type_or_class
    return _class('srv', type_or_class)


def define_message(type_: str, text: str) -> MessageClass:
    """Define the message type ``'package/Type'`` by the text of a ``.msg`` file; returns its class.

    Types that it nests may follow, each after a line of ``=`` and a line ``MSG: package/Type``, as
    ``gendeps --cat`` prints them; those that are not known yet are thereby defined too.

    :raises UnknownTypeError: for a text that cannot be read or refers to an unknown type
    :raises MessageTypeError: if the type is known with other fields
    """
    return _define('msg', type_, text)


def define_service(type_: str, text: str) -> Any:
    """Define the service type ``'package/Type'`` by the text of a ``.srv`` file, as
    :func:`define_message` does."""
    return _define('srv', type_, text)


def known_service_classes(type_: str) -> List[Any]:
    """The classes of all definitions of a service type that are here, whichever
    :func:`service_class` gives."""
    classes = []
    with _lock:
        for known in lookup.everywhere('srv', type_):
            try:
                classes.append(_made('srv', type_, known))
            except UnknownTypeError:  # a text that cannot be read tells nobody anything
                continue
    return classes


def describe_service(cls: Any) -> str:
    """The fields of a service class as a text: ``'request: data: bool; response: no fields'``."""
    request, response = map(describe_fields, (cls._request_class, cls._response_class))
    return f'request: {request}; response: {response}'


def class_from_definition(type_: Any, full_text: Any, md5sum: Optional[str] = None) -> MessageClass:
    """The class for a message type as a peer describes it in its connection header, nested types
    included.

    The installed class is returned if it is the same. Nothing is defined for later.

    :raises UnknownTypeError: for a text that cannot be read
    :raises MessageTypeError: if the text has not the ``md5sum`` given
    """
    lookup.check_name('msg', type_)
    with _lock:
        cls = definition.make('msg', type_, full_text)
    if md5sum not in (None, '*', cls._md5sum):
        raise MessageTypeError(
            f'{type_} was announced with md5sum {md5sum}, but its definition has {cls._md5sum} '
            f'({describe_fields(cls)}): build the peer anew, its message code is inconsistent'
        )
    return cls


def _made(kind: str, type_: str, known: lookup.Known) -> Any:
    return definition.make(kind, type_, known) if isinstance(known, str) else known


def _class(kind: str, type_: Any) -> Any:
    lookup.check_name(kind, type_)
    with _lock:
        cls = _made(kind, type_, lookup.find(kind, type_))
        lookup.found[kind, type_] = cls
        return cls


def _define(kind: str, type_: str, text: str) -> Any:
    lookup.check_name(kind, type_)
    key = kind, type_
    with _lock:
        cls = definition.make(kind, type_, text)
        before = _given.get(key) or lookup.installed(*key) or lookup.file_text(*key)
        if before is None:
            lookup.provisional.add(key)
        elif _made(kind, type_, before) is not cls:
            raise MessageTypeError(
                f'{type_} is known already, with md5sum {_made(kind, type_, before)._md5sum} and'
                ' other fields or constants than in the text now given: give the same text, or'
                ' define another type'
            )
        _given[key] = lookup.found[key] = cls
        classes = getattr(getattr(cls, '_request_class', cls), '_classes', {})
        for nested in classes.keys() & definition.split(type_, text).keys() - {type_}:
            if not lookup.everywhere('msg', nested):
                _given['msg', nested] = lookup.found['msg', nested] = classes[nested]
                lookup.provisional.add(('msg', nested))
        return cls


def _forget() -> None:
    """In a process that was forked, perhaps while another thread made a class."""
    global _lock
    _lock = threading.RLock()


os.register_at_fork(after_in_child=_forget)
