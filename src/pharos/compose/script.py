"""Scripts: programs of rospy that run unmodified as nodes of this process."""
import ast
import asyncio
import collections
import contextlib
import ctypes
import functools
import os
import pathlib
import re
import signal
import sys
import threading
import time
import tokenize
import traceback
import types
from typing import Any

from rosgraph.names import anonymous_name, get_ros_namespace, load_mappings, ns_join

import pharos
from pharos import program
from pharos.errors import PharosError, UnknownNodeError
from pharos.master import Master
from pharos.node import Lifecycle, Node
from pharos.private_rospy import loader
from pharos.private_rospy.loader import Shim
from pharos.private_rospy.patches import patch
from pharos.private_rospy.run import STOP_LIMIT, Run, join
from pharos.ros_process import find_program

SIGNAL_PATIENCE = 0.2  # seconds that a signal waits for the main thread

#: what catkin puts into a devel space for a script: it runs the file that it names
_WRAPPER = re.compile(r'^python_script = (.+?)$.*exec\(compile\(', re.MULTILINE | re.DOTALL)


@patch('subprocess', 'Popen.__init__')
def start_child(original, run, self, *args, env=None, **kwargs):
    """Gives a child the environment of this process."""
    original(self, *args, env=run.environ if env is None else env, **kwargs)


class ScriptRun(Run):
    """One run of a program.

    At its end these are set, in this order: ``is_stopping`` (somebody wants it to end),
    ``is_signalled`` and ``signal_waits`` (a signal waits for the main thread), ``signal_taken`` (its
    handlers run), ``is_shut`` (hooks run), ``stopping`` (they have run: ``is_shutdown()`` is True),
    ``has_ended`` (the main thread has nothing left to run), ``over`` (threads that are left end).
    """

    error = None  # what the program raised before it was a node
    wanted = None  # the SystemExit that a handler or os._exit() raised
    is_registered = False  # True once rospy.init_node() has registered the node
    is_awaited = True  # False once start() has returned
    is_stopping = False
    is_signalled = False
    is_shut = False
    has_ended = False

    def __init__(self, node):
        node.exit_code = 1  # if it cannot be read
        code = _compiled(node.path)
        self.exits = []  # of atexit
        self.thread_exits = []  # those before it, of threading
        self.awaited = []  # threads that are no daemons
        self.handlers = {}  # of signals
        self.created = []  # nodes that the program has created with pharos
        self.signal_waits, self.signal_taken = threading.Event(), threading.Event()
        self.handling = threading.RLock()  # held while a signal is handled
        super().__init__(node)
        self.main = self.Thread(target=self.run_main, args=[code], name=self.name)
        node.exit_code = None
        self.environ.update(node.env)
        self.argv[0] = node.path
        folder = os.path.dirname(os.path.realpath(node.path))
        self.path.insert(0, folder)
        self.modules.folder = folder
        system = self.modules.modules['sys']
        system.modules = collections.ChainMap(self.modules.modules, sys.modules)
        self.modules.builtins.update(print=self._print, exit=sys.exit, quit=sys.exit)
        self.ros.init_node = self.init_node

    def substitutes(self):
        """Return what the program imports instead of some modules of Python."""
        found, run = super().substitutes(), self

        class Thread(self.Thread):
            """One that the program's end waits for, unless it is a daemon; its error is the node's."""

            def __init__(self, *args, **kwargs):
                super().__init__(*args, **kwargs)
                if threading.current_thread() is run.main:  # which is a daemon here alone
                    self.daemon = bool(kwargs.get('daemon'))

            def start(self):
                if not self.daemon:
                    run.awaited.append(self)
                self.run = functools.partial(run.run_thread, self.run)
                super().start()

        found['threading'] = Shim(
            threading,
            Thread=Thread,
            Timer=type('Timer', (Thread, threading.Timer), {}),
            main_thread=lambda: self.main,
            _register_atexit=lambda function: self.thread_exits.append(function),
        )
        found['signal'] = Shim(signal, signal=self._set_handler, getsignal=self._handler_of)
        found['atexit'].register = self._at_exit
        found['atexit'].unregister = lambda function: None
        found['os'].getenv = self.environ.get
        found['os']._exit = self.exit_now
        found['asyncio'] = _Asyncio(self)
        found['pharos'] = _Pharos(self)
        self.streams = NamedLines(sys.__stdout__, self), NamedLines(sys.__stderr__, self)
        found['sys'].stdout, found['sys'].stderr = self.streams
        # a line has the node's name in front
        self.environ['ROSCONSOLE_FORMAT'] = os.environ.get(
            'ROSCONSOLE_FORMAT', '[${severity}] [${time}]: ${message}'
        )
        return found

    def _at_exit(self, function, *args, **kwargs):
        self.exits.append(lambda: function(*args, **kwargs))
        return function

    def _handler_of(self, number):
        default = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        return self.handlers.get(number, default)

    def _set_handler(self, number, handler):
        former = self._handler_of(number)
        self.handlers[number] = handler
        return former

    def _print(self, *values, file=None, **options):
        print(*values, file=file or self.modules.modules['sys'].stdout, **options)

    def print_error(self, error, title=''):
        """Print a traceback, as Python does at the end of a program or thread."""
        self.streams[1].write(title + ''.join(traceback.format_exception(error)))

    def start(self):
        """Run the program until its node is registered, or it has ended, or ``init_timeout``.

        :raises PharosError: if the program raised an exception by then, its cause
        """
        node, main = self.node, self.main
        node._souls[main] = None
        main.start()
        program.wait(lambda: self.is_known or not main.is_alive(), node.init_timeout, node)
        self.is_awaited = False
        if self.error:
            kind = type(self.error) if isinstance(self.error, PharosError) else PharosError
            text = f'{node.path} ended before it was a node: {self.error!r}'
            raise kind(text) from self.error

    @property
    def is_known(self):
        """True if the program has a node of its own, or has created one with pharos."""
        return self.is_registered or bool(self.created)

    def init_node(self, name, argv=None, anonymous=False, disable_signals=False, **options):
        """Register the node; stands in for ``rospy.init_node``."""
        if self.is_registered:
            return
        node = self.node
        name = anonymous_name(name) if anonymous else name
        self.base = load_mappings(self.argv).get('__name', name)
        namespace = get_ros_namespace(self.environ, self.argv)
        self.name = node._name = node.name = ns_join(namespace, self.base)
        asked = options.pop('tcpros_port', 0), options.pop('xmlrpc_port', 0)
        node._ports = tuple(port or known for port, known in zip(asked, node._ports))
        for key, value in node.params.items():
            node._master.parameters[f'{node._name}/{key}'] = value
        super().start(disable_signals=disable_signals, **options)
        self.is_registered = True

    def run_thread(self, target):
        """Run what a thread of the program runs."""
        try:
            target()
        except SystemExit:  # ends a thread alone
            pass
        except Exception as error:
            name = target.__self__.name
            self.print_error(error, f'Exception in thread {name}:\n')
            self.node._keep_failure(error, name)

    def run_main(self, code):
        """Run the program, and what Python does at its end."""
        program.here.node = self.node
        self.modules.modules['__main__'] = main = types.ModuleType('__main__')
        vars(main).update(__file__=self.node.path, __builtins__=self.modules.builtins)
        status = 0
        try:
            exec(code, vars(main))
        except SystemExit as wanted:
            status = self._status(wanted)
        except BaseException as error:
            error.__traceback__ = error.__traceback__.tb_next  # without this method
            self.print_error(error)
            status = 1
            if isinstance(error, KeyboardInterrupt):
                status = -signal.SIGINT
            elif self.is_awaited and not self.is_known:
                self.error = error
            else:
                self.node._keep_failure(error, self.node.path)
        try:
            self._run_all(self.thread_exits)
            self._wait_for_threads()
            self._run_all(self.exits)  # rospy's own was the first to be registered, and comes last
        finally:
            for stream in self.streams:
                stream.flush()
            if self.node._run is self:  # else a late one, and the node runs again
                self.node.exit_code = status if self.wanted is None else self._status(self.wanted)
            self.has_ended = True
            if not self.is_stopping:
                self.end_node()

    def _run_all(self, functions):
        while functions:
            function = functions.pop()
            try:
                function()
            except (Exception, SystemExit, KeyboardInterrupt) as error:
                self.print_error(error)
                self.node._keep_failure(error, function)

    def exit_now(self, status):
        """Stand in for os._exit: end the program, not the process."""
        self.wanted = SystemExit(status)
        self.end_node()
        raise self.wanted

    def _wait_for_threads(self):
        """Wait for the threads that are no daemons; a signal ends this, as with Python."""
        with contextlib.suppress(KeyboardInterrupt, SystemExit):
            while self.awaited and not self.over.is_set():
                self.checkpoint()
                self.awaited[0].join(0.02)
                self.awaited = [thread for thread in self.awaited if thread.is_alive()]

    def _status(self, wanted):
        if isinstance(wanted.code, str):
            self._print(wanted.code, file=self.modules.modules['sys'].stderr)
            return 1
        return wanted.code or 0

    # -- what a signal does

    def sleep(self, seconds):
        """Stand in for ``time.sleep``: a signal ends it; what comes after the end sleeps as usual."""
        if threading.current_thread() is not self.main:
            if not self.stopping.is_set():
                super().sleep(seconds)
            elif self.over.wait(seconds):
                raise SystemExit
        elif self.stopping.is_set() or seconds <= 0:
            time.sleep(seconds)
        else:
            self.signal_waits.wait(seconds)
            self.checkpoint()

    def checkpoint(self):
        """Handle a signal that waits, if this is the main thread, or wait until it is handled."""
        if self.is_signalled and threading.current_thread() is self.main:
            self.handle_signal()

    def handle_signal(self):
        """Call the program's handlers, once."""
        with self.handling:
            if not self.signal_waits.is_set():
                return
            self.signal_waits.clear()
            self.signal_taken.set()
            for number in self._signals():
                handler = self._handler_of(number)
                if handler is signal.default_int_handler:
                    self.end_created()
                if callable(handler):
                    handler(number, None)

    def _signals(self):
        """Return SIGINT; SIGTERM, too, if the program has a handler of its own for this alone."""
        common = signal.default_int_handler, self.core._ros_signal
        interrupt, terminate = map(self._handler_of, (signal.SIGINT, signal.SIGTERM))
        if callable(terminate) and terminate not in common and interrupt in common:
            return [signal.SIGINT, signal.SIGTERM]
        return [signal.SIGINT]

    def _handle_beside(self):
        """Have another thread handle the signal, and return the threads that do."""
        try:
            return [self.start_thread(self.handle_signal_beside)]
        except RuntimeError:  # the interpreter ends, and starts none
            self.handle_signal_beside()
            return []

    def handle_signal_beside(self):
        """Do so while the main thread stands still, or is busy with something else."""
        try:
            self.handle_signal()
        except (Exception, KeyboardInterrupt, SystemExit) as error:  # is meant for the main thread
            if self.created:
                join([self.main], STOP_LIMIT)  # it ends with its nodes
            self.raise_in_main(error)

    def raise_in_main(self, error):
        """Raise an exception in the main thread, at the next line that it runs."""
        if isinstance(error, SystemExit):
            self.wanted = error
        if self.main.is_alive() and not self.has_ended:
            ident = ctypes.c_ulong(self.main.ident)
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ident, ctypes.py_object(type(error)))

    def signal_shutdown(self, reason):
        """Run the program's hooks, and close what rospy has open; stands in for rospy's."""
        if self.is_shut:
            return
        self.is_shut = True
        hooks = self.core._client_shutdown_hooks[:]
        self.core._client_shutdown_hooks.clear()
        for hook in hooks:
            try:
                hook()
            except (Exception, SystemExit) as error:
                if error is self.wanted:  # of exit_now()
                    break
                self.print_error(error)
                self.node._keep_failure(error, hook)
        self.shut_rospy_down(STOP_LIMIT)

    def end_created(self):
        """Stop the nodes that the program has created with pharos."""
        for node in self.created[:]:
            node._end_now()

    def spin(self):
        """Wait until the nodes that the program has created have stopped; stands in for pharos.spin."""
        with contextlib.suppress(KeyboardInterrupt):
            while any(node in program.nodes for node in self.created):
                self.sleep(0.01)
        self.end_created()

    def stop(self, timeout):
        """End the program as Ctrl-C does: its handlers and hooks first, then its main thread."""
        self.is_stopping = True
        if not self.has_ended:
            self.is_signalled = True
            self.signal_waits.set()
            threads = [self.main]
            if not self.signal_taken.wait(SIGNAL_PATIENCE):
                threads += self._handle_beside()
            if join(threads, timeout):
                self.ros.logwarn(f'left behind, since it did not end in time: {self.node.path}')
                self.raise_in_main(SystemExit())
                self.node._souls.pop(self.main)
                self.threads.discard(self.main)
        self.signal_shutdown('stop')
        self.end_created()
        self.over.set()  # threads that are left end at their next sleep
        super().stop(timeout)


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
    _run_class = ScriptRun

    def __init__(self, path: str, args: list[str], params: dict | None = None, env: Any = ()):
        self.path = path
        self.args = self._remappings = args
        self.params = params or {}
        self.env = dict(env)

    def _opens_channels(self):
        """True: its program does."""
        return True

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
        self._stream = stream
        self._run = run
        self._begun = ''  # what is not written of a line
        self._is_within = False  # True if a part of the line is written

    def __getattr__(self, name):
        return getattr(self._stream, name)

    def write(self, text):
        """Write what is complete of the lines."""
        *lines, self._begun = (self._begun + text).split('\n')
        if lines:
            self._write('\n'.join(lines) + '\n')
        return len(text)

    def flush(self):
        """Write the rest, which has no end yet."""
        if self._begun:
            self._write(self._begun)
            self._begun = ''

    def _write(self, text):
        name = f'[{self._run.name}] '
        named = ''.join(f'{name}{line}' for line in text.splitlines(keepends=True))
        if self._is_within:
            named = named.removeprefix(name)
        with contextlib.suppress(
            OSError, ValueError
        ):  # whoever reads it has gone: go on, and stop motors
            self._stream.write(named)
            self._stream.flush()
        self._is_within = not text.endswith('\n')


class _Asyncio(Shim):
    """asyncio; a program's main thread has a loop, as asyncio makes one in the main thread alone."""

    def __init__(self, run):
        super().__init__(asyncio, _run=run, _has_loop=False)

    def __getattr__(self, name):
        if not self._has_loop and threading.current_thread() is self._run.main:
            self._has_loop = True
            asyncio.set_event_loop(asyncio.new_event_loop())
        return super().__getattr__(name)


class _Pharos(Shim):
    """pharos; the nodes that a program creates belong to its entry, and end with it."""

    def __init__(self, run):
        class EntryMaster(Master):
            """A master whose nodes take the name, the namespace and the remappings of the entry."""

            _environ = run.environ
            _first_with: dict = {}

            def __init__(self, url=None, share_connections=None):
                entry = run.node._master
                if share_connections is None:
                    share_connections = entry.share_connections
                super().__init__(url or entry.url, share_connections)

            def _full_name(self, node, name, mappings):
                name = super()._full_name(node, name, mappings)
                for key, value in run.node.params.items():
                    self.parameters[f'{name}/{key}'] = value
                return name

            def create(self, *args, **kwargs):
                node = super().create(*args, **kwargs)
                run.created.append(node)
                return node

        transcript = type(pharos.Transcript)()
        transcript.on_show(run._print)
        super().__init__(pharos, Master=EntryMaster, spin=run.spin, Transcript=transcript)


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


_PYTHON = re.compile(r'#!.*\bpython(3(\.\d+)?)?\b')
#: what shows windows, or takes signals, and so needs the main thread of a process
_NEEDS_MAIN = re.compile(
    r'^[ \t]*(?:import|from)[ \t]+(?:tkinter|PyQt\d|PySide\d|python_qt_binding'
    r'|rqt_\w+|qt_gui|gtk|wx|pygame|turtle)\b'
    r'|\bgi\.require_version\(.Gtk|\bcv2\.(?:imshow|namedWindow)\(|\b(?:plt|pyplot)\.(?:show|pause)\('
    r'|\.add_signal_handler\(|\bsignal\.(?:alarm|setitimer|pause)\(',
    re.MULTILINE,
)
_IMPORT = re.compile(
    r'^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t(]+([\w, ]+)|import[ \t]+([\w.]+))', re.MULTILINE
)


def why_apart(path, is_here=False):
    """Return why a program of a launch file cannot run in this process, as text; '' if it can.

    :param is_here: True: it may show windows
    """
    with open(path, errors='replace') as file:
        if not _PYTHON.match(file.readline(256)):
            return 'it is not a program of Python 3'
    return '' if is_here else needs_main_thread(path)


def needs_main_thread(path):
    """Return why a Python program needs the main thread of a process, as text; '' if it does not.

    Its modules are read, too, if they lie beside it or in a package of the user's.
    """
    files = [pathlib.Path(source_of(path))]
    for file in files:  # it grows meanwhile
        text = re.sub('#.*', '', file.read_text(errors='replace'))
        found = _NEEDS_MAIN.search(text)
        if found:
            return (
                f'it has {found[0].strip()!r}, which needs the main thread; --here overrides this'
            )
        for package, names, module in _IMPORT.findall(text):
            for name in [
                module or package,
                *(f'{package}.{name.strip()}' for name in names.split(',')),
            ]:
                own = _own_file(name, file.parent)
                if own and own not in files:
                    files.append(own)
    return ''


def _own_file(module, folder):
    """Return the file of a module beside a program, or of a package of the user's; None if of others."""
    top, *rest = module.lstrip('.').split('.')  # a relative one lies beside it, too
    if not top:
        return None
    _, folders = loader.home_of(top)
    for place in folder / top, *map(pathlib.Path, folders):
        base = place.joinpath(*rest)
        for file in base.with_suffix('.py'), base / '__init__.py':
            if file.is_file() and not str(file).startswith(('/usr/', '/opt/ros/')):
                return file
    return None


def source_of(path):
    """Return the file with the source of a program: catkin's devel space has a wrapper."""
    with open(path, errors='replace') as file:
        wrapper = _WRAPPER.search(file.read(4000))
    return str(ast.literal_eval(wrapper[1])) if wrapper else path


def load(
    master,
    package,
    executable=None,
    *args,
    name=None,
    namespace=None,
    remap=None,
    params=None,
    here=False,
):
    """Do what :meth:`Master.load` does."""
    path = os.path.abspath(package) if executable is None else find_program(package, executable)
    if not os.path.isfile(path):
        raise UnknownNodeError(f'there is no file {path}: give a path, or a package and a program')
    reason = '' if here else needs_main_thread(path)
    if reason:
        raise PharosError(
            f'{path} needs a process of its own, since {reason}: start it by master.run(),'
            ' or load(..., here=True)'
        )
    arguments = [*map(str, args), *(f'{a}:={b}' for a, b in (remap or {}).items())]
    arguments += [f'__name:={name.rpartition("/")[2]}'] if name else []
    # until it calls init_node, it is called after its file
    named = name or re.sub(r'\W|^(?=[^A-Za-z])', 'x', os.path.basename(path).removesuffix('.py'))
    named = ns_join(namespace, named) if namespace else named
    return master.create(ScriptNode, named, path=source_of(path), args=arguments, params=params)
