#!/usr/bin/python3
"""Coordinate frames with tf2: a robot drives in a circle, and a node asks where its camera is.

The robot broadcasts where it is in the map, and once where its camera is mounted. tf2 puts the two
together. It runs until Ctrl-C. Meanwhile, in other terminals:

  rostopic echo /camera/position
  rostopic echo /tf
"""
import contextlib
import math

from geometry_msgs.msg import TransformStamped

from pharos import BlockNode, Master, spin


def transform(stamp, parent, child, x, y, yaw=0.0):
    made = TransformStamped(child_frame_id=child)
    made.header.stamp, made.header.frame_id = stamp, parent
    made.transform.translation.x, made.transform.translation.y = x, y
    made.transform.rotation.z, made.transform.rotation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    return made


def drive(robot):
    tf2_ros, now = robot.ros_import('tf2_ros'), robot.ros.Time.now
    mounting = tf2_ros.StaticTransformBroadcaster()
    mounting.sendTransform(transform(now(), 'robot', 'camera', 0.5, 0.0))
    broadcaster = tf2_ros.TransformBroadcaster()
    for turn in robot.every(0.1):
        yaw = turn / 20
        x, y = 2 * math.sin(yaw), -2 * math.cos(yaw)
        broadcaster.sendTransform(transform(now(), 'map', 'robot', x, y, yaw))


def look(observer):
    tf2_ros, latest = observer.ros_import('tf2_ros'), observer.ros.Time(0)
    frames = tf2_ros.Buffer()
    tf2_ros.TransformListener(frames)
    for _ in observer.every(1):
        if frames.can_transform('map', 'camera', latest, observer.ros.Duration(1)):
            found = frames.lookup_transform('map', 'camera', latest).transform.translation
            observer.send_to('/camera/position', typed_as='geometry_msgs/Vector3', block=found)
            observer.log(f'the camera is at x={found.x:.2f}, y={found.y:.2f} in the map')


def main():
    master = Master()
    master.create(BlockNode, named='observer', soul=look).fork()
    master.create(BlockNode, named='robot', soul=drive).fork()
    spin()


if __name__ == '__main__':
    with contextlib.suppress(KeyboardInterrupt):
        main()
