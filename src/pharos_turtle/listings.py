"""Shared by the programs of the report's listings: options, a turtle, an end.

The turtle's commands differ between the releases of turtlesim: up to ROS groovy, and so in the
report, they are turtlesim/Velocity on /turtle1/command_velocity, since ROS hydro
geometry_msgs/Twist on /turtle1/cmd_vel. The graph tells which of them is there.
"""
import argparse
import os
import sys

import rospy

from pharos import PharosError
from pharos.waiting import wait

TWIST = 'geometry_msgs/Twist'
#: where turtles take commands, and the types of these; the first is preferred
COMMANDS = (('/turtle1/cmd_vel', TWIST), ('/turtle1/command_velocity', 'turtlesim/Velocity'))
PATIENCE = 10.0  # seconds until a program gives up waiting for a turtle that is just starting


def find_commands(node):
    """Return the topic to which a turtle listens, and its type; waits for one for a while.

    A turtle is any other node that listens to one of :data:`COMMANDS`.
    """

    def others(topic):
        return {*node.master.topic(node.ros.resolve_name(topic)).subscribers} - {node.name}

    def heard():
        return [each for each in COMMANDS if others(each[0])]

    topic, type_name = (wait(heard, PATIENCE, node) or COMMANDS)[0]
    node.log(f'drives {node.ros.resolve_name(topic)} ({type_name})')
    return topic, type_name


def fill(message, linear, angular):
    """Make the message a command to drive at so many metres and radians a second."""
    if message._type == TWIST:
        message.linear.x, message.angular.z = linear, angular
    else:
        message.linear, message.angular = linear, angular


def parser_of(description):
    """Return the parser of a program whose options are keywords of ``Master.create``."""
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
    """Return what the command line says, as keywords of ``Master.create``."""
    return {'argv': sys.argv, **vars(parser.parse_args(rospy.myargv()[1:]))}


def run(main):
    """Run the ``main`` of a program; what is wrong is told in one line, with the status 1."""
    try:
        main()
    except KeyboardInterrupt:
        pass
    except (PharosError, ValueError) as error:
        sys.exit(f'{os.path.basename(sys.argv[0])}: {error}')
