"""A package that reaches rospy through another one alone."""
import robot_maths  # noqa: F401
from robot_eyes import looking  # noqa: F401
