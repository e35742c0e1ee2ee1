"""Types from the graph: topics, and their types, of which nothing is on this side's disk."""
import concurrent.futures
import contextlib
import functools
import inspect
import itertools
import json
import os
import socket
import struct
import sys
import threading
import time
import xmlrpc.server
from xmlrpc.client import ServerProxy

import genpy
import pytest
import rosbag
import rosgraph
import rospkg
import yaml
from genpy.generate_initpy import write_modules
from genpy.generator import MsgGenerator

from helpers import create
from pharos.testing import Mailbox, TIMEOUT, until
from pharos import (
    Master,
    MessageTypeError,
    NodeStoppedError,
    PharosError,
    UnknownTopicError,
    UnknownTypeError,
    define_message,
    message_class,
)
from pharos.messages import class_from_definition
from pharos.private_rospy import tcpros_connection
from pharos.private_rospy.tcpros_connection import publisher_header
from programs import Program, run
from sockets import refused_url

SEPARATOR = '\n' + '=' * 80 + '\n'
SCAN = 'scanner_msgs/Scan'
FILES = {
    'Scan': '''# what a scanner saw
uint8 OK=0
uint8 BROKEN=7
string FRAME=base "link" # not a comment
float32 STEP=0.25
bool TURNS=True
Header header
Mark[] marks
Mark[2] pair
Place place
time[] stamps
duration lasted
int8[3] three
uint8[] raw
uint8[4] four
bool[] flags
char letter
byte small
float32[] ranges
string[] names
string text
int64 big
uint64 huge
geometry_msgs/Point[] points
Place[] none''',
    'Mark': 'string name\nPlace[] places\nduration[2] waits',
    'Place': 'int8 UNKNOWN=-1\nfloat64 x\ntime seen',
}
TEXT = SEPARATOR.join(
    [
        FILES['Scan'],
        'MSG: scanner_msgs/Mark\n' + FILES['Mark'],
        'MSG: scanner_msgs/Place\n' + FILES['Place'],
        'MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id',
        'MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z',
    ]
)
PLACE = {'x': 1.5, 'seen': [1, 999999999]}
EMPTY_MARK = {'name': '', 'places': [], 'waits': [[0, 0], [0, 0]]}
# the publisher numbers the header itself
VALUES = {
    'header': {'stamp': [9, 8], 'frame_id': 'laser'},
    'marks': [
        {
            'name': 'door',
            'places': [PLACE, {'x': -2.0, 'seen': [0, 0]}],
            'waits': [[-1, 5], [2, 0]],
        },
        EMPTY_MARK,
    ],
    'pair': [EMPTY_MARK, {'name': 'right', 'places': [PLACE], 'waits': [[0, 0], [0, 1]]}],
    'place': PLACE,
    'stamps': [[3, 4], [2**32 - 1, 6]],
    'lasted': [-2, 7],
    'three': [1, -2, 3],
    'raw': list(range(256)),
    'four': [1, 0, 3, 255],
    'flags': [True, False],
    'letter': 65,
    'small': -128,
    'ranges': [0.5, -1.25],
    'names': ['', 'Tür', '日本'],
    'text': 'two\n"lines" \\',
    'big': -(2**63),
    'huge': 2**64 - 1,
    'points': [{'x': 1.0, 'y': 2.0, 'z': -3.0}],
    'none': [],
}


def make(find, type_, value):
    """A message of such values, by the classes that ``find(type)`` gives; the programs below do
    this, too."""
    base, _, array = type_.partition('[')
    if array:
        return bytes(value) if base == 'uint8' else [make(find, base, one) for one in value]
    if base in ('time', 'duration'):
        return {'time': genpy.Time, 'duration': genpy.Duration}[base](*value)
    if '/' not in base:
        return value
    message = find(base)()
    for name, kind in zip(message.__slots__, message._slot_types):
        if name in value:
            setattr(message, name, make(find, kind, value[name]))
    return message


MAKE = 'import genpy, json, sys\n' + inspect.getsource(make)
# a rospy node whose class genpy.dynamic has generated from a text
ROSPY_PEER = (
    MAKE
    + '''
import genpy.dynamic, rospy
name, topic, type_, text, values = sys.argv[1:]
classes = genpy.dynamic.generate_dynamic(type_, text)
rospy.init_node(name)
publisher = rospy.Publisher(topic, classes[type_], latch=True, queue_size=1)
publisher.publish(make(classes.get, type_, json.loads(values)))
print('published', flush=True)
rospy.spin()
'''
)
# a node of this package, which finds the type in the .msg files of a package on its
# ROS_PACKAGE_PATH
FILES_PEER = (
    MAKE
    + '''
import pharos
topic, type_, values = sys.argv[1:]
node = pharos.Master().create(pharos.BlockNode, named='/files_peer')
channel = node.output_channel(topic, type_, latch=True)
channel.publish(make(pharos.message_class, type_, json.loads(values)))
print('published', flush=True)
pharos.spin()
'''
)
# a node of this package that knows nothing: it prints what it hears
HEARING_PEER = '''
import sys, pharos
def hear(message, channel):
    print(message, flush=True)
    print('heard', channel.type, message.OK, flush=True)
pharos.Master().create(pharos.BlockNode, named='/hearing_peer', delegate=hear).interested_in(sys.argv[1], wait=60)
pharos.spin()
'''


def plain(value):
    """A message as VALUES has it: with dicts and lists."""
    if isinstance(value, genpy.Message):
        return {name: plain(getattr(value, name)) for name in value.__slots__ if name != 'seq'}
    if isinstance(value, genpy.rostime.TVal):
        return [value.secs, value.nsecs]
    return [plain(one) for one in value] if isinstance(value, (list, tuple, bytes)) else value


def assert_unknown_here(type_=SCAN):
    with pytest.raises(UnknownTypeError):
        message_class(type_)


@pytest.fixture(scope='module')
def rospy_peer(ros_master):
    """A rospy node that publishes VALUES on /types/from_rospy, latched."""
    with Program(
        ros_master.url,
        sys.executable,
        '-c',
        ROSPY_PEER,
        'rospy_peer',
        '/types/from_rospy',
        SCAN,
        TEXT,
        json.dumps(VALUES),
    ) as program:
        program.wait_for('published')
        yield program


@pytest.fixture(scope='module')
def bag(ros_master, rospy_peer, tmp_path_factory):
    """A bag that rosbag has recorded from it."""
    return record(ros_master.url, '/types/from_rospy', tmp_path_factory.mktemp('bag') / 'scan.bag')


def record(url, topic, path):
    """Record the next message of a topic with rosbag; returns the path."""
    recorder = run(url, 'rosbag', 'record', '--limit=1', '-O', str(path), topic)
    assert recorder.returncode == 0, recorder.stderr
    return path


def read(bag):
    """The type and the message in a bag, which rosbag decodes by the definition that it has
    recorded."""
    with rosbag.Bag(str(bag)) as opened:
        ((topic, message, _),) = opened.read_messages()
        return opened.get_type_and_topic_info().topics[topic].msg_type, message


@contextlib.contextmanager
def publishing_rospy_peer(master, request, tmp_path):
    request.getfixturevalue('rospy_peer')
    yield '/types/from_rospy'


@contextlib.contextmanager
def publishing_files_peer(master, request, tmp_path):
    (tmp_path / 'scanner_msgs/msg').mkdir(parents=True)
    (tmp_path / 'scanner_msgs/package.xml').write_text(
        '<package><name>scanner_msgs</name></package>'
    )
    for name, text in FILES.items():
        (tmp_path / 'scanner_msgs/msg' / (name + '.msg')).write_text(text)
    with Program(
        master.url,
        sys.executable,
        '-c',
        FILES_PEER,
        '/types/from_files',
        SCAN,
        json.dumps(VALUES),
        ROS_PACKAGE_PATH=os.pathsep.join([str(tmp_path), '/usr/share']),
    ) as program:
        program.wait_for('published')
        yield '/types/from_files'


@contextlib.contextmanager
def publishing_rosbag_play(master, request, tmp_path):
    bag = request.getfixturevalue('bag')
    with Program(
        master.url, 'rosbag', 'play', '--keep-alive', str(bag), '/types/from_rospy:=/types/from_bag'
    ):
        yield '/types/from_bag'


@contextlib.contextmanager
def publishing_roscpp(master, request, tmp_path):
    """topic_tools' relay, which passes on any type with the definition that it gets."""
    request.getfixturevalue('rospy_peer')
    with master.run('topic_tools', 'relay', '/types/from_rospy', '/types/from_roscpp'):
        yield '/types/from_roscpp'


# -- receiving


@pytest.mark.parametrize(
    'publishing',
    [publishing_rospy_peer, publishing_files_peer, publishing_rosbag_play, publishing_roscpp],
)
@pytest.mark.leaves('peers that the next test uses')
def test_a_type_that_is_nowhere_here_is_received_with_all_fields_right(
    master, request, tmp_path, mailbox, publishing
):
    """rospy subscribes with a class alone, which must be there; only its tools take the type from
    the publisher."""
    with publishing(master, request, tmp_path) as topic:
        channel = create(master, '/receiver', delegate=mailbox).interested_in(topic, wait=TIMEOUT)
        message = mailbox.next()
    assert channel.type == SCAN
    assert plain(message) == VALUES
    assert (message.OK, message.BROKEN, message.FRAME) == (0, 7, 'base "link" # not a comment')
    assert (message.STEP, message.TURNS, message.marks[0].places[1].UNKNOWN) == (0.25, True, -1)
    assert isinstance(message.stamps[0], genpy.Time)
    assert isinstance(message.marks[0].waits[0], genpy.Duration)
    assert message.four == b'\1\0\3\xff'
    assert message.points[0] == message_class('geometry_msgs/Point')(1, 2, -3)
    assert_unknown_here()


def test_a_type_asked_for_by_name_is_the_publishers(master, rospy_peer, mailbox):
    create(master, '/receiver', delegate=mailbox).interested_in('/types/from_rospy', typed_as=SCAN)
    assert plain(mailbox.next()) == VALUES


def test_nodes_that_learn_a_type_each_send_and_receive_it(master, rospy_peer, mailbox):
    receiver, sender = create(master, '/receiver', delegate=mailbox), create(master, '/sender')
    heard = receiver.interested_in('/types/from_rospy')
    mailbox.next()
    sent = sender.send_to('/types/from_rospy', text='from here')
    assert type(sent) is heard.message_class
    assert mailbox.next().text == 'from here'


def test_a_type_learnt_serves_its_node_after_the_publisher_has_gone(master, mailbox):
    node = create(master, '/node', delegate=mailbox)
    with Program(
        master.url,
        sys.executable,
        '-c',
        ROSPY_PEER,
        'brief_peer',
        '/types/brief',
        'brief_msgs/Word',
        'string word',
        '{"word": "hello"}',
    ) as program:
        program.wait_for('published')
        node.interested_in('/types/brief')
        assert mailbox.next().word == 'hello'
    for options in {}, {'typed_as': 'brief_msgs/Word'}, {'wait': TIMEOUT}:
        node.send_to('/types/brief', word='again', **options)
        assert mailbox.next().word == 'again'
    node.stop()
    node.start()
    node.send_to('/types/brief', word='after a restart')
    assert mailbox.next().word == 'after a restart'


def test_without_a_type_the_masters_is_taken(master, mailbox):
    talker = Program(
        master.url, 'rostopic', 'pub', '--latch', '/types/installed', 'std_msgs/Int32', '7'
    )
    with talker, Program(master.url, 'rostopic', 'echo', '/types/echoed', 'std_msgs/msg/String'):
        node = create(master, '/node', delegate=mailbox)
        assert node.interested_in('/types/installed', wait=TIMEOUT).type == 'std_msgs/Int32'
        assert mailbox.next().data == 7
        assert node.send_to('/types/installed', data=8)._type == 'std_msgs/Int32'
        assert mailbox.next().data == 8


# -- sending

DEFINED = 'defined_msgs/Scan'


@pytest.fixture
def defined(master):
    """A type given by define_message, and VALUES sent with it on /types/defined, latched."""
    define_message(DEFINED, TEXT.replace('scanner_msgs', 'defined_msgs'))
    channel = create(master, '/definer').output_channel('/types/defined', DEFINED, latch=True)
    channel.publish(make(message_class, DEFINED, VALUES))
    return channel


def printed_message(text):
    """A message as a program printed it, in YAML."""

    def as_values(value):
        if isinstance(value, dict):
            if set(value) == {'secs', 'nsecs'}:
                return [value['secs'], value['nsecs']]
            return {name: as_values(one) for name, one in value.items() if name != 'seq'}
        return [as_values(one) for one in value] if isinstance(value, list) else value

    return as_values(yaml.safe_load(text))


def test_rosbag_records_a_type_given_by_definition_with_all_that_reading_it_takes(
    master, defined, tmp_path
):
    bag = record(master.url, '/types/defined', tmp_path / 'defined.bag')
    type_, message = read(bag)
    assert (type_, message._md5sum) == (DEFINED, defined.message_class._md5sum)
    assert plain(message) == VALUES and message.FRAME == 'base "link" # not a comment'
    printed = run(master.url, 'rostopic', 'echo', '-b', str(bag), '/types/defined').stdout
    assert printed_message(printed.partition('---')[0]) == VALUES


def test_rosbag_records_a_type_learnt_from_the_graph_and_sent_on(
    master, rospy_peer, mailbox, tmp_path
):
    node = create(master, '/node', delegate=mailbox)
    heard = node.interested_in('/types/from_rospy')
    node.output_channel('/types/sent_on', heard.message_class, latch=True).publish(mailbox.next())
    type_, message = read(record(master.url, '/types/sent_on', tmp_path / 'sent_on.bag'))
    assert type_ == SCAN
    assert plain(message) == VALUES


def test_a_process_that_knows_nothing_hears_a_type_given_by_definition(master, defined):
    with Program(master.url, sys.executable, '-c', HEARING_PEER, '/types/defined') as peer:
        assert peer.wait_for('heard').split() == ['heard', DEFINED, '0']
        assert printed_message(''.join(peer.printed[:-1])) == VALUES


def test_rostopic_tells_the_type_given_by_definition_and_whether_it_comes(master, defined):
    assert run(master.url, 'rostopic', 'type', '/types/defined').stdout == DEFINED + '\n'
    assert 'Type: ' + DEFINED in run(master.url, 'rostopic', 'info', '/types/defined').stdout
    defined.node.fork(lambda me: [defined.send() for _ in me.every(0.01)])
    with Program(master.url, 'rostopic', 'bw', '/types/defined') as bandwidth:
        bandwidth.wait_for('average:')


def test_rostopic_echo_prints_it_where_generated_code_is_installed(
    master, defined, rospy_peer, tmp_path
):
    """And only there: rostopic echo and hz do not use the definition that a publisher sends, be it
    rospy's or ours."""
    for topic in '/types/defined', '/types/from_rospy':
        echo = run(master.url, 'rostopic', 'echo', '-n1', topic)
        assert echo.returncode == 1
        assert 'Cannot load message class' in echo.stderr
    definitions, package = tmp_path / 'definitions', tmp_path / 'python/defined_msgs/msg'
    definitions.mkdir()
    package.mkdir(parents=True)
    (package.parent / '__init__.py').touch()
    for name, text in FILES.items():
        (definitions / (name + '.msg')).write_text(text)
    found = {
        name: [rospkg.RosPack().get_path(name) + '/msg'] for name in ('std_msgs', 'geometry_msgs')
    }
    MsgGenerator().generate_messages(
        'defined_msgs',
        [str(path) for path in definitions.iterdir()],
        str(package),
        {'defined_msgs': [str(definitions)], **found},
    )
    write_modules(str(package))
    with Program(
        master.url, 'rostopic', 'echo', '-n1', '/types/defined', PYTHONPATH=str(tmp_path / 'python')
    ) as echo:
        assert printed_message(echo.read_to_the_end().partition('---')[0]) == VALUES


# -- no type yet

WAYS = {
    'interested_in': lambda node, topic, **wait: node.interested_in(topic, **wait).type,
    'output_channel': lambda node, topic, **wait: node.output_channel(topic, **wait).type,
    'send_to': lambda node, topic, **wait: node.send_to(topic, **wait)._type,
}
each_way = pytest.mark.parametrize('way', WAYS.values(), ids=WAYS)


@pytest.fixture
def asked(monkeypatch):
    """An event set once the master has been asked for a type."""
    event, topic_types = threading.Event(), Master.topic_types

    def answer(self):
        types = topic_types(self)
        event.set()
        return types

    monkeypatch.setattr(Master, 'topic_types', answer)
    return event


@each_way
def test_a_topic_that_only_subscribers_of_any_type_have_is_an_error_that_says_so(master, way):
    with master.run('topic_tools', 'relay', '/types/any', '/types/any_relayed'):
        until(lambda: master.topic('/types/any').subscribers)
        with pytest.raises(
            UnknownTopicError, match='/types/any is not known yet.*nodes of any type.*typed_as='
        ):
            way(create(master, '/node'), '/types/any')


@each_way
def test_a_topic_that_nobody_uses_is_an_error_after_the_wait(master, way):
    with pytest.raises(
        UnknownTopicError, match='no node of .* publishes or subscribes to /types/unused'
    ):
        way(create(master, '/node'), '/types/unused', wait=0.01)


@each_way
def test_a_type_that_is_not_there_yet_is_waited_for(master, asked, way, request):
    topic = '/types/awaited_by_' + request.node.callspec.id
    with concurrent.futures.ThreadPoolExecutor() as pool:
        waiting = pool.submit(way, create(master, '/node'), topic, wait=TIMEOUT)
        assert asked.wait(TIMEOUT)
        assert not waiting.done()
        create(master, '/other').output_channel(topic, 'std_msgs/Int32')
        assert waiting.result(TIMEOUT) == 'std_msgs/Int32'


def test_a_definition_that_is_not_there_yet_is_waited_for(master, asked):
    topic, type_ = '/types/late_definition', 'late_msgs/Word'
    node = create(master, '/node')
    with subscriber(master, topic, type_):
        with pytest.raises(
            UnknownTypeError, match=r"unknown message type 'late_msgs/Word'.*define_message\("
        ):
            node.interested_in(topic)
        asked.clear()
        with concurrent.futures.ThreadPoolExecutor() as pool:
            waiting = pool.submit(node.interested_in, topic, wait=TIMEOUT)
            assert asked.wait(TIMEOUT)
            assert not waiting.done()
            with Publisher(master, topic, type_, 'string word'):
                assert waiting.result(TIMEOUT).type == type_
                node.stop()


def test_the_stop_of_a_node_ends_its_wait_for_a_type(master, asked, transcript):
    node = create(master, '/node')
    raised = Mailbox()

    def soul(me):
        try:
            me.interested_in('/types/never', wait=100 * TIMEOUT)
        except BaseException as error:
            raised(error, None)
            raise

    node.fork(soul)
    assert asked.wait(TIMEOUT)
    node.stop()
    error = raised.next()
    assert isinstance(error, NodeStoppedError)
    assert '/types/never' in str(error)
    assert not node.errors
    assert not transcript


# -- publishers that lie


@contextlib.contextmanager
def subscriber(master, topic, type_):
    """The master knows of one, and thereby the topic's type; it answers nobody."""
    registered = rosgraph.Master('/subscriber', master_uri=master.url)
    registered.registerSubscriber(topic, type_, refused_url())
    yield
    registered.unregisterSubscriber(topic, registered.lookupNode('/subscriber'))


class Publisher:
    """A publisher by hand, which says what the test wants in its connection header, or instead.

    :param answer: to requestTopic, instead of where it listens
    :param said: bytes, instead of a connection header
    :param heard: called with the connection header of each who comes
    """

    def __init__(
        self,
        master,
        topic,
        type_,
        definition=None,
        md5sum='*',
        name='/liar',
        answer=None,
        said=None,
        heard=lambda header: None,
        **header,
    ):
        self._heard = heard
        self._master, self._topic, self._name = (
            rosgraph.Master(name, master_uri=master.url),
            topic,
            name,
        )
        header = {
            'type': type_,
            'md5sum': md5sum,
            'message_definition': definition,
            'callerid': name,
            **header,
        }
        self._said = (
            said
            if said is not None
            else rosgraph.network.encode_ros_handshake_header(
                {key: value for key, value in header.items() if value is not None}
            )
        )
        self._listener = socket.create_server(('127.0.0.1', 0))
        self._rpc = xmlrpc.server.SimpleXMLRPCServer(('127.0.0.1', 0), logRequests=False)
        self._rpc.register_function(
            lambda *args: answer or [1, '', ['TCPROS', *self._listener.getsockname()]],
            'requestTopic',
        )
        self._rpc.register_function(lambda *args: [1, '', os.getpid()], 'getPid')
        # looks for its end every 10 ms
        self._threads = [
            threading.Thread(target=target)
            for target in (self._serve, functools.partial(self._rpc.serve_forever, 0.01))
        ]
        for thread in self._threads:
            thread.start()
        self._uri = 'http://127.0.0.1:%d/' % self._rpc.server_address[1]
        self._master.registerPublisher(topic, type_, self._uri)

    def _serve(self):
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return  # the end
            with client, contextlib.suppress(OSError, struct.error):  # it may go at once
                (size,) = struct.unpack('<I', client.recv(4, socket.MSG_WAITALL))
                asked = struct.pack('<I', size) + client.recv(size, socket.MSG_WAITALL)
                self._heard(rosgraph.network.decode_ros_handshake_header(asked))
                client.sendall(self._said)
                client.shutdown(socket.SHUT_WR)
                while client.recv(1 << 16):
                    pass

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self._master.unregisterPublisher(self._topic, self._uri)
        self._rpc.shutdown()
        self._rpc.server_close()
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for thread in self._threads:
            thread.join(TIMEOUT)


CODE = '__import__("os").system("touch executed")'
topic_numbers = itertools.count()  # the master never forgets the type of a topic


@pytest.fixture
def lie(master, tmp_path, monkeypatch):
    """``lie(type, definition, …)``: the error by which a node refuses a topic with such a
    publisher."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tcpros_connection, 'TIMEOUT', 0.5)

    def refusal(type_, *args, **kwargs):
        topic = '/types/lie_%d' % next(topic_numbers)
        node = create(master, '/victim')
        with Publisher(master, topic, type_, *args, **kwargs):
            with pytest.raises(PharosError) as error:
                node.interested_in(topic)
        assert node.is_running
        assert not node.channels
        assert '/victim' not in master.topic(topic).subscribers
        assert list(tmp_path.iterdir()) == []
        assert len(str(error.value)) < 2000
        return error.value

    return refusal


@pytest.mark.parametrize(
    'definition, reason',
    [
        ('complete nonsense!', "line 1, 'complete nonsense!'"),
        ('complete nonsense', "unknown message type 'lie_msgs/complete'"),
        ('\0\1\2\n\x7f', 'line 1'),
        (f'int8 X={CODE}', 'line 1'),
        (f'bool X={CODE}', 'line 1'),
        (f'float64 X={CODE}', 'line 1'),
        (f'int8 x; {CODE}', 'line 1'),
        (f'int8 a\nint8[{CODE}] x', 'line 2'),
        (f'{CODE} x', 'line 1'),
        (f'int8 a{SEPARATOR}MSG: evil/../../x\nint8 b', 'malformed'),
        (f'int8 a{SEPARATOR}MSG: a/b"; import os\nint8 b', 'malformed'),
        ('../../../etc/passwd x', 'line 1'),
        ('sys/modules x', "unknown message type 'sys/modules'"),
        ('%s%n{0.__class__} x', 'line 1'),
        ('Lie x', 'nests itself'),
        (f'Other[] x{SEPARATOR}MSG: lie_msgs/Other\nLie[] y', 'nests itself'),
        (
            ''.join(f'T{n} x{SEPARATOR}MSG: lie_msgs/T{n}\n' for n in range(3000)) + 'int8 x',
            'nests itself or more than 64',
        ),
        (
            ''.join(f'T{n} x\nT{n} y{SEPARATOR}MSG: lie_msgs/T{n}\n' for n in range(40)) + 'int8 x',
            'fields',
        ),
        ('uint8[999999999] x', 'elements'),
        ('int8 x\n' * 100000, 'Duplicate'),
        ('#' * (2 << 20), 'at most 1048576 characters'),
    ],
    ids=lambda text: text.partition('\n')[0][:30],
)
def test_a_definition_that_cannot_be_read_is_refused_and_runs_nothing(lie, definition, reason):
    error = lie('lie_msgs/Lie', definition)
    assert isinstance(error, UnknownTypeError)
    assert reason in str(error)
    assert '/liar publishes on /types/lie_' in str(error)
    assert_unknown_here('lie_msgs/Lie')


def test_a_definition_that_has_not_the_md5sum_given_is_refused(lie):
    error = lie('lie_msgs/Lie', 'int8 a', md5sum='0123456789abcdef0123456789abcdef')
    assert isinstance(error, MessageTypeError)
    assert 'md5sum 0123456789abcdef0123456789abcdef' in str(error)
    assert 'a: int8' in str(error)


@pytest.mark.parametrize(
    'type_', ['a/b"; import os', '../x', 'x/..', 'a/b\n', 'evil/%s', 'é/B', '/b', 'a/' + 'b' * 1000]
)
def test_a_type_that_can_be_no_name_is_refused(lie, type_):
    assert 'malformed' in str(lie(type_, 'int8 a'))


@pytest.mark.parametrize(
    'instead',
    [
        {'definition': None},
        {'type': 'std_msgs/String'},
        {'type': '*'},
        {'said': b''},
        {'said': b'\xff\xff\xff\xff'},
        {'said': b'\4\0\0\0\xff\xff\xff\xff'},
        {'said': b'HTTP/1.1 400 Bad Request\r\n\r\n'},
        {'said': struct.pack('<II', 9, 5) + b'\xff=\xff=\xff'},
        {'answer': 1},
        {'answer': 'TCPROS'},
        {'answer': [1]},
        {'answer': [1, '', []]},
        {'answer': [1, '', 0]},
        {'answer': [0, 'no', 0]},
        {'answer': [1, '', ['TCPROS', '127.0.0.1', 1 << 20]]},
        {'answer': [1, '', ['TCPROS', 7, 'x']]},
        {'answer': [1, '', ['TCPROS', 'a' * 100 + '.', 7]]},
    ],
    ids=lambda instead: ' '.join(map(str, *instead.items()))[:40],
)
def test_a_publisher_that_does_not_tell_the_definition_is_passed_over(lie, master, instead):
    what = {'definition': 'int8 a', **instead}
    assert "unknown message type 'lie_msgs/Lie'" in str(lie('lie_msgs/Lie', **what))
    topic = '/types/lie_%d' % next(topic_numbers)
    with Publisher(master, topic, 'lie_msgs/Lie', **what), Publisher(
        master, topic, 'lie_msgs/Lie', 'string word', name='/honest'
    ):
        assert master.topic(topic).message_class(create(master, '/other')).__slots__ == ['word']


def test_one_who_lies_keeps_nobody_from_the_definition_of_another(master):
    with Publisher(master, '/types/disputed', 'disputed_msgs/Word', 'nonsense'), Publisher(
        master, '/types/disputed', 'disputed_msgs/Word', 'string word', name='/honest'
    ):
        assert master.topic('/types/disputed').message_class(create(master, '/node')).__slots__ == [
            'word'
        ]


def test_code_in_a_constant_of_text_is_text(master, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with Publisher(master, '/types/text', 'text_msgs/Text', f'string X={CODE}\nstring x # {CODE}'):
        cls = master.topic('/types/text').message_class(create(master, '/node'))
    assert cls.X == CODE
    assert cls(CODE).x == CODE
    assert list(tmp_path.iterdir()) == []


# -- several definitions of one type


@contextlib.contextmanager
def publishing(master, topic, type_, text, **values):
    """A rospy node in another process that publishes such a message, latched."""
    name = 'defines' + topic.replace('/', '_')
    with Program(
        master.url, sys.executable, '-c', ROSPY_PEER, name, topic, type_, text, json.dumps(values)
    ) as peer:
        peer.wait_for('published')
        yield


@pytest.mark.parametrize(
    'type_, define',
    [('given_msgs/Reading', True), ('turtlesim/Pose', False)],
    ids=['given', 'shipped'],
)
@pytest.mark.parametrize('typed', [True, False], ids=['by name', 'without a type'])
def test_a_subscriber_takes_a_live_publishers_definition_before_one_given_or_shipped(
    master, mailbox, type_, define, typed
):
    here = define_message(type_, 'string level\n') if define else message_class(type_)
    topic = '/types/live_%d' % next(topic_numbers)
    node = create(master, '/node', delegate=mailbox)
    with publishing(master, topic, type_, 'int32 level\nint32 more\n', level=7, more=8):
        channel = node.interested_in(topic, *[type_] * typed)
        message = mailbox.next()
    assert (message.level, message.more) == (7, 8)
    # nothing is defined for others
    assert channel.message_class is not here
    assert message_class(type_) is here


def test_who_asks_for_a_class_gets_that_one(master):
    here = define_message('given_msgs/Reading', 'string level\n')
    topic = '/types/live_%d' % next(topic_numbers)
    with publishing(master, topic, 'given_msgs/Reading', 'int32 level\n', level=7):
        assert create(master, '/node').interested_in(topic, here).message_class is here


def test_an_installed_type_goes_before_a_publishers(master):
    topic = '/types/live_%d' % next(topic_numbers)
    with publishing(master, topic, 'std_msgs/Int32', 'int8 data\n', data=7):
        channel = create(master, '/node').interested_in(topic, 'std_msgs/Int32')
    assert channel.message_class is message_class('std_msgs/Int32')


def test_a_type_in_a_msg_file_goes_before_a_publishers(master, tmp_path, monkeypatch):
    (tmp_path / 'file_msgs/msg').mkdir(parents=True)
    (tmp_path / 'file_msgs/package.xml').write_text('<package><name>file_msgs</name></package>')
    (tmp_path / 'file_msgs/msg/Reading.msg').write_text('string level')
    monkeypatch.setenv('ROS_PACKAGE_PATH', str(tmp_path))
    topic = '/types/live_%d' % next(topic_numbers)
    with publishing(master, topic, 'file_msgs/Reading', 'int32 level\n', level=7):
        channel = create(master, '/node').interested_in(topic, 'file_msgs/Reading')
    assert describe(channel) == 'string'
    define_message('file_msgs/Reading', 'string level')  # the same, which makes it no other
    with publishing(master, topic, 'file_msgs/Reading', 'int32 level\n', level=7):
        assert (
            describe(create(master, '/other').interested_in(topic, 'file_msgs/Reading')) == 'string'
        )


def describe(channel):
    return channel.message_class._slot_types[0]


def test_who_asks_for_a_definition_is_no_subscriber(master):
    """Else one who waits for a subscriber sends to nobody."""
    topic = '/types/live_%d' % next(topic_numbers)
    channel = create(master, '/sender').output_channel(topic, 'std_msgs/Int32', latch=True)
    channel.send(data=7)
    asked = ServerProxy(channel.node.uri).requestTopic('/asks', topic, [['TCPROS']])
    header = publisher_header(tuple(asked[2][1:]), topic, time.monotonic() + TIMEOUT)
    assert (header['type'], header['callerid']) == ('std_msgs/Int32', '/sender')
    assert 'int32 data' in header['message_definition']
    assert channel.connections == []
    assert not channel.node.latest_run.rospy.publisher(topic).connections


def test_who_sends_takes_the_definition_given(master, mailbox):
    here = define_message('given_msgs/Reading', 'string level\n')
    topic = '/types/live_%d' % next(topic_numbers)
    with publishing(master, topic, 'given_msgs/Reading', 'int32 level\n', level=7):
        assert (
            type(create(master, '/node').send_to(topic, typed_as='given_msgs/Reading', level='low'))
            is here
        )


def test_a_publisher_of_this_process_is_taken_at_its_word_too(master, mailbox):
    define_message('given_msgs/Reading', 'string level\n')
    other = genpy.dynamic.generate_dynamic('given_msgs/Reading', 'int32 level\n')[
        'given_msgs/Reading'
    ]
    topic = '/types/live_%d' % next(topic_numbers)
    sender, node = create(master, '/sender'), create(master, '/node', delegate=mailbox)
    sender.output_channel(topic, other, latch=True).send(level=7)
    assert node.interested_in(topic, 'given_msgs/Reading').message_class is other
    assert mailbox.next().level == 7


@pytest.mark.parametrize(
    'given, taken',
    [
        ('int32 level\n', ['int32']),
        ('int8 level\n', ['int8']),
        ('string level\n', ['int8', 'int32']),
    ],
)
def test_of_several_publishers_the_one_that_agrees_with_what_was_given_counts(master, given, taken):
    type_ = 'given_msgs/Reading%d' % next(topic_numbers)
    topic = '/types/live_%d' % next(topic_numbers)
    define_message(type_, given)
    with publishing(master, topic, type_, 'int32 level\n', level=1):
        with Publisher(
            master,
            topic,
            type_,
            'int8 level\n',
            class_from_definition(type_, 'int8 level\n')._md5sum,
        ):
            assert describe(create(master, '/node').interested_in(topic, type_)) in taken


@pytest.mark.parametrize(
    'publisher',
    [
        dict(definition='complete nonsense!'),
        dict(definition='int8 a', md5sum='0' * 32),
        dict(definition=None),
        dict(said=b''),
        dict(answer=[0, 'not today', 0]),
    ],
    ids=str,
)
def test_a_publisher_that_does_not_tell_leaves_what_was_given(master, publisher, monkeypatch):
    here = define_message('given_msgs/Reading', 'string level\n')
    topic = '/types/live_%d' % next(topic_numbers)
    with Publisher(master, topic, 'given_msgs/Reading', **publisher):
        assert (
            create(master, '/node').interested_in(topic, 'given_msgs/Reading').message_class is here
        )


@pytest.mark.parametrize('here', ['int32 level\n', 'string level\n'])
def test_no_publisher_takes_the_question_for_its_definition_for_a_subscriber(master, mailbox, here):
    """rospy's, which waits for a subscriber and then sends, would send to nobody."""
    topic, type_ = '/types/live_%d' % next(topic_numbers), f'given_msgs/Level{len(here)}'
    define_message(type_, here)
    there = class_from_definition(type_, 'int32 level\n')
    came = []
    with Publisher(master, topic, type_, there._full_text, there._md5sum, heard=came.append):
        assert create(master, '/node').interested_in(topic, type_).message_class is there
    assert came
    assert {header['callerid'] for header in came} == {'/node'}


def test_a_publisher_that_is_dead_is_not_waited_for(master):
    define_message('given_msgs/Reading', 'string level\n')
    topic, node = '/types/live_%d' % next(topic_numbers), create(master, '/node')
    node.connect_timeout = 100 * TIMEOUT
    master.api('/dead').registerPublisher(topic, 'given_msgs/Reading', refused_url())
    try:
        assert describe(node.interested_in(topic, 'given_msgs/Reading')) == 'string'
    finally:
        master.api('/dead').unregisterPublisher(topic, master.api().lookupNode('/dead'))


def test_the_definition_that_is_taken_is_no_failure_and_those_it_does_not_suit_are(master, mailbox):
    define_message('given_msgs/Reading', 'string level\n')
    topic, node = '/types/live_%d' % next(topic_numbers), create(master, '/node', delegate=mailbox)
    with publishing(master, topic, 'given_msgs/Reading', 'int32 level\n', level=7):
        create(master, '/other').ros.Publisher(topic, message_class('std_msgs/Empty'), queue_size=1)
        assert describe(node.interested_in(topic, 'given_msgs/Reading')) == 'int32'
        assert mailbox.next().level == 7
        until(lambda: node.errors)
    (error,) = node.errors
    assert '/other publishes std_msgs/Empty' in str(error)


def test_a_channel_keeps_the_class_that_it_was_opened_with(master, mailbox):
    here = define_message('given_msgs/Reading', 'string level\n')
    topic, early, late = (
        '/types/live_%d' % next(topic_numbers),
        create(master, '/early'),
        create(master, '/late'),
    )
    opened = early.interested_in(topic, 'given_msgs/Reading')
    with publishing(master, topic, 'given_msgs/Reading', 'int32 level\n', level=7):
        assert (
            describe(late.interested_in(topic, 'given_msgs/Reading', delegate=mailbox)) == 'int32'
        )
        assert mailbox.next().level == 7
        assert (
            early.interested_in(topic, 'given_msgs/Reading').message_class
            is opened.message_class
            is here
        )
    early.send_to(topic, level='low')
