"""Have inspect and dataclasses find private modules, in the whole process.

They look for the module of a class or function in ``sys.modules``, which has no private module.
"""
import dataclasses
import inspect
import linecache
import sys
from types import ModuleType

from pharos.private_rospy.loader import PrivateModules, process_lock


def _private_module(thing):
    """Return the private module of a class, function, method or frame, or None.

    That of a class is one of the node whose code has called.
    """
    owner = None
    if inspect.isclass(thing):
        name = thing.__module__
        frame = sys._getframe()
        while frame and not owner:
            owner = owner_of_builtins(frame.f_globals.get('__builtins__'))
            frame = frame.f_back  # type: ignore[assignment]
    else:
        variables = getattr(thing, 'f_globals', None) or getattr(thing, '__globals__', None) or {}
        name = variables.get('__name__')  # type: ignore[assignment]
        owner = owner_of_builtins(variables.get('__builtins__'))
    module = owner.by_name.get(name) if owner else None
    return module if type(module) is ModuleType else None  # not a stand-in


def owner_of_builtins(module_builtins):
    """Return the PrivateModules that a module's ``__builtins__`` belong to, or None."""
    if type(module_builtins) is not dict:  # those of __main__ are a module
        return None
    owner = getattr(module_builtins.get('__import__'), '__self__', None)
    return owner if isinstance(owner, PrivateModules) else None


def _getmodule(thing, _filename=None, original=inspect.getmodule):
    """Find private modules, too: inspect looks for them in all of sys.modules, in vain."""
    return _private_module(thing) or original(thing, _filename)


def _getfile(thing, original=inspect.getfile):
    """Find the files of private modules' classes, too: inspect looks for them in sys.modules."""
    module = _private_module(thing) if inspect.isclass(thing) else None
    return getattr(module, '__file__', None) or original(thing)


def _getsourcefile(thing, original=inspect.getsourcefile):
    """Return the file of a frame from linecache; rospy asks for that at each line of the log.

    Python looks at the disk, which lets other threads run: the logging thread waits up to 5 ms.
    """
    if inspect.isframe(thing) and thing.f_code.co_filename in linecache.cache:
        return thing.f_code.co_filename
    return original(thing)


def _process_class(cls, *args, original=dataclasses._process_class, **kwargs):  # type: ignore
    """Have @dataclass find the module of a private class: it looks in sys.modules for ClassVar.

    Another node may be importing a module of the same name.
    """
    module = _private_module(cls)
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
inspect.getmodule = _getmodule
inspect.getfile = _getfile
inspect.getsourcefile = _getsourcefile
