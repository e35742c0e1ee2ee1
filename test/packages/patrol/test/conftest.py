"""Fixtures: a ROS master for each test, and nodes that end with it."""
import pathlib
import sys

# the tests run in a clone where nothing is built, too
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent / 'src'))

from pharos.testing import create_node, master  # noqa: E402, F401
