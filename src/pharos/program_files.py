"""The files of ROS programs and launch files, found as rosrun and roslaunch find them."""
import contextlib
import os
from typing import Iterator, List, Optional, Union

import roslib.packages
import rospkg
from catkin.find_in_workspaces import find_in_workspaces

from pharos.errors import PharosError, UnknownNodeError

AnyPath = Union[str, 'os.PathLike[str]']


def find(package: str, executable: str) -> List[str]:
    """The paths of a program, as rosrun looks it up.

    :raises UnknownNodeError: if there is no such package or program
    """
    with _known(package, executable):
        paths = _find(package, executable)
    if not paths:
        what = f': see what it has with rosrun {package} <Tab>'
        with contextlib.suppress(rospkg.ResourceNotFound):  # it has no package.xml, as in _find
            for file in roslib.packages.find_resource(package, executable):
                what = f', but a file of that name, which is not executable: chmod +x {file}'
        raise UnknownNodeError(f'the ROS package {package} has no program {executable!r}{what}')
    return paths


def _find(package: str, executable: str) -> List[str]:
    try:
        return list(roslib.packages.find_node(package, executable))
    except rospkg.ResourceNotFound:
        # Debian's topic_tools and others have no package.xml, but catkin knows their folder
        folders = find_in_workspaces(['libexec'], project=package)
        if not folders:
            raise
        paths = [os.path.join(folder, executable) for folder in folders]
        return [path for path in paths if os.path.isfile(path) and os.access(path, os.X_OK)]


def find_launch_file(package: Optional[AnyPath], file: Optional[AnyPath]) -> str:
    """The path of a launch file, as roslaunch looks it up.

    :param package: without it, or without ``file``, the other one is a path
    :raises UnknownNodeError: if there is no such package or launch file
    """
    if package is None or file is None:
        return _check_launch_path(file if package is None else package)
    if not isinstance(file, str):
        raise ValueError(
            f'a launch file of the package {package!r} is given by its name, not {file!r}: without'
            ' the package, it is a path'
        )
    with _known(package, file):
        found = roslib.packages.find_resource(package, file)
    if not found:
        raise UnknownNodeError(
            f'the ROS package {package} has no launch file {file!r}: is it spelt so, and installed?'
        )
    return str(found[0])


def _check_launch_path(path: Optional[AnyPath]) -> str:
    if not isinstance(path, (str, os.PathLike)):
        raise ValueError(
            'a launch file is given by its package and name, or by its path alone, not by'
            f' {path!r}'
        )
    if os.path.isfile(path):
        return str(path)
    if os.path.isdir(path):
        raise UnknownNodeError(f'{str(path)!r} is a folder: give the path of a launch file in it')
    hint = ''
    if os.sep not in str(path):
        hint = f' One of a ROS package is given by two names: {str(path)!r}, and that of the file.'
    raise UnknownNodeError(f'there is no launch file {str(path)!r}: is the path spelt so?{hint}')


@contextlib.contextmanager
def _known(package: object, file: object) -> Iterator[None]:
    """Say what to do where there is no such package."""
    if not all(isinstance(name, str) and name for name in (package, file)):
        raise ValueError(
            f'a ROS package and a program or file in it are given by their names, not {package!r}'
            f' and {file!r}'
        )
    if os.sep in str(package):
        raise UnknownNodeError(
            f'{package!r} is a path, and no ROS package, in which to look for {file!r}: give the name'
            ' of a package, or None for the second, before what the program is told'
        )
    try:
        yield
    except rospkg.ResourceNotFound:
        raise UnknownNodeError(
            f'no ROS package {package!r} on ROS_PACKAGE_PATH: install it, or source its'
            ' workspace\'s setup.bash'
        ) from None
    except Exception as error:  # catkin reads the package.xml of every package in a workspace
        raise PharosError(f'{package}/{file} cannot be looked up: {error}; mend that') from error
