#!/usr/bin/python3
"""Closes what it prints to, in the ways that there are: ``closing.py HOW``."""
import io
import sys

HOW = sys.argv[1]
if HOW == 'wrap':
    io.TextIOWrapper(sys.stdout.buffer, encoding='utf-8').write('printed\n')
else:
    print('printed')
if HOW == 'detach':
    sys.stdout.detach().close()
elif HOW == 'close':
    sys.stdout.close()
    sys.stderr.close()
