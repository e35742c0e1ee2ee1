"""The node my_node."""
from pharos import Node


class MyNode(Node):
    """Says on ~output, every ~period seconds, how many messages came on ~input."""

    def start(self):
        """Open what the node needs; it is registered with the master when super() returns."""
        super().start()
        self.count = 0
        self.period = self.parameter('~period', initialized=1.0)
        self.interested_in('~input', typed_as='std_msgs/String', delegate=self.hear)
        self.fork(MyNode.speak, required=True)

    def hear(self, message):
        """Run for each message on ~input, one at a time."""
        self.count += 1
        self.log(f'heard {message.data!r}')

    def speak(self):
        """Run in a thread of its own, until the node stops."""
        while self.is_running:
            self.send_to('~output', typed_as='std_msgs/String', data=f'{self.count} came')
            self.sleep(self.period.value)
