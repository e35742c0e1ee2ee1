"""Blocks: how many arguments they take, and which methods they are."""
from __future__ import annotations

import inspect
from typing import Any, Callable

Block = Callable[..., Any]


def with_arguments(block: Block | None, role: str, least: int, most: int) -> Any:
    """Return a block that takes ``most`` arguments, and passes on as many as the given one needs.

    Parameters keep their defaults: ``lambda message, side=side: ...`` gets the message alone.
    None stays None.

    :param role: the word for the block in an error, such as 'delegate'
    :param least: the given block gets at least so many arguments
    :param most: the given block gets at most so many arguments
    :raises TypeError: if the block is not callable, is an ``async def``, or takes another number of
        arguments
    """
    if block is None:
        return None
    if not callable(block):
        raise TypeError(f'a {role} is a callable, not {block!r}')
    if any(map(inspect.iscoroutinefunction, (block, getattr(block, '__call__', None)))):
        raise TypeError(
            f'a {role} runs in a thread, and cannot be async def: write def, and asyncio.run() in it'
        )
    try:
        signature = inspect.signature(block)
    except ValueError:  # a function in C, such as deque.append, has no signature
        signature = inspect.signature(lambda value: None)
    count = _count_needed(signature, least, most)
    try:
        signature.bind(*[None] * count)
    except TypeError:
        numbers = ' or '.join(str(number) for number in range(least, most + 1))
        raise TypeError(f'a {role} takes {numbers} arguments, not {signature}') from None
    if count == most:
        return block
    return lambda *values: block(*values[:count])


def _count_needed(signature: inspect.Signature, least: int, most: int) -> int:
    """Return how many arguments to pass: ``most`` for ``*args``, else those without a default."""
    parameters = signature.parameters.values()
    if any(parameter.kind is parameter.VAR_POSITIONAL for parameter in parameters):
        return most
    count = 0
    for parameter in parameters:
        is_positional = parameter.kind in (
            parameter.POSITIONAL_ONLY,
            parameter.POSITIONAL_OR_KEYWORD,
        )
        if is_positional and parameter.default is parameter.empty:
            count += 1
    return min(max(count, least), most)


class DelegateHolder:
    """The base of nodes and input channels: an object with a delegate."""

    _delegate: Block | None = None
    _delegate_block: Block | None = None  # the delegate, as a block that takes two arguments

    @property
    def delegate(self) -> Block | None:
        """The block run for each message, as ``block(message, channel)`` or ``block(message)``.

        None: no block. A channel's delegate goes before its node's. A new delegate takes effect
        with the next message. The report: ``self receiverDelegate: [:message :channel | ...]``.

        :raises TypeError: if the new delegate is not a block of one or two arguments
        """
        return self._delegate

    @delegate.setter
    def delegate(self, block: Block | None) -> None:
        self._delegate_block = with_arguments(block, 'delegate', 1, 2)
        self._delegate = block


def block_name(block: Block | str) -> str:
    """Return the name of a block for logs and tables; a string is its own name."""
    if isinstance(block, str):
        return block
    return getattr(block, '__qualname__', type(block).__name__)
