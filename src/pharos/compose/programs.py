"""Finds programs as rosrun does, and tells whether they are written in Python."""
import ast
import os
import re
import tokenize
from typing import Any, Optional

from pharos import program_files
from pharos.errors import PharosError, UnknownNodeError

#: what catkin puts into a devel space for a script: it runs the file that it names
_WRAPPER = re.compile(
    rb'# generated from catkin/cmake/template/script.py.in.*^python_script = (.+?)$',
    re.MULTILINE | re.DOTALL,
)
#: a program of ours makes its nodes itself: within another one they would not end with it
_USES_PHAROS = re.compile(rb'^\s*(from|import) pharos\b', re.MULTILINE)
#: why it runs apart, and what to do
MAKES_NODES = (
    'programs that use pharos make their nodes themselves; for one process with all of them, write'
    ' a program that makes these beside master.compose(), as doc/compose.md says'
)
_ELF = b'\x7fELF'  # how compiled programs begin


def find_program(package: Any, executable: Optional[str] = None) -> str:
    """The path of a program, as rosrun looks it up; without ``executable``, the file ``package``.

    :raises TypeError: if that is no text, nor a path
    :raises UnknownNodeError: if there is none, or several
    """
    if executable is None:
        if not isinstance(package, (str, os.PathLike)):
            raise TypeError(
                f'a program is given by its package and its name, or by its path, not {package!r}'
            )
        path = os.path.abspath(os.fspath(package))
        if not os.path.isfile(path):
            raise UnknownNodeError(
                f'there is no file {path}: to load a program of a package, give the names of both'
            )
        return path
    paths = program_files.find(package, executable)
    # a wrapper in the devel space and what it wraps are one
    if len({os.path.realpath(source_of(path)) for path in paths}) > 1:
        raise UnknownNodeError(
            f'the ROS package {package} has several programs {executable!r}: load the one that you'
            f" mean by its path, of {', '.join(paths)}"
        )
    return paths[0]


def source_of(path: str) -> str:
    """The file that has the source of a program: itself, or where it is catkin's wrapper in a devel
    space, the file that this runs."""
    with open(path, 'rb') as file:
        wrapper = _WRAPPER.search(file.read(2000))
    return str(ast.literal_eval(wrapper.group(1).decode())) if wrapper else path


def uses_pharos(path: str) -> bool:
    """Whether a program makes nodes with pharos itself, and so is to be a process of its own."""
    with open(source_of(path), 'rb') as file:
        return _USES_PHAROS.search(file.read()) is not None


def check_source(path: str) -> None:
    """Look whether a program can be run in this process.

    :raises PharosError: if it cannot be read, or is no Python program
    """
    try:
        with open(path, 'rb') as file:
            if file.read(len(_ELF)) == _ELF:
                raise PharosError(
                    f'{path} is no Python program but a compiled one, which cannot run in this'
                    ' process: start it with master.run()'
                )
        with tokenize.open(path) as text:
            compile(text.read(), path, 'exec', dont_inherit=True)
    except (SyntaxError, ValueError) as error:  # ValueError: it has a null byte
        raise PharosError(
            f'{path} is no Python 3 program: {error}. Mend it, or start what is not written in'
            ' Python with master.run()'
        ) from error
    except OSError as error:
        raise PharosError(f'{path} cannot be read: {error.strerror}') from error
