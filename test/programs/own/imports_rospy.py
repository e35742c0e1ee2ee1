#!/usr/bin/python3
# flake8: noqa
"""A program that imports rospy in the ways that there are."""
import doctest
import importlib
import importlib.util
import runpy
import sys, rospy

from rospy import Publisher as publisher

by_name = importlib.import_module('rospy.topics')
by_function = __import__('rospy')
by_modules = sys.modules['rospy']
names = {each.get_name() for each in (rospy, by_function, by_modules)}
same = by_name.Publisher is publisher is rospy.Publisher
reloaded = importlib.reload(importlib.import_module('logging')) is sys.modules['logging']
known = [
    importlib.util.find_spec(name) is not None
    for name in ('names_its_node', 'rospy.topics', 'json', 'not_there')
]
beside = __file__.replace('imports_rospy', 'names_its_node')
spec = importlib.util.spec_from_file_location('a_plug_in', beside)
plug_in = importlib.util.module_from_spec(spec)
spec.loader.exec_module(plug_in)
by_file = plug_in.NAME
by_run = runpy.run_path(beside)['NAME']
by_code = {}
exec(open(beside).read(), by_code)
examples = doctest.testmod(plug_in)
