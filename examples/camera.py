#!/usr/bin/python3
"""A camera, a detector and a controller, in one process: their images need no socket.

A ball swings before the camera, and the robot turns towards it, until Ctrl-C. In other terminals:

  rostopic echo /cmd_vel                # angular.z follows the ball
  rosparam set /controller/gain 3.0     # the robot turns three times as fast, at once
  rosrun pharos top                     # how often messages come, and by what transport
"""
import contextlib
import math

import numpy

from pharos import BlockNode, Master, Node, Transcript, spin

HEIGHT, WIDTH = 480, 640
SIZE = {'height': HEIGHT, 'width': WIDTH, 'step': WIDTH, 'encoding': 'mono8'}


def film(camera):
    for turn in camera.every(0.1):
        pixels = numpy.zeros((HEIGHT, WIDTH), numpy.uint8)
        column = int(WIDTH / 2 + WIDTH / 3 * math.sin(turn / 10))
        pixels[200:240, column - 20 : column + 20] = 255
        camera.send_to('/image', typed_as='sensor_msgs/Image', data=pixels.tobytes(), **SIZE)


def detect(image, channel):
    pixels = numpy.frombuffer(image.data, numpy.uint8).reshape(image.height, image.width)
    rows, columns = pixels.nonzero()
    channel.node.send_to('/ball', typed_as='geometry_msgs/Point', x=columns.mean(), y=rows.mean())


class Controller(Node):
    def start(self):
        super().start()
        self.gain = self.parameter('~gain', initialized=1.0)
        self.gain.on_change(lambda gain: Transcript.show(f'the gain is {gain} from now on'))
        self.interested_in('/ball', typed_as='geometry_msgs/Point', delegate=self.follow)

    def follow(self, ball, channel):
        turn = self.gain.value * (0.5 - ball.x / WIDTH)
        self.send_to('/cmd_vel', typed_as='geometry_msgs/Twist', angular={'z': turn})
        self.ros.loginfo_throttle(1, f'the ball is in column {ball.x:.0f}: turns by {turn:+.2f}')


def main():
    master = Master()
    master.create(Controller, named='controller')
    detector = master.create(BlockNode, named='detector', delegate=detect)
    detector.interested_in('/image', typed_as='sensor_msgs/Image')
    master.create(BlockNode, named='camera', soul=film).fork()
    spin()


if __name__ == '__main__':
    with contextlib.suppress(KeyboardInterrupt):
        main()
