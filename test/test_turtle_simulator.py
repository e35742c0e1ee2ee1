"""The turtle simulator: the field without ROS, then the program as a process, driven by ROS's own
tools."""
import math
import re
import shutil
import signal
import subprocess
import time

import PIL.Image
import PIL.ImageGrab
import pytest
from hypothesis import given, strategies
from pharos.testing import Mailbox, TIMEOUT
from programs import Program, forget_parameters, run, script

from pharos import BlockNode, ServiceCallError
from pharos_turtle.field import BACKGROUND, FIELD_SIZE, PEN_COLOUR, SHELL_COLOURS, Field, Turtle

STEP = 0.016

velocities = strategies.floats(-1e6, 1e6)
lengths = strategies.floats(-1e6, 1e6)
actions = strategies.lists(
    strategies.one_of(
        strategies.tuples(strategies.just(Turtle.drive), velocities, velocities, velocities),
        strategies.tuples(strategies.just(Turtle.teleport_absolute), lengths, lengths, lengths),
        strategies.tuples(strategies.just(Turtle.teleport_relative), lengths, lengths),
        strategies.tuples(strategies.just(Turtle.update), strategies.just(STEP)),
    )
)


def updates(turtle, seconds):
    """What that many seconds of updates report about walls."""
    return [turtle.update(STEP) for _ in range(round(seconds / STEP))]


@pytest.fixture
def field():
    return Field()


@pytest.fixture
def turtle(field):
    return field.turtles['turtle1']


# -- the field


def test_a_field_is_as_large_as_turtlesims_and_has_one_turtle_in_its_middle_facing_right(field):
    assert FIELD_SIZE == pytest.approx(11.088889, abs=1e-6)
    assert list(field.turtles) == ['turtle1']
    turtle = field.turtles['turtle1']
    assert (turtle.x, turtle.y, turtle.theta) == (pytest.approx(5.544445, abs=1e-6),) * 2 + (0,)
    assert field.picture().size == (500, 500)


@given(actions)
def test_a_turtle_never_leaves_the_field_and_its_heading_stays_within_half_a_turn(actions):
    turtle = Field().turtles['turtle1']
    for action, *arguments in actions:
        action(turtle, *arguments)
        assert 0 <= turtle.x <= FIELD_SIZE
        assert 0 <= turtle.y <= FIELD_SIZE
        assert -math.pi <= turtle.theta <= math.pi


@given(strategies.floats(-3, 3), strategies.floats(-3, 3))
def test_a_turtle_away_from_walls_goes_as_far_as_it_was_told(forward, turning):
    turtle = Field().turtles['turtle1']
    turtle.drive(forward, turning)
    distance = 0
    for _ in range(60):
        x, y = turtle.x, turtle.y
        turtle.update(STEP)
        distance += math.hypot(turtle.x - x, turtle.y - y)
    assert distance == pytest.approx(abs(forward) * 60 * STEP)
    assert turtle.theta == pytest.approx(turning * 60 * STEP)


def test_a_command_holds_for_one_second(turtle):
    turtle.drive(1.0, 0.0)
    updates(turtle, 3)
    assert turtle.x - FIELD_SIZE / 2 == pytest.approx(1.0, abs=STEP)
    assert (turtle.linear_velocity, turtle.angular_velocity) == (0, 0)


def test_a_command_repeated_every_second_keeps_the_turtle_going_round(turtle):
    for _ in range(7):
        turtle.drive(2.0, 1.0)
        updates(turtle, 1)
        assert (turtle.linear_velocity, turtle.angular_velocity) == (2.0, 1.0)
        # a circle of radius 2 around a point to the left of the start
        assert math.dist(
            (turtle.x, turtle.y), (FIELD_SIZE / 2, FIELD_SIZE / 2 + 2)
        ) == pytest.approx(2, abs=0.05)


def test_a_turtle_also_goes_backwards_and_sideways(turtle):
    turtle.drive(-2.0, 0.0)
    turtle.update(STEP)
    assert turtle.linear_velocity == -2.0
    assert turtle.x < FIELD_SIZE / 2
    turtle.drive(3.0, 0.0, left=4.0)
    turtle.update(STEP)
    assert turtle.linear_velocity == 5.0
    assert turtle.y - FIELD_SIZE / 2 == pytest.approx(4.0 * STEP)


def test_a_wall_stops_a_turtle_and_is_reported_with_where_it_would_have_gone(turtle):
    turtle.drive(10.0, 0.0)
    reports = [report for report in updates(turtle, 1) if report]
    assert turtle.x == FIELD_SIZE
    assert reports[-1] == (pytest.approx(FIELD_SIZE + 10.0 * STEP), FIELD_SIZE / 2)


@pytest.mark.parametrize('number', [math.nan, math.inf])
def test_a_number_that_is_not_finite_is_refused_by_name_and_changes_nothing(field, turtle, number):
    with pytest.raises(ValueError, match='forward is .*finite'):
        turtle.drive(number, 0.0)
    with pytest.raises(ValueError, match='theta is .*finite'):
        turtle.teleport_absolute(1.0, 1.0, number)
    with pytest.raises(ValueError, match='y is .*finite'):
        field.spawn('odd', 1.0, number, 0.0)
    turtle.update(STEP)
    assert (turtle.x, turtle.y, turtle.theta) == (FIELD_SIZE / 2, FIELD_SIZE / 2, 0)
    assert list(field.turtles) == ['turtle1']


# -- pens and colours


def test_a_pen_draws_where_the_turtle_goes_and_clear_wipes_it(field, turtle):
    turtle.drive(1.0, 0.0)
    updates(turtle, 1)
    middle = (FIELD_SIZE / 2 + 0.5, FIELD_SIZE / 2)
    assert field.colour_at(*middle) == PEN_COLOUR
    field.clear((1, 2, 3))
    assert field.colour_at(*middle) == (1, 2, 3)


def test_a_teleport_draws_a_line_with_the_pens_colour_and_width(field, turtle):
    turtle.set_pen((255, 0, 0), 9, False)
    turtle.teleport_absolute(1.0, FIELD_SIZE / 2, 1.5)
    assert turtle.theta == 1.5
    assert field.colour_at(3.0, FIELD_SIZE / 2 + 4 / 45) == (255, 0, 0)
    assert field.colour_at(3.0, FIELD_SIZE / 2 + 6 / 45) == BACKGROUND


def test_a_relative_teleport_turns_first(turtle):
    turtle.teleport_relative(2.0, math.pi / 2)
    assert (turtle.x, turtle.y) == (
        pytest.approx(FIELD_SIZE / 2),
        pytest.approx(FIELD_SIZE / 2 + 2),
    )


def test_a_lifted_pen_draws_nothing(field, turtle):
    turtle.set_pen((255, 0, 0), 9, True)
    turtle.teleport_absolute(1.0, FIELD_SIZE / 2, 0.0)
    assert field.colour_at(3.0, FIELD_SIZE / 2) == BACKGROUND


def test_the_colour_under_a_turtle_is_that_of_the_lines_it_stands_on(turtle):
    assert turtle.colour == BACKGROUND
    turtle.teleport_relative(1.0, 0.0)
    turtle.update(STEP)
    assert turtle.colour == PEN_COLOUR


def test_the_picture_shows_each_turtle_but_the_turtle_leaves_no_mark(field, turtle):
    where = turtle.x, turtle.y
    centre = (250, 249)
    assert field.picture().getpixel(centre) not in (BACKGROUND, PEN_COLOUR)
    assert field.colour_at(*where) == BACKGROUND


# -- several turtles


def test_a_turtle_without_a_name_gets_the_next_free_one(field):
    field.spawn('turtle2', 1, 1, 0)
    assert field.spawn('', 2, 2, 0) == 'turtle3'
    field.kill('turtle3')
    assert field.spawn('', 2, 2, 0) == 'turtle4'


def test_a_taken_name_and_an_unknown_name_are_refused_in_turtlesims_words(field):
    with pytest.raises(ValueError, match=r'A turtle named \[turtle1\] already exists'):
        field.spawn('turtle1', 1, 1, 0)
    with pytest.raises(ValueError, match=r'Tried to kill turtle \[nobody\], which does not exist'):
        field.kill('nobody')


def test_a_reset_brings_back_the_first_turtle_and_an_empty_field(field, turtle):
    turtle.teleport_absolute(1.0, 1.0, 1.0)
    field.spawn('', 2, 2, 0)
    field.kill('turtle1')
    field.reset()
    assert list(field.turtles) == ['turtle1']
    assert (field.turtles['turtle1'].x, field.turtles['turtle1'].theta) == (FIELD_SIZE / 2, 0)
    assert field.colour_at(3.27, 3.27) == BACKGROUND
    assert field.spawn('', 2, 2, 0) == 'turtle2'


# -- the program


@pytest.fixture(autouse=True)
def no_parameters_left(master):
    yield
    forget_parameters(master.url)


@pytest.fixture
def simulator(master, tmp_path):
    """The running program, whose picture goes to `simulator.picture`."""
    picture = tmp_path / 'drive.png'
    with Program(
        master.url, script('turtle_simulator'), f'_picture:={picture}', cwd=tmp_path
    ) as program:
        program.picture = picture
        program.wait_for(
            'Spawning turtle [turtle1] at x=[5.544444], y=[5.544444], theta=[0.000000]'
        )
        program.wait_for('There is no window')
        yield program


@pytest.fixture
def client(master):
    """A node that talks to the simulator."""
    return master.create(BlockNode, named='/client')


def hear(client, topic, typed_as):
    """A Mailbox of the messages on a topic."""
    mailbox = Mailbox()
    client.interested_in(topic, typed_as=typed_as, delegate=mailbox)
    return mailbox


def call(master, service, **fields):
    return master.lookup_service(service, '/client').call(timeout=TIMEOUT, **fields)


def wait_until(poses, condition):
    """The first pose that meets the condition."""
    return poses.wait_for(condition)


def test_it_is_a_node_called_turtlesim_with_turtlesims_topics_services_and_parameters(
    master, simulator
):
    publications, subscriptions, services = master.system_state()
    for topics, names in (publications, ('pose', 'color_sensor')), (
        subscriptions,
        ('command_velocity', 'cmd_vel'),
    ):
        for name in names:
            assert topics[f'/turtle1/{name}'] == ['/turtlesim']
    for service, service_type in {
        '/clear': 'std_srvs/Empty',
        '/reset': 'std_srvs/Empty',
        '/spawn': 'turtlesim/Spawn',
        '/kill': 'turtlesim/Kill',
        '/turtle1/set_pen': 'turtlesim/SetPen',
        '/turtle1/teleport_absolute': 'turtlesim/TeleportAbsolute',
        '/turtle1/teleport_relative': 'turtlesim/TeleportRelative',
    }.items():
        assert services[service] == ['/turtlesim']
        assert master.lookup_service(service).type == service_type
    for name, value in ('r', '69'), ('g', '86'), ('b', '255'):
        assert (
            run(master.url, 'rosparam', 'get', f'/turtlesim/background_{name}').stdout.strip()
            == value
        )


def test_it_tells_the_pose_and_the_colour_62_and_a_half_times_a_second(simulator, client):
    poses = hear(client, '/turtle1/pose', 'turtlesim/Pose')
    colours = hear(client, '/turtle1/color_sensor', 'turtlesim/Color')
    pose, colour = poses.next(), colours.next()
    assert (pose.x, pose.y) == (pytest.approx(5.544445, abs=1e-6),) * 2
    assert (pose.theta, pose.linear_velocity, pose.angular_velocity) == (0, 0, 0)
    assert (colour.r, colour.g, colour.b) == BACKGROUND
    started = time.monotonic()
    poses.take(125)
    assert 1.6 < time.monotonic() - started < 20  # s; 2 where nothing else goes on


def test_a_velocity_drives_the_turtle_for_a_second(simulator, client):
    poses = hear(client, '/turtle1/pose', 'turtlesim/Pose')
    client.send_to('/turtle1/command_velocity', linear=1.5, angular=0.5)
    moving = wait_until(poses, lambda pose: pose.linear_velocity)
    assert (moving.linear_velocity, moving.angular_velocity) == (1.5, 0.5)
    halted = wait_until(poses, lambda pose: not pose.linear_velocity)
    assert halted.theta == pytest.approx(0.5, abs=0.02)


def test_rostopic_drives_the_turtle_with_a_twist(master, simulator, client):
    poses = hear(client, '/turtle1/pose', 'turtlesim/Pose')
    twist = '{linear: {x: 1.5}, angular: {z: 0.5}}'
    with Program(master.url, 'rostopic', 'pub', '/turtle1/cmd_vel', 'geometry_msgs/Twist', twist):
        moving = wait_until(poses, lambda pose: pose.linear_velocity)
        assert (moving.linear_velocity, moving.angular_velocity) == (1.5, 0.5)
        halted = wait_until(poses, lambda pose: not pose.linear_velocity)
        assert halted.theta == pytest.approx(0.5, abs=0.02)


def test_a_wall_stops_the_turtle_with_turtlesims_warning(simulator, client):
    poses = hear(client, '/turtle1/pose', 'turtlesim/Pose')
    client.send_to('/turtle1/command_velocity', linear=100.0)
    line = simulator.wait_for('Oh no! I hit the wall! (Clamping from [x=')
    assert 'WARN' in line
    assert 'y=5.544444])' in line
    assert wait_until(poses, lambda pose: pose.x > 11).x == pytest.approx(FIELD_SIZE)


def test_turtles_are_spawned_and_killed(master, simulator, client):
    assert call(master, '/spawn', x=1.0, y=2.0, theta=0.5).name == 'turtle2'
    assert call(master, '/spawn', x=1.0, y=2.0, theta=0.5, name='robots/leo').name == 'robots/leo'
    pose = hear(client, '/robots/leo/pose', 'turtlesim/Pose').next()
    assert (pose.x, pose.y, pose.theta) == (1.0, 2.0, 0.5)
    call(master, '/kill', name='turtle2')
    assert not [name for kind in master.system_state() for name in kind if 'turtle2' in name]
    simulator.wait_for(
        'Spawning turtle [robots/leo] at x=[1.000000], y=[2.000000], theta=[0.500000]'
    )


@pytest.mark.parametrize(
    'service, name, reason',
    [
        ('/spawn', 'turtle1', 'A turtle named [turtle1] already exists'),
        ('/spawn', 'no name!', 'A turtle cannot be named [no name!]'),
        ('/kill', 'nobody', 'Tried to kill turtle [nobody], which does not exist'),
    ],
)
def test_a_name_that_is_taken_bad_or_unknown_is_refused_and_everything_goes_on(
    master, simulator, client, service, name, reason
):
    with pytest.raises(ServiceCallError, match=re.escape(reason)):
        call(master, service, name=name)
    assert 'ERROR' in simulator.wait_for(reason)
    hear(client, '/turtle1/pose', 'turtlesim/Pose').take(2)


def test_a_turtle_is_teleported_and_draws_with_the_pen_it_was_given(master, simulator, client):
    poses = hear(client, '/turtle1/pose', 'turtlesim/Pose')
    colours = hear(client, '/turtle1/color_sensor', 'turtlesim/Color')
    call(master, '/turtle1/set_pen', r=255, g=128, b=0, width=9)
    call(master, '/turtle1/teleport_absolute', x=2.0, y=3.0, theta=0.0)
    call(master, '/turtle1/teleport_relative', linear=1.0, angular=math.pi / 2)
    pose = wait_until(poses, lambda pose: pose.x < 3 and pose.y > 3.9)
    assert (pose.x, pose.y, pose.theta) == (
        pytest.approx(2.0),
        pytest.approx(4.0),
        pytest.approx(math.pi / 2),
    )
    assert wait_until(colours, lambda colour: colour.r == 255).g == 128


def test_rosservice_clears_the_field_with_the_background_colour_that_rosparam_set(
    master, simulator, client
):
    colours = hear(client, '/turtle1/color_sensor', 'turtlesim/Color')
    call(master, '/turtle1/teleport_relative', linear=1.0, angular=0.0)
    wait_until(colours, lambda colour: colour.r == PEN_COLOUR[0])
    assert run(master.url, 'rosparam', 'set', '/turtlesim/background_r', '150').returncode == 0
    assert run(master.url, 'rosservice', 'call', '/clear').returncode == 0
    wait_until(colours, lambda colour: (colour.r, colour.g, colour.b) == (150, 86, 255))
    # as turtlesim had it until ROS noetic
    assert run(master.url, 'rosparam', 'set', '/background_g', '1').returncode == 0
    assert run(master.url, 'rosservice', 'call', '/clear').returncode == 0
    wait_until(colours, lambda colour: (colour.r, colour.g, colour.b) == (150, 1, 255))


def test_a_background_that_is_no_colour_is_refused_by_name(master, simulator):
    run(master.url, 'rosparam', 'set', '/turtlesim/background_b', 'blue')
    with pytest.raises(
        ServiceCallError, match="background_b is 'blue': a colour is made of numbers from 0 to 255"
    ):
        call(master, '/clear')


def test_rosservice_resets_the_field(master, simulator, client):
    poses = hear(client, '/turtle1/pose', 'turtlesim/Pose')
    call(master, '/spawn', x=1.0, y=2.0, name='leo')
    call(master, '/turtle1/teleport_absolute', x=2.0, y=3.0, theta=1.0)
    wait_until(poses, lambda pose: pose.x == 2)
    assert run(master.url, 'rosservice', 'call', '/reset').returncode == 0
    assert wait_until(poses, lambda pose: pose.x > 5).theta == 0
    assert '/leo/set_pen' not in master.services()


def test_it_draws_the_picture_on_demand_and_at_the_end(master, simulator, client):
    poses = hear(client, '/turtle1/pose', 'turtlesim/Pose')
    answer = call(master, '/turtlesim/save_picture')
    assert (answer.success, answer.message) == (True, str(simulator.picture))
    empty = PIL.Image.open(simulator.picture).convert('RGB')
    assert empty.size == (500, 500)
    assert PEN_COLOUR not in pixels(empty)
    client.send_to('/turtle1/command_velocity', linear=2.0, angular=1.0)
    wait_until(poses, lambda pose: pose.theta > 0.9)
    assert simulator.end() == 0
    assert f'The picture of the field is {simulator.picture}' in simulator.read_to_the_end()
    # 2 m, several pixels wide
    assert pixels(PIL.Image.open(simulator.picture).convert('RGB'))[PEN_COLOUR] > 2 * 45


def pixels(image):
    """How many pixels there are of each colour."""
    return {colour: count for count, colour in image.getcolors()}


def test_a_picture_that_cannot_be_written_is_said_so(master, tmp_path):
    with Program(
        master.url, script('turtle_simulator'), '_picture:=/nowhere/drive.png', cwd=tmp_path
    ) as program:
        program.wait_for('There is no window')
        answer = call(master, '/turtlesim/save_picture')
        assert not answer.success
        assert '/nowhere/drive.png' in answer.message
        assert program.end() == 1
        assert 'turtle_simulator: ' in program.read_to_the_end()


@pytest.mark.parametrize('no_picture', ["_picture:=''", '_picture:='])
def test_it_follows_its_name_its_namespace_and_remappings(master, client, tmp_path, no_picture):
    with Program(
        master.url,
        script('turtle_simulator'),
        '__name:=sim',
        '__ns:=/robot1',
        'turtle1/pose:=where',
        no_picture,
        cwd=tmp_path,
    ) as program:
        program.wait_for('Starting turtlesim with node name /robot1/sim')
        hear(client, '/robot1/where', 'turtlesim/Pose').next()
        assert '/robot1/turtle1/set_pen' in master.services()
        assert program.end() == 0
    assert not list(tmp_path.iterdir())


def test_the_reports_nodes_drive_and_log_it(master, simulator):
    with Program(master.url, script('turtle_logger')) as logger, Program(
        master.url, script('turtle_driver')
    ):
        logger.wait_for('x: 2.0')
        logger.wait_for('z: 1.0')
    assert run(master.url, script('clear_turtle')).returncode == 0
    simulator.wait_for('Clearing turtlesim.')


@pytest.fixture
def display():
    """The name of a display of its own, without a screen."""
    if not shutil.which('Xvfb'):
        pytest.skip('no Xvfb: apt install xvfb')
    with subprocess.Popen(
        ['Xvfb', '-displayfd', '1', '-screen', '0', '600x600x24'],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as server:
        yield f':{server.stdout.readline().strip()}'
        server.terminate()


def test_a_window_shows_the_field_where_there_is_a_display(master, display, tmp_path):
    with Program(master.url, script('turtle_simulator'), cwd=tmp_path, DISPLAY=display) as program:
        program.wait_for('The field is shown in a window')
        screen = pixels(PIL.ImageGrab.grab(xdisplay=display))
        assert screen[BACKGROUND] > 400 * 400
        assert screen[SHELL_COLOURS[0]] > 100
        assert run(master.url, 'rosnode', 'kill', '/turtlesim').returncode == 0
        assert program.process.wait(TIMEOUT) == 0
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize('with_signal', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_program_with_a_window_with_status_0(
    master, display, tmp_path, with_signal
):
    with Program(
        master.url, script('turtle_simulator'), f'_picture:={tmp_path}/drive.png', DISPLAY=display
    ) as program:
        program.wait_for('The field is shown in a window')
        assert program.end(with_signal) == 0
        assert 'Traceback' not in program.read_to_the_end()
    assert '/turtlesim' not in str(master.system_state())
    assert (tmp_path / 'drive.png').exists()


def test_without_a_display_a_window_that_was_asked_for_is_an_error(master, tmp_path):
    done = run(master.url, script('turtle_simulator'), '_window:=true', cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith('turtle_simulator: ')
    assert 'display' in done.stderr
