"""What is built on the facade, and loaded only when it is used."""
import importlib
import sys
from typing import Any, List

_MODULES = {
    'Composition': 'pharos.compose.composition',
    'Graph': 'pharos.live.graph',
    'ScriptNode': 'pharos.compose.script',
}


def __getattr__(name: str) -> Any:
    """What ``pharos.ScriptNode`` is: the package has this function, too (PEP 562)."""
    if name not in _MODULES:
        raise AttributeError(f"module 'pharos' has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> List[str]:
    return sorted({*vars(sys.modules['pharos']), *_MODULES})
