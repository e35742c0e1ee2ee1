#!/usr/bin/python3
"""A program that sets what is usually the whole process's."""
import contextlib
import io
import logging
import sys

sys.stdout = io.StringIO()
print('own')
with contextlib.redirect_stdout(io.StringIO()) as redirected:
    print('redirected')
sys.path.insert(0, '/no/such/folder')
sys.argv[1:] = ['changed']
sys.setrecursionlimit(sys.getrecursionlimit())
logging.basicConfig(level=logging.DEBUG, stream=sys.stdout, format='%(message)s', force=True)
logging.debug('logged')
logging.getLogger('own').info('logged too')
root = logging.getLogger()
