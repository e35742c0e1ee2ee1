"""Loads a program of ROS and waits: ``loads.py spin|wait|end PROGRAM ARGUMENT ...``."""
import sys

import pharos


def say(line):
    """Print a line in one piece: the program that is loaded may print just now, too."""
    print(f'{line}\n', end='', flush=True)


how, program, *arguments = sys.argv[1:]
node = pharos.Master().load(program, None, *arguments)
say(f'loaded {node.name}')
if how == 'spin':
    pharos.spin()
elif how == 'wait':
    say(f'exit code {node.wait()}')
say('ends')
