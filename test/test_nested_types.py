"""Nested messages of classes made in every way: filled, checked and copied alike."""
import copy
import io
import queue

import genpy.dynamic
import geometry_msgs.msg
import numpy
import pytest
from genmsg.msgs import parse_type
from hypothesis import given, settings
from hypothesis import strategies as st
from rospy.numpy_msg import numpy_msg

from helpers import serializes_numpy
from pharos.testing import TIMEOUT
from pharos import BlockNode, MessageTypeError
from pharos.messages import build, check_fits, class_from_definition, explain
from pharos.messages import nested_class
from pharos.intraprocess.copier import copier_for
from test_copier import told, wire
from test_message_types import PRIMITIVES, VALUES

# of a package that is not here, as in a bag
POSE = class_from_definition(
    'bag_msgs/Stamped',
    """std_msgs/Header header
Estimate pose
=====
MSG: bag_msgs/Estimate
Place pose
float64[36] covariance
=====
MSG: bag_msgs/Place
Point position
=====
MSG: bag_msgs/Point
float64 x
float64 y
""",
)
COVARIANCE = numpy.zeros(36)  # a numpy_msg takes no lists


# genpy's code for numpy calls what numpy will not have much longer
pytestmark = pytest.mark.filterwarnings('ignore:tostring')


def dynamic(cls):
    """The class as rosbag makes it of the definition in a bag, with everything that it nests."""
    return genpy.dynamic.generate_dynamic(cls._type, cls._full_text)[cls._type]


WAYS = {
    'as it is': lambda cls: cls,
    'from a bag': dynamic,
    'of numpy': numpy_msg,
    'from a bag, of numpy': lambda cls: numpy_msg(dynamic(cls)),
}
each_way = pytest.mark.parametrize('made', WAYS.values(), ids=WAYS)
each_written_way = pytest.mark.parametrize(
    'made',
    [
        pytest.param(made, id=name, marks=serializes_numpy if 'numpy' in name else ())
        for name, made in WAYS.items()
    ],
)


def to_bytes(message):
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


def assert_nested_classes_are_those_of_the_code(message):
    """The message is one that came over the wire: the class's own code has made all that is in
    it."""
    for name, field_type in zip(message.__slots__, message._slot_types):
        base, is_array, _ = parse_type(field_type)
        value = getattr(message, name)
        for item in value if is_array else [value]:
            if isinstance(item, (genpy.Message, genpy.TVal)):
                assert type(item) is nested_class(type(message), base)
            if isinstance(item, genpy.Message):
                assert_nested_classes_are_those_of_the_code(item)


@each_written_way
def test_nested_fields_are_filled_by_dicts(made):
    message = build(
        made(POSE),
        None,
        {
            'header': {'stamp': {'secs': 7}, 'frame_id': 'map'},
            'pose': {'pose': {'position': {'x': 1}}, 'covariance': COVARIANCE},
        },
    )
    assert (message.header.stamp.secs, message.pose.pose.position.x) == (7, 1)
    assert to_bytes(message) == to_bytes(
        build(POSE, None, {'header': message.header, 'pose': message.pose})
    )
    assert_nested_classes_are_those_of_the_code(wire(message))


@each_way
@pytest.mark.parametrize(
    'fields, said',
    [
        (
            {'pose': {'pose': {'position': {'x': 'far'}}}},
            "bag_msgs/Stamped.pose.pose.position.x = 'far' does not fit float64: give a number",
        ),
        (
            {'pose': {'pose': {'position': {'w': 1}}}},
            "bag_msgs/Stamped.pose.pose.position has no field 'w'; its fields are x: float64, y: float64",
        ),
        (
            {'pose': {'covariance': 'wide'}},
            "bag_msgs/Stamped.pose.covariance = 'wide' does not fit float64[36]",
        ),
        (
            {'header': {'stamp': {'secs': -1}}},
            'bag_msgs/Stamped.header.stamp.secs = -1 does not fit uint32',
        ),
        (
            {'header': 5},
            'bag_msgs/Stamped.header = 5 does not fit std_msgs/Header: give a Header or a dict of its fields (seq: ',
        ),
    ],
)
def test_a_wrong_value_is_named_by_its_path(made, fields, said):
    with pytest.raises(MessageTypeError) as error:
        build(made(POSE), None, fields)
    assert said in str(error.value)


@each_way
def test_a_block_that_sets_a_wrong_field_is_told_the_right_ones(made):
    message = made(POSE)()
    with pytest.raises(AttributeError) as error:
        message.pose.pose.position.w = 1
    with pytest.raises(
        MessageTypeError, match="bag_msgs/Point has no field 'w'; its fields are x: float64"
    ):
        explain(error.value, message)
    message.pose.pose.position = geometry_msgs.msg.Quaternion(x='far')
    with pytest.raises(
        MessageTypeError, match="bag_msgs/Stamped.pose.pose.position.x = 'far' does not fit float64"
    ):
        check_fits(message)


def test_a_message_written_by_hand_is_checked_by_its_own_code():
    class Hand(genpy.Message):
        __slots__, _slot_types, _type, _md5sum = (
            ['inner'],
            ['hand_msgs/Inner'],
            'hand_msgs/Hand',
            '1' * 32,
        )

        def serialize(self, buffer):
            raise ValueError('not today')

    message = Hand()
    assert nested_class(Hand, 'hand_msgs/Inner') is None
    message.inner = geometry_msgs.msg.Point(x='far')
    with pytest.raises(
        MessageTypeError, match="hand_msgs/Hand.inner.x = 'far' does not fit float64"
    ):
        check_fits(message)


@each_written_way
def test_a_node_sends_nested_fields_by_name(master, made):
    got = queue.SimpleQueue()
    hears, sends = (
        master.create(BlockNode, named=name, domain='127.0.0.1') for name in ('/hears', '/sends')
    )
    hears.interested_in('/nested/pose', POSE, delegate=lambda message, channel: got.put(message))
    sends.send_to(
        '/nested/pose',
        typed_as=made(POSE),
        header={'frame_id': 'map'},
        pose={'pose': {'position': {'x': 1}}, 'covariance': COVARIANCE},
    )
    message = got.get(timeout=TIMEOUT)
    assert (message.header.frame_id, message.pose.pose.position.x) == ('map', 1.0)


# Properties


@st.composite
def definitions_with_fields(draw):
    """A definition that nests others, three deep, and fields that fit it, nested ones as dicts."""
    plain = [*PRIMITIVES, 'geometry_msgs/Point', 'std_msgs/Header']
    layers = []  # of fields: (type, array), the innermost first
    for nested in [], ['Leaf', 'Leaf'], ['Inner', 'Inner', 'Leaf']:
        types = st.tuples(st.sampled_from(plain + nested), st.sampled_from(['', '', '[]', '[2]']))
        layers.append(draw(st.lists(types, min_size=1, max_size=4)))
    by_type = dict(zip(['Leaf', 'Inner', 'Outer'], layers))

    def values(type_):
        return {f'f{number}': several(*field) for number, field in enumerate(by_type[type_])}

    def several(type_, array):
        if not array:
            return one(type_)
        return [one(type_) for _ in range(2 if array == '[2]' else draw(st.integers(0, 2)))]

    def one(type_):
        if type_ in by_type:
            return values(type_)
        if type_ == 'std_msgs/Header':
            return {'stamp': draw(VALUES['time']), 'frame_id': draw(VALUES['string'])}
        return (
            {'y': draw(VALUES['float64'])}
            if type_ == 'geometry_msgs/Point'
            else draw(VALUES[type_])
        )

    outer, inner, leaf = (
        ''.join(
            f'{type_}{array} f{number}\n' for number, (type_, array) in enumerate(by_type[name])
        )
        for name in ('Outer', 'Inner', 'Leaf')
    )
    separator = '=' * 80
    return f'{outer}{separator}\nMSG: zoo/Inner\n{inner}{separator}\nMSG: zoo/Leaf\n{leaf}', values(
        'Outer'
    )


def paths(value, before=''):
    """``[(path, function that sets what is there)]`` of all that is no dict or list in a dict of
    fields."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, item in items:
        path = f'{before}.{key}' if isinstance(value, dict) else f'{before}[{key}]'
        if isinstance(item, (dict, list)):
            yield from paths(item, path)
        else:
            yield path, lambda new, key=key: value.__setitem__(key, new)


@settings(deadline=None, max_examples=25)
@given(definitions_with_fields(), st.data())
def test_messages_of_any_definition_are_filled_checked_and_copied_alike_however_their_class_was_made(
    case, data
):
    text, fields = case
    plain = class_from_definition('zoo/Outer', text)
    expected = to_bytes(build(plain, None, fields))
    leaves = list(paths(fields))
    path, _ = data.draw(st.sampled_from(leaves)) if leaves else ('', None)
    for made in WAYS.values():
        cls = made(plain)
        if leaves:
            wrong = copy.deepcopy(fields)
            dict(paths(wrong))[path](object())
            with pytest.raises(MessageTypeError) as error:
                build(cls, None, wrong)
            assert str(error.value).startswith(f'zoo/Outer{path} = <object'), path
        message = build(cls, None, fields)
        if made in (numpy_msg, WAYS['from a bag, of numpy']):
            continue  # numpy's arrays alone are written
        assert to_bytes(message) == expected
        arrived = wire(message)
        assert_nested_classes_are_those_of_the_code(arrived)
        copier = copier_for(cls)
        assert copier.freeze_fields is not None  # nothing need be serialized
        assert told(copier.thaw(copier.freeze(message))) == told(arrived)
