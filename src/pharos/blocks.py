"""Blocks: the callables that a node is made of."""
import functools
import inspect
from typing import Any, Callable, Sequence

from pharos.signals import code_of, is_from_signal

_ASYNC = inspect.CO_COROUTINE | inspect.CO_ITERABLE_COROUTINE | inspect.CO_ASYNC_GENERATOR


def check_block(block: Any, what: str, parameters: Sequence[str]) -> Any:
    """``block`` if it can be called with so many arguments (or is None), else TypeError that says
    how it is called."""
    if block is None:
        return None
    call = f"{what.split()[-1]}({', '.join(parameters)})"
    if not callable(block):
        raise TypeError(f'a {what} is called as {call}; {block!r} cannot be called')
    check_runs(block, 'a ' + what)
    try:
        signature = inspect.signature(block)
    except (TypeError, ValueError):
        return block  # some built-in functions do not tell
    try:
        signature.bind(*parameters)
    except TypeError as error:
        raise TypeError(
            f'a {what} is called as {call}; {block!r} does not take that: {error}'
        ) from None
    return block


def check_runs(block: Any, what: str) -> None:
    """Raise TypeError for a function that does not run when it is called: ``async def``, or one
    with ``yield``."""
    function = block
    while isinstance(function, functools.partial):
        function = function.func
    flags = getattr(code_of(function), 'co_flags', 0)
    if flags & _ASYNC:
        raise TypeError(
            f'{what} is called and not awaited, so that {block!r}, which is async, would never run:'
            ' write a plain function that calls asyncio.run_coroutine_threadsafe(coroutine, loop)'
            ' or asyncio.run(coroutine)'
        )
    if flags & inspect.CO_GENERATOR:
        raise TypeError(
            f'{what} is called and not iterated, so that {block!r}, which has a yield, would never'
            ' run: write a plain function; to do something again and again, a soul loops over'
            ' node.every(seconds)'
        )


def check_delegate(block: Any) -> Any:
    """``block`` if it can be a delegate (or is None), else TypeError."""
    return check_block(block, 'delegate', ('message', 'channel'))


def check_soul(block: Any) -> Any:
    """``block`` if it can be a soul (or is None), else TypeError."""
    try:
        return check_block(block, 'soul', ('node',))
    except TypeError as error:
        if not inspect.ismethod(block):
            raise
        raise TypeError(f'{error}. Give {name_of(block)}, whose self is the node') from None


def attempt(function: Callable[[], Any], otherwise: Any = None) -> Any:
    """What ``function()`` returns, or ``otherwise`` where it raises, whatever that is.

    A signal ends the program all the same.
    """
    try:
        return function()
    except BaseException as error:
        if is_from_signal(error):
            raise
        return otherwise


def text_of(thing: Any) -> str:
    """The text of a thing of the user's, whatever its ``__str__`` raises."""
    text: str = attempt(lambda: str(thing), f'<{type(thing).__name__} that cannot be shown>')
    return text


def name_of(block: Any) -> str:
    """How logs name a block."""
    name = attempt(lambda: getattr(block, '__qualname__', None) or repr(block))
    return text_of(name or f'a {type(block).__name__}')
