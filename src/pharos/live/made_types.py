"""Make the classes of types that no installed package has generated, out of their definitions."""
from __future__ import annotations

import difflib
import functools
import pathlib
import re
import sys
from contextlib import suppress
from typing import Any, Callable

import genmsg
import rospkg
from genmsg.gentools import compute_full_text, compute_md5
from genmsg.msg_loader import load_depends, load_msg_from_string, load_srv_from_string
from genmsg.msgs import bare_msg_type, is_builtin
from genpy.dynamic import generate_dynamic
from genpy.message import Message

from pharos.errors import MessageTypeError, UnknownTypeError
from pharos.messages import generated_class
from pharos.private_rospy.loader import process_lock

#: turtlesim's types as in ROS Fuerte, which the report uses; Debian has none
_TURTLESIM = '''
msg turtlesim/Color
uint8 r
uint8 g
uint8 b

msg turtlesim/Pose
float32 x
float32 y
float32 theta
float32 linear_velocity
float32 angular_velocity

msg turtlesim/Velocity
float32 linear
float32 angular

srv turtlesim/Kill
string name
---

srv turtlesim/SetPen
uint8 r
uint8 g
uint8 b
uint8 width
uint8 off
---

srv turtlesim/Spawn
float32 x
float32 y
float32 theta
string name
---
string name

srv turtlesim/TeleportAbsolute
float32 x
float32 y
float32 theta
---

srv turtlesim/TeleportRelative
float32 linear
float32 angular
---

'''
#: (suffix, type) -> definition; the suffix is msg or srv
_shipped_definitions = {
    (suffix, type_name): text
    for suffix, type_name, text in re.findall(r'(\w+) (\S+)\n(.*?\n)\n', _TURTLESIM, re.S)
}
_given_definitions: dict[tuple[str, str], str] = {}  #: as _shipped_definitions


def find_message(type_name: str, ask: Callable | None = None) -> type[Message]:
    """Do the work of :func:`pharos.message_class`."""
    return generated_class('msg', type_name) or _make_message(
        type_name, _find_definition('msg', type_name, ask)
    )


def find_service(type_name: str) -> Any:
    """Do the work of :func:`pharos.service_class`."""
    return generated_class('srv', type_name) or _make_service(
        type_name, _find_definition('srv', type_name)
    )


def define(suffix: str, type_name: str, text: str) -> Any:
    """Do the work of :func:`pharos.define_message` and :func:`pharos.define_service`."""
    find_class: Any = find_message if suffix == 'msg' else find_service
    make_class: Any = _make_message if suffix == 'msg' else _make_service
    new_class = make_class(type_name, text)
    key = suffix, type_name
    with suppress(UnknownTypeError):
        known_class = find_class(type_name)
        is_other = known_class._md5sum != new_class._md5sum
        if is_other and key not in _shipped_definitions:  # a real turtlesim may have other fields
            raise MessageTypeError(f'{type_name} is known with other fields: define another type')
    _given_definitions.setdefault(key, text)
    return find_class(type_name)


def _find_definition(suffix, type_name, ask=None):
    """Return the definition of a type that has no generated class, or raise UnknownTypeError."""
    package, name = type_name.split('/')
    # there may be no file, or the package.xml of another package cannot be parsed
    with suppress(Exception):
        folder = pathlib.Path(rospkg.RosPack().get_path(package), suffix)
        return (folder / f'{name}.{suffix}').read_text('utf-8', 'replace')
    key = suffix, type_name
    # a question takes up to connect_timeout; for turtlesim's types, which are here, it is not worth it
    if ask and key not in _shipped_definitions:
        definition = ask(type_name)
        if isinstance(definition, str):
            return definition
    for definitions in _given_definitions, _shipped_definitions:
        if key in definitions:
            return definitions[key]
    near_types = difflib.get_close_matches(type_name, known_types(suffix), cutoff=0.9)
    if near_types:
        raise UnknownTypeError(
            f'unknown type {type_name!r}: {"? ".join(near_types)}? If not, source its workspace'
        )
    function_name = 'define_message' if suffix == 'msg' else 'define_service'
    raise UnknownTypeError(
        f'unknown type {type_name!r}: Python has no {package}.{suffix}.{name}, there is no'
        f' {package}/{suffix}/{name}.{suffix} on ROS_PACKAGE_PATH'
        f' ({":".join(rospkg.get_ros_paths())}), and no definition was given; install {package} (on'
        f' Debian python3-{package.replace("_", "-")}), source its workspace, or call'
        f' {function_name}(type, text)'
    )


def known_types(suffix: str) -> set[str]:
    """Return the types that Python has packages of, and turtlesim's.

    :param suffix: msg or srv
    """
    types = {name for kind, name in _shipped_definitions if kind == suffix}
    for folder in sys.path:
        for file in pathlib.Path(folder).glob(f'*/{suffix}/_[!_]*.py'):
            types.add(f'{file.parts[-3]}/{file.stem[1:]}')
    return types


def _read(load, type_name, text):
    """Return genmsg's context, which has all nested types, and the specification of a type.

    :param load: genmsg's function for the text of a message or of a service
    """
    context = genmsg.MsgContext.create_default()
    own_text, *parts = re.split(r'(?m)^=+[ \t]*\nMSG: *', text)
    given_texts = {}
    for part in parts:
        name, _, nested_text = part.partition('\n')
        given_texts[name.strip()] = nested_text
    spec = load(context, own_text, type_name)
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
        _given_definitions.setdefault(('msg', name), text)
        nested_spec = load_msg_from_string(context, text, name)
        context.register(name, nested_spec)
        _register_nested(context, nested_spec, given_texts)


def _nested_definition(type_name):
    """Return the definition of a nested type, without the texts of further nested types."""
    installed_class = generated_class('msg', type_name)
    if installed_class:
        text = installed_class._full_text
    else:
        text = _find_definition('msg', type_name)
    return re.split(r'\n=+[ \t]*\n', text)[0]


def _once(make_class):
    """Return a function that runs once for the same arguments, in one thread at a time.

    Each exception becomes an UnknownTypeError.
    """
    cached_function = functools.lru_cache(None)(make_class)

    def make_once(type_name, text):
        try:
            with process_lock:  # genpy's generator is not thread-safe, and imports
                return cached_function(type_name, text)
        except Exception as error:
            raise UnknownTypeError(f'{type_name}: no class can be made of it: {error}') from error

    return make_once


@_once
def _make_message(type_name, text):
    """Return the class of a message type; equal arguments give the same class.

    :raises UnknownTypeError: if no class can be made
    """
    full_text = compute_full_text(*_read(load_msg_from_string, type_name, text))
    classes = generate_dynamic(type_name, f'{full_text}\n')
    cls = classes[type_name]
    cls._full_text = full_text
    for name in classes.keys() - {type_name}:  # genpy has made classes of these, too
        known_class = find_message(name)
        if known_class._md5sum == classes[name]._md5sum:
            # genpy's deserialize() makes nested messages of this name, and nested_class() reads it
            cls.serialize.__globals__['_' + name.replace('/', '__')] = known_class
    return cls


@_once
def _make_service(type_name, text):
    """Return the class of a service type, as _make_message() does."""
    context, spec = _read(load_srv_from_string, type_name, text)
    attributes = {
        '_type': type_name,
        '_md5sum': compute_md5(context, spec),
        '_request_class': _make_part(context, spec.request),
        '_response_class': _make_part(context, spec.response),
    }
    return type(spec.short_name, (), attributes)


def _make_part(context, spec):
    return _make_message(spec.full_name, compute_full_text(context, spec))
