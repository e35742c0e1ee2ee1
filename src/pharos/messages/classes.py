"""Message and service classes by type name, made at run time where no generated code is installed.

A class made here works with rospy's topics and services like an installed one. Every function may
be called from any thread.
"""

import threading

import genpy

from pharos.messages import definition, lookup
from pharos.errors import MessageTypeError, UnknownTypeError
from pharos.messages.fields import describe_fields

_lock = threading.RLock()
_given = {}  # (kind, type): class from define_message or define_service


def message_class(type_or_class):
    """Return the class of a message type, ``'package/Type'`` or ``'Header'``; a message class is
    returned as it is.

    Sought in this order: installed Python packages, ``.msg`` files on ROS_PACKAGE_PATH, what
    :func:`define_message` was given, and what this package ships for turtlesim. A subscriber asks
        the live publishers of its topic before it takes
    one of the last two. Raises `UnknownTypeError`.
    """
    if isinstance(type_or_class, type) and issubclass(type_or_class, genpy.Message):
        return type_or_class
    return _class('msg', 'std_msgs/Header' if type_or_class == 'Header' else type_or_class)


def is_provisional(cls):
    """Whether the class is that of its type here, but of no package: given at run time, or shipped
    for turtlesim."""
    key = 'msg', cls._type
    return key in lookup.provisional and lookup.found.get(key) is cls


def service_class(type_or_class):
    """Return the class of a service type, ``'package/Type'``, as :func:`message_class` does with
    ``.srv`` files."""
    if isinstance(type_or_class, type) and hasattr(type_or_class, '_request_class'):
        return type_or_class
    return _class('srv', type_or_class)


def define_message(type_, text):
    """Define the message type ``'package/Type'`` by the text of a ``.msg`` file and return its
    class.

    Types that it nests may follow, each after a line of ``=`` and a line ``MSG: package/Type``, as
    ``gendeps --cat`` prints them; those that are not known yet are thereby defined too. Raises
    `UnknownTypeError` for a text that cannot be read or refers to an unknown type, and
    `MessageTypeError` if the type is known with other fields.
    """
    return _define('msg', type_, text)


def define_service(type_, text):
    """Define the service type ``'package/Type'`` by the text of a ``.srv`` file, as
    :func:`define_message` does."""
    return _define('srv', type_, text)


def known_service_classes(type_):
    """Return the classes of all definitions of a service type that are here, whichever
    :func:`service_class` gives."""
    classes = []
    with _lock:
        for known in lookup.everywhere('srv', type_):
            try:
                cls = definition.make('srv', type_, known) if isinstance(known, str) else known
            except UnknownTypeError:  # a text that cannot be read tells nobody anything
                continue
            classes.append(cls)
    return classes


def describe_service(cls):
    """Return the fields of a service class as a text: ``'request: data: bool; response: no
    fields'``."""
    request, response = map(describe_fields, (cls._request_class, cls._response_class))
    return f'request: {request}; response: {response}'


def class_from_definition(type_, full_text, md5sum=None):
    """Return the class for a message type as a peer describes it in its connection header, nested
    types included.

    The installed class is returned if it is the same. Nothing is defined for later. Raises
    `UnknownTypeError` for a text that cannot be read, and `MessageTypeError` if the text has not
    the ``md5sum`` given.
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


def _class(kind, type_):
    lookup.check_name(kind, type_)
    with _lock:
        cls = lookup.find(kind, type_)
        if isinstance(cls, str):
            cls = definition.make(kind, type_, cls)
        lookup.found[kind, type_] = cls
        return cls


def _define(kind, type_, text):
    lookup.check_name(kind, type_)
    with _lock:
        cls = definition.make(kind, type_, text)
        key = kind, type_
        before = _given.get(key) or lookup.installed(kind, type_) or lookup.file_text(kind, type_)
        if before is None:
            lookup.provisional.add(key)
        if isinstance(before, str):
            before = definition.make(kind, type_, before)
        if before not in (None, cls):
            raise MessageTypeError(
                f'{type_} is known already, with md5sum {before._md5sum} and other fields or '
                'constants than in the text now given: give the same text, or define another type'
            )
        _given[key] = lookup.found[key] = cls
        classes = getattr(getattr(cls, '_request_class', cls), '_classes', {})
        for nested in classes.keys() & definition.split(type_, text).keys() - {type_}:
            if lookup.find('msg', nested, must=False) is None:
                _given['msg', nested] = lookup.found['msg', nested] = classes[nested]
                lookup.provisional.add(('msg', nested))
        return cls
