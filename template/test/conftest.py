"""Fixtures: a ROS master for each test, and nodes that end with it."""
import pathlib
import sys

pytest_plugins = ['pharos.testing']
# the tests run before anything is built, too
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent / 'src'))
