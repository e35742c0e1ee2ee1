#!/usr/bin/python3
"""A service that takes its time: an arm that needs 3 s or 1 s to pick, one thing at a time.

Each call runs in a thread of its own, so the arm can tell a second caller at once that it is busy.
The callers wait for 2 s, and then do something else. It runs until Ctrl-C. Meanwhile, in other
terminals:

  rostopic echo /arm/progress
  rosservice call /arm/pick     # tells when it has picked, or at once that the arm is busy
"""
import contextlib
import itertools
import threading

from pharos import BlockNode, Master, Node, ServiceCallError, spin


class Arm(Node):
    def start(self):
        super().start()
        self.gripper = threading.Lock()
        self.seconds = itertools.cycle([3, 1])
        self.serve('~pick', 'std_srvs/Trigger', self.pick)

    def pick(self, request):
        if not self.gripper.acquire(blocking=False):
            return False, 'the arm is busy'
        try:
            seconds = next(self.seconds)
            for percent in range(0, 100, 10):
                self.send_to('~progress', typed_as='std_msgs/UInt8', data=percent)
                self.sleep(seconds / 10)
            return True, f'picked in {seconds} s'
        finally:
            self.gripper.release()


def ask(me):
    pick = me.lookup_service('arm/pick')
    for _ in me.every(2):
        try:
            me.log(pick.call(timeout=2).message)
        except ServiceCallError as error:
            me.log(f'does something else: {error}', level='warn')


def main():
    master = Master()
    master.create(Arm, named='arm')
    for name in 'anna', 'bert':
        master.create(BlockNode, named=name, soul=ask).fork()
    spin()


if __name__ == '__main__':
    with contextlib.suppress(KeyboardInterrupt):
        main()
