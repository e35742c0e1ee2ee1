"""Pictures of messages, and numbers of a topic over time."""
import gc
import io
import struct
import subprocess
import sys
import threading

import genpy
import numpy
import pytest
from PIL import Image as Pillow

from helpers import create, ended
from pharos import MessageTypeError, NodeStoppedError, PharosError, message_class, spin
from pharos.live import pictures, plot as plot_module, top
from pharos.live.pictures import picture
from pharos.messages import class_from_definition
from pharos.messages.numeric_field import numeric_field, numeric_paths
from pharos.testing import TIMEOUT, Mailbox, until
from programs import environment

Image = message_class('sensor_msgs/Image')
CompressedImage = message_class('sensor_msgs/CompressedImage')
LaserScan = message_class('sensor_msgs/LaserScan')
PointCloud2 = message_class('sensor_msgs/PointCloud2')
PointField = message_class('sensor_msgs/PointField')
Path = message_class('nav_msgs/Path')
PoseStamped = message_class('geometry_msgs/PoseStamped')
OccupancyGrid = message_class('nav_msgs/OccupancyGrid')
Twist = message_class('geometry_msgs/Twist')

RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)


def image_of(encoding, width, height, data, step=0, is_bigendian=0):
    return Image(
        encoding=encoding,
        width=width,
        height=height,
        data=bytes(data),
        step=step or len(data) // height,
        is_bigendian=is_bigendian,
    )


def pixels(drawn):
    return list(drawn.convert('RGB').getdata())


# -- images


@pytest.mark.parametrize(
    'encoding, data',
    [
        ('rgb8', [255, 0, 0, 0, 0, 255]),
        ('bgr8', [0, 0, 255, 255, 0, 0]),
        ('8UC3', [0, 0, 255, 255, 0, 0]),
        ('rgba8', [255, 0, 0, 255, 0, 0, 255, 255]),
        ('bgra8', [0, 0, 255, 255, 255, 0, 0, 255]),
        ('rgb16', [0, 255, 0, 0, 0, 0, 0, 0, 0, 0, 0, 255]),
        ('bgr16', [0, 0, 0, 0, 0, 255, 0, 255, 0, 0, 0, 0]),
    ],
)
def test_the_colours_of_an_image_are_those_of_its_encoding(encoding, data):
    assert pixels(picture(image_of(encoding, 2, 1, data))) == [RED, BLUE]


def test_numbers_of_sixteen_bits_may_have_the_greater_byte_first():
    drawn = picture(image_of('rgb16', 1, 1, [255, 0, 0, 9, 0, 9], is_bigendian=1))
    assert pixels(drawn) == [RED]


@pytest.mark.parametrize('encoding', ['mono8', '8UC1'])
def test_a_grey_image_is_grey(encoding):
    drawn = picture(image_of(encoding, 2, 2, [0, 50, 100, 255]))
    assert (drawn.mode, list(drawn.getdata())) == ('L', [0, 50, 100, 255])
    deep = picture(image_of('mono16', 2, 1, struct.pack('<HH', 0x1234, 0xFFFF)))
    assert list(deep.getdata()) == [0x12, 0xFF]


@pytest.mark.parametrize(
    'encoding, packed',
    [
        ('16UC1', struct.pack('<4H', 0, 1000, 2000, 3000)),
        ('32FC1', struct.pack('<4f', float('nan'), 1, 2, 3)),
        ('64FC1', struct.pack('<4d', float('inf'), 1, 2, 3)),
        ('16SC1', struct.pack('<4h', 0, -100, 0x7FFF // 2 - 50, 0x7FFF)),
    ],
)
def test_depths_are_drawn_from_the_least_to_the_greatest_and_black_where_unknown(encoding, packed):
    unknown, near, middle, far = picture(image_of(encoding, 4, 1, packed)).getdata()
    assert unknown == 0
    assert 0 < near < middle < far == 255
    assert abs(middle - (near + far) / 2) < 3


def test_depths_that_are_all_alike_or_all_unknown_are_drawn():
    assert len(set(picture(image_of('16UC1', 2, 1, struct.pack('<2H', 7, 7))).getdata())) == 1
    assert set(picture(image_of('32FC1', 2, 1, struct.pack('<2f', 0, 0))).getdata()) == {0}


@pytest.mark.parametrize(
    'encoding, data',
    [
        ('bayer_rggb8', [255, 0, 0, 0]),
        ('bayer_bggr8', [0, 0, 0, 255]),
        ('bayer_gbrg8', [0, 0, 255, 0]),
        ('bayer_grbg8', [0, 255, 0, 0]),
        ('bayer_rggb16', [0, 255, 0, 0, 0, 0, 0, 0]),
    ],
)
def test_four_pixels_of_a_bayer_sensor_make_one(encoding, data):
    drawn = picture(image_of(encoding, 2, 2, data))
    assert (drawn.size, pixels(drawn)) == ((1, 1), [RED])


@pytest.mark.parametrize(
    'encoding, data', [('yuv422', [90, 76, 255, 76]), ('yuv422_yuy2', [76, 90, 76, 255])]
)
def test_brightness_and_colour_may_come_apart(encoding, data):
    drawn = picture(image_of(encoding, 2, 1, data))
    assert drawn.size == (2, 1)
    for red, green, blue in pixels(drawn):
        assert red > 240 and green < 20 and blue < 20


def test_rows_may_be_longer_than_their_pixels():
    drawn = picture(image_of('mono8', 2, 2, [1, 2, 99, 99, 3, 4], step=4))
    assert list(drawn.getdata()) == [1, 2, 3, 4]


def test_a_message_that_has_not_been_sent_may_hold_a_list_or_a_bytearray():
    for data in [1, 2], bytearray([1, 2]):
        message = image_of('mono8', 2, 1, b'12')
        message.data = data
        assert list(picture(message).getdata()) == [1, 2]


@pytest.mark.parametrize(
    'message, text',
    [
        (
            image_of('rgb8', 2, 1, b'12345'),
            '2 x 1 pixels, rgb8, has 6 bytes a row .* 5 in rows of 5',
        ),
        (image_of('rgb8', 2, 2, b'12345678', step=6), '8 in rows of 6'),
        (Image(encoding='rgb8'), '0 x 0 pixels'),
        (image_of('rbg8', 1, 1, b'123'), r"the encoding 'rbg8' \(did you mean 'rgb8'"),
        (image_of('bayer_rggb8', 1, 1, b'1'), 'two rows and columns'),
        (image_of('bayer_rggb32', 1, 1, b'1'), "the encoding 'bayer_rggb32'"),
    ],
)
def test_an_image_that_makes_no_picture_is_an_error_that_says_why(message, text):
    with pytest.raises(MessageTypeError, match=text):
        picture(message)


def encoded(format_, pixels_):
    file = io.BytesIO()
    Pillow.fromarray(pixels_).save(file, format_)
    return file.getvalue()


def test_compressed_images_are_read_as_they_are():
    red = numpy.zeros((8, 8, 3), 'u1') + numpy.array(RED, 'u1')
    drawn = picture(CompressedImage(format='bgr8; jpeg compressed bgr8', data=encoded('JPEG', red)))
    assert drawn.size == (8, 8) and pixels(drawn)[0][0] > 240
    assert pixels(picture(CompressedImage(format='png', data=encoded('PNG', red))))[0] == RED


def test_compressed_depths_are_depths():
    coded = numpy.array([[0, 1000, 2000]], 'u2')
    data = bytes(12) + encoded('PNG', coded)
    unknown, near, far = picture(
        CompressedImage(format='16UC1; compressedDepth png', data=data)
    ).getdata()
    assert 0 == unknown < near < far
    data = struct.pack('<iff', 0, 1000.0, 10.0) + encoded('PNG', coded)
    unknown, far, near = picture(
        CompressedImage(format='32FC1; compressedDepth png', data=data)
    ).getdata()
    assert 0 == unknown < near < far


@pytest.mark.parametrize('format_', ['jpeg', '32FC1; compressedDepth png', 'theora'])
def test_a_compressed_image_that_nobody_can_read_is_an_error(format_):
    for data in b'', b'nonsense', encoded('PNG', numpy.zeros((9, 9), 'u1'))[:40]:
        with pytest.raises(MessageTypeError, match=f'{format_!r}, of .* cannot be read'):
            picture(CompressedImage(format=format_, data=data))


@pytest.mark.parametrize('format_', ['EPS', 'ICNS', 'PCX'])
def test_a_compressed_image_reaches_no_reader_but_those_of_its_formats(monkeypatch, format_):
    data = encoded(format_, numpy.zeros((64, 64, 3), 'u1'))
    monkeypatch.setattr(subprocess, 'Popen', None)  # which would start Ghostscript
    with pytest.raises(MessageTypeError, match='cannot be read'):
        picture(CompressedImage(format='jpeg', data=data))


def test_a_compressed_image_of_too_many_pixels_is_an_error(monkeypatch):
    data = encoded('PNG', numpy.zeros((9, 9), 'u1'))
    for limit in 30, 60:  # Pillow raises at twice its limit, and warns before
        monkeypatch.setattr(Pillow, 'MAX_IMAGE_PIXELS', limit)
        with pytest.raises(MessageTypeError, match='cannot be read: .*decompression bomb'):
            picture(CompressedImage(format='png', data=data))


# -- from above


def where(drawn, color):
    """The middle of the pixels of a colour, from the left and from the bottom; None: there are
    none."""
    canvas = numpy.array(drawn.convert('RGB'))
    rows, columns = numpy.nonzero((canvas == numpy.array(color)).all(axis=2))
    return (columns.mean(), drawn.height - rows.mean()) if len(rows) else None


ORANGE, SEA, GRASS = (0xD5, 0x5E, 0x00), (0x00, 0x72, 0xB2), (0x00, 0x9E, 0x73)


def test_a_scan_is_seen_from_above_forwards_to_the_right_and_left_up():
    scan = LaserScan(angle_min=0, angle_increment=1.5708, range_min=0.1, range_max=10)
    scan.ranges = [4.0, 2.0, float('nan'), 99.0]
    drawn = picture(scan)
    (x, y), (at_x, at_y) = where(drawn, ORANGE), where(drawn, SEA)
    assert x > at_x and y > at_y
    scan.ranges = [float('inf'), 99.0, 0.0]
    assert where(picture(scan), ORANGE) is None and where(picture(scan), SEA)
    assert picture(LaserScan()).size


def test_a_path_goes_from_its_green_beginning_to_its_orange_end():
    path = Path()
    for x, y in (0, 0), (1, 0), (3, 2):
        pose = PoseStamped()
        pose.pose.position.x, pose.pose.position.y, pose.pose.orientation.w = x, y, 1
        path.poses.append(pose)
    drawn = picture(path)
    (x, y), (end_x, end_y) = where(drawn, GRASS), where(drawn, ORANGE)
    assert end_x > x + 100 and end_y > y + 100
    assert where(drawn, SEA)
    assert picture(Path()).size


def test_a_map_has_its_first_cell_at_the_lower_left():
    grid = OccupancyGrid(data=[0, 100, -1, 50])
    grid.info.width, grid.info.height = 2, 2
    drawn = picture(grid)
    left, right = drawn.width // 4, 3 * drawn.width // 4
    top, bottom = drawn.height // 4, 3 * drawn.height // 4
    assert drawn.getpixel((left, bottom)) == (255, 255, 255)
    assert drawn.getpixel((right, bottom)) == (0, 0, 0)
    unknown, half = drawn.getpixel((left, top)), drawn.getpixel((right, top))
    assert len(set(unknown)) == 3 and len(set(half)) == 1 and 100 < half[0] < 155
    with pytest.raises(MessageTypeError, match='3 x 2 cells has as many values.* has 4'):
        grid.info.width = 3
        picture(grid)


def cloud_of(points, kind='<f4', datatype=7, is_bigendian=False, padding=4):
    array = numpy.zeros((len(points), 3 + padding), kind)
    array[:, :3] = points
    size = numpy.dtype(kind).itemsize
    return PointCloud2(
        width=len(points),
        height=1,
        point_step=array.shape[1] * size,
        row_step=array.nbytes,
        is_bigendian=is_bigendian,
        fields=[PointField(name, at * size, datatype, 1) for at, name in enumerate('xyz')],
        data=array.tobytes(),
    )


@pytest.mark.parametrize(
    'options', [{}, {'kind': '>f4', 'is_bigendian': True}, {'kind': '<f8', 'datatype': 8}]
)
def test_a_cloud_is_seen_from_above_and_brighter_where_it_is_higher(options):
    drawn = picture(cloud_of([(0, 0, 0), (2, 1, 3), (float('nan'), 5, 0)], **options))
    low, high = where(drawn, (68, 1, 84)), where(drawn, (230, 210, 30))
    assert high[0] > low[0] + 100 and high[1] > low[1] + 50


def test_a_cloud_may_be_empty_organized_or_made_wrongly():
    assert picture(cloud_of(numpy.zeros((0, 3)))).size
    organized = cloud_of([(0, 0, 0), (2, 1, 3)])
    organized.width, organized.height, organized.row_step = 1, 2, organized.point_step
    assert where(picture(organized), (230, 210, 30))
    short = cloud_of([(0, 0, 0), (2, 1, 3)])
    short.data = short.data[:-1]
    with pytest.raises(MessageTypeError, match='2 x 1 points of 28 bytes has 56 bytes a row'):
        picture(short)
    flat = cloud_of([(0, 0, 0)])
    del flat.fields[2]
    with pytest.raises(MessageTypeError, match='fields x, y and z; this one has x, y'):
        picture(flat)


def one_field(**changes):
    """A cloud of two points, but for these fields."""
    cloud = cloud_of([(1, 2, 3), (4, 5, 6)])
    for name, value in changes.items():
        setattr(cloud, name, value)
    return cloud


def far_away():
    poses = [PoseStamped(), PoseStamped()]
    poses[0].pose.position.x, poses[1].pose.position.x = -1e308, 1e308
    return Path(poses=poses)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize(
    'message',
    [
        one_field(point_step=0),
        one_field(point_step=2**31, width=0),
        one_field(fields=[PointField(name, 2**32 - 1, 7, 1) for name in 'xyz']),
        one_field(fields=[PointField(name, 40, 7, 1) for name in 'xyz']),
        cloud_of([(-1.7e308, 0, 0), (1.7e308, 0, 0)], '<f8', 8),
        far_away(),
        Image(encoding='mono8', width=2, height=1, data=[300, 2]),
        Image(encoding='mono8', width=2, height=1, data='ab'),
        Image(encoding='mono8', width=2.0, height=1, data=b'ab'),
        LaserScan(ranges=['a']),
    ],
)
def test_values_that_make_no_picture_are_an_error_of_ours(message):
    with pytest.raises(MessageTypeError):
        picture(message)


@pytest.mark.filterwarnings('error')
def test_values_at_the_limits_of_their_type_are_drawn():
    heights = cloud_of([(0, 0, -1.7e308), (0, 0, 1.7e308)], '<f8', 8)
    depths = image_of('64FC1', 2, 1, struct.pack('<2d', 1e308, -1e308))
    for message in heights, depths:
        assert picture(message).size


def test_a_frame_may_have_any_name():
    scan = LaserScan(ranges=[1, 2], range_max=5)
    scan.header.frame_id = '猫'
    assert picture(scan).size


def test_other_messages_have_no_picture():
    with pytest.raises(
        MessageTypeError, match='of geometry_msgs/Twist: there are those of sensor_msgs'
    ):
        picture(Twist())
    with pytest.raises(MessageTypeError, match='no picture is made of 3'):
        picture(3)


def test_another_definition_of_a_type_is_an_error_of_ours():
    other = class_from_definition('sensor_msgs/Image', 'string text')
    with pytest.raises(MessageTypeError, match="of this sensor_msgs/Image: .*'encoding'"):
        picture(other())


def test_without_pillow_or_numpy_it_says_what_to_install(monkeypatch):
    for name in 'PIL', 'pharos.live.images':
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(PharosError, match='apt-get install python3-pil python3-numpy'):
        picture(image_of('mono8', 1, 1, b'1'))


# -- in Jupyter


@pytest.fixture
def ipython():
    shells = pytest.importorskip('IPython.core.interactiveshell')
    shell = shells.InteractiveShell()
    pictures.register(shell)
    yield shell
    shells.InteractiveShell.clear_instance()


def test_jupyter_shows_a_picture_of_a_message_and_its_text_without_endless_arrays(ipython):
    message = image_of('rgb8', 2000, 1000, bytes(6000000))
    shown, _ = ipython.display_formatter.format(message)
    drawn = Pillow.open(io.BytesIO(shown['image/png']))
    assert drawn.width <= 800 and drawn.height <= 600
    assert 'encoding: "rgb8"' in shown['text/plain'] and len(shown['text/plain']) < 1000


@pytest.mark.parametrize('mode', ['F', 'I', 'I;16', 'CMYK', 'LAB', 'PA'])
def test_jupyter_shows_compressed_images_of_any_mode(ipython, mode):
    file = io.BytesIO()
    Pillow.new(mode, (1000, 900)).save(file, 'TIFF')
    message = CompressedImage(format='tiff', data=file.getvalue())
    shown, _ = ipython.display_formatter.format(message)
    assert Pillow.open(io.BytesIO(shown['image/png'])).width <= 800


def test_jupyter_shows_the_text_alone_of_what_has_no_picture(ipython):
    for message in Twist(), image_of('rgb8', 9, 9, b'123'):
        shown, _ = ipython.display_formatter.format(message)
        assert list(shown) == ['text/plain']
    assert not hasattr(Image, '_repr_png_') and not hasattr(genpy.Message, '_repr_png_')


# -- numbers over time


@pytest.fixture
def turns(master):
    """A channel of /plotted_turns, and what sends on it."""
    one, two = create(master, '/plotted_one'), create(master, '/plotted_two')
    mailbox = Mailbox()
    heard = two.interested_in('/plotted_turns', 'geometry_msgs/Twist', mailbox)
    sent = one.output_channel('/plotted_turns', heard.type)
    sent.wait_for_subscribers(1, TIMEOUT)

    def send(x):
        sent.send(lambda message: setattr(message.linear, 'x', x))

    heard.mailbox, heard.send_x = mailbox, send
    return heard


def test_a_plot_collects_from_when_it_is_made_until_it_is_closed(turns):
    turns.send_x(1.0)
    with turns.plot('linear.x', 'angular.z') as plot:
        until(lambda: len(turns.node.master.topic('/plotted_turns').subscribers) == 2)
        for x in 2.0, 3.0:
            turns.send_x(x)
        until(lambda: len(plot.times) == 2)
        assert 'collecting' in repr(plot) and 'linear.x, angular.z' in repr(plot)
    turns.send_x(4.0)
    turns.mailbox.wait_for(lambda message: message.linear.x == 4.0)
    assert plot.values == {'linear.x': [2.0, 3.0], 'angular.z': [0.0, 0.0]}
    assert 0 <= plot.times[0] <= plot.times[1]
    assert 'closed' in repr(plot)
    plot.close()
    assert (turns.received, turns.dropped) == (4, 0)


def test_a_plot_may_be_made_for_some_seconds(turns):
    turns.node.master.local_nodes()[0].fork(lambda me: [turns.send_x(1.0) for _ in me.every(0.01)])
    plot = turns.plot('linear.x', seconds=0.5)
    assert set(plot.values['linear.x']) == {1.0}
    assert plot.times[-1] < TIMEOUT
    assert 'closed' in repr(plot)


def test_a_plot_is_a_file_or_a_picture_in_jupyter_without_a_display(turns, tmp_path, monkeypatch):
    monkeypatch.delenv('DISPLAY', raising=False)
    with turns.plot('linear.x') as plot:
        assert plot._repr_png_().startswith(b'\x89PNG')  # nothing has come yet
        turns.send_x(2.0)
        until(lambda: plot.times)
    plot.save(tmp_path / 'plot.svg')
    plot.save(tmp_path / 'plot.png')
    assert b'<svg' in (tmp_path / 'plot.svg').read_bytes()
    assert Pillow.open(tmp_path / 'plot.png').size == (800, 400)
    with pytest.raises(ValueError, match='nonsense'):
        plot.save(tmp_path / 'plot.nonsense')
    with pytest.raises(PharosError, match='missing/plot.png cannot be written: No such file'):
        plot.save(tmp_path / 'missing' / 'plot.png')


@pytest.mark.parametrize('path', ['', '.', '/', 'noext', 'a.xyz', 'a.svg.', 'a\0b.png'])
def test_a_plot_is_saved_only_where_the_suffix_says_how(turns, path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with turns.plot('linear.x') as plot:
        with pytest.raises((ValueError, PharosError), match='let its name end in|a path such as'):
            plot.save(path)
        with pytest.raises(TypeError):
            plot.save(None)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize('value', [1e308, -1e308])
def test_numbers_that_matplotlib_cannot_draw_are_left_out(turns, value):
    with turns.plot('linear.x') as plot:
        turns.send_x(value)
        turns.send_x(-value)
        until(lambda: len(plot.times) >= 2)
        assert plot._repr_png_().startswith(b'\x89PNG')
        assert plot.values['linear.x'][-1] == -value


def test_a_plot_that_nobody_has_any_more_leaves_no_node(turns):
    plot = turns.plot('linear.x')
    assert lookers(turns)
    del plot
    gc.collect()
    until(lambda: not lookers(turns))


def test_a_plot_ends_with_the_node_of_its_channel_but_not_by_a_restart(turns):
    plot = turns.plot('linear.x')
    turns.node.restart()
    assert 'collecting' in repr(plot)
    turns.node.stop()
    assert 'closed' in repr(plot)
    assert not lookers(turns)
    turns.node.start()
    with pytest.raises(NodeStoppedError, match='the plot of /plotted_turns is closed'):
        plot.wait(TIMEOUT)
    assert 'closed' in repr(plot)


def test_a_soul_that_plots_ends_though_its_node_stopped_before_it_waits(turns, monkeypatch):
    soul = create(turns.node.master, '/plots')
    began, ends = threading.Event(), []

    def wait_until_it_stops(looker, topic, timeout):
        began.set()
        assert soul.latest_run.rospy.ended.wait(TIMEOUT)

    monkeypatch.setattr(plot_module, 'wait_for_publishers', wait_until_it_stops)

    def draw(me):
        try:
            turns.plot('linear.x', seconds=1000)
        except NodeStoppedError as error:
            ends.append(error)

    thread = soul.fork(draw)
    assert began.wait(TIMEOUT)
    soul.stop()
    assert ended(thread) and ends


def test_spin_waits_for_no_plot(turns):
    others = [node for node in turns.node.master.local_nodes() if node is not turns.node]
    for node in others:
        node.stop()
    plot = turns.plot('linear.x')
    looker = turns.node.master.node(lookers(turns)[0])
    turns.node.latest_run.forget(plot._collected)  # as if it were a node's that has stopped before
    turns.node.stop()
    spin()
    assert looker.is_running
    plot.close()


def test_what_only_looks_is_left_out_of_graphs_and_of_top(turns):
    master = turns.node.master
    with turns.plot('linear.x'):
        (looker,) = lookers(turns)
        assert looker not in master.graph().nodes
        assert looker in master.graph(show_all=True).nodes
        for names in (), [looker]:
            rows = [row.name for row in top.measure(master, 0.1, names).nodes]
            assert (looker in rows) == bool(names)


def lookers(channel):
    names = [node.name for node in channel.node.master.local_nodes()]
    return [name for name in names if 'pharos_looks' in name]


def test_a_plot_hears_what_its_channel_hears(master):
    nodes = [create(master, f'/plotted_{name}') for name in ('one', 'two', 'three')]
    heard = nodes[2].interested_in('/plotted_some', 'std_msgs/Float64', from_='/plotted_one')
    with heard.plot('data') as plot:
        for number, node in enumerate(nodes[:2]):
            sent = node.output_channel('/plotted_some', heard.type)
            sent.wait_for_subscribers(2, TIMEOUT)
            sent.send(data=number + 1.0)
        nodes[0].send_to('/plotted_some', data=3.0)
        until(lambda: len(plot.times) == 2)
    assert plot.values == {'data': [1.0, 3.0]}


@pytest.mark.parametrize(
    'cls, path, value',
    [
        ('geometry_msgs/Twist', 'linear.x', 1.5),
        ('std_msgs/Header', 'seq', 7.0),
        ('std_msgs/Header', 'stamp', 2.5),
        ('std_msgs/Header', 'stamp.secs', 2.0),
        ('std_msgs/Bool', 'data', 1.0),
        ('sensor_msgs/LaserScan', 'ranges[1]', 9.0),
        ('sensor_msgs/LaserScan', 'ranges[-1]', 9.0),
        ('sensor_msgs/LaserScan', 'ranges[2]', None),
        ('nav_msgs/Path', 'poses[0].pose.position.y', 4.0),
        ('nav_msgs/Path', 'poses[1].pose.position.y', None),
        ('sensor_msgs/Image', 'data[0]', 65.0),
        ('nav_msgs/Odometry', 'pose.covariance[35]', 0.0),
    ],
)
def test_a_number_is_found_by_its_path(cls, path, value):
    message = message_class(cls)()
    values = {
        'geometry_msgs/Twist': lambda: setattr(message.linear, 'x', 1.5),
        'std_msgs/Header': lambda: message.__init__(7, genpy.Time(2, 500000000), ''),
        'std_msgs/Bool': lambda: setattr(message, 'data', True),
        'sensor_msgs/LaserScan': lambda: setattr(message, 'ranges', (8.0, 9.0)),
        'nav_msgs/Path': lambda: message.poses.append(PoseStamped()),
        'sensor_msgs/Image': lambda: setattr(message, 'data', b'A'),
    }
    values.get(cls, lambda: None)()
    if cls == 'nav_msgs/Path':
        message.poses[0].pose.position.y = 4.0
    assert numeric_field(type(message), path)(message) == value


@pytest.mark.parametrize(
    'cls, path, text',
    [
        ('geometry_msgs/Twist', 'linear.w', r"no such field \(did you mean 'linear..' or .*numbers are linear.x"),
        ('geometry_msgs/Twist', 'linear', 'it is a geometry_msgs/Vector3, and no number'),
        ('geometry_msgs/Twist', 'linear.x.y', 'there is no such field'),
        ('geometry_msgs/Twist', '', 'there is no such field'),
        ('geometry_msgs/Twist', 'linear.x[0]', 'x is no array'),
        ('std_msgs/Header', 'frame_id', 'it is a string, and no number.* seq, stamp'),
        ('sensor_msgs/LaserScan', 'ranges', r'ranges is an array: name one of it, as ranges\[0\]'),
        ('std_msgs/Empty', 'data', 'its numbers are none'),
        ('nav_msgs/Odometry', 'speed', 'and . more'),
    ],
)  # fmt: skip
def test_a_field_that_is_no_number_is_refused_with_those_that_are(cls, path, text):
    with pytest.raises(MessageTypeError, match=text):
        numeric_field(message_class(cls), path)


def test_a_plot_names_fields_as_text(turns):
    with pytest.raises(TypeError, match='name a field to plot'):
        turns.plot()
    with pytest.raises(TypeError, match="such as 'linear.x', not as 3"):
        turns.plot(3)
    with pytest.raises(ValueError, match='seconds'):
        turns.plot('linear.x', seconds=0)
    with pytest.raises(MessageTypeError, match='no such field'):
        turns.plot('linear.x', 'speed')
    assert len(turns.node.master.local_nodes()) == 2  # none was made to look


def test_a_plot_of_what_nobody_sends_says_so(turns):
    with pytest.raises(
        TimeoutError, match='/plotted_turns within 0.1 s: it is published by /plotted_one'
    ):
        turns.plot('linear.x', seconds=0.1)
    silent = turns.node.interested_in('/plotted_silence', 'std_msgs/Float64')
    with pytest.raises(
        TimeoutError, match='/plotted_silence within 0.1 s: it is published by nobody'
    ):
        silent.plot('data', seconds=0.1)


def test_every_number_that_is_named_can_be_plotted():
    for name in 'nav_msgs/Odometry', 'sensor_msgs/PointCloud2', 'tf2_msgs/TFMessage':
        cls = message_class(name)
        for path in numeric_paths(cls):
            numeric_field(cls, path)


def test_without_matplotlib_it_says_what_to_install_and_leaves_no_node(turns, monkeypatch):
    monkeypatch.setitem(sys.modules, 'matplotlib', None)
    monkeypatch.setitem(sys.modules, 'matplotlib.figure', None)
    with pytest.raises(PharosError, match='apt-get install python3-matplotlib'):
        turns.plot('linear.x')
    assert len(turns.node.master.local_nodes()) == 2


def test_none_of_the_libraries_is_loaded_before_it_is_used():
    source = 'import sys, pharos, pharos.live.pictures, pharos.live.graph; print(*sys.modules)'
    modules = subprocess.check_output(
        [sys.executable, '-c', source], env=environment(''), text=True
    ).split()
    assert not {'PIL', 'matplotlib', 'IPython'} & set(modules)
