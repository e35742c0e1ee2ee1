"""Blocks: what they take, and which method they are."""
import inspect
import types
from typing import Any, Callable

Block = Callable[..., Any]


def taking(block, what, *counts):
    """Return a block that takes the first of ``counts`` arguments, made from one that may take fewer.

    :param what: what it is, for the error
    :raises TypeError: if it is not callable, or takes none of these numbers of arguments
    """
    if block is None:
        return None
    if not callable(block):
        raise TypeError(f'a {what} is a callable, not {block!r}')
    try:
        signature = inspect.signature(block)
    except ValueError:  # of a function in C, such as deque.append
        signature = inspect.signature(lambda value: None)
    for count in counts:
        try:
            signature.bind(*[None] * count)
        except TypeError:
            continue
        return block if count == counts[0] else lambda *values: block(*values[:count])
    raise TypeError(f'a {what} takes {" or ".join(map(str, counts))} arguments, not {signature}')


class Receiver:
    """Runs a delegate for each message."""

    delegate_runs: Block | None = None  #: the delegate, as a block that takes two arguments
    _delegate: Block | None = None

    @property
    def delegate(self):
        """The block run for each message, as ``block(message, channel)`` or ``block(message)``.

        That of a channel goes before that of its node. One that is set takes effect with the next
        message. The report: ``self receiverDelegate: [:message :channel | ...]``.
        """
        return self._delegate

    @delegate.setter
    def delegate(self, block: Block | None) -> None:
        self.delegate_runs = taking(block, 'delegate', 2, 1)
        self._delegate = block


def rebound(block, node, cls):
    """Return the block; if it is a method of the node, that of the same name of another class."""
    if isinstance(block, list):
        return [rebound(each, node, cls) for each in block]
    if getattr(block, '__self__', None) is not node:
        return block
    return types.MethodType(getattr(cls, block.__name__), node)


def name_of(block):
    """Return the name of a block, for texts."""
    if isinstance(block, str):
        return block
    return getattr(block, '__qualname__', type(block).__name__)
