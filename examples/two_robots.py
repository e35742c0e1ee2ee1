#!/usr/bin/python3
"""Two robots, each with a ROS master of its own, in one program; one follows where the other goes.

Both have a node /robot, and neither sees the other's: of their topics only /leader goes from one
master to the other, over `rosrun pharos bridge`. No roscore is needed. It goes on until Ctrl-C;
what to type meanwhile, in other terminals, it says itself.
"""
import contextlib
import math

from pharos import BlockNode, Master, Transcript, spin


def lead(robot):
    for turn in robot.every(0.2):
        position = {'x': math.cos(turn / 10), 'y': math.sin(turn / 10)}
        robot.send_to('/leader', position, typed_as='geometry_msgs/Point')


def follow(point, channel):
    channel.node.send_to('/goal', typed_as='geometry_msgs/Point', x=0.9 * point.x, y=0.9 * point.y)


def main():
    with Master.embedded() as first, Master.embedded() as second:
        for master, topic in (first, '/leader'), (second, '/goal'):
            Transcript.show(f'ROS_MASTER_URI={master.url} rostopic echo {topic}')
        leader = first.create(BlockNode, named='robot', soul=lead)
        follower = second.create(BlockNode, named='robot', delegate=follow)
        follower.interested_in('/leader', typed_as='geometry_msgs/Point')
        leader.fork()
        urls = first.url, second.url
        with first.run('pharos', 'bridge', *urls, '/leader', on_line=Transcript.show):
            spin()


if __name__ == '__main__':
    with contextlib.suppress(KeyboardInterrupt):
        main()
