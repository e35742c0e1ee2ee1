"""Change asyncio, dataclasses and importlib for the whole process, as programs need it.

asyncio makes an event loop in the main thread of a program, too. The others find private modules.
"""
import asyncio
import contextlib
import dataclasses
import sys
import threading
from importlib.machinery import SourceFileLoader
from typing import Any

from pharos.private_rospy.inspecting import owner_of_builtins, private_module
from pharos.private_rospy.loader import process_lock
from pharos.waiting import current

#: asyncio's policies derive from this; Python 3.14 has changed its name
_PREFIX = '_' if sys.version_info >= (3, 14) else ''
_POLICY: Any = getattr(asyncio.events, f'{_PREFIX}BaseDefaultEventLoopPolicy')
#: packages whose frames are between a program and what it imports
_IMPORTERS = 'importlib', 'imp', '_frozen_importlib', '_frozen_importlib_external'


def _get_event_loop(policy, original=_POLICY.get_event_loop):
    """Return the event loop of this thread; make one in the main thread of a program.

    asyncio makes one in the main thread of a process, up to Python 3.13.
    """
    run = current.run
    if hasattr(run, 'event_loops') and threading.current_thread() is run.main:
        with contextlib.suppress(RuntimeError):
            return original(policy)
        if not _PREFIX:
            policy.set_event_loop(policy.new_event_loop())
    return original(policy)


def _new_event_loop(policy, original=_POLICY.new_event_loop):
    """Return a new event loop; the end of the program that has made the loop closes it."""
    loop = original(policy)
    if hasattr(current.run, 'event_loops'):
        current.run.event_loops.add(loop)
    return loop


_POLICY.get_event_loop = _get_event_loop
_POLICY.new_event_loop = _new_event_loop


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
