"""Programs that need a process of their own get one, alone or as a group; its crash is told."""
import os
import signal
import sys

import psutil
import pytest

from helpers import INIT, SPIN, end
from pharos.compose.sources import needs_group, why_apart
from pharos.testing import until


def check(tmp_path, question, texts, expected):
    """Ask a question about programs of these texts; the answer has the expected text, or is ''."""
    for text in texts.split('|'):
        (tmp_path / 'program').write_text(text)
        found = question(str(tmp_path / 'program'))
        assert expected in found and bool(expected) == bool(found), (text, found)


def test_first_line_may_name_another_python(tmp_path):
    right = '#!/usr/bin/python3|#!/usr/bin/env python3|#!/usr/bin/env -S python3 -u'
    check(tmp_path, why_apart, f'{right}|#!/usr/bin/python3.{sys.version_info.minor}', '')
    check(tmp_path, why_apart, '#!/usr/bin/python3.2|#!/home/me/venv/bin/python', 'names /')
    check(tmp_path, why_apart, '#!/usr/bin/env python2|#!/bin/sh', 'not a program of Python 3')


def test_program_may_need_a_plain_process(tmp_path):
    head = '#!/usr/bin/python3\n'
    needs = f'{head}reactor.run()|{head}import matplotlib.pyplot as p|{head}import pylab'
    check(tmp_path, why_apart, f'{needs}|{head}from matplotlib import cm, pyplot', 'needs one')
    check(tmp_path, why_apart, f'{head}import matplotlib.figure|{head}self.reactor.running()', '')


def test_program_may_need_an_environment(tmp_path):
    sets = "os.environ['GPU'] = '1'|os.environ.setdefault('OMP_NUM_THREADS', '1')|env = os.environ"
    sets += "|os.environ.update(TZ='UTC')|os.putenv('TZ', 'UTC')|os.environ[name] = value"
    sets += "|os.environ.pop('TZ')|del os.environ['TZ']"
    check(tmp_path, needs_group, sets, 'env')
    check(tmp_path, needs_group, 'np.set_printoptions(precision=3)', 'set_printoptions(')
    reads = "os.environ['ROS_NAMESPACE'] = ''|os.environ['TZ'] == 'UTC'|print(os.environ['TZ'])"
    check(tmp_path, needs_group, f'{reads}|subprocess.run(command, env=os.environ)', '')


APART = '<node pkg="bench" type="program" name="program">{}</node>'
SAYS_PROCESS = INIT + "say(f'{os.getppid()} {sys.argv[0]}')\nrospy.spin()\n"


@pytest.mark.parametrize('how', ['option', 'parameter'])
def test_node_apart_is_a_plain_process(master, bench, how):
    path = bench.write(SAYS_PROCESS)
    inside = '<param name="pharos_apart" value="true"/>' if how == 'parameter' else ''
    apart = ['--apart', 'program'] if how == 'option' else []
    with bench.program(bench.launch_file(APART.format(inside)), *apart) as composed:
        bench.until(bench.said)
        parent, program = bench.said()[0].split()
        assert program == path
        assert 'roslaunch_parent.py' in ' '.join(psutil.Process(int(parent)).cmdline())
        process = psutil.Process(master.node('/program').pid)
        assert not any('pharos' in each.path for each in process.memory_maps())
        assert process.cmdline()[1] == path
    assert '/program runs as a plain process: as --apart or pharos_apart says' in composed.output


def test_nodes_of_a_killed_roslaunch_end_or_respawn(master, bench):
    bench.write(INIT + "say(os.getpid())\nrospy.spin()\n")
    xml = ''.join(
        f'<node pkg="bench" type="program" name="{name}" respawn="{respawn}"/>'
        for name, respawn in [('one', 'true'), ('two', 'false')]
    )
    with bench.program(bench.launch_file(xml), '--apart', 'one', 'two') as composed:
        bench.until(lambda: len(bench.said()) == 2)
        for name in 'one', 'two':
            composed.node(f'/{name}')
        two = master.node('/two')
        os.kill(psutil.Process(two.pid).ppid(), signal.SIGKILL)
        bench.until(lambda: len(bench.said()) == 3)
        assert composed.node('/one').is_alive()
        until(lambda: '/two' not in [each.name for each in master.nodes()])
        assert end(composed) == 1
    until(lambda: not any(psutil.pid_exists(int(pid)) for pid in bench.said()))


# -- crashes are told


CRASH = '''
import ctypes
rospy.init_node('program')
say(os.getpid())
while not rospy.is_shutdown() and not rospy.get_param('/crash', False): rospy.sleep(0.01)
if not rospy.is_shutdown():
    rospy.delete_param('/crash')
    ctypes.string_at(0)
'''
GROUP = '<param name="pharos_group" value="g"/>'


@pytest.mark.parametrize('ending', ['SIGSEGV', 'SIGKILL'])
def test_crash_of_a_group_is_told_and_its_node_respawns(master, bench, ending):
    bench.write(CRASH)
    bench.write(SPIN.replace("'program'", "'beside'"), 'beside')
    xml = f'<node pkg="bench" type="program" name="program" respawn="true">{GROUP}</node>'
    xml += f'<node pkg="bench" type="beside" name="beside">{GROUP}</node>'

    def process_ids():
        return [int(line) for line in bench.said() if line.isdigit()]

    with bench.program(bench.launch_file(xml)) as composed:
        for count in 1, 2:
            bench.until(lambda count=count: len(process_ids()) == count)
            composed.node('/program')
            if ending == 'SIGKILL':
                os.kill(process_ids()[-1], signal.SIGKILL)
            else:
                master.parameters['/crash'] = True
            bench.until(lambda count=count: len(process_ids()) == count + 1)
            until(lambda: '/beside' not in [each.name for each in master.nodes()])
        assert end(composed) == 1
    assert f'/program: {ending} has ended their process' in composed.output
    assert '/program: back in a new process' in composed.output
    if ending == 'SIGSEGV':
        assert 'bench/program", line' in composed.output


def test_crash_of_a_group_with_a_required_node_ends_all(master, bench):
    bench.write(CRASH)
    xml = f'<node pkg="bench" type="program" name="program" required="true">{GROUP}</node>'
    with bench.program(bench.launch_file(xml, other=SPIN)) as composed:
        bench.until(lambda: 'ready' in bench.said() and len(bench.said()) == 2)
        master.parameters['/crash'] = True
        assert composed.wait() == 1
    assert not any(master.system_state())
