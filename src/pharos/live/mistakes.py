"""Mistakes at a prompt: what this package refuses is told by the line that asked for it and one
sentence, without what is below them.

``%tb`` shows all of it.
"""
import copy
import sys
from types import TracebackType
from typing import Any, Callable, Iterator, Optional

from pharos.blocks import attempt
from pharos.errors import PharosError

#: what is raised here for what users do
KINDS = PharosError, ValueError, TypeError, LookupError, AttributeError, TimeoutError
#: packages whose lines are none of the user's
_BELOW = 'IPython', 'pharos', 'rospy'


def own_lines(traceback: TracebackType) -> Optional[TracebackType]:
    """Of a traceback that ends in this package the part that is the user's; None: there is none,
    or it ends elsewhere."""
    frames = list(_frames(traceback))
    if _package(frames[-1]) != 'pharos':
        return None
    own: Optional[TracebackType] = None
    for frame in reversed(frames):
        if _package(frame) not in _BELOW:
            own = TracebackType(own, frame.tb_frame, frame.tb_lasti, frame.tb_lineno)
    return own


def _frames(traceback: Optional[TracebackType]) -> Iterator[TracebackType]:
    while traceback is not None:
        yield traceback
        traceback = traceback.tb_next


def _package(traceback: TracebackType) -> str:
    return str(traceback.tb_frame.f_globals.get('__name__', '')).partition('.')[0]


# -- in IPython


def equip(shell: Any) -> Callable[[], None]:
    """Have a session of IPython's show them so; returns a function that ends it."""
    before = shell.custom_exceptions, shell.CustomTB

    def show(shell: Any, kind: type, error: Exception, traceback: Any, tb_offset: Any) -> None:
        own = own_lines(traceback)
        if own is None:
            shell.showtraceback((kind, error, traceback), tb_offset=tb_offset)
            return
        # a copy has no cause, which IPython would show in full, too
        alone = attempt(lambda: copy.copy(error), error)
        shell.showtraceback((kind, alone, own), tb_offset=0)
        sys.last_value, sys.last_traceback = error, traceback  # for %tb and %debug

    def end() -> None:
        shell.custom_exceptions, shell.CustomTB = before

    shell.set_custom_exc(KINDS, show)
    return end
