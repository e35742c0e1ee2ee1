"""One half of a circle."""
import robot_rings

robot_rings.started('one')
from robot_rings import two  # noqa: E402, F401

NAME = 'one'
