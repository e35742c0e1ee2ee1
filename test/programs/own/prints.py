#!/usr/bin/python3
"""A program that prints by functions of Python's library."""
import pprint
import traceback

pprint.pprint(['shown'])
try:
    raise ValueError('in vain')
except ValueError:
    traceback.print_exc()
