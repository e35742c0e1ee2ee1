#!/usr/bin/python3
"""A program that sets a time limit for its sockets."""
import socket

socket.setdefaulttimeout(1.5)
with socket.socket() as sock:
    found = sock.gettimeout()
