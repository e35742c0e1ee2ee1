"""The debugger in frames of what is over: IPython's in its shells, else pdb."""
import pdb
import sys
from types import TracebackType
from typing import Any


def look_at(frames: TracebackType) -> None:
    """Have the user look at the innermost of the frames, in this thread, until he or she quits."""
    ipython: Any = sys.modules.get('IPython')
    shell = ipython and ipython.get_ipython()
    debugger = shell.debugger_cls if shell else pdb.Pdb
    # else a Ctrl-C after its 'continue' is taken for a wish to debug, and stops no node any more
    looking = debugger(nosigint=True)
    looking.reset()
    looking.interaction(None, frames)
