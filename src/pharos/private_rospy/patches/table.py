"""How an override gets into the table of patches, and from there into the rospy of a node."""
import functools
import types
from typing import Any, Callable, Collection, List, NamedTuple

from pharos.errors import PharosError


class Patch(NamedTuple):
    """One row of the table."""

    module: str  # of rospy or rosgraph; or of a library on it, which a node may never load
    target: str  # 'Class.method', or the name of a function or variable of the module
    reason: str
    function: Callable
    kind: str  # 'replaced', 'added' or 'substituted'

    def apply(self, module: types.ModuleType, node: Any) -> None:
        """Put the override into a private module that has just been loaded for ``node``.

        :raises PharosError: where rospy is not what the patch was written for
        """
        class_name, _, name = self.target.rpartition('.')
        owner = getattr(module, class_name, None) if class_name else module
        is_added = self.kind == 'added'  # perhaps over one that the class inherits
        original = vars(owner).get(name) if owner and is_added else getattr(owner, name, None)
        if owner is None or (original is None) is not is_added:
            raise self.error('is there already' if original else 'is not there')
        checked = None
        if self.kind == 'replaced':
            if not isinstance(original, types.FunctionType):
                raise self.error('is no function')
            checked = _checked_cell(original)
            original = checked.cell_contents if checked else original
            expected, found = _parameters(self.function), _parameters(original)
            if expected != found:
                raise self.error(f'takes ({", ".join(found)}), not ({", ".join(expected)})')
        override = _with(self.function, node=node, module=module, original=original)
        if self.kind == 'substituted':
            override = override()
        if checked:
            checked.cell_contents = override
        else:
            setattr(owner, name, override)

    def error(self, found: str) -> PharosError:
        """The error for what was found instead of the target."""
        return PharosError(
            f'the patch {self.function.__module__}.{self.function.__name__} does not fit this'
            f' release of rospy: {self.module}.{self.target} {found}. pharos knows the releases'
            ' that its documentation lists in patches.md'
        )


TABLE: List[Patch] = []


def patch(module: str, target: str, reason: str, kind: str = 'replaced') -> Callable:
    """Decorates the function that replaces one of rospy's."""

    def enter(function):
        if any((other.module, other.target) == (module, target) for other in TABLE):
            raise PharosError(f'{module}.{target} has two patches')
        TABLE.append(Patch(module, target, reason, function, kind))
        return function

    return enter


#: Decorates a function that a class or module of rospy has not.
addition = functools.partial(patch, kind='added')
#: Decorates a function that is called once per node, and returns what a module shall have under
#: that name.
substitute = functools.partial(patch, kind='substituted')


def apply(module: types.ModuleType, node: Any) -> None:
    """Apply all patches of a private module, right after its code has run."""
    for each in TABLE:
        if each.module == module.__name__:
            each.apply(module, node)


def check_applied(names: Collection[str]) -> None:
    """Raise PharosError for a patch of a module of packages that are loaded, but not it."""
    packages = {name.partition('.')[0] for name in names}
    for each in TABLE:
        if each.module.partition('.')[0] in packages and each.module not in names:
            raise each.error('is not there')


def _with(function, **given):
    """A copy of the function that has these for its keyword-only parameters, as far as it names
    them."""
    code = function.__code__
    copy = types.FunctionType(code, function.__globals__, function.__name__, function.__defaults__)
    own = code.co_varnames[code.co_argcount : code.co_argcount + code.co_kwonlyargcount]
    copy.__kwdefaults__ = {name: given[name] for name in own}
    copy.__doc__ = function.__doc__
    return copy


def _parameters(function):
    """The names of the positional parameters, those with a default as ``name=``."""
    names = list(function.__code__.co_varnames[: function.__code__.co_argcount])
    for at in range(1, 1 + len(function.__defaults__ or ())):
        names[-at] += '='
    return names


def _checked_cell(function):
    """Where rospy's apivalidate keeps the function that it calls with checked arguments; None for
    other functions."""
    code = function.__code__
    if code.co_name != 'validated_f':
        return None
    return function.__closure__[code.co_freevars.index('f')]
