"""Draw messages by matplotlib: images, scans, clouds, paths, maps."""
import io

import numpy

#: encoding -> numpy's type, and the order of its channels as red, green, blue
ENCODINGS = {
    'mono8': ('u1', [0]),
    'rgb8': ('u1', [0, 1, 2]),
    'bgr8': ('u1', [2, 1, 0]),
    'rgba8': ('u1', [0, 1, 2, 3]),
    'bgra8': ('u1', [2, 1, 0, 3]),
    'mono16': ('u2', [0]),
    '16UC1': ('u2', [0]),
    '32FC1': ('f4', [0]),
}
COLUMNS = {7: 'f4', 8: 'f8'}  # datatypes of the fields of clouds


def _image(axes, message):
    kind, order = ENCODINGS[message.encoding]
    rows = numpy.frombuffer(message.data, 'u1').reshape(message.height, message.step)
    size = numpy.dtype(kind).itemsize * len(order) * message.width
    pixels = rows[:, :size].copy().view(('>' if message.is_bigendian else '<') + kind)
    pixels = pixels.reshape(message.height, message.width, len(order))[:, :, order]
    # Without a vmax the greatest depth is white.
    axes.imshow(numpy.squeeze(pixels), cmap='gray', vmin=0, vmax=255 if kind == 'u1' else None)


def _compressed(axes, message):
    from PIL import Image

    axes.imshow(Image.open(io.BytesIO(message.data)))


def _scan(axes, message):
    ranges = numpy.array(message.ranges)
    angles = message.angle_min + message.angle_increment * numpy.arange(len(ranges))
    ranges[(ranges < message.range_min) | (ranges > message.range_max)] = numpy.nan
    axes.scatter(ranges * numpy.cos(angles), ranges * numpy.sin(angles), s=4)
    axes.plot(0, 0, 'r>')


def _path(axes, message):
    places = [pose.pose.position for pose in message.poses]
    axes.plot([place.x for place in places], [place.y for place in places])


def _map(axes, message):
    cells = numpy.array(message.data).reshape(message.info.height, message.info.width)
    axes.set_facecolor('lightblue')  # of what is unknown
    axes.imshow(numpy.ma.masked_less(cells, 0), cmap='gray_r', origin='lower', vmin=0, vmax=100)


def _cloud(axes, message):
    fields = {field.name: field for field in message.fields}
    layout = {
        'names': list('xyz'),
        'formats': [COLUMNS[fields[name].datatype] for name in 'xyz'],
        'offsets': [fields[name].offset for name in 'xyz'],
        'itemsize': message.point_step,
    }
    points = numpy.frombuffer(message.data, numpy.dtype(layout))
    axes.scatter(points['x'], points['y'], s=1, c=points['z'])


DRAWN = {
    'sensor_msgs/Image': _image,
    'sensor_msgs/CompressedImage': _compressed,
    'sensor_msgs/LaserScan': _scan,
    'sensor_msgs/PointCloud2': _cloud,
    'nav_msgs/Path': _path,
    'nav_msgs/OccupancyGrid': _map,
}


def png_of(message):
    """Return the picture of a message, None if it cannot be drawn."""
    if message._type not in DRAWN:
        return None
    from matplotlib.figure import Figure

    made = Figure(layout='constrained')
    axes = made.add_subplot(title=message.header.frame_id, aspect='equal')
    try:
        DRAWN[message._type](axes, message)
        return png(made)
    except (LookupError, ValueError, OSError):  # empty, malformed, or of an encoding not drawn
        return None


def png(figure):
    """Return a matplotlib Figure as a notebook shows it."""
    file = io.BytesIO()
    figure.savefig(file, format='png')
    return file.getvalue()
