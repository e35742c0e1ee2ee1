"""Copies made in process: equal in value and type to what the wire would have delivered."""
import array
import collections
import gc
import importlib
import inspect
import io
import pathlib
import random
import struct
import sys
import types

import genpy.dynamic
import numpy
import pytest
import std_msgs.msg
from genmsg.msgs import parse_type
from geometry_msgs.msg import Point, Point32, Polygon, Twist, Vector3
from rospy.numpy_msg import numpy_msg
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage

pytestmark = pytest.mark.filterwarnings('ignore')
SEPARATOR = '\n' + '=' * 80 + '\n'
PRIMITIVES = 'bool int8 uint8 int16 uint16 int32 uint32 int64 uint64 float32 float64 char byte'
PRIMITIVES = f'{PRIMITIVES} string time duration'.split()
TYPES = {**dict(zip(PRIMITIVES, PRIMITIVES)), 'Header': 'std_msgs/Header'}
TYPES.update(Leaf='made_up/Leaf', Empty='made_up/Empty')
FIELDS = '{1} a_{0}\n{1}[] some_{0}\n{1}[3] three_{0}\n'
#: a field of each kind: alone, in an array, and in an array of three
TEXTS = [
    ''.join(FIELDS.format(kind, type_) for kind, type_ in TYPES.items()),
    f'MSG: std_msgs/Header\n{std_msgs.msg.Header._full_text}',
    'MSG: made_up/Leaf\nduration age\nstring[] names\nfloat32[2] pair\nbool[2] flags\n',
    'MSG: made_up/Empty\n',
]
NAME = 'made_up/Everything'
EVERYTHING = genpy.dynamic.generate_dynamic(NAME, SEPARATOR.join(TEXTS))[NAME]
PYTHON_PACKAGES = pathlib.Path(std_msgs.__file__).parent.parent
PACKAGES = {path.parent.parent.name for path in PYTHON_PACKAGES.glob('*/msg/__init__.py')}
PACKAGES |= {path.parent.parent.name for path in PYTHON_PACKAGES.glob('*/srv/__init__.py')}


def copier(cls):
    """The functions ``freeze(message)`` and ``thaw(frozen)``: all that is asked of a core."""
    from pharos.intraprocess.copier import copier_for

    return copier_for(cls)[:2]


class Text(str):
    """A str that is not quite one."""


ODD = [
    *(None, 1.5, -1, True, 7, 2**70, 10**400, 1e39, -0.0, float('nan')),
    *('', 'text', 'Straße', '\ud800', Text('text'), b'', b'ab', b'abcd', bytearray(b'abc')),
    *(memoryview(b'abc'), (), {}, {1: 2}, {0.5}, [1, 0, 7], (1, 2, 3), [0.5] * 3, [None], [-1]),
    *([1e39], [2**70], ['a', 'b'], ['\ud800'], [b'a'], range(3), array.array('h', [1, 2, 3])),
    *(collections.deque([1, 2, 3]), Vector3(), genpy.Time(1, 2), genpy.Duration(-1, 5)),
    *([genpy.Time(1, 2)] * 3, types.SimpleNamespace(secs=1, nsecs=2), numpy.bool_(True)),
    *(numpy.float32(0.1), numpy.float64(0.1), numpy.int64(3), numpy.array(3)),
    *(numpy.array([1, 2, 3], dtype) for dtype in ('u1', 'i4', '>i2', 'f2', 'f4', '>f8')),
    *(numpy.array([True]), numpy.array([300, -1]), numpy.array([1j]), numpy.zeros((1, 3))),
]


def random_value(chance, cls, type_):
    """A value of a field that the wire takes."""
    base, is_array, length = parse_type(type_)
    if is_array:
        count = chance.randint(0, 3) if length is None else length
        items = [random_value(chance, cls, base) for _ in range(count)]
        if base in ('uint8', 'char'):
            return chance.choice([list, tuple, bytes, bytearray])(items)
        with_numpy = [numpy.array] if base in ('float32', 'float64', 'int32') else []
        return chance.choice([list, tuple, *with_numpy])(items)
    if base in ('float32', 'float64'):
        return chance.choice([chance.uniform(-1e30, 1e30), -0.0, 5, float('inf'), float('nan')])
    if base == 'bool':
        return chance.choice([True, False, 1])
    if base in genpy.base.SIMPLE_TYPES:
        code = genpy.base.SIMPLE_TYPES_DICT[base]
        bits, low = 8 * struct.calcsize(code), -1 if code.islower() else 0
        return chance.randrange(low << bits - 1, 1 << bits + low)
    if base == 'string':
        return ''.join(chance.choices('aé道 \n', k=chance.randint(0, 4)))
    if base in ('time', 'duration'):
        value = genpy.Time() if base == 'time' else genpy.Duration()
        value.secs, value.nsecs = chance.randint(0, 2**31 - 1), chance.randint(0, 2**31 - 1)
        return value
    package, name = base.split('/')
    module = cls.deserialize.__globals__  # genpy's code knows the classes that it nests
    nested = module.get(f'_{package}__{name}')
    return random_message(chance, nested or getattr(module[package].msg, name))


def random_message(chance, cls):
    return cls(*[random_value(chance, cls, type_) for type_ in cls._slot_types])


def to_bytes(message):
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


def told(value):
    """A value as tuples, which are equal only if all values and types in it are: 1 is not 1.0."""
    if isinstance(value, (genpy.Message, genpy.TVal)):
        return type(value), *[told(getattr(value, name)) for name in value.__slots__]
    if isinstance(value, (list, tuple)):
        return type(value), *map(told, value)
    if isinstance(value, numpy.ndarray):
        return value.dtype.str, value.tobytes()
    return type(value), struct.pack('<d', value) if isinstance(value, float) else value


def mutables(value):
    """The ids of all that could be changed in place."""
    if isinstance(value, (genpy.Message, genpy.TVal)):
        return {id(value)}.union(*(mutables(getattr(value, name)) for name in value.__slots__))
    if isinstance(value, (list, tuple)):
        return ({id(value)} if isinstance(value, list) else set()).union(*map(mutables, value))
    return {id(value)} if isinstance(value, (bytearray, numpy.ndarray)) else set()


def assert_as_on_the_wire(message, takes_more=False):
    """It arrives, or is refused, as by the wire; no two receivers share what can be changed.

    :param takes_more: True: what the wire refuses may arrive
    """
    freeze, thaw = copier(type(message))
    try:
        expected = type(message)().deserialize(to_bytes(message))
    except Exception as error:
        if not takes_more:
            with pytest.raises(type(error)):
                freeze(message)
        return
    frozen = freeze(message)
    first, second = thaw(frozen), thaw(frozen)
    assert told(first) == told(second) == told(expected)
    assert not mutables(first) & mutables(second)
    assert not mutables(message) & (mutables(first) | mutables(second))


# -- any message


def test_messages_of_package_arrive_alike():
    for package in sorted(PACKAGES):
        chance = random.Random(package)
        for kind in 'msg', 'srv':
            if not (PYTHON_PACKAGES / package / kind).is_dir():
                continue
            for cls in vars(importlib.import_module(f'{package}.{kind}')).values():
                if inspect.isclass(cls) and issubclass(cls, genpy.Message):
                    for message in [cls(), *[random_message(chance, cls) for _ in range(5)]]:
                        assert_as_on_the_wire(message)


def test_messages_of_all_fields_arrive_alike():
    chance = random.Random(1)
    for _ in range(50):
        assert_as_on_the_wire(random_message(chance, EVERYTHING))


def test_odd_values_arrive_or_fail_alike():
    for kind in TYPES:
        chance = random.Random(kind)
        for name in f'a_{kind}', f'some_{kind}', f'three_{kind}':
            for value in ODD:
                message = random_message(chance, EVERYTHING)
                setattr(message, name, value)
                is_array = isinstance(value, numpy.ndarray)  # rospy takes these for some types
                assert_as_on_the_wire(message, takes_more=is_array)


def test_odd_nested_values_arrive_alike():
    for value in [*ODD[:3], types.SimpleNamespace(x=1, y=2, z=3), Vector3(x='a')]:
        for message in Twist(linear=value), TFMessage([value]), TFMessage(value):
            assert_as_on_the_wire(message)


def test_elements_of_a_similar_class_arrive_alike():
    assert_as_on_the_wire(Polygon([Point(0.1, 2, 3), Vector3(4, 5, 6)]))


# -- classes that are not genpy's plain ones


class Shouted(std_msgs.msg.String):
    def serialize(self, buffer):
        std_msgs.msg.String(self.data.upper()).serialize(buffer)


@pytest.mark.parametrize(
    'message',
    [
        Shouted('text'),
        pytest.param(
            numpy_msg(std_msgs.msg.Float32MultiArray)(data=numpy.array([1, 2], 'f4')),
            marks=pytest.mark.skipif(
                not hasattr(numpy.ndarray, 'tostring'), reason='genpy needs ndarray.tostring'
            ),
        ),
    ],
    ids=lambda message: type(message).__name__,
)
def test_unusual_class_arrives_as_it_serializes(message):
    freeze, thaw = copier(type(message))
    received = thaw(freeze(message))
    assert type(received) is type(message)
    expected = type(message)().deserialize(to_bytes(message))
    assert to_bytes(received) == to_bytes(expected)


def test_subclass_arrives_as_publishers_class():
    freeze, thaw = copier(std_msgs.msg.String)
    received = thaw(freeze(Shouted('text')))
    assert (type(received), received.data) == (std_msgs.msg.String, 'TEXT')


@pytest.mark.parametrize(
    'message',
    [Polygon([Point32(1, 2, 3)] * 12), JointState(name=['a', 'b', 'c'] * 4)],
    ids=['messages', 'strings'],
)
def test_profiler_disturbs_no_copy(message):
    """It looks at all objects, and holds some that a copy is about to make."""
    freeze, thaw = copier(type(message))
    held = []
    sys.setprofile(lambda *event: held.__setitem__(slice(None), gc.get_objects(0)))
    try:
        frozen = freeze(message)
    finally:
        sys.setprofile(None)
    assert thaw(frozen) == message
