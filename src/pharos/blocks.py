"""Blocks: what they take, and which method they are."""
import inspect
import types
from typing import Any, Callable

Block = Callable[..., Any]


def taking(block, what, least, most):
    """Return a block that takes ``most`` arguments, and passes on as many as the block needs.

    Parameters with a default keep it: ``lambda message, side=side: ...`` gets the message alone.

    :param what: what it is, for the error
    :param least: so many arguments it gets at least
    :raises TypeError: if it is not callable, takes another number of arguments, or is an ``async def``
    """
    if block is None:
        return None
    if not callable(block):
        raise TypeError(f'a {what} is a callable, not {block!r}')
    if any(map(inspect.iscoroutinefunction, (block, getattr(block, '__call__', None)))):
        raise TypeError(
            f'a {what} runs in a thread, and cannot be async def: write def, and asyncio.run() in it'
        )
    try:
        signature = inspect.signature(block)
    except ValueError:  # of a function in C, such as deque.append
        signature = inspect.signature(lambda value: None)
    count = _needed(signature, least, most)
    try:
        signature.bind(*[None] * count)
    except TypeError:
        numbers = ' or '.join(str(number) for number in range(least, most + 1))
        raise TypeError(f'a {what} takes {numbers} arguments, not {signature}') from None
    if count == most:
        return block
    return lambda *values: block(*values[:count])


def _needed(signature, least, most):
    """Return how many arguments to pass: all if there is ``*args``, else those without a default."""
    parameters = signature.parameters.values()
    if any(each.kind is each.VAR_POSITIONAL for each in parameters):
        return most
    kinds = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
    needed = [each for each in parameters if each.kind in kinds and each.default is each.empty]
    return min(max(len(needed), least), most)


class Receiver:
    """Runs a delegate for each message."""

    _delegate_runs: Block | None = None  # the delegate, as a block that takes two arguments
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
        self._delegate_runs = taking(block, 'delegate', 1, 2)
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
