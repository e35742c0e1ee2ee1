"""The files of a new package: their texts, in which ``@word@`` stands for what differs."""
import re
from typing import Dict, Iterable, List, NamedTuple, Tuple
from xml.sax.saxutils import escape, quoteattr

PACKAGE_XML = '''\
<?xml version="1.0"?>
<?xml-model href="http://download.ros.org/schema/package_format3.xsd" schematypens="http://www.w3.org/2001/XMLSchema"?>
<package format="3">
  <name>@package@</name>
  <version>0.1.0</version>
  <description>Nodes written with pharos: @node_names@.</description>
  <maintainer email=@email_attribute@>@author_text@</maintainer>
  <license>@license_text@</license>
  <author email=@email_attribute@>@author_text@</author>

  <buildtool_depend>catkin</buildtool_depend>
  <buildtool_depend>python3-setuptools</buildtool_depend>

  <exec_depend>pharos</exec_depend>
  <exec_depend>std_msgs</exec_depend>

  <test_depend>python3-pytest</test_depend>

  <export>
    <architecture_independent/>
  </export>
</package>
'''

CMAKE_LISTS = '''\
cmake_minimum_required(VERSION 3.10)
project(@package@)

find_package(catkin REQUIRED)

catkin_python_setup()
catkin_package()

catkin_install_python(
  PROGRAMS
@script_lines@
  DESTINATION ${CATKIN_PACKAGE_BIN_DESTINATION}
)
install(DIRECTORY launch DESTINATION ${CATKIN_PACKAGE_SHARE_DESTINATION})

if(CATKIN_ENABLE_TESTING)
  # Not catkin_add_nosetests: Debian has no nose any more, and without it that silently adds no test.
  set(pytest_results "${CATKIN_TEST_RESULTS_DIR}/${PROJECT_NAME}/pytest.xml")
  catkin_run_tests_target("pytest" "nodes" "pytest.xml"
    COMMAND "${PYTHON_EXECUTABLE} -m pytest --junitxml=${pytest_results} ${PROJECT_SOURCE_DIR}/test"
  )
endif()
'''

SETUP = '''\
"""Read by catkin_python_setup() in CMakeLists.txt; name and version are those of package.xml."""

from catkin_pkg.python_setup import generate_distutils_setup
from setuptools import setup

setup(**generate_distutils_setup(packages=['@package@'], package_dir={'': 'src'}))
'''

INIT = '''\
"""The nodes of the package @package@, each a class in a module of its own."""
'''

NODE = '''\
"""The node @node@."""

import pharos
import std_msgs.msg


class @class@(pharos.Node):
    """Says on ~output, every ~period seconds, how much it has heard on ~input."""

    def start(self) -> None:
        """Open what the node needs; it has registered with the master when super() returns."""
        super().start()
        self.heard = 0
        self.period = self.parameter('~period', initialized=1.0)
        self.interested_in('~input', typed_as='std_msgs/String', delegate=self.hear)
        self.fork(@class@.speak)

    def hear(self, message: std_msgs.msg.String, channel: pharos.InputChannel) -> None:
        """Run for each message on ~input, one at a time."""
        self.heard += 1
        self.log(f'heard {message.data!r}')

    def speak(self) -> None:
        """Run in a thread of its own, until the node stops."""
        while self.is_running:
            self.send_to('~output', data=f'heard {self.heard}', typed_as='std_msgs/String')
            self.sleep(max(0.01, self.period.value))  # as it is by now, whoever has set it
'''

SCRIPT = '''\
#!/usr/bin/python3
"""Runs the node @node@ until Ctrl-C."""

import sys

import pharos
from @package@.@node@ import @class@
from pharos import program


def main() -> None:
    """Run it, with the names and parameters that rosrun or roslaunch give."""
    pharos.Master().create(@class@, named='@node@', argv=sys.argv)
    pharos.spin()


if __name__ == '__main__':
    sys.exit(program.run('@node@', main, about=__doc__))
'''

ALL_IN_ONE = '''\
#!/usr/bin/python3
"""Runs all nodes of @package@ in one process, until Ctrl-C."""

import sys

import pharos
@imports@
from pharos import program


def main() -> None:
    """Make them one after the other; each hears what the one before says."""
    argv = [
        *sys.argv,
@remappings@
    ]
    master = pharos.Master()
@creations@
    pharos.spin()


if __name__ == '__main__':
    sys.exit(program.run('@program@', main, about=__doc__))
'''

CONFTEST = '''\
"""Fixtures: a ROS master for each test, and nodes that end with it."""

import pathlib
import sys

# the tests run in a clone where nothing is built, too
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent / 'src'))

from pharos.testing import (  # noqa: E402, F401
    create_node,
    expect_failures,
    mailbox,
    master,
    pytest_configure,
)
'''

TEST = '''\
"""The node @node@."""

import pharos
from pharos import testing
from @package@.@node@ import @class@


def test_it_says_how_much_it_has_heard(create_node: testing.NodeFactory) -> None:
    node = create_node(@class@, argv=['_period:=0.1'])
    other = create_node(pharos.BlockNode)
    said = testing.Mailbox(other, f'{node.name}/output', 'std_msgs/String')
    other.send_to(f'{node.name}/input', data='hello', typed_as='std_msgs/String')
    said.wait_for(lambda message: message.data == 'heard 1')
'''

LAUNCH = '''\
<?xml version="1.0"?>
<launch>
  <arg name="period" default="1.0" doc="seconds between two messages of a node"/>

@launched@
</launch>
'''

LAUNCHED = '''\
  <node name="@node@" pkg="@package@" type="@node@" output="screen">
    <param name="period" value="$(arg period)" type="double"/>
  </node>
'''

LAUNCHED_NEXT = '''\
  <!-- hears what the node above says -->
  <node name="@node@" pkg="@package@" type="@node@" output="screen">
    <remap from="~input" to="@former@/output"/>
    <param name="period" value="$(arg period)" type="double"/>
  </node>
'''

README = '''\
# @package@

Nodes written with pharos: @node_names@.

It goes into the `src` of a catkin workspace that has pharos, or is built on one that has it. In the workspace:

    @catkin_make@
    source devel/setup.bash
    roslaunch @package@ @package@.launch

While that runs:

    rostopic echo /@first@/output
    rostopic pub --once /@first@/input std_msgs/String hello
    rosrun pharos graph

`rosrun @package@ @first@` runs one node@all_in_one@.

## Tests

In a shell that has sourced the workspace, here, or, when it is built, in the workspace:

    /usr/bin/python3 -m pytest test
    catkin_make run_tests_@package@ && catkin_test_results build/test_results

## Files

- `src/@package@`: the nodes, each a class in a module.
- `scripts`: a program for each; all are listed in `CMakeLists.txt`.
- `launch/@package@.launch`: all of them, with their names, parameters and remappings.
- `test`: a file for each node, whose tests have a ROS master of their own.
'''


#: builds a workspace, also where another python3 is before Debian's, which alone has catkin and rospy
CATKIN_MAKE = 'catkin_make -DPYTHON_EXECUTABLE=/usr/bin/python3'
#: the program that has all nodes, where there are several
IN_ONE = 'all_in_one'


class Package(NamedTuple):
    """What a new package is to be."""

    name: str
    nodes: List[str]
    author: str
    email: str
    license: str


def class_name(node: str) -> str:
    """The name of the class of a node: LineFollower for line_follower."""
    return ''.join(word.capitalize() for word in node.split('_'))


def files_of(package: Package) -> Dict[str, str]:
    """``{path in the package: text}``; those in scripts are programs."""
    is_one = len(package.nodes) == 1
    programs = package.nodes if is_one else [*package.nodes, IN_ONE]
    words = {
        'package': package.name,
        'catkin_make': CATKIN_MAKE,
        'first': package.nodes[0],
        'node_names': ', '.join(package.nodes),
        'script_lines': '\n'.join(f'    scripts/{program}' for program in sorted(programs)),
        'launched': '\n'.join(_launched(package)).rstrip('\n'),
        'all_in_one': ''
        if is_one
        else f', `rosrun {package.name} {IN_ONE}` all of them in one process',
        'author_text': escape(package.author),
        'email_attribute': quoteattr(package.email),
        'license_text': escape(package.license),
    }
    found = {
        'README.md': README,
        'package.xml': PACKAGE_XML,
        'CMakeLists.txt': CMAKE_LISTS,
        'setup.py': SETUP,
        f'src/{package.name}/__init__.py': INIT,
        f'launch/{package.name}.launch': LAUNCH,
        'test/conftest.py': CONFTEST,
    }
    texts = {path: _fill(text, words) for path, text in found.items()}
    for node in package.nodes:
        words.update(node=node, **{'class': class_name(node)})
        texts[f'src/{package.name}/{node}.py'] = _fill(NODE, words)
        texts[f'scripts/{node}'] = _fill(SCRIPT, words)
        texts[f'test/test_{node}.py'] = _fill(TEST, words)
    if not is_one:
        texts[f'scripts/{IN_ONE}'] = _all_in_one(package)
    return texts


def _all_in_one(package: Package) -> str:
    classes = {node: class_name(node) for node in package.nodes}
    lines = {
        'imports': [
            f'from {package.name}.{node} import {classes[node]}' for node in sorted(package.nodes)
        ],
        'remappings': [
            f"        '{node}:~input:={former}/output'," for former, node in _pairs(package)
        ],
        'creations': [
            f"    master.create({classes[node]}, named='{node}', argv=argv)"
            for node in package.nodes
        ],
    }
    words = {word: '\n'.join(text) for word, text in lines.items()}
    return _fill(ALL_IN_ONE, {**words, 'package': package.name, 'program': IN_ONE})


def _pairs(package: Package) -> Iterable[Tuple[str, str]]:
    """Each node but the first, after the one that it hears."""
    return zip(package.nodes, package.nodes[1:])


def _launched(package: Package) -> List[str]:
    """The nodes of the launch file, each of which hears the one before."""
    names = {'package': package.name}
    first = _fill(LAUNCHED, {**names, 'node': package.nodes[0]})
    others = [
        _fill(LAUNCHED_NEXT, {**names, 'former': former, 'node': node})
        for former, node in _pairs(package)
    ]
    return [first, *others]


def _fill(text: str, words: Dict[str, str]) -> str:
    return re.sub('@(\\w+)@', lambda match: words[match[1]], text)
