#!/usr/bin/python3
"""Ten minutes of a robot in a second: it drives until its battery is low, and docks.

The robot and its world are ordinary nodes. In a Simulation they run as fast as the processor allows,
and do the same each time. This needs no roscore.
"""
import random
import time

from pharos import Master, Node, Transcript
from pharos.simulation import Simulation


class World(Node):
    """Moves the robot, and drains or charges its battery."""

    def start(self):
        super().start()
        self.x = 0.0
        self.speed = 0.0
        self.interested_in('/speed', 'std_msgs/Float64', self.set_speed)
        self.fork(World.go_on)

    def set_speed(self, message):
        self.speed = message.data

    def go_on(self):
        percentage = 1.0
        for _ in self.every(0.1):
            self.x += 0.1 * self.speed
            is_at_dock = abs(self.x) < 0.1
            percentage += 0.001 if is_at_dock else -0.0003 * random.random()
            self.send_to('/position', typed_as='geometry_msgs/Point', x=self.x)
            self.send_to('/battery', typed_as='sensor_msgs/BatteryState', percentage=percentage)


class Robot(Node):
    """Drives to and fro, and to its dock at x = 0 when a tenth of the battery is left."""

    docked = False

    def start(self):
        super().start()
        self.goes_home = False
        self.speed = 0.5
        self.interested_in('/battery', 'sensor_msgs/BatteryState', self.read)
        self.interested_in('/position', 'geometry_msgs/Point', self.steer)

    def read(self, battery):
        if battery.percentage < 0.1:
            self.goes_home = True

    def steer(self, position):
        if self.goes_home:
            self.docked = abs(position.x) < 0.05
            self.speed = -position.x
        elif abs(position.x) > 5:
            self.speed = -0.1 * position.x
        self.send_to('/speed', typed_as='std_msgs/Float64', data=self.speed)


def main():
    with Master.embedded() as master, Simulation(master) as simulation:
        with master.create(World, 'world'), master.create(Robot, 'robot') as robot:
            start = simulation.now
            simulation.run_until(lambda: robot.docked, limit=3600)
            seconds = simulation.now - start
    Transcript.show(f'docked after {seconds:.1f} s, in {time.process_time():.1f} s')


if __name__ == '__main__':
    main()
