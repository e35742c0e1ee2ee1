"""The debugger in frames of what is over: IPython's in its shells, else pdb."""
import contextvars
import importlib
import pdb
from types import TracebackType
from typing import Any

from pharos import node_registry
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
        prompt = above(raw=True)(session.prompt)
        # What other threads print finds the prompt in the session that all have by default; IPython
        # gives the debugger's one of its own since 8.13 or so.
        session.prompt = lambda: contextvars.Context().run(prompt)
    looking.reset()

    def end() -> None:
        leave(session)  # whose prompt is in a thread of its own

    node_registry.before_stop_all(end)  # which a signal asks for
    try:
        looking.interaction(None, frames)
    finally:
        node_registry.not_before_stop_all(end)


def leave(prompt: Any) -> None:
    """Have a session of prompt_toolkit's end as by Ctrl-D, from whatever thread; None is none."""
    application = prompt and prompt.app
    if application and application.loop is not None:
        application.loop.call_soon_threadsafe(_leave, application)


def _leave(application: Any) -> None:
    if application.is_running:
        application.exit(exception=EOFError)
