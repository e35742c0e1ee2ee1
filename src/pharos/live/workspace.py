"""The workspace: a session in which robots are programmed while they run.

``rosrun pharos workspace`` is :func:`run`; a notebook has one by :func:`start`, or by
``%load_ext pharos.live.workspace``. What it is made of can be had from any program, too:
:class:`Workspace`, :func:`namespace`, and what completes and explains (:mod:`pharos.live.completion`,
:mod:`pharos.live.explanation`, :mod:`pharos.live.notebook`).
"""
import itertools
import os
import shutil
import signal
import sys
from typing import Any, Callable, Dict, List, Optional, Sequence, Tuple

from rosgraph.rosenv import ROS_MASTER_URI

import pharos
from pharos import node_registry, program, signals
from pharos.counts import counted
from pharos.errors import PharosError, missing
from pharos.live import completion, debugger, explanation, mistakes, notebook
from pharos.master import Master
from pharos.node import BlockNode
from pharos.signals import is_from_signal

NAME = 'workspace'  # of the node that a session has, where it is free


class Workspace:
    """What a session has: a master, a node of its own, and the names that can be typed.

    Where no master is named and none answers, there is one of the session's own, which
    ROS_MASTER_URI names until :meth:`close`.

    :ivar master: the ROS master's proxy
    :ivar me: the node
    :ivar namespace: the names, a dict
    :ivar is_embedded: whether the master is the session's own
    :ivar sought: where a master was looked for, a URL
    :param url: URL of the ROS master; None: ROS_MASTER_URI's, or a master of its own
    :param argv: ROS remappings and private parameters of ``me``
    :raises ValueError: if ROS_MASTER_URI or ``url`` is no URL
    :raises MasterUnreachableError: if no master answers at ``url``
    """

    def __init__(self, url: Optional[str] = None, argv: Optional[List[str]] = None) -> None:
        self.master = Master(url)
        self.is_embedded = url is None and not self.master.is_reachable()
        self.sought = self.master.url
        self._former_uri = os.environ.get(ROS_MASTER_URI)
        if self.is_embedded:
            self.master = Master.embedded()
            os.environ[ROS_MASTER_URI] = self.master.url
        try:
            self.me = self.master.create(BlockNode, named=free_name(self.master, NAME), argv=argv)
        except BaseException:
            self._give_back_master()
            raise
        self.namespace = namespace(self.master, self.me)

    def close(self) -> None:
        """Stop its node, and its master where that is its own, with the nodes of this process at
        it. Harmless when done twice."""
        self.me.stop()
        self._give_back_master()

    def _give_back_master(self) -> None:
        if not self.is_embedded:
            return
        self.master.stop()
        if os.environ.get(ROS_MASTER_URI) == self.master.url:
            os.environ.pop(ROS_MASTER_URI)
            if self._former_uri is not None:
                os.environ[ROS_MASTER_URI] = self._former_uri

    @property
    def banner(self) -> str:
        """What is said when the session begins."""
        if self.is_embedded:
            where = (
                f'no ROS master answers at {self.sought}, so this session has one of its own,'
                f' until it ends.\nOther shells join it by: export'
                f' {ROS_MASTER_URI}={self.master.url}'
            )
        else:
            count = len(self.master.nodes())
            where = f'{counted(count, "node is", "nodes are")} at the ROS master {self.master.url}'
        return (
            f'PhaROS {pharos.__version__}: {where}\n'
            f'master is that master, me the node {self.me.name} of this session; all of pharos is'
            ' imported.\nTab completes, x? explains x, Ctrl-C ends a line, Ctrl-D the session and'
            ' its nodes.\n'
        )

    def __enter__(self) -> 'Workspace':
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f'<Workspace of {self.me.name} at {self.master.url}>'


def namespace(master: Master, me: Optional[BlockNode] = None) -> Dict[str, Any]:
    """The names of a session: all exports of pharos, ``pharos`` itself, ``master``, and ``me``."""
    names = {name: getattr(pharos, name) for name in pharos.__all__ if name[0] != '_'}
    names.update(pharos=pharos, master=master)
    if me is not None:
        names['me'] = me
    return names


def free_name(master: Master, name: str) -> str:
    """``name``, or the first of ``name_2``, ``name_3`` ... that no live node of the master has."""
    names = itertools.chain([name], (f'{name}_{number}' for number in itertools.count(2)))
    return next(each for each in names if master.live_node(each) is None)


def equip(shell: Any, workspace: Workspace) -> Callable[[], None]:
    """Give a session of IPython's the names of a workspace, and have it complete, explain and show
    the things of a graph, and mistakes in short; returns a function that ends that."""
    shell.push(workspace.namespace, interactive=False)
    ends = [room.equip(shell) for room in (completion, explanation, mistakes, notebook)]

    def end() -> None:
        for each in ends:
            each()

    return end


def start(url: Optional[str] = None) -> Workspace:
    """Make the IPython session that calls this a workspace, in a notebook for example; returns it.

    In a session that is one already, that ends first. Nothing waits, and no signal is needed:
    :meth:`Workspace.close` or the end of the session's program stops its node.

    :param url: as for :class:`Workspace`
    :raises PharosError: if there is no session, or IPython is not installed
    :raises ValueError, MasterUnreachableError: as :class:`Workspace`
    """
    shell = ipython().get_ipython()
    if shell is None:
        raise PharosError(
            'there is no session of IPython that could become a workspace: rosrun pharos workspace'
            ' opens one'
        )
    unload_ipython_extension(shell)
    workspace = Workspace(url)
    _started[shell] = equip(shell, workspace), workspace.close
    print(workspace.banner)
    return workspace


#: session -> what ends its workspace
_started: Dict[Any, Tuple[Callable[[], None], Callable[[], None]]] = {}


def load_ipython_extension(shell: Any) -> None:
    """What ``%load_ext pharos.live.workspace`` does: :func:`start`."""
    start()


def unload_ipython_extension(shell: Any) -> None:
    """What ``%unload_ext pharos.live.workspace`` does: the session is no workspace any more."""
    for end in _started.pop(shell, ()):
        end()


def run(
    script: Optional[str] = None, args: Sequence[str] = (), argv: Optional[List[str]] = None
) -> int:
    """A session in this terminal, until it is left; returns the exit status of the program.

    The nodes made in it stop with the program. Where standard input is no terminal, its lines are
    run as if they were typed.

    :param script: path of a Python program to be run first, among the names of the session
    :param args: its further arguments
    :param argv: as for :class:`Workspace`
    :raises FileNotFoundError: if there is no such script
    :raises PharosError: if IPython is not installed, or there is no standard output
    :raises ValueError, MasterUnreachableError: as :class:`Workspace`
    """
    program.check_output()
    application = ipython().terminal.ipapp.TerminalIPythonApp
    if script is not None and not os.path.isfile(script):
        raise FileNotFoundError(f'there is no script {script}: give the path of a Python program')
    with Workspace(argv=argv) as workspace:
        session = _Session(workspace, application)
        if script is not None:
            session.run_script(script, args)
        return session.interact()


def ipython() -> Any:
    """The module ``IPython``.

    :raises PharosError: if it is not installed
    """
    try:
        import IPython
    except ModuleNotFoundError as error:
        raise PharosError(missing('a workspace needs IPython', error, 'python3-ipython')) from error
    return IPython


class _Session:
    """A workspace in IPython's terminal."""

    def __init__(self, workspace: Workspace, application: Any) -> None:
        self._app = application.instance()
        self._app.display_banner = False
        if not sys.stdout.isatty():
            self._app.config.TerminalInteractiveShell.update(colors='NoColor', term_title=False)
        self._app.initialize([])
        self._shell = self._app.shell
        self._is_over = False  # whether a signal has ended the session
        self._status = 0  # of what failed, where nobody is there to see it
        print(workspace.banner)
        if not sys.stdin.isatty():
            print('Standard input is no terminal: its lines are run, to its end.\n')
            self._shell.confirm_exit = False
            self._shell.events.register('post_run_cell', self._note)
        equip(self._shell, workspace)
        if 'PAGER' not in os.environ and shutil.which('less') is None:
            # writing to a pager that is not there, IPython takes it for one that has been left
            page = ipython().core.page
            self._shell.set_hook('show_in_pager', page.as_hook(page.display_page))
        node_registry.before_stop_all(self._end)  # which a signal asks for

    def run_script(self, path: str, args: Sequence[str]) -> None:
        """Run a program; what it raises leaves the session open."""
        argv_before, sys.argv = sys.argv, [path, *args]
        self._shell.user_ns['__file__'] = path
        try:
            self._shell.safe_execfile(
                path, self._shell.user_ns, shell_futures=True, raise_exceptions=True
            )
        except SystemExit as error:
            if is_from_signal(error):
                raise
            self._status = _status_of(error)
            if error.code not in (None, 0):
                print(f'{path} has ended: sys.exit({error.code!r})', file=sys.stderr)
        except BaseException as error:
            self._status = 1
            self._shell.showtraceback((type(error), error, _below(error.__traceback__, path)))
        finally:
            sys.argv = argv_before

    def _note(self, result: Any) -> None:
        """A line has been run."""
        error = result.error_before_exec or result.error_in_exec
        if error is not None:
            self._status = _status_of(error)

    def interact(self) -> int:
        """Run what is typed, until the session is left; returns the exit status.

        :raises SystemExit: if a signal has ended it
        """
        if not self._is_over:
            self._app.start()
        node_registry.not_before_stop_all(self._end)
        if not self._is_over:
            return 0 if sys.stdin.isatty() else self._status
        with signals.held():  # which raises afterwards what the signal is to raise
            pass
        return 128 + signal.SIGTERM  # it has ended a wait, and there is nothing to raise

    def _end(self) -> None:
        """A signal ends the program: leave the prompt as Ctrl-D does, so that the terminal is as it
        was before, and begin no other line."""
        self._is_over = True
        self._shell.confirm_exit = False
        self._shell.ask_exit()
        debugger.leave(self._shell.pt_app)  # None where there is no terminal


def _status_of(error: BaseException) -> int:
    """The exit status of a program that such an exception ends."""
    code = error.code if isinstance(error, SystemExit) else 1
    return 0 if code is None else code if isinstance(code, int) else 1


def _below(trace: Any, path: str) -> Any:
    """A traceback from the script's first line on; where it has not come to run, all of it."""
    own, script = trace, os.path.realpath(path)
    while own is not None and own.tb_frame.f_code.co_filename != script:
        own = own.tb_next
    return own or trace
