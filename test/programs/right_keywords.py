"""A user's program without mistakes: mypy finds none, also with the plugin. See test_typing.py."""
import sys
from typing import Any, List, Optional

import pharos
from pharos import BlockNode, InputChannel, Master, Node, Transcript


class Driver(Node):
    """A node with keywords of its own."""

    def __init__(self, speed: float, frame: str = 'odom') -> None:
        super().__init__()
        self.speed, self.frame = speed, frame
        self.seen: List[Any] = []

    def start(self) -> None:
        super().start()
        self.interested_in('/scan', 'sensor_msgs/LaserScan', delegate=self.on_scan)
        self.delegate = self.on_scan
        self.soul = Driver.drive
        self.serve('~set', 'std_srvs/SetBool', lambda request: (request.data, 'done'))
        self.parameter('~speed', initialized=self.speed).on_change(print)
        self.fork(Driver.drive)

    def stop(self) -> None:
        self.log('stops')
        super().stop()

    def drive(self) -> None:
        for _ in self.every(0.1):
            self.send_to('/cmd_vel', typed_as='geometry_msgs/Twist', linear={'x': self.speed})

    def on_scan(self, scan: Any, channel: InputChannel) -> None:
        self.seen.append(scan)

    def nearest(self) -> float:
        message = self.wait_for_message('/scan', timeout=5, where=lambda scan: bool(scan.ranges))
        return float(min(message.ranges))


def main(argv: Optional[List[str]] = None) -> int:
    """Run it."""
    with Master.embedded() as master:
        with master.create(Driver, named='/driver', speed=1.0, frame='map', argv=argv) as driver:
            nearest = driver.nearest()
            Transcript.show(nearest, driver.seen)
        master.create(Driver, '/other', None, 0, 0, None, None, None, 2.0)
        logger = master.create(
            BlockNode,
            named='/logger',
            soul=lambda me: me.sleep(1),
            delegate=lambda message, channel: Transcript.show(message),
        )
        logger.send_to('/chatter', data='hello', typed_as='std_msgs/String')
        logger.send_to('/chatter', {'data': 'hello'}, to='/driver', wait=1.0, connect_timeout=1)
        logger.send_to('/chatter', lambda message: setattr(message, 'data', 'x'))
        logger.send_to('/markers', typed_as='visualization_msgs/Marker', type=1, ns='a', id=3)
        logger.send_to('/orders', type='x', types=['a'], timeout=1.0, connection_timeout=2.0)
        channel = logger.output_channel('/chatter', latch=True)
        channel.send(data='hello', typed=1)
        service = master.wait_for_service('/driver/set', timeout=5)
        print(service.call(data=True, timeout=1.0).success)
        for node in master.nodes():
            print(node.name)
        for failure in logger.failures:
            failure.retry()
        pharos.spin()
    return 0


if __name__ == '__main__':
    sys.exit(main())
