"""Pictures by graphviz, whose program ``dot`` runs as a child."""
import contextlib
import os
import pathlib
import stat
import subprocess
import threading
from typing import Collection, List, Union

from pharos.errors import PharosError, missing, suggest

FORMATS = 'svg', 'png', 'pdf', 'dot'
#: programs of graphviz, and the seconds that each may take; the others draw what is too tangled for
#: the first, but know no frames
LAYOUTS = (
    (['dot'], 20.0),
    (['sfdp', '-Goverlap=prism'], 20.0),
    (['sfdp', '-Goverlap=prism', '-Gsplines=line'], 60.0),
)
#: what is longer, in inches, and that many times as long as wide, is a strip that nobody can read
LONGEST, SLIMMEST = 50.0, 6.0


def check_format(path: Union[str, 'os.PathLike[str]'], formats: Collection[str] = FORMATS) -> str:
    """The format that the suffix of a path says.

    :raises ValueError: if it is none of the ``formats``
    :raises TypeError: if it is no path
    """
    if not isinstance(path, (str, os.PathLike)) or '\0' in os.fspath(path):
        kind = ValueError if isinstance(path, str) else TypeError
        raise kind(f"a picture is written to a path such as 'graph.svg', not to {path!r}")
    suffix = pathlib.PurePath(path).suffix[1:].lower()
    if suffix not in formats:
        choices = ', '.join('.' + each for each in formats)
        raise ValueError(
            f'{os.fspath(path)} does not say what picture it is to be: let its name end in'
            f' {choices}{suggest(suffix, formats)}'
        )
    return suffix


def save(dot: str, path: Union[str, 'os.PathLike[str]']) -> None:
    """Write a picture to a file: see :meth:`Graph.save <pharos.Graph.save>`."""
    format_ = check_format(path)
    write(path, dot.encode() if format_ == 'dot' else render(dot, format_))


def render(dot: str, format_: str) -> bytes:
    """The picture that graphviz makes of a text in its language.

    :raises PharosError: if graphviz is not there, or cannot do it
    """
    picture = None
    for program, limit in LAYOUTS:
        with contextlib.suppress(subprocess.TimeoutExpired):
            try:
                # as text, too, whose first line has the size: graph SCALE WIDTH HEIGHT
                text = _run([*program, '-Tplain', f'-T{format_}'], dot, limit)
            except PharosError:
                if picture is not None:
                    break
                raise
            layout, _, picture = text.partition(b'\nstop\n')
            shorter, longer = sorted(map(float, layout.split()[2:4]))
            if longer < LONGEST or longer < SLIMMEST * shorter:
                break
    if picture is None:
        raise PharosError(
            f'graphviz did not draw the picture within {limit:g} s: leave more of the graph out'
        )
    return picture


def _run(program: List[str], dot: str, limit: float) -> bytes:
    try:
        ended = subprocess.run(
            program,
            input=dot.encode(),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            timeout=limit,
            start_new_session=True,  # Ctrl-C is for us to answer
            check=False,
        )
    except OSError as error:
        raise PharosError(
            missing('graphviz draws the picture', error, 'graphviz') + ', or save it as .dot'
        ) from error
    if ended.returncode or not ended.stdout:
        said = ended.stderr.decode(errors='replace').strip()
        raise PharosError(
            f'graphviz cannot draw it: {said or f"{program[0]} ended with {ended.returncode}"}'
        )
    return ended.stdout


def write(path: Union[str, 'os.PathLike[str]'], content: bytes) -> None:
    """Write a file all at once, so that nobody sees half of it; what is no file, such as a pipe, is
    written to.

    :raises PharosError: if it cannot be written
    """
    target = os.path.realpath(path)
    # a name of its own, for that of the target may be as long as names can be
    own_name = f'.{os.getpid()}-{threading.get_ident()}'
    beside = os.path.join(os.path.dirname(target), own_name)
    try:
        if os.path.lexists(target) and not stat.S_ISREG(os.stat(target).st_mode):
            with open(target, 'wb') as file:
                file.write(content)
            return
        try:
            with open(beside, 'xb') as file:
                file.write(content)
            os.replace(beside, target)
        except BaseException:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(beside)
            raise
    except OSError as error:
        raise PharosError(f'{os.fspath(path)} cannot be written: {error.strerror}') from error
