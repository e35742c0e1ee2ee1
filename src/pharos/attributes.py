"""What a node has, whether it runs or not: its settings, blocks, failures and log; and what may be
set of it, in its class or on it."""
import inspect
import numbers
import threading
from typing import TYPE_CHECKING, Any, Callable, Dict, FrozenSet, List, Optional, TypeVar

from pharos.blocks import (
    Block,
    attempt,
    check_delegate,
    check_flag,
    check_runs,
    check_soul,
    text_of,
)
from pharos import node_registry
from pharos.errors import NodeStoppedError
from pharos.failures import FailureList, Failures
from pharos.lifecycle import Lifecycle
from pharos.private_rospy.logs import lines_shown
from pharos.private_rospy.settings import Settings
from pharos.seconds import check_seconds
from pharos.transcript import Transcript
from pharos.wrong_guesses import getattr_with_hint, keyword_hint

if TYPE_CHECKING:
    from pharos.master import Master
    from pharos.run import Run

NodeType = TypeVar('NodeType', bound='NodeAttributes')
_SET_ONCE = frozenset(['_master', '_settings', '_errors'])
_made_here = threading.local()  # .node_class: of the node that this thread makes


def _check_bytes(name: str, value: Any) -> Any:
    is_number = isinstance(value, numbers.Real)
    if not (is_number and value > 0):
        raise ValueError(f'{name} is a number of bytes above 0, not {value!r}')
    return value


def _check_run(name: str, value: Any) -> Any:
    if value is not None and not hasattr(value, 'dispatcher'):  # which a Run has
        raise _not_to_be_set(name)
    return value


# name of an attribute -> check(name, value) returns the value that it gets
_CHECKS: Dict[str, Callable[[str, Any], Any]] = {
    'connect_timeout': check_seconds,
    'stop_timeout': check_seconds,
    'client_timeout': check_seconds,
    'queue_bytes': _check_bytes,
    'soul': lambda name, block: check_soul(block),
    'delegate': lambda name, block: check_delegate(block),
    'latest_run': _check_run,
}
# names of levels -> rospy's
_LEVELS = {level: level for level in ('debug', 'info', 'warning', 'error', 'critical')}
_LEVELS.update(warn='warning', err='error', fatal='critical')


class NodeAttributes:
    """What lasts of a node from its making on; the base of Node alone, which adds its life.

    Whatever a user sets is checked here, so that the node can still work, and stop.
    """

    #: seconds that a topic's first message waits for the subscribers the master knows
    connect_timeout = 2.0
    #: bytes of messages, about, that wait for a slow receiver for each publisher, or one message
    queue_bytes = 64 << 20
    #: whether any host may ask it to stop, not only this one and the master's
    allow_remote_shutdown = False
    #: seconds in which a client that connects must have said who it is
    client_timeout = 5.0
    #: seconds that :meth:`stop` waits for souls, and for messages under way
    stop_timeout = 2.0
    #: the block that says what the node does, called as ``soul(node)`` by :meth:`execute` and
    #: :meth:`fork`; one that is set while the node runs takes effect with the next run, and
    #: :meth:`renew` has one that loops go on as the new one
    soul: Optional[Block] = None
    #: the block run for each message received, called as ``delegate(message, channel)``; those of a
    #: node run one at a time. The report: ``self receiverDelegate: [:message :channel | ...]``. One
    #: that is set while the node runs takes effect with the next message.
    delegate: Optional[Block] = None

    #: the run of the present start, or the last one; None before the first start
    latest_run: 'Run' = None  # type: ignore[assignment]
    #: names of the methods of Node, without which it could not work, nor stop
    _methods: FrozenSet[str] = frozenset()
    #: what can be asked of it, and is not set, by name
    _properties: Dict[str, property] = {}

    if not TYPE_CHECKING:  # who reads its arguments takes them for those of the nodes

        def __new__(cls, *args, **kwargs):
            if getattr(_made_here, 'node_class', None) is not cls:
                given = [kwargs.get('named'), kwargs.get('name'), *args]
                name = next((repr(each) for each in given if isinstance(each, str)), '...')
                raise TypeError(
                    f'a node is made by a master: Master().create({cls.__name__}, named={name}),'
                    f' not {cls.__name__}()'
                )
            return super().__new__(cls)

        __getattr__ = getattr_with_hint

    def __init_subclass__(cls, is_base: bool = False, **kwargs: Any) -> None:
        """:param is_base: whether it is one of those that make up Node"""
        super().__init_subclass__(**kwargs)
        if is_base:
            methods = inspect.getmembers(cls, inspect.isfunction)
            cls._methods = frozenset(name for name, _ in methods)
            properties = inspect.getmembers(cls, lambda member: isinstance(member, property))
            cls._properties = dict(properties)
            return
        for name, own in cls._properties.items():
            if inspect.getattr_static(cls, name) is not own:  # by the class, or another base of it
                raise _not_to_be_set(name)
        for name in _SET_ONCE.intersection(vars(cls)):
            raise _not_to_be_set(name)
        for name in ('soul', 'delegate'):
            if name in vars(cls) and not isinstance(vars(cls)[name], property):
                raise TypeError(
                    f'{cls.__name__}.{name} would never run: each node has a {name} of its own,'
                    f' given to create() or set. Name it otherwise, and set self.{name} in start()'
                )
        for name in (cls._methods | _CHECKS.keys()).intersection(vars(cls)):
            value = getattr(cls, name)
            checked = value if isinstance(value, property) else cls._checked(name, value)
            if checked is not value:
                setattr(cls, name, checked)
        for name in ('start', 'stop'):
            check_runs(getattr(cls, name), f'{cls.__name__}.{name}')

    def __setattr__(self, name: str, value: Any) -> None:
        if name in ('start', 'stop') or name in _SET_ONCE and name in vars(self):
            raise _not_to_be_set(name)
        if name == 'name':
            raise AttributeError(
                f'{self.name} is the name by which the master knows the node: give another one to'
                f' create(), as named={value!r}, and what else {type(self).__name__} is called to'
                ' another attribute'
            )
        super().__setattr__(name, self._checked(name, value))

    @classmethod
    def _checked(cls, name: str, value: Any) -> Any:
        """The value that an attribute gets, in a class of nodes or in one of them."""
        if name in _CHECKS:
            return _CHECKS[name](name, value)
        is_taken = name in cls._methods and not callable(value)
        if is_taken or name in cls._properties:
            raise _not_to_be_set(name)
        return value

    def _configure(
        self, master: 'Master', settings: Settings, soul: Optional[Block], delegate: Optional[Block]
    ) -> None:
        self._master = master
        self._settings = settings
        self._errors = Failures(self._tell_failure)
        self.soul, self.delegate = soul, delegate

    @property
    def master(self) -> 'Master':
        """The :class:`Master` that created the node."""
        return self._master

    @property
    def lifecycle(self) -> Lifecycle:
        """Where the node is in its life: a :class:`Lifecycle`."""
        return Lifecycle.NEW if self.latest_run is None else self.latest_run.lifecycle

    @property
    def is_running(self) -> bool:
        """Whether the node is started and no stop has begun."""
        return self.lifecycle is Lifecycle.RUNNING

    @property
    def current_run(self) -> 'Run':
        """The :class:`~pharos.run.Run` of the present start.

        :raises NodeStoppedError: if the node is not started
        """
        if node_registry.is_superseded(self):
            raise NodeStoppedError(f'{self.name} was stopped while it started, and started again')
        run, lifecycle = self.latest_run, self.lifecycle
        if run is not None and lifecycle in (Lifecycle.RUNNING, Lifecycle.STOPPING):
            return run
        if lifecycle is Lifecycle.NEW and node_registry.is_in_start(self):
            raise NodeStoppedError(needs_super(self))
        hint = ''
        if lifecycle is Lifecycle.NEW:
            hint = ', which create() does when __init__ has run; what needs it'
            hint += ' goes into a start() of its own, after super().start()'
        raise NodeStoppedError(f'{self.name} is {lifecycle.value}: start() it first{hint}')

    @property
    def name(self) -> str:
        """The node's name, as the master knows it: '/robot1/driver'."""
        return self._settings.name

    @property
    def tcp_port(self) -> int:
        """The TCPROS port; the one asked for, before the first start."""
        return self._settings.tcp_port

    @property
    def xmlrpc_port(self) -> int:
        """The XML-RPC port; the one asked for, before the first start."""
        return self._settings.xmlrpc_port

    @property
    def errors(self) -> Failures:
        """The exceptions that blocks raised, the newest last: of identical ones the newest alone.

        100 are kept, among them the first, for it may be the cause of the others. Who has seen to
        them may ``pop`` or ``clear`` them.
        """
        return self._errors

    @property
    def failures(self) -> FailureList:
        """For each of :attr:`errors` its :class:`~pharos.Failure`: what failed, on what, how often;
        a list, which is shown as a table of cause, block, message, count and time."""
        return self._errors.all()

    def _tell_failure(self, line: str, details: str) -> None:
        text = f'{line}\n{details}' if details else line
        if self._has_no_log:
            Transcript.show(text)
            return
        before = lines_shown()
        attempt(lambda: self.log(text, level='error'))
        if lines_shown() == before or not Transcript.is_where_errors_are:
            Transcript.show(line)

    @property
    def _has_no_log(self) -> bool:
        return self.latest_run is None or self.latest_run.is_over

    def log(self, text: str, level: str = 'info') -> None:
        """Log a line on /rosout, the node's log file and the screen, with the file and line of the
        caller. Where the node is not started, or has stopped, the Transcript shows it.

        :param level: 'debug', 'info', 'warning' (or 'warn'), 'error' or 'fatal'
        """
        try:
            level = _LEVELS[level]
        except KeyError:
            raise ValueError(f"no log level {level!r}: there are {', '.join(_LEVELS)}") from None
        if self._has_no_log:
            Transcript.show(f'[{level.upper()}] {self.name}: {text_of(text)}')
        else:
            log = self.latest_run.rospy.log
            # no wrapper between: rospy looks for the caller of this method
            log('%s', (text,), {}, level=level)


def make(
    node_class: Callable[..., NodeType],
    master: 'Master',
    named: str,
    soul: Optional[Block],
    delegate: Optional[Block],
    args: Any,
    kwargs: Any,
    **settings: Any,
) -> NodeType:
    """A new node of ``node_class``, configured and not yet started."""
    if not (isinstance(node_class, type) and issubclass(node_class, NodeAttributes)):
        raise TypeError(f'a node is made of a subclass of Node, or BlockNode; not {node_class!r}')
    if node_class.__hash__ is None:
        name = node_class.__name__
        raise TypeError(
            f'nodes are told apart by their identity, and {name} compares its nodes by their values:'
            f' write @dataclass(eq=False), or give {name} no __eq__'
        )
    taken = {'named': named, 'soul': soul, 'delegate': delegate, **settings}
    check_not_taken(node_class, [name for name, value in taken.items() if value])
    _made_here.node_class = node_class
    try:
        node: NodeType = node_class.__new__(node_class)
    finally:
        del _made_here.node_class
    settings['shares_connections'] = check_flag('share_connections', master.share_connections)
    node._configure(master, Settings(named, master.url, **settings), soul, delegate)
    try:
        node.__init__(*args, **kwargs)
    except TypeError as error:
        known = [*taken, *inspect.signature(node_class.__init__).parameters]
        hint = keyword_hint(known, kwargs)
        if hint:
            error.args = (f'{error}{hint}',)
        raise
    return node


def needs_super(node: NodeAttributes) -> str:
    """What is said of a start() of a class's own that uses the node before it is started, or does
    not start it."""
    return (
        f'{node.name} is not started: {type(node).__name__}.start() has to call super().start()'
        ' before anything else'
    )


def check_not_taken(node_class: Any, given: List[str], taker: str = 'create()') -> None:
    """Raise TypeError where a keyword that ``taker`` was given, and takes for itself, is one that the
    class's own __init__ waits for, too."""
    parameters = inspect.signature(node_class.__init__).parameters
    for name in given:
        if name in parameters:
            raise TypeError(
                f'{taker} takes {name}= for itself, so that {node_class.__name__}.__init__ would'
                f' never get it: give that parameter another name, such as my_{name}'
            )


def _not_to_be_set(name: str) -> AttributeError:
    hint = ' (a node\'s name is given to create(), as named=)' if name == 'name' else ''
    return AttributeError(
        f'{name} is what each Node has, and needs{hint}: give what else has that name another one,'
        f' such as my_{name}'
    )
