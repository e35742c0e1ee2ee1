"""Draw messages by matplotlib: images, scans, clouds, paths, maps."""
from __future__ import annotations

import io
from typing import Any

import numpy
from genpy import Message

#: encoding -> numpy's type, and the indices of red, green and blue among the channels
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
#: datatype of a PointField -> numpy's type
POINT_TYPES = {7: 'f4', 8: 'f8'}


def _draw_image(axes, message):
    number_type, channel_order = ENCODINGS[message.encoding]
    byte_order = '>' if message.is_bigendian else '<'
    pixel_type = numpy.dtype(byte_order + number_type)
    channel_count = len(channel_order)
    row_size = pixel_type.itemsize * channel_count * message.width  # without the padding
    rows = numpy.frombuffer(message.data, 'u1').reshape(message.height, message.step)
    pixels = rows[:, :row_size].copy().view(pixel_type)
    pixels = pixels.reshape(message.height, message.width, channel_count)[:, :, channel_order]
    white = 255 if number_type == 'u1' else None  # None: the greatest depth
    axes.imshow(numpy.squeeze(pixels), cmap='gray', vmin=0, vmax=white)


def _draw_compressed_image(axes, message):
    from PIL import Image

    axes.imshow(Image.open(io.BytesIO(message.data)))


def _draw_scan(axes, message):
    ranges = numpy.array(message.ranges)
    angles = message.angle_min + message.angle_increment * numpy.arange(len(ranges))
    ranges[(ranges < message.range_min) | (ranges > message.range_max)] = numpy.nan
    axes.scatter(ranges * numpy.cos(angles), ranges * numpy.sin(angles), s=4)
    axes.plot(0, 0, 'r>')  # the sensor


def _draw_path(axes, message):
    positions = [pose.pose.position for pose in message.poses]
    axes.plot([position.x for position in positions], [position.y for position in positions])


def _draw_map(axes, message):
    cells = numpy.array(message.data).reshape(message.info.height, message.info.width)
    axes.set_facecolor('lightblue')  # unknown cells, which are negative
    axes.imshow(numpy.ma.masked_less(cells, 0), cmap='gray_r', origin='lower', vmin=0, vmax=100)


def _draw_cloud(axes, message):
    fields = {field.name: field for field in message.fields}
    layout: Any = {
        'names': list('xyz'),
        'formats': [POINT_TYPES[fields[name].datatype] for name in 'xyz'],
        'offsets': [fields[name].offset for name in 'xyz'],
        'itemsize': message.point_step,
    }
    points: Any = numpy.frombuffer(message.data, numpy.dtype(layout))
    axes.scatter(points['x'], points['y'], s=1, c=points['z'])


#: message type -> function that draws a message
DRAW_FUNCTIONS = {
    'sensor_msgs/Image': _draw_image,
    'sensor_msgs/CompressedImage': _draw_compressed_image,
    'sensor_msgs/LaserScan': _draw_scan,
    'sensor_msgs/PointCloud2': _draw_cloud,
    'nav_msgs/Path': _draw_path,
    'nav_msgs/OccupancyGrid': _draw_map,
}


def message_png(message: Message) -> bytes | None:
    """Return the picture of a message as PNG, None if the message cannot be drawn."""
    draw = DRAW_FUNCTIONS.get(message._type)
    if draw is None:
        return None
    from matplotlib.figure import Figure

    figure = Figure(constrained_layout=True)
    axes = figure.add_subplot(title=message.header.frame_id, aspect='equal')
    try:
        draw(axes, message)
        return figure_png(figure)
    except (LookupError, ValueError, OSError):  # empty, malformed, or of an unknown encoding
        return None


def figure_png(figure: Any) -> bytes:
    """Return a matplotlib Figure as PNG, for a notebook."""
    file = io.BytesIO()
    figure.savefig(file, format='png')
    return file.getvalue()
