"""The node guard."""
import pharos
import std_msgs.msg


class Guard(pharos.Node):
    """Sends the walker up and down a way ~length metres long."""

    def start(self) -> None:
        """It waits to hear where the walker is."""
        super().start()
        self.length = self.parameter('~length', initialized=2.0)
        self.interested_in('position', typed_as='std_msgs/Float64', delegate=self.look)

    def look(self, message: std_msgs.msg.Float64, channel: pharos.InputChannel) -> None:
        """At an end, the goal is the other end."""
        if message.data <= 0:
            self.send_to('goal', data=self.length.value, typed_as='std_msgs/Float64')
        elif message.data >= self.length.value:
            self.send_to('goal', data=0.0, typed_as='std_msgs/Float64')
