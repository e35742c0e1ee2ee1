"""Classes made from the text of a definition, as genpy would have written them to a file.

The text may come from the network, so it never reaches genpy's code generator: that sees checked
field names, primitive types, and names of our own making for the types nested. The caller holds a
lock: the generator's state is global.
"""

import re
import reprlib
import types

import genmsg
from genmsg.msgs import bare_msg_type, is_builtin

from pharos.messages import lookup
from pharos.errors import UnknownTypeError
from pharos.messages.lookup import MAX_TEXT, NAME
from pharos.messages.fields import nested_classes

MAX_DEPTH = 64  # types nested in one another
# of a type and those it nests, counted wherever they occur: genpy writes code for each, 4 s for all
MAX_FIELDS = 10000
MAX_ELEMENTS = 1 << 24  # that a new message holds in its arrays of fixed length

_FIELD_TYPE = re.compile(r'(%s/)?%s(\[[0-9]{0,9}\])?' % (NAME.pattern, NAME.pattern))
_NESTED = re.compile(r'(?:\A|\n)=+[ \t]*\nMSG:(.*)')

_made = {}  # classes made here, by what they are made of


def make(kind, type_, text):
    """Return the class for a definition; ``kind`` is 'msg' or 'srv'."""
    context, spec, parts = _read(kind, type_, text)
    sizes = {}
    for part in parts:
        _measure(part, context, sizes, ())
    if (
        sum(fields for fields, _ in sizes.values()) > MAX_FIELDS
        or max(n for _, n in sizes.values()) > MAX_ELEMENTS
    ):
        raise UnknownTypeError(
            f'{type_} has more than {MAX_FIELDS} fields or {MAX_ELEMENTS} elements in all: use '
            'fewer, or arrays of variable length'
        )
    installed = lookup.installed(kind, type_)
    request_and_response = getattr(installed, '_request_class', None), getattr(
        installed, '_response_class', None
    )
    classes = _generate(
        context, sizes, {part.full_name: cls for part, cls in zip(parts, request_and_response)}
    )
    if kind == 'msg':
        return classes[type_]
    request, response = (classes[part.full_name] for part in parts)
    if (request, response) == request_and_response:
        return installed
    if (request, response) not in _made:
        genmsg.msg_loader.load_depends(context, spec, {})
        _made[request, response] = type(
            spec.short_name,
            (),
            {
                '_type': type_,
                '_md5sum': genmsg.compute_md5(context, spec),
                '_request_class': request,
                '_response_class': response,
                '__module__': spec.package + '.srv',
            },
        )
    return _made[request, response]


def _read(kind, type_, text):
    """Parse a definition with all that it nests: return genmsg's context, spec, and the specs of
    its parts."""
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
                known = lookup.find('msg', nested)
            except UnknownTypeError as error:
                raise UnknownTypeError(f'{user} has a field of an {error}') from error
            texts = {
                **split(nested, known if isinstance(known, str) else known._full_text),
                **texts,
            }
        pending += [
            (nested, field_type)
            for field_type in _parse('msg', nested, texts[nested], context)[0].types
        ]
    return context, spec, parts


def split(type_, text):
    """Return the texts of a definition, by type, with those nested in it."""
    if not isinstance(text, str) or len(text) > MAX_TEXT:
        raise UnknownTypeError(
            f'{type_}: its definition must be a str of at most {MAX_TEXT} characters'
        )
    # genpy.dynamic does the same with Header's former package
    own, *nested = _NESTED.split(
        text.replace('\r\n', '\n').replace('roslib/Header', 'std_msgs/Header')
    )
    texts = {name.strip(): nested_text[1:] for name, nested_text in zip(nested[::2], nested[1::2])}
    for name in texts:
        lookup.check_name('msg', name)
    return {**texts, type_: own}


def _parse(kind, type_, text, context):
    load = (
        genmsg.msg_loader.load_msg_from_string
        if kind == 'msg'
        else genmsg.msg_loader.load_srv_from_string
    )

    def parse(text, context):
        spec = load(context, text, type_)
        parts = (spec,) if kind == 'msg' else (spec.request, spec.response)
        for part in parts:
            for name in part.names + [constant.name for constant in part.constants]:
                if not NAME.fullmatch(name):
                    raise genmsg.InvalidMsgSpec(f'{name!r} is not a name')
            for field_type in part.types:
                if not _FIELD_TYPE.fullmatch(field_type):
                    raise genmsg.InvalidMsgSpec(f'{field_type!r} is not a type')
        return spec, parts

    try:
        return parse(text, context)
    except Exception as error:
        # genmsg does not say where: the first line that cannot stand alone, if there is one
        reason = str(error)[:200]
        for number, line in enumerate(text.split('\n'), 1):
            try:
                parse(line, genmsg.MsgContext())
            except Exception as line_error:
                reason = f'line {number}, {reprlib.repr(line)}: {str(line_error)[:200]}'
                break
        raise UnknownTypeError(
            f'{type_}: its definition cannot be read: {reason}; correct that'
        ) from error


def _measure(spec, context, sizes, users):
    """Enter numbers of fields and elements into ``sizes``, by type, nested types first."""
    if spec.full_name in users or len(users) > MAX_DEPTH:
        raise UnknownTypeError(
            f'{spec.full_name} nests itself or more than {MAX_DEPTH} types: flatten its definition'
        )
    fields = elements = 1
    for field in spec.parsed_fields():
        if not field.is_builtin and field.base_type not in sizes:
            _measure(
                context.get_registered(field.base_type), context, sizes, (*users, spec.full_name)
            )
        nested_fields, nested_elements = sizes.get(field.base_type, (1, 1))
        fields += nested_fields
        elements += nested_elements * (field.array_len or 1)
    sizes[spec.full_name] = fields, elements


def _generate(context, types_, installed):
    """Return the classes of ``types_``, nested types first: those installed if they are the same,
    else genpy's output.

    ``installed`` holds the parts of an installed service, which are not found by their names.
    """
    aliases = {type_: f'nested/T{number}' for number, type_ in enumerate(types_)}
    plain = genmsg.MsgContext.create_default()
    namespace = types.SimpleNamespace(msg=types.SimpleNamespace())
    classes = {}
    for type_, alias in aliases.items():
        spec = context.get_registered(type_)
        field_types = [
            re.sub(r'[^[]+', lambda match: aliases.get(match[0], match[0]), t, count=1)
            for t in spec.types
        ]
        plain.register(alias, genmsg.MsgSpec(field_types, spec.names, [], '', alias))
        genmsg.msg_loader.load_depends(context, spec, {})
        md5sum = genmsg.compute_md5(context, spec)
        # The md5sum alone does not tell T from T[], as ROS computes it.
        nested = [classes[t] for t in map(bare_msg_type, spec.types) if t in classes]
        key = type_, md5sum, *spec.types, *nested
        cls = _made.get(key) or installed.get(type_) or lookup.installed('msg', type_)
        if cls is None or key != (type_, cls._md5sum, *cls._slot_types, *nested_classes(cls)):
            cls = _made[key] = _write(spec, plain, alias, namespace)
            cls._type, cls._md5sum, cls._slot_types = type_, md5sum, spec.types
            cls._has_header, cls._full_text = spec.has_header(), genmsg.compute_full_text(
                context, spec
            )
            cls._classes = classes
        classes[type_] = cls
        setattr(namespace.msg, alias[7:], cls)
    return classes


def _write(spec, plain, alias, namespace):
    """Return genpy's class for the message ``alias`` of ``plain``, with the name and constants of
    ``spec``."""
    from genpy.generator import make_python_safe, msg_generator  # not loaded by rospy

    module = {'nested': namespace, '__name__': spec.package + '.msg'}
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
