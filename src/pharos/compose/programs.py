"""Finds programs as rosrun does, and tells whether they are written in Python."""
import ast
import os
import tokenize
from typing import Any, Optional

from pharos import ros_process
from pharos.errors import PharosError, UnknownNodeError

# what catkin puts into a devel space for a script: it runs the file of this variable
_RELAY = '# generated from catkin/cmake/template/script.py.in'
_RELAYED = 'python_script'


def find_program(package: Any, executable: Optional[str] = None) -> str:
    """The path of a program, as rosrun looks it up; without ``executable``, the file ``package``.

    :raises UnknownNodeError: if there is none, or several
    """
    if executable is None:
        path = os.path.abspath(os.fspath(package))
        if not os.path.isfile(path):
            raise UnknownNodeError(
                f'there is no file {path}: to load a program of a package, give the names of both'
            )
        return path
    paths = ros_process.find(package, executable)
    # a devel space has a wrapper of what the package's folder has
    if len(paths) > 1 and len({os.path.realpath(source_of(path)) for path in paths}) > 1:
        raise UnknownNodeError(
            f'the ROS package {package} has several programs {executable!r}: load the one that you'
            f" mean by its path, of {', '.join(paths)}"
        )
    return paths[0]


def source_of(path: str) -> str:
    """The path of the source file of a Python program: the file itself, or the one that catkin's
    wrapper in a devel space runs.

    :raises PharosError: if it cannot be read, or is no Python program
    """
    tree = _parse(path)
    with open(path, 'rb') as file:
        is_relay = _RELAY.encode() in file.read(1000)
    if not is_relay:
        return path
    for statement in tree.body:
        targets = getattr(statement, 'targets', [None])
        if isinstance(statement, ast.Assign) and getattr(targets[0], 'id', None) == _RELAYED:
            source = str(ast.literal_eval(statement.value))
            _parse(source)
            return source
    return path


def _parse(path: str) -> ast.Module:
    try:
        with open(path, 'rb') as file:
            if file.read(4) == b'\x7fELF':
                raise PharosError(
                    f'{path} is no Python program but a compiled one, which cannot run in this'
                    ' process: start it with master.run()'
                )
        with tokenize.open(path) as text:
            return ast.parse(text.read(), path)
    except (SyntaxError, ValueError) as error:  # ValueError: it has a null byte
        raise PharosError(
            f'{path} is no Python 3 program: {error}. Start what is not written in Python with'
            ' master.run()'
        ) from error
    except OSError as error:
        raise PharosError(f'{path} cannot be read: {error.strerror}') from error
