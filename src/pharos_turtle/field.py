"""The turtles' field: how a turtle moves, the line that its pen draws, and the picture of both.

There is no ROS in here. The figures are turtlesim's (ros_tutorials, turtlesim/src/turtle.cpp and
turtle_frame.cpp). A place is a complex number, x + y·j in metres from the lower left corner; a
heading is in radians. Pixels count from the upper left corner.
"""
import cmath
import math

from PIL import ImageDraw

METRE, SIZE = 45, 500  # pixels
FIELD = (SIZE - 1) / METRE  # 11.088889 m
BACKGROUND = 69, 86, 255
PEN = (179, 184, 255), 3  # colour, width in pixels
OUTLINE = 0.5, -0.4 + 0.35j, -0.2, -0.4 - 0.35j  # of a turtle that heads right, in metres


class Turtle:
    """A turtle, and the picture of all lines, to which it adds its own.

    :ivar colour: what was under it at its last step
    :ivar pen: the colour and width of its line, None if the pen is up
    """

    def __init__(self, lines, place, heading):
        self.lines, self.place, self.pen = lines, place, None
        self.go_to(place, heading)
        self.pen = PEN
        self.drive(0, 0)

    def drive(self, velocity, turning):
        """Go on for a second, at forward + left·j metres and so many radians a second."""
        if not cmath.isfinite(velocity + turning):
            raise ValueError('a turtle takes finite velocities only')
        self.velocity, self.turning, self.time_left = velocity, turning, 1.0

    def update(self, seconds):
        """Move on by some seconds."""
        if self.time_left < 0:
            self.velocity = self.turning = 0
        self.time_left -= seconds
        self.go(self.velocity * seconds, self.turning * seconds)

    def go(self, way, turn):
        """Turn, then go forward + left·j metres."""
        heading = self.heading + turn
        self.go_to(self.place + way * cmath.rect(1, heading), heading)

    def go_to(self, place, heading):
        """Go to a place, or to the wall before it, with a line if the pen is down."""
        before, self.heading = pixel(self.place), math.remainder(heading, math.tau)
        x, y = (max(0, min(FIELD, length)) for length in (place.real, place.imag))
        self.place = complex(x, y)
        after = pixel(self.place)
        self.colour = self.lines.getpixel(after)  # before its own line covers it
        if self.pen and after != before:
            ImageDraw.Draw(self.lines).line((before, after), *self.pen)

    def draw(self, image, colour):
        """Draw its outline on an image."""
        corners = [pixel(self.place + each * cmath.rect(1, self.heading)) for each in OUTLINE]
        ImageDraw.Draw(image).polygon(corners, colour, 'black')


def pixel(place):
    """Return the pixel at a place."""
    return round(place.real * METRE), round((FIELD - place.imag) * METRE)
