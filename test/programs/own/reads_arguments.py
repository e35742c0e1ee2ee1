#!/usr/bin/python3
# flake8: noqa
"""A program that reads its arguments, after star imports that bring a sys with them."""
import argparse
import optparse
import sys

import rospy
from os import *
from std_srvs.srv import *
from time import *

argv = sys.argv
parser = argparse.ArgumentParser()
parser.add_argument('--speed', type=int)
speed = parser.parse_args(rospy.myargv()[1:]).speed
program, rest = parser.prog, parser.parse_known_args()[1]
others = optparse.OptionParser(prog='own').parse_args(['one'])[1]
usage = optparse.OptionParser().get_prog_name()
variable = environ['ROS_MASTER_URI']
request = EmptyRequest
