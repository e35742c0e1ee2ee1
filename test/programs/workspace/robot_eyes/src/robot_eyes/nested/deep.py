# flake8: noqa
"""A module of a subpackage."""
from .. import looking
from ..msg import Spot
