"""Scripts: programs of rospy that run unmodified as nodes of this process."""
import ast
import collections
import contextlib
import ctypes
import os
import re
import signal
import sys
import threading
import tokenize
import types
from typing import Any

from rosgraph.names import anonymous_name, get_ros_namespace, load_mappings, ns_join

from pharos import program
from pharos.errors import PharosError, UnknownNodeError
from pharos.node import Lifecycle, Node
from pharos.private_rospy.loader import Shim
from pharos.private_rospy.patches import patch
from pharos.private_rospy.run import Run
from pharos.ros_process import find_program

#: what catkin puts into a devel space for a script: it runs the file that it names
_WRAPPER = re.compile(r'^python_script = (.+?)$.*exec\(compile\(', re.MULTILINE | re.DOTALL)


@patch('subprocess', 'Popen.__init__')
def start_child(original, run, self, *args, env=None, **kwargs):
    """Gives a child the environment of this process."""
    original(self, *args, env=run.environ if env is None else env, **kwargs)


class ScriptRun(Run):
    """One run of a program."""

    is_registered, is_awaited, error, wanted = False, True, None, None

    def __init__(self, node):
        code = _compiled(node.path)
        self.exits, self.awaited, self.handlers = [], [], {}
        super().__init__(node)
        self.main = self.Thread(target=self.run_main, args=[code], name=self.name)
        node.exit_code = None
        self.environ.update(node.env)
        self.argv[0] = node.path
        system = self.modules.modules['sys']
        system.path = self.modules.path = [os.path.dirname(os.path.realpath(node.path)), *sys.path]
        system.modules = collections.ChainMap(self.modules.modules, sys.modules)
        self.modules.builtins['print'] = self._print
        self.exits.clear()  # rospy's own
        self.ros.init_node = self.init_node

    def substitutes(self):
        """Return what the program imports instead of some modules of Python."""
        found, run = super().substitutes(), self

        class Thread(self.Thread):
            """One that the program's end waits for, unless it is a daemon."""

            def __init__(self, *args, **kwargs):
                super().__init__(*args, **kwargs)
                self.daemon = bool(kwargs.get('daemon'))  # not as the program's thread is

            def start(self):
                if not self.daemon:
                    run.awaited.append(self)
                super().start()

        found['threading'] = Shim(
            threading,
            Thread=Thread,
            Timer=type('Timer', (Thread, threading.Timer), {}),
            main_thread=lambda: self.main,
            _register_atexit=lambda function: self.exits.append(function),
        )
        found['signal'] = Shim(
            signal,
            signal=self._set_handler,
            getsignal=lambda number: self.handlers.get(number, signal.SIG_DFL),
        )
        found['atexit'].register = self._at_exit
        found['atexit'].unregister = lambda function: None
        found['os'].getenv = self.environ.get
        for name in 'stdout', 'stderr':
            vars(found['sys'])[name] = NamedLines(getattr(sys, f'__{name}__'), self)
        return found

    def _at_exit(self, function, *args, **kwargs):
        self.exits.append(lambda: function(*args, **kwargs))
        return function

    def _set_handler(self, number, handler):
        former = self.handlers.get(number, signal.SIG_DFL)
        self.handlers[number] = handler
        return former

    def _print(self, *values, file=None, **options):
        print(*values, file=file or self.modules.modules['sys'].stdout, **options)

    def start(self):
        """Run the program until its node is registered, or it has ended, or ``init_timeout``.

        :raises PharosError: if the program raised an exception by then, its cause
        """
        node, main = self.node, self.main
        node.souls[main] = None
        main.start()
        program.wait(lambda: self.is_registered or not main.is_alive(), node.init_timeout, node)
        self.is_awaited = False
        if self.error:
            kind = type(self.error) if isinstance(self.error, PharosError) else PharosError
            text = f'{node.path} ended before it was a node: {self.error!r}'
            raise kind(text) from self.error

    def init_node(self, name, argv=None, anonymous=False, disable_signals=False, **options):
        """Register the node; stands in for ``rospy.init_node``."""
        if self.is_registered:
            return
        node = self.node
        name = anonymous_name(name) if anonymous else name
        self.base = load_mappings(self.argv).get('__name', name)
        namespace = get_ros_namespace(self.environ, self.argv)
        self.name = node.name = ns_join(namespace, self.base)
        node.tcp_port = options.pop('tcpros_port', 0) or node.tcp_port
        node.xmlrpc_port = options.pop('xmlrpc_port', 0) or node.xmlrpc_port
        for key, value in node.params.items():
            node.master.parameters[f'{node.name}/{key}'] = value
        super().start(**options)
        self.is_registered = True

    def run_main(self, code):
        """Run the program, and what Python does at its end."""
        self.modules.modules['__main__'] = main = types.ModuleType('__main__')
        vars(main).update(__file__=self.node.path, __builtins__=self.modules.builtins)
        status = 0
        try:
            exec(code, vars(main))
        except SystemExit as wanted:
            status = self._status(wanted)
        except BaseException as error:
            status = 1
            error.__traceback__ = error.__traceback__.tb_next  # without this method
            if self.is_awaited and not self.is_registered:
                self.error = error
            else:
                self.node.report(error, self.node.path, 'script')
        for function in reversed(self.exits):
            try:
                function()
            except Exception as error:
                self.node.report(error, function, 'atexit')
        while self.awaited and not self.stopping.is_set():  # the stop ends what rospy receives
            self.awaited[0].join(0.05)
            self.awaited = [thread for thread in self.awaited if thread.is_alive()]
        self.node.exit_code = status if self.wanted is None else self._status(self.wanted)
        if not self.stopping.is_set():
            self.end_node()

    def _status(self, wanted):
        if isinstance(wanted.code, str):
            self._print(wanted.code, file=self.modules.modules['sys'].stderr)
            return 1
        return wanted.code or 0

    def stop(self, timeout):
        """End the program: its on_shutdown, its handler of a signal, its main thread."""
        for hook in self.core._client_shutdown_hooks:
            with contextlib.suppress(Exception):
                hook()
        self.core._client_shutdown_hooks.clear()
        handlers = [each for each in self.handlers.items() if callable(each[1])]
        for number, handler in handlers[:1] if self.main.is_alive() else ():
            try:
                handler(number, None)
            except SystemExit as wanted:
                self.wanted = wanted
        super().stop(timeout)
        if self.main.is_alive() and self.main is not threading.current_thread():
            ident = ctypes.c_ulong(self.main.ident)
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ident, ctypes.py_object(SystemExit))


class ScriptNode(Node):
    """A program of rospy, unmodified, as a node of this process; made by :meth:`Master.load`.

    A start runs it from its first line, in a thread of its own; its ``rospy.init_node``
    registers the node. :meth:`stop` ends it. The node stops when the program has ended.

    :ivar path: the file of the program
    :ivar args: its arguments, ROS's among them
    :ivar exit_code: what its process would have ended with; None while it runs
    """

    #: seconds that a start waits for the program to call ``rospy.init_node``, or to end
    init_timeout = 10.0
    #: seconds that :meth:`stop` waits for the program, as long as roslaunch waits after its SIGINT
    stop_timeout = 15.0
    exit_code: int | None = None
    launched: Any = None  # roslaunch's node, if a launch file named it
    run_class = ScriptRun

    def __init__(self, path: str, args: list[str], params: dict | None = None, env: Any = ()):
        self.path, self.args, self.remappings = path, args, args
        self.params, self.env = params or {}, dict(env)

    def start(self) -> None:
        """Run the program, which opens its channels itself."""
        super().start()

    def wait(self, timeout: float | None = None) -> int | None:
        """Wait until it has ended, and return its :attr:`exit_code`.

        :param timeout: seconds, None: without limit
        :raises TimeoutError: if it has not in that time
        """
        wait_for_end(lambda: self.lifecycle is Lifecycle.STOPPED, timeout, self.name)
        return self.exit_code


class NamedLines:
    """A stream that puts the node's name before each line."""

    def __init__(self, stream, run):
        self._stream, self._run, self._begun = stream, run, ''

    def __getattr__(self, name):
        return getattr(self._stream, name)

    def write(self, text):
        """Write what is complete of the lines."""
        *lines, self._begun = (self._begun + text).split('\n')
        self._stream.write(''.join(f'[{self._run.name}] {line}\n' for line in lines))
        self._stream.flush()
        return len(text)


def wait_for_end(predicate, timeout, name):
    """Wait until ``predicate()`` is true, or Ctrl-C; raise TimeoutError if it is not in time."""
    with program.quiet_wait():
        if not program.wait(predicate, timeout):
            raise TimeoutError(f'{name} has not ended within {timeout:g} s: stop() it')


def _compiled(path):
    try:
        with tokenize.open(path) as file:
            return compile(file.read(), path, 'exec', dont_inherit=True)
    except (SyntaxError, ValueError, OSError) as error:
        raise PharosError(
            f'{path} cannot be read as Python 3: {error}; master.run() starts others'
        ) from error


def source_of(path):
    """Return the file with the source of a program: catkin's devel space has a wrapper."""
    with open(path, errors='replace') as file:
        wrapper = _WRAPPER.search(file.read(4000))
    return str(ast.literal_eval(wrapper[1])) if wrapper else path


def load(
    master, package, executable=None, *args, name=None, namespace=None, remap=None, params=None
):
    """Do what :meth:`Master.load` does."""
    path = os.path.abspath(package) if executable is None else find_program(package, executable)
    if not os.path.isfile(path):
        raise UnknownNodeError(f'there is no file {path}: give a path, or a package and a program')
    arguments = [*map(str, args), *(f'{a}:={b}' for a, b in (remap or {}).items())]
    arguments += [f'__name:={name.rpartition("/")[2]}'] if name else []
    # until it calls init_node, it is called after its file
    named = name or re.sub(r'\W|^(?=[^A-Za-z])', 'x', os.path.basename(path).removesuffix('.py'))
    named = ns_join(namespace, named) if namespace else named
    return master.create(ScriptNode, named, path=source_of(path), args=arguments, params=params)
