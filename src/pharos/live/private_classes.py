"""Have dataclasses and importlib find private modules, in the whole process.

Programs load this, and libraries by :meth:`Node.ros_import`.
"""
import dataclasses
import sys
from importlib.machinery import SourceFileLoader

from pharos.private_rospy.inspecting import owner_of_builtins, private_module
from pharos.private_rospy.loader import process_lock

#: packages whose frames are between a program and what it imports
_IMPORTERS = 'importlib', 'imp', '_frozen_importlib', '_frozen_importlib_external'


def _exec_module(loader, module, original=SourceFileLoader.exec_module):
    """Give the node's rospy to a module that a private one loads from a file, by importlib or imp."""
    frame = sys._getframe(1)
    # code in C may import in a thread without another frame
    while frame and frame.f_globals.get('__name__', '').partition('.')[0] in _IMPORTERS:
        frame = frame.f_back  # type: ignore[assignment]
    owner = frame and owner_of_builtins(frame.f_globals.get('__builtins__'))
    if owner:
        vars(module)['__builtins__'] = owner.builtins
    original(loader, module)


SourceFileLoader.exec_module = _exec_module  # type: ignore[assignment]


def _process_class(cls, *args, original=dataclasses._process_class, **kwargs):  # type: ignore
    """Have @dataclass find the module of a private class: it looks in sys.modules for ClassVar.

    Another node may be importing a module of the same name.
    """
    module = private_module(cls)
    if module is None:
        return original(cls, *args, **kwargs)
    name = cls.__module__
    with process_lock:
        shown_module = sys.modules.get(name)
        sys.modules[name] = module
        try:
            return original(cls, *args, **kwargs)
        finally:
            if shown_module:
                sys.modules[name] = shown_module
            else:
                del sys.modules[name]


dataclasses._process_class = _process_class  # type: ignore[attr-defined]
