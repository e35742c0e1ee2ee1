"""Making a catkin package: what it may be called, where it goes, and what is to be done next."""
import builtins
import contextlib
import getpass
import importlib.util
import keyword
import os
import pathlib
import re
import shutil
import subprocess
import sys
from typing import Dict, Iterator, List, NamedTuple, Optional, Sequence

import rospkg

from pharos.errors import PharosError, suggest
from pharos.new_package.files import CATKIN_MAKE, IN_ONE, Package, class_name, files_of

NAME = re.compile(r'[a-z][a-z0-9]*(_[a-z0-9]+)*', re.ASCII)
#: what catkin takes for an address: it builds no package whose maintainer has another
EMAIL = re.compile(
    r'[-a-zA-Z0-9_%+]+(\.[-a-zA-Z0-9_%+]+)*@[-a-zA-Z0-9%]+(\.[-a-zA-Z0-9%]+)*\.[a-zA-Z]{2,}'
)
ANYBODY_RUNS = 0o111


class Author(NamedTuple):
    """Who makes the package, for package.xml."""

    name: str
    email: str
    is_known: bool  # or made up, for there has to be one


def create_package(
    name: str, nodes: Sequence[str], directory: pathlib.Path, license_name: str
) -> str:
    """Write a package; returns what there is to do next, as text for a terminal.

    :param nodes: the names of its nodes; one called ``<name>_node``, if there are none
    :param directory: where it becomes a folder of its name
    :param license_name: for package.xml, such as 'BSD-3-Clause'
    :raises ValueError: if it, or a node, cannot be called so
    :raises PharosError: if there is such a folder already, or none can be made there
    """
    nodes = list(nodes) or [f'{name}_node']
    path = pathlib.Path(os.path.abspath(directory)) / name
    _check_package_name(name, path.parent)
    _check_nodes(nodes)
    if not license_name.strip():
        raise ValueError('--license is a name, such as BSD-3-Clause')
    _check_folder(path)
    author = _author(path.parent)
    texts = files_of(Package(name, nodes, author.name, author.email, license_name))
    try:
        path.mkdir()  # before what removes it: another program may have made it meanwhile
        _write_all(path, texts)
    except OSError as error:
        raise PharosError(f'the package cannot be written to {path}: {error}') from error
    return _advice(path, list(texts), author)


# -- what is refused


def _check_package_name(name: str, directory: pathlib.Path) -> None:
    _check_name(name, 'package')
    if len(name) < 2:
        raise ValueError(f'{name!r} cannot be the name of a package: it has two letters or more')
    workspace = workspace_of(directory)
    if name in sys.builtin_module_names or name in getattr(sys, 'stdlib_module_names', ()):
        raise ValueError(
            f'{name!r} cannot be the name of the package, which would hide that module of Python:'
            ' choose another name'
        )
    for other in _namesakes(name):
        # what catkin has built of a package that was here and was removed is no other one
        if workspace is None or workspace not in other.parents:
            raise ValueError(
                f'{name!r} cannot be the name of the package, which would hide {other}: choose'
                ' another name'
            )


def _namesakes(name: str) -> Iterator[pathlib.Path]:
    """Where a Python module and a ROS package of that name are."""
    spec = importlib.util.find_spec(name)
    if spec is not None and spec.origin is not None:
        yield pathlib.Path(spec.origin)
    with contextlib.suppress(rospkg.ResourceNotFound):
        yield pathlib.Path(rospkg.RosPack().get_path(name))


def _check_nodes(nodes: Sequence[str]) -> None:
    for number, node in enumerate(nodes):
        _check_name(node, 'node')
        if hasattr(builtins, class_name(node)):
            raise ValueError(
                f'{node!r} cannot be the name of a node: its class would be {class_name(node)}, and'
                ' Python has that: choose another name'
            )
        if node == IN_ONE:
            raise ValueError(f'{node!r} is the program that runs all nodes: choose another name')
        for former in nodes[:number]:
            if class_name(former) == class_name(node):
                raise ValueError(
                    f'the nodes {former!r} and {node!r} would both be the class {class_name(node)}:'
                    ' choose another name for one'
                )


def _check_name(name: str, what: str) -> None:
    if not NAME.fullmatch(name):
        meant = re.sub(r'[^a-z0-9]+', '_', re.sub(r'(?<=[a-z0-9])(?=[A-Z])', '_', name).lower())
        meant = meant.strip('_0123456789')
        hint = suggest(name, (), [meant]) if NAME.fullmatch(meant) else ''
        raise ValueError(
            f'{name!r} cannot be the name of a {what}{hint}: it begins with a small letter, and has'
            ' small letters, digits and single underscores'
        )
    if keyword.iskeyword(name):
        raise ValueError(f'{name!r} cannot be the name of a {what}: it is a word of Python')


def _check_folder(path: pathlib.Path) -> None:
    if path.exists() or path.is_symlink():
        raise PharosError(f'{path} is there already: choose another name, or another --directory')
    if path.parent.exists() and not path.parent.is_dir():
        raise PharosError(f'{path.parent} is a file: give a folder as --directory')
    if not path.parent.is_dir():
        raise PharosError(f'there is no folder {path.parent}: make it, by mkdir -p {path.parent}')
    for parent in path.parents:
        if (parent / 'package.xml').exists():
            raise PharosError(
                f'{parent} is a package, and catkin looks for no other in it: give the src of a'
                ' workspace as --directory'
            )


# -- what is written


def _author(folder: pathlib.Path) -> Author:
    name, email = (_git_config(key, folder) for key in ('user.name', 'user.email'))
    is_known = bool(name and EMAIL.fullmatch(email))
    if not is_known:
        user = _user()
        name, email = name or user, f'{user}@users.noreply.example.org'
    return Author(name, email, is_known)


def _git_config(key: str, folder: pathlib.Path) -> str:
    """What git has for it there; nothing where there is no git."""
    try:
        ended = subprocess.run(
            ['git', 'config', '--get', key],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            errors='replace',
            check=False,
        )
    except OSError:
        return ''
    return ended.stdout.strip()


def _user() -> str:
    """The user's name, as it can be in an address."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a user of whom the system knows only the number
        user = ''
    return re.sub(r'[^a-zA-Z0-9_]+', '_', user) or 'user'


def _write_all(path: pathlib.Path, texts: Dict[str, str]) -> None:
    """Write all files, or leave nothing, also where Ctrl-C comes meanwhile."""
    try:
        for file, text in texts.items():
            _write(path / file, text, is_program=file.startswith('scripts/'))
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)
        raise


def _write(path: pathlib.Path, text: str, is_program: bool) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding='utf-8')
    if is_program:
        mode = path.stat().st_mode
        path.chmod(mode | mode >> 2 & ANYBODY_RUNS)  # whoever may read it may run it


# -- what is to be done next


def workspace_of(folder: pathlib.Path) -> Optional[pathlib.Path]:
    """The catkin workspace in whose src the folder is, by its name; None: in none."""
    return next((each.parent for each in (folder, *folder.parents) if each.name == 'src'), None)


def _advice(path: pathlib.Path, files: List[str], author: Author) -> str:
    workspace = workspace_of(path.parent)
    lines = [f'{path}:', *(f'  {file}' for file in files), '']
    if not author.is_known:
        lines += [
            'Who maintains it, git does not know (git config --global user.name, user.email), or',
            'catkin would not take the address: write yours into package.xml.',
            '',
        ]
    lines += [
        'Its tests pass as it is, where a workspace that has pharos was sourced, or pharos is installed:',
        f'  /usr/bin/python3 -m pytest {path}/test',
        '',
    ]
    if workspace is None:
        lines += [
            f'{path.parent} is not the src of a catkin workspace. Move the package to one:',
            f'  mkdir -p ~/catkin_ws/src && mv {path} ~/catkin_ws/src/',
            '',
        ]
    lines += [
        'Build and run it:',
        f'  cd {workspace or "~/catkin_ws"}',
        f'  {CATKIN_MAKE} && source devel/setup.bash',
        f'  roslaunch {path.name} {path.name}.launch',
    ]
    return '\n'.join(lines)
