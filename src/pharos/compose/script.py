"""Scripts: rospy programs that run unmodified as nodes of this process."""
import os
import re
import signal
import threading
from typing import TYPE_CHECKING, Any, Dict, Optional, Sequence

import rosgraph.names

from pharos import node_registry, signals, working_directory
from pharos.blocks import attempt
from pharos.compose.output import redirect
from pharos.compose.programs import check_source, find_program, source_of
from pharos.counts import counted
from pharos.errors import NodeStoppedError, PharosError
from pharos.lifecycle import Lifecycle
from pharos.node import Node
from pharos.restarts import is_restarting
from pharos.program_arguments import arguments_of, parameters_of
from pharos.run import Run
from pharos.watcher import watcher_of

if TYPE_CHECKING:
    from pharos.master import Master


class ScriptNode(Node):
    """A rospy program, unmodified, as a node of this process: made by :meth:`Master.load`.

    :meth:`start` runs it from its first line, in a thread of its own; its ``rospy.init_node``
    registers the node. :meth:`stop` ends it, ``restart()`` also runs it again, and the node stops
    when it has ended by itself.

    :ivar path: the file of the program
    :ivar args: its arguments
    :ivar params: ``{name: value}`` of private parameters that it is given
    :ivar cwd: its working directory; None: this process's
    :ivar output: where what it prints goes, as below
    :ivar init_timeout: seconds that :meth:`start` waits for its ``rospy.init_node``
    :param path: the file of the program
    :param args: its arguments, ROS's among them
    :param params: ``{name: value}`` of private parameters, set when it calls ``init_node``
    :param env: ``{name: value}`` of further environment variables
    :param takes_own_name: whether it has the name that it gives to ``init_node``, and not the one
        given here
    :param private_name: the node in whose namespace its private names are; None: itself
    :param cwd: its working directory, where the system lets it have one of its own; None: this
        process's
    :param output: 'screen': each line that it prints has its node's name before it; a path: the
        file for what it prints, and its errors have the name; None: as this process prints
    """

    _kind = 'a script'
    #: seconds that :meth:`start` waits for the program to call ``rospy.init_node``, or to end
    init_timeout = 10.0
    #: seconds that :meth:`stop` waits for the program, as long as roslaunch waits after its SIGINT
    stop_timeout = 15.0

    def __init__(
        self,
        path: str,
        args: Sequence[str] = (),
        params: Optional[Dict[str, Any]] = None,
        env: Optional[Dict[str, str]] = None,
        takes_own_name: bool = False,
        private_name: Optional[str] = None,
        cwd: Optional[str] = None,
        output: Optional[str] = None,
    ) -> None:
        super().__init__()
        found = find_program(path)
        self.path, self.args = source_of(found), [str(argument) for argument in args]
        self.params = parameters_of(params)
        self._settings.for_program(found, self.args, env or {}, takes_own_name, private_name)
        if cwd is not None and not os.path.isdir(cwd):
            raise ValueError(f'{found} cannot run in {cwd!r}: there is no such folder')
        self.cwd = cwd
        if not isinstance(output, (str, os.PathLike, type(None))):  # a number is an open file
            raise TypeError(f"output is 'screen', the path of a file, or None, not {output!r}")
        self.output = output

    def start(self) -> None:
        """Run the program from its first line.

        Returns when its node is registered, or it has ended without one, or has run for
        :attr:`init_timeout` seconds.

        :raises PharosError: if the program raised an exception by then, its cause
        :raises NodeStoppedError: if :meth:`stop` was called before it was a node
        """
        check_source(self.path)
        ScriptRun(self, self._settings).start(reopens=False)

    @property
    def exit_code(self) -> Optional[int]:
        """What its process would have ended with; None while it runs, or if it did not end."""
        return self.latest_run.exit_code if isinstance(self.latest_run, ScriptRun) else None

    def wait(self, timeout: Optional[float] = None) -> Optional[int]:
        """Wait until it has ended, and its node has stopped; returns its :attr:`exit_code`.

        :param timeout: seconds, None: without limit
        :raises TimeoutError: if it has not in that time
        """
        run = self.latest_run

        def has_ended() -> bool:
            nonlocal run
            while run.successor is not None:
                run = run.successor
            return run.is_over and not is_restarting(self)

        with signals.interruptible_wait():
            if not node_registry.wait_until(has_ended, timeout):
                raise TimeoutError(f'{self.name} has not ended within {timeout:g} s: stop() it')
        return self.exit_code

    def _size(self) -> str:
        if not self.is_running:
            return ''
        rospys = self.latest_run.rospy.topics
        topics = {name for name, _ in rospys.get_publications() + rospys.get_subscriptions()}
        topics -= {'/rosout'}  # each program has it
        return f', {counted(len(topics), "topic")}'


class ScriptRun(Run):
    """One run of a program."""

    node: ScriptNode
    may_run_elsewhere = False
    left_behind = (
        'A script ends by itself if it spins, sleeps, or loops while not rospy.is_shutdown(); one'
        ' that cannot is better a process of its own: master.run()'
    )

    def __init__(self, node: ScriptNode, settings: Any) -> None:
        super().__init__(node, settings)
        self.exit_code: Optional[int] = None
        self._process = os.getpid()
        self.is_registered = False
        self.has_ended = False  # whether the program has
        self._is_stopped_early = False  # whether that is by another's stop, before it was a node
        self._is_awaited = True  # whether start() waits still, whose caller gets what is raised
        self._error: Optional[BaseException] = None  # with which it ended before it was a node
        self.rospy.on_init_node = self._init_node
        folder = (node.cwd or os.getcwd()) if working_directory.is_possible() else None
        self.rospy.expect_program(folder)
        is_again = isinstance(node.latest_run, ScriptRun)
        self.rospy.names_log_lines = node.output is None
        self._file = redirect(self.rospy.system, node.output, lambda: node.name, is_again)

    def start(self, reopens: bool) -> None:
        """Run the program in a thread of its own; see :meth:`ScriptNode.start`."""
        with signals.held():
            node_registry.claim(self)
            self._become(Lifecycle.RUNNING)
            self.fork(self._run, 'script')
            node_registry.wait_until(
                lambda: self.is_registered or self.has_ended or self.is_over,
                self.node.init_timeout,
            )
            with node_registry.changed:
                error, self._error = self._error, None
                self._is_awaited = False
            if self._is_stopped_early:
                raise NodeStoppedError(f'{self.node.path} was stopped before it was a node')
            if self.has_ended:
                self.node.stop()
        if error is not None:
            kind = type(error) if isinstance(error, PharosError) else PharosError
            raise kind(
                f'{self.node.path}, to be the node {self.node.name}, ended before it was one:'
                f' {type(error).__name__}: {error}'
            ) from error

    def _run(self) -> None:
        """What the thread of the program does, and Python at the end of one."""
        error: Optional[BaseException] = None
        try:
            self.rospy.run_main(self.node.path, self._settings.argv)
            exit_code = 0
        except SystemExit as wanted:
            exit_code = self._exit_code(wanted)
        except KeyboardInterrupt:  # it has no handler for what its stop is to it
            exit_code = -signal.SIGINT
        except BaseException as raised:
            exit_code, error = 1, _in_program(raised, self.node.path)
            self._call_hook(error)
        with node_registry.changed:
            is_for_caller = self._is_awaited and not self.is_registered
            if is_for_caller:
                self._error = error
        if error is not None and not is_for_caller:
            self.report(error, self.node.path, 'script')
        self.rospy.exit_main()
        for stream in self.rospy.system.stdout, self.rospy.system.stderr:
            attempt(stream.flush)
        self.exit_code, self.has_ended = exit_code, True
        node_registry.notify()
        if not self.is_ending:
            stop = threading.Thread(
                target=node_registry.stop, args=(self.node,), name=f'{self.node.name} stop'
            )
            stop.daemon = True
            stop.start()

    def _call_hook(self, error: BaseException) -> None:
        """Call the program's ``sys.excepthook``, if it has set one."""
        hook = vars(self.rospy.system).get('excepthook')
        if hook is not None:
            attempt(lambda: hook(type(error), error, error.__traceback__))

    def end(self) -> None:
        """End it, and close the file that it prints to."""
        with node_registry.changed:
            if self._is_awaited and not (self.is_registered or self.has_ended or self.is_ending):
                self._is_stopped_early = True
        super().end()
        if self._file is not None and self.is_over:
            self._file.close()

    def _end_rospy(self, timeout: float) -> None:
        super()._end_rospy(min(timeout, Node.stop_timeout))

    def _exit_code(self, wanted: SystemExit) -> int:
        """What Python makes of the argument of ``sys.exit``; what cuts a program off has another
        class, and the number of a signal."""
        code = wanted.code
        if code is None or isinstance(code, int):
            status = int(code or 0)
            return status & 0xFF if type(wanted) is SystemExit else status
        # in one piece: others of this process may print just now, too
        attempt(lambda: print(f'{code}\n', end='', file=self.rospy.system.stderr))
        return 1

    def _init_node(self, name: str, register: Any, xmlrpc_port: int, tcpros_port: int) -> None:
        """Its program calls ``rospy.init_node``, in whatever thread."""
        node, settings = self.node, self._settings
        if os.getpid() != self._process:
            raise PharosError(
                f'{name} is to be a node in a process forked off that of {node.name}, which has the'
                " thread that forked alone, and no node: start it by subprocess, or multiprocessing's"
                " get_context('spawn'), or run its script as a process of its own"
            )
        node_registry.rename(node, name)
        settings.xmlrpc_port = xmlrpc_port or settings.xmlrpc_port
        settings.tcp_port = tcpros_port or settings.tcp_port
        for parameter, value in node.params.items():
            full_name = f'{name}/{parameter}'
            node.master.parameters[full_name] = value
            self.rospy.parameters.initialize(full_name, value)
        self.rospy.start(node.connect_timeout, register)
        self.is_registered = True
        node_registry.notify()
        watcher_of(node.master).check()


def _in_program(error: BaseException, path: str) -> BaseException:
    """The exception, without what ran the program in its traceback."""
    frames = error.__traceback__
    while frames is not None and frames.tb_frame.f_code.co_filename != path:
        frames = frames.tb_next
    return error.with_traceback(frames or error.__traceback__)


def load(
    master: 'Master',
    package: str,
    executable: Optional[str] = None,
    args: Sequence[object] = (),
    name: Optional[str] = None,
    namespace: Optional[str] = None,
    remap: Optional[Dict[str, str]] = None,
    **options: Any,
) -> ScriptNode:
    """What :meth:`Master.load` does."""
    path = find_program(package, executable)
    # until it calls init_node, it is called after its file, with a number
    base = re.match(r'[A-Za-z]\w*', os.path.basename(path), re.ASCII)
    named = name or (base.group() if base else 'script')
    if not isinstance(namespace, (str, type(None))):
        raise TypeError(f'namespace is a name, not {namespace!r}')
    if namespace:
        named = rosgraph.names.ns_join(namespace, named)
    arguments = arguments_of(args, None, remap)
    return master.create(
        ScriptNode, named, path=path, args=arguments, takes_own_name=name is None, **options
    )
