"""Messages arrive alike within a process, by shared memory, and over TCPROS."""
import inspect
import math

import numpy
import pytest

import helpers
import pharos
from helpers import TIMEOUT, create
from pharos.testing import Mailbox, until


def plain(value):
    """Return the types and values of a message, recursively, as text."""
    if hasattr(value, '__slots__') and not isinstance(value, (str, bytes)):
        return [type(value).__name__, *[plain(getattr(value, name)) for name in value.__slots__]]
    if isinstance(value, (list, tuple)):
        return [type(value).__name__, *map(plain, value)]
    return [type(value).__name__, repr(value)]


class Both:
    """A node that sends, one that receives beside it, and a peer that receives elsewhere."""

    def __init__(self, master, peer):
        self.master, self.peer = master, peer
        self.sender, self.hearer = create(master, '/sender'), create(master, '/hearer')
        peer.run(inspect.getsource(plain))
        self.topics = {}

    def ends(self, type_):
        """Return the channel and the mailbox of a type; the peer hears it, too."""
        if type_ not in self.topics:
            topic = f'/t{len(self.topics)}'
            self.peer.hear(topic, type_)
            box = Mailbox(self.hearer, topic, type_)
            channel = self.sender.output_channel(topic, type_, queue_size=1000)
            until(lambda: len(channel.connections) == 2)
            self.topics[type_] = channel, box, topic
        return self.topics[type_]

    def send(self, type_, **fields):
        """Send a message; returns what came here and there."""
        channel, box, topic = self.ends(type_)
        channel.send(**fields)
        here = box.next()
        until(lambda: self.peer.value(f'len(heard[{topic!r}])') >= len(box.all()), TIMEOUT)
        return plain(here), self.peer.value(f'plain(heard[{topic!r}][-1])')


@pytest.fixture(scope='module', params=[helpers.Peer, helpers.PharosPeer])
def both(request):
    ros_master = helpers.InProcessMaster()
    master = pharos.Master(ros_master.url)
    with request.param(ros_master.url) as peer:
        yield Both(master, peer)
        helpers.stop_nodes(master)
    ros_master.stop()


@pytest.mark.parametrize(
    'type_, value, came',
    [
        ('std_msgs/Float32', 0.1, numpy.float32(0.1).item()),
        ('std_msgs/Float64', 7, 7.0),
        ('std_msgs/Bool', 7, True),
        ('std_msgs/Float32MultiArray', [1, 2], (1.0, 2.0)),
        ('std_msgs/Float32MultiArray', numpy.array([1.0, 2.0]), (1.0, 2.0)),
        ('std_msgs/UInt8MultiArray', [1, 2], b'\1\2'),
        ('std_msgs/UInt8MultiArray', bytearray(b'\1\2'), b'\1\2'),
        ('std_msgs/Int64', True, 1),
    ],
)
def test_wire_changes_values_alike(both, type_, value, came):
    here, there = both.send(type_, data=value)
    assert here == there
    assert here[-1] == plain(came)


def test_nan_and_infinity_arrive(both):
    for value in math.inf, -math.inf, math.nan:
        here, there = both.send('std_msgs/Float64', data=value)
        assert here == there == ['Float64', ['float', repr(value)]]


UNFIT = [
    ('std_msgs/Int8', 128),
    ('std_msgs/UInt32', -1),
    ('std_msgs/Float32', 1e300),
    ('std_msgs/String', 7),
    ('std_msgs/Bool', 'x'),
    ('std_msgs/Float32MultiArray', [1.0, 'x']),
    ('std_msgs/Time', 7),
]


@pytest.mark.parametrize('receivers', ['none', 'here', 'there', 'both'])
def test_unfit_value_is_refused_alike(both, receivers):
    for type_, value in UNFIT:
        topic = f'/unfit_{receivers}_{type_.split("/")[1]}'
        if receivers in ('there', 'both'):
            both.peer.hear(topic, type_)
        channels = [both.sender.output_channel(topic, type_)]
        if receivers in ('here', 'both'):
            channels.append(Mailbox(both.hearer, topic, type_).channel)
        count = {'none': 0, 'here': 1, 'there': 1, 'both': 2}[receivers]
        until(lambda: len(channels[0].connections) == count)
        with pytest.raises(pharos.MessageTypeError):
            channels[0].send(data=value)
        assert channels[0].sent == 0
        for channel in channels:
            channel.close()


# -- queues


# -- headers, latches, other classes


def test_connection_headers_are_alike(both):
    both.send('std_msgs/Int16', data=1)
    channel, box, topic = both.ends('std_msgs/Int16')
    here = box.all()[-1]._connection_header
    there = both.peer.value(f'heard[{topic!r}][-1]._connection_header')
    names = 'callerid', 'topic', 'type', 'md5sum', 'latching', 'message_definition'
    assert [here[name] for name in names] == [there[name] for name in names]


def test_latched_messages_are_alike(both):
    out = both.sender.output_channel('/latched', 'geometry_msgs/PoseStamped', latch=True)
    out.send(header={'frame_id': 'map'})
    box = Mailbox(both.hearer, '/latched')
    both.peer.hear('/latched', 'geometry_msgs/PoseStamped')
    here = plain(box.next())
    both.peer.heard('/latched')
    assert both.peer.value("plain(heard['/latched'][0])") == here


def test_any_message_is_alike(both):
    cls = both.hearer.ros.AnyMsg
    box = Mailbox()
    both.hearer.ros.Subscriber('/any', cls, lambda message: box(message, None))
    both.peer.run(
        "heard['/any'] = []; rospy.Subscriber('/any', rospy.AnyMsg, heard['/any'].append)"
    )
    out = both.sender.output_channel('/any', 'std_msgs/String')
    until(lambda: len(out.connections) == 2)
    out.send(data='x')
    until(lambda: both.peer.value("len(heard['/any'])"))
    assert box.next()._buff == both.peer.value("heard['/any'][0]._buff") == b'\1\0\0\0x'


@pytest.mark.skipif(not hasattr(numpy.ndarray, 'tostring'), reason='genpy needs ndarray.tostring')
def test_numpy_messages_are_alike(both):
    numpy_msg = both.hearer.ros_import('rospy.numpy_msg').numpy_msg
    box = Mailbox()
    cls = numpy_msg(pharos.message_class('std_msgs/Float32MultiArray'))
    both.hearer.ros.Subscriber('/numpy', cls, lambda message: box(message, None))
    both.sender.send_to('/numpy', typed_as='std_msgs/Float32MultiArray', data=[1.0, 2.0])
    got = box.next().data
    assert isinstance(got, numpy.ndarray) and got.dtype == numpy.float32
    assert got.tolist() == [1.0, 2.0]
