"""Cover the differences between the versions of Python, from 3.8 on."""
import os
import sys


def _standard_modules() -> frozenset:
    """Return the names of the standard library's modules."""
    if sys.version_info >= (3, 10):
        return sys.stdlib_module_names
    folder = os.path.dirname(os.__file__)
    files = [*os.listdir(folder), *os.listdir(f'{folder}/lib-dynload')]
    return frozenset([*sys.builtin_module_names, *(file.partition('.')[0] for file in files)])


STANDARD_MODULES = _standard_modules()
