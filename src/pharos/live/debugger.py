"""The debugger in frames of what is over: IPython's in its shells, else pdb."""
import pdb
from types import TracebackType

from pharos.reloading import ipython_shell


def look_at(frames: TracebackType) -> None:
    """Have the user look at the innermost of the frames, in this thread, until he or she quits."""
    shell = ipython_shell()
    debugger = shell.debugger_cls if shell else pdb.Pdb
    # else a Ctrl-C after its 'continue' is taken for a wish to debug, and stops no node any more
    looking = debugger(nosigint=True)
    looking.reset()
    looking.interaction(None, frames)
