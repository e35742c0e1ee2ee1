"""Launch files, read by roslaunch itself, and who is to run which of their nodes."""
import copy
import dataclasses
import os
import re
import shlex
import shutil
import sys
from typing import (
    Any,
    Collection,
    Dict,
    Iterable,
    List,
    Mapping,
    NamedTuple,
    Optional,
    Sequence,
    Set,
)

import rosgraph.names
import roslaunch.config
import roslaunch.core
import roslaunch.launch
import roslaunch.node_args
import roslaunch.pmon
import roslaunch.xmlloader
import rospkg
from roslaunch.substitution_args import SubstitutionException

from pharos import working_directory
from pharos.compose.programs import MAKES_NODES, uses_pharos
from pharos.errors import PharosError, UnknownNodeError, suggest
from pharos.parameters import as_stored
from pharos.program_files import AnyPath, find_launch_file

_PYTHON = re.compile(r'python(3(\.\d+)?)?')
#: what roslaunch lacks in the file, and its words for that
_MISSING_ARG = re.compile(r"requires the '(\S+)' arg to be set")


@dataclasses.dataclass(frozen=True)
class LaunchedNode:
    """A node that is to run in this process, of a launch file mostly."""

    name: str
    program: str  # 'package/executable'
    path: str
    args: Sequence[str] = ()  # the command line, but for the path, as roslaunch would give it
    env: Mapping[str, str] = dataclasses.field(default_factory=dict)  # of the launch file
    cwd: Optional[str] = None
    output: Optional[str] = None  # 'screen' or 'log'; None: as this process prints
    is_required: bool = False
    respawn_delay: Optional[float] = None  # seconds; None: it is not started again
    file: str = ''  # the launch file that it is in
    takes_own_name: bool = False  # whether its program names the node
    private_name: Optional[str] = None  # the node in whose namespace its private names are


class Problem(NamedTuple):
    """Why a node is not started."""

    name: str
    file: str
    why: str
    ends_all: bool = False  # whether it is required, and roslaunch would end all others for that

    def __str__(self) -> str:
        where = f'{self.file}: ' if self.file else ''
        return f'{where}{self.name} is not started: {self.why}'


class _Loader(roslaunch.xmlloader.XmlLoader):
    """roslaunch's, which also says what parameter the server cannot hold, and where a parameter is
    whose value cannot be read or computed.
    """

    def add_param(self, config: Any, name: str, value: Any, verbose: bool = True) -> None:
        """See roslaunch: of what is in a rosparam tag.

        :raises ValueError: as roslaunch expects it, who adds the tag
        """
        if isinstance(value, dict):
            for key in value:
                if not isinstance(key, str):
                    raise ValueError(
                        f'{key!r} in {name} is no text, as a name is: put it in quotes'
                    )
        else:
            as_stored(name, value)
        super().add_param(config, name, value, verbose=verbose)

    def param_value(self, verbose: bool, name: str, *given: Any) -> Any:
        """See roslaunch; likewise."""
        try:
            value = super().param_value(verbose, name, *given)
        except OSError as error:
            raise ValueError(f'{name} cannot be read: {error}') from error
        as_stored(name, value)
        return value

    def resolve_args(self, args: Any, context: Any) -> Any:
        """See roslaunch."""
        try:
            return super().resolve_args(args, context)
        except (roslaunch.core.RLException, SubstitutionException, rospkg.ResourceNotFound):
            raise
        except Exception as error:  # of any kind, in an $(eval)
            raise roslaunch.xmlloader.XmlParseException(
                f'{context.filename}: {args} raised {type(error).__name__}: {error}'
            ) from error


class _ParameterSetter(roslaunch.launch.ROSLaunchRunner):
    """roslaunch's runner, which sets the parameters and starts nothing."""

    def __init__(self, run_id: str, config: Any) -> None:
        # a monitor of its own, that never runs: roslaunch's takes the signals of the program
        super().__init__(run_id, config, pmon=roslaunch.pmon.ProcessMonitor())

    def set_all(self) -> None:
        self._launch_setup_executables()
        self._load_parameters()


class LaunchFile:
    """A launch file and all that it includes.

    :param master_url: the master that its nodes are for
    :param package: a ROS package; without it, or without ``file``, the other one is a path
    :param args: the arguments of the launch file
    :param only: the names of the nodes that are wanted; all, if there are none
    :param apart: the names of those that are to run in processes of their own
    :raises UnknownNodeError: if there is no such package, file, argument or node
    :raises PharosError: if roslaunch cannot read it
    """

    def __init__(
        self,
        master_url: str,
        package: Optional[AnyPath],
        file: Optional[AnyPath],
        args: Dict[str, object],
        only: Collection[str] = (),
        apart: Collection[str] = (),
    ) -> None:
        self.path = find_launch_file(package, file)
        #: roslaunch's configuration, whole
        self.config = self._read(args)
        self.config.master.uri = master_url
        named = {_name_of(node): node for node in self.config.nodes}
        wanted = self._chosen(only, named) or set(named)
        kept_apart = self._chosen(apart, named)
        #: the nodes for this process
        self.here: List[LaunchedNode] = []
        #: roslaunch's nodes, for processes of their own
        self.apart: List[Any] = []
        #: why they are to have these, with the names of those for which it is so
        self.reasons: Dict[str, List[str]] = {}
        #: those that nobody can start
        self.problems: List[Problem] = []
        for name, node in named.items():
            if name in wanted:
                self._sort(name, node, name in kept_apart)

    def _read(self, args: Dict[str, object]) -> Any:
        loader = _Loader()
        argv = [f'{name}:={_as_text(value)}' for name, value in args.items()]
        try:
            config = roslaunch.config.load_config_default(
                [(self.path, argv)], None, loader=loader, verbose=False
            )
        except Exception as error:  # those of roslaunch, or of what it asks for the packages
            raise self._unreadable(error) from error
        declared = loader.root_context.resolve_dict.get('arg_doc', {})
        with open(self.path, encoding='utf-8', errors='replace') as file:
            passes_all_on = 'pass_all_args' in file.read()
        for name in args:
            if name not in declared and not passes_all_on:
                raise UnknownNodeError(
                    f'{self.path} has no arg {name!r}{suggest(name, declared)}: it has'
                    f" {', '.join(sorted(declared)) or 'none'}"
                )
        return config

    def _unreadable(self, error: Exception) -> PharosError:
        """What roslaunch says, with the file before it."""
        if isinstance(error, rospkg.ResourceNotFound):
            package = str(error).partition('\n')[0]
            return UnknownNodeError(
                f'{self.path} needs the ROS package {package!r}, which is not on ROS_PACKAGE_PATH:'
                " install it, or source its workspace's setup.bash"
            )
        # each once: a circle of includes has them many times
        lines = dict.fromkeys(line.strip() for line in str(error).splitlines() if line)
        text = '; '.join(lines)
        missing = _MISSING_ARG.search(text)
        if missing:
            text += f': give it with {missing.group(1)}:=VALUE'
        return PharosError(text if self.path in text else f'{self.path}: {text}')

    def _chosen(self, names: Iterable[str], known: Iterable[str]) -> Set[str]:
        """The full names that are meant, each by itself or by its last part."""
        if isinstance(names, str):
            raise TypeError(f'the names of nodes are a list or tuple, not {names!r}')
        chosen = set()
        for name in names:
            found = {each for each in known if name in (each, each[1:], each.rpartition('/')[2])}
            if not found:
                raise UnknownNodeError(
                    f'{self.path} has no node {name!r}{suggest(name, known)}: it has'
                    f" {', '.join(sorted(known)) or 'none'}"
                )
            chosen |= found
        return chosen

    def _sort(self, name: str, node: Any, is_kept_apart: bool) -> None:
        is_local = roslaunch.core.is_machine_local(node.machine)
        if not is_local:
            self._put_apart(name, node, 'on another machine')
            return
        try:
            command = _command(node)
        except Exception as error:  # likewise
            why = str(error).partition('\n')[0]
            if isinstance(error, ValueError):  # of shlex
                why = f'args={node.args!r} or launch-prefix={node.launch_prefix!r}: {why}'
            if isinstance(error.__context__, rospkg.ResourceNotFound):
                why = (
                    f'there is no ROS package {node.package!r} on ROS_PACKAGE_PATH: install it, or'
                    " source its workspace's setup.bash"
                )
            self.problems.append(Problem(name, node.filename, why))
            return
        reason = 'as asked for' if is_kept_apart else _reason(command[0], node)
        if reason:
            why = _lacks(command[0], node)
            if why:
                self.problems.append(Problem(name, node.filename, why, bool(node.required)))
            else:
                self._put_apart(name, node, reason)
            return
        self.here.append(
            LaunchedNode(
                name=name,
                program=f'{node.package}/{node.type}',
                path=command[0],
                args=command[1:],
                env={str(key): str(value) for key, value in node.env_args},
                cwd=os.path.dirname(command[0]) if node.cwd == 'node' else rospkg.get_ros_home(),
                output=node.output or 'log',
                is_required=bool(node.required),
                respawn_delay=float(node.respawn_delay or 0) if node.respawn else None,
                file=node.filename,
            )
        )

    def _put_apart(self, name: str, node: Any, reason: str) -> None:
        self.apart.append(node)
        self.reasons.setdefault(reason, []).append(name)

    def set_parameters(self, run_id: str) -> None:
        """Run what is to run before (rosparam's delete and dump), clear and set the parameters.

        :raises PharosError: if a command fails, or the master refuses
        """
        try:
            _ParameterSetter(run_id, self.config).set_all()
        except roslaunch.core.RLException as error:
            raise PharosError(f'{self.path}: {error}') from error

    def config_apart(self) -> Any:
        """The configuration that is left for roslaunch: the nodes apart, without the parameters."""
        rest = copy.copy(self.config)
        rest.nodes = self.apart
        rest.nodes_core, rest.tests, rest.executables = [], [], []
        rest.params, rest.clear_params, rest.config_errors = {}, [], []
        # whether there is another machine among them
        machines = [node.machine for node in rest.nodes]
        rest.machines = {machine.name: machine for machine in [rest.machines[''], *machines]}
        return rest


def _name_of(node: Any) -> str:
    if not node.name:  # roslaunch invents one, which says less
        node.name = rosgraph.names.anonymous_name(node.type)
    return str(rosgraph.names.ns_join(node.namespace, node.name))


def _as_text(value: object) -> str:
    """As a launch file writes it."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _command(node: Any) -> List[str]:
    """The command line by which roslaunch would start the node, without its launch-prefix."""
    arguments = roslaunch.node_args.create_local_process_args(
        node, node.machine, env=os.environ  # else what ROS_PACKAGE_PATH was at first
    )
    prefix = shlex.split(node.launch_prefix) if node.launch_prefix else []
    return list(arguments[len(prefix) :])


def _interpreter(path: str) -> List[str]:
    """The words of a script's first line that say what is to run it; none for other programs."""
    with open(path, 'rb') as file:
        line = file.readline(256).decode(errors='replace')
    return line[2:].split() if line.startswith('#!') else []


def _lacks(path: str, node: Any) -> str:
    """Why the system cannot start the program of a node, as far as that can be seen."""
    environment = dict(node.env_args)
    prefix = shlex.split(node.launch_prefix or '')[:1]
    if (
        prefix
        and '/' not in prefix[0]
        and not shutil.which(prefix[0], path=environment.get('PATH'))
    ):
        return f'its launch-prefix names {prefix[0]}, which is not there'
    with open(path, 'rb') as file:
        begin = file.read(2000)
    words = _interpreter(path)
    if not words:
        # what is not text may be of a kind that the system knows
        if b'\0' in begin:
            return ''
        return (
            f'{path} does not begin with a line such as #!/usr/bin/python3: the system does not know'
            ' what is to run it'
        )
    named = [word for word in words[1:] if not word.startswith('-') and '=' not in word]
    if os.path.exists(words[0]):
        is_env = os.path.basename(words[0]) == 'env'
        if not (is_env and named and shutil.which(named[0]) is None):
            return ''
    else:
        named = words
    return f'the first line of {path} names {named[0]}, which is not there'


def _reason(path: str, node: Any) -> str:
    """Why a node of this host cannot be one of this process; empty where it can."""
    if node.launch_prefix:
        return 'with a launch-prefix'
    if node.cwd is not None and not working_directory.is_possible():
        return 'with a cwd, which all nodes of a process share on this system'
    if not any(map(_is_python, _interpreter(path))):
        return 'not written in Python, or for another one than this'
    return MAKES_NODES if uses_pharos(path) else ''


def _is_python(word: str) -> bool:
    folder, base = os.path.split(word)
    match = _PYTHON.fullmatch(base)
    if not match or match.group(2) not in (None, f'.{sys.version_info[1]}'):
        return False
    # a virtual environment has packages of its own
    environment = os.path.dirname(folder)
    is_virtual = bool(folder) and os.path.exists(os.path.join(environment, 'pyvenv.cfg'))
    return not is_virtual or os.path.realpath(environment) == os.path.realpath(sys.prefix)
