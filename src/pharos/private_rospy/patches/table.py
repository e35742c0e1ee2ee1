"""How an override gets into the table of patches, and from there into the rospy of a node."""
import types
from typing import Any, Callable, List, NamedTuple

from pharos.errors import PharosError

REPLACED, ADDED, SUBSTITUTED = 'replaced', 'added', 'substituted'


class Patch(NamedTuple):
    """One row of the table."""

    module: str  # of rospy or rosgraph
    target: str  # 'Class.method', or the name of a function or variable of the module
    reason: str
    function: Callable
    kind: str  # REPLACED, ADDED or SUBSTITUTED

    def __str__(self):
        return f'{self.function.__module__}.{self.function.__name__}'

    def apply(self, module, node):
        """Put the override into a private module that has just been loaded for ``node``.

        :raises PharosError: where rospy is not what the patch was written for
        """
        owner, name = self._find(module)
        original = getattr(owner, name, None)
        given = {'node': node, 'module': module}
        if self.kind == SUBSTITUTED:
            setattr(owner, name, _with(self.function, original=original, **given)())
            return
        if self.kind == ADDED:
            setattr(owner, name, _with(self.function, **given))
            return
        validated = _validated_cell(original)
        if validated is not None:
            original = validated.cell_contents
        if not isinstance(original, types.FunctionType):
            raise self._error('is no function')
        if _parameters(original) != _parameters(self.function):
            raise self._error(
                f'takes ({", ".join(_parameters(original)[0])}),'
                f' not ({", ".join(_parameters(self.function)[0])})'
            )
        replacement = _with(self.function, original=original, **given)
        if validated is not None:
            validated.cell_contents = replacement
        else:
            setattr(owner, name, replacement)

    def _find(self, module):
        """The class or module that the target belongs to, and its name there."""
        *path, name = self.target.split('.')
        owner = module
        for part in path:
            owner = getattr(owner, part, None)
        if owner is None or self.kind != ADDED and not hasattr(owner, name):
            raise self._error('is not there')
        if self.kind == ADDED and hasattr(owner, name):
            raise self._error('is there already')
        return owner, name

    def _error(self, found):
        return PharosError(
            f'the patch {self} does not fit this release of rospy: {self.module}.{self.target}'
            f' {found}. pharos knows the releases that its documentation lists in patches.md'
        )


TABLE: List[Patch] = []


def patch(module: str, target: str, reason: str) -> Callable:
    """Decorates the function that replaces one of rospy's."""
    return _entry(module, target, reason, REPLACED)


def addition(module: str, target: str, reason: str) -> Callable:
    """Decorates a function that a class or module of rospy has not."""
    return _entry(module, target, reason, ADDED)


def substitute(module: str, target: str, reason: str) -> Callable:
    """Decorates a function that is called once per node, and returns what a module shall have
    under that name."""
    return _entry(module, target, reason, SUBSTITUTED)


def _entry(module, target, reason, kind):
    def enter(function):
        if any((other.module, other.target) == (module, target) for other in TABLE):
            raise PharosError(f'{module}.{target} has two patches')
        TABLE.append(Patch(module, target, reason, function, kind))
        return function

    return enter


def apply(module: types.ModuleType, node: Any) -> None:
    """Apply all patches of a private module, right after its code has run."""
    for each in TABLE:
        if each.module == module.__name__:
            each.apply(module, node)


def check_applied(names: Any) -> None:
    """Raise PharosError for a patch of a module that is not among the names of those loaded."""
    for each in TABLE:
        if each.module not in names:
            raise each._error('is not there')


def _with(function, **given):
    """A copy of the function that has these for its keyword-only parameters, as far as it names
    them."""
    copy = types.FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__
    )
    code = function.__code__
    own = code.co_varnames[code.co_argcount : code.co_argcount + code.co_kwonlyargcount]
    copy.__kwdefaults__ = {name: given[name] for name in own}
    copy.__doc__ = function.__doc__
    return copy


def _parameters(function):
    """The names of the positional parameters, and how many of them have a default."""
    code = function.__code__
    return code.co_varnames[: code.co_argcount], len(function.__defaults__ or ())


def _validated_cell(function):
    """Where rospy's apivalidate keeps the function that it calls with checked arguments; None for
    other functions."""
    code = getattr(function, '__code__', None)
    if code is None or code.co_name != 'validated_f':
        return None
    return function.__closure__[code.co_freevars.index('f')]
