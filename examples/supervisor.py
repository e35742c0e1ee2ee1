#!/usr/bin/python3
"""A supervisor that restarts nodes of its process, if they have failed or were stopped.

Each worker fails after some steps: that ends its soul, and no other node. The supervisor says why,
restarts it, and sends the health of all on /diagnostics. It runs until Ctrl-C. Meanwhile, in other
terminals:

  rosnode kill /left        # the supervisor starts it again
  rostopic echo /diagnostics
"""
import contextlib
import random

from pharos import BlockNode, Master, MasterUnreachableError, Node, NodeStoppedError, spin


class Worker(Node):
    def start(self):
        super().start()
        self.fork(Worker.work)

    def work(self):
        for step in self.every(0.1):
            self.send_to('/steps', typed_as='std_msgs/UInt32', data=step)
            if random.random() < 0.02:
                raise RuntimeError(f'the wheel is stuck after {step} steps')


def supervise(supervisor, workers):
    due = {}  # worker -> why it is to be restarted
    for _ in supervisor.every(1):
        for worker in workers:
            if worker.errors or not worker.is_running:
                due[worker] = worker.errors[-1] if worker.errors else 'it was stopped'
            if worker in due:
                supervisor.log(f'restarts {worker.name}: {due[worker]}', level='warn')
                try:
                    worker.restart()
                    del due[worker]
                except (MasterUnreachableError, NodeStoppedError) as error:  # stopped half way
                    supervisor.log(f'will try again: {error}', level='warn')
        health = [{'name': each.name, 'message': str(vars(each.health()))} for each in workers]
        supervisor.send_to(
            '/diagnostics', typed_as='diagnostic_msgs/DiagnosticArray', status=health
        )


def main():
    master = Master()
    workers = [master.create(Worker, named=name) for name in ('left', 'right')]
    supervisor = master.create(BlockNode, named='supervisor')
    supervisor.fork(lambda me: supervise(me, workers))
    spin()


if __name__ == '__main__':
    with contextlib.suppress(KeyboardInterrupt):
        main()
