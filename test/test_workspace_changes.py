"""A robot is programmed in a workspace while it runs: the report's driver of the turtle."""
import os
import signal
import sys

import pytest

from helpers import create
from pharos.testing import TIMEOUT, Mailbox, until
from programs import Program, forget_parameters, script
from terminal import Terminal


@pytest.fixture
def poses(master, tmp_path):
    """The poses of a turtle that a simulator moves."""
    with Program(master.url, script('turtle_simulator'), cwd=tmp_path):
        hearer = create(master, '/hearer')
        yield Mailbox(hearer, '/turtle1/pose', 'turtlesim/Pose')
        hearer.stop()
    forget_parameters(master.url)


@pytest.fixture
def session(master, poses):
    """A session in which the driver of listing 3.1 drives that turtle."""
    with Terminal(master.url, sys.executable, script('workspace'), script('turtle_driver')) as it:
        master.wait_for_node('/my_turtle_driver', TIMEOUT)
        it.press('C-c')
        it.wait_for(r'^In \[1\]:')
        it.enter('driver = master.node("/my_turtle_driver")')
        it.wait_for(r'^In \[2\]:')
        yield it
        os.kill(it.pid, signal.SIGTERM)
        it.wait()


def test_a_loop_of_a_running_driver_is_replaced_and_the_turtle_turns_the_other_way(session, poses):
    until(lambda: poses.next().angular_velocity > 0)
    session.enter(
        'def turn_right(me): [me.send_to("/turtle1/command_velocity", angular=-1.0)'
        ' for _ in me.every(0.1)]',
        '',
        'type(driver).publishing_loop = turn_right',
        'driver.renew()',
    )
    until(lambda: poses.next().angular_velocity < 0)


def test_a_failure_is_debugged_and_retried_while_the_turtle_goes_on(session, poses):
    session.enter(
        'seen = []',
        'channel = driver.interested_in("/turtle1/pose", delegate=lambda pose, _: pose.speed)',
    )
    session.enter('from pharos.testing import until; until(lambda: driver.failures) and None')
    session.wait_for(r'^In \[5\]:')
    session.enter('driver.failures')
    session.wait_for(r'^0 .* AttributeError')
    session.enter('driver.failures[0].debug()')
    session.wait_for('^ipdb>')
    session.enter('p "theta", type(pose).__name__')
    session.wait_for(r"^\('theta', '_?.*Pose'\)")
    x = poses.next().x
    until(lambda: poses.next().x != x)  # the driver is debugged, and drives
    session.enter('q', 'channel.delegate = lambda pose, _: seen.append(pose)')
    session.enter('"retried", driver.failures[0].retry(), driver.failures[0].message in seen')
    session.wait_for(r"^Out.*\('retried', True, True\)")
