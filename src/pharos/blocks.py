"""Blocks: what they take, and which method they are."""
from __future__ import annotations

import inspect
from typing import Any, Callable

Block = Callable[..., Any]


def taking(block: Any, what: str, *counts: int) -> Any:
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
    except (TypeError, ValueError):  # of some functions in C
        return block
    for count in counts:
        try:
            signature.bind(*[None] * count)
        except TypeError:
            continue
        return block if count == counts[0] else lambda *values: block(*values[:count])
    raise TypeError(f'a {what} takes {" or ".join(map(str, counts))} arguments, not {signature}')


def rebound(block: Any, node: Any) -> Any:
    """Return the block, or the method of its name if it is one of the node, whose class changed."""
    if isinstance(block, list):
        return [rebound(each, node) for each in block]
    return getattr(node, block.__name__) if getattr(block, '__self__', None) is node else block


def name_of(block: Any) -> str:
    """Return the name of a block, for texts."""
    if isinstance(block, str):
        return block
    return getattr(block, '__qualname__', type(block).__name__)
