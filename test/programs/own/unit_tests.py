#!/usr/bin/python3
"""A program that is a test of its own."""
import sys
import unittest

import rospy


class TestName(unittest.TestCase):
    """A test that passes, and one that is not asked for."""

    def test_name(self):
        """The node has a name."""
        self.assertEqual(rospy.get_name(), '/program_node')

    def test_never(self):
        """Is not run."""
        self.fail()


if __name__ == '__main__':
    program = unittest.main(argv=[sys.argv[0], 'TestName.test_name'], exit=False)
    result = program.result
    unittest.main(exit=True)
