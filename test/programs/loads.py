"""Loads a program of ROS and waits: ``loads.py spin|wait|end PROGRAM ARGUMENT ...``."""
import sys

import pharos

how, program, *arguments = sys.argv[1:]
node = pharos.Master().load(program, None, *arguments)
print('loaded', node.name, flush=True)
if how == 'spin':
    pharos.spin()
elif how == 'wait':
    print('exit code', node.wait(), flush=True)
print('ends', flush=True)
