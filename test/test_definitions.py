"""Definitions: any text that ROS understands gives the class that genpy makes of it."""
import io
import itertools

import genmsg
import genpy.dynamic
import geometry_msgs.msg
import pytest
import std_msgs.msg
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pharos import UnknownTypeError, define_message, define_service

SEPARATOR = '=' * 80
REAL = {'float32': st.floats(width=32, allow_nan=False), 'float64': st.floats(allow_nan=False)}
TEXTS = st.text(st.characters(blacklist_categories=['Cs']), max_size=5)
INTEGERS = {
    f'{sign}int{bits}': st.integers(
        0 if sign else -(2 ** (bits - 1)), 2 ** (bits if sign else bits - 1) - 1
    )
    for bits in (8, 16, 32, 64)
    for sign in ('', 'u')
}
VALUES = {
    **REAL,
    **INTEGERS,
    'bool': st.booleans(),
    'string': TEXTS,
    'char': st.integers(0, 255),
    'byte': st.integers(-128, 127),
    'time': st.builds(genpy.Time, st.integers(0, 2**32 - 1), st.integers(0, 10**9 - 1)),
    'duration': st.builds(
        genpy.Duration, st.integers(-(2**31), 2**31 - 1), st.integers(0, 10**9 - 1)
    ),
}
NESTED = 'geometry_msgs/Point', 'std_msgs/Header', 'Inner'  # Inner: defined in the text, too
NAMES = st.from_regex(r'\A[a-z](_?[a-z0-9]){0,8}\Z').filter(
    lambda name: name not in ('serialize', 'deserialize')
)
COMMENTS = st.sampled_from(['', '', ' # it\'s "a" comment', '\t#= --- é', '   ', ' #'])
SPACES = st.sampled_from([' ', '  ', '    '])
BLANKS = st.sampled_from(['', '', '\n', '# a line of its own\n', '   \n'])
count = itertools.count()
thoroughly = settings(
    deadline=None, max_examples=50, database=None, suppress_health_check=list(HealthCheck)
)


@st.composite
def constants(draw, name):
    """A line that defines a constant."""
    type_ = draw(st.sampled_from([*INTEGERS, *REAL, 'bool', 'string', 'char', 'byte']))
    if type_ == 'string':
        return f'string {name}={draw(st.text("abc #=", max_size=6))}'
    equals = draw(st.sampled_from(['=', ' = ', '= ', ' =']))
    value = draw(VALUES[type_].filter(lambda value: value == value and abs(value) != float('inf')))
    return f'{type_} {name}{equals}{value}{draw(COMMENTS)}'


@st.composite
def definitions(draw, types=(*VALUES, *NESTED)):
    """The text of a definition, as people write them."""
    names = draw(st.lists(NAMES, unique_by=str.lower, max_size=7))
    lines = []
    for name in names:
        if draw(st.integers(0, 4)) == 0:
            line = draw(constants(name.upper()))
        else:
            type_, array = draw(st.sampled_from(types)), draw(
                st.sampled_from(['', '[]', '[0]', '[3]'])
            )
            line = f'{type_}{array}{draw(SPACES)}{name}{draw(COMMENTS)}'
        lines.append(draw(BLANKS) + line)
    return '\n'.join(lines) + draw(st.sampled_from(['', '\n', '\n\n']))


def genmsg_context(name, inner):
    """The definitions that genmsg knows; 'Inner' has that name and text."""
    context = genmsg.MsgContext.create_default()
    for cls in geometry_msgs.msg.Point, std_msgs.msg.Header:
        genmsg.msg_loader.load_msg_from_string(context, cls._full_text, cls._type)
    genmsg.msg_loader.load_msg_from_string(context, inner, name)
    return context


def assert_like_genmsgs(cls, context, spec):
    """A message class is what genmsg says of its definition."""
    genmsg.msg_loader.load_depends(context, spec, {})
    assert cls._md5sum == genmsg.compute_md5(context, spec)
    assert cls._slot_types == spec.types
    assert cls._has_header == spec.has_header()
    assert cls._full_text == genmsg.compute_full_text(context, spec)


def fill(data, message):
    """Set the fields of a message to random values."""
    for name, type_ in zip(message.__slots__, message._slot_types):
        base, is_array, length = genmsg.msgs.parse_type(type_)
        if base not in VALUES:
            continue  # what is nested stays as it is
        sizes = dict(min_size=length or 0, max_size=4 if length is None else length)
        value = st.lists(VALUES[base], **sizes) if is_array else VALUES[base]
        setattr(message, name, data.draw(value))
    return message


def to_bytes(message):
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


# -- what ROS understands


@thoroughly
@given(definitions(), definitions(types=tuple(VALUES)), st.data())
def test_any_definition_gives_genpys_class(text, inner, data):
    number = next(count)
    name, nested = f'any_msgs/T{number}', f'any_msgs/Inner{number}'
    text = text.replace('Inner', f'Inner{number}')
    made = define_message(name, f'{text}\n{SEPARATOR}\nMSG: {nested}\n{inner}')
    context = genmsg_context(nested, inner)
    assert_like_genmsgs(made, context, genmsg.msg_loader.load_msg_from_string(context, text, name))
    truth = genpy.dynamic.generate_dynamic(name, made._full_text)[name]
    assert made.__slots__ == truth.__slots__
    constants = [each for each in vars(truth) if each.isupper()]
    assert [getattr(made, each) for each in constants] == [
        getattr(truth, each) for each in constants
    ]
    message = fill(data, made())
    sent = to_bytes(message)
    assert to_bytes(truth().deserialize(sent)) == to_bytes(made().deserialize(sent)) == sent


@thoroughly
@given(definitions(), definitions(), definitions(types=tuple(VALUES)))
def test_any_service_gives_genmsgs_md5sum(request, response, inner):
    number = next(count)
    name, nested = f'any_srvs/T{number}', f'any_srvs/Inner{number}'
    text = f'{request}\n---\n{response}'.replace('Inner', f'Inner{number}')
    define_message(nested, inner)
    made, context = define_service(name, text), genmsg_context(nested, inner)
    spec = genmsg.msg_loader.load_srv_from_string(context, text, name)
    assert_like_genmsgs(made._request_class, context, spec.request)
    assert_like_genmsgs(made._response_class, context, spec.response)
    assert made._md5sum == genmsg.compute_md5(context, spec)


@thoroughly
@given(definitions(types=tuple(VALUES)), st.data())
def test_comments_and_spaces_change_nothing(text, data):
    name = f'spaced_msgs/T{next(count)}'
    cls = define_message(name, text)
    assert define_message(name, f'# first\n\n{text}  \n# last') is cls
    assert define_message(name, text.replace('\n', '\r\n')) is cls


# -- nonsense


def test_nonsense_raises_and_names_type():
    for text in [
        'int8',
        'int8 a\n\nint8 b c\n',
        'int8 1a',
        'int8 é',
        'int8 a-b',
        'int8[-1] a',
        'int8[2][3] a',
        'int8[x] a',
        'a/b/c d',
        '../../etc a',
        'int8 X=300',
        'int8 X=a',
        'string X; import os; Y=1',
        'float32 X=__import__',
        'int8 a\nint8 a',
        'int8 serialize',
        'no_msgs/Nonsuch x',
        'Bad x',
        'Other[] x\n===\nMSG: nonsense_msgs/Other\nBad[] y',
        b'int8 a',
        None,
    ]:
        with pytest.raises(UnknownTypeError, match='nonsense_msg'):
            define_message('nonsense_msgs/Bad', text)
        with pytest.raises(UnknownTypeError):
            define_message('nonsense_msgs/User', 'Bad bad')


@pytest.mark.parametrize('text', ['int8\n---\n', '---\nint8', '---\nNo x', None], ids=repr)
def test_nonsense_service_raises_and_names_type(text):
    with pytest.raises(UnknownTypeError, match='nonsense_srvs/Bad'):
        define_service('nonsense_srvs/Bad', text)


@settings(thoroughly, max_examples=200)
@given(st.text() | st.text('int8 xyABC=#[]/"\'\\\n\r\t.-;()', max_size=60))
def test_no_text_raises_any_other_error(text):
    name = f'fuzz_msgs/T{next(count)}'
    try:
        assert define_message(name, text)._type == name
    except UnknownTypeError as error:
        assert 'fuzz_msgs' in str(error)
