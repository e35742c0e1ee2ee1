#!/usr/bin/python3
"""Recording a drive with rosbag, and replaying it again and again, in the time of the recording.

Each replay jumps back in time, and the node's loop and rospy's Timer follow. All nodes of a master
have one time, so this starts a master of its own: it needs no roscore. It runs until Ctrl-C, and
says what to type meanwhile in another terminal.
"""
import contextlib
import itertools
import math
import pathlib
import tempfile

from pharos import BlockNode, Master, Node, Transcript


def drive(robot):
    for turn in robot.every(0.1):
        robot.send_to('/position', typed_as='geometry_msgs/Point', x=math.sin(turn / 10))


class Listener(Node):
    def start(self):
        super().start()
        self.x = math.nan
        self.interested_in('/position', typed_as='geometry_msgs/Point', delegate=self.keep)
        self.fork(Listener.look)
        self.ros.Timer(self.ros.Duration(1), lambda event: self.show('Timer'), reset=True)

    def keep(self, position, channel):
        self.x = position.x

    def look(self):
        for _ in self.every(0.5):
            self.show('every')

    def show(self, who):
        Transcript.show(f'{self.ros.get_time() % 1000:.1f} {who}: x={self.x:.2f}')


def main():
    with Master.embedded() as master, tempfile.TemporaryDirectory() as folder:
        Transcript.show(f'ROS_MASTER_URI={master.url} rostopic echo /clock')
        bag = pathlib.Path(folder, 'drive.bag')
        with master.create(BlockNode, named='robot', soul=drive) as robot:
            robot.fork()
            Transcript.show('recording')
            master.run('rosbag', 'record', '--duration=2', '-O', bag, '/position').wait()
        master.parameters['/use_sim_time'] = True
        master.create(Listener, named='listener')
        for count in itertools.count(1):
            Transcript.show(f'replay {count}')
            master.run('rosbag', 'play', '--clock', bag, '__name:=player').wait()


if __name__ == '__main__':
    with contextlib.suppress(KeyboardInterrupt):
        main()
