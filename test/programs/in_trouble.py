"""A node of pharos that fails once and drops three messages, and then says so."""
import threading

from pharos import BlockNode, Master, Node, spin


class Troubled(Node):
    """Takes nothing while it is busy."""

    def start(self):
        super().start()
        self.busy, self.go_on = threading.Event(), threading.Event()
        self.interested_in('/trouble', 'std_msgs/String', delegate=self.take, queue_size=1)

    def take(self, message, channel):
        self.busy.set()
        self.go_on.wait()
        if message.data == '0':
            raise RuntimeError('in trouble')


master = Master()
node, peer = master.create(Troubled, 'in_trouble'), master.create(BlockNode, 'peer')
for number in range(5):  # one is being taken, one waits, three are dropped
    peer.send_to('/trouble', typed_as='std_msgs/String', data=str(number))
    node.busy.wait()
node.go_on.set()
spin()
