"""Make message and service classes of definitions, for types that no installed package has."""
from __future__ import annotations

import functools
import re
import threading
from contextlib import suppress

import genmsg
from genmsg.msg_loader import load_depends, load_msg_from_string, load_srv_from_string
from genmsg.msgs import bare_msg_type, is_builtin
from genpy.dynamic import generate_dynamic

from pharos.errors import MessageTypeError, UnknownTypeError
from pharos.messages import (
    class_of_package,
    find_definition,
    given_definitions,
    message_class,
    shipped_definitions,
)

_lock = threading.RLock()  # genpy's generator is not thread-safe


def define(suffix, type_name, text, find_class, make_class):
    """Do the work of :func:`pharos.define_message` and :func:`pharos.define_service`."""
    new_class = make_class(type_name, text)
    key = suffix, type_name
    with suppress(UnknownTypeError):
        known_class = find_class(type_name)
        is_shipped = key in shipped_definitions  # a real turtlesim may have other fields
        if _checksums(known_class) != _checksums(new_class) and not is_shipped:
            raise MessageTypeError(f'{type_name} is known with other fields: define another type')
    given_definitions.setdefault(key, text)
    return find_class(type_name)


def _checksums(cls):
    """Return the md5sums of a class, and of a service's request: equal for equal fields."""
    return cls._md5sum, getattr(cls, '_request_class', cls)._md5sum


class _Definition:
    """A definition as genmsg reads it, with the definitions of all nested types.

    :ivar context: genmsg's context, with all types
    :ivar text: the text of the type alone
    :ivar nested_texts: names of nested types -> their texts
    """

    def __init__(self, type_name, text):
        self.context = genmsg.MsgContext.create_default()
        self.nested_texts = {}
        own_text, *parts = re.split(r'\n=+[ \t]*\nMSG: *', f'\n{text}')
        self.text = own_text[1:]
        self._given_texts = {}
        for part in parts:
            name, _, nested_text = part.partition('\n')
            self._given_texts[name.strip()] = nested_text
        for part in re.split(r'^---.*$', own_text, flags=re.M):  # a service has two parts
            self._add_nested(type_name, part)

    def _add_nested(self, type_name, text):
        """Read the text of a type, and add the types of its fields, and those nested in them."""
        spec = load_msg_from_string(self.context, text, type_name)
        for field_type in map(bare_msg_type, spec.types):
            name = 'std_msgs/Header' if field_type == 'Header' else field_type
            if is_builtin(name) or name in self.nested_texts:
                continue
            nested_text = self._given_texts.get(name)
            if nested_text is None:
                nested_text = _nested_definition(name)
            self.nested_texts[name] = nested_text
            # other types may nest this one without its definition
            given_definitions.setdefault(('msg', name), nested_text)
            self._add_nested(name, nested_text)

    @property
    def nested_part(self):
        """The texts of the nested types, as they follow in a full definition."""
        texts = self.nested_texts.items()
        return ''.join(f'\n{"=" * 80}\nMSG: {name}\n{text}' for name, text in texts)


def _nested_definition(type_name):
    """Return the definition of a nested type, without the texts of further nested types."""
    installed_class = class_of_package('msg', type_name)
    if installed_class:
        text = installed_class._full_text
    else:
        text = find_definition('msg', type_name)
    return re.split(r'\n=+[ \t]*\n', text)[0]


def _once(make_class):
    """Return a function that runs once for the same arguments, in one thread at a time.

    Each exception becomes an UnknownTypeError.
    """
    cached_function = functools.lru_cache(None)(make_class)

    @functools.wraps(make_class)
    def make_once(type_name, text):
        try:
            with _lock:
                return cached_function(type_name, text)
        except Exception as error:
            raise UnknownTypeError(f'{type_name}: no class can be made of it: {error}') from error

    return make_once


@_once
def make_message(type_name, text):
    """Return the class of a message type; equal arguments give the same class.

    :raises UnknownTypeError: if no class can be made
    """
    definition = _Definition(type_name, text)
    full_text = definition.text + definition.nested_part
    classes = generate_dynamic(type_name, f'{full_text}\n')
    cls = classes[type_name]
    cls._full_text = full_text
    cls._classes = classes  # for the copier
    for name in definition.nested_texts:  # genpy has made classes of these, too
        known_class = message_class(name)
        if known_class._md5sum == classes[name]._md5sum:
            classes[name] = known_class
            # genpy's deserialize() makes nested messages of this name
            cls.serialize.__globals__['_' + name.replace('/', '__')] = known_class
    return cls


@_once
def make_service(type_name, text):
    """Return the class of a service type, as make_message() does."""
    definition = _Definition(type_name, text)
    spec = load_srv_from_string(definition.context, definition.text, type_name)
    load_depends(definition.context, spec, {})
    nested_part = definition.nested_part
    attributes = {
        '_type': type_name,
        '_md5sum': genmsg.compute_md5(definition.context, spec),
        '_request_class': make_message(f'{type_name}Request', spec.request.text + nested_part),
        '_response_class': make_message(f'{type_name}Response', spec.response.text + nested_part),
    }
    return type(spec.short_name, (), attributes)
