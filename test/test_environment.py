"""Programs in this process find variables, modules, hooks and output as in their own process."""
import os
import sys
import types

import pytest

import pharos
from helpers import INIT, SPIN, TIMEOUT

# -- variables

PROGRAM = '<node pkg="bench" type="program" name="program">{}</node>'
SAYS_GPU = '''
import ctypes
rospy.init_node('program')
getenv = ctypes.CDLL(None).getenv
getenv.restype = ctypes.c_char_p
os.system('echo shell $GPU >> ' + SAID)
say(f'C {getenv(b"GPU")}')
rospy.spin()
'''
ENVIRONMENTS = {
    'launch file': ('<env name="GPU" value="1"/>', '', 'its environment has GPU=1'),
    'program': ('', "os.environ['GPU'] = '1'\n", '/program has "environ[\'GPU\'] ="'),
}


@pytest.mark.parametrize('xml, first, reason', ENVIRONMENTS.values(), ids=ENVIRONMENTS)
def test_environment_reaches_c_code_and_shells(master, bench, xml, first, reason):
    bench.write(first + SAYS_GPU)
    with bench.program(bench.launch_file(PROGRAM.format(xml), other=SPIN)) as composed:
        bench.until(lambda: {'shell 1', "C b'1'"} <= set(bench.said()))
        assert composed.node('/program').pid != composed.pid
        assert composed.node('/other').pid == composed.pid
    assert f'/program runs in a group of its own: {reason}' in composed.output


SAYS_WHERE = '''
rospy.init_node('program')
variable = os.popen('echo $GPU').read()
say(f'{rospy.get_name()} {os.getpid()} {variable}')
rospy.spin()
'''


def where(bench, count):
    """Wait until so many nodes have said where they run; return {name: (PID, $GPU of a child)}."""
    bench.until(lambda: len([line for line in bench.said() if line]) >= count)
    rows = [line.split(' ') for line in bench.said() if line]
    return {name: (int(pid), variable) for name, pid, variable in rows}


def test_nodes_of_one_environment_share_this_process(master, bench):
    """An <env> at the top of the file holds for all."""
    scripts = {name: SAYS_WHERE for name in ('one', 'two', 'three')}
    path = bench.launch_file('<env name="GPU" value="1"/>', **scripts)
    with bench.program(path) as composed:
        places = where(bench, 3)
        assert set(places.values()) == {(composed.pid, '1')}
    assert 'runs in' not in composed.output


def test_each_environment_is_one_process(master, bench):
    env = '<env name="GPU" value="{}"/>'
    bench.write(SAYS_WHERE)
    node = '<node pkg="bench" type="program" name="{}">{}</node>'
    names = {'a': '', 'b': '', 'c': env.format(1), 'd': env.format(1), 'e': env.format(2)}
    xml = ''.join(node.format(name, variable) for name, variable in names.items())
    with bench.program(bench.launch_file(xml)) as composed:
        places = where(bench, 5)
        assert [places[f'/{name}'][1] for name in 'abcde'] == ['', '', '1', '1', '2']
        pids = [places[f'/{name}'][0] for name in 'abcde']
        assert pids[0] == pids[1] == composed.pid
        assert pids[2] == pids[3] and len(set(pids)) == 3


def test_group_has_no_variable_of_this_process(master, bench):
    bench.write(SAYS_WHERE)
    node = '<node pkg="bench" type="program" name="{}">{}</node>'
    env = '<env name="GPU" value="1"/>'
    xml = node.format('a', env) + node.format('b', env) + node.format('c', '')
    with bench.program(bench.launch_file(xml)) as composed:
        places = where(bench, 3)
        assert places['/a'] == places['/b'] == (composed.pid, '1')
        assert places['/c'][1] == ''


def test_composition_gives_the_environment_back(master, bench):
    path = bench.launch_file('<env name="GPU" value="1"/>', one=SPIN)
    with master.compose(None, path):
        assert os.environ['GPU'] == '1'
    assert 'GPU' not in os.environ


def test_only_program_has_the_environment_of_the_process(master, bench):
    path = bench.write("os.environ['GPU'] = '1'\n" + SAYS_GPU)
    with bench.program('--script', path) as composed:
        bench.until(lambda: {'shell 1', "C b'1'"} <= set(bench.said()))
        assert master.node('/program').pid == composed.pid


def test_only_program_comes_back_with_its_environment(bench):
    bench.write(INIT + "say(os.environ.get('PATH'))\n")
    xml = '<node pkg="bench" type="program" name="program" respawn="true"/>'
    with bench.program(bench.launch_file(xml)):
        bench.until(lambda: len(bench.said()) >= 2)
    first, second, *_ = bench.said()
    assert first == second != 'None'


def test_program_chooses_its_master(master, bench):
    with pharos.Master.embedded() as other:
        script = bench.load(f"os.environ['ROS_MASTER_URI'] = '{other.url}'\n" + SPIN)
        assert script.master == other
        assert '/program' in [each.name for each in other.nodes()]
        assert not any(master.system_state())
        script.stop()


# -- modules


LOADERS = {
    'spec': "spec = importlib.util.spec_from_file_location('plug', path)\n"
    'm = importlib.util.module_from_spec(spec)\nspec.loader.exec_module(m)',
    'loader': "m = importlib.machinery.SourceFileLoader('plug', path).load_module()",
    'imp': "import warnings; warnings.simplefilter('ignore')\n"
    "import imp; m = imp.load_source('plug', path)",
    'runpy': 'import runpy, types; m = types.SimpleNamespace(**runpy.run_path(path))',
}
PLUG = "import rospy\ndef name(): return rospy.get_name()\n"


@pytest.mark.parametrize('how', LOADERS)
def test_loaded_plugin_has_the_rospy_of_its_node(bench, how):
    if how == 'imp' and sys.version_info >= (3, 12):
        pytest.skip('Python has no imp any more')
    path = bench.write(PLUG, 'plugins/plug.py', '')
    head = f'import importlib.machinery, importlib.util\npath = {path!r}\n'
    assert bench.load(f'{INIT}{head}{LOADERS[how]}\nsay(m.name())').wait(TIMEOUT) == 0
    assert bench.said() == ['/program']


def test_shared_module_is_imported_by_one_thread_at_a_time(bench, tmp_path, monkeypatch):
    """Two modules that import each other fail if two threads begin with one each, as in Python."""
    for one, other in ('a', 'b'), ('b', 'a'):
        text = f'import time\ntime.sleep(0.3)\nimport circle_{other}\ncircle_{other}.__file__, 1\n'
        (tmp_path / f'circle_{one}.py').write_text(text + f'value = "{one}"\n')
    monkeypatch.setenv('PYTHONPATH', f'{tmp_path}:{os.environ["PYTHONPATH"]}')
    begin = 'from circle_{0} import value\nrospy.init_node("{0}")\nsay(value)\n'
    launch = bench.launch_file(**{name: begin.format(name) for name in 'ab'})
    with bench.program(launch) as composed:
        assert composed.wait() == 0
    assert sorted(bench.said()) == ['a', 'b']


def test_failed_import_fails_again(bench):
    bench.write('import rospy\nraise OSError("no device")', 'helper.py', '')
    text = '''
        rospy.init_node('program')
        for attempt in range(2):
            try:
                import helper
                say('imported')
            except OSError as error:
                say(error)
        '''
    assert bench.load(text).wait(TIMEOUT) == 0
    assert bench.said() == ['no device'] * 2


def test_dataclass_of_a_program_leaves_the_process_its_module(bench, monkeypatch):
    module = types.ModuleType('wheels')
    monkeypatch.setitem(sys.modules, 'wheels', module)
    text = 'import dataclasses\n@dataclasses.dataclass\nclass Wheel:\n    size: int = 1\n'
    bench.write(text, 'wheels.py', '')
    assert bench.load(f'import wheels\n{INIT}say(wheels.Wheel().size)').wait(TIMEOUT) == 0
    assert bench.said() == ['1'] and sys.modules['wheels'] is module


# -- exceptions and output


def test_hooks_for_exceptions_are_called(bench):
    text = '''
        sys.excepthook = lambda kind, error, trace: say(f'main {kind.__name__}')
        threading.excepthook = lambda args: say(f'{args.thread.name} {args.exc_type.__name__}')
        rospy.init_node('program')
        thread = threading.Thread(target=lambda: 1 / 0, name='worker')
        thread.start()
        thread.join()
        raise RuntimeError
        '''
    assert bench.load(text).wait(TIMEOUT) == 1
    assert bench.said() == ['worker ZeroDivisionError', 'main RuntimeError']


def test_traceback_has_the_frames_of_the_program(bench, capfd):
    with pytest.raises(pharos.PharosError):
        bench.load('def read():\n    import no_such_module\nread()')
    lines = [line for line in capfd.readouterr().err.splitlines() if 'File "' in line]
    assert len(lines) == 2 and all('bench/program' in line for line in lines)


@pytest.mark.parametrize(
    'output, option, is_shown',
    [('', '', False), ('output="screen"', '', True), ('', '--screen', True)],
)
def test_output_is_as_with_roslaunch(bench, output, option, is_shown):
    bench.write(INIT + "print('printed')\nrospy.loginfo('logged')\nrospy.logwarn('warned')")
    xml = f'<node pkg="bench" type="program" name="program" {output}/>'
    with bench.program(bench.launch_file(xml), *filter(None, [option])) as composed:
        composed.wait()
    assert 'warned' in composed.output
    files = (bench.folder.parent / 'log').rglob('program-1-stdout.log')
    text = composed.output if is_shown else next(files).read_text()
    assert 'printed' in text and 'logged' in text
    assert ('printed' in composed.output) == ('logged' in composed.output) == is_shown
