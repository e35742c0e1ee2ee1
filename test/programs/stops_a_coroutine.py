#!/usr/bin/python3
"""Stops a program whose main thread runs a coroutine, in a process of its own: the client of Jupyter
has replaced asyncio.run in one that has run a notebook."""
import pathlib

import pharos
from pharos.testing import TIMEOUT

node = pharos.Master().load(str(pathlib.Path(__file__).parent / 'own' / 'runs_a_coroutine.py'))
main = node.ros_import('__main__')
assert main.begun.wait(TIMEOUT)
node.stop()
print(*main.ended, node.exit_code)
