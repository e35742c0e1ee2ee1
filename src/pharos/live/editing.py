"""Change the class of a running node; its name, ports, connections and attributes stay."""
from __future__ import annotations

from types import MethodType

from pharos.names import check_node_class


def become(node, node_class, base):
    """Do the work of :meth:`Node.become`."""
    check_node_class(node_class, base)
    run = node._current_run

    def change():
        receivers = [node, *run.endpoints]
        # find all blocks before the first change: the new class may lack one
        soul = _rebind(node.soul, node, node_class)
        delegates = [_rebind(receiver.delegate, node, node_class) for receiver in receivers]
        node.__class__ = node_class
        node.soul = soul
        for receiver, delegate in zip(receivers, delegates):
            receiver.delegate = delegate

    run.callback_queue.run_exclusively(change)


def _rebind(block, node, node_class):
    """Return a block; a method of the node is replaced by the method of that name in a class.

    :param block: a block, None, or a list of blocks, which gives a list
    :raises AttributeError: if the class lacks the method
    """
    if isinstance(block, list):
        return [_rebind(item, node, node_class) for item in block]
    if getattr(block, '__self__', None) is not node:
        return block
    return MethodType(getattr(node_class, block.__name__), node)
