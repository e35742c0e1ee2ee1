"""The other half."""
import robot_rings

robot_rings.started('two')
import robot_rings.one as one  # noqa: E402, F401

NAME = 'two'
