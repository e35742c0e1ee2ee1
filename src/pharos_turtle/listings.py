"""Options, a turtle, and an end, which the programs of the report's listings share.

The turtle's commands differ between the releases of turtlesim. Up to ROS groovy, and in the report,
they are turtlesim/Velocity on /turtle1/command_velocity. Since ROS hydro they are
geometry_msgs/Twist on /turtle1/cmd_vel. The graph tells which of the two a turtle takes.
"""
import argparse
import os
import sys

import rospy

from pharos import PharosError
from pharos.waiting import wait

TWIST = 'geometry_msgs/Twist'
#: the topics on which turtles take commands, with their types; the first is preferred
COMMANDS = (('/turtle1/cmd_vel', TWIST), ('/turtle1/command_velocity', 'turtlesim/Velocity'))
TURTLE_TIMEOUT = 10.0  # seconds that a program waits for a turtle to start


def find_commands(node):
    """Return the topic and the type of a turtle's commands; waits a while until a turtle is there.

    A turtle is any other node that receives from one of :data:`COMMANDS`.
    """

    def has_turtle(topic):
        subscribers = node.master.topic(node.ros.resolve_name(topic)).subscribers
        return bool(set(subscribers) - {node.name})

    def find_turtles():
        return [command for command in COMMANDS if has_turtle(command[0])]

    turtles = wait(find_turtles, TURTLE_TIMEOUT, node) or COMMANDS
    topic, type_name = turtles[0]
    node.log(f'drives {node.ros.resolve_name(topic)} ({type_name})')
    return topic, type_name


def fill(message, linear, angular):
    """Fill in the speeds of a command: metres and radians in one second."""
    if message._type == TWIST:
        message.linear.x = linear
        message.angular.z = angular
    else:
        message.linear = linear
        message.angular = angular


def parser_of(description):
    """Return a parser of options that are keywords of ``Master.create``."""
    parser = argparse.ArgumentParser(
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        argument_default=argparse.SUPPRESS,
    )
    parser.add_argument('--domain', help='address to advertise; by default ROS_HOSTNAME')
    for option in '--tcp-port', '--xmlrpc-port':
        parser.add_argument(option, type=int, help='by default any free one')
    return parser


def options_of(parser):
    """Return the options of the command line, as keywords of ``Master.create``."""
    return {'argv': sys.argv, **vars(parser.parse_args(rospy.myargv()[1:]))}


def run(main):
    """Run the ``main`` of a program; an error of ours ends it with one line and the status 1."""
    try:
        main()
    except KeyboardInterrupt:
        pass
    except (PharosError, ValueError) as error:
        sys.exit(f'{os.path.basename(sys.argv[0])}: {error}')
