"""A copy made in process cannot be told from one that went over the wire.

The wire is genpy's serialize() followed by deserialize(): the tests compare with that, never with
values of their own, but for a few sentences at the end that spell out what the wire does.
"""
import array
import collections
import enum
import gc
import importlib
import inspect
import struct
import types
import weakref

import genpy
import genpy.dynamic
import numpy
import pytest
import rospy.msg
from genmsg.msgs import parse_type
from geometry_msgs.msg import Pose, PoseArray, PoseStamped, TransformStamped, Twist, Vector3
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rospy.numpy_msg import numpy_msg
from sensor_msgs.msg import CameraInfo, Image, JointState, LaserScan, PointCloud2
from std_msgs.msg import ByteMultiArray, Empty, Float32, Float64, Header, String
from std_msgs.msg import Bool, Duration, Float32MultiArray, Time, UInt8MultiArray
from tf2_msgs.msg import TFMessage

from helpers import serializes_numpy
from pharos.intraprocess.copier import copier_for, serialized, thawer

# Among the wrong values are some that numpy, or genpy on its way, warns of.
pytestmark = pytest.mark.filterwarnings('ignore')

# A type of each kind of field, made at run time, in which even the nested classes are not the
# installed ones.
PRIMITIVES = 'bool int8 uint8 int16 uint16 int32 uint32 int64 uint64 float32 float64 char byte string time duration'
SEPARATOR = '\n' + '=' * 80 + '\n'
DEFINITION = SEPARATOR.join(
    [
        'Header header\nInner inner\nInner[] inners\nInner[2] two_inners\nEmpty empty\nEmpty[] empties\n'
        + '\n'.join(
            '{0} a_{0}\n{0}[] some_{0}\n{0}[3] three_{0}'.format(primitive)
            for primitive in PRIMITIVES.split()
        ),
        'MSG: std_msgs/Header\n' + Header._full_text,
        'MSG: made_up/Inner\nstd_msgs/Header header\ntime stamp\nmade_up/Leaf[] leaves\nbool yes\nfloat64 from',
        'MSG: made_up/Leaf\nduration age\nstring[] names\nfloat32[2] pair\nbool[2] flags',
        'MSG: made_up/Empty\n',
    ]
)
EVERYTHING = genpy.dynamic.generate_dynamic('made_up/Everything', DEFINITION)['made_up/Everything']

TYPES = """
    std_msgs/Empty std_msgs/String std_msgs/Bool std_msgs/Byte std_msgs/Char std_msgs/Int64 std_msgs/Float32
    std_msgs/Time std_msgs/Duration std_msgs/Header std_msgs/ColorRGBA std_msgs/Float64MultiArray
    std_msgs/UInt8MultiArray
    geometry_msgs/Twist geometry_msgs/PoseStamped geometry_msgs/PoseWithCovarianceStamped
    geometry_msgs/PolygonStamped
    sensor_msgs/Image sensor_msgs/PointCloud2 sensor_msgs/LaserScan sensor_msgs/JointState sensor_msgs/CameraInfo
    sensor_msgs/BatteryState sensor_msgs/MultiDOFJointState nav_msgs/Odometry nav_msgs/OccupancyGrid nav_msgs/Path
    nav_msgs/MapMetaData diagnostic_msgs/DiagnosticArray tf2_msgs/TFMessage rosgraph_msgs/Log rosgraph_msgs/Clock
    rosgraph_msgs/TopicStatistics actionlib_msgs/GoalStatusArray actionlib_msgs/GoalID
""".split()
CLASSES = [genpy.message.get_message_class(name) for name in TYPES] + [EVERYTHING]


# Random messages


class Level(enum.IntEnum):
    LOW = 1


class Text(str):
    """A str that is not quite one."""


class RospyTime(genpy.Time):
    """As rospy.Time is."""


def integers(base):
    bits, signed = int(base.strip('uint') or 8), not base.startswith('u')
    return (
        st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        if signed
        else st.integers(0, 2**bits - 1)
    )


def numbers(base):
    """Values of a number field that the wire takes."""
    if base in ('float32', 'float64'):
        real = st.floats(width=int(base[5:]))
        others = st.integers(-9, 9) | st.sampled_from([True, -0.0])
        return real | st.floats(-1e30, 1e30) | real.map(numpy.float64) | others
    plain = integers({'bool': 'uint8', 'char': 'uint8', 'byte': 'int8'}.get(base, base))
    return plain | st.booleans() | st.just(Level.LOW) | st.integers(0, 127).map(numpy.int64)


def arrays(base, length):
    """Values of a number array that the wire takes, in all their containers."""
    size = {} if length is None else dict(min_size=length, max_size=length)
    plain = st.lists(numbers(base), **{'max_size': 4, **size})
    if base in ('uint8', 'char'):
        return (
            plain
            | plain.map(tuple)
            | plain.map(bytes)
            | plain.map(bytearray)
            | st.binary(max_size=5)
        )
    small = st.lists(st.integers(0, 100), **{'max_size': 4, **size})
    dtypes = ['i1', 'u1', '>i2', 'i4', 'i8', 'u8'] + (
        ['f2', 'f4', '>f4', 'f8', 'g'] if 'float' in base else []
    )
    from_numpy = st.builds(numpy.array, small, st.sampled_from(dtypes))
    if base in ('float32', 'float64'):
        from_numpy |= st.builds(
            numpy.array, st.lists(st.floats(width=32), **size), st.sampled_from(['f4', 'f8'])
        )
    others = small.map(collections.deque) | small.map(lambda items: array.array('h', items))
    return plain | plain.map(tuple) | from_numpy | others


WRONG = [
    None,
    1.5,
    -1,
    2**70,
    10**400,
    1e39,
    '',
    'text',
    '\ud800',
    Text('text'),
    b'',
    b'ab',
    memoryview(b'abc'),
    (),
    {},
    {1: 2},
    {0.5},
    [None],
    [-1],
    [1e39],
    [2**70],
    ['\ud800'],
    Empty(),
    Vector3(),
    genpy.Time(),
    types.SimpleNamespace(secs=1, nsecs=2),
    types.SimpleNamespace(x=1, y=2, z=3),
    numpy.bool_(True),
    numpy.float32(0.1),
    numpy.array(3),
    numpy.array([True]),
    numpy.array([300, -1]),
    numpy.array([1 + 0j]),
    numpy.array([1, None]),
    numpy.array(['2020-01-01'], 'M8[ns]'),
    numpy.array([[1.0, 2.0]]),
    numpy.array([[1], [2], [3]]),
    numpy.ma.array([1, 2], mask=[0, 1]),
]


def times(base):
    unset = {'time': genpy.Time, 'duration': genpy.Duration}[base]
    number = integers('uint32' if base == 'time' else 'int32')

    def make(cls, secs, nsecs):
        value = cls()
        value.secs, value.nsecs = secs, nsecs  # not canonical, as the constructor would make it
        return value

    return st.builds(
        make, st.sampled_from([unset, RospyTime]), number, number | st.integers(0, 999999999)
    )


@st.composite
def messages(draw, cls, wrong=False):
    """A message with random values; where wrong, one in a few of them is likely to be refused."""
    message = cls()
    for name, type_name in zip(cls.__slots__, cls._slot_types):
        if wrong and draw(st.integers(0, 2 * len(cls.__slots__) + 1)) == 0:
            setattr(message, name, draw(st.sampled_from(WRONG)))
        else:
            setattr(message, name, draw(values(type(message), type_name, wrong)))
    return message


def values(cls, type_name, wrong):
    base, is_array, length = parse_type(type_name)
    if base in genpy.base.SIMPLE_TYPES:
        return arrays(base, length) if is_array else numbers(base)
    if base == 'string':
        element = st.text(st.characters(blacklist_categories=['Cs']), max_size=4)
    elif base in ('time', 'duration'):
        element = times(base)
    else:
        package, name = base.split('/')
        module = cls.deserialize.__globals__
        element = messages(
            module.get(f'_{package}__{name}') or getattr(module[package].msg, name), wrong
        )
    if not is_array:
        return element
    elements = st.lists(element, min_size=length or 0, max_size=2 if length is None else length)
    return elements | elements.map(tuple)


# Comparing


def wire(message):
    return type(message)().deserialize(serialized(message))


def told(value):
    """A value as tuples, equal only if the value and type of everything in it are: 1 is not 1.0,
    nan is nan."""
    kind = type(value)
    if isinstance(value, (genpy.Message, genpy.rostime.TVal)):
        assert not hasattr(value, '_connection_header')
        assert not hasattr(value, '__dict__')
        return kind, *[(name, told(getattr(value, name))) for name in value.__slots__]
    if kind in (list, tuple):
        return kind, *map(told, value)
    if kind is numpy.ndarray:
        return kind, value.dtype.str, value.tobytes()
    assert kind in (bool, int, float, str, bytes)
    return kind, struct.pack('<d', value) if kind is float else value


def mutables(value):
    """The ids of everything in a value that could be changed in place."""
    if isinstance(value, (genpy.Message, genpy.rostime.TVal)):
        return {id(value)}.union(*(mutables(getattr(value, name)) for name in value.__slots__))
    if isinstance(value, (list, tuple, collections.deque)):
        return ({id(value)} if not isinstance(value, tuple) else set()).union(*map(mutables, value))
    return {id(value)} if isinstance(value, (bytearray, numpy.ndarray, array.array)) else set()


def is_immutable(frozen):
    if type(frozen) is tuple:
        return all(map(is_immutable, frozen))
    return type(frozen) in (bool, int, float, str, bytes)


def assert_as_on_the_wire(message):
    copier = copier_for(type(message))
    try:
        expected = wire(message)
    except Exception as error:
        with pytest.raises(type(error)) as caught:
            copier.freeze(message)
        assert caught.type is type(error)
        assert str(caught.value) == str(error)
        return
    frozen = copier.freeze(message)
    assert is_immutable(frozen)
    first, second = copier.thaw(frozen), copier.thaw(frozen)
    assert told(first) == told(second) == told(expected)
    assert not mutables(first) & mutables(second)
    assert not mutables(first) & mutables(message)


def frozen_fast(message):
    """What freeze gives, provided that it did not take the wire."""
    frozen = copier_for(type(message)).freeze(message)
    assert type(frozen) is tuple
    return frozen


def copy(message):
    return copier_for(type(message)).thaw(frozen_fast(message))


# Any message at all

quickly = settings(
    deadline=None, max_examples=20, database=None, suppress_health_check=list(HealthCheck)
)
each_class = pytest.mark.parametrize('cls', CLASSES, ids=lambda cls: cls._type)


@each_class
def test_random_values_arrive_as_on_the_wire(cls):
    @quickly
    @given(messages(cls))
    def test(message):
        assert_as_on_the_wire(message)

    test()


@each_class
def test_wrong_values_arrive_or_are_refused_as_on_the_wire(cls):
    @quickly
    @given(messages(cls, wrong=True))
    def test(message):
        assert_as_on_the_wire(message)

    test()


@each_class
def test_a_new_message_is_copied_without_the_wire(cls):
    assert told(copy(cls())) == told(wire(cls()))


@pytest.mark.parametrize('name', EVERYTHING.__slots__)
def test_each_wrong_value_in_each_kind_of_field(name):
    for value in WRONG:
        message = EVERYTHING()
        setattr(message, name, value)
        assert_as_on_the_wire(message)


@pytest.mark.parametrize(
    'package',
    [
        'actionlib',
        'actionlib_msgs',
        'diagnostic_msgs',
        'geometry_msgs',
        'nav_msgs',
        'rosgraph_msgs',
        'sensor_msgs',
        'std_msgs',
        'tf2_msgs',
    ],
)
def test_every_installed_class_has_generated_functions(package):
    for kind in ('msg', 'srv'):
        try:
            module = importlib.import_module(f'{package}.{kind}')
        except ImportError:
            continue
        for cls in vars(module).values():
            if inspect.isclass(cls) and issubclass(cls, genpy.Message):
                assert copier_for(cls).freeze_fields, cls
                assert_as_on_the_wire(cls())


# What the wire does that surprises, without the wire


def test_a_float32_is_rounded():
    assert copy(Float32(0.1)).data == struct.unpack('<f', struct.pack('<f', 0.1))[0] != 0.1


def test_an_int_in_a_float_field_arrives_as_a_float():
    assert told(copy(Twist(linear=Vector3(1, 2.0, 3))).linear) == told(Vector3(1.0, 2.0, 3.0))


def test_a_float_of_numpy_arrives_as_a_plain_one():
    assert told(copy(Float64(numpy.float64(0.1))).data) == told(0.1)


def test_a_bool_given_as_7_arrives_as_true():
    assert copy(Bool(7)).data is True


@pytest.mark.parametrize('number', [-0.0, float('inf'), float('-inf'), float('nan'), 5e-324])
def test_special_floats_keep_every_bit(number):
    assert told(copy(Float64(number)).data) == told(number)
    assert told(copy(LaserScan(ranges=[number])).ranges) == told(
        wire(LaserScan(ranges=[number])).ranges
    )


def test_number_arrays_arrive_as_tuples():
    received = copy(JointState(position=[1, 2.5], velocity=numpy.array([1.0, 2.0]), effort=(1.0,)))
    assert told((received.position, received.velocity, received.effort)) == told(
        ((1.0, 2.5), (1.0, 2.0), (1.0,))
    )


@pytest.mark.parametrize('dtype', ['f2', 'f4', 'f8', '>f8', 'i4', 'u1'])
def test_an_array_of_numpy_needs_no_wire(dtype):
    message = Float32MultiArray(data=numpy.array([1, 2, 3], dtype))
    assert told(copy(message).data) == told((1.0, 2.0, 3.0))


def test_a_bool_array_arrives_as_a_list_of_bools():
    received = copy(EVERYTHING(some_bool=(1, 0, 7), three_bool=[True, False, 2]))
    assert told((received.some_bool, received.three_bool)) == told(
        ([True, False, True], [True, False, True])
    )


@pytest.mark.parametrize('kind', [bytes, bytearray, list, tuple])
def test_uint8_and_char_arrays_arrive_as_bytes(kind):
    received = copy(
        EVERYTHING(some_uint8=kind(b'ab'), some_char=kind(b'cd'), three_uint8=kind(b'efg'))
    )
    assert told((received.some_uint8, received.some_char, received.three_uint8)) == told(
        (b'ab', b'cd', b'efg')
    )


def test_a_byte_array_is_one_of_signed_numbers():
    assert copy(ByteMultiArray(data=[-1, 1])).data == (-1, 1)


@pytest.mark.parametrize(
    'sent, arriving', [(b'abcd', b'abc'), (bytearray(b'abcd'), b'abc'), (b'a', b'a\0\0')]
)
def test_bytes_are_cut_or_padded_to_a_fixed_length(sent, arriving):
    message = EVERYTHING(three_uint8=sent)
    copier = copier_for(EVERYTHING)
    assert told(copier.thaw(copier.freeze(message)).three_uint8) == told(arriving)


@pytest.mark.parametrize('data', [numpy.zeros(3, 'u1'), memoryview(b'abc'), 'abc'])
def test_other_buffers_are_refused_in_a_uint8_array(data):
    with pytest.raises(genpy.SerializationError):
        copier_for(UInt8MultiArray).freeze(UInt8MultiArray(data=data))


class Late(Vector3):
    """Meets the time limit of a handler of signals, once."""

    __slots__ = ['is_over']

    @property
    def x(self):
        if not hasattr(self, 'is_over'):
            self.is_over = True
            raise TimeoutError
        return 1.0

    @x.setter
    def x(self, value):
        pass


def test_what_a_handler_of_signals_raises_within_the_copying_is_raised():
    with pytest.raises(TimeoutError):
        copier_for(Twist).freeze(Twist(linear=Late()))


@pytest.mark.parametrize(
    'message, error',
    [
        (String(b'bytes'), AttributeError),
        (String('\ud800'), UnicodeEncodeError),
        (Float32(1e39), OverflowError),
        (Bool(256), genpy.SerializationError),
        (Float64('0.1'), genpy.SerializationError),
        (CameraInfo(K=[0.0] * 8), genpy.SerializationError),
        (PoseArray(poses=[None]), AttributeError),
    ],
)
def test_a_refusal_is_the_wires_own(message, error):
    with pytest.raises(error) as caught:
        copier_for(type(message)).freeze(message)
    assert caught.value.__context__ is None or not type(
        caught.value.__context__
    ).__module__.startswith('pharos')


@pytest.mark.parametrize('cls, unset', [(Time, genpy.Time), (Duration, genpy.Duration)])
def test_a_time_is_canonized_in_the_message_itself(cls, unset):
    message = cls(unset())
    message.data.nsecs = 2000000001
    assert (copy(message).data.secs, copy(message).data.nsecs) == (2, 1)


def test_a_time_is_not_canonized_in_a_header_or_an_array():
    message = EVERYTHING(some_time=[genpy.Time()])
    message.header.stamp.nsecs = message.some_time[0].nsecs = 2000000001
    assert copy(message).header.stamp.nsecs == copy(message).some_time[0].nsecs == 2000000001


def test_a_time_after_2038_needs_no_wire():
    assert copy(Time(genpy.Time(2**32 - 1))).data.secs == 2**32 - 1


def test_a_subclass_of_time_arrives_as_a_plain_time():
    assert type(copy(Time(RospyTime(1, 2))).data) is genpy.Time


def test_a_nested_message_of_another_class_with_the_same_fields_is_taken():
    assert told(copy(Twist(linear=types.SimpleNamespace(x=1, y=2, z=3.0))).linear) == told(
        Vector3(1.0, 2.0, 3.0)
    )


def test_text_beyond_ascii_needs_no_wire():
    assert copy(String('Straße 道')).data == 'Straße 道'


# Independence


def test_what_the_publisher_does_afterwards_does_not_show():
    message = Image(data=bytearray(b'old'), header=Header(frame_id='old'))
    frozen = frozen_fast(message)
    message.data[:] = b'new'
    message.header.frame_id = 'new'
    received = copier_for(Image).thaw(frozen)
    assert (received.data, received.header.frame_id) == (b'old', 'old')


def test_what_one_receiver_does_does_not_show_to_another():
    copier = copier_for(TFMessage)
    frozen = frozen_fast(TFMessage([TransformStamped()]))
    first = copier.thaw(frozen)
    first.transforms[0].transform.translation.x = 5.0
    first.transforms.append(None)
    assert told(copier.thaw(frozen)) == told(TFMessage([TransformStamped()]))


def test_large_data_is_shared():
    message = PointCloud2(data=bytes(1000))
    assert copy(message).data is message.data


def test_frozen_values_cost_the_garbage_collector_nothing():
    frozen = [
        frozen_fast(message)
        for message in (PoseStamped(), TFMessage([TransformStamped()]), LaserScan(ranges=[1.0]))
    ]
    # the collector drops a tuple when it finds that nothing in it is tracked, here four levels deep
    for _ in range(4):
        gc.collect()
    assert not any(map(gc.is_tracked, frozen))


# Classes


def test_a_class_made_at_run_time_nests_its_own_classes():
    message = copy(EVERYTHING(inners=[EVERYTHING().inner], two_inners=[EVERYTHING().inner] * 2))
    assert (
        type(message.inners[0])
        is type(message.two_inners[1])
        is type(EVERYTHING().inner)
        is not Pose
    )
    assert type(message.header) is type(message.inners[0].header) is not Header


def test_a_class_is_not_kept_alive():
    module = {'__name__': 'generated'}
    exec(inspect.getsource(inspect.getmodule(Float64)), module)
    assert told(copy(module['Float64'](1)).data) == told(1.0)
    reference = weakref.ref(module['Float64'])
    module.clear()
    gc.collect()
    assert reference() is None


def test_a_message_of_another_class_than_the_publishers_takes_the_wire():
    class Shouted(String):
        def serialize(self, buffer):
            String(self.data.upper()).serialize(buffer)

    received = copier_for(String).thaw(copier_for(String).freeze(Shouted('text')))
    assert type(received) is String
    assert received.data == 'TEXT'


def test_a_class_with_a_constructor_of_its_own_is_made_by_it():
    class MyString(String):
        def __init__(self):
            super().__init__()
            self.mine = 'set'

    copier = copier_for(MyString)
    assert copier.thaw(copier.freeze(MyString())).mine == 'set'


def test_a_class_written_by_hand_serializes_as_it_says():
    class Backwards(genpy.Message):
        _md5sum = _type = 'by/hand'
        __slots__ = ['data']
        _slot_types = ['string']

        def serialize(self, buffer):
            buffer.write(self.data[::-1].encode())

        def deserialize(self, data):
            self.data = data.decode()
            return self

    message = Backwards('abc')
    assert copier_for(Backwards).thaw(copier_for(Backwards).freeze(message)).data == 'cba'


@pytest.mark.parametrize(
    'name', ['data.real', 'data=1; raise SystemExit; message.data', 'class', '']
)
def test_a_field_name_is_never_run_as_code(name):
    evil = type(
        'Evil',
        (genpy.Message,),
        {name: vars(Float64)[name] for name in ('serialize', 'serialize_numpy')},
    )
    evil.__slots__, evil._slot_types = [name], ['float64']
    assert copier_for(evil).freeze_fields is None


@pytest.mark.parametrize(
    'message',
    [
        Twist(linear=Vector3(1, 2, 3)),
        String('text'),
        Time(genpy.Time(1, 2)),
        UInt8MultiArray(data=b'ab'),
        LaserScan(ranges=[0.1], header=Header(frame_id='laser')),
    ],
)
def test_a_receiver_of_another_class_gets_what_the_wire_gives_it(message):
    publisher = type(message)
    same_type = genpy.dynamic.generate_dynamic(publisher._type, publisher._full_text)[
        publisher._type
    ]
    for receiver in (publisher, same_type, numpy_msg(publisher), rospy.msg.AnyMsg):
        received = thawer(publisher, receiver)(copier_for(publisher).freeze(message))
        assert type(received) is receiver
        assert told(received) == told(receiver().deserialize(serialized(message)))


def test_any_msg_gets_times_as_they_were_sent():
    message = Time(genpy.Time())
    message.data.nsecs = 2000000001
    received = thawer(Time, rospy.msg.AnyMsg)(frozen_fast(message))
    assert received._buff == serialized(message)


def test_any_msg_forwards_what_it_got():
    private = types.ModuleType('private')  # another node's AnyMsg is another class
    exec(inspect.getsource(rospy.msg), vars(private))
    message = private.AnyMsg()
    message._buff = serialized(Float64(0.1))
    frozen = copier_for(private.AnyMsg).freeze(message)
    assert thawer(private.AnyMsg, Float64)(frozen).data == 0.1
    for receiver in (private.AnyMsg, rospy.msg.AnyMsg):
        assert told(thawer(private.AnyMsg, receiver)(frozen)._buff) == told(message._buff)
    assert copier_for(Float64).thaw(copier_for(Float64).freeze(message)).data == 0.1


@serializes_numpy
def test_numpy_msg_takes_and_gives_arrays():
    cls = numpy_msg(Float32MultiArray)
    message = cls(data=numpy.array([1, 2], 'f4'))
    frozen = copier_for(cls).freeze(message)
    first, second = copier_for(cls).thaw(frozen), copier_for(cls).thaw(frozen)
    assert told(first.data) == told(message.data)
    assert first.data is not second.data
    assert told(thawer(cls, Float32MultiArray)(frozen).data) == told((1.0, 2.0))
    assert copier_for(numpy_msg(Float64)).freeze_fields is None
