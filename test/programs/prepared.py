"""What the programs begin with that test_signals.py runs."""
import signal  # noqa: F401
import sys  # noqa: F401
import threading

import pharos
from pharos import BlockNode, Master


def node(name='/program', **kwargs):
    return Master().create(BlockNode, named=name, domain='127.0.0.1', **kwargs)


def ready():
    print('ready', flush=True)


def wait_for(event):
    """In short waits: a signal that comes just before one begins does not end it, in Python."""
    while not event.wait(0.1):
        pass


def ready_in_wait():
    """Tell when the main thread waits in something of ours; before that, it runs code of its
    own."""

    def tell():
        while not pharos.signals._waits:
            threading.Event().wait(0.001)
        ready()

    threading.Thread(target=tell, daemon=True).start()
