"""Make message and service classes of definitions, for types that no installed package has."""
from __future__ import annotations

import functools
import re
import threading
from contextlib import suppress

import genmsg
from genmsg.gentools import compute_full_text, compute_md5
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
        is_other = _checksums(known_class) != _checksums(new_class)
        if is_other and key not in shipped_definitions:  # a real turtlesim may have other fields
            raise MessageTypeError(f'{type_name} is known with other fields: define another type')
    given_definitions.setdefault(key, text)
    return find_class(type_name)


def _checksums(cls):
    """Return the md5sums of a class, and of a service's request: equal for equal fields."""
    return cls._md5sum, getattr(cls, '_request_class', cls)._md5sum


def _read(load, type_name, text):
    """Return genmsg's context, which has all nested types, and the specification of a type.

    :param load: genmsg's function for the text of a message or of a service
    """
    context = genmsg.MsgContext.create_default()
    own_text, *parts = re.split(r'\n=+[ \t]*\nMSG: *', f'\n{text}')
    given_texts = {}
    for part in parts:
        name, _, nested_text = part.partition('\n')
        given_texts[name.strip()] = nested_text
    spec = load(context, own_text[1:], type_name)
    for part in getattr(spec, 'request', spec), getattr(spec, 'response', spec):
        _register_nested(context, part, given_texts)
    load_depends(context, spec, {})
    return context, spec


def _register_nested(context, spec, given_texts):
    """Register the types of the fields of a type, and those nested in them."""
    for field_type in map(bare_msg_type, spec.types):
        name = 'std_msgs/Header' if field_type == 'Header' else field_type
        if is_builtin(name) or context.is_registered(name):
            continue
        text = given_texts.get(name)
        if text is None:
            text = _nested_definition(name)
        # other types may nest this one without its definition
        given_definitions.setdefault(('msg', name), text)
        nested_spec = load_msg_from_string(context, text, name)
        context.register(name, nested_spec)
        _register_nested(context, nested_spec, given_texts)


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
    full_text = compute_full_text(*_read(load_msg_from_string, type_name, text))
    classes = generate_dynamic(type_name, f'{full_text}\n')
    cls = classes[type_name]
    cls._full_text = full_text
    for name in classes.keys() - {type_name}:  # genpy has made classes of these, too
        known_class = message_class(name)
        if known_class._md5sum == classes[name]._md5sum:
            # genpy's deserialize() makes nested messages of this name, and nested_class() reads it
            cls.serialize.__globals__['_' + name.replace('/', '__')] = known_class
    return cls


@_once
def make_service(type_name, text):
    """Return the class of a service type, as make_message() does."""
    context, spec = _read(load_srv_from_string, type_name, text)
    attributes = {
        '_type': type_name,
        '_md5sum': compute_md5(context, spec),
        '_request_class': _make_part(context, spec.request),
        '_response_class': _make_part(context, spec.response),
    }
    return type(spec.short_name, (), attributes)


def _make_part(context, spec):
    return make_message(spec.full_name, compute_full_text(context, spec))
