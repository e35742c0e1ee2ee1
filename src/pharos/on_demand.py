"""What is built on the facade, and loaded only when it is used: its exports, and its modules."""
import importlib
import sys
from typing import Any, List

_MODULES = {
    'Composition': 'compose.composition',
    'Graph': 'live.graph',
    'ScriptNode': 'compose.script',
}


def module(name: str) -> Any:
    """A module of this package, such as 'live.plot'."""
    return importlib.import_module(f'pharos.{name}')


def __getattr__(name: str) -> Any:
    """What ``pharos.ScriptNode`` is: the package has this function, too (PEP 562)."""
    if name not in _MODULES:
        hint = module('wrong_guesses').hint(name)
        raise AttributeError(f"module 'pharos' has no attribute {name!r}{hint}")
    return getattr(module(_MODULES[name]), name)


def __dir__() -> List[str]:
    return sorted({*vars(sys.modules['pharos']), *_MODULES})
