"""Unmodified rospy programs and launch files run as nodes of one process."""
import contextlib
import importlib
import inspect
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import xmlrpc.client

import genpy
import pytest
import rospy

import pharos
from helpers import (
    COMPOSE,
    INIT,
    PYTHON,
    ROOT,
    SPIN,
    TIMEOUT,
    Peer,
    Program,
    create,
    end,
    free_port,
    registrations,
)
from pharos import ExternalNode, Master, PharosError, ScriptNode, UnknownNodeError
from pharos.compose.control import control, reload_on_save
from pharos.live.editing import editable_modules
from pharos.testing import Mailbox, until

pytestmark = pytest.mark.usefixtures('bench')  # ROS finds the package robot
STRING = 'std_msgs/String'


@pytest.fixture
def ends(master, tmp_path):
    """``ends(how)`` loads a script that ends in this way; it may write to tmp_path/said."""
    return lambda how: master.load('robot', 'ends', how, str(tmp_path / 'said'))


@pytest.fixture
def compose(master, bench):
    """``compose('<node .../>')`` or ``compose('a.launch')`` of robot; it ends with the test."""
    begun = []

    def compose(what, **options):
        package = 'robot'
        if what.startswith('<'):
            package, what = None, bench.launch_file(what)
        begun.append(master.compose(package, what, **options))
        return begun[-1]

    yield compose
    for composition in begun:
        composition.stop()


def node(type_, package='bench', more='', inside=''):
    """Return the element of a launch file for a node, named after its type."""
    return f'<node pkg="{package}" type="{type_}" name="{type_}" {more}>{inside}</node>'


def links(ros_node):
    """Return the links that a node sends by, as ``(topic, receiver, transport)``."""
    _, _, found = xmlrpc.client.ServerProxy(ros_node.uri).getBusInfo('/test')
    return {(topic, receiver, how) for _, receiver, way, how, topic, *_ in found if way == 'o'}


# -- a whole robot, composed and as processes


SCRIPTS = 'front', 'avoider', 'gripper', 'settings', 'heartbeat', 'mission'
FACTS = (
    'started_as ranges commands beats latched_by_timer service private_service action'
    ' preempted_action state parameters log warning topics registrations switched_off left'
).split()


def behaviour(start):
    """Return what a rospy node in another process finds out about the robot that `start` starts."""
    with Master.embedded() as master, Peer(master.url) as peer:
        peer.run((ROOT / 'test' / 'robot' / 'observer.py').read_text())
        with start(master):
            facts = peer.value('observe()')
            names = [f'/rover/{name}' for name in SCRIPTS]
            facts['registrations'] = [registrations(master, name) for name in names]
        facts['switched_off'] = master.parameters['/switched_off']
        facts['left'] = [registrations(master, name) for name in names]
        return facts


@pytest.mark.skipif(
    'isAlive' in inspect.getsource(rospy.core.signal_shutdown),
    reason='rospy of Debian 11 ends by an AttributeError, roslaunch too: hooks may not run',
)
def test_composed_robot_behaves_as_launched():
    composed = behaviour(lambda master: master.compose('robot', 'robot.launch'))
    launched = behaviour(lambda master: master.launch('robot', 'robot.launch'))
    for fact in FACTS:
        assert (fact, composed[fact]) == (fact, launched[fact])


# -- master.load: one script


def test_loaded_script_is_a_node(master, bench):
    script = bench.load(SPIN)
    assert isinstance(script, ScriptNode) and isinstance(script, pharos.Node)
    assert master.node('/program') is script
    assert script in master.nodes()
    assert script.is_running


def test_path_and_args_are_kept(master, bench):
    script = master.load('robot', 'gripper', '--fast', 'x:=y')
    assert script.path == str(bench.folder.parent / 'robot' / 'scripts' / 'gripper')
    assert list(script.args)[:2] == ['--fast', 'x:=y']


@pytest.mark.parametrize(
    'args, options, name',
    [
        ([], {}, '/program'),
        ([], {'name': 'arm'}, '/arm'),
        ([], {'namespace': '/left'}, '/left/program'),
        ([], {'namespace': 'left', 'name': 'arm'}, '/left/arm'),
        (['__name:=leg'], {}, '/leg'),
        (['__ns:=/right', '__name:=leg'], {}, '/right/leg'),
    ],
)
def test_node_takes_given_name(bench, args, options, name):
    script = bench.load(SPIN, *args, **options)
    assert script.name == script.ros.get_name() == name


def test_anonymous_names_are_unique(master, bench):
    path = bench.write("rospy.init_node('program', anonymous=True)\nrospy.spin()")
    with master.load(path) as one, master.load(path) as other:
        assert one.name.startswith('/program_')
        assert one.name != other.name


SAY = "rospy.init_node('program')\nrospy.set_param('/said', {})\nrospy.spin()"


@pytest.mark.parametrize(
    'expression, expected',
    [
        ('sys.argv[1:4]', ['--mode', 'two words', '_depth:=3']),
        ('rospy.myargv()[1:]', ['--mode', 'two words']),
        ("os.environ['ROS_MASTER_URI']", 'URL'),
        ('__name__', '__main__'),
        ("sys.modules['__main__'].__dict__ is globals()", True),
        ("rospy.resolve_name('range')", '/sonar'),
        ("rospy.get_param('~gains')", {'p': [1, 2]}),
        ("rospy.get_param('~depth')", 3),
        ('threading.current_thread() is threading.main_thread()', True),
        ("exec('from std_srvs.srv import *') or sys.argv[1]", '--mode'),
        ("__import__('actionlib.msg').msg.TestGoal.__name__", 'TestGoal'),
    ],
)
def test_script_finds_what_it_was_given(master, bench, expression, expected):
    args = '--mode', 'two words', '_depth:=3'
    bench.load(
        SAY.format(expression), *args, remap={'range': '/sonar'}, params={'gains': {'p': [1, 2]}}
    )
    until(lambda: '/said' in master.parameters)
    assert master.parameters['/said'] == (master.url if expected == 'URL' else expected)


def test_exit_code_is_the_scripts(master, ends):
    codes = {'exit': 0, 'exit 3': 3, 'exit text': 1, 'error': 1, 'signal_shutdown': 0}
    for how, code in codes.items():
        script = ends(how)
        assert script.wait(TIMEOUT) == code
        assert script.exit_code == code
        assert not script.is_running
        assert registrations(master, '/ends') == [[], [], []]


def test_script_without_node_has_exit_code(bench):
    assert bench.load('sys.exit(4)').wait(TIMEOUT) == 4


def test_error_in_script_is_its_failure(bench, transcript):
    script = bench.load("rospy.init_node('program')\nrospy.sleep(0)\n1 / 0")
    script.wait(TIMEOUT)
    assert isinstance(script.errors[0], ZeroDivisionError)
    assert '\n1 / 0\n' in script.failures[0].traceback.replace('    ', '')
    assert script.failures[0].error is script.errors[0]


@pytest.mark.parametrize(
    'error, arguments',
    [
        (UnknownNodeError, ('no_such_package', 'talker')),
        (UnknownNodeError, ('robot', 'no_such_program')),
        (UnknownNodeError, ('/no/such/file.py',)),
        (PharosError, ('robot', 'relay')),
    ],
)
def test_missing_script_is_an_error(master, error, arguments):
    with pytest.raises(error, match=arguments[0]):
        master.load(*arguments)


@pytest.mark.parametrize('text, cause', [('1 / 0', ZeroDivisionError), ('return 1', SyntaxError)])
def test_early_failure_is_an_error(bench, text, cause):
    with pytest.raises(PharosError) as error:
        bench.load(text)
    assert isinstance(error.value.__cause__, cause)


def test_name_in_use_is_refused(bench, master):
    first = bench.load(SPIN)
    with pytest.raises(pharos.NodeNameInUseError):
        master.load(bench.write(SPIN, 'another'))
    assert first.is_running


def test_script_needs_a_master(bench):
    with pytest.raises(pharos.MasterUnreachableError):
        Master('http://127.0.0.1:1/').load(bench.write(SPIN))


def test_wait_has_a_time_limit(bench):
    with pytest.raises(TimeoutError):
        bench.load(SPIN).wait(0.01)


@pytest.mark.parametrize('how', ['spin', 'loop', 'rate', 'threads'])
def test_stop_ends_script(master, ends, how):
    """The fixture of the master finds that its threads have ended, too."""
    script = ends(how)
    script.stop()
    assert script.exit_code == 0
    assert not script.is_running
    assert registrations(master, '/ends') == [[], [], []]


def test_script_starts_again(master, ends):
    script = ends('spin')
    until(lambda: master.parameters.get('/ends/starts') == 1)
    script.stop()
    script.start()
    until(lambda: master.parameters['/ends/starts'] == 2)
    assert master.node('/ends') is script
    script.restart()
    until(lambda: master.parameters['/ends/starts'] == 3)


def test_rosnode_kill_ends_script(master, bench):
    script = bench.load(SPIN)
    with Program(['rosnode', 'kill', '/program'], master.url) as program:
        program.expect('killed')
    assert script.wait(TIMEOUT) == 0


def stop_when_ready(script, path):
    """Stop the script; return the lines that it wrote."""
    until(lambda: '/ends/ready' in registrations(script.master, '/ends')[0])
    script.stop()
    return path.read_text().split()


@pytest.mark.parametrize('name', ['SIGINT', 'SIGTERM'])
def test_signal_handler_is_called_at_stop(ends, tmp_path, name):
    script = ends(name)
    assert stop_when_ready(script, tmp_path / 'said') == [name]
    assert script.exit_code == 5


@pytest.mark.parametrize('how', ['thread', 'timer', 'executor'])
def test_script_waits_for_its_threads(master, ends, how):
    assert ends(how).wait(TIMEOUT) == 0
    assert master.parameters['/ends/worked'] is True


def test_program_whose_required_soul_has_ended_runs_again(bench):
    text = '''
        node = pharos.Master().create(pharos.BlockNode, 'program')
        if os.path.exists(SAID):
            node.fork(lambda me: [say('again') for turn in me.every(0.01)])
        else:
            say('first')
            node.fork(lambda me: None, required=True)
        pharos.spin()
        '''
    script = bench.load(text)
    assert script.wait(TIMEOUT) == 1
    script.start()
    until(lambda: bench.said().count('again') > 5 or script.exit_code is not None)
    assert script.is_running


# -- what is a script's own


DATA = '''
from __future__ import annotations
import dataclasses, typing
@dataclasses.dataclass
class Place:
    count: typing.ClassVar[int] = 0
    x: int = 0
'''


def test_helpers_beside_scripts_are_their_own(master, bench):
    for side in 'left', 'right':
        bench.write(f'SIDE = {side!r}', f'{side}/helpers.py')
        bench.write(DATA, f'{side}/places.py', '')
        path = bench.write(
            "import helpers, places\nrospy.init_node('program')\nrospy.set_param('~side', helpers.SIDE)",
            f'{side}/program',
        )
        master.load(path, name=side).wait(TIMEOUT)
    assert [master.parameters[f'/{side}/side'] for side in ('left', 'right')] == ['left', 'right']


def test_dataclass_of_program_may_have_class_variable(master, bench):
    path = bench.write(
        f"{DATA}\nimport rospy\nrospy.init_node('program')\n"
        "rospy.set_param('~fields', [each.name for each in dataclasses.fields(Place)])\n",
        head='',
    )
    assert master.load(path).wait(TIMEOUT) == 0
    assert master.parameters['/program/fields'] == ['x']


def test_each_run_has_modules_anew(master, bench):
    bench.write('calls = []', 'helpers.py')
    path = bench.write(
        '''
        import helpers
        rospy.init_node('program')
        helpers.calls.append(1)
        rospy.set_param('~calls', len(helpers.calls))
        '''
    )
    for name in 'left', 'right':
        script = master.load(path, name=name)
        script.wait(TIMEOUT)
        script.start()
        script.wait(TIMEOUT)
        assert master.parameters[f'/{name}/calls'] == 1


def test_library_on_rospy_is_each_scripts(master, bench, monkeypatch):
    bench.write('def name():\n    return rospy.get_name()', 'lib/names_its_node.py')
    monkeypatch.syspath_prepend(str(bench.folder / 'lib'))
    path = bench.write(
        '''
        import names_its_node
        rospy.init_node('program')
        rospy.set_param('~found', names_its_node.name())
        '''
    )
    for name in '/left', '/right':
        master.load(path, name=name).wait(TIMEOUT)
        assert master.parameters[f'{name}/found'] == name


@pytest.mark.parametrize(
    'module, is_shared',
    [('numpy', True), ('std_msgs.msg', True), ('rospy', False), ('actionlib', False)],
)
def test_modules_without_rospy_are_shared(master, bench, module, is_shared):
    bench.load(SAY.format(f"str(id(__import__('importlib').import_module({module!r})))"))
    until(lambda: '/said' in master.parameters)
    ours = str(id(importlib.import_module(module)))
    assert (master.parameters['/said'] == ours) == is_shared


def test_settings_of_process_stay(bench):
    before = os.getcwd(), list(sys.argv), list(sys.path)
    bench.load("os.environ['GREETING'] = 'x'\nsys.argv[:] = []\nsys.path.insert(0, '/x')").wait(
        TIMEOUT
    )
    assert 'GREETING' not in os.environ
    assert before == (os.getcwd(), sys.argv, sys.path)


# -- links


def test_links_between_scripts_are_intraprocess(master, compose):
    compose('sensing.launch')
    until(lambda: ('/range', '/avoider', 'INTRAPROCESS') in links(master.node('/sonar')))


def test_own_node_hears_script_intraprocess(master):
    node_ = create(master)
    mailbox = Mailbox(node_, '/range', 'sensor_msgs/Range')
    with master.load('robot', 'sonar'):
        mailbox.next()
        assert node_.channels[0].connections == [('/sonar', 'INTRAPROCESS')]


def test_clock_moves_time_of_script(master, bench):
    master.parameters['/use_sim_time'] = True
    script = bench.load(
        '''
        rospy.init_node('program')
        rospy.sleep(1000)
        rospy.set_param('/woke', rospy.get_time())
        '''
    )
    clock = create(master, '/clock_node').output_channel('/clock', 'rosgraph_msgs/Clock')
    seconds = iter(range(0, 10**9, 500))

    def has_ended_by_now():
        clock.send(clock=genpy.Time(next(seconds)))
        return not script.is_running

    until(has_ended_by_now)
    assert master.parameters['/woke'] >= 1000


def test_scripts_of_two_masters_are_apart(master, bench):
    path = bench.write(SPIN)
    with Master.embedded() as other, master.load(path) as one, other.load(path) as two:
        assert one.name == two.name
        assert (one.master.url, two.master.url) == (master.url, other.url)


# -- master.compose: launch files


def test_python_nodes_run_in_this_process(master, compose):
    composition = compose('sensing.launch')
    assert isinstance(composition, pharos.Composition)
    assert [each.name for each in composition.nodes] == ['/sonar', '/avoider']
    assert all(isinstance(each, ScriptNode) for each in composition.nodes)
    assert composition.process is None


def wait_for_gripper(master, name='/gripper'):
    """Wait until it has registered all: a process of rospy's that is ended before leaves some."""
    until(lambda: f'{name}/count' in master.system_state()[2], TIMEOUT)


def test_others_run_as_roslaunch_starts_them(master, compose):
    mailbox = Mailbox(create(master, '/ear'), '/relayed', 'sensor_msgs/Range')
    composition = compose('mixed.launch', frame='back')
    assert mailbox.next().header.frame_id == 'back'
    assert [each.name for each in composition.nodes] == ['/sonar']
    assert composition.process.poll() is None
    wait_for_gripper(master)
    assert all(
        isinstance(master.wait_for_node(name, TIMEOUT), ExternalNode)
        for name in ('/relay', '/gripper')
    )


def test_named_nodes_run_apart(master, compose):
    composition = compose('sensing.launch', apart=['sonar'])
    assert [each.name for each in composition.nodes] == ['/avoider']
    Mailbox(create(master, '/ear'), '/range', 'sensor_msgs/Range').next()  # all is registered
    assert isinstance(master.node('/sonar'), ExternalNode)


def test_only_chosen_nodes_run(compose):
    composition = compose('mixed.launch', only=['/sonar'])
    assert [each.name for each in composition.nodes] == ['/sonar']
    assert composition.process is None


def test_parameters_of_launch_file_are_set(master, bench, compose):
    bench.write('loaded: true', 'a.yaml', '')
    part = '<launch><arg name="x"/><param name="a" value="$(arg x)"/></launch>'
    bench.write(part, 'part.launch', '')
    for xml, name, value in [
        ('<param name="a" value="1" type="str"/>', '/a', '1'),
        ('<group ns="n"><param name="a" value="x"/></group>', '/n/a', 'x'),
        ('<rosparam>{a: {b: [1, x]}}</rosparam>', '/a', {'b': [1, 'x']}),
        ('<arg name="x" default="7"/><param name="a" value="$(eval x * 2)"/>', '/a', 14),
        ('<param name="a" value="1" if="false"/><param name="a" value="2" if="1"/>', '/a', 2),
        ('<param name="a" command="echo text"/>', '/a', 'text\n'),
        ('<group ns="o" clear_params="true"><param name="b" value="1"/></group>', '/o', {'b': 1}),
        ('<rosparam command="load" file="$(find bench)/a.yaml"/>', '/loaded', True),
        ('<include file="$(find bench)/part.launch"><arg name="x" value="5"/></include>', '/a', 5),
    ]:
        master.parameters['/o/value'] = 1
        compose(xml)
        assert master.parameters[name] == value


@pytest.mark.parametrize(
    'xml, expression, value',
    [
        ('<group ns="deep">{}</group>', 'rospy.get_name()', '/deep/tell'),
        ('<remap from="a" to="b"/>{}', "rospy.resolve_name('a')", '/b'),
        ('<env name="GREETING" value="hi"/>{}', "os.environ['GREETING']", 'hi'),
        ('<group ns="deep">{}</group>', 'rospy.get_namespace()', '/deep/'),
        ('<node pkg="bench" type="tell" name="$(anon x)"/>', 'rospy.get_name()[:3]', '/x_'),
        ('<node pkg="bench" type="tell" name="x" args="\'2 3\'"/>', 'rospy.myargv()[1]', '2 3'),
    ],
)
def test_node_of_launch_file_gets(master, compose, bench, xml, expression, value):
    bench.write(SAY.format(expression), 'tell')
    compose(xml.replace('{}', node('tell')))
    until(lambda: '/said' in master.parameters)
    assert master.parameters['/said'] == value


def test_bad_launch_file_is_an_error(compose):
    for error, said, file, args in [
        (UnknownNodeError, 'no_such.launch', 'no_such.launch', {}),
        (UnknownNodeError, 'framee', 'mixed.launch', {'framee': 1}),
        (UnknownNodeError, 'sonor', 'mixed.launch', {'only': ['sonor']}),
        (PharosError, 'mismatched tag', '<node>', {}),
        (PharosError, '<param> tag must have', '<param name="a"/>', {}),
        (PharosError, 'robott', '<arg name="robott"/><param name="a" value="$(arg robott)"/>', {}),
        (PharosError, 'multiple nodes', node('sonar', 'robot') * 2, {}),
        (PharosError, 'no_such_package', '<include file="$(find no_such_package)/a.launch"/>', {}),
    ]:
        with pytest.raises(error, match=said):
            compose(file, **args)


@pytest.mark.parametrize(
    'bad', [node('no_such_program'), node('x', 'no_such_package'), node('broken'), node('fails')]
)
def test_others_run_without_bad_node(compose, bench, transcript, bad):
    bench.write('return 1', 'broken')
    bench.write('1 / 0', 'fails')
    composition = compose(bad + node('sonar', 'robot'))
    assert [each.name for each in composition.nodes if each.is_running] == ['/sonar']
    assert transcript


def ending(more=''):
    """Return the element for a node that goes on while /stay is true."""
    return node('ends', 'robot', f'args="told" {more}')


@pytest.mark.parametrize('where', [{}, {'groups': [['ends']]}])
def test_respawned_node_starts_again(master, compose, where):
    compose(ending('respawn="true"'), **where)
    until(lambda: master.parameters.get('/ends/starts', 0) >= 3)


@pytest.mark.parametrize('where', [{}, {'apart': ['ends']}, {'groups': [['ends']]}])
def test_required_node_ends_all(master, compose, where):
    master.parameters['/stay'] = True
    composition = compose(ending('required="true"') + node('sonar', 'robot'), **where)
    until(lambda: '/ends/starts' in master.parameters)
    assert any(each.is_running for each in composition.nodes)
    master.parameters['/stay'] = False
    assert composition.wait(TIMEOUT) == 1
    assert not any(each.is_running for each in composition.nodes)


GROUPED = node('sonar', 'robot') + node('avoider', 'robot') + node('heartbeat', 'robot')


def test_groups_share_memory(master, compose):
    composition = compose(GROUPED, groups=[['sonar'], ['/avoider']])
    assert [each.name for each in composition.nodes] == ['/heartbeat']
    sonar, avoider = (master.wait_for_node(f'/{name}', TIMEOUT) for name in ('sonar', 'avoider'))
    until(lambda: ('/range', '/avoider', 'SHARED_MEMORY') in links(sonar), TIMEOUT)
    assert len({sonar.pid, avoider.pid, os.getpid()}) == 3
    composition.stop()
    until(lambda: not (sonar.is_alive() or avoider.is_alive()))


def test_launch_file_names_groups(master, compose):
    group = '<param name="pharos_group" value="senses"/>'
    compose(node('sonar', 'robot', inside=group) + node('avoider', 'robot', inside=group))
    pids = {master.wait_for_node(f'/{name}', TIMEOUT).pid for name in ('sonar', 'avoider')}
    assert len(pids) == 1 and os.getpid() not in pids


def test_program_takes_groups(master, bench):
    with bench.program('robot', 'sensing.launch', '--group', 'sonar') as composed:
        assert composed.node('/avoider').pid == composed.pid
        sonar = composed.node('/sonar')
        assert sonar.pid != composed.pid
    assert not sonar.is_alive()


def test_save_reloads_a_node_of_a_group(master, bench, tmp_path):
    path = tmp_path / 'robot/scripts/sonar'
    options = '--group', 'sonar', '--reload'
    with bench.program('robot', 'sensing.launch', *options) as composed:
        composed.until(lambda: composed.output.count('hears') > 5)  # looks at the file go on
        path.write_text(path.read_text().replace('is ready', 'is as ready as can be'))
        composed.expect('/sonar done: Sonar.report takes effect')


def test_commands_control_a_node(master, compose):
    composition = compose(node('sonar', 'robot') + ending('respawn="true"'))
    box = Mailbox(create(master, '/ear'), '/range', 'sensor_msgs/Range')
    (sonar, _) = composition.nodes

    def command(action, name='sonar'):
        with Program(['rosrun', 'pharos', action, name], master.url) as program:
            return program.wait(), program.output

    box.next()
    assert command('stop') == (0, '')
    assert not sonar.is_running and not composition.is_over
    assert command('start') == (0, '')
    assert sonar.is_running
    first_run = sonar.uri
    assert command('restart') == (0, '')
    assert command("reload") == (0, "nothing has changed\n")
    assert sonar.is_running and sonar.uri != first_run
    status, output = command('restart', 'nobody')
    assert status == 1 and '/nobody is not a node of a composition' in output


def test_commands_leave_other_masters_alone(compose):
    (sonar,) = compose(node('sonar', 'robot')).nodes
    with Program(['rosrun', 'pharos', 'stop', 'sonar'], 'http://127.0.0.1:1/') as program:
        assert program.wait() == 1
    assert sonar.is_running


def test_wait_returns_when_all_ended(master, compose):
    master.parameters['/stay'] = True
    composition = compose(ending())
    with pytest.raises(TimeoutError):
        composition.wait(0.01)
    master.parameters['/stay'] = False
    assert composition.wait(TIMEOUT) == 0
    assert composition.nodes[0].exit_code == 3


def test_stop_ends_all_nodes(master, compose):
    composition = compose('mixed.launch')
    master.wait_for_node('/relay', TIMEOUT)
    wait_for_gripper(master)
    composition.stop()
    assert not any(each.is_running for each in composition.nodes)
    assert composition.process.poll() is not None


def test_last_node_can_be_stopped_and_started(master, bench):
    with master.compose(None, bench.launch_file(program=SPIN)) as composition:
        (script,) = composition.nodes
        composition.control(script, 'stop')
        with pytest.raises(TimeoutError):
            composition.wait(0.2)
        composition.control(script, 'start')
        assert script.is_running


def test_end_waits_for_a_slow_program(master, bench, monkeypatch):
    monkeypatch.setattr('pharos.compose.composition.SLOW_END', 0.01)
    text = f"{INIT}rospy.on_shutdown(lambda: [time.sleep(0.5), say('stands')])\nsay('ready')\n"
    with master.compose(None, bench.launch_file(program=f'{text}rospy.spin()')):
        bench.until(bench.said)
    assert bench.said() == ['ready', 'stands']


# -- rosrun pharos compose


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_program_composes_until_signal(master, bench, number):
    command = ['rosrun', 'pharos', 'compose', 'robot', 'mixed.launch', 'frame:=back']
    with Program(command, master.url) as composed:
        mailbox = Mailbox(create(master, '/ear'), '/relayed', 'sensor_msgs/Range')
        assert mailbox.next().header.frame_id == 'back'
        assert composed.node('/sonar').pid == composed.pid
        wait_for_gripper(master)
        composed.signal(number)
        composed.wait()
    until(lambda: {each.name for each in master.nodes()} <= {'/ear', '/rosout', '/pharos'})


def test_interrupt_while_it_is_imported_is_silent(master, tmp_path):
    (tmp_path / 'rosgraph.py').write_text("print('imports')\nimport time\ntime.sleep(60)")
    path = f'{tmp_path}:{os.environ["PYTHONPATH"]}'
    with Program([*COMPOSE, 'robot', 'robot.launch'], master.url, PYTHONPATH=path) as composed:
        composed.expect('imports')
        composed.signal(signal.SIGINT)
        assert composed.wait() == -signal.SIGINT
    assert composed.output == 'imports\n'


def test_second_composition_is_refused_without_a_traceback(bench):
    file = bench.launch_file(program=SPIN)
    with bench.program(file) as first:
        bench.until(bench.said)
        with Program([*COMPOSE, file], bench.master.url) as second:
            second.expect('/program has ended, with exit code 1')
        assert 'NodeNameInUseError: /program is running already, at' in second.output
        assert 'Traceback' not in second.output
        assert not first.has_ended


def test_program_takes_only_and_apart(master, bench):
    chosen = '--only', 'heartbeat', 'gripper', '--apart', 'gripper'
    with bench.program('robot', 'robot.launch', 'robot:=r2', *chosen) as composed:
        assert composed.node('/r2/heartbeat').pid == composed.pid
        wait_for_gripper(master, '/r2/gripper')
        assert master.node('/r2/gripper').pid != composed.pid
        assert '/r2/mission' not in [each.name for each in master.nodes()]


def test_program_prefixes_what_scripts_print(master, bench):
    path = bench.write(
        '''
        rospy.init_node('program')
        print('printed')
        print('aside', file=sys.stderr)
        rospy.loginfo('logged')
        1 / 0
        '''
    )
    with bench.program('--script', path) as composed:
        composed.wait()
    lines = composed.output.splitlines()
    assert {'[/program] printed', '[/program] aside'} <= set(lines)
    assert any(line.startswith('[/program] [INFO]') and 'logged' in line for line in lines)
    assert any('1 / 0' in line for line in lines)


def test_program_runs_several_scripts(master, bench):
    with bench.program('--script', 'robot/gripper', 'robot/heartbeat') as composed:
        for name in '/gripper', '/heartbeat':
            assert composed.node(name).pid == composed.pid


@pytest.mark.parametrize(
    'arguments, said',
    [
        (['robot', 'no_such.launch'], 'no_such.launch'),
        (['bad.launch'], 'mismatched tag'),
        (['robot', 'mixed.launch', 'framee:=x'], 'framee'),
        (['--script', 'robot/no_such_program'], 'no_such_program'),
    ],
)
def test_program_fails_with_status(bench, arguments, said, monkeypatch):
    monkeypatch.chdir(bench.folder)
    bench.write('<launch><node></launch>', 'bad.launch', '')
    with bench.program(*arguments) as composed:
        assert composed.wait() == 1
    assert said in composed.output
    assert 'Traceback' not in composed.output


def test_required_node_is_programs_status(bench):
    with bench.program(bench.launch_file(ending('required="true"'))) as composed:
        assert composed.wait() == 1


def test_stopped_node_does_not_respawn(master, compose):
    again = '<node pkg="robot" type="ends" name="again" args="told" respawn="true"/>'
    master.parameters['/stay'] = True
    composition = compose(ending('respawn="true"') + again)
    ends, _ = composition.nodes
    until(lambda: master.parameters.get('/ends/starts') and master.parameters.get('/again/starts'))
    composition.control(ends, 'stop')
    master.parameters['/stay'] = False
    until(lambda: master.parameters['/again/starts'] >= 3, TIMEOUT)
    assert not ends.is_running and master.parameters['/ends/starts'] == 1
    composition.control(ends, 'start')
    until(lambda: master.parameters['/ends/starts'] >= 3, TIMEOUT)  # it respawns again


def test_scripts_start_side_by_side_with_arguments(master, bench):
    waits = 'while not os.path.exists(SAID): time.sleep(0.01)\n'
    slow = bench.write(f'{waits}{INIT}rospy.spin()', 'slow')
    quick = bench.write(
        "rospy.init_node('quick')\nsay(rospy.get_param('~rate'))\nrospy.spin()", 'quick'
    )
    with bench.program('--script', slow, quick, '_rate:=5', '__ns:=/left') as composed:
        bench.until(lambda: bench.said() == ['5'])
        assert composed.node('/left/program')
        assert master.node('/left/quick').pid == composed.pid


@pytest.mark.parametrize('text, status', [('sys.exit(3)', 3), ('1 / 0', 1), ('', 0)])
def test_status_is_that_of_the_only_program(bench, text, status):
    with bench.program(bench.write(INIT + text, 'program.py')) as composed:
        assert composed.wait() == status


def test_without_arguments_its_usage_is_shown(master):
    with Program(COMPOSE, master.url) as composed:
        assert composed.wait() == 2
    assert 'usage: compose' in composed.output


# -- compose as a node of roslaunch


NAMED = '''
rospy.init_node('{0}')
say(rospy.get_name())
say([each for each in sys.argv if 'robot' in each])
rospy.spin()
'''


@contextlib.contextmanager
def as_node(bench, args, inside=''):
    """Run roslaunch with compose as its only node, named robot, in the group of a namespace."""
    for name in 'talk', 'hear':
        bench.write(NAMED.format(name), name)
    node = f'<node pkg="pharos" type="compose" name="robot" args="{args}" output="screen">'
    xml = f'<launch><group ns="rig">{inside}{node}</node></group></launch>'
    with Program(['roslaunch', bench.write(xml, 'all.launch', '')], bench.master.url) as launched:
        try:
            yield launched
        finally:
            end(launched)


def test_node_of_roslaunch_runs_scripts(bench):
    """The name and the log that roslaunch gives are those of compose, not of each program."""
    paths = f'{bench.folder}/talk {bench.folder}/hear'
    with as_node(bench, f'--script {paths}') as launched:
        launched.until(lambda: len(bench.said()) == 4)
    assert sorted(bench.said()) == ['/rig/hear', '/rig/talk', '[]', '[]']


@pytest.mark.parametrize('args', ['--script {0}/talk {0}/hear', '{0}/programs.launch'])
def test_remap_in_scope_of_a_node_is_taken(bench, args):
    """It holds for its programs, and is no argument of a launch file."""
    xml = ''.join(f'<node pkg="bench" type="{name}" name="{name}"/>' for name in ('talk', 'hear'))
    bench.write(f'<launch>{xml}</launch>', 'programs.launch', '')
    remap = '<remap from="chatter" to="words"/>'
    with as_node(bench, args.format(bench.folder), remap) as launched:
        launched.until(lambda: len(bench.said()) == 4)
    assert sorted(bench.said())[:2] == ['/rig/hear', '/rig/talk']


def test_respawn_waits_for_its_delay(bench):
    bench.write(INIT + 'say(time.time())\n')
    more = 'respawn="true" respawn_delay="0.5"'
    with bench.program(bench.launch_file(f'<node pkg="bench" type="program" name="p" {more}/>')):
        bench.until(lambda: len(bench.said()) >= 2)
    first, second, *_ = map(float, bench.said())
    assert second - first >= 0.5


def test_node_with_a_folder_runs_there(bench):
    bench.write(INIT + 'say(os.getcwd())\nrospy.spin()\n')
    xml = '<node pkg="bench" type="program" name="program" cwd="node"/>'
    with bench.program(bench.launch_file(xml)):
        bench.until(bench.said)
    assert bench.said() == [str(bench.folder)]


def test_program_with_a_window_runs_here_if_asked(bench):
    path = bench.launch_file(program=f'import tkinter\n{INIT}say(os.getpid())\nrospy.spin()\n')
    for options in [], ['--here', 'program']:
        with bench.program(path, *options) as composed:
            bench.until(lambda options=options: len(bench.said()) == 1 + len(options) // 2)
            is_here = bench.said()[-1] == str(composed.pid)
        assert is_here == bool(options)


def test_master_is_started_if_there_is_none(bench, monkeypatch):
    bench.master = pharos.Master(f'http://127.0.0.1:{free_port()}/')
    with bench.program(bench.launch_file(program=SPIN)) as composed:
        bench.until(lambda: bench.said() == ['ready'])
        assert bench.master.node('/program').pid == composed.pid
        assert 'no ROS master at' in composed.output
        end(composed)
    assert not bench.master.is_reachable()


# -- control


OTHER_USER = ['setpriv', '--reuid', '65534', '--clear-groups']
needs_other_user = pytest.mark.skipif(
    not shutil.which('setpriv') or subprocess.call([*OTHER_USER, 'true']) != 0,
    reason='needs the right to be another user',
)


def test_silent_client_keeps_no_other_out(master, bench):
    with master.compose(None, bench.launch_file(program=SPIN)) as composition:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as silent:
            silent.connect(f'\0pharos-compose-{os.getpid()}')
            control('restart', '/program', master)
        assert composition.nodes[0].is_running


def test_program_is_controlled_by_the_names_of_its_nodes(master, bench):
    bench.write(
        """
        master = pharos.Master()
        for name in 'arm', 'hand': master.create(pharos.BlockNode, name)
        say('ready')
        pharos.spin()
        """
    )
    launch = bench.launch_file('<node pkg="bench" type="program" name="program"/>')
    with master.compose(None, launch) as composition:
        bench.until(lambda: bench.said() == ['ready'])
        assert control('stop', '/hand', master) == '/program'
        assert not composition.nodes[0].is_running
        assert control('start', '/arm', master) == '/program'
        bench.until(lambda: bench.said() == ['ready'] * 2)


@pytest.mark.parametrize(
    'name, text, said',
    [
        ('helper.py', 'import rospy\nx = = 1\n', r'helper\.py:2: '),
        ('program', 'def', 'cannot be read as Python 3'),
    ],
)
def test_restart_keeps_a_node_that_cannot_be_read(master, bench, name, text, said):
    bench.write('import rospy\n', 'helper.py', '')
    with master.compose(None, bench.launch_file(program='import helper\n' + SPIN)) as composition:
        bench.until(lambda: bench.said() == ['ready'])
        bench.write(text, name, '')
        with pytest.raises(pharos.PharosError, match=said):
            composition.control(composition.nodes[0], 'restart')
        assert composition.nodes[0].is_running


EDITED = '''
def word(): return '{}'
rospy.init_node('program')
last = ''
while not rospy.is_shutdown():
    if word() != last:
        last = word()
        say(last)
    time.sleep(0.01)
'''


@pytest.mark.parametrize('what', ['editable_modules', '_answer', 'Transcript'])
def test_failed_look_at_files_is_made_again(master, bench, monkeypatch, what):
    failed, may_fail = threading.Event(), threading.Event()

    def failing_once(function):
        def call(*args, **kwargs):
            if may_fail.is_set() and not failed.is_set():
                failed.set()
                raise RuntimeError('this look fails')
            return function(*args, **kwargs)

        return call

    def look(node):
        looks.append(node)
        return editable_modules(node)

    module = 'pharos.compose.control'
    looks = []
    monkeypatch.setattr(f'{module}.editable_modules', look)
    if what == 'editable_modules':
        monkeypatch.setattr(f'{module}.editable_modules', failing_once(look))
    elif what == '_answer':
        monkeypatch.setattr(f'{module}._answer', failing_once(pharos.compose.control._answer))
    else:
        monkeypatch.setattr(type(pharos.Transcript), 'show', failing_once(lambda *things: None))
    with master.compose(None, bench.launch_file(program=EDITED.format('first'))) as composition:
        thread = threading.Thread(target=reload_on_save, args=[composition])
        thread.start()
        bench.until(lambda: bench.said() == ['first'])
        bench.until(lambda: len(looks) > 1)  # nothing sees a save before the end of the first
        bench.write(EDITED.format('second'))
        bench.until(lambda: len(bench.said()) > 1)
        may_fail.set()
        bench.write(EDITED.format('the third'))
        assert failed.wait(TIMEOUT)
        bench.write(EDITED.format('the fourth'))
        bench.until(lambda: bench.said()[-1] == 'the fourth')
    thread.join(TIMEOUT)


def test_failed_accept_ends_no_control(master, bench, monkeypatch):
    accept, failed = socket.socket.accept, threading.Event()

    def fail_once(sock):
        if sock.family == socket.AF_UNIX and not failed.is_set():
            failed.set()
            raise ValueError('odd')
        return accept(sock)

    with master.compose(None, bench.launch_file(program=SPIN)):
        monkeypatch.setattr(socket.socket, 'accept', fail_once)
        control('restart', '/program', master)
        assert failed.wait(TIMEOUT)
        assert control('restart', '/program', master) == '/program'


TAKES_NAME = '''
import socket, sys, threading
sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
sock.bind('\\0pharos-compose-' + sys.argv[1])
sock.listen()
print('taken', flush=True)
threading.Event().wait()
'''


@needs_other_user
def test_control_name_that_another_user_has_is_told(master, bench, transcript):
    """The name has the number of this process: the nodes of the composition cannot be controlled."""
    command = [*OTHER_USER, PYTHON, '-c', TAKES_NAME, str(os.getpid())]
    with Program(command, master.url) as thief:
        thief.expect('taken')
        with master.compose(None, bench.launch_file(program=SPIN)):
            bench.until(bench.said)
        thief.signal(signal.SIGKILL)
    (line,) = [line for line in transcript if 'control name' in line]
    assert 'user' in line
