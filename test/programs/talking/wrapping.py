#!/usr/bin/python3
"""Prints by a stream of its own around the bytes of sys.stdout, which that closes in the end."""
import io
import sys

sys.stdout.reconfigure(line_buffering=True)
sys.stdout = io.TextIOWrapper(sys.stdout.buffer, encoding='utf-8')
print('wrapped: ü')
sys.stdout.close()
