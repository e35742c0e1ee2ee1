"""Message and service classes: found by name, or made of definitions, as genpy would make them."""
import concurrent.futures
import importlib
import inspect
import io
import pathlib
import shutil

import genpy.dynamic
import geometry_msgs.msg
import pytest
import std_msgs.msg
import std_srvs.srv

from helpers import create, one_in_five
from pharos import (
    MessageTypeError,
    UnknownTypeError,
    define_message,
    define_service,
    message_class,
    service_class,
)
from pharos.testing import Mailbox

PYTHON_PACKAGES = pathlib.Path(std_msgs.__file__).parent.parent
SHARE = pathlib.Path('/usr/share')
SEPARATOR = '=' * 80


def packages_with(kind):
    """The names of the installed packages that have messages ('msg') or services ('srv')."""
    return sorted(path.parent.parent.name for path in PYTHON_PACKAGES.glob(f'*/{kind}/__init__.py'))


def installed(package, kind='msg'):
    """The classes of a package: of its messages, or of its services."""
    mark = '_slot_types' if kind == 'msg' else '_request_class'
    classes = vars(importlib.import_module(f'{package}.{kind}')).values()
    return [value for value in classes if inspect.isclass(value) and hasattr(value, mark)]


def to_bytes(message):
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


def over_the_wire(message):
    return type(message)().deserialize(to_bytes(message))


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Write files of packages on ROS_PACKAGE_PATH: ``package('arm', 'msg/Joint.msg', text)``."""

    def write(name, path, text):
        file = tmp_path / name / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        (tmp_path / name / 'package.xml').write_text(
            f'<package><name>{name}</name><version>1.0.0</version><description>d</description>'
            '<maintainer email="a@b.c">a</maintainer><license>BSD</license></package>'
        )

    monkeypatch.setenv('ROS_PACKAGE_PATH', str(tmp_path))
    return write


# -- found


@pytest.mark.parametrize(
    'find, name, cls',
    [
        (message_class, 'geometry_msgs/Twist', geometry_msgs.msg.Twist),
        (message_class, 'std_msgs/Header', std_msgs.msg.Header),
        (service_class, 'std_srvs/SetBool', std_srvs.srv.SetBool),
    ],
)
def test_installed_type_gives_installed_class(find, name, cls):
    assert find(name) is cls
    assert find(cls) is cls


def test_turtlesims_types_are_shipped():
    for find, name, md5sum in [
        (message_class, 'Velocity', '9d5c2dcd348ac8f76ce2a4307bd63a13'),
        (message_class, 'Pose', '863b248d5016ca62ea2e895ae5265cf9'),
        (message_class, 'Color', '353891e354491c51aabe32df673fb446'),
        (service_class, 'Kill', 'c1f3d28f1b044c871e6eff2e9fc3c667'),
        (service_class, 'SetPen', '9f452acce566bf0c0954594f69a8e41b'),
        (service_class, 'Spawn', '0b2d2e872a8e2887d5ed626f2bf2c561'),
        (service_class, 'TeleportAbsolute', 'a130bc60ee6513855dc62ea83fcc5b20'),
        (service_class, 'TeleportRelative', '9d5c2dcd348ac8f76ce2a4307bd63a13'),
    ]:
        assert find(f'turtlesim/{name}')._md5sum == md5sum


def test_message_file_needs_no_generated_code(package):
    package('arm_msgs', 'msg/Joint.msg', 'float64 angle\n')
    package('arm_msgs', 'msg/Arm.msg', 'Header header\nJoint[] joints\ngeometry_msgs/Point tip\n')
    arm = message_class('arm_msgs/Arm')
    message = arm(joints=[message_class('arm_msgs/Joint')(angle=0.5)])
    assert message.tip == geometry_msgs.msg.Point()
    assert over_the_wire(message) == message


def test_service_file_needs_no_generated_code(package):
    package('arm_srvs', 'srv/Move.srv', 'float64 angle\n---\nbool moved\n')
    move = service_class('arm_srvs/Move')
    assert move._request_class(angle=0.5).angle == 0.5
    assert move._response_class().moved is False


def test_new_file_is_found(package, tmp_path):
    package('late_msgs', 'msg/First.msg', 'int8 x\n')
    with pytest.raises(UnknownTypeError):
        message_class('late_msgs/Second')
    package('late_msgs', 'msg/Second.msg', 'int8 y\n')
    assert message_class('late_msgs/Second')().y == 0


def test_installed_class_comes_before_file(package):
    package('std_msgs', 'msg/String.msg', 'int8 other\n')
    assert message_class('std_msgs/String') is std_msgs.msg.String


def test_file_comes_before_definition(package):
    package('both_msgs', 'msg/Joint.msg', 'float64 angle\n')
    with pytest.raises(MessageTypeError, match='both_msgs/Joint'):
        define_message('both_msgs/Joint', 'int8 other\n')
    assert message_class('both_msgs/Joint').__slots__ == ['angle']


def test_definition_comes_before_shipped_type(peer):
    """In a process of its own, as it changes a type for good."""
    peer.run("import pharos; pharos.define_message('turtlesim/Velocity', 'float64 speed')")
    assert peer.value("message_class('turtlesim/Velocity').__slots__") == ['speed']


def test_refused_package_has_its_types(package, tmp_path, peer):
    """Its package.xml lacks what catkin asks for; in a process that looks into this path first."""
    package('odd_msgs', 'msg/Leg.msg', 'Knee knee\n')
    package('odd_msgs', 'msg/Knee.msg', 'float64 angle\n')
    (tmp_path / 'odd_msgs' / 'package.xml').write_text('<package><name>odd_msgs</name></package>')
    assert peer.value("message_class('odd_msgs/Leg')().knee.angle") == 0
    with pytest.raises(RuntimeError, match='UnknownTypeError.*odd_msgs/Hip'):
        peer.run("message_class('odd_msgs/Hip')")


@pytest.mark.parametrize('find, define', [(message_class, 'message'), (service_class, 'service')])
def test_unknown_type_error_tells_places(tmp_path, monkeypatch, find, define):
    monkeypatch.setenv('ROS_PACKAGE_PATH', str(tmp_path))
    with pytest.raises(UnknownTypeError) as caught:
        find('leg_msgs/Knee')
    for said in 'leg_msgs/Knee', str(tmp_path), f'define_{define}(':
        assert said in str(caught.value)


@pytest.mark.parametrize(
    'find, slip, meant',
    [
        (message_class, 'std_msgs/Strin', 'std_msgs/String'),
        (message_class, 'std_msg/String', 'std_msgs/String'),
        (message_class, 'turtlesim/Velocty', 'turtlesim/Velocity'),
        (service_class, 'std_srvs/SetBol', 'std_srvs/SetBool'),
    ],
)
def test_near_type_is_named(find, slip, meant):
    with pytest.raises(UnknownTypeError) as caught:
        find(slip)
    assert f'{slip!r}: {meant}?' in str(caught.value)
    assert 'install' not in str(caught.value)


def test_bad_type_name_raises_its_error():
    for name in [
        '',
        'Nonsuch',
        '/a/B',
        'a/',
        '../a',
        'a/../B',
        'a/B\n',
        'a b/C',
        'a/msg/B',
        None,
        3,
    ]:
        for use in (
            message_class,
            service_class,
            lambda name: define_message(name, ''),
            lambda name: define_service(name, '---'),
        ):
            with pytest.raises(UnknownTypeError):
                use(name)


def test_broken_file_is_named(package):
    package('broken_msgs', 'msg/Leg.msg', 'int8\n')
    with pytest.raises(UnknownTypeError, match='broken_msgs/Leg'):
        message_class('broken_msgs/Leg')


def test_threads_get_one_class():
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        made = pool.map(lambda _: define_message('thread_msgs/T', 'int8 x\nstring y\n'), range(8))
        assert len(set(made)) == 1


# -- as genpy makes them


def assert_alike(made, cls):
    """A class is what genpy's is, but for its name."""
    assert made is not cls
    for name in '_md5sum', '__slots__', '_slot_types', '_has_header':
        assert getattr(made, name) == getattr(cls, name)
    for name, value in vars(cls).items():
        if name[0] != '_' and isinstance(value, (int, float, str)):  # a constant
            assert getattr(made, name) == value
    assert to_bytes(made()) == to_bytes(cls())


def test_defined_message_is_like_installed_one():
    for name in one_in_five(packages_with('msg')):
        for cls in installed(name):
            made = define_message(f'{cls._type}Again', cls._full_text)
            assert made._type == f'{cls._type}Again'
            assert_alike(made, cls)


def test_files_give_installed_md5sums(package, tmp_path):
    """Each .msg and .srv file of a package, copied into one that has no generated code."""
    for name in one_in_five({*packages_with('msg'), *packages_with('srv')}):
        package(f'copied_{name}', 'README', '')
        for kind, find in ('msg', message_class), ('srv', service_class):
            if not (SHARE / name / kind).is_dir():
                continue
            shutil.copytree(SHARE / name / kind, tmp_path / f'copied_{name}' / kind)
            files = (SHARE / name / kind).glob(f'*.{kind}')
            expected = {
                file.stem: getattr(importlib.import_module(f'{name}.{kind}'), file.stem)
                for file in files
            }
            found = {stem: find(f'copied_{name}/{stem}')._md5sum for stem in expected}
            assert found == {stem: cls._md5sum for stem, cls in expected.items()}


def test_defined_service_is_like_generated_one():
    made = define_service('made_srvs/SetBool', 'bool data\n---\nbool success\nstring message\n')
    like = std_srvs.srv.SetBool
    assert (made._type, made._md5sum) == ('made_srvs/SetBool', like._md5sum)
    assert made._request_class._type == 'made_srvs/SetBoolRequest'
    assert made._response_class._type == 'made_srvs/SetBoolResponse'
    assert_alike(made._request_class, like._request_class)
    assert_alike(made._response_class, like._response_class)


# -- defined


def test_definition_nests_types_of_all_kinds():
    define_message('zoo_msgs/Leg', 'int8 length\n')
    text = 'Header header\nLeg[] legs\nLeg[2] ears\nturtlesim/Pose pose\ngeometry_msgs/Pose place\n'
    beast = define_message('zoo_msgs/Beast', f'{text}time born\n')
    leg = message_class('zoo_msgs/Leg')
    message = beast(legs=[leg(1), leg(-2)], born=genpy.Time(1, 2))
    message.header.frame_id, message.pose.x = 'cage', 1.5
    assert over_the_wire(message) == message
    assert type(message.place) is geometry_msgs.msg.Pose
    assert beast._has_header


def test_nested_text_defines_types_too():
    cage = define_message(
        'cage_msgs/Cage', f'Lock lock\n{SEPARATOR}\nMSG: cage_msgs/Lock\nbool shut\n'
    )
    assert type(cage().lock) is message_class('cage_msgs/Lock')
    spin = define_service(
        'cage_msgs/Spin', 'Wheel wheel\n---\nWheel[] wheels\n===\nMSG: cage_msgs/Wheel\nint8 size\n'
    )
    wheel = message_class('cage_msgs/Wheel')
    response = spin._response_class([wheel(3)])
    assert over_the_wire(response) == response


def test_full_text_holds_nested_definitions():
    define_message('text_msgs/Lock', 'bool shut # "or not"\n')
    cage = define_message('text_msgs/Cage', 'Lock lock')
    nested = 'MSG: text_msgs/Lock\nbool shut # "or not"\n'
    assert cage._full_text == f'Lock lock\n{SEPARATOR}\n{nested}'


@pytest.mark.parametrize(
    'text, value',
    [
        ('int8 X=-5', -5),
        ('uint64 X = 18446744073709551615  # the largest', 2**64 - 1),
        ('bool X=True', True),
        ('float32 X=1.5e3', 1500.0),
        ('string X= a "b" \'c\' # \\ no comment\\', 'a "b" \'c\' # \\ no comment\\'),
    ],
)
def test_constant_is_attribute_of_class(text, value):
    name = f'const_msgs/{"".join(filter(str.isalpha, text))}'
    assert define_message(name, text).X == value


def test_python_keyword_gets_underscore():
    cls = define_message('zoo_msgs/Transfer', 'int8 from\nint8 to\n')
    assert over_the_wire(cls(from_=1, to=2)) == cls(from_=1, to=2)


def test_same_definition_gives_same_class():
    cls = define_message('same_msgs/Leg', 'int8 length\n')
    assert define_message('same_msgs/Leg', 'int8   length  # in cm') is cls
    assert message_class('same_msgs/Leg') is cls
    assert define_message('std_msgs/String', 'string data') is std_msgs.msg.String
    assert define_service('std_srvs/Empty', '---') is std_srvs.srv.Empty


@pytest.mark.parametrize(
    'define, name, text, other',
    [
        (define_message, 'redefined_msgs/Leg', 'int8 length', 'int16 length'),
        (define_message, 'std_msgs/String', 'string data', 'string text'),
        (define_service, 'std_srvs/Empty', '---', 'int8 x\n---'),
    ],
)
def test_other_definition_is_refused(define, name, text, other):
    cls = define(name, text)
    with pytest.raises(MessageTypeError, match=name):
        define(name, other)
    assert define(name, text) is cls


def test_message_and_service_share_a_name():
    assert issubclass(define_message('shared_msgs/Spin', 'int8 x'), genpy.Message)
    assert define_service('shared_msgs/Spin', 'int8 y\n---')._request_class.__slots__ == ['y']


# -- used


def test_defined_type_goes_between_nodes(master):
    define_message('used_msgs/Leg', 'int8 length\n')
    define_message('used_msgs/Beast', 'used_msgs/Leg[] legs\nstring name\n')
    box = Mailbox(create(master, '/hears'), '/beasts', 'used_msgs/Beast')
    leg = message_class('used_msgs/Leg')
    create(master, '/sends').send_to(
        '/beasts', typed_as='used_msgs/Beast', name='bob', legs=[leg(1), leg(2)]
    )
    message = box.next()
    assert (message.name, [each.length for each in message.legs]) == ('bob', [1, 2])


def test_dynamic_class_is_filled_by_dicts(master):
    nested = 'MSG: car_msgs/Wheel\nTyre tyre\n', 'MSG: car_msgs/Tyre\nint8 size\n'
    text = f'\n{SEPARATOR}\n'.join(['Wheel front\nWheel[] wheels', *nested])
    cls = genpy.dynamic.generate_dynamic('car_msgs/Car', text)['car_msgs/Car']
    box, node = Mailbox(create(master, '/hears'), '/cars', cls), create(master, '/sends')
    fields = {'front': {'tyre': {'size': 1}}, 'wheels': [{'tyre': {'size': 2}}, {}]}
    node.send_to('/cars', cls, **fields)
    node.output_channel('/cars', cls).send(fields)
    for car in box.next(), box.next():
        assert [wheel.tyre.size for wheel in [car.front, *car.wheels]] == [1, 2, 0]


def test_class_is_given_for_its_name(master):
    node = create(master)
    box = Mailbox(node, '/twist', geometry_msgs.msg.Twist)
    node.send_to(
        '/twist', lambda twist: setattr(twist.linear, 'x', 2.0), typed_as=geometry_msgs.msg.Twist
    )
    assert box.next().linear.x == 2.0
    node.serve('/clear', std_srvs.srv.Empty, lambda request: None)
    assert master.topic('/twist').type == 'geometry_msgs/Twist'
    assert node.lookup_service('/clear').type == 'std_srvs/Empty'


@pytest.mark.parametrize(
    'definition', [None, 'int32 a'], ids=['unknown here', 'defined otherwise here']
)
def test_live_publisher_defines_type(master, peer, definition):
    """A subscriber believes it before what define_message was given."""
    name = 'live_msgs/Known' if definition else 'live_msgs/Unknown'
    peer.run(
        f"import pharos; cls = pharos.define_message({name!r}, 'int32 a\\nLeg leg\\n==='\n"
        "    '\\nMSG: live_msgs/Leg\\nfloat32 length\\n')\n"
        "live = rospy.Publisher('/live', cls, queue_size=1, latch=True)\n"
        "live.publish(5, message_class('live_msgs/Leg')(2.5))"
    )
    if definition:
        define_message(name, definition)
    box = Mailbox(create(master), '/live', name)
    message = box.next()
    assert (message.a, message.leg.length) == (5, 2.5)


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
