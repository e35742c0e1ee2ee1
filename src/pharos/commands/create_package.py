"""The command create_package."""
from __future__ import annotations

import argparse
import keyword
import pathlib
import re

import rospkg

from pharos.commands import argument_parser
from pharos.python_versions import STANDARD_MODULES

NAME_PATTERN = re.compile(r'[a-z][a-z0-9]*(_[a-z0-9]+)*')
NODE_LINE = re.compile('.*my_node.*\n')


def create_package(arguments: list[str]) -> None:
    """Make a catkin package whose nodes are written with pharos.

      cd ~/catkin_ws/src
      rosrun pharos create_package my_robot                            with a node my_robot_node
      rosrun pharos create_package my_robot --node camera controller   with these

    Each node is a class in a module, with a program in scripts/ and a test. At first a node counts the
    messages that it receives: put your own code there. The launch file starts all nodes. Write the
    maintainer and the license into package.xml.
    """
    parser = argument_parser(create_package)
    parser.add_argument(
        'package', metavar='NAME', type=package_name, help='the name of the package'
    )
    parser.add_argument(
        '--node', metavar='NAME', type=package_name, nargs='+', help='the names of its nodes'
    )
    options = parser.parse_args(arguments)
    package = options.package
    write_package(package, options.node or [f'{package}_node'])
    print(f'Made {package}. In the workspace: catkin_make -DPYTHON_EXECUTABLE=/usr/bin/python3')
    print(f'  source devel/setup.bash; roslaunch {package} {package}.launch')


def package_name(text: str) -> str:
    """Return the text if a package or node can have it as its name.

    :raises argparse.ArgumentTypeError: if not
    """
    is_module = text in STANDARD_MODULES
    if is_module or keyword.iskeyword(text) or not NAME_PATTERN.fullmatch(text):
        raise argparse.ArgumentTypeError(
            f'{text!r} cannot be a name: give small letters, digits and single underscores, and no'
            ' word or module of Python'
        )
    return text


def write_package(package: str, nodes: list[str]) -> None:
    """Write a package to a folder of its name, from the folder template of this package.

    In the template, my_package, my_node and MyNode stand for the names. A file with my_node in its
    name is written once for each node. In other files, a line with my_node is repeated for each.

    :raises FileExistsError: if the folder exists
    :raises rospkg.ResourceNotFound: if ROS_PACKAGE_PATH does not have pharos
    """

    def fill_in(text, node):
        class_name = node.title().replace('_', '')
        text = text.replace('MyNode', class_name).replace('my_node', node)
        return text.replace('my_package', package)

    def repeat_line(match):
        return ''.join(fill_in(match[0], node) for node in nodes)

    template = pathlib.Path(rospkg.RosPack().get_path('pharos'), 'template')
    pathlib.Path(package).mkdir()
    for path in filter(pathlib.Path.is_file, template.rglob('*')):
        if path.suffix == '.pyc':
            continue
        text = path.read_text()
        file_nodes = nodes
        if 'my_node' not in path.name:
            text = NODE_LINE.sub(repeat_line, text)
            file_nodes = nodes[:1]  # one file for all
        for node in file_nodes:
            target = pathlib.Path(package, fill_in(str(path.relative_to(template)), node))
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(fill_in(text, node))
            target.chmod(path.stat().st_mode)
