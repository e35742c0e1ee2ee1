#!/usr/bin/python3
"""Has a child that wants to be a node: ``has_a_child.py HOW`` (fork or spawn)."""
import multiprocessing
import sys

import rospy


def be_a_node():
    """What the child does."""
    rospy.init_node('child_of_program')


if __name__ == '__main__':
    child = multiprocessing.get_context(sys.argv[1]).Process(target=be_a_node)
    child.start()
    child.join()
    sys.exit(child.exitcode)
