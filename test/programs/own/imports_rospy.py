#!/usr/bin/python3
# flake8: noqa
"""A program that imports rospy in the ways that there are."""
import importlib
import sys, rospy

from rospy import Publisher as publisher

by_name = importlib.import_module('rospy.topics')
by_function = __import__('rospy')
by_modules = sys.modules['rospy']
names = {each.get_name() for each in (rospy, by_function, by_modules)}
same = by_name.Publisher is publisher is rospy.Publisher
reloaded = importlib.reload(importlib.import_module('logging')) is sys.modules['logging']
