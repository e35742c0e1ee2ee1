"""Message and service types: classes by name, made from definitions, filled by name."""
from __future__ import annotations

import contextlib
import functools
import re
import threading
from typing import Any, Callable

import genmsg
import genpy.dynamic
import rospkg
from genmsg.msgs import bare_msg_type, is_builtin
from rospy.impl.tcpros_service import convert_return_to_response as as_rospy

from pharos.errors import MessageTypeError, UnknownTypeError
from pharos.intraprocess.copier import copied, nested_class

_TYPE = re.compile(r'[A-Za-z][A-Za-z0-9_]{0,127}/[A-Za-z][A-Za-z0-9_]{0,127}')
_RULE = '=' * 80
_COLOUR = 'uint8 r\nuint8 g\nuint8 b\n'
_PLACE = 'float32 x\nfloat32 y\nfloat32 theta\n'
_VELOCITY = 'float32 linear\nfloat32 angular\n'
#: the definitions of turtlesim's types as in ROS Fuerte, which the report uses; Debian has none
TURTLESIM = {
    ('msg', 'turtlesim/Color'): _COLOUR,
    ('msg', 'turtlesim/Pose'): _PLACE + '\nfloat32 linear_velocity\nfloat32 angular_velocity\n',
    ('msg', 'turtlesim/Velocity'): _VELOCITY,
    ('srv', 'turtlesim/Kill'): 'string name\n---\n',
    ('srv', 'turtlesim/SetPen'): _COLOUR + 'uint8 width\nuint8 off\n---\n',
    ('srv', 'turtlesim/Spawn'): _PLACE + 'string name\n---\nstring name\n',
    ('srv', 'turtlesim/TeleportAbsolute'): _PLACE + '---\n',
    ('srv', 'turtlesim/TeleportRelative'): _VELOCITY + '---\n',
}
_defined = {}
_lock = threading.RLock()  # genpy's generator is not thread-safe


def message_class(type_: str | type, ask: Callable | None = None) -> type[genpy.Message]:
    """Return the class of a message type, such as ``'geometry_msgs/Twist'``.

    Types are sought in installed Python packages, in ``.msg`` files on ROS_PACKAGE_PATH, among those
    given to :func:`define_message`, and among turtlesim's. A message class is returned as it is.

    :param ask: ``ask(type_)`` returns the definition that a publisher sends, or None
    :raises UnknownTypeError: if the type is nowhere, or its definition cannot be read
    """
    if isinstance(type_, type) and issubclass(type_, genpy.Message):
        return type_
    return _installed('msg', type_) or _made_message(type_, _text_of('msg', type_, ask))


def service_class(type_: Any) -> Any:
    """Return the class of a service type, sought as :func:`message_class` does."""
    if hasattr(type_, '_request_class'):
        return type_
    return _installed('srv', type_) or _made_service(type_, _text_of('srv', type_))


def define_message(type_: str, text: str) -> type[genpy.Message]:
    """Define a message type by the text of a ``.msg`` file, and return its class.

    Nested types follow after a line of ``=`` and ``MSG: package/Type``, if they are not known.

    :raises MessageTypeError: if the type is known already, with other fields
    """
    return _define('msg', type_, text, message_class, _made_message)


def define_service(type_: str, text: str) -> Any:
    """Define a service type by the text of a ``.srv`` file, as :func:`define_message` does."""
    return _define('srv', type_, text, service_class, _made_service)


def _define(kind, type_, text, find, make):
    check_name(type_)
    for name, nested in _Definition(type_, text).nested.items():
        _defined.setdefault(('msg', name), nested)
    cls = make(type_, text)
    with contextlib.suppress(UnknownTypeError):
        known = find(type_)
        if _fields(known) != _fields(cls) and (kind, type_) not in TURTLESIM:
            raise MessageTypeError(f'{type_} is known with other fields: define another type')
    _defined.setdefault((kind, type_), text)
    return find(type_)


def _fields(cls):
    return cls._md5sum, getattr(cls, '_request_class', cls)._md5sum


def check_name(type_: Any) -> None:
    """Raise UnknownTypeError unless it can be the name of a type."""
    if not (isinstance(type_, str) and _TYPE.fullmatch(type_)):
        raise UnknownTypeError(
            f"malformed type {type_!r}: give 'package/Type', such as 'std_msgs/String', or a class"
        )


def _installed(kind, type_):
    check_name(type_)
    get = genpy.message.get_message_class if kind == 'msg' else genpy.message.get_service_class
    cls = get(type_)
    return cls if kind == 'msg' or hasattr(cls, '_request_class') else None


def _file_text(kind, type_):
    package, name = type_.split('/')
    try:
        path = f'{rospkg.RosPack().get_path(package)}/{kind}/{name}.{kind}'
        with open(path, encoding='utf-8', errors='replace') as file:
            return file.read()
    except Exception:  # there is none; or another package.xml cannot be parsed
        return None


def _text_of(kind, type_, ask=None):
    """Return the definition of a type that has no generated class."""
    key, (package, name) = (kind, type_), type_.split('/')
    text = _file_text(*key)
    if text is None and ask and key not in TURTLESIM:
        text = ask(type_)
    text = _defined.get(key, TURTLESIM.get(key)) if text is None else text
    if text is None:
        define = 'define_message' if kind == 'msg' else 'define_service'
        raise UnknownTypeError(
            f'unknown type {type_!r}: Python has no {package}.{kind}.{name}, there is no'
            f' {package}/{kind}/{name}.{kind} on ROS_PACKAGE_PATH'
            f' ({":".join(rospkg.get_ros_paths())}), and no definition was given; install {package}'
            f' or call {define}({type_!r}, text)'
        )
    return text


class _Definition:
    """A definition with all that it nests.

    :ivar own: its text, without those that it nests
    :ivar nested: the texts of nested types, by type
    """

    def __init__(self, type_: str, text: str):
        self.type, self.nested = type_, {}
        self.context = genmsg.MsgContext.create_default()
        self.own, *parts = re.split(r'\n=+[ \t]*\nMSG: *', f'\n{text}')
        self.own = self.own[1:]
        given = {part.partition('\n')[0].strip(): part.partition('\n')[2] for part in parts}
        for part in re.split(r'^---.*$', self.own, flags=re.M):  # of a service there are two
            self._add_nested(type_, part, given)

    def _add_nested(self, name, text, given):
        try:
            spec = genmsg.msg_loader.load_msg_from_string(self.context, text, name)
            for field in map(bare_msg_type, spec.types):
                field = 'std_msgs/Header' if field == 'Header' else field
                if is_builtin(field) or field in self.nested:
                    continue
                if field not in given:
                    installed = _installed('msg', field)
                    full = installed._full_text if installed else _text_of('msg', field)
                    given = {**given, field: re.split(r'\n=+[ \t]*\n', full)[0]}
                self.nested[field] = given[field]
                self._add_nested(field, given[field], given)
        except Exception as error:
            raise UnknownTypeError(
                f'{self.type}: the definition of {name} cannot be read: {error}'
            ) from error

    @property
    def tail(self) -> str:
        """The nested definitions, as they follow in a full text."""
        return ''.join(f'\n{_RULE}\nMSG: {name}\n{text}' for name, text in self.nested.items())


def _made(make):
    """Have a function run once for the same arguments, in one thread at a time."""
    cached = functools.lru_cache(None)(make)

    def made(*args):
        with _lock:
            return cached(*args)

    return made


@_made
def _made_message(type_, text):
    definition = _Definition(type_, text)
    full = definition.own + definition.tail
    try:
        classes = genpy.dynamic.generate_dynamic(type_, full + '\n')
    except Exception as error:
        raise UnknownTypeError(f'{type_}: no class can be made of it: {error}') from error
    cls = classes[type_]
    cls._full_text, cls._classes = full, classes  # these are for the copier
    for name in definition.nested:  # genpy has made classes of these, too
        with contextlib.suppress(UnknownTypeError):
            known = message_class(name)
            if known._md5sum == classes[name]._md5sum:
                classes[name] = known
                cls.serialize.__globals__['_' + name.replace('/', '__')] = known
    return cls


@_made
def _made_service(type_, text):
    definition = _Definition(type_, text)
    try:
        spec = genmsg.msg_loader.load_srv_from_string(definition.context, definition.own, type_)
        genmsg.msg_loader.load_depends(definition.context, spec, {})
        md5sum = genmsg.compute_md5(definition.context, spec)
    except Exception as error:
        raise UnknownTypeError(f'{type_}: its definition cannot be read: {error}') from error
    request, response = (
        _made_message(f'{type_}{kind}', part.text + definition.tail)
        for kind, part in (('Request', spec.request), ('Response', spec.response))
    )
    attributes = {'_request_class': request, '_response_class': response}
    return type(spec.short_name, (), {'_type': type_, '_md5sum': md5sum, **attributes})


# -- filling


def describe(cls: Any) -> str:
    """Return the fields of a message class as text."""
    types = getattr(cls, '_slot_types', ())
    return ', '.join(f'{name}: {type_}' for name, type_ in zip(cls.__slots__, types)) or 'no fields'


def build(cls: Any, filler: Callable | dict | genpy.Message | None, fields: dict) -> genpy.Message:
    """Return a message that ``filler(message)`` and keywords fill, or ``filler``, if it is one.

    Dicts fill nested messages, and a list of dicts an array of them. numpy arrays are taken for
    arrays of numbers.

    :raises MessageTypeError: for a field that does not exist
    """
    if isinstance(filler, genpy.Message):
        if fields:
            raise MessageTypeError(
                f'a ready {filler._type} is sent as it is: set {", ".join(fields)} in it before'
            )
        return filler
    message = cls()
    if isinstance(filler, dict):
        fields = {**filler, **fields}
    elif callable(filler):
        made = filler(message)
        if isinstance(made, genpy.Message) and made is not message:
            raise MessageTypeError('the block is to fill the message that it gets, not another one')
    elif filler is not None:
        raise MessageTypeError(
            f'{cls._type} is filled by a block, a dict or keywords, or is a message; not {filler!r}'
        )
    return _fill(message, fields)


def response(cls: Any, value: Any) -> genpy.Message:
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
            value = _fill(nested_class(base, cls)(), value)
        elif type(value) is list and value and type(value[0]) is dict:
            value = [_fill(nested_class(base, cls)(), each) for each in value]
        setattr(message, name, value)
    return message


def explain(message: genpy.Message, error: Exception) -> MessageTypeError:
    """Return our error for what serializing a message raised, with the path of the field."""
    path, reason = _wrong_field(message) or ('', error)
    where = f'.{path}' if path else ''
    return MessageTypeError(f'{message._type}{where} cannot be sent: {reason}')


def _wrong_field(message):
    for name, type_ in zip(message.__slots__, message._slot_types):
        value = getattr(message, name, None)
        if isinstance(value, genpy.Message):
            found = _wrong_field(value)
            if found:
                return f'{name}.{found[0]}', found[1]
            continue
        try:
            genpy.message.check_type(name, type_, value)
        except genpy.SerializationError as error:
            return name, f'expected {type_}, got {str(value)[:80]!r} ({error})'
        except Exception as error:
            return name, error
    return None
