"""What a program has of a process of its own, and a node's program, libraries and rospy have of the
node: environment, arguments, exit handlers, signals, threads and child processes."""
import atexit
import functools
import os
import posixpath
import time
import xmlrpc
import xmlrpc.client
import _posixsubprocess
import _thread

from pharos.private_rospy.module_proxy import ModuleProxy
from pharos.private_rospy.own_signals import OwnSignals
from pharos.private_rospy.proxies import ServerProxy


class OwnProcess:
    """Puts into a set of private modules what stands in for Python's.

    :param imports: the :class:`~.loader.PrivateImports`
    :param settings: the :class:`~.settings.Settings` of the node
    :param report: called with what an exit handler or a handler of signals raised, and with what
        that is, where it is not of the end
    :param request_stop: called with the reason why a signal ends the program
    """

    def __init__(self, imports, settings, lifetime, report, request_stop):
        self._environ, self._lifetime, self._report = settings.environ, lifetime, report
        self.exit_handlers = []  # (function, arguments, keyword arguments), the first to run last
        #: the program's signals
        self.signals = signals = OwnSignals(lifetime, report, request_stop)
        proxies = ModuleProxy(xmlrpc.client, ServerProxy=ServerProxy)
        own_os = self._os(imports)
        imports.system.argv = settings.argv
        imports.modules.update(
            {
                'os': own_os,
                'os.path': own_os.path,
                'posixpath': own_os.path,
                'atexit': ModuleProxy(
                    atexit,
                    register=self._at_exit,
                    unregister=self._not_at_exit,
                    # a process of multiprocessing begins and ends by these, since Python 3.13
                    _clear=self.exit_handlers.clear,
                    _run_exitfuncs=self.run_exit_handlers,
                ),
                'signal': signals.module,
                'threading': lifetime.threading,
                '_thread': ModuleProxy(_thread, start_new_thread=lifetime.start_thread),
                'time': ModuleProxy(time, sleep=lifetime.sleep),
                'xmlrpc': ModuleProxy(xmlrpc, client=proxies),
                'xmlrpc.client': proxies,
                '_posixsubprocess': ModuleProxy(_posixsubprocess, fork_exec=self._fork_exec),
            }
        )

    # -- environment and child processes

    def _os(self, imports):
        own_os = imports.twin(
            os,
            environ=self._environ,
            putenv=self._environ.__setitem__,
            unsetenv=lambda name: self._environ.pop(name, None),
            system=self._system,
            kill=self.signals.kill,
            execv=lambda path, arguments: os.execve(path, arguments, self._environ),
            posix_spawn=functools.partial(self._spawn, os.posix_spawn),
            posix_spawnp=functools.partial(self._spawn, os.posix_spawnp),
        )
        own_os.path = imports.twin(posixpath, os=own_os)
        return own_os

    def _system(self, command):
        """``os.system``."""
        child = os.posix_spawn('/bin/sh', ['sh', '-c', command], self._environ)
        return os.waitpid(child, 0)[1]

    def _spawn(self, spawn, path, arguments, environ, **options):
        """``os.posix_spawn`` and its like, by which subprocess starts programs, without an
        environment since Python 3.13."""
        return spawn(path, arguments, self._environ if environ is None else environ, **options)

    def _fork_exec(self, *arguments):
        """What subprocess and multiprocessing start programs by."""
        *before, environ = arguments[:6]
        if environ is None:
            environ = [
                os.fsencode(name) + b'=' + os.fsencode(value)
                for name, value in self._environ.items()
            ]
        return _posixsubprocess.fork_exec(*before, environ, *arguments[6:])

    # -- the end

    def _at_exit(self, function, *args, **kwargs):
        """``atexit.register``."""
        self.exit_handlers.append((function, args, kwargs))
        return function

    def _not_at_exit(self, function):
        """``atexit.unregister``."""
        self.exit_handlers[:] = [each for each in self.exit_handlers if each[0] != function]

    def end_pools(self):
        """Have the threads of executors end when their work is done, as Python does at its end."""
        waiting = self._lifetime.before_threads_end
        while waiting:
            self._attempt(waiting.pop())

    def has_exit_handlers(self):
        """Whether :meth:`run_exit_handlers` has anything to do, for which a thread may not be
        there."""
        lifetime = self._lifetime
        return bool(lifetime.raised or self.exit_handlers or lifetime.before_threads_end)

    def run_exit_handlers(self):
        """Run the handlers of atexit, the last first, each once."""
        self._attempt(self._lifetime.raise_pending)  # where it could not, report it
        while self.exit_handlers:
            function, args, kwargs = self.exit_handlers.pop()
            self._attempt(function, *args, **kwargs)
        self.end_pools()  # of a library, and of a program that has not come to its end

    def _attempt(self, function, *args, **kwargs):
        try:
            function(*args, **kwargs)
        except (SystemExit, KeyboardInterrupt):
            pass  # the node ends already
        except BaseException as error:
            self._report(error)
