"""Blocks: the callables that a node is made of, and the souls among them that run in threads of
their own."""
import functools
import inspect
import threading

from pharos import running
from pharos.errors import NodeStoppedError
from pharos.signals import code_of, is_from_signal

_ASYNC = inspect.CO_COROUTINE | inspect.CO_ITERABLE_COROUTINE | inspect.CO_ASYNC_GENERATOR


def check_block(block, what, parameters):
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


def check_runs(block, what):
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


def check_delegate(block):
    """``block`` if it can be a delegate (or is None), else TypeError."""
    return check_block(block, 'delegate', ('message', 'channel'))


def check_soul(block):
    """``block`` if it can be a soul (or is None), else TypeError."""
    try:
        return check_block(block, 'soul', ('node',))
    except TypeError as error:
        if not inspect.ismethod(block):
            raise
        raise TypeError(f'{error}. Give {name_of(block)}, whose self is the node') from None


def attempt(function, otherwise=None):
    """What ``function()`` returns, or ``otherwise`` where it raises, whatever that is.

    A signal ends the program all the same.
    """
    try:
        return function()
    except BaseException as error:
        if is_from_signal(error):
            raise
        return otherwise


def text_of(thing):
    """The text of a thing of the user's, whatever its ``__str__`` raises."""
    return attempt(lambda: str(thing), f'<{type(thing).__name__} that cannot be shown>')


def name_of(block):
    """How logs name a block."""
    name = attempt(lambda: getattr(block, '__qualname__', None) or repr(block))
    return text_of(name or f'a {type(block).__name__}')


class Souls:
    """The souls of one node that run: in threads of their own, or in a thread of the user's."""

    def __init__(self, node):
        self._node = node
        self._threads = set()
        self._here = threading.local()  # .depth: how many souls of the node run in this thread

    def run(self, block, present):
        """Run a soul in this thread; an exception in it is reported and ends nothing else.

        :param present: ``present()`` is the soul as it is then, to be run in its place again
        """
        self._here.depth = self._depth() + 1
        try:
            with self._node._live_rospy().interrupts_waits():
                return block(self._node)
        except BaseException as error:
            self._node._report(
                error, block, 'soul', again=lambda nothing: self.run(present(), present)
            )
            return None
        finally:
            self._here.depth -= 1

    def fork(self, block, present, name, start_thread):
        """Run a soul in a thread of its own, and return the thread."""
        known = threading.Event()

        def run():
            known.wait()
            try:
                self.run(block, present)
            finally:
                self._threads.discard(threading.current_thread())

        thread = start_thread(run, name=name)
        self._threads.add(thread)
        known.set()
        return thread

    def end(self, timeout):
        """Wait for all but this thread's, up to ``timeout`` seconds; returns the threads that went
        on."""
        threads = [
            thread for thread in tuple(self._threads) if thread is not threading.current_thread()
        ]
        running.join(threads, timeout)
        return [thread for thread in threads if thread.is_alive()]

    def end_here(self):
        """End the soul that runs in this thread, if one does."""
        if self._depth():
            raise NodeStoppedError(f'{self._node.name} stops, and this soul with it')

    def _depth(self):
        return getattr(self._here, 'depth', 0)
