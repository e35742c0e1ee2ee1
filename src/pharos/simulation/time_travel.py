"""The prompt of ``compose --at``: the whole robot stands still at one time, to look at and to debug."""
from __future__ import annotations

import code
import gc
import pdb
import signal
import sys
import weakref
from typing import Any, Callable

from pharos.errors import PharosError, UnknownNodeError, UnknownTopicError
from pharos.live.editing import editable_modules
from pharos.names import full_name

LIMIT = 600.0  # seconds of ROS time
HELP = (
    "It stands still. at(20), at(3) back, node('/x').name, topic('/t'), step('/x'),\n"
    "until(lambda: node('/x').n > 3); now: the time. Ctrl-D ends all."
)


class Program:
    """A node's program: its names as attributes, also those in running functions and in its objects.

    :param node: the node
    """

    def __init__(self, node):
        self._run = node._current_run
        modules = [self._run.modules.by_name.get('__main__'), *editable_modules(node)]
        self._scopes = [vars(module) for module in modules if module]
        self._find_objects()

    def has(self, frame):
        """True if a frame runs a function of the program, or of its package."""
        return any(frame.f_globals is scope for scope in self._scopes)

    def _find_objects(self):
        """Find the objects of the program's classes; this takes long."""
        names = {scope['__name__'] for scope in self._scopes}
        values = [value for scope in self._scopes for value in scope.values()]
        classes = {
            each
            for each in values
            if isinstance(each, type) and each.__module__ in names and each.__weakrefoffset__
        }
        self._objects = [weakref.ref(each) for each in gc.get_objects() if type(each) in classes]

    def _places(self):
        """Yield dicts of names and values: of modules, of running functions, of objects."""
        yield from self._scopes
        for thread in list(self._run.threads):
            frame = sys._current_frames().get(thread.ident)
            while frame:
                if self.has(frame):
                    yield frame.f_locals
                frame = frame.f_back
        for reference in self._objects:
            yield getattr(reference(), '__dict__', {})

    def __dir__(self):
        self._find_objects()
        return sorted({name for place in self._places() for name in place})

    def __getattr__(self, name):
        for _ in range(2):
            for place in self._places():
                if name in place:
                    return place[name]
            self._find_objects()  # it may be an attribute of a new one
        raise AttributeError(f'the program has no {name}: dir() lists what it has')


class Debugger(pdb.Pdb):
    """The debugger of a step: ``c``, ``q`` and the return of the frame lead back to the prompt.

    If there are breakpoints (``b 60``), ``c`` and the return lead on to the next one in this thread.
    """

    def __init__(self, simulation):
        super().__init__(nosigint=True, skip=['pharos.*'])
        self._simulation = simulation
        self.prompt = '(step) '

    def begin(self, frame):
        """Debug a frame, and what it calls."""
        self.reset()
        self.botframe = caller = frame
        while caller:  # it may have a breakpoint, too
            caller.f_trace = self.trace_dispatch
            caller = caller.f_back
        self.set_next(frame)
        sys.settrace(self.trace_dispatch)

    def user_return(self, frame, value):
        super().user_return(frame, value)
        if frame is self.botframe:
            self.set_continue()

    def set_continue(self):
        super().set_continue()
        if not self.breaks:
            self._simulation.wake()

    def set_quit(self):
        self.clear_all_breaks()
        self.set_continue()


class Prompt:
    """Goes to times of a simulation, and shows the nodes.

    :param go_back: ``go_back(seconds)`` begins anew, and opens the prompt at that time
    """

    def __init__(self, simulation, go_back):
        self._simulation = simulation
        self._go_back = go_back
        self._programs: dict[Any, Program] = {}  # by their runs
        functions = self.at, self.node, self.topic, self.step, self.until
        self._names: dict[str, Any] = {each.__name__: each for each in functions}

    def interact(self) -> None:
        """Open the prompt; return at its end."""
        text = f'{self._simulation.seconds:.3f} s. {HELP}'
        self._stand_still()
        try:
            import IPython
        except ImportError:
            import readline  # noqa: F401: input() has a history then

            code.interact(text, local=self._names, exitmsg='')
        else:
            IPython.embed(banner1=text, user_ns=self._names, confirm_exit=False)
        finally:  # the end is virtual, too
            self._simulation.resume()

    def _stand_still(self):
        """End what :meth:`_run` has begun; Ctrl-C clears the line."""
        self._names['now'] = self._simulation.seconds
        self._simulation.pause()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def _run(self, block, *args):
        """Call a block while the robot may move; Ctrl-C stops the robot."""
        self._simulation.resume()
        signal.signal(signal.SIGINT, lambda *_: self._simulation.wake())
        try:
            return block(*args)
        finally:
            self._stand_still()

    def at(self, seconds: float) -> None:
        """Go to a time: on from here, or back, by a new process that does the same."""
        is_back = seconds < self._simulation.seconds
        self._run(self._go_back if is_back else self._simulation.at, seconds)

    def node(self, name: str) -> Any:
        """Return the program of a node, with its names as attributes; or the node, if made with pharos."""
        node = self._find(name)
        run = node._current_run
        if not hasattr(run, 'main'):
            return node
        if run not in self._programs:
            self._programs[run] = Program(node)
        return self._programs[run]

    def _find(self, name):
        nodes = {node.name: node for node in self._simulation.master.own_nodes()}
        name = full_name(name)
        if name not in nodes:
            raise UnknownNodeError(f'there is no node {name} now: there are {", ".join(nodes)}')
        return nodes[name]

    def topic(self, name: str) -> Any:
        """Return the last message of a topic."""
        messages = self._simulation.last_messages
        name = full_name(name)
        if name not in messages:
            raise UnknownTopicError(f'{name} had no message; these had: {", ".join(messages)}')
        return messages[name]

    def until(self, predicate: Callable[[], Any], limit: float = LIMIT) -> bool:
        """Go on to the first moment at which ``predicate()`` is true.

        :param limit: seconds of ROS time
        :returns: False if it does not become true
        """
        return self._run(self._simulation.run_to, predicate, limit)

    def step(self, name: str, limit: float = LIMIT) -> None:
        """Open the debugger at the next line that a node runs, while all others stand still.

        :param limit: seconds of ROS time
        :raises PharosError: with Python 3.14, whose debugger loses the next line
        """
        if sys.version_info >= (3, 14):
            raise PharosError(
                'step() needs an older Python than 3.14: write breakpoint() at the line'
            )
        program = Program(self._find(name))
        simulation = self._simulation
        debugger = Debugger(simulation)

        def trace(frame, event, argument):
            if simulation.on_turn is not look:  # the debugger has begun in another thread
                sys.settrace(None)
            elif program.has(frame):
                simulation.on_turn = None
                debugger.begin(frame)
                if event == 'call':
                    return debugger.trace_dispatch  # at the first line
                return debugger.trace_dispatch(frame, event, argument)

        def look() -> None:
            sys.settrace(trace)
            frame: Any = sys._getframe()
            while frame:
                if program.has(frame):
                    frame.f_trace = trace
                frame = frame.f_back

        simulation.on_turn = look
        self._run(simulation.run, limit)
        if simulation.on_turn is not None:
            simulation.on_turn = None
            print(f'{name} has run no line of its program in {limit:g} s')
