"""Message and service classes found by name or made at run time, and messages filled and
checked."""

import glob
import importlib
import io
import os
import signal
import struct
import subprocess
import sys
import threading
import warnings

import genmsg
import genpy
import geometry_msgs.msg
import pytest
import sensor_msgs.msg
import std_msgs.msg
import std_srvs.srv
from hypothesis import given, settings, strategies as st

from helpers import ended, in_thread
from programs import PROGRAMS
from pharos.testing import TIMEOUT
from pharos.messages import classes, definition, lookup
from pharos.errors import MessageTypeError, UnknownTypeError
from pharos.messages import (
    check_fits,
    class_from_definition,
    define_message,
    define_service,
    describe_fields,
    explain,
    fill,
    message_class,
    service_class,
)

SEPARATOR = '=' * 80
PRIMITIVES = [
    'bool',
    'int8',
    'uint8',
    'int16',
    'uint16',
    'int32',
    'uint32',
    'int64',
    'uint64',
    'float32',
    'float64',
    'char',
    'byte',
    'string',
    'time',
    'duration',
]


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    """Each test begins with nothing defined, made or found."""
    monkeypatch.setattr(definition, '_made', {})
    monkeypatch.setattr(classes, '_given', {})
    monkeypatch.setattr(lookup, 'found', {})


@pytest.fixture
def package_path(tmp_path, monkeypatch):
    """Write the files of packages on ROS_PACKAGE_PATH: ``package_path('a', 'msg/B.msg', text)``."""

    def write(package, path, text, manifest='<package><name>%s</name></package>'):
        file = tmp_path / package / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding='utf-8')
        (tmp_path / package / 'package.xml').write_text(manifest.replace('%s', package))

    monkeypatch.setenv('ROS_PACKAGE_PATH', str(tmp_path))
    return write


def to_bytes(message):
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


def over_the_wire(message):
    return type(message)().deserialize(to_bytes(message))


def installed_classes():
    """All message classes installed here."""
    for folder in glob.glob(
        os.path.join(os.path.dirname(os.path.dirname(std_msgs.__file__)), '*', 'msg')
    ):
        package = os.path.basename(os.path.dirname(folder))
        for value in vars(importlib.import_module(package + '.msg')).values():
            if isinstance(value, type) and issubclass(value, genpy.Message):
                yield value


# Finding


def test_an_installed_type_gives_the_installed_class():
    assert message_class('geometry_msgs/Twist') is geometry_msgs.msg.Twist
    assert service_class('std_srvs/SetBool') is std_srvs.srv.SetBool


def test_a_class_passes_through():
    assert message_class(geometry_msgs.msg.Twist) is geometry_msgs.msg.Twist
    assert service_class(std_srvs.srv.SetBool) is std_srvs.srv.SetBool


def test_header_needs_no_package():
    assert message_class('Header') is std_msgs.msg.Header


def test_a_msg_file_on_the_package_path_needs_no_generated_code(package_path):
    package_path('arm', 'msg/Joint.msg', 'float64 angle\n')
    package_path('arm', 'msg/Arm.msg', 'Header header\nJoint[] joints\ngeometry_msgs/Point tip\n')
    arm = message_class('arm/Arm')
    assert arm._has_header
    assert arm().tip == geometry_msgs.msg.Point()
    message = arm(joints=[message_class('arm/Joint')(angle=0.5)])
    assert over_the_wire(message) == message


def test_a_srv_file_on_the_package_path_needs_no_generated_code(package_path):
    package_path('arm', 'srv/Move.srv', 'float64 angle\n---\nbool moved\n')
    assert describe_fields(service_class('arm/Move')._response_class) == 'moved: bool'


def test_a_package_manifest_that_cannot_be_parsed_hides_no_other_type(package_path):
    package_path('arm', 'msg/Joint.msg', 'float64 angle\n', manifest='<package><name>')
    assert message_class('turtlesim/Pose')


@pytest.mark.parametrize(
    'name, md5sum',
    [
        ('Velocity', '9d5c2dcd348ac8f76ce2a4307bd63a13'),
        ('Pose', '863b248d5016ca62ea2e895ae5265cf9'),
        ('Color', '353891e354491c51aabe32df673fb446'),
    ],
)
def test_turtlesim_messages_have_the_md5sums_of_turtlesim(name, md5sum):
    assert message_class('turtlesim/' + name)._md5sum == md5sum


@pytest.mark.parametrize(
    'name, md5sum',
    [
        ('Kill', 'c1f3d28f1b044c871e6eff2e9fc3c667'),
        ('SetPen', '9f452acce566bf0c0954594f69a8e41b'),
        ('Spawn', '0b2d2e872a8e2887d5ed626f2bf2c561'),
        ('TeleportAbsolute', 'a130bc60ee6513855dc62ea83fcc5b20'),
        ('TeleportRelative', '9d5c2dcd348ac8f76ce2a4307bd63a13'),
    ],
)
def test_turtlesim_services_have_the_md5sums_of_turtlesim(name, md5sum):
    assert service_class('turtlesim/' + name)._md5sum == md5sum


def test_a_definition_given_comes_before_the_one_shipped():
    assert (
        describe_fields(message_class('turtlesim/Velocity')) == 'linear: float32, angular: float32'
    )
    define_message('turtlesim/Velocity', 'float64 speed\n')
    assert describe_fields(message_class('turtlesim/Velocity')) == 'speed: float64'


def test_a_process_forked_while_a_class_is_made_makes_its_own(monkeypatch):
    making, forked, find = threading.Event(), threading.Event(), lookup.find

    def find_slowly(*key):
        making.set()
        forked.wait(TIMEOUT)
        return find(*key)

    monkeypatch.setattr(lookup, 'find', find_slowly)
    thread = in_thread(message_class, 'std_msgs/Int32')
    assert making.wait(TIMEOUT)
    monkeypatch.undo()
    with warnings.catch_warnings():  # Python 3.12 and later do not like what is tried here
        warnings.simplefilter('ignore', DeprecationWarning)
        child = os.fork()
    if not child:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)  # which ends one that waits
        signal.alarm(int(TIMEOUT))
        os._exit(message_class('std_msgs/Int32') is not std_msgs.msg.Int32)
    forked.set()
    assert os.waitpid(child, 0)[1] == 0
    assert ended(thread)


def test_two_threads_that_ask_get_the_same_class():
    start = threading.Barrier(8)
    answers = []

    def ask():
        start.wait()
        answers.append(message_class('turtlesim/Pose'))

    threads = [threading.Thread(target=ask) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(answers) == 8
    assert len(set(answers)) == 1


def test_an_unknown_type_says_where_it_was_sought_and_how_to_provide_it(package_path, tmp_path):
    with pytest.raises(UnknownTypeError) as error:
        message_class('leg/Knee')
    for part in (
        'leg.msg.Knee',
        'leg/msg/Knee.msg',
        str(tmp_path),
        "define_message('leg/Knee', text)",
    ):
        assert part in str(error.value)


@pytest.mark.parametrize(
    'slip, meant',
    [
        ('geometry_msg/Twist', 'geometry_msgs/Twist'),
        ('std_msgs/Strin', 'std_msgs/String'),
        ('turtlesim/velocity', 'turtlesim/Velocity'),
        ('Twist', 'geometry_msgs/Twist'),
        ('std_msgs/msg/String', 'std_msgs/String'),
    ],
)
def test_a_slip_in_a_type_gets_a_hint(slip, meant):
    with pytest.raises(UnknownTypeError, match=f"did you mean.* '{meant}'"):
        message_class(slip)


@pytest.mark.parametrize(
    'name',
    [
        '',
        'Nonsuch',
        '/a/B',
        'a/',
        '../a',
        'a/../B',
        'a/B\n',
        'a b/C',
        'é/B',
        '_a/B',
        None,
        3,
        b'a/B',
        'a/' + 'B' * 5000,
    ],
)
def test_a_malformed_name_is_called_so(name):
    for find in (
        message_class,
        service_class,
        lambda name: define_message(name, ''),
        lambda name: class_from_definition(name, ''),
    ):
        with pytest.raises(UnknownTypeError, match='malformed'):
            find(name)


def test_a_name_does_not_import_a_module_that_holds_no_messages(tmp_path, monkeypatch):
    (tmp_path / 'trap.py').write_text('raise SystemExit("imported")')
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UnknownTypeError):
        message_class('trap/Foo')


# Defining


def test_a_definition_may_nest_given_shipped_and_installed_types_and_header():
    define_message('zoo/Leg', 'int8 length\n')
    beast = define_message(
        'zoo/Beast',
        'Header header\nLeg[] legs\nLeg[2] ears\nturtlesim/Pose pose\n'
        'geometry_msgs/Pose place\ntime born\n',
    )
    leg = message_class('zoo/Leg')
    message = beast(legs=[leg(1), leg(-2)], born=genpy.Time(1, 2))
    message.header.frame_id = 'cage'
    message.pose.x = 1.5
    assert over_the_wire(message) == message
    assert type(message.pose) is message_class('turtlesim/Pose')
    assert type(message.place) is geometry_msgs.msg.Pose
    assert beast._has_header
    assert beast._type == 'zoo/Beast'
    assert beast.__name__ == 'Beast'


def test_nested_definitions_in_the_text_are_defined_too():
    define_message(
        'zoo/Cage', f'Lock lock\n{SEPARATOR}\nMSG: zoo/Lock\nbool shut\n====\nMSG: zoo/Unused\n'
    )
    assert describe_fields(message_class('zoo/Lock')) == 'shut: bool'
    assert message_class('zoo/Cage')().lock == message_class('zoo/Lock')()


def test_the_full_text_holds_the_nested_definitions_as_gendeps_prints_them():
    define_message('zoo/Lock', 'bool shut # \\n "quoted" \'\'\' """\n')
    cage = define_message('zoo/Cage', 'Lock lock # \\')
    assert (
        cage._full_text
        == f'Lock lock # \\\n{SEPARATOR}\nMSG: zoo/Lock\nbool shut # \\n "quoted" \'\'\' """\n'
    )


def test_constants_are_attributes_of_the_class():
    cls = define_message(
        'zoo/Consts',
        'int8 LOW=-5\nfloat32 NAN=nan\nbool YES=True\nuint8 from=1\n'
        'string TEXT= a "b" \'c\' # \\ no comment\\\n',
    )
    assert (cls.LOW, cls.YES, cls.from_, cls.TEXT) == (-5, True, 1, 'a "b" \'c\' # \\ no comment\\')
    assert cls.NAN != cls.NAN


def test_a_field_with_the_name_of_a_python_keyword_gets_an_underscore_as_in_genpy():
    cls = define_message('zoo/Transfer', 'int8 from\nint8 to\n')
    assert over_the_wire(cls(from_=1, to=2)) == cls(from_=1, to=2)


@pytest.mark.parametrize('type_', ['struct/genpy', 'class/lambda', 'sys/struct', 'nested/T0'])
def test_a_type_name_cannot_disturb_the_generated_code(type_):
    define_message(type_, 'int8 x\nstring[] words\n')
    cls = define_message('zoo/User', f'{type_} one\n{type_}[] more\n')
    message = fill(cls(), {'one': {'x': 1}, 'more': [{'x': 2, 'words': ['a']}]})
    assert over_the_wire(message) == message


def test_the_same_definition_again_gives_the_same_class():
    cls = define_message('zoo/Leg', 'int8 length\n')
    assert define_message('zoo/Leg', 'int8   length  # in cm') is cls
    assert class_from_definition('zoo/Leg', 'int8 length', cls._md5sum) is cls
    assert message_class('zoo/Leg') is cls


def test_an_array_of_a_type_is_told_from_the_type_though_their_md5sums_are_the_same():
    one, array = (
        class_from_definition('zoo/T', f'geometry_msgs/Point{suffix} x\n') for suffix in ('', '[]')
    )
    assert one._md5sum == array._md5sum
    assert (describe_fields(one), describe_fields(array)) == (
        'x: geometry_msgs/Point',
        'x: geometry_msgs/Point[]',
    )


def test_an_installed_type_defined_alike_stays_the_installed_class():
    assert define_message('std_msgs/String', 'string data') is std_msgs.msg.String
    assert define_service('std_srvs/Empty', '---') is std_srvs.srv.Empty


def test_another_definition_for_a_known_type_is_refused(package_path):
    define_message('zoo/Leg', 'int8 length\n')
    package_path('arm', 'msg/Joint.msg', 'float64 angle\n')
    for type_ in ('zoo/Leg', 'arm/Joint', 'std_msgs/String'):
        with pytest.raises(MessageTypeError, match=f'{type_} is known already'):
            define_message(type_, 'int16 other\n')
    assert describe_fields(message_class('zoo/Leg')) == 'length: int8'


@pytest.mark.parametrize(
    'text, reason',
    [
        ('int8 a\nint8\n', "line 2, 'int8'"),
        ('int8 a\n\nint8 b c\n', "line 3, 'int8 b c'"),
        ('int8 1a', "line 1, 'int8 1a'"),
        ('int8 é', 'line 1'),
        ('int8[-1] a', 'line 1'),
        ('int8[2][3] a', 'line 1'),
        ('int8[٣] a', 'line 1'),
        ('a/b/c d', 'line 1'),
        ('../../etc a', 'line 1'),
        ('int8 X=300', 'out of bounds'),
        ('string X; import os; Y=1', 'line 1'),
        ('float32 X=__import__', 'line 1'),
        ('int8 a\nint8 a', 'Duplicate'),
        ('int8 a\nint8 a=1', 'taken'),
        ('int8 serialize', 'serialize'),
        ('int8 _type=1', 'line 1'),
        ('zoo/Nonsuch x', "zoo/Bad has a field of an unknown message type 'zoo/Nonsuch'"),
        ('Bad x', 'nests itself'),
        ('Other[] x\n===\nMSG: zoo/Other\nBad[] y', 'nests itself'),
        ('int8 a\n===\nMSG: zoo/Other; import os\nint8 b', 'malformed'),
        (b'int8 a', 'must be a str'),
        ('#' * (1 << 20) + '\n', 'at most 1048576 characters'),
        ('uint8[999999999] a', 'elements'),
    ],
)
def test_a_definition_that_cannot_be_read_says_why(text, reason):
    with pytest.raises(UnknownTypeError) as error:
        define_message('zoo/Bad', text)
    assert reason in str(error.value)
    with pytest.raises(UnknownTypeError, match='unknown message type'):
        message_class('zoo/Bad')


def test_files_that_nest_each_other_are_refused(package_path):
    package_path('arm', 'msg/Hen.msg', 'Egg egg\n')
    package_path('arm', 'msg/Egg.msg', 'Hen[] hens\n')
    with pytest.raises(UnknownTypeError, match='nests itself'):
        message_class('arm/Hen')


@pytest.mark.parametrize('twice, depth', [(True, 40), (False, 200)])
def test_a_small_text_that_would_make_endless_code_is_refused(twice, depth):
    text = ''.join(
        f'T{n} a\n' + (f'T{n} b\n' if twice else '') + f'===\nMSG: zoo/T{n}\n' for n in range(depth)
    )
    with pytest.raises(UnknownTypeError, match='zoo/'):
        class_from_definition('zoo/Bomb', text)


# Definitions received from a peer


def test_a_definition_received_gives_a_class_that_reads_the_peers_messages():
    peer = sensor_msgs.msg.Imu
    cls = class_from_definition('peer_msgs/Imu', peer._full_text, peer._md5sum)
    sent = fill(peer(), {'header': {'frame_id': 'imu'}, 'orientation': {'w': 0.5}})
    assert to_bytes(cls().deserialize(to_bytes(sent))) == to_bytes(sent)


def test_a_definition_received_of_an_installed_type_gives_the_installed_class():
    for known in (std_msgs.msg.String, sensor_msgs.msg.Imu):
        assert class_from_definition(known._type, known._full_text, known._md5sum) is known
        assert class_from_definition(known._type, known._full_text) is known


def test_a_definition_received_in_another_version_leaves_the_installed_one_alone():
    text = f'Vector3 v\n{SEPARATOR}\nMSG: geometry_msgs/Vector3\nfloat32 x\n'
    cls = class_from_definition('geometry_msgs/Twist', text)
    assert describe_fields(type(cls().v)) == 'x: float32'
    assert fill(cls(), {'v': {'x': 1}}).v.x == 1
    assert message_class('geometry_msgs/Twist') is geometry_msgs.msg.Twist
    assert message_class('geometry_msgs/Vector3') is geometry_msgs.msg.Vector3


def test_a_definition_received_defines_nothing_for_later():
    class_from_definition('zoo/Leg', 'int8 length\n')
    with pytest.raises(UnknownTypeError):
        message_class('zoo/Leg')


def test_a_definition_that_has_not_the_md5sum_announced_is_refused():
    with pytest.raises(MessageTypeError, match='zoo/Leg was announced with md5sum 0123'):
        class_from_definition('zoo/Leg', 'int8 length\n', '0123')


def test_the_former_package_of_header_is_understood():
    cls = class_from_definition(
        'old/Stamped',
        f'roslib/Header header\n{SEPARATOR}\nMSG: roslib/Header\n' + std_msgs.msg.Header._full_text,
    )
    assert type(cls().header) is std_msgs.msg.Header
    assert cls._has_header


@pytest.mark.parametrize('cls', list(installed_classes()), ids=lambda cls: cls._type)
def test_a_class_made_from_an_installed_ones_text_is_like_it(cls):
    made = class_from_definition(cls._type + 'Made', cls._full_text)
    assert made is not cls
    for name in ('_md5sum', '__slots__', '_slot_types', '_has_header'):
        assert getattr(made, name) == getattr(cls, name)
    assert to_bytes(made()) == to_bytes(cls())
    constants = [
        name
        for name in vars(cls)
        if name[0] != '_' and isinstance(vars(cls)[name], (int, float, str))
    ]
    assert [getattr(made, name) for name in constants] == [getattr(cls, name) for name in constants]


# Services


def test_a_service_made_from_text_is_like_a_generated_one():
    made = define_service(
        'made_srvs/SetBool',
        'bool data # e.g. for hardware enabling / disabling\n---\n'
        'bool success   # indicate successful run of triggered service\n'
        'string message # informational, e.g. for error messages\n',
    )
    like = std_srvs.srv.SetBool
    assert made._type == 'made_srvs/SetBool'
    assert made._md5sum == like._md5sum
    for part in ('_request_class', '_response_class'):
        ours, theirs = getattr(made, part), getattr(like, part)
        assert ours._type == theirs._type.replace('std_srvs', 'made_srvs')
        assert (ours._md5sum, ours._full_text) == (theirs._md5sum, theirs._full_text)
    assert (
        define_service('made_srvs/SetBool', 'bool data\n---\nbool success\nstring message') is made
    )


def test_a_service_may_nest_definitions_in_its_text():
    spin = define_service(
        'zoo/Spin', 'Wheel wheel\n---\nWheel[] wheels\n===\nMSG: zoo/Wheel\nint8 size\n'
    )
    response = fill(spin._response_class(), {'wheels': [{'size': 3}]})
    assert over_the_wire(response) == response
    assert message_class('zoo/Wheel') is type(response.wheels[0])


def test_a_service_and_a_message_may_share_a_name():
    assert issubclass(define_message('zoo/Spin', 'int8 x'), genpy.Message)
    assert define_service('zoo/Spin', 'int8 y\n---')._request_class._type == 'zoo/SpinRequest'


def test_a_service_made_from_text_answers_rosservice(tmp_path):
    environment = dict(
        os.environ,
        PYTHONPATH=os.pathsep.join(sys.path),
        ROS_HOSTNAME='127.0.0.1',
        ROS_LOG_DIR=str(tmp_path),
    )
    with subprocess.Popen(
        [sys.executable, PROGRAMS / 'set_bool_server.py'],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    ) as server:
        assert server.stdout.readline().strip() == 'made at run time'
        environment['ROS_MASTER_URI'] = server.stdout.readline().strip()
        answer = subprocess.run(
            [sys.executable, '/usr/bin/rosservice', 'call', '/switch', 'true'],
            env=environment,
            capture_output=True,
            text=True,
            timeout=30,
        )
        server.stdin.close()
    assert 'success: True\nmessage: "made at run time"' in answer.stdout, answer.stderr


# Filling and checking


def test_fill_sets_fields_by_name_nested_ones_by_dict():
    twist = geometry_msgs.msg.Twist()
    twist.linear.y = 7.0
    assert fill(twist, {'linear': {'x': 2}, 'angular': geometry_msgs.msg.Vector3(1, 2, 3)}) is twist
    assert (twist.linear.x, twist.linear.y, twist.angular.z) == (2, 7.0, 3)


def test_fill_makes_messages_of_dicts_in_arrays_and_times_of_dicts():
    polygon = fill(
        geometry_msgs.msg.PolygonStamped(),
        {
            'header': {'stamp': {'secs': 1, 'nsecs': 2}},
            'polygon': {'points': [{'x': 1}, geometry_msgs.msg.Point32(y=2)]},
        },
    )
    assert polygon.header.stamp == genpy.Time(1, 2)
    assert polygon.polygon.points == [
        geometry_msgs.msg.Point32(x=1),
        geometry_msgs.msg.Point32(y=2),
    ]


def test_fill_names_type_and_field_that_does_not_exist_and_the_one_meant():
    with pytest.raises(
        MessageTypeError,
        match=r"geometry_msgs/Twist has no field 'liner' \(did you mean 'linear'\?\)",
    ):
        fill(geometry_msgs.msg.Twist(), {'liner': 1})
    with pytest.raises(
        MessageTypeError,
        match=r"geometry_msgs/Twist.linear has no field 'w'.* x: float64, y: float64",
    ):
        fill(geometry_msgs.msg.Twist(), {'linear': {'w': 1}})
    with pytest.raises(MessageTypeError, match="no field 'data'; it has no fields at all"):
        fill(std_msgs.msg.Empty(), {'data': 1})


@pytest.mark.parametrize(
    'field, value, said',
    [
        ('float32 x', 'fast', "zoo/T.x = 'fast' does not fit float32: give a number"),
        ('float32 x', 1e39, 'give a number up to 3.4e38'),
        ('int8 x', 128, 'give an integer from -128 to 127'),
        ('uint16 x', -1, 'give an integer from 0 to 65535'),
        ('int32 x', 1.0, 'zoo/T.x = 1.0 does not fit int32'),
        ('bool x', None, 'give True or False'),
        ('string x', b'abc', "does not fit string: give a str"),
        ('string x', '\ud800', 'does not fit string'),
        ('uint8[] x', 'abc', 'give a list of uint8 or bytes'),
        ('uint8[] x', [1, 256], 'zoo/T.x[1] = 256 does not fit uint8'),
        ('int32[3] x', [1, 2], 'zoo/T.x = [1, 2] does not fit int32[3]: give a list of 3 int32'),
        ('string[2] x', ['a'], 'give a list of 2 string'),
        ('string[] x', ['a', 1], 'zoo/T.x[1] = 1 does not fit string'),
        ('int32[] x', 5, 'zoo/T.x = 5 does not fit int32[]'),
        ('geometry_msgs/Point x', 5, 'give a Point or a dict of its fields (x: float64, y: '),
        ('geometry_msgs/Point[] x', [{'y': 'q'}], "zoo/T.x[0].y = 'q' does not fit float64"),
        ('geometry_msgs/Point[] x', [5], 'zoo/T.x[0] = 5 does not fit geometry_msgs/Point'),
        ('time x', 5, 'give a rospy.Time, such as node.ros.Time.now()'),
        ('duration x', 1.5, 'give a rospy.Duration, such as node.ros.Duration(1.5)'),
        ('time x', {'secs': -1}, 'zoo/T.x.secs = -1 does not fit uint32'),
    ],
)
def test_fill_refuses_a_value_that_does_not_fit_and_says_what_does(field, value, said):
    cls = define_message('zoo/T', field)
    with pytest.raises(MessageTypeError) as error:
        fill(cls(), {'x': value})
    assert said in str(error.value)


@pytest.mark.parametrize(
    'field, value',
    [
        ('float32 x', 1),
        ('float64 x', True),
        ('bool x', 7),
        ('int8 x', False),
        ('char x', 65),
        ('string x', 'é'),
        ('uint8[] x', b'ab'),
        ('uint8[] x', (1, 2)),
        ('uint8[] x', bytearray(b'ab')),
        ('uint8[4] x', b'ab'),
        ('float64[] x', range(3)),
    ],
)
def test_fill_takes_what_the_wire_takes(field, value):
    message = fill(define_message('zoo/T', field)(), {'x': value})
    to_bytes(message)


def test_a_message_that_serializes_fits():
    check_fits(sensor_msgs.msg.Imu())


def test_a_message_that_does_not_serialize_is_explained_by_the_path_to_the_value():
    twist = geometry_msgs.msg.Twist()
    twist.angular.z = 'left'
    with pytest.raises(
        MessageTypeError, match=r"geometry_msgs/Twist.angular.z = 'left' does not fit float64"
    ) as error:
        check_fits(twist)
    assert isinstance(error.value.__cause__, struct.error)


def test_a_message_of_a_type_made_at_run_time_is_explained_too():
    define_message('zoo/Leg', 'int8 length\n')
    message = define_message('zoo/Beast', 'Leg[] legs\n')()
    message.legs = [message_class('zoo/Leg')(1), message_class('zoo/Leg')('long')]
    with pytest.raises(
        MessageTypeError, match=r"zoo/Beast.legs\[1\].length = 'long' does not fit int8"
    ):
        check_fits(message)


def test_a_missing_nested_message_is_explained():
    with pytest.raises(
        MessageTypeError,
        match='geometry_msgs/PoseStamped.header = None does not fit std_msgs/Header',
    ):
        message = geometry_msgs.msg.PoseStamped()
        message.header = None
        check_fits(message)


@pytest.mark.parametrize(
    'block, said',
    [
        (
            lambda twist: setattr(twist, 'liner', 1),
            r"geometry_msgs/Twist has no field 'liner' \(did you mean 'linear'\?\)",
        ),
        (
            lambda twist: setattr(twist.angular, 'q', 1),
            "geometry_msgs/Vector3 has no field 'q'; its fields are x: float64",
        ),
    ],
)
def test_an_attribute_error_from_a_field_that_does_not_exist_is_explained(block, said):
    twist = geometry_msgs.msg.Twist()
    with pytest.raises(AttributeError) as error:
        block(twist)
    with pytest.raises(MessageTypeError, match=said):
        explain(error.value, twist)


def test_an_attribute_error_from_elsewhere_is_not_explained():
    assert (
        explain(AttributeError("'NoneType' object has no attribute 'x'"), geometry_msgs.msg.Twist())
        is None
    )


def test_a_type_without_fields_is_described_so():
    assert describe_fields(std_msgs.msg.Empty) == 'no fields'


# Properties

VALUES = {
    'bool': st.booleans(),
    'string': st.text(st.characters(blacklist_categories=('Cs',))),
    'float32': st.floats(width=32, allow_nan=False),
    'float64': st.floats(allow_nan=False),
    'time': st.builds(genpy.Time, st.integers(0, 2**32 - 1), st.integers(0, 999999999)),
    'duration': st.builds(
        genpy.Duration, st.integers(-(2**31), 2**31 - 1), st.integers(0, 999999999)
    ),
    'char': st.integers(0, 255),
    'byte': st.integers(-128, 127),
    **{
        f'int{bits}': st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        for bits in (8, 16, 32, 64)
    },
    **{f'uint{bits}': st.integers(0, 2**bits - 1) for bits in (8, 16, 32, 64)},
}


@st.composite
def definitions_with_fields(draw):
    """A definition, with one nested, and fields that fit it, nested ones as dicts."""

    def fields(types):
        return draw(
            st.lists(
                st.tuples(st.sampled_from(types), st.sampled_from(['', '[]', '[0]', '[3]'])),
                max_size=6,
            )
        )

    def values(fields, nested):
        return {
            f'f{n}': draw(value(type_, array, nested)) for n, (type_, array) in enumerate(fields)
        }

    def value(type_, array, nested):
        one = (
            VALUES[type_]
            if nested is None or type_ in VALUES
            else st.builds(lambda: values(nested, None))
        )
        if array in ('', '[]'):
            return one if array == '' else st.lists(one, max_size=4)
        return st.lists(one, min_size=int(array[1]), max_size=int(array[1]))

    def text(fields):
        return ''.join(f'{type_}{array} f{n}\n' for n, (type_, array) in enumerate(fields))

    nested, own = fields(PRIMITIVES), fields(PRIMITIVES + ['Inner', 'Inner'])
    return text(own), text(nested), values(own, nested)


def genmsg_md5(own, nested):
    context = genmsg.MsgContext.create_default()
    genmsg.msg_loader.load_msg_from_string(context, nested, 'zoo/Inner')
    return genmsg.compute_md5(
        context, genmsg.msg_loader.load_msg_from_string(context, own, 'zoo/Outer')
    )


@settings(deadline=None)  # the first example imports genpy's generator
@given(definitions_with_fields())
def test_any_definition_has_genmsgs_md5sum_and_its_messages_survive_the_wire(case):
    own, nested, fields = case
    cls = class_from_definition(
        'zoo/Outer', f'{own}{SEPARATOR}\nMSG: zoo/Inner\n{nested}', genmsg_md5(own, nested)
    )
    message = fill(cls(), fields)
    data = to_bytes(message)
    assert to_bytes(cls().deserialize(data)) == data
    assert class_from_definition('zoo/Outer', cls._full_text) is cls


ANYTHING = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=3),
    st.binary(max_size=3),
    st.lists(st.one_of(st.integers(-300, 300), st.floats(), st.text(max_size=2)), max_size=3),
    st.tuples(st.integers(0, 2), st.integers(0, 2)),
    st.builds(genpy.Time),
    st.builds(genpy.Duration),
)


@settings(deadline=None)
@given(
    st.sampled_from([*PRIMITIVES, 'geometry_msgs/Point', 'std_msgs/Empty']),
    st.sampled_from(['', '[]', '[2]']),
    ANYTHING,
)
def test_fill_refuses_exactly_what_does_not_serialize(type_, array, value):
    cls = define_message(
        'zoo/Field' + type_.replace('/', '_') + str(len(array)), f'{type_}{array} x\n'
    )
    message = cls()
    message.x = value
    try:
        data = to_bytes(message)
    except Exception:
        with pytest.raises(MessageTypeError, match=r'\.x'):
            fill(cls(), {'x': value})
        with pytest.raises(MessageTypeError, match=r'\.x'):
            check_fits(message)
    else:
        assert to_bytes(fill(cls(), {'x': value})) == data
        check_fits(message)


@settings(deadline=None)
@given(st.one_of(st.text(), st.text(alphabet='int8 xyABC=#[]/"\'\\\n\r\t.-;()', max_size=60)))
def test_no_text_raises_anything_but_an_error_of_ours(text):
    try:
        class_from_definition('zoo/Any', text)
    except UnknownTypeError:
        pass
