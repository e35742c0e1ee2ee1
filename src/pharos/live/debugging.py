"""Open a debugger at the frames of a failure."""
import importlib
import sys


def open_debugger(frames):
    """Open IPython's debugger if IPython is loaded, or else pdb."""
    module_name = 'IPython.core.debugger' if 'IPython' in sys.modules else 'pdb'
    debugger = importlib.import_module(module_name).Pdb()
    debugger.reset()
    debugger.interaction(None, frames)
