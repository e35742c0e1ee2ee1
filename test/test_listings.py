"""The report's listings, each as the program that a reader runs.

Other nodes of the tests live in this process; the programs are processes of their own, told apart
by `__name`.
"""
import importlib.machinery
import importlib.util
import posixpath
import signal
import socket
import threading

import pytest
from pharos.testing import Mailbox, TIMEOUT
from programs import Program, forget_parameters, run, script

from pharos import BlockNode, Transcript

COMMANDS = '/turtle1/command_velocity'
EMPTY_MD5SUM = 'd41d8cd98f00b204e9800998ecf8427e'
PUBLISHERS = ['turtle_driver', 'block_publisher', 'block_both']
SCRIPTS = PUBLISHERS + ['turtle_logger', 'block_subscriber', 'clear_turtle', 'turtle_simulator']


@pytest.fixture(autouse=True)
def no_parameters_left(master):
    yield
    forget_parameters(master.url)


@pytest.fixture
def turtle(master):
    """A node in the place of the report's turtle, whose delegate keeps the commands that it was
    sent."""
    return turtle_at(master, COMMANDS)


def turtle_at(master, topic):
    node = master.create(BlockNode, named='/turtle', delegate=Mailbox())
    node.output_channel(f'{posixpath.dirname(topic)}/pose', typed_as='turtlesim/Pose')
    node.interested_in(topic, typed_as='turtlesim/Velocity')
    return node


def next_command(node):
    message = node.delegate.next()
    return message.linear, message.angular


def classes_of(name):
    """A script as a module."""
    loader = importlib.machinery.SourceFileLoader(name, script(name))
    loader.set_data = lambda *args, **kwargs: None  # no __pycache__ beside the scripts
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader(name, loader))
    loader.exec_module(module)
    return module


def free_ports():
    with socket.create_server(('127.0.0.1', 0)) as one, socket.create_server(
        ('127.0.0.1', 0)
    ) as other:
        return one.getsockname()[1], other.getsockname()[1]


# -- the listings


def test_listing_3_1_a_publisher_node_is_a_class_with_a_loop_that_stop_ends(master, turtle):
    driver = master.create(
        classes_of('turtle_driver').TurtleDriver, named='/my_turtle_driver', argv=['_period:=0.02']
    )
    for _ in range(3):
        assert next_command(turtle) == (2.0, 1.0)
    process = driver.process
    driver.stop()
    assert not process.is_alive()
    driver.start()
    assert next_command(turtle) == (2.0, 1.0)
    driver.stop()


def test_listing_3_2_a_driver_runs_under_the_name_the_address_and_the_ports_it_is_given(
    master, turtle
):
    tcp_port, xmlrpc_port = free_ports()
    with Program(
        master.url,
        script('turtle_driver'),
        '--domain',
        '127.0.0.1',
        '--tcp-port',
        str(tcp_port),
        '--xmlrpc-port',
        str(xmlrpc_port),
        '_linear:=0.5',
        '_angular:=-1',
        '_period:=0.02',
    ) as driver:
        assert next_command(turtle) == (0.5, -1.0)
        assert master.node('/my_turtle_driver').uri == f'http://127.0.0.1:{xmlrpc_port}/'
        socket.create_connection(('127.0.0.1', tcp_port), TIMEOUT).close()
        assert driver.end() == 0
    assert COMMANDS not in master.system_state()[0]


def test_listing_3_3_a_subscriber_node_is_a_class_with_a_delegate_that_shows_each_message(
    master, transcript
):
    logger = master.create(classes_of('turtle_logger').TurtleLogger, named='/my_turtle_logger')
    assert {(channel.topic, channel.type) for channel in logger.channels} == {
        ('/turtle1/cmd_vel', 'geometry_msgs/Twist'),
        (COMMANDS, 'turtlesim/Velocity'),
    }
    shown = threading.Event()
    Transcript.on_show(lambda text: transcript.append(text) or shown.set())
    master.create(BlockNode, named='/driver').send_to(COMMANDS, linear=2.0, angular=1.0)
    assert shown.wait(TIMEOUT)
    assert transcript == ['linear: 2.0\nangular: 1.0']


def test_listing_3_4_a_logger_prints_what_it_hears(master, turtle):
    with Program(master.url, script('turtle_logger'), '__name:=listener') as logger, Program(
        master.url, script('turtle_driver'), '_linear:=1.25', '_period:=0.02'
    ):
        logger.wait_for('linear: 1.25')
        logger.wait_for('angular: 1.0')
        assert master.node('/listener').is_alive()
        assert logger.end() == 0


@pytest.fixture
def clear(master):
    """A service /clear in the turtle's place; a list of the names of those who called it."""
    callers = []
    turtle = master.create(BlockNode, named='/turtlesim')
    turtle.serve(
        '/clear',
        'std_srvs/Empty',
        lambda request: callers.append(request._connection_header['callerid']),
    )
    return callers


@pytest.mark.parametrize('arguments', [[], [f'_md5sum:={EMPTY_MD5SUM}']])
def test_listing_3_5_a_service_is_called_by_name_with_its_md5sum_found_or_set_by_hand(
    master, clear, arguments
):
    done = run(master.url, script('clear_turtle'), *arguments)
    assert (done.returncode, done.stderr) == (0, '')
    assert f'/clear (std_srvs/Empty, md5sum {EMPTY_MD5SUM}) answered' in done.stdout
    assert clear == ['/myID']


def test_listing_3_5_line_by_line(master, clear):
    service = master.lookup_service('/clear', caller_id='/myID')
    service.md5sum = 'd41d8cd98f00b204e9800998ecf8427e'
    response = service.call()
    assert service.response is response
    assert response._type == 'std_srvs/EmptyResponse'
    assert clear == ['/myID']


def test_listing_3_5_a_wrong_md5sum_is_an_error_that_says_all_about_the_service(master, clear):
    done = run(master.url, script('clear_turtle'), '_md5sum:=0123456789abcdef0123456789abcdef')
    assert done.returncode == 1
    for what in ('/clear', 'std_srvs/Empty', EMPTY_MD5SUM, 'request:', 'response:'):
        assert what in done.stderr
    assert not clear


def test_listing_3_5_an_md5sum_that_yaml_reads_as_a_number_is_told(master, clear):
    done = run(master.url, script('clear_turtle'), '_md5sum:=0')
    assert done.returncode == 1
    assert "the md5sum of /clear is a text such as 'd41d8" in done.stderr
    assert 'in quotes' in done.stderr
    assert not clear
    done = run(master.url, script('clear_turtle'), "_md5sum:='0'")
    assert done.returncode == 1
    assert "the md5sum '0' is not that of /clear" in done.stderr
    assert not clear


def test_listing_3_5_a_call_follows_remappings(master):
    turtle = master.create(BlockNode, named='/turtlesim')
    turtle.serve('/robot1/clear', 'std_srvs/Empty', lambda request: None)
    done = run(master.url, script('clear_turtle'), '/clear:=/robot1/clear')
    assert '/robot1/clear (std_srvs/Empty' in done.stdout


@pytest.mark.parametrize('arguments', [[], ['--once']])
def test_listing_3_6_a_block_node_sends_one_command_and_loses_it_not(master, turtle, arguments):
    done = run(master.url, script('block_publisher'), *arguments)
    assert (done.returncode, done.stderr) == (0, '')
    assert next_command(turtle) == (-2.0, 1.0)
    assert turtle.delegate.empty()


def test_listing_3_7_a_soul_is_executed_once_by_the_calling_thread(master, turtle):
    done = run(master.url, script('block_publisher'), '--execute', '_linear:=0.25')
    assert (done.returncode, done.stderr) == (0, '')
    assert next_command(turtle) == (0.25, 1.0)
    assert turtle.delegate.empty()


def test_listing_3_8_a_soul_in_the_background_sends_every_second(master, turtle):
    with Program(master.url, script('block_publisher'), '--background') as publisher:
        assert [next_command(turtle) for _ in range(3)] == [(-2.0, 1.0)] * 3
        assert publisher.end() == 0


def test_listing_3_9_a_delegate_given_at_creation_shows_each_message(master, turtle):
    with Program(master.url, script('block_subscriber'), '__name:=listener') as subscriber, Program(
        master.url, script('block_publisher'), '--background'
    ):
        subscriber.wait_for('linear: -2.0')
        subscriber.wait_for('angular: 1.0')
        assert subscriber.end() == 0


def test_listing_3_10_a_node_both_sends_and_receives(master, turtle):
    with Program(master.url, script('block_both'), '_angular:=0.5') as both:
        assert next_command(turtle) == (-2.0, 0.5)
        both.wait_for('linear: -2.0')
        both.wait_for('angular: 0.5')
        assert both.end() == 0
    assert turtle.delegate.empty()


# -- what holds for every program


@pytest.mark.parametrize('name', SCRIPTS)
def test_help_names_the_listing(name):
    done = run('http://127.0.0.1:1/', script(name), '--help', '__name:=unused')
    assert done.returncode == 0
    assert 'usage: ' + name in done.stdout
    assert ('turtlesim' if name == 'turtle_simulator' else 'of the PhaROS report') in done.stdout


@pytest.mark.parametrize('name', SCRIPTS)
def test_a_missing_master_is_one_line_on_stderr_and_status_1(name):
    done = run('http://127.0.0.1:1/', script(name))
    assert done.returncode == 1
    assert done.stderr.startswith(name + ': ')
    assert 'http://127.0.0.1:1' in done.stderr
    assert done.stderr.count('\n') == 1


@pytest.mark.parametrize('name', PUBLISHERS)
def test_a_publisher_follows_remappings(master, name):
    turtle = turtle_at(master, '/turtle2/velocity')
    with Program(master.url, script(name), f'{COMMANDS}:=/turtle2/velocity', '_linear:=0.75'):
        assert next_command(turtle) == (0.75, 1.0)


@pytest.mark.parametrize('name', ['turtle_logger', 'block_subscriber', 'block_both'])
def test_a_subscriber_follows_remappings(master, name):
    driver = master.create(BlockNode, named='/driver')
    channel = driver.output_channel('/turtle2/velocity', typed_as='turtlesim/Velocity')
    with Program(master.url, script(name), f'{COMMANDS}:=/turtle2/velocity') as program:
        assert channel.wait_for_subscribers(timeout=TIMEOUT)
        channel.send(linear=0.75)
        program.wait_for('linear: 0.75')


@pytest.mark.parametrize('with_signal', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    'name', ['turtle_driver', 'turtle_logger', 'block_subscriber', 'block_both']
)
def test_a_signal_ends_a_program_with_status_0_and_leaves_nothing_of_it(
    master, turtle, name, with_signal
):
    driver = master.create(BlockNode, named='/driver')
    with Program(master.url, script(name), '__name:=program') as program:
        if name in PUBLISHERS:
            turtle.delegate.next()
        else:
            assert driver.output_channel(COMMANDS, 'turtlesim/Velocity').wait_for_subscribers(
                2, TIMEOUT
            )
        # it may not have come to spin() yet, and is then ended as any program
        assert program.end(with_signal) in (0, 128 + signal.SIGTERM)
    assert '/program' not in str(master.system_state())
    assert 'Traceback' not in program.read_to_the_end()
