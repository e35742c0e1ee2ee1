"""What rosrun and roslaunch tell one node, shared out among the nodes of a program."""
import uuid

import pytest

from helpers import create
from pharos.testing import Mailbox
import pharos
from programs import PROGRAMS, ROOT
from test_ros_process import MANIFEST, write

STRING = 'std_msgs/String'


@pytest.fixture
def argv():
    """The arguments of a program, another one for each test: who has taken its __name keeps it."""
    return lambda *more: ['/bin/program', f'--run={uuid.uuid4()}', *more]


def names(master, argv, *named, **kwargs):
    return [create(master, name, argv=argv, **kwargs).name for name in named]


# -- several nodes


@pytest.mark.parametrize(
    'arguments, named, expected',
    [
        (['__name:=eye'], ['/a', '/b', '/c'], ['/eye', '/b', '/c']),
        (['__name:=eye'], ['/r/a', '/r/b'], ['/r/eye', '/r/b']),
        (
            ['__name:=eye', '__ns:=/robot'],
            ['/a', '/b', 'c'],
            ['/robot/eye', '/robot/b', '/robot/c'],
        ),
        (['__ns:=robot'], ['/a', 'b'], ['/robot/a', '/robot/b']),
        (
            ['__ns:=/robot'],
            ['/left/eye', '/right/eye', 'arm/eye'],
            ['/robot/left/eye', '/robot/right/eye', '/robot/arm/eye'],
        ),
        (['__name:=eye', '__ns:=/robot'], ['/left/a', '/left/b'], ['/robot/eye', '/robot/left/b']),
        (['__ns:=/'], ['/a'], ['/a']),
        (['__name:='], ['/a'], ['/a']),
    ],
)
def test_the_first_takes_the_name_and_the_others_keep_theirs(
    master, argv, arguments, named, expected
):
    assert names(master, argv(*arguments), *named) == expected


def test_a_list_of_the_same_arguments_is_the_same(master, argv):
    arguments = argv('__name:=eye')
    assert names(master, list(arguments), '/a') + names(master, tuple(arguments), '/b') == [
        '/eye',
        '/b',
    ]


def test_each_master_has_a_first(master, argv):
    arguments = argv('__name:=bridge')
    with pharos.Master.embedded() as other:
        assert names(master, arguments, '/one') + names(other, arguments, '/one', '/two') == [
            '/bridge',
            '/bridge',
            '/two',
        ]
    again = pharos.Master(master.url.replace('127.0.0.1', 'localhost'))
    assert names(again, arguments, '/three') == ['/three']


def test_who_has_taken_the_name_keeps_it(master, argv):
    arguments = argv('__name:=eye')
    first = create(master, '/first', argv=arguments)
    first.stop()
    second = create(master, '/second', argv=arguments)
    first.start()
    assert (first.name, second.name) == ('/eye', '/second')
    first.stop()
    assert create(master, '/first', argv=arguments).name == '/eye'


def test_remappings_and_parameters_hold_for_all(master, argv):
    arguments = argv('__name:=eye', 'image:=/camera/image', '_rate:=5')
    for named in '/a', '/b':
        node = create(master, named, argv=arguments)
        assert node.output_channel('image', STRING).topic == '/camera/image'
        assert node.parameter('~rate').value == 5
    assert master.parameters['/eye/rate'] == master.parameters['/b/rate'] == 5


def test_where_the_first_gives_up_its_own_name_that_is_told_once(master, argv, capsys):
    arguments = argv('__name:=perception', '__ns:=/robot')
    named = '/detector', '/controller', '/planner'
    nodes = [create(master, name, argv=arguments) for name in named]
    nodes[1].restart()
    (told,) = capsys.readouterr().err.splitlines()
    assert '/robot/controller: __name:=perception' in told
    assert "has named the node that it creates first, 'detector'" in told
    assert 'write <node name="detector">' in told


@pytest.mark.parametrize('given', ['__name:=detector', 'detector:__name:=eye', 'image:=/image'])
def test_where_each_has_the_name_that_is_meant_nothing_is_told(master, argv, capsys, given):
    arguments = argv(given)
    for name in '/detector', '/controller':
        create(master, name, argv=arguments)
    assert capsys.readouterr().err == ''


# -- for one node alone


def test_what_is_for_one_node_is_for_that_alone(master, argv):
    arguments = argv(
        'image:=/image',
        'detector:image:=/camera/image',
        'detector:__name:=spotter',
        'detector:_threshold:=0.5',
        '_threshold:=0.1',
        'detector:_url:=http://host:80/',
    )
    detector, other = (
        create(master, name, argv=arguments) for name in ('/robot/detector', '/robot/other')
    )
    assert (detector.name, other.name) == ('/robot/spotter', '/robot/other')
    assert detector.output_channel('image', STRING).topic == '/camera/image'
    assert other.output_channel('image', STRING).topic == '/image'
    assert (detector.parameter('~threshold').value, other.parameter('~threshold').value) == (
        0.5,
        0.1,
    )
    assert (detector.parameter('~url').value, other.parameter('~url').value) == (
        'http://host:80/',
        None,
    )


def test_who_has_a_name_of_its_own_leaves_the_other_one(master, argv):
    arguments = argv('__name:=eye', 'detector:__name:=spotter')
    assert names(master, arguments, '/detector', '/other') == ['/spotter', '/eye']


def test_a_namespace_of_its_own(master, argv):
    arguments = argv('__ns:=/robot', 'detector:__ns:=/lab')
    assert names(master, arguments, '/detector', '/other') == ['/lab/detector', '/robot/other']


def test_the_part_before_the_colon_is_the_last_of_the_name_given(master, argv):
    arguments = argv('eye:image:=/seen', 'left:image:=/wrong', '__name:=first')
    for named in '/left/eye', '/right/eye':
        assert (
            create(master, named, argv=arguments).output_channel('image', STRING).topic == '/seen'
        )


@pytest.mark.parametrize('variable', [None, 'ROS_NAMESPACE'])
@pytest.mark.parametrize('root', ['/', '//', '///'])
def test_the_root_is_a_namespace_however_it_is_written(master, monkeypatch, variable, root):
    if variable:
        monkeypatch.setenv(variable, root)
    assert create(master, 'eye', argv=[] if variable else [f'__ns:={root}']).name == '/eye'


# -- what is none


@pytest.mark.parametrize(
    'arguments',
    [
        '__name:=eye',
        'a:=b',
        b'__name:=eye',
        ['__name:=eye', 5],
        [None],
        5,
        False,
        {'a': 'b'},
        iter(['__name:=eye']),
        (each for each in ['eye:a:=b']),
    ],
)
def test_what_is_no_list_of_strings_is_refused(master, arguments):
    with pytest.raises(TypeError, match=r'argv is a list of strings, such as sys\.argv'):
        create(master, '/refused', argv=arguments)
    create(master, '/refused').stop()


@pytest.mark.parametrize(
    'arguments, says',
    [
        (['1image:=cam'], "'1image:=cam' in argv maps no name"),
        (['a:=b:=c'], "'a:=b:=c' in argv maps to several"),
        (['_p:=b:=c'], "'_p:=b:=c' in argv maps to several"),
        (['__name:=a b'], "'a b' cannot be a node name"),
        (['__name:=/ns/eye'], "'/ns/eye' cannot be a node name"),
        (['__ns:=a b'], "'a b' cannot be a namespace name"),
        (['__ns:=~a'], "'~a' cannot be a namespace name"),
        (['refused:__name:=1'], "'1' cannot be a node name"),
    ],
)
def test_a_mapping_that_cannot_be_one_is_refused(master, argv, arguments, says):
    before = master.system_state()
    with pytest.raises(ValueError, match=says):
        create(master, '/refused', argv=argv(*arguments))
    assert master.system_state() == before


def test_what_is_no_mapping_is_ignored_as_by_ros(master, argv):
    arguments = argv(
        'x', '-v', '--to=a:=b', ':=b', 'a:=', '_p:=', 'a b:=c', 'é:=b', 'other:_p:=1', '1:a:=b', ''
    )
    node = create(master, '/patient', argv=arguments)
    assert node.output_channel('a', STRING).topic == '/a'
    assert node.parameter('~p').value is None


@pytest.mark.parametrize('arguments', [['__name:=eye'], ['__name:=eye', '__ns:=/r']], ids=str)
def test_a_name_that_the_first_has_taken_from_another_is_told(master, argv, arguments):
    arguments = argv(*arguments)
    first = create(master, 'arm', argv=arguments)
    with pytest.raises(
        pharos.NodeNameInUseError,
        match=f"name {first.name} is taken by .* 'arm', which took it from __name:= in argv, .*<node>",
    ):
        create(master, 'eye', argv=arguments)
    with pytest.raises(pharos.NodeNameInUseError, match='this process: choose'):
        create(master, 'other', argv=argv())
        create(master, 'other', argv=argv())


# -- roslaunch


@pytest.fixture
def launch(master, tmp_path, monkeypatch):
    """Runs a launch file with a program of four nodes; returns what these have seen, {name: [topic,
    parameters...]}."""
    folder = tmp_path / 'src' / 'two_in_one'
    write(folder / 'package.xml', MANIFEST % 'two_in_one')
    write(folder / 'scripts' / 'program', (PROGRAMS / 'four_nodes.py').read_text(), 0o755)
    monkeypatch.setenv('PYTHONPATH', str(ROOT / 'src'))
    monkeypatch.setenv('ROS_PACKAGE_PATH', str(tmp_path / 'src'))
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))

    def run(text):
        write(folder / 'launch' / 'test.launch', text)
        seen, lines = {}, Mailbox()
        with master.launch('two_in_one', 'test.launch', on_line=lambda line: lines(line, None)):
            while True:
                words = lines.next().split()
                if words[:1] == ['SEEN']:
                    if words[1] == 'all':
                        registered = {node.name for node in master.nodes()}
                        return seen, registered
                    seen[words[1]] = words[2:]

    return run


def test_under_roslaunch_the_first_has_the_name_that_roslaunch_knows(launch):
    seen, registered = launch(
        """<launch><group ns="robot">
      <node pkg="two_in_one" type="program" name="vision" output="screen" args="_threshold:=3 eye:_threshold:=4">
        <remap from="image" to="/camera/image"/>
        <param name="given" value="7"/>
      </node>
      <param name="listener/mine" value="8"/></group></launch>"""
    )
    assert seen == {
        '/robot/vision': ['/camera/image', '7', 'None', '3', '/robot/'],
        '/robot/listener': ['/camera/image', 'None', '8', '3', '/robot/'],
        '/robot/left/eye': ['/camera/image', 'None', 'None', '4', '/robot/left/'],
        '/robot/right/eye': ['/camera/image', 'None', 'None', '4', '/robot/right/'],
    }
    assert set(seen) <= registered


def test_under_roslaunch_without_a_namespace(launch, tmp_path):
    seen, registered = launch(
        """<launch>
      <node pkg="two_in_one" type="program" name="vision" output="screen">
        <remap from="image" to="picture"/>
        <param name="given" value="7"/>
      </node></launch>"""
    )
    assert {name: values[:2] for name, values in seen.items()} == {
        '/vision': ['/picture', '7'],
        '/listener': ['/picture', 'None'],
        '/left/eye': ['/left/picture', 'None'],
        '/right/eye': ['/right/picture', 'None'],
    }
    assert set(seen) <= registered
    logs = {path.name for path in (tmp_path / 'log').rglob('*.log')}
    assert {'vision-1.log', 'listener.log', 'left_eye.log', 'right_eye.log'} <= logs  # each its own
