"""Makes a catkin package whose nodes are written with pharos.

  cd ~/catkin_ws/src
  rosrun pharos create_package my_robot                            with a node my_robot_node
  rosrun pharos create_package my_robot --node camera controller   with these

Each node is a class in a module, with a program in scripts/ and a test. A node counts the messages
that it hears: replace that by what it shall do. The launch file starts all nodes. Write who
maintains the package, and its license, into package.xml.
"""
import argparse
import keyword
import pathlib
import re
import sys

import rospkg
import rospy

NAME = re.compile(r'[a-z][a-z0-9]*(_[a-z0-9]+)*')


def create_package(package, nodes):
    """Write a package to a folder of its name, after the folder template of this package.

    There, my_package, my_node and MyNode stand for the names. A file that has my_node in its name
    is written for each node; in other files, a line that has it.

    :raises FileExistsError: if there is such a folder
    :raises rospkg.ResourceNotFound: if this package is not installed as one of ROS
    """

    def fill(text, node):
        text = text.replace('MyNode', node.title().replace('_', '')).replace('my_node', node)
        return text.replace('my_package', package)

    template = pathlib.Path(rospkg.RosPack().get_path('pharos'), 'template')
    pathlib.Path(package).mkdir()
    for path in filter(pathlib.Path.is_file, template.rglob('*')):
        text = path.read_text()
        if 'my_node' not in path.name:
            text = re.sub(
                '.*my_node.*\n', lambda line: ''.join(fill(line[0], n) for n in nodes), text
            )
        for node in nodes if 'my_node' in path.name else nodes[:1]:
            target = pathlib.Path(package, fill(str(path.relative_to(template)), node))
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(fill(text, node))
            target.chmod(path.stat().st_mode)


def name_of(text):
    """Return the text if a package or node can have it as its name, else raise an error."""
    if not NAME.fullmatch(text) or keyword.iskeyword(text) or text in sys.stdlib_module_names:
        raise argparse.ArgumentTypeError(
            f'{text!r} cannot be a name: give small letters, digits and single underscores, and no'
            ' word or module of Python'
        )
    return text


def main():
    """Run the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('package', metavar='NAME', type=name_of, help='the package')
    parser.add_argument('--node', metavar='NAME', type=name_of, nargs='+', help='its nodes')
    options = parser.parse_args(rospy.myargv()[1:])
    package = options.package
    try:
        create_package(package, options.node or [f'{package}_node'])
    except (OSError, rospkg.ResourceNotFound) as error:
        sys.exit(f'create_package: {error}')
    print(f'Made {package}. In the workspace: catkin_make -DPYTHON_EXECUTABLE=/usr/bin/python3')
    print(f'  source devel/setup.bash; roslaunch {package} {package}.launch')
