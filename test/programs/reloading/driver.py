"""A node whose module is edited and reloaded while it runs."""
from pharos import Node

STEP = 1


class Driver(Node):
    """Adds up what it hears, tells the sums, and turns."""

    def __init__(self):
        super().__init__()
        self.sum = 0
        self.turned = []

    def start(self):
        super().start()
        self.sums = self.output_channel('/sums', 'std_msgs/Int32')
        self.interested_in('/steps', 'std_msgs/Int32', delegate=self.on_step)
        self.serve('/step', 'std_srvs/Trigger', self.on_call)
        self.parameter('~step').on_change(self.on_parameter)
        self.fork(Driver.turn, name='turning')

    def on_step(self, message, channel):
        self.sum += message.data * STEP
        self.sums.send(data=self.sum)

    def on_call(self, request):
        return {'message': 'first'}

    def on_parameter(self, value):
        self.changed = 'first'

    def turn(self):
        for _ in self.every(0.001):
            self.turned.append('first')
