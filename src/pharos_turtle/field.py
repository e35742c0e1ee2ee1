"""The turtles' field: where the turtles are, how they move, and the picture that their pens draw.

There is no ROS in here; `scripts/turtle_simulator` puts a field on topics and services. The figures
and the order of events are turtlesim's (ros_tutorials, turtlesim/src/turtle.cpp and
turtle_frame.cpp), so that a program sees the same numbers from either. Lengths are in metres from
the lower left corner, y upwards, and angles in radians, as in turtlesim/Pose; pixels count from the
upper left corner.
"""

import itertools
import math

from PIL import Image, ImageDraw

METRE = 45  # pixels: the height of turtlesim's picture of a turtle
PICTURE_SIZE = 500  # pixels
FIELD_SIZE = (PICTURE_SIZE - 1) / METRE  # 11.088889 m
COMMAND_HOLDS = 1.0  # seconds
BACKGROUND = (0x45, 0x56, 0xFF)
PEN_COLOUR = (0xB3, 0xB8, 0xFF)
PEN_WIDTH = 3  # pixels

# A turtle seen from above, heading right: discs (forward, left, radius) in metres, the shell last.
LIMBS = (
    (0.46, 0, 0.13),
    (0.28, 0.3, 0.1),
    (0.28, -0.3, 0.1),
    (-0.28, 0.3, 0.1),
    (-0.28, -0.3, 0.1),
    (-0.42, 0, 0.06),
)
SHELL = (0, 0, 0.38)
SHELL_COLOURS = (
    (0x3C, 0x8F, 0x3C),
    (0xD9, 0x7B, 0x29),
    (0x8E, 0x4A, 0xA8),
    (0xC0, 0x3A, 0x3A),
    (0x2B, 0x8C, 0x8C),
)
LIMB_COLOUR = (0xE4, 0xD3, 0x9A)


class Turtle:
    """A turtle on a field. Where it is: `x`, `y`, `theta`; `colour` is what was under it at the
    last update."""

    def __init__(self, field, x, y, theta):
        _check_finite(x=x, y=y, theta=theta)
        self.field = field
        self.x, self.y, self.theta = _in_field(x), _in_field(y), _normalised(theta)
        self.colour = field.colour_at(self.x, self.y)
        self.pen_colour, self.pen_width, self.pen_is_down = PEN_COLOUR, PEN_WIDTH, True
        self._stop()

    @property
    def linear_velocity(self):
        """Metres a second: signed along the heading, or the speed of a turtle that also goes
        sideways."""
        return math.hypot(self._forward, self._left) if self._left else self._forward

    @property
    def angular_velocity(self):
        """Radians a second, counter-clockwise."""
        return self._turning

    def drive(self, forward, turning, left=0.0):
        """Move on with these velocities (metres and radians a second) for a second, unless told
        anew."""
        _check_finite(forward=forward, turning=turning, left=left)
        self._forward, self._left, self._turning = forward, left, turning
        self._command_age = 0.0

    def set_pen(self, colour, width, off):
        """Lift the pen, or put it down with another colour and width (pixels; 0 is the
        thinnest)."""
        self.pen_is_down = not off
        if not off:
            self.pen_colour, self.pen_width = tuple(colour), width or 1

    def update(self, seconds):
        """Move on by so many seconds. Returns where a wall kept the turtle from going, `(x, y)`, or
        None."""
        if self._command_age > COMMAND_HOLDS:
            self._stop()
        self._command_age += seconds
        self.theta = _normalised(self.theta + self._turning * seconds)
        along, across = math.cos(self.theta), math.sin(self.theta)
        return self._go_to(
            self.x + (along * self._forward - across * self._left) * seconds,
            self.y + (across * self._forward + along * self._left) * seconds,
        )

    def teleport_absolute(self, x, y, theta):
        """Be there, with a line from where the turtle was. Returns as `update` does."""
        _check_finite(x=x, y=y, theta=theta)
        self.theta = _normalised(theta)
        return self._go_to(x, y)

    def teleport_relative(self, linear, angular):
        """Turn by `angular`, then be `linear` ahead, with a line. Returns as `update` does."""
        _check_finite(linear=linear, angular=angular)
        self.theta = _normalised(self.theta + angular)
        return self._go_to(
            self.x + math.cos(self.theta) * linear, self.y + math.sin(self.theta) * linear
        )

    def _stop(self):
        self._forward = self._left = self._turning = 0.0
        self._command_age = 0.0

    def _go_to(self, x, y):
        start, end = (self.x, self.y), (_in_field(x), _in_field(y))
        self.x, self.y = end
        # As turtlesim does it: the colour is read before this step's own line covers it.
        self.colour = self.field.colour_at(*end)
        if self.pen_is_down and end != start:
            self.field.draw_line(start, end, self.pen_colour, self.pen_width)
        return None if end == (x, y) else (x, y)


class Field:
    """A square field, the turtles on it (`turtles`, by name) and the lines they have drawn."""

    def __init__(self, background=BACKGROUND):
        self.turtles = {}
        self.reset(background)

    def spawn(self, name, x, y, theta):
        """Put a turtle on the field; without a name it gets one. Returns the name; ValueError if it
        is taken."""
        if not name:
            name = next(
                free for free in map('turtle{}'.format, self._numbers) if free not in self.turtles
            )
        if name in self.turtles:
            raise ValueError(f'A turtle named [{name}] already exists')
        self.turtles[name] = Turtle(self, x, y, theta)
        return name

    def kill(self, name):
        """Take a turtle off the field; its lines stay. ValueError if there is none."""
        if name not in self.turtles:
            raise ValueError(f'Tried to kill turtle [{name}], which does not exist')
        del self.turtles[name]

    def reset(self, background=BACKGROUND):
        """Back to the start: one turtle in the middle of an empty field, heading right."""
        self.turtles.clear()
        self._numbers = itertools.count(1)
        self.clear(background)
        self.spawn('', FIELD_SIZE / 2, FIELD_SIZE / 2, 0.0)

    def clear(self, background=BACKGROUND):
        """Wipe all lines."""
        self._lines = Image.new('RGB', (PICTURE_SIZE, PICTURE_SIZE), background)
        self._pen = ImageDraw.Draw(self._lines)

    def colour_at(self, x, y):
        """The colour (red, green, blue) of the ground there."""
        return self._lines.getpixel(tuple(map(round, _pixel(x, y))))

    def draw_line(self, start, end, colour, width):
        """Draw a line between two points with ends as broad as the line."""
        pixels = [_pixel(*start), _pixel(*end)]
        self._pen.line(pixels, colour, width)
        # Pillow cuts a wide line off square at its ends: without a dot there, a curve shows a gap
        # at each of its steps.
        for x, y in pixels:
            self._pen.ellipse(_box(x, y, (width - 1) / 2), colour)

    def picture(self):
        """A picture (PIL.Image) of the field as it is now, lines and turtles."""
        picture = self._lines.copy()
        pen = ImageDraw.Draw(picture)
        for turtle, shell_colour in zip(self.turtles.values(), itertools.cycle(SHELL_COLOURS)):
            along, across = math.cos(turtle.theta), math.sin(turtle.theta)
            for forward, left, radius in LIMBS + (SHELL,):
                x, y = _pixel(
                    turtle.x + along * forward - across * left,
                    turtle.y + across * forward + along * left,
                )
                colour = shell_colour if radius == SHELL[-1] else LIMB_COLOUR
                pen.ellipse(_box(x, y, radius * METRE), colour, outline='black')
        return picture


def _in_field(length):
    return min(max(length, 0.0), FIELD_SIZE)


def _normalised(angle):
    return math.remainder(angle, math.tau)


def _pixel(x, y):
    return x * METRE, (FIELD_SIZE - y) * METRE


def _box(x, y, radius):
    return x - radius, y - radius, x + radius, y + radius


def _check_finite(**values):
    for name, value in values.items():
        if not math.isfinite(value):
            raise ValueError(f'{name} is {value}: a turtle takes finite numbers only')
