#!/usr/bin/python3
"""An action server and its client: actionlib, unmodified, in two nodes of one process.

The server counts down, and tells each step. The client cancels a goal that takes longer than 2 s:
each second one. It runs until Ctrl-C. Meanwhile, in other terminals:

  rostopic echo /countdown/feedback
  rostopic pub -1 /countdown/goal actionlib/TestActionGoal '{goal: {goal: 4}}'    # takes its place
"""
import contextlib
import itertools

from actionlib.msg import TestAction, TestFeedback, TestGoal, TestResult

from pharos import BlockNode, Master, Node, spin


class Server(Node):
    def start(self):
        super().start()
        actionlib = self.ros_import('actionlib')
        self.action = actionlib.SimpleActionServer('/countdown', TestAction, self.count_down, False)
        self.action.start()

    def count_down(self, goal):
        for left in range(goal.goal, 0, -1):
            if self.action.is_preempt_requested() or not self.is_running:
                self.action.set_preempted(TestResult(left))
                return
            self.action.publish_feedback(TestFeedback(left))
            self.sleep(0.3)
        self.action.set_succeeded(TestResult(0))


def ask(me):
    def show(feedback):
        me.log(f'{feedback.feedback} ...')

    def end(state, result):
        me.log(f'stopped at {result.result}' if result.result else 'lift-off')

    client = me.ros_import('actionlib').SimpleActionClient('/countdown', TestAction)
    client.wait_for_server()
    for seconds, _ in zip(itertools.cycle([5, 10]), me.every(3)):
        client.send_goal(TestGoal(seconds), done_cb=end, feedback_cb=show)
        if not client.wait_for_result(me.ros.Duration(2)):
            client.cancel_goal()


def main():
    master = Master()
    master.create(Server, named='server')
    master.create(BlockNode, named='client', soul=ask).fork()
    spin()


if __name__ == '__main__':
    with contextlib.suppress(KeyboardInterrupt):
        main()
