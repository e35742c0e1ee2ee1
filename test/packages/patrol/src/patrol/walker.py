"""The node walker."""
import pharos
import std_msgs.msg


class Walker(pharos.Node):
    """Walks towards what it hears on goal, and says on position where it is, in metres."""

    def start(self) -> None:
        """At the beginning of its way, with no other goal."""
        super().start()
        self.position = self.goal = 0.0
        self.speed = self.parameter('~speed', initialized=0.5)  # metres a step
        self.interested_in('goal', typed_as='std_msgs/Float64', delegate=self.aim)
        self.fork(Walker.walk)

    def aim(self, message: std_msgs.msg.Float64, channel: pharos.InputChannel) -> None:
        """Somebody has another goal for it."""
        self.goal = message.data
        self.log(f'goes to {self.goal:g} m')

    def walk(self) -> None:
        """A step towards the goal, again and again."""
        for _ in self.every(self.parameter('~period', initialized=0.1).value):
            speed = self.speed.value
            self.position += max(-speed, min(speed, self.goal - self.position))
            self.send_to('position', data=self.position, typed_as='std_msgs/Float64')
