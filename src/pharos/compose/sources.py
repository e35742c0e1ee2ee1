"""Read the sources of programs, to find out which ones need a process of their own."""
from __future__ import annotations

import ast
import os
import pathlib
import re
import sys
from functools import lru_cache
from typing import Any

from pharos.errors import PharosError
from pharos.private_rospy.loader import SYSTEM_FOLDERS, source_places

_PYTHON = re.compile(r'#!\s*(\S*/)?(env\s.*\b)?python(3(?:\.\d+)?)?\b')
_VERSIONS = None, '3', f'3.{sys.version_info.minor}'  # that a first line may name
_PYTHON_FOLDERS = None, '/usr/bin/', '/bin/', os.path.dirname(sys.executable) + '/'
#: catkin's stand-in for a script in a devel space, which names and runs the script's file
_WRAPPER = re.compile(r'^python_script = (.+?)$.*exec\(compile\(', re.MULTILINE | re.DOTALL)
_WRAPPER_LENGTH = 4000  # characters
#: code that shows windows, takes signals, or has one state for the whole process
_NEEDS_PROCESS = re.compile(
    r'^[ \t]*(?:import|from)[ \t]+(?:tkinter|PyQt\d|PySide\d|python_qt_binding'
    r'|rqt_\w+|qt_gui|gtk|wx|pygame|turtle|pylab|matplotlib\.pyplot)\b'
    r'|^[ \t]*from[ \t]+matplotlib[ \t]+import[^\n]*\bpyplot\b'
    r'|\bgi\.require_version\(.Gtk|\bcv2\.(?:imshow|namedWindow)\(|\breactor\.run\('
    r'|\.add_signal_handler\(|\bsignal\.(?:alarm|setitimer|pause)\('
    r'|\bos\.chdir\(|\bSIG(?:USR[12]|HUP|CHLD|ALRM)\b|\bProcessPoolExecutor\b|\bsocket\.setdefaulttimeout\('
    r'|\bweb\.run_app\(|\buvicorn\.run\(',
    re.MULTILINE,
)
#: code that sets environment variables other than ROS's, or has numpy print otherwise
_NEEDS_GROUP = re.compile(
    r'\benviron\[\s*(?![\'"]ROS)[^]\n]*\]\s*=(?!=)|\bdel\s+os\.environ\b|\benviron\s*\|='
    r'|\benviron\.(?:update\(|(?:setdefault|pop)\(\s*(?![\'"]ROS))|\bos\.putenv\('
    r'|^[ \t]*\w+[ \t]*=[ \t]*os\.environ[ \t]*$|\bset_printoptions\(',
    re.MULTILINE,
)
_IMPORT = re.compile(
    r'^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]*(\([^)]*\)|[^\n(]+)|import[ \t]+([\w., \t]+))',
    re.MULTILINE,
)


def source_of(path: str) -> str:
    """Return the file with the source of a program.

    :param path: the program, or the wrapper that catkin's devel space has for a program
    """
    with open(path, errors='replace') as file:
        wrapper = _WRAPPER.search(file.read(_WRAPPER_LENGTH))
    return str(ast.literal_eval(wrapper[1])) if wrapper else path


def compile_program(path: str) -> Any:
    """Return the compiled code of a program.

    :raises PharosError: if the file cannot be read as Python 3
    """
    try:
        # compile() decodes bytes as the file's first lines say
        return compile(pathlib.Path(path).read_bytes(), path, 'exec', dont_inherit=True)
    except (SyntaxError, ValueError, OSError) as error:
        line = getattr(error, 'lineno', None) or 1
        raise PharosError(f'{path}:{line}: cannot be read as Python 3: {error}') from error


def why_apart(path: str, may_show_windows: bool = False) -> str:
    """Return why a program of a launch file needs a plain process, as text; else ''.

    :param path: the program, whose first line must name Python 3
    :param may_show_windows: True: ask the first line alone
    """
    return why_not_this_python(path) or ('' if may_show_windows else needs_process(path))


def why_not_this_python(path: str, needs_first_line: bool = True) -> str:
    """Return why this Python cannot run a program, by its first line, as text; else ''.

    :param needs_first_line: False: a program without a first line for the system is one of Python
    """
    with open(path, errors='replace') as file:
        first_line = file.readline(256)
    python = _PYTHON.match(first_line)
    if not (needs_first_line or first_line.startswith('#!')):
        return ''
    if not python:
        return 'it is not a program of Python 3'
    folder, _, version = python.groups()
    if folder not in _PYTHON_FOLDERS or version not in _VERSIONS:
        return f'its first line names {python[0][2:].strip()}'
    return ''


def needs_process(path: str) -> str:
    """Return why a Python program needs a plain process, as text; else ''."""
    match = _search(path, _NEEDS_PROCESS)
    return match and f'it has {match!r}, which needs one; --here overrides this'


def environment_of(pairs: list[tuple[str, str]]) -> tuple[tuple[str, str], ...]:
    """Return the environment variables that a launch file sets for a node, sorted, without ROS's."""
    return tuple(sorted((name, value) for name, value in pairs if not name.startswith('ROS')))


def needs_group(path: str) -> str:
    """Return the code of a Python program that sets environment variables or print options, or ''.

    In a process with other programs, code in C and shared modules do not see its variables, and all
    have its print options of numpy.
    """
    return _search(path, _NEEDS_GROUP)


def forget_files() -> None:
    """Look for the files of modules anew: a user may have moved some."""
    _user_file.cache_clear()


def _search(path: str, pattern: re.Pattern[str]) -> str:
    """Return the first text of a program that a pattern matches, or ''.

    This also reads the program's modules that lie beside the program or in its own package; not those
    of libraries, which may have such code for others.
    """
    program = pathlib.Path(source_of(path)).resolve()
    packages = [folder for folder in program.parents if (folder / 'package.xml').is_file()]
    own_folder = f'{packages[0] if packages else program.parent}/'
    files = [program]
    for file in files:  # the list grows meanwhile
        code, names = _read(file, file.stat().st_mtime_ns, pattern)
        if code:
            return code
        for name in names:
            imported_file = _user_file(name, file.parent, tuple(sys.path))
            is_own = imported_file and str(imported_file.resolve()).startswith(own_folder)
            if is_own and imported_file not in files:
                files.append(imported_file)  # type: ignore[arg-type]
    return ''


@lru_cache(None)
def _read(file: pathlib.Path, change_time: int, pattern: re.Pattern[str]) -> tuple[str, set[str]]:
    """Return the first text of a file that a pattern matches, or '', and the names that it imports."""
    text = re.sub('#.*', '', file.read_text(errors='replace'))
    match = pattern.search(text)
    return match[0].strip() if match else '', set(_imported_names(text))


def _imported_names(text: str) -> Any:
    """Yield the names that could be modules in the imports of a text."""
    for package, names, modules in _IMPORT.findall(text):
        yield package
        yield from re.findall(r'[\w.]+', modules)
        for name in re.findall(r'\w+', names):
            yield f'{package}.{name}'


@lru_cache(None)
def _user_file(
    module: str, folder: pathlib.Path, search_path: tuple[str, ...]
) -> pathlib.Path | None:
    """Return the file of a module in a folder, or in a package outside of the system's, or None."""
    top_name, *rest = module.lstrip('.').split('.')  # a relative one is sought in the folder, too
    if not top_name:
        return None
    _, folders = source_places(top_name)
    for place in [folder / top_name, *map(pathlib.Path, folders)]:
        base = place.joinpath(*rest)
        for file in base.with_suffix('.py'), base / '__init__.py':
            if file.is_file() and not str(file).startswith(SYSTEM_FOLDERS):
                return file
    return None
