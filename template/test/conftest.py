"""Fixtures: a ROS master for each test, and nodes that end with it."""
import pathlib
import sys

pytest_plugins = ['pharos.testing']
# the tests run before anything is built, too; what is built comes first, since it has the messages
sys.path.append(str(pathlib.Path(__file__).resolve().parent.parent / 'src'))
