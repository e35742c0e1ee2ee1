"""Where a turtle takes its commands, and what they are made of.

It differs between the releases of turtlesim: up to ROS groovy, and so in the report, they are
turtlesim/Velocity on /turtle1/command_velocity, since ROS hydro geometry_msgs/Twist on
/turtle1/cmd_vel. The graph tells which of them is there.
"""

import posixpath
from typing import Any, List, NamedTuple, Optional

from pharos import Node

TWIST = 'geometry_msgs/Twist'
VELOCITY = 'turtlesim/Velocity'
PATIENCE = 10.0  # seconds that a program waits for a turtle which is only just being started


class Commands(NamedTuple):
    """A topic of commands, and their type."""

    topic: str
    type: str

    def fill(self, message: Any, linear: float, angular: float) -> None:
        """Make it a command to drive so many metres and turn so many radians a second.

        :raises ValueError: if messages of this type command no turtle
        """
        self.check()
        if self.type == TWIST:
            message.linear.x = linear
            message.angular.z = angular
        else:
            message.linear = linear
            message.angular = angular

    def check(self) -> None:
        """Raise ValueError if messages of this type command no turtle."""
        if self.type not in (TWIST, VELOCITY):
            raise ValueError(
                f'{self.topic} is of type {self.type}, and a turtle takes {TWIST} or {VELOCITY}:'
                ' name the topic with _topic:=, its type with _type:='
            )

    def __str__(self) -> str:
        return f'{self.topic} ({self.type})'


#: turtlesim's, the one to be preferred first
TURTLESIM = [
    Commands('/turtle1/cmd_vel', TWIST),
    Commands('/turtle1/command_velocity', VELOCITY),
]


def possible_commands(node: Node) -> List[Commands]:
    """Where commands may come: both of turtlesim's topics, or what the private parameters ~topic
    and ~type of the node name.

    :raises ValueError: if turtlesim has no topic of that type, or no topic can have that name
    """
    topic, type_name = (str(node.ros.get_param(name, '')) for name in ('~topic', '~type'))
    if topic:
        node.current_run.resolve(topic, 'topic')  # raises where it is no name
        return [Commands(topic, type_name or _type_of(node, topic))]
    found = [commands for commands in TURTLESIM if type_name in ('', commands.type)]
    if not found:
        raise ValueError(f'no topic of turtlesim has type {type_name}: name one with _topic:=')
    return found


def find_commands(node: Node) -> Commands:
    """Where the turtle takes its commands: waits for it, and says in a line of the log what it
    found.

    A turtle is whoever tells its pose beside the topic; of a topic that ~topic names, whoever
    listens to it. Where there is none in time, it is a topic that anybody listens to, or else
    that of turtlesim since ROS hydro.

    :raises ValueError: as :func:`possible_commands` does
    :raises NodeStoppedError: if the node stops meanwhile
    """
    possible = possible_commands(node)
    for commands in possible:
        commands.check()
    expected = ' or '.join(map(str, possible))
    found = _turtle(node)
    if found is None:
        node.log(f'waits for a turtle, which listens to {expected}')
        found = node.master.look_until_found(lambda: _turtle(node), PATIENCE, 'a turtle')
    if found is None:
        found = _heard(node) or possible_commands(node)[0]
        node.log(f'no turtle came within {PATIENCE:g} s', level='warn')
    node.log(f'drives {node.ros.resolve_name(found.topic)} ({found.type})')
    return found


def _type_of(node: Node, topic: str) -> str:
    """The type that the master knows, or else the one that the name suggests."""
    suggested = VELOCITY if posixpath.basename(topic) == 'command_velocity' else TWIST
    return dict(node.master.topic_types()).get(node.ros.resolve_name(topic), suggested)


def _turtle(node: Node) -> Optional[Commands]:
    """The commands to which a turtle listens."""
    if node.ros.get_param('~topic', ''):
        return _heard(node)
    publishers, subscribers, _ = node.master.system_state()
    for commands in possible_commands(node):
        topic = node.ros.resolve_name(commands.topic)
        pose = posixpath.join(posixpath.dirname(topic), 'pose')
        if set(subscribers.get(topic, ())) & set(publishers.get(pose, ())):
            return commands
    return None


def _heard(node: Node) -> Optional[Commands]:
    """The commands to which any other node listens."""
    _, subscribers, _ = node.master.system_state()
    for commands in possible_commands(node):
        if set(subscribers.get(node.ros.resolve_name(commands.topic), ())) - {node.name}:
            return commands
    return None
