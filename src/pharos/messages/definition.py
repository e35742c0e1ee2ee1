"""Classes made from the text of a definition, as genpy would have written them to a file.

The text may come from the network, so it never reaches genpy's code generator: that sees checked
field names, primitive types, and names of our own making for the types nested. genpy.dynamic is not
used: it makes a new class per call, makes sys.path longer, and leaves files behind for a bad text.

The caller holds a lock: the generator's state is global.
"""
import re
import reprlib
import types
from typing import Any, Dict, List, Tuple

import genmsg
from genmsg.msgs import bare_msg_type, is_builtin

from pharos.errors import UnknownTypeError
from pharos.messages import lookup
from pharos.messages.fields import MessageClass, nested_classes
from pharos.messages.lookup import MAX_TEXT, NAME

MAX_DEPTH = 64  # types nested in one another
# of a type and those it nests, counted wherever they occur: genpy writes code for each, 4 s for all
MAX_FIELDS = 10000
MAX_ELEMENTS = 1 << 24  # that a new message holds in its arrays of fixed length

_FIELD_TYPE = re.compile(rf'({NAME.pattern}/)?{NAME.pattern}(\[[0-9]{{0,9}}\])?')
_NESTED = re.compile(r'(?:\A|\n)=+[ \t]*\nMSG:(.*)')

_made: Dict[Tuple[Any, ...], type] = {}  # classes made here, by what they are made of


def make(kind: str, type_: str, text: str) -> Any:
    """The class for a definition.

    :param kind: 'msg' or 'srv'
    :raises UnknownTypeError: if the text cannot be read, or Python can have no class for it
    """
    context, spec, parts = _read(kind, type_, text)
    sizes: Dict[str, Tuple[int, int]] = {}
    for part in parts:
        _measure(part, context, sizes, ())
    fields, elements = zip(*sizes.values())
    if sum(fields) > MAX_FIELDS or max(elements) > MAX_ELEMENTS:
        raise UnknownTypeError(
            f'{type_} has more than {MAX_FIELDS} fields or {MAX_ELEMENTS} elements in all: use '
            'fewer, or arrays of variable length'
        )
    if kind == 'msg':
        return _generate(context, list(sizes), {})[type_]
    installed: Any = lookup.installed(kind, type_)
    own = getattr(installed, '_request_class', None), getattr(installed, '_response_class', None)
    names = [part.full_name for part in parts]
    classes = _generate(context, list(sizes), dict(zip(names, own)))
    request, response = (classes[name] for name in names)
    if (request, response) == own:
        return installed
    if (request, response) not in _made:
        genmsg.msg_loader.load_depends(context, spec, {})
        attributes = {
            '_type': type_,
            '_md5sum': genmsg.compute_md5(context, spec),
            '_request_class': request,
            '_response_class': response,
            '__module__': spec.package + '.srv',
        }
        _made[request, response] = type(spec.short_name, (), attributes)
    return _made[request, response]


def _read(
    kind: str, type_: str, text: str
) -> Tuple[genmsg.MsgContext, Any, Tuple[genmsg.MsgSpec, ...]]:
    """Parse a definition with all that it nests: genmsg's context, spec, and the specs of its
    parts."""
    context = genmsg.MsgContext.create_default()
    texts = split(type_, text)
    spec, parts = _parse(kind, type_, texts[type_], context)
    pending = [(type_, field_type) for part in parts for field_type in part.types]
    while pending:
        user, nested = pending.pop()
        nested = bare_msg_type(nested)
        if is_builtin(nested) or context.is_registered(nested):
            continue
        if nested not in texts:
            try:
                known: Any = lookup.find('msg', nested)
            except UnknownTypeError as error:
                raise UnknownTypeError(f'{user} has a field of an {error}') from error
            known_text = known if isinstance(known, str) else known._full_text
            texts = {**split(nested, known_text), **texts}
        nested_spec, _ = _parse('msg', nested, texts[nested], context)
        pending += [(nested, field_type) for field_type in nested_spec.types]
    return context, spec, parts


def split(type_: str, text: Any) -> Dict[str, str]:
    """The texts of a definition, by type, with those nested in it.

    :raises UnknownTypeError: if it is no str or too long, or what is nested has no name
    """
    if not isinstance(text, str) or len(text) > MAX_TEXT:
        raise UnknownTypeError(
            f'{type_}: its definition must be a str of at most {MAX_TEXT} characters'
        )
    # genpy.dynamic does the same with Header's former package
    text = text.replace('\r\n', '\n').replace('roslib/Header', 'std_msgs/Header')
    own, *nested = _NESTED.split(text)
    texts = {name.strip(): nested_text[1:] for name, nested_text in zip(nested[::2], nested[1::2])}
    for name in texts:
        lookup.check_name('msg', name)
    return {**texts, type_: own}


def _parse(
    kind: str, type_: str, text: str, context: genmsg.MsgContext
) -> Tuple[Any, Tuple[genmsg.MsgSpec, ...]]:
    """The spec of a text, and of its parts: itself, or a service's request and response."""
    try:
        return _load(kind, type_, text, context)
    except Exception as error:
        # genmsg does not say where: the first line that cannot stand alone, if there is one
        reason = str(error)[:200]
        for number, line in enumerate(text.split('\n'), 1):
            try:
                _load(kind, type_, line, genmsg.MsgContext())
            except Exception as line_error:
                reason = f'line {number}, {reprlib.repr(line)}: {str(line_error)[:200]}'
                break
        raise UnknownTypeError(
            f'{type_}: its definition cannot be read: {reason}; correct that'
        ) from error


def _load(
    kind: str, type_: str, text: str, context: genmsg.MsgContext
) -> Tuple[Any, Tuple[genmsg.MsgSpec, ...]]:
    loader = genmsg.msg_loader
    if kind == 'msg':
        spec = loader.load_msg_from_string(context, text, type_)
        parts: Tuple[genmsg.MsgSpec, ...] = (spec,)
    else:
        spec = loader.load_srv_from_string(context, text, type_)
        parts = spec.request, spec.response
    for part in parts:
        for name in part.names + [constant.name for constant in part.constants]:
            if not NAME.fullmatch(name):
                raise genmsg.InvalidMsgSpec(f'{name!r} is not a name')
        for field_type in part.types:
            if not _FIELD_TYPE.fullmatch(field_type):
                raise genmsg.InvalidMsgSpec(f'{field_type!r} is not a type')
    return spec, parts


def _measure(
    spec: genmsg.MsgSpec,
    context: genmsg.MsgContext,
    sizes: Dict[str, Tuple[int, int]],
    users: Tuple[str, ...],
) -> None:
    """Enter numbers of fields and elements into ``sizes``, by type, nested types first.

    :param users: the types that nest this one
    """
    if spec.full_name in users or len(users) > MAX_DEPTH:
        raise UnknownTypeError(
            f'{spec.full_name} nests itself or more than {MAX_DEPTH} types: flatten its definition'
        )
    fields = elements = 1
    for field in spec.parsed_fields():
        if not field.is_builtin and field.base_type not in sizes:
            nested = context.get_registered(field.base_type)
            _measure(nested, context, sizes, (*users, spec.full_name))
        nested_fields, nested_elements = sizes.get(field.base_type, (1, 1))
        fields += nested_fields
        elements += nested_elements * (field.array_len or 1)
    sizes[spec.full_name] = fields, elements


def _generate(
    context: genmsg.MsgContext, names: List[str], installed: Dict[str, Any]
) -> Dict[str, MessageClass]:
    """The classes of the types named, nested types first: those installed if they are the same,
    else genpy's output.

    :param installed: the parts of an installed service, which are not found by their names
    """
    aliases = {name: f'nested/T{number}' for number, name in enumerate(names)}
    plain = genmsg.MsgContext.create_default()
    namespace = types.SimpleNamespace(msg=types.SimpleNamespace())
    classes: Dict[str, MessageClass] = {}
    for name, alias in aliases.items():
        spec = context.get_registered(name)
        plain_types = []
        for field_type in spec.types:
            base = bare_msg_type(field_type)
            plain_types.append(aliases.get(base, base) + field_type[len(base) :])
        plain.register(alias, genmsg.MsgSpec(plain_types, spec.names, [], '', alias))
        genmsg.msg_loader.load_depends(context, spec, {})
        md5sum = genmsg.compute_md5(context, spec)
        # The md5sum alone does not tell T from T[], as ROS computes it.
        nested = [classes[t] for t in map(bare_msg_type, spec.types) if t in classes]
        key = name, md5sum, *spec.types, *nested
        cls: Any = _made.get(key) or installed.get(name) or lookup.installed('msg', name)
        if cls is None or key != (name, cls._md5sum, *cls._slot_types, *nested_classes(cls)):
            cls = _made[key] = _write(spec, plain, alias, namespace)
            cls._type, cls._md5sum, cls._slot_types = name, md5sum, spec.types
            cls._has_header = spec.has_header()
            cls._full_text = genmsg.compute_full_text(context, spec)
            cls._classes = classes
        classes[name] = cls
        setattr(namespace.msg, alias[7:], cls)
    return classes


def _write(
    spec: genmsg.MsgSpec, plain: genmsg.MsgContext, alias: str, namespace: types.SimpleNamespace
) -> Any:
    """genpy's class for the message ``alias`` of ``plain``, with the name and constants of
    ``spec``."""
    # rospy does not load it, and it takes 60 ms
    from genpy.generator import make_python_safe, msg_generator

    module: Dict[str, Any] = {'nested': namespace, '__name__': spec.package + '.msg'}
    try:
        lines = msg_generator(plain, plain.get_registered(alias), {})
        source = '\n'.join(line for line in lines if line != 'import nested.msg')
        exec(compile(source, f'<{spec.full_name}, written by genpy>', 'exec'), module)
        cls = module[alias[7:]]
        for constant in make_python_safe(spec).constants:
            if hasattr(cls, constant.name):
                raise ValueError(f'the name of the constant {constant.name} is taken')
            setattr(cls, constant.name, constant.val)
    except Exception as error:
        # for example a field named serialize, or 21 arrays nested in one another
        raise UnknownTypeError(
            f'{spec.full_name}: Python can have no class for its definition: {error}; '
            'choose other names or a flatter definition'
        ) from error
    cls.__name__ = cls.__qualname__ = spec.short_name
    return cls
