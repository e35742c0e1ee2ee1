"""Blocks: the callables that a node is made of, and what else users give that can be checked."""
import functools
import inspect
import reprlib
from typing import Any, Callable, Optional, Sequence, Tuple

from pharos.signals import code_of, is_from_signal

#: what a user gives to be run
Block = Callable[..., Any]

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


def check_filler(
    block: Any, find_class: Callable[[], Any] = lambda: None, what: str = 'message'
) -> None:
    """Raise TypeError for what cannot fill a message, and say what does.

    :param find_class: finds the class of the message, for what is said
    :param what: 'message' or 'request'
    """
    if isinstance(block, dict):
        return
    if isinstance(block, type) or not (block is None or callable(block)):
        names: Sequence[str] = getattr(attempt(find_class), '__slots__', ())
        meant = 'give the value of a field by its name, as a keyword'
        if len(names) == 1 and not isinstance(block, type):
            meant += f': {names[0]}={reprlib.repr(block)}'
        elif isinstance(block, (str, type)):
            meant = f'give a type as typed_as=, and {meant[5:]}'
        raise TypeError(
            f'a {what} is given ready, or filled by keywords, a dict of fields, or a block, called'
            f' as block({what}); {reprlib.repr(block)} cannot be called: {meant}'
        )
    check_block(block, 'block', (what,))


def _check_no_class(block: Any, what: str) -> None:
    if isinstance(block, type):
        raise TypeError(
            f'a {what} is a function, or another thing that can be called, and not the class'
            f' {block!r}, of which each call makes another object: give {block.__name__}(...)'
        )


def check_delegate(block: Any) -> Any:
    """``block`` if it can be a delegate (or is None), else TypeError."""
    _check_no_class(block, 'delegate')
    return check_block(block, 'delegate', ('message', 'channel'))


def check_soul(block: Any) -> Any:
    """``block`` if it can be a soul (or is None), else TypeError."""
    _check_no_class(block, 'soul')
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


class BlockOf:
    """A block that was given to a node: where it is a method of the node's class, the one of that
    name of the class that the node has by now."""

    def __init__(self, node: Any, block: Any, is_soul: bool = False) -> None:
        self._node, self.given = node, block
        #: the name of the method; None: it is none of the class
        self.method, is_wrapped = _method_of(node, block)
        # What is called without the node is called with it where it has become a plain method. A
        # soul gets the node in any case.
        is_bound = inspect.ismethod(block) and block.__self__ is node
        self._binds = is_bound or is_wrapped and not is_soul

    @property
    def now(self) -> Any:
        """The block; the one that was given where the class has no such method any more."""
        block = self.as_of(type(self._node))
        return self.given if block is None else block

    def as_of(self, node_class: type) -> Any:
        """What it is when the node has that class; None where that has no such method."""
        if self.method is None:
            return self.given
        value = inspect.getattr_static(node_class, self.method, None)
        bind = getattr(type(value), '__get__', None)
        return bind(value, self._node if self._binds else None, node_class) if bind else value


def _method_of(node: Any, block: Any) -> Tuple[Optional[str], bool]:
    """The name of the method of the node's class that the block is, and whether that is a static
    or class method; None if it is none."""
    function = block
    if inspect.ismethod(block):
        function = block.__func__
        if block.__self__ is not node and not isinstance(block.__self__, type):
            return None, False  # a method of something else
    for owner in type(node).__mro__:
        for name, value in vars(owner).items():
            is_wrapped = isinstance(value, (staticmethod, classmethod))
            other = value.__func__ if is_wrapped else value
            if other is function or _is_reloaded(function, other):
                return name, is_wrapped
    return None, False


def _is_reloaded(function: Any, other: Any) -> bool:
    """Whether the other function comes from the same place, and a reload of that has made it."""
    if not (inspect.isfunction(function) and inspect.isfunction(other)):
        return False
    names = function.__module__, function.__qualname__
    return names == (other.__module__, other.__qualname__)


def check_flag(name: str, value: Any, hint: str = '') -> bool:
    """``value`` if it is True or False, else ValueError."""
    if not attempt(lambda: value in (True, False), False):  # numpy compares each of an array
        raise ValueError(f'{name} is True or False, not {value!r}{hint}')
    return bool(value)
