"""Have inspect find private modules, in the whole process.

It looks for the module of a class or function in ``sys.modules``, which has no private module.
"""
import inspect
import linecache
import sys
from types import ModuleType

from pharos.private_rospy.loader import PrivateModules


def private_module(thing):
    """Return the private module of a class, function, method or frame, or None.

    A class has only the name of its module, the same in all nodes: its module is that of the node
    whose code has called.
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
    return private_module(thing) or original(thing, _filename)


def _getfile(thing, original=inspect.getfile):
    """Find the files of private modules' classes, too: inspect looks for them in sys.modules."""
    module = private_module(thing) if inspect.isclass(thing) else None
    return getattr(module, '__file__', None) or original(thing)


def _getsourcefile(thing, original=inspect.getsourcefile):
    """Return the file of a frame from linecache; rospy asks for that at each line of the log.

    Python looks at the disk, which lets other threads run: the logging thread waits up to 5 ms.
    """
    if inspect.isframe(thing) and thing.f_code.co_filename in linecache.cache:
        return thing.f_code.co_filename
    return original(thing)


inspect.getmodule = _getmodule
inspect.getfile = _getfile
inspect.getsourcefile = _getsourcefile
