"""One run of a script: the program in a thread, with stand-ins for parts of a process.

These are signals, atexit, sys.argv, the output, the environment, and the main thread.
"""
from __future__ import annotations

import collections
import contextlib
import ctypes
import functools
import gc
import os
import signal
import socket
import sys
import threading
import time
import traceback
import types
from threading import ExceptHookArgs
from typing import Any
from weakref import WeakSet, WeakValueDictionary

from rosgraph import get_master_uri
from rosgraph.names import anonymous_name, get_ros_namespace, load_mappings, ns_join

from pharos import signals
from pharos.blocks import Block, block_name
import pharos.compose.event_loops  # noqa: F401: it changes asyncio
from pharos.compose.child_process import interrupt
from pharos.compose.sources import compile_program
from pharos.errors import NodeNameInUseError, PharosError
from pharos.live import private_classes
from pharos.live.editing import editable_modules
from pharos.private_rospy import loader
from pharos.private_rospy.loader import Shim, remember_text
from pharos.private_rospy.patches import patch
from pharos.private_rospy.plain import guide
from pharos.private_rospy.run import STOP_LIMIT, Lifecycle, Run, items_of, join
from pharos.transcript import Transcript
from pharos.waiting import current, wait

SIGNAL_LIMIT = 0.2  # seconds that a signal waits for the main thread to sleep
BLOCK_LIMIT = 1.0  # seconds that a thread has to end after an exception in it
JOIN_PERIOD = 0.02  # seconds between two looks for a signal
SPIN_PERIOD = 0.01  # seconds
COLOR_END = '\x1b[0m'  # as rospy writes it
#: files whose frames tracebacks do not show
_HIDDEN = '<frozen importlib', loader.__file__, private_classes.__file__, __file__


@patch('subprocess', 'Popen.__init__')
def start_child(
    original: Block, run: Any, self: Any, *args: Any, env: Any = None, **kwargs: Any
) -> None:
    """Python gives a child the environment of this process. This passes on the program's.

    The end of a composed program interrupts the child, as roslaunch and a terminal do.
    """
    original(self, *args, env=run.environ if env is None else env, **kwargs)
    former_children = getattr(run, 'children', ())
    # not poll(), which waits in virtual time
    run.children = [self, *(each for each in former_children if each._internal_poll() is None)]


class ScriptRun(Run):
    """One run of a program.

    "The main thread" is the thread that runs the program. It is one of the run's ``souls`` until the
    program and its exit functions have ended. A stop sets the following attributes, in this order, if the
    main thread ends in time.

    :ivar pending_signal: a signal waits for the main thread; clear while the program's handlers run
    :ivar has_run_hooks: True: the hooks of rospy.on_shutdown() run, or have run
    :ivar stopping: ``is_shutdown()`` is True
    :ivar finished: threads left behind end
    """

    # the SystemExit that a handler or os._exit() has raised, or the stop of a late main thread
    exit_request: SystemExit | None = None
    is_registered = False  # True once rospy.init_node() has registered the node
    has_run_hooks = False

    def __init__(self, node: Any, settings: Any) -> None:
        node.exit_code = 1  # stays if the program cannot be read
        code = compile_program(node.path)
        node.exit_code = None
        self.process_id = os.getpid()  # os.fork() makes another one
        self.children = []  # processes, as subprocess.Popen
        self.exit_functions = []  # of atexit
        self.thread_exit_functions = []  # of threading._register_atexit, which run before
        self.event_loops = WeakSet()  # of asyncio
        self.threads_to_join = set()  # those that are not daemons
        self.handlers = {}  # number of a signal -> the program's handler
        self.created_nodes = []  # the nodes that the program has created with pharos
        self.pending_signal = threading.Event()
        self.handler_lock = threading.RLock()  # held while a signal is handled
        super().__init__(node, settings)
        self.main = self.Thread(target=self.run_main, args=[code], name=self.name)
        self.environ.update(node.env)
        self.argv[0] = node.path
        folder = os.path.dirname(os.path.realpath(node.path))
        self.path.insert(0, folder)
        self.modules.program_folder = folder
        self.own_sys = self.modules.by_name[
            'sys'
        ]  # the table is empty at the end, when a __del__ prints
        self.own_sys.modules = collections.ChainMap(self.modules.by_name, sys.modules)
        self.modules.builtins.update(print=self.print, exit=sys.exit, quit=sys.exit)
        self.ros.init_node = self.init_node

    def substitutes(self) -> dict[str, Any]:
        """Return the stand-ins that the program imports for some modules of Python."""
        # without ${node}: NamedLines puts the node's name in front
        self.environ['ROSCONSOLE_FORMAT'] = os.environ.get(
            'ROSCONSOLE_FORMAT', '[${severity}] [${time}]: ${message}'
        )
        if self.node.owns_process:  # code in C and shared modules see the program's variables
            os.environ.update(self.environ)
            self.environ = os.environ
        stand_ins = super().substitutes()
        run = self

        class Thread(self.Thread):
            """A thread of the program. The program's end waits for the thread if not a daemon."""

            def __init__(self, *args: Any, **kwargs: Any) -> None:
                super().__init__(*args, **kwargs)
                # all threads of a run are daemons, and would pass that on; these would not be in a process
                if threading.current_thread() in (run.main, *run.threads_to_join):
                    self.daemon = bool(kwargs.get('daemon'))

            def start(self) -> None:
                if not self.daemon:
                    run.threads_to_join.add(self)
                super().start()

        stand_ins['threading'] = Shim(
            threading,
            Thread=Thread,
            Timer=type('Timer', (Thread, threading.Timer), {}),
            main_thread=lambda: self.main,
            excepthook=self._print_thread_error,
            _register_atexit=self.thread_exit_functions.append,
        )
        stand_ins['signal'] = Shim(signal, signal=self._set_handler, getsignal=self._handler_of)
        stand_ins['atexit'].register = self._register_at_exit
        stand_ins['atexit'].unregister = lambda function: None
        stand_ins['os'].getenv = self.environ.get
        stand_ins['os']._exit = self.exit_now
        stand_ins['os'].kill = self._kill
        stand_ins['pharos'] = _Pharos(self)
        self.stdout = NamedLines(sys.__stdout__, self)
        self.stderr = NamedLines(sys.__stderr__, self)
        if self.node.output_file:
            with contextlib.suppress(OSError):  # the terminal has it, if the folder is gone
                self.stdout = open(self.node.output_file, 'a', buffering=1)
        stand_ins['sys'].stdout = self.stdout
        stand_ins['sys'].stderr = self.stderr
        stand_ins['sys'].excepthook = self.print_error
        return stand_ins

    def _kill(self, process_id: int, number: int) -> None:
        """Stand in for ``os.kill``: a signal to its own process stops the program alone."""
        if process_id == os.getpid() and number in (signal.SIGINT, signal.SIGTERM):
            self.request_stop()
        else:
            os.kill(process_id, number)

    def _register_at_exit(self, function: Block, *args: Any, **kwargs: Any) -> Block:
        self.exit_functions.append(functools.partial(function, *args, **kwargs))
        return function

    def _tell_left_threads(self) -> None:
        left_threads = join({*self.threads, self.main}, BLOCK_LIMIT)
        if left_threads:
            names = ', '.join(thread.name for thread in left_threads)
            Transcript.show(f'{self.name} leaves threads that block, with what they use: {names}')

    def _handler_of(self, number: int) -> Any:
        default = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        return self.handlers.get(number, default)

    def _set_handler(self, number: int, handler: Any) -> Any:
        former_handler = self._handler_of(number)
        self.handlers[number] = handler
        return former_handler

    def print(self, *values: object, file: Any = None, **options: Any) -> None:
        """Stand in for ``print``: write to the program's own sys.stdout, not to the process's."""
        print(*values, file=file or self.own_sys.stdout, **options)

    def print_error(
        self, error_class: Any, error: BaseException, trace: Any, title: str = ''
    ) -> None:
        """Stand in for ``sys.excepthook``: print a traceback, without the frames of pharos."""
        summary = traceback.TracebackException(error_class, error, trace)
        summary.stack[:] = [each for each in summary.stack if not each.filename.startswith(_HIDDEN)]
        self.stderr.write(title + ''.join(summary.format()))

    def _print_thread_error(self, args: Any) -> None:
        """Stand in for ``threading.excepthook``."""
        self.print_error(*args[:3], f'Exception in thread {args.thread.name}:\n')  # type: ignore

    # -- start

    def start(self) -> None:  # type: ignore[override]
        """Start the program, and wait until its node is registered.

        Return at the end of the program, too, and after the node's ``init_timeout``. The program
        goes on in the main thread.

        :raises PharosError: if the program raised an exception before it was a node
        """
        node = self.node
        self.souls[self.main] = self.name, None, False
        self.main.start()
        wait(lambda: self.is_known or not self.main.is_alive(), node.init_timeout, node)
        errors = [failure.error for failure in self.failures if failure.block == node.path]
        if errors and not self.is_known:
            if isinstance(errors[-1], PharosError):
                raise errors[-1]
            text = f'{node.path} ended before it was a node: {errors[-1]!r}'
            raise PharosError(text) from errors[-1]

    @property
    def is_known(self) -> bool:
        """True if the program has a node of its own, or has created one with pharos."""
        return self.is_registered or bool(self.created_nodes)

    def init_node(
        self,
        name: str,
        argv: Any = None,
        anonymous: bool = False,
        log_level: int | None = None,
        *,
        disable_signals: bool = False,
        **options: Any,
    ) -> None:
        """Stand in for ``rospy.init_node``: give the node its name, and register the node.

        A second call does nothing.

        :raises NodeNameInUseError, PortInUseError, MasterUnreachableError: as for a start
        """
        if self.is_registered:
            return
        if anonymous:
            name = anonymous_name(name)
        settings = self.settings
        url = get_master_uri(self.environ, self.argv)
        master = type(self.master)(url, self.master.shared_memory, self.master.share_connections)
        if master != self.master:
            settings.master = self.node.master = master
        self.base_name = load_mappings(self.argv).get('__name', name)
        settings.name = ns_join(get_ros_namespace(self.environ, self.argv), self.base_name)
        self.node.name = self.name
        settings.ports = options.pop('tcpros_port', 0), options.pop('xmlrpc_port', 0)
        for parameter_name, value in self.node.params.items():
            self.master.parameters[f'{self.name}/{parameter_name}'] = value
        super().start(disable_signals=disable_signals, log_level=log_level, **options)
        self.is_registered = True

    # -- the program

    def run_thread(self, thread: threading.Thread, target: Block) -> None:
        """Run the target of a thread; show and keep its exception."""
        try:
            super().run_thread(thread, target)
        except Exception as error:
            if self.lifecycle is Lifecycle.STOPPED:
                return  # the hook is gone with the program
            self.keep_failure(error, thread.name)
            hook = self.modules.by_name['threading'].excepthook
            hook(ExceptHookArgs([type(error), error, error.__traceback__, thread]))
        finally:
            self.threads_to_join.discard(thread)

    def run_main(self, code: types.CodeType) -> None:
        """Run the program to its end, with its threads and exit functions; stop the node."""
        current.node = self.node
        current.run = self
        main_module = types.ModuleType('__main__')
        main_module.__file__ = self.node.path
        remember_text(main_module)
        vars(main_module)['__builtins__'] = self.modules.builtins
        self.modules.by_name['__main__'] = main_module
        status = 1  # stays if the program's own sys.excepthook raises an exception
        try:
            status = self._run_code(code, vars(main_module))
            self._run_all(self.thread_exit_functions, -1)
            self._join_threads()
            # rospy's own function was the first to be registered, and comes last
            self._run_all(self.exit_functions, -1)
        finally:
            for stream in self.own_sys.stdout, self.own_sys.stderr, self.stdout, self.stderr:
                with contextlib.suppress(Exception):  # the program has closed it, or given it away
                    stream.flush()
            if NamedLines.open_line_owner in (self.stdout, self.stderr):
                NamedLines.open_line_owner._write([''])  # the line ends
            if self.node._current_run is self:  # else the node has started again before this end
                if self.exit_request is not None:
                    status = self._status_of(self.exit_request)
                self.node.exit_code = status
            self.mark_ended(self.main)
            signals.silenced_threads.discard(self.main.ident)  # another thread may get the number
            if self.lifecycle not in (Lifecycle.STOPPING, Lifecycle.STOPPED):
                self.request_stop()

    def _run_code(self, code: types.CodeType, variables: dict[str, Any]) -> Any:
        """Run the program's code, and return its exit status."""
        try:
            exec(code, variables)
            return 0
        except SystemExit as error:
            return self._status_of(error)
        except BaseException as error:
            trace = error.__traceback__
            if isinstance(error, NodeNameInUseError):  # the text says all
                trace = None
            self.own_sys.excepthook(type(error), error, trace)
            if isinstance(error, KeyboardInterrupt):
                return -signal.SIGINT
            self.keep_failure(error, self.node.path)
            return 1

    def _run_all(self, functions: list[Block], position: int) -> None:
        """Run functions of the program; each leaves the list before.

        :param position: 0: the first one comes first; -1: the last one
        """
        while functions:
            function = functions.pop(position)
            try:
                function()
            except (Exception, SystemExit, KeyboardInterrupt) as error:
                if error is not self.exit_request:  # of os._exit()
                    self.print_error(type(error), error, error.__traceback__)
                    self.keep_failure(error, block_name(getattr(function, 'func', function)))

    def exit_now(self, status: int) -> None:
        """Stand in for ``os._exit``: end the program, not the process, without hooks."""
        if os.getpid() != self.process_id:
            os._exit(status)  # a child by os.fork()
        self.exit_request = SystemExit(status)
        for functions in (
            self.ros.core._client_shutdown_hooks,
            self.exit_functions,
            self.thread_exit_functions,
            self.threads_to_join,
        ):
            functions.clear()
        self.request_stop()
        raise self.exit_request

    def _join_threads(self) -> None:
        """Wait for the threads that are not daemons; a handler that raises ends the wait, as in Python."""
        with contextlib.suppress(KeyboardInterrupt, SystemExit):
            while self.threads_to_join and not self.finished.is_set():
                self.handle_signal()
                join(list(self.threads_to_join), JOIN_PERIOD)

    def _status_of(self, exit_request: SystemExit) -> Any:
        """Return the exit status of a SystemExit; print its text if it has one."""
        if isinstance(exit_request.code, str):
            self.stderr.write(f'{exit_request.code}\n')
            return 1
        return exit_request.code or 0

    # -- signals

    def sleep(self, seconds: float) -> None:
        """Stand in for ``time.sleep``: a signal ends a sleep of the main thread.

        A stop ends sleeps of threads that the program's end waits for, and of those that answer a call of a
        service. Daemon threads sleep on, and end with the run. Once ``stopping`` is set, the main
        thread sleeps as usual, and all others end with the run.
        """
        thread = threading.current_thread()
        if thread is self.main:
            if self.stopping.is_set() or seconds <= 0:
                time.sleep(seconds)
            else:
                self.pending_signal.wait(seconds)
                self.handle_signal()
            return
        is_awaited = thread in self.threads_to_join or current.service_run is self
        if seconds <= 0 or is_awaited and not self.stopping.is_set():
            super().sleep(seconds)
        elif self.finished.wait(seconds):
            raise SystemExit

    def checkpoint(self) -> None:
        """Have the main thread wait while another thread handles a signal, for STOP_LIMIT at most.

        The caller of is_shutdown() may hold a lock that a hook takes, as smach does.
        """
        if threading.current_thread() is self.main:
            if self.handler_lock.acquire(timeout=STOP_LIMIT):
                self.handler_lock.release()

    def handle_signal(self) -> None:
        """Call the program's handlers for a stop, once; they may raise an exception.

        Wait while another thread does so.
        """
        with self.handler_lock:
            if not self.pending_signal.is_set():
                return
            self.pending_signal.clear()
            for number in self._signal_numbers():
                handler = self._handler_of(number)
                if handler is signal.default_int_handler:
                    self.stop_created_nodes()
                if callable(handler):
                    handler(number, None)
                elif handler is signal.SIG_DFL:  # the system ends a process at once
                    self.exit_now(-number)

    def _signal_numbers(self) -> list[int]:
        """Return [SIGINT], and SIGTERM if the program has a handler of its own for that alone."""
        defaults = signal.default_int_handler, self.ros.core._ros_signal
        handler = self._handler_of(signal.SIGTERM)
        is_own = callable(handler) and handler not in defaults
        if is_own and self._handler_of(signal.SIGINT) in defaults:
            return [signal.SIGINT, signal.SIGTERM]
        return [signal.SIGINT]

    def handle_signal_for_main(self) -> None:
        """Handle the signal in this thread: the main thread is blocked or computes.

        What the main thread publishes meanwhile is dropped: a process would stand still. An exception
        of a handler is raised in the main thread, before that publishes again.
        """
        if self.main in self.souls:  # else another thread may have the number
            signals.silenced_threads.add(self.main.ident)
        try:
            self.handle_signal()
        except (Exception, KeyboardInterrupt, SystemExit) as error:
            if self.created_nodes:
                join([self.main], STOP_LIMIT)  # the main thread ends with its nodes
            if not self.finished.is_set():  # else the main thread has got its SystemExit
                self.raise_in_main(error)
        finally:
            signals.silenced_threads.discard(self.main.ident)

    def raise_in_main(self, error: BaseException) -> None:
        """Raise an exception of this class in the main thread, at its next line of Python."""
        if isinstance(error, SystemExit):
            self.exit_request = error
        if self.main in self.souls:
            raise_in(self.main, type(error))
            for loop in items_of(self.event_loops):
                with contextlib.suppress(RuntimeError):  # it is closed
                    # an idle loop waits in C: this wakes it
                    loop.call_soon_threadsafe(bool)

    # -- stop

    def check_readable(self) -> None:
        """Compile the program, and its modules that lie outside of the system's folders.

        :raises PharosError: if one cannot be read as Python 3
        """
        compile_program(self.node.path)
        for module in editable_modules(self.node):
            compile_program(module.__file__)

    def signal_shutdown(self, reason: str) -> None:
        """Stand in for ``rospy.signal_shutdown``: run the program's hooks, and close rospy.

        A second call does nothing.
        """
        if self.has_run_hooks:
            return
        self.has_run_hooks = True
        self._run_all(self.ros.core._client_shutdown_hooks, 0)
        self.close_rospy(STOP_LIMIT)

    def stop_created_nodes(self) -> None:
        """Stop the nodes that the program has created with pharos."""
        for node in self.created_nodes[:]:
            node._stop_safely()

    def spin(self) -> None:
        """Stand in for ``pharos.spin``: wait until the nodes of the program have stopped."""
        with contextlib.suppress(KeyboardInterrupt):
            while any(node in signals.own_nodes() for node in self.created_nodes):
                if signals.lost_names & self.node.created_names:
                    break
                self.sleep(SPIN_PERIOD)
        self.stop_created_nodes()
        lost_names = signals.lost_names & self.node.created_names
        signals.lost_names -= lost_names  # a respawn begins anew
        if lost_names:
            sys.exit(1)

    def end_program(self, timeout: float) -> set[threading.Thread]:
        """End the program as Ctrl-C does: handlers, hooks, main thread, then created nodes that are left.

        Python's own handler of SIGINT stops the created nodes first.

        :param timeout: seconds for the main thread
        :returns: the program's threads that go on: a SystemExit waits at their next line of Python
        """
        left_threads: set[threading.Thread] = set()
        for child in self.children:
            interrupt(child)
        if self.main in self.souls:
            self.pending_signal.set()
            threads = [self.main]
            is_accepted = wait(lambda: not self.pending_signal.is_set(), SIGNAL_LIMIT)
            if not is_accepted:
                thread = self.start_thread(self.handle_signal_for_main)
                if thread:
                    threads.append(thread)
                else:  # the interpreter ends, and starts no thread
                    self.handle_signal_for_main()
            if join(threads, timeout):
                self.ros.logwarn(f'left behind, since it did not end in time: {self.node.path}')
                self.raise_in_main(SystemExit())
                end_reads(self.main)
                left_threads.add(self.main)
        # rospy's handler of SIGINT has done this already, in most programs
        self.signal_shutdown('stop')
        self.stop_created_nodes()
        self.finished.set()
        thread_class = self.modules.by_name['threading'].Thread
        own_threads = [thread for thread in self.threads.copy() if isinstance(thread, thread_class)]
        for thread in join(own_threads, SIGNAL_LIMIT):  # others have slept, and ended
            raise_in(thread, SystemExit)  # at its next line
            end_reads(thread)  # after that: a thread that has woken would read again
            left_threads.add(thread)
        return left_threads

    def stop(self, timeout: float) -> None:
        """Stop the node, and drop what the program has opened, as the end of a process does.

        These are ports, files, locks. The Transcript names threads that keep some.
        """
        super().stop(timeout)
        if not signals.is_ending():
            self._tell_left_threads()
        for loop in items_of(self.event_loops):
            with contextlib.suppress(RuntimeError):  # it runs in a thread that is left behind
                loop.close()
        self.exit_request = None
        self.handlers.clear()
        self.created_nodes.clear()
        for failure in self.failures:
            failure.drop_frames()
        self.modules.by_name.clear()
        if not signals.is_ending():
            gc.collect()


def end_reads(thread: threading.Thread) -> None:
    """End the wait of a thread that reads a socket, or a port of pyserial, without a limit."""
    frame = sys._current_frames().get(thread.ident)
    while frame:
        values = frame.f_locals
        for value in [*values.values(), *getattr(values.get('self'), '__dict__', {}).values()]:
            with contextlib.suppress(Exception):  # it is closed already
                if isinstance(value, socket.socket):
                    value.shutdown(socket.SHUT_RD)
                elif hasattr(value, 'cancel_read'):
                    value.cancel_read()
        frame = frame.f_back


def raise_in(thread: threading.Thread, error_class: type[BaseException]) -> None:
    """Raise an exception of a class in a thread, at its next line of Python."""
    if thread.ident is None:
        return  # it has not begun
    if sys.version_info[:2] == (3, 11) and sys.gettrace():
        return  # traced threads would stand still until the thread has come to that line
    thread_id = ctypes.c_ulong(thread.ident)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(thread_id, ctypes.py_object(error_class))


class NamedLines:
    """A stream that puts the node's name before each line; its end is not that of the stream behind it.

    :param stream: the stream to write to, such as the process's stdout
    :param run: the run with the name
    """

    closed = False
    #: the NamedLines whose text on the terminal has no line end yet, such as a progress bar, or None
    open_line_owner: NamedLines | None = None

    def __init__(self, stream: Any, run: ScriptRun) -> None:
        self._stream = stream
        self._run = run
        self._partial_line = ''  # the text after the last line end, not written yet
        self._lock = threading.RLock()  # of a kind that the handler of a signal may take again

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def close(self) -> None:
        """Take no more text."""
        self.flush()
        self.closed = True

    def detach(self) -> Any:
        """Return a stream of bytes, which a program may wrap anew, and close."""
        return os.fdopen(os.dup(self._stream.fileno()), 'wb')

    buffer = property(detach)

    def write(self, text: str) -> int:
        """Write the complete lines, keep the rest, and return the number of characters."""
        if self.closed:
            raise ValueError('I/O operation on closed file.')
        # rospy's log ends a colour after the end of the line: the next line may be that of another node
        ended_text = text.replace(f'\n{COLOR_END}', f'{COLOR_END}\n')
        with self._lock:  # other threads print, too
            *lines, self._partial_line = (self._partial_line + ended_text).split('\n')
        if lines:
            self._write(lines)
        return len(text)

    def flush(self) -> None:
        """Write the rest of the text: on a terminal as it is, elsewhere as a line."""
        with self._lock:
            text, self._partial_line = self._partial_line, ''
        if text:
            self._write([text], '' if self._stream.isatty() else '\n')

    def _write(self, lines: list[str], end: str = '\n') -> None:
        name = f'[{self._run.name}] '
        text = name + f'\n{name}'.join(lines) + end
        if self._stream.isatty():
            if NamedLines.open_line_owner is self:
                text = text[len(name) :]
            elif NamedLines.open_line_owner:
                text = f'\n{text}'
            NamedLines.open_line_owner = None if end else self
        # the reader of a pipe may have gone: the program must go on, and stop its motors
        with contextlib.suppress(OSError, ValueError):
            self._stream.write(text)
            self._stream.flush()


class _Pharos(Shim):
    """A stand-in for pharos: the nodes that a program creates end with the program.

    They get the name and remappings of its entry in the launch file. Its Transcript prints lines.
    """

    def __init__(self, run: ScriptRun) -> None:
        facade = sys.modules['pharos']  # it lies above, and is loaded already

        class EntryMaster(facade.Master):
            """A master that gives nodes the name, the namespace and the remappings of the entry."""

            _environ = run.environ
            _first_nodes = WeakValueDictionary()

            def __init__(
                self,
                url: str | None = None,
                shared_memory: bool | None = run.master.shared_memory,
                share_connections: bool = run.master.share_connections,
            ) -> None:
                super().__init__(url or run.master.url, shared_memory, share_connections)

            def _remapped_name(self, node: Any, name: str, mappings: tuple[str, ...]) -> str:
                full_name = super()._remapped_name(node, name, mappings)
                for parameter_name, value in run.node.params.items():
                    self.parameters[f'{full_name}/{parameter_name}'] = value
                return full_name

            def _live_nodes(self) -> list:
                return [
                    node
                    for node in signals.live_nodes()
                    if type(node._settings.master) is type(self)
                ]

            def create(self, *args: Any, **kwargs: Any) -> Any:
                if not run.created_nodes:
                    guide(run.ros, self._live_nodes)
                node = super().create(*args, **kwargs)
                run.created_nodes.append(node)
                run.node.created_names.add(node._settings.name)
                return node

        transcript = type(Transcript)()
        transcript.on_show(run.print)
        super().__init__(facade, Master=EntryMaster, spin=run.spin, Transcript=transcript)
