"""examples/: what each does, with peers of ROS, and that its picture is true."""
import ast
import contextlib
import re
import signal
import subprocess
import sys

import pytest

import examples
from helpers import create
from pharos.testing import TIMEOUT, Mailbox, until
from programs import environment, forget_parameters, run
from sockets import refused_url

README = examples.EXAMPLES / 'README.md'
NAMES = pytest.mark.parametrize('name', examples.NAMES)


@contextlib.contextmanager
def example(name, master):
    """Run an example at the master; checks its pictures, and that it ends as it should. Gives the
    Program and its masters."""
    with examples.started(name, master.url) as program:
        masters = examples.masters_of(name, program, master.url)
        program.wait_for(examples.READY[name])
        for path, each in masters.items():
            drawn = examples.said_by_picture(path)
            until(
                lambda: examples.said(examples.look(name, each)) == drawn,
                what=f'what {path.name} shows: draw it anew with tools/pictures {name}',
            )
        yield program, list(masters.values())
        assert program.end(signal.SIGINT) == 0
        assert 'KeyboardInterrupt' not in program.read_to_the_end()
    forget_parameters(master.url)


def echo(master, topic):
    """The next message of a topic, as rostopic prints it."""
    return run(master.url, 'rostopic', 'echo', '-n1', topic).stdout


# -- each of them


def test_a_camera_steers_a_robot_by_a_parameter_that_is_set_meanwhile(master):
    with example('camera', master) as (program, _):
        turns = Mailbox(create(master, '/hearer_of_turns'), '/cmd_vel', 'geometry_msgs/Twist')
        assert abs(turns.next().angular.z) <= 0.5
        assert run(master.url, 'rosparam', 'set', '/controller/gain', '30.0').returncode == 0
        program.wait_for('the gain is 30.0 from now on')
        turns.wait_for(lambda twist: abs(twist.angular.z) > 0.5)
        assert 'angular' in echo(master, '/cmd_vel')


def test_a_busy_provider_answers_and_goes_on(master):
    with example('busy_service', master) as (program, _):
        program.wait_for('does something else: /arm/pick did not answer in time')
        # it is still at it
        assert 'data' in echo(master, '/arm/progress')
        answer = run(master.url, 'rosservice', 'call', '/arm/pick').stdout
        assert re.search('picked in|the arm is busy', answer)
        assert any('the arm is busy' in line for line in program.printed)


def test_an_action_is_done_or_cancelled(master):
    with example('action', master) as (program, _):
        program.wait_for('lift-off')
        program.wait_for('stopped at')
        other = create(master, '/other_client')
        feedback = Mailbox(other, '/countdown/feedback')
        other.send_to('/countdown/goal', goal_id={'id': 'by hand'}, goal={'goal': 4})
        feedback.wait_for(lambda told: told.status.goal_id.id == 'by hand')


def test_tf2_puts_together_what_is_broadcast(master):
    with example('transforms', master):
        assert 'frame_id: "map"' in echo(master, '/tf')
        position = Mailbox(create(master, '/hearer_of_positions'), '/camera/position').next()
        assert position.x**2 + position.y**2 == pytest.approx(2**2 + 0.5**2)


def test_one_topic_goes_from_robot_to_robot(master):
    with example('two_robots', master) as (_, masters):
        first, second = masters
        assert 'x:' in echo(second, '/goal')
        assert '/goal' not in [topic.name for topic in first.topics()]


def test_a_recording_is_replayed_again_and_again(master):
    with example('replay', master) as (program, (own,)):
        assert 'clock' in echo(own, '/clock')
        times = {'every': [], 'Timer': []}
        while 'replay 3' not in program.wait_for(''):
            found = re.match(r'([\d.]+) (every|Timer): x=(?!nan)', program.printed[-1])
            if found:
                times[found[2]].append(float(found[1]))
        for who, seen in times.items():
            assert seen != sorted(seen), f'{who} has not gone on after the jump back: {seen}'


def test_what_has_failed_or_stopped_is_restarted(master):
    with example('supervisor', master) as (program, _):
        said = ''
        while 'it was stopped' not in said:  # but that it had failed, if it did just before
            run(master.url, 'rosnode', 'kill', '/left')
            said = program.wait_for('restarts /left')
        until(lambda: master.live_node('/left'))
        assert any('the wheel is stuck' in line for line in program.printed)
        assert 'registered' in echo(master, '/diagnostics')


def test_the_supervisor_goes_on_when_the_master_comes_back(mortal_master):
    with examples.started('supervisor', mortal_master.url) as program:
        program.wait_for(examples.READY['supervisor'])
        mortal_master.end()
        program.wait_for('will try again: no ROS master answers')
        mortal_master.come_back()
        program.wait_for('had forgotten')
        for _ in range(3):  # one of the two has failed, and was restarted, more than once
            program.wait_for(': the wheel is stuck')
        assert program.end(signal.SIGINT) == 0


# -- all of them


@NAMES
def test_it_says_what_there_is_to_see(name):
    source = examples.path_of(name).read_text()
    assert 'Ctrl-C' in ast.get_docstring(ast.parse(source))
    assert source.endswith(f"    sys.exit(program.run('{name}', main, about=__doc__))\n")


def test_help_is_that():
    path = examples.path_of('camera')
    ended = run(refused_url(), sys.executable, str(path), '--help')
    assert (ended.returncode, ended.stderr) == (0, '')
    assert ended.stdout.strip() == ast.get_docstring(ast.parse(path.read_text()))


def test_without_a_master_it_is_said_in_one_line():
    url = refused_url()
    running = {
        name: subprocess.Popen(
            [sys.executable, str(examples.path_of(name))],
            env=environment(url),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for name in examples.NAMES
        if 'Master.embedded()' not in examples.path_of(name).read_text()
    }
    for name, process in running.items():
        output, errors = process.communicate(timeout=2 * TIMEOUT)
        assert (process.returncode, output) == (1, '')
        assert re.fullmatch(f'{name}: no ROS master answers at .*roscore.*\n', errors)


@NAMES
def test_an_example_is_short(name):
    source = examples.path_of(name).read_text()
    assert source.count('\n') < 60


@NAMES
def test_the_readme_shows_each(name):
    text = README.read_text()
    assert f'rosrun pharos {name}.py' in text
    pictures = [path.name for path in examples.EXAMPLES.glob(f'{name}*.svg')]
    assert pictures and all(f'({picture})' in text for picture in pictures)
