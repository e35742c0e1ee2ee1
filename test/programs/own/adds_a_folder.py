#!/usr/bin/python3
"""A program that adds a folder to Python's path."""
import os
import sys

import pharos  # noqa: F401

sys.path.insert(0, os.path.join(os.path.dirname(__file__), 'lib'))

import plain_module  # noqa: E402

plain_module.USERS.append(sys.argv[0])
