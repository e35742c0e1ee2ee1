"""Pictures from above, in metres: laser scans, paths, clouds of points, maps."""
import math
from typing import Any, List, Optional, Tuple

import numpy
from PIL import Image, ImageColor, ImageDraw

from pharos.errors import MessageTypeError
from pharos.live.colors import BLUE, GREEN, VERMILION

SIZE = 640  # pixels of the longer side of a view
BORDER = 40  # pixels around what is drawn
LINES = 8  # lines of the grid that a side has at the most
#: from the lowest to the highest: light for all who see, dark to bright as matplotlib's viridis
_HEIGHTS = numpy.array(
    [(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (230, 210, 30)], 'f8'
)


class ViewFromAbove:
    """A view of points from above, x to the right and y up, with a grid in metres.

    :param points: an array of x and y, of which all that are finite are to be in view
    """

    def __init__(self, points: Any, frame: str) -> None:
        points = points[numpy.isfinite(points).all(axis=1)] if len(points) else points
        points = points if len(points) else numpy.zeros((1, 2))
        low, high = points.min(axis=0), points.max(axis=0)
        extent = max(*(high - low), 0.1)
        self._scale = (SIZE - 2 * BORDER) / extent  # pixels a metre
        self._low = low
        width, height = (int(side * self._scale) + 2 * BORDER for side in high - low)
        self.image = Image.new('RGB', (max(width, SIZE // 3), max(height, SIZE // 4)), 'white')
        self.draw = ImageDraw.Draw(self.image)
        self._draw_grid(extent)
        self.draw.text((4, 2), _drawable(frame), fill='#505050')

    def place(self, points: Any) -> Any:
        """Where points are, in pixels."""
        pixels = (numpy.asarray(points, 'f8')[:, :2] - self._low) * self._scale + BORDER
        pixels[:, 1] = self.image.height - pixels[:, 1]
        return pixels

    def _draw_grid(self, extent: float) -> None:
        step = _round_step(extent / LINES)
        for axis in 0, 1:
            count = int(self.image.size[axis] / (step * self._scale)) + 2
            first = math.floor((self._low[axis] - BORDER / self._scale) / step)
            for number in range(first, first + count + 1):
                self._draw_line(axis, number * step, f'{number * step:g}')

    def _draw_line(self, axis: int, value: float, text: str) -> None:
        point = [self._low[0], self._low[1]]
        point[axis] = value
        at = self.place([point])[0][axis]
        color = '#B0B0B0' if value == 0 else '#E8E8E8'
        if axis == 0:
            self.draw.line([(at, 0), (at, self.image.height)], fill=color)
            self.draw.text((at + 2, self.image.height - 12), text + ' m', fill='#808080')
        else:
            self.draw.line([(0, at), (self.image.width, at)], fill=color)
            self.draw.text((2, at - 12), text, fill='#808080')

    def dots(self, points: Any, colors: Any, size: int = 1) -> None:
        """A square dot at each point.

        :param colors: an array of red, green and blue for each, or one for all
        """
        pixels = numpy.rint(self.place(points)).astype('i8')
        canvas = numpy.array(self.image)
        for right in range(size):
            for down in range(size):
                x, y = pixels[:, 0] + right, pixels[:, 1] + down
                inside = (x >= 0) & (y >= 0) & (x < self.image.width) & (y < self.image.height)
                each = colors[inside] if numpy.ndim(colors) == 2 else colors
                canvas[y[inside], x[inside]] = each
        self.image.paste(Image.fromarray(canvas))

    def line(self, points: Any, color: str) -> None:
        """A line through points."""
        self.draw.line([tuple(point) for point in self.place(points)], fill=color, width=2)

    def mark(self, point: Tuple[float, float], color: str, yaw: Optional[float] = None) -> None:
        """A disc at a point, with a line to where it looks."""
        x, y = self.place([point])[0]
        if yaw is not None:
            end = (x + 14 * math.cos(yaw), y - 14 * math.sin(yaw))
            self.draw.line([(x, y), end], fill=color, width=2)
        self.draw.ellipse([x - 4, y - 4, x + 4, y + 4], fill=color)


def _drawable(text: str) -> str:
    """A text without what Pillow's own font has not."""
    return text.encode('latin-1', 'replace').decode('latin-1')


def _round_step(step: float) -> float:
    """The next of 1, 2, 5, 10 and so on."""
    power = 10.0 ** math.floor(math.log10(step))
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= step * 0.999)


def _yaw(orientation: Any) -> float:
    x, y, z, w = (getattr(orientation, name) for name in 'xyzw')
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


# -- messages


def scan_picture(message: Any) -> Image.Image:
    """A sensor_msgs/LaserScan from above, forwards to the right; what is out of range is left
    out."""
    ranges = numpy.array(message.ranges, 'f8')
    known = numpy.isfinite(ranges) & (ranges >= message.range_min) & (ranges <= message.range_max)
    angles = message.angle_min + message.angle_increment * numpy.flatnonzero(known)
    distances = ranges[known]
    points = numpy.column_stack([distances * numpy.cos(angles), distances * numpy.sin(angles)])
    view = ViewFromAbove(numpy.vstack([points, [(0, 0)]]), message.header.frame_id)
    view.dots(points, ImageColor.getrgb(VERMILION), size=3)
    view.mark((0, 0), BLUE, 0.0)
    return view.image


def path_picture(message: Any) -> Image.Image:
    """A nav_msgs/Path from above, from its green beginning to its vermilion end."""
    poses = [pose.pose for pose in message.poses]
    points = numpy.array([(pose.position.x, pose.position.y) for pose in poses]).reshape(-1, 2)
    view = ViewFromAbove(points, message.header.frame_id)
    if poses:
        view.line(points, BLUE)
        view.mark(points[0], GREEN, _yaw(poses[0].orientation))
        view.mark(points[-1], VERMILION, _yaw(poses[-1].orientation))
    return view.image


def map_picture(message: Any) -> Image.Image:
    """A nav_msgs/OccupancyGrid, x to the right and y up: free is white, occupied black, and what is
    not known a bluish grey.

    :raises MessageTypeError: if it has not as many cells as it says
    """
    width, height = message.info.width, message.info.height
    cells = numpy.array(message.data, 'i2')
    if not width or not height or len(cells) != width * height:
        raise MessageTypeError(
            f'a map of {width} x {height} cells has as many values, and at least one: this one has'
            f' {len(cells)}'
        )
    grey = 255 - numpy.clip(cells, 0, 100) * 255 // 100
    colors = numpy.repeat(grey[:, numpy.newaxis], 3, axis=1)
    colors[(cells < 0) | (cells > 100)] = (150, 170, 185)
    picture = Image.fromarray(colors.astype('u1').reshape(height, width, 3)[::-1])
    times = max(1, SIZE // max(width, height))
    return picture.resize((width * times, height * times), Image.NEAREST)


def cloud_picture(message: Any) -> Image.Image:
    """A sensor_msgs/PointCloud2 from above, coloured by height: the lowest tenth is dark, the highest
    bright.

    :raises MessageTypeError: if it has no x, y and z, or fewer bytes than it says
    """
    points = _cloud_points(message)
    points = points[numpy.isfinite(points).all(axis=1)]
    view = ViewFromAbove(points[:, :2], message.header.frame_id)
    if len(points):
        points = points[numpy.argsort(points[:, 2], kind='stable')]  # the highest on top
        low, high = numpy.percentile(points[:, 2], [2, 98])
        height = numpy.clip((points[:, 2] - low) / ((high - low) or 1), 0, 1)
        steps = numpy.linspace(0, 1, len(_HEIGHTS))
        channels = [numpy.interp(height, steps, _HEIGHTS[:, channel]) for channel in range(3)]
        view.dots(points, numpy.column_stack(channels), size=2)
        view.draw.text((4, 14), f'z {low:.3g} m to {high:.3g} m', fill='#505050')
    return view.image


#: datatype of a PointField -> numpy's
_DATATYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}


def _cloud_points(message: Any) -> Any:
    """An array of x, y and z."""
    order = '>' if message.is_bigendian else '<'
    fields = {field.name: field for field in message.fields}
    missing = [name for name in 'xyz' if name not in fields]
    if missing or any(fields[name].datatype not in _DATATYPES for name in 'xyz'):
        names = ', '.join(fields) or 'none'
        raise MessageTypeError(f'a cloud of points has fields x, y and z; this one has {names}')
    kind = numpy.dtype(
        {
            'names': list('xyz'),
            'formats': [order + _DATATYPES[fields[name].datatype] for name in 'xyz'],
            'offsets': [fields[name].offset for name in 'xyz'],
            'itemsize': message.point_step,
        }
    )
    data = bytes(message.data)
    row = message.point_step * message.width
    step = message.row_step or row
    if step < row or len(data) < step * (message.height - 1) + row:
        raise MessageTypeError(
            f'a cloud of {message.width} x {message.height} points of {message.point_step} bytes has'
            f' {row} bytes a row: this one has {len(data)} in rows of {step}'
        )
    rows: List[Any] = [
        numpy.frombuffer(data, kind, message.width, step * row_number)
        for row_number in range(message.height)
    ]
    points = numpy.concatenate(rows) if rows else numpy.zeros(0, kind)
    return numpy.column_stack([points[name].astype('f8') for name in 'xyz'])
