"""The debugger in frames of what is over: IPython's in its shells, else pdb."""
import importlib
import pdb
from types import TracebackType

from pharos.reloading import ipython_shell


def look_at(frames: TracebackType) -> None:
    """Have the user look at the innermost of the frames, in this thread, until he or she quits."""
    shell = ipython_shell()
    debugger = shell.debugger_cls if shell else pdb.Pdb
    # else a Ctrl-C after its 'continue' is taken for a wish to debug, and stops no node any more
    looking = debugger(nosigint=True)
    session = getattr(looking, 'pt_app', None)  # prompt_toolkit's, which pdb has not
    if session is not None:
        # as IPython has it of its own prompt: what is printed meanwhile comes above the line
        above = importlib.import_module('prompt_toolkit.patch_stdout').patch_stdout
        session.prompt = above(raw=True)(session.prompt)
    looking.reset()
    looking.interaction(None, frames)
