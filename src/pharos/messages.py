"""Message and service types: classes by name, made from definitions, filled by name."""
import functools
import pathlib
import re
import threading
from contextlib import suppress
from typing import Callable

import genmsg
import rospkg
from catkin_pkg.package import InvalidPackage
from genmsg.msg_loader import load_depends, load_msg_from_string, load_srv_from_string
from genmsg.msgs import bare_msg_type, is_builtin
from genpy.dynamic import generate_dynamic
from genpy.message import Message, get_message_class, get_service_class
from rospy.impl.tcpros_service import convert_return_to_response as as_rospy

from pharos.errors import MessageTypeError, UnknownTypeError
from pharos.intraprocess.copier import copied, nested_class

_TYPE = re.compile(r'[A-Za-z][A-Za-z0-9_]{0,127}/[A-Za-z][A-Za-z0-9_]{0,127}')
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
#: (msg or srv, type) -> definition
_shipped = {
    (kind, type_): text
    for kind, type_, text in re.findall(r'(\w+) (\S+)\n(.*?\n)\n', _TURTLESIM, re.S)
}
_defined = {}
_lock = threading.RLock()  # genpy's generator is not thread-safe


def message_class(type_: str | type, ask: Callable | None = None) -> type[Message]:
    """Return the class of a message type, such as ``'geometry_msgs/Twist'``.

    Types are sought in installed Python packages, in ``.msg`` files on ROS_PACKAGE_PATH, among those
    given to :func:`define_message`, and among turtlesim's. A message class is returned as it is.

    :param ask: ``ask(type_)`` returns the definition that a publisher sends, or None
    :raises UnknownTypeError: if the type is nowhere, or its definition cannot be read
    """
    if isinstance(type_, type) and issubclass(type_, Message):
        return type_
    return _installed('msg', type_) or _made_message(type_, _text_of('msg', type_, ask))


def service_class(type_):
    """Return the class of a service type, sought as :func:`message_class` does."""
    if hasattr(type_, '_request_class'):
        return type_
    return _installed('srv', type_) or _made_service(type_, _text_of('srv', type_))


def define_message(type_: str, text: str) -> type[Message]:
    """Define a message type by the text of a ``.msg`` file, and return its class.

    Nested types follow after a line of ``=`` and ``MSG: package/Type``, if they are not known.

    :raises MessageTypeError: if the type is known already, with other fields
    """
    return _define('msg', type_, text, message_class, _made_message)


def define_service(type_: str, text: str):
    """Define a service type by the text of a ``.srv`` file, as :func:`define_message` does."""
    return _define('srv', type_, text, service_class, _made_service)


def _define(kind, type_, text, find, make):
    cls = make(type_, text)
    with suppress(UnknownTypeError):
        if _fields(find(type_)) != _fields(cls) and (kind, type_) not in _shipped:
            raise MessageTypeError(f'{type_} is known with other fields: define another type')
    _defined.setdefault((kind, type_), text)
    return find(type_)


def _fields(cls):
    return cls._md5sum, getattr(cls, '_request_class', cls)._md5sum


def _installed(kind, type_):
    if not (isinstance(type_, str) and _TYPE.fullmatch(type_)):
        raise UnknownTypeError(
            f"malformed type {type_!r}: give 'package/Type', such as 'std_msgs/String', or a class"
        )
    get = get_message_class if kind == 'msg' else get_service_class
    try:
        return get(type_)
    except InvalidPackage:  # genpy reads package.xml; there may be a file of the type all the same
        return None


def _text_of(kind, type_, ask=None):
    """Return the definition of a type that has no generated class."""
    key, (package, name) = (kind, type_), type_.split('/')
    with suppress(Exception):  # there is no file; or another package.xml cannot be parsed
        folder = pathlib.Path(rospkg.RosPack().get_path(package), kind)
        return (folder / f'{name}.{kind}').read_text('utf-8', 'replace')
    asked = ask and key not in _shipped and ask(type_)
    for text in asked, _defined.get(key), _shipped.get(key):
        if isinstance(text, str):
            return text
    raise UnknownTypeError(
        f'unknown type {type_!r}: Python has no {package}.{kind}.{name}, there is no'
        f' {package}/{kind}/{name}.{kind} on ROS_PACKAGE_PATH'
        f' ({":".join(rospkg.get_ros_paths())}), and no definition was given; install {package}, source'
        f' its workspace, or call define_{"message" if kind == "msg" else "service"}(type, text)'
    )


def _read(type_, text):
    """Return genmsg's context of a definition, its own text, that of what it nests, and their names."""
    context, nested = genmsg.MsgContext.create_default(), {}
    own, *parts = re.split(r'\n=+[ \t]*\nMSG: *', f'\n{text}')
    given = {part.partition('\n')[0].strip(): part.partition('\n')[2] for part in parts}

    def add_nested(name, text):
        for field in map(bare_msg_type, load_msg_from_string(context, text, name).types):
            field = 'std_msgs/Header' if field == 'Header' else field
            if is_builtin(field) or field in nested:
                continue
            if field not in given:
                installed = _installed('msg', field)
                full = installed._full_text if installed else _text_of('msg', field)
                given[field] = re.split(r'\n=+[ \t]*\n', full)[0]
            nested[field] = given[field]
            _defined.setdefault(('msg', field), given[field])
            add_nested(field, given[field])

    for part in re.split(r'^---.*$', own, flags=re.M):  # of a service there are two
        add_nested(type_, part)
    tail = ''.join(f'\n{"=" * 80}\nMSG: {name}\n{text}' for name, text in nested.items())
    return context, own[1:], tail, nested


def _made(make):
    """Have a function run once for the same arguments, in one thread at a time."""
    cached = functools.cache(make)

    def made(type_, text):
        try:
            with _lock:
                return cached(type_, text)
        except Exception as error:
            raise UnknownTypeError(f'{type_}: no class can be made of it: {error}') from error

    return made


@_made
def _made_message(type_, text):
    _, own, tail, nested = _read(type_, text)
    classes = generate_dynamic(type_, f'{own}{tail}\n')
    cls = classes[type_]
    cls._full_text, cls._classes = own + tail, classes  # these are for the copier
    for name in nested:  # genpy has made classes of these, too
        known = message_class(name)
        if known._md5sum == classes[name]._md5sum:
            classes[name] = known
            cls.serialize.__globals__['_' + name.replace('/', '__')] = known
    return cls


@_made
def _made_service(type_, text):
    context, own, tail, _ = _read(type_, text)
    spec = load_srv_from_string(context, own, type_)
    load_depends(context, spec, {})
    md5sum = genmsg.compute_md5(context, spec)
    request, response = (
        _made_message(f'{type_}{kind}', part.text + tail)
        for kind, part in (('Request', spec.request), ('Response', spec.response))
    )
    attributes = {'_request_class': request, '_response_class': response}
    return type(spec.short_name, (), {'_type': type_, '_md5sum': md5sum, **attributes})


# -- filling


def describe(cls):
    """Return the fields of a message class as text."""
    fields = zip(cls.__slots__, cls._slot_types)
    return ', '.join(f'{name}: {type_}' for name, type_ in fields) or 'no fields'


def build(cls, filler, fields):
    """Return a message that ``filler(message)`` fills or returns, or ``filler``, if it is one.

    Keywords fill it, too. Dicts fill nested messages, and a list of dicts an array of them. numpy arrays are taken for
    arrays of numbers.

    :raises MessageTypeError: for a field that does not exist
    """
    message = cls()
    if callable(filler):
        made = filler(message)
        filler = made if isinstance(made, Message) else None
    if isinstance(filler, dict):
        fields = {**filler, **fields}
    elif isinstance(filler, Message):
        message = filler
    elif filler is not None:
        raise MessageTypeError(
            f'{cls._type} is filled by a block, a dict or keywords, or is a message; not {filler!r}'
        )
    return _fill(message, fields)


def response(cls, value):
    """Return the response for what the block of a service returned: a response, a dict, tuple or
    list of its fields, or its only field; None if it has no fields.

    :raises MessageTypeError: if it does not fit
    """
    names = cls.__slots__
    if value is None and not names:
        value = {}
    elif len(names) == 1 and type(value) is list and cls._slot_types[0].endswith(']'):
        if not (value and type(value[0]) is list):
            value = {names[0]: value}
    return check(_fill(cls(), value) if type(value) is dict else as_rospy(value, cls))


def check(message):
    """Return a copy of the message; raise MessageTypeError if it cannot be sent."""
    try:
        return copied(message)
    except Exception as error:
        raise explain(message, error) from error


def _fill(message, fields):
    cls = type(message)
    types = dict(zip(cls.__slots__, cls._slot_types))
    for name, value in fields.items():
        if name not in types:
            raise MessageTypeError(f'{cls._type} has no field {name!r}; it has {describe(cls)}')
        base = types[name].partition('[')[0]
        if type(value) is dict:
            value = _fill(_nested_class(base, cls)(), value)
        elif type(value) is list and dict in map(type, value[:1]):
            value = [_fill(_nested_class(base, cls)(), each) for each in value]
        setattr(message, name, value)
    return message


def _nested_class(base, cls):
    """Return the class of a nested field; genpy.dynamic puts them into one module, under such names."""
    beside = cls.serialize.__globals__.get('_' + base.replace('/', '__'))
    return beside or nested_class(base, cls)


def explain(message, error):
    """Return our error for what serializing a message raised; genpy names the field."""
    try:
        message._check_types()
    except Exception as found:
        error = found
    return MessageTypeError(f'{message._type} cannot be sent: {error}: {str(message)[:200]!r}')
