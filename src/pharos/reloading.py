"""What IPython's autoreload leaves to be done.

It gives nodes the new class, and the functions of the old one, which delegates hold as bound methods,
the new code; but a ``super()`` in them means the old class still, of which the node is none any more.
"""
import functools
import sys
from typing import Any

from pharos import node_registry
from pharos.becoming import places
from pharos.blocks import attempt

_EVENTS = 'pre_run_cell', 'post_run_cell'  # before and after the one, perhaps, autoreload acts


def ipython_shell() -> Any:
    """The session of IPython's that this program is; None: it is none."""
    ipython: Any = sys.modules.get('IPython')
    return ipython and ipython.get_ipython()


def follow() -> None:
    """From now on, nodes have methods of their present classes for blocks, where this is IPython."""
    shell = ipython_shell()
    for event in _EVENTS if shell else ():
        if _look_up_methods not in shell.events.callbacks[event]:
            shell.events.register(event, _look_up_methods)


def _look_up_methods(*cell: Any) -> None:
    for node in node_registry.nodes():
        for place in places(node):
            block = place.block.now
            if place.take and place.block.method is not None and block != place.block.given:
                # what cannot be called as it was is told when it is called
                attempt(functools.partial(place.take, block))
