"""Cover the differences between the versions of Python, from 3.8 on."""
import os
import pkgutil
import sys


def _standard_modules():
    """Return the names of the standard library's modules."""
    if sys.version_info >= (3, 10):
        return sys.stdlib_module_names
    folder = os.path.dirname(os.__file__)
    folders = [folder, os.path.join(folder, 'lib-dynload')]
    found_names = [module.name for module in pkgutil.iter_modules(folders)]
    return frozenset([*found_names, *sys.builtin_module_names])


STANDARD_MODULES = _standard_modules()
